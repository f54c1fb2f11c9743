"""Cells of `benchmarks.installed`: one failure on one recording, replayed once, its scores kept as JSON in the cache.

What is kept is named by the hash of fgloc's sources and of those that score, and by the recording: an interrupted run
goes on where it was, and a change of either is measured anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.adaptive_recordings import Floor, Recorded, cache_folder
from benchmarks.adaptive_runs import CASES as FAILURES
from benchmarks.adaptive_runs import Replayed, changed, failure, replayed
from benchmarks.installed_recordings import Take, folder, load
from benchmarks.installed_scores import (
    Scores,
    carried,
    errors,
    found_by,
    found_errors,
    lost_share,
    map_over_survey,
    places_in,
    refused_share,
)
from benchmarks.textbook import PIPELINES, Textbook
from fgloc.ablation.failures import Kidnap, Lift
from fgloc.config import Config
from fgloc.errors import FglocError
from fgloc.estimation.localizer import Localizer
from fgloc.evaluation.metrics import match
from fgloc.files.atomic import atomic_file
from fgloc.types import Estimate, Step, Trajectory

CASES = ("none", "slip", "mu01", "dark30", "dark60", "ids30", "moved", "frozen", "onewheel", "kidnap")
_ROOT = Path(__file__).resolve().parent.parent
_SCORING = ("adaptive_runs", "installed_map", "installed_runs", "installed_scores", "textbook")
_PLAIN = {"motion": {"use": False}}  # a textbook knows no learned motion either


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """A case on a recording."""

    take: Take
    case: str
    plain: bool = False  # without learned motion, online, and beside it the textbook's pipelines on the same steps

    @property
    def name(self) -> str:
        """Name of the cell, for files and tables."""
        return f"{self.case}{'_plain' if self.plain else ''}_{folder(self.take)}_{self.take.variant}"


def floor(case: str) -> Floor:
    """Floor on which a case is driven."""
    return FAILURES[case].floor


# --- Many cells -------------------------------------------------------------------------------------------------------


def run_all(cells: Sequence[Cell], jobs: int | None = None) -> dict[Cell, Scores]:
    """Scores of all cells, from the cache or run now; a process (by default one per core) keeps to one recording."""
    groups = [list(group) for _, group in groupby(sorted(cells), key=lambda cell: cell.take)]
    found: dict[Cell, Scores] = {}
    began = time.monotonic()
    with ProcessPoolExecutor(min(jobs or os.cpu_count() or 1, len(groups)), get_context("spawn")) as pool:
        for job in as_completed([pool.submit(_run_group, group) for group in groups]):
            found.update(job.result())
            gone = time.monotonic() - began
            left = gone * (len(cells) / len(found) - 1.0)
            print(f"{len(found)} of {len(cells)} cells, {gone:.0f} s, {left:.0f} s left", file=sys.stderr, flush=True)
    return found


def _run_group(cells: Sequence[Cell]) -> dict[Cell, Scores]:
    out = {}
    for cell in cells:
        out[cell] = Scores.from_json(kept(cell.name, lambda cell=cell: run_cell(cell).as_json()))  # type: ignore[misc]
    return out


def kept(name: str, make: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
    """Result of a cell: from the cache, or made now and put there."""
    path = cache_folder() / "installed" / f"{name}_{_sources()}.json"
    if path.is_file():
        return dict(json.loads(path.read_text(encoding="utf-8")))
    began = time.monotonic()
    content = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as file:
        json.dump(content, file)
    print(
        f"  {name}: {time.monotonic() - began:.1f} s {content.get('failed') or content.get('batch_failed') or ''}",
        file=sys.stderr,
        flush=True,
    )
    return content


@cache
def _sources() -> str:
    made = hashlib.sha256()
    package = sorted(p for p in (_ROOT / "fgloc").rglob("*") if p.suffix in (".py", ".safetensors"))
    for path in [*package, *(_ROOT / "benchmarks" / f"{name}.py" for name in _SCORING)]:
        made.update(path.relative_to(_ROOT).as_posix().encode())
        made.update(path.read_bytes())
    return made.hexdigest()[:12]


# --- One cell ---------------------------------------------------------------------------------------------------------


def run_cell(cell: Cell) -> Scores:
    """Scores of a case that is replayed now; of a failed run the reason."""
    recorded = load(cell.take)
    try:
        chain = [failure(described) for described in FAILURES[cell.case].chain(recorded)]
    except ValueError as error:  # a drive too short for the failure
        return Scores(failed=str(error))
    config = changed(recorded.config, _PLAIN if cell.plain else {})
    batch_failed = ""
    for batch in (False,) if cell.plain else (True, False):
        with processor_times() as times:
            try:
                made = replayed(recorded, config, chain, cell.take.seed, batch)
            except FglocError as error:
                if not batch:
                    return Scores(failed=f"{type(error).__name__}: {error}")
                batch_failed = f"{type(error).__name__}: {error}"  # what was found online is scored all the same
                continue
        if made is None:
            return Scores(failed="no pose was ever found")
        return replace(_scores(recorded, config, made, times, cell.plain), batch_failed=batch_failed)
    raise AssertionError("an online run ends the loop")


def _scores(recorded: Recorded, config: Config, made: Replayed, times: Sequence[float], plain: bool) -> Scores:
    lifted = [f.when.intervals[0][0] for f in made.chain if isinstance(f, Kidnap | Lift)]
    unknown = carried(made.given, recorded.start_ns + round(lifted[0] * 1e9)) if lifted else None
    online, batch = made.online, made.batch
    found = None if batch is None or recorded.installed is None else found_by(batch)
    return Scores(
        online=errors(online, config, unknown),
        batch=None if batch is None else errors(batch, config, unknown),
        lost_share=lost_share(online.modes, online.trajectory.stamps_ns, unknown),
        refused_share=refused_share(online.decisions),
        update_ms=tuple(round(ms, 4) for ms in times),
        found=None if found is None else found_errors(found, recorded.installed or {}),
        map_over_survey=None
        if found is None
        else map_over_survey(places_in(found), made.landmarks, recorded.installed or {}),
        textbook_mm=textbook_mm(recorded, config, made) if plain else {},
    )


def textbook_mm(recorded: Recorded, config: Config, made: Replayed) -> dict[str, float]:
    """Mean distance from the truth of each of the textbook's pipelines on the steps of a run [mm]."""
    if recorded.camera is None or made.online.truth is None:
        raise ValueError(f"{recorded.name}: the textbook needs a camera and a truth")
    out = {}
    for pipeline in PIPELINES:
        estimates = Textbook(pipeline, made.landmarks, recorded.camera, config.wheels).run(made.steps)
        stamps = np.array([e.stamp_ns for e in estimates], dtype=np.int64)
        trajectory = Trajectory(stamps, np.array([e.pose for e in estimates]).reshape(-1, 3))
        enough = len(estimates) > 1
        out[pipeline] = 1e3 * float(match(trajectory, made.online.truth).distances.mean()) if enough else np.inf
    return out


@contextmanager
def processor_times() -> Iterator[list[float]]:
    """Processor time [ms] of every update after the one that gave the first pose, while this holds."""
    times: list[float] = []
    started = False
    update = Localizer.update

    def timed(self: Localizer, step: Step) -> Estimate | None:
        nonlocal started
        began = time.process_time()
        estimate = update(self, step)
        if started:
            times.append((time.process_time() - began) * 1e3)
        started = started or estimate is not None
        return estimate

    with patch.object(Localizer, "update", timed):
        yield times
