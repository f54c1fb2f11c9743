"""Cells of `benchmarks.follow`: one drive each, its score kept as JSON in the cache.

What is kept is named by the hash of the sources of fgloc and of the simulator: an interrupted run goes on where it was,
and after a change everything is driven anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path

from benchmarks.recordings import cache_folder
from fgloc.errors import FglocError
from fgloc.files.atomic import atomic_file
from fgloc_datasets.sim.following import PoseName, follow
from fgloc_datasets.sim.following.cases import drive_of

_ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """One drive."""

    seed: int
    case: str
    pose: PoseName
    corners: bool = False  # of markers, not images


@dataclass(frozen=True, slots=True)
class Driven:
    """Score of the drive (`fgloc_datasets.sim.following.loop.Score`), or the reason why it failed."""

    track_mm: float = float("nan")
    reached: float = 0.0
    arrived: bool = False
    pose_mm: float | None = None
    seconds: float = float("nan")
    failed: str = ""


def run_all(cells: Sequence[Cell], jobs: int | None = None) -> dict[Cell, Driven]:
    """All drives, from the cache or driven now."""
    found: dict[Cell, Driven] = {}
    began = time.monotonic()
    with ProcessPoolExecutor(jobs or os.cpu_count() or 1, get_context("spawn")) as pool:
        waiting = {pool.submit(kept, cell): cell for cell in cells}
        for job in as_completed(waiting):
            found[waiting[job]] = job.result()
            left = (time.monotonic() - began) * (len(cells) / len(found) - 1.0)
            print(f"{len(found)} of {len(cells)} drives, {left:.0f} s left", file=sys.stderr, flush=True)
    return found


def kept(cell: Cell) -> Driven:
    """A drive from the cache, or driven now and put there."""
    sees = "corners" if cell.corners else "images"
    path = cache_folder() / "follow" / f"{cell.case}_{cell.pose}_{cell.seed}_{sees}_{source_hash()}.json"
    if path.is_file():
        return Driven(**json.loads(path.read_text(encoding="utf-8")))
    made = _driven(cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as file:
        json.dump(asdict(made), file)
    print(f"  {cell.case} {cell.pose} {cell.seed}: {made}", file=sys.stderr, flush=True)
    return made


def _driven(cell: Cell) -> Driven:
    try:
        score = follow(drive_of(cell.case, cell.pose, cell.seed, "corners" if cell.corners else "images")).score
    except FglocError as error:
        return Driven(failed=str(error))
    return Driven(score.track_mm, score.reached, score.arrived, score.pose_mm, score.seconds)


@cache
def source_hash(benchmark: Path = Path(__file__)) -> str:
    """Hash of fgloc's sources and of a benchmark's module."""
    made = hashlib.sha256()
    parts = [_ROOT / "fgloc"]
    files = sorted(p for part in parts for p in part.rglob("*") if p.suffix in (".py", ".safetensors", ".yaml"))
    for path in [*files, benchmark]:
        made.update(path.relative_to(_ROOT).as_posix().encode())
        made.update(path.read_bytes())
    return made.hexdigest()[:12]
