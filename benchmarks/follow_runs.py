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
from typing import Any

import numpy as np

from benchmarks.adaptive_recordings import cache_folder
from benchmarks.adaptive_runs import failure
from datasets.sim.following import Drive, PoseName, follow, load_path
from datasets.sim.installation import Installation
from datasets.sim.physics import make_scene
from datasets.sim.scenario import Camera, Scenario
from datasets.sim.suite import BUNDLED, load_suite
from fgloc.ablation.failures import Failure
from fgloc.errors import FglocError
from fgloc.files.atomic import atomic_file

FAILED_S = (8.0, 28.0)  # when a sensor fails: from the first lane to the last but one
MOVED_M = 0.5
_CAMERA_HZ = 5.0
_ROOT = Path(__file__).resolve().parent.parent
_BLIND = ("truth", "wheels", "learned")  # need no images


@dataclass(frozen=True, slots=True)
class Case:
    """A floor of the simulated suite, a path, and what fails."""

    floor: str
    path: str
    failing: dict[str, Any] | None = None


_IN_TIME = {"intervals": [FAILED_S]}
CASES: dict[str, Case] = {
    "flat30": Case("calibrated", "grid30"),
    "flat20": Case("calibrated", "grid20"),
    "ice": Case("slippery", "grid30"),
    "dark20": Case("slippery", "grid30", {"kind": "dropout", "sensor": "camera", "when": _IN_TIME}),
    "onewheel": Case("calibrated", "grid30", {"kind": "encoder_dead", "wheel": "left", "when": _IN_TIME}),
    "moved": Case("calibrated", "grid30", {"kind": "moved_marker", "distance_m": MOVED_M}),
}


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """One drive."""

    seed: int
    case: str
    pose: PoseName


@dataclass(frozen=True, slots=True)
class Driven:
    """What came of it: see `datasets.sim.following.results.Score`; or why it failed."""

    track_mm: float = float("nan")
    reached: float = 0.0
    arrived: bool = False
    pose_mm: float | None = None
    seconds: float = float("nan")
    failed: str = ""


def drive(cell: Cell) -> Drive:
    """What is driven: as installed by a careful person, and no error besides."""
    case = CASES[cell.case]
    made = load_suite(BUNDLED).find(case.floor)
    robot = made.robot.model_copy(update={"radius_scale": (1.0, 1.0)})
    changes = {"robot": robot, "camera": Camera(rate_hz=_CAMERA_HZ), "installation": Installation.as_installed()}
    scenario = made.model_copy(update=changes)
    path = load_path(case.path)
    failures: tuple[Failure, ...] = ()
    if case.failing is not None and cell.pose != "truth":
        told = case.failing
        if told["kind"] == "moved_marker":
            told = told | {"ids": [_ahead(scenario.model_copy(update={"start": path.start}), cell.seed)]}
        failures = (failure(told),)
    sees = "nothing" if cell.pose in _BLIND else "images"
    return Drive(scenario, path, cell.pose, cell.seed, failures, sees)  # type: ignore[arg-type]


def _ahead(scenario: Scenario, seed: int) -> int:
    """The marker that the robot at the start has nearest before it: moving one that it seldom sees changes nothing."""
    x, y, yaw = scenario.start
    landmarks = make_scene(scenario, seed).landmarks.landmarks
    places = np.array([m.position[:2] for m in landmarks.values()]) - (x, y)
    off = np.abs(np.angle(np.exp(1j * (np.arctan2(places[:, 1], places[:, 0]) - yaw))))
    return list(landmarks)[int(np.argmin(off))]


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
    path = cache_folder() / "follow" / f"{cell.case}_{cell.pose}_{cell.seed}_{_sources()}.json"
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
        score = follow(drive(cell)).score
    except FglocError as error:
        return Driven(failed=str(error))
    return Driven(score.track_mm, score.reached, score.arrived, score.pose_mm, score.seconds)


@cache
def _sources() -> str:
    made = hashlib.sha256()
    parts = [_ROOT / "fgloc", _ROOT / "datasets" / "sim"]
    files = sorted(p for part in parts for p in part.rglob("*") if p.suffix in (".py", ".safetensors", ".yaml"))
    for path in [*files, Path(__file__)]:
        made.update(path.relative_to(_ROOT).as_posix().encode())
        made.update(path.read_bytes())
    return made.hexdigest()[:12]
