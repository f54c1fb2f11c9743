"""Replays that benchmarks share: a recording with a failure through fgloc, and figures of it that are kept as JSON.

Failures are those of `fgloc.ablation.failures`; what is random in them is drawn anew for each seed. Online and batch
come from the same replay. What is kept is named by the hash of fgloc's sources and of those that score, and by the
recording: an interrupted benchmark goes on where it was, and a change of either is measured anew.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from pydantic import TypeAdapter

from benchmarks.common import ROOT
from benchmarks.recordings import Floor, Recorded, cache_folder, moved_interval
from fgloc.ablation.failures import AnyFailure, Corruption, Kidnap, Lift
from fgloc.config import Config
from fgloc.errors import EstimatorError
from fgloc.estimation.localizer import Localizer
from fgloc.files.atomic import atomic_file
from fgloc.runner import RunResult, protections, run
from fgloc.sensors.failures import Failure
from fgloc.sensors.maps import write_map
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.types import Estimate, Event, LandmarkMap, Step, Trajectory

Interval = tuple[float, float]
FAILED_S = (30.0, 50.0)  # when encoders fail
KIDNAPPED_S, KIDNAPPED_M = 30.0, (3.0, 2.5, 2.0, 1.5, 1.0)  # the farthest that the drive allows
MOVED_M = 0.5
_FAILURE = TypeAdapter(AnyFailure)
_SCORING = ("installed", "recordings", "replays", "scores", "textbook")


@dataclass(frozen=True, slots=True)
class Case:
    """A failure on a floor."""

    floor: Floor
    chain: Callable[[Recorded], list[dict[str, Any]]] = lambda recorded: []


def _dark(length_s: float) -> Case:
    start = 0.5 * (80.0 - length_s)
    failure = {"kind": "dropout", "sensor": "camera", "when": {"intervals": [(start, start + length_s)]}}
    return Case("patches", lambda recorded: [failure])


def _wrong_ids(share: float) -> Case:
    return Case("unequal_radii", lambda recorded: [{"kind": "wrong_ids", "probability": share}])


def _encoders(failure: dict[str, Any]) -> Case:
    return Case("unequal_radii", lambda recorded: [failure | {"when": {"intervals": [FAILED_S]}}])


def _carried(kind: str) -> Case:
    def chain(recorded: Recorded) -> list[dict[str, Any]]:
        return [{"kind": kind, "when": {"intervals": [carried_interval(recorded)]}}]

    return Case("unequal_radii", chain)


FAILURES: dict[str, Case] = {
    "none": Case("unequal_radii"),
    "slip": Case("patches"),
    "mu01": Case("slippery"),
    "dark30": _dark(30.0),
    "dark60": _dark(60.0),
    "ids10": _wrong_ids(0.1),
    "ids30": _wrong_ids(0.3),
    "ids50": _wrong_ids(0.5),
    "moved": Case(
        "unequal_radii",
        lambda recorded: [{"kind": "moved_marker", "ids": [moved_id(recorded)], "distance_m": MOVED_M}],
    ),
    "frozen": _encoders({"kind": "encoder_frozen"}),
    "onewheel": _encoders({"kind": "encoder_dead", "wheel": "left"}),
    "kidnap": _carried("kidnap"),
    "lifted": _carried("lift"),
}


def floor(case: str) -> Floor:
    """Floor on which a case is driven."""
    return FAILURES[case].floor


@dataclass(frozen=True, slots=True, eq=False)
class Replayed:
    """Results of one run of a recording with failures.

    Attributes:
        online: the estimates as they were made, with all decisions.
        batch: the smoothed run, if it was asked for.
        chain: the failures.
        given: the images' corners that the localizer was given.
        steps: that it was given.
        landmarks: the map that it was given.
    """

    online: RunResult
    batch: RunResult | None
    chain: Sequence[Failure]
    given: Sequence[Event]
    steps: Sequence[Step]
    landmarks: LandmarkMap

    def unknown_ns(self, start_ns: int) -> tuple[int, int] | None:
        """Stamps [ns] from the first lift to the first image after it that shows a marker; None if nothing lifts it.

        ``start_ns`` is the recording's. In this time the pose cannot be known.
        """
        lifts_s = [f.when.intervals[0][0] for f in self.chain if isinstance(f, Kidnap | Lift)]
        if not lifts_s:
            return None
        lifted_ns = start_ns + round(lifts_s[0] * 1e9)
        seen = [e.stamp_ns for e in self.given if isinstance(e, CornersEvent) and e.sightings]
        return lifted_ns, min((stamp for stamp in seen if stamp > lifted_ns), default=2**62)


def replayed(recorded: Recorded, config: Config, chain: Sequence[Failure], seed: int, batch: bool) -> Replayed | None:
    """One run of a recording with failures; None if no pose was ever found.

    Raises:
        FglocError: the configuration does not fit the recording.
    """
    failing = Corruption(chain, (recorded.start_ns, recorded.duration_s), config, recorded.landmarks, seed)
    estimates: list[Estimate] = []
    steps: list[Step] = []
    given: list[Event] = []

    def note(step: Step, estimate: Estimate | None) -> None:
        steps.append(step)
        if estimate is not None:
            estimates.append(estimate)

    def keep(events: Iterator[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, CornersEvent):
                given.append(event)
            yield event

    with tempfile.TemporaryDirectory() as folder:
        map_path, landmarks = recorded.map_path, failing.corrupt_map(recorded.landmarks)
        if landmarks is not recorded.landmarks:
            map_path = Path(folder) / "map.yaml"
            write_map(landmarks, map_path)
        try:
            result = run(
                recorded.bag,
                map_path,
                config,
                "batch" if batch else "online",
                on_step=note,
                events=lambda _: failing.recorded(iter(recorded.events)),
                sightings=lambda events: keep(failing.sightings(events)),
            )
        except EstimatorError:
            if estimates:
                raise
            return None
    online = replace(
        result,
        trajectory=_trajectory(estimates),
        modes=tuple(e.mode for e in estimates),
        protections=protections(estimates),
    )
    return Replayed(online, result if batch else None, chain, given, steps, landmarks)


def _trajectory(estimates: Sequence[Estimate]) -> Trajectory:
    return Trajectory(
        np.array([e.stamp_ns for e in estimates], dtype=np.int64),
        np.array([e.pose for e in estimates]),
        np.array([e.cov for e in estimates]),
    )


def failures(case: str, recorded: Recorded) -> list[Failure]:
    """Failures of a case of `FAILURES` on a recording.

    Raises:
        ValueError: the drive is too short for them.
    """
    return [failure(described) for described in FAILURES[case].chain(recorded)]


def failure(described: Mapping[str, Any]) -> Failure:
    """A failure as a suite of ablations describes it."""
    return _FAILURE.validate_python(described)


def carried_interval(recorded: Recorded) -> Interval:
    """Interval [s] that is cut out of a drive, so that the robot seems to be carried away.

    Raises:
        ValueError: the robot stays too near to where it is.
    """
    for distance_m in KIDNAPPED_M[:-1]:
        with suppress(ValueError):
            return moved_interval(recorded, KIDNAPPED_S, distance_m)
    return moved_interval(recorded, KIDNAPPED_S, KIDNAPPED_M[-1])


def moved_id(recorded: Recorded) -> int:
    """The landmark that is seen most often: moving another might change nothing."""
    seen = [s.landmark_id for e in recorded.events if isinstance(e, CornersEvent) for s in e.sightings]
    seen += [s.landmark_id for e in recorded.events if isinstance(e, RangeBearingEvent) for s in e.sightings]
    seen = [i for i in seen if i in recorded.landmarks]
    ids, counts = np.unique(seen, return_counts=True)
    return int(ids[int(np.argmax(counts))])


# --- Figures that are kept --------------------------------------------------------------------------------------------


def kept(name: str, make: Callable[[], Mapping[str, Any]], *sources: Path) -> Mapping[str, Any]:
    """Result of a cell: from the cache, or made now and put there; ``sources``: others that it depends on."""
    path = cache_folder() / "installed" / f"{name}_{_sources(sources)}.json"
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
def _sources(others: tuple[Path, ...]) -> str:
    made = hashlib.sha256()
    package = sorted(p for p in (ROOT / "fgloc").rglob("*") if p.suffix in (".py", ".safetensors"))
    for path in [*package, *(ROOT / "benchmarks" / f"{name}.py" for name in _SCORING), *others]:
        made.update(path.relative_to(ROOT).as_posix().encode())
        made.update(path.read_bytes())
    return made.hexdigest()[:12]


def parallel(work: Callable[[Any], Any], items: Sequence[Any], jobs: int) -> Iterator[Any]:
    """Results of the work for the items, in any order; computed in this process if there is one job."""
    if jobs == 1 or len(items) < 2:
        yield from map(work, items)
        return
    with ProcessPoolExecutor(min(jobs, len(items)), get_context("spawn")) as pool:
        for job in as_completed([pool.submit(work, item) for item in items]):
            yield job.result()


def by_recording(
    work: Callable[[Any], Any], cells: Sequence[Any], recording: Callable[[Any], Any], jobs: int
) -> dict[Any, Any]:
    """Results of the work by cell; a process keeps to the cells of one recording at a time."""
    groups: dict[Any, list[Any]] = {}
    for cell in cells:
        groups.setdefault(recording(cell), []).append(cell)
    found: dict[Any, Any] = {}
    began = time.monotonic()
    for done in parallel(partial(_each, work), list(groups.values()), jobs):
        found.update(done)
        gone = time.monotonic() - began
        left = gone * (len(cells) / len(found) - 1.0)
        print(f"{len(found)} of {len(cells)} cells, {gone:.0f} s, {left:.0f} s left", file=sys.stderr, flush=True)
    return found


def _each(work: Callable[[Any], Any], cells: Sequence[Any]) -> dict[Any, Any]:
    return {cell: work(cell) for cell in cells}


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
