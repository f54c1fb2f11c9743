"""Simulated robots of several drives, as installed: the rows ``sim.*`` of `benchmarks.drives`.

Each robot drives over the floors of the simulated suite, with the control functions of its test split: grippy (``none``),
and patches of friction 0.04 to 0.15 in stop and go (``slip``; ``dark30``: the same with no image for 30 s). Corners are
those that `CornerDetector` finds, without rendering, at 5 Hz. None has learned motion. The differential robot is the
measure of the others: ``sim.DRIVE.CASE.MODE.ate_mm`` is the mean distance from the truth, ``.over_differential`` its ratio
to the differential robot's, ``.nees`` NEES/3, each a mean over the seeds.

Noise of the wheels is that of the simulator's robots; of other seeds only 91 was looked at. Finished cells are kept (`benchmarks.replays.kept`).
"""

# ruff: noqa: E501 (lines of the description)
from __future__ import annotations

import heapq
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import lru_cache
from hashlib import sha256
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import Row
from benchmarks.recordings import Recorded, cache_folder, scenario
from benchmarks.replays import failure, kept, replayed
from benchmarks.scores import errors
from fgloc.config import config_of
from fgloc.errors import FglocError
from fgloc.files.atomic import atomic_folder
from fgloc.recording.reader import open_recording
from fgloc.sensors.maps import load_map
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.sim.physics import make_scene, simulate
from fgloc_datasets.sim.record import (
    BUNDLED,
    RUN_FILES,
    describe,
    is_recorded,
    load_suite,
    robot_settings,
    write_beside,
)
from fgloc_datasets.sim.scenario import Installation, Robot, Scenario
from fgloc_datasets.sim.sensors import streams

DRIVES = ("differential", "ackermann", "mecanum", "skid")
CASES = ("none", "slip", "dark30")
SEEDS = tuple(range(101, 111))
_QUICK_SEEDS = SEEDS[:1]
DURATION_S = 50.0
_DARK_S = (15.0, 45.0)
_SCENARIOS = {"ackermann": "ackermann", "mecanum": "mecanum", "skid": "skid_steer"}


def measure(quick: bool, drives: Sequence[str] = DRIVES, seeds: Sequence[int] | None = None) -> Iterator[Row]:
    """The rows; a quick run has one seed."""
    seeds = seeds or (_QUICK_SEEDS if quick else SEEDS)
    of: dict[tuple[str, str, str], list[dict[str, float]]] = {}
    for drive in drives:
        for case in CASES:
            cells = [_cell(drive, case, seed) for seed in seeds]
            for mode in ("batch", "online"):
                found = [cell[mode] for cell in cells if mode in cell]
                of[drive, case, mode] = found
                name = f"sim.{drive}.{case}.{mode}"
                failed = "; ".join(cell["failed"] for cell in cells if "failed" in cell)
                ate = [cell["ate_mm"] for cell in found]
                yield _row(f"{name}.ate_mm", ate, "mm", failed)
                yield _row(f"{name}.nees", [cell["nees_over_3"] for cell in found], "", failed)
                reference = [cell["ate_mm"] for cell in of.get(("differential", case, mode), [])]
                if drive != "differential" and ate and reference:
                    yield Row(f"{name}.over_differential", float(np.mean(ate) / np.mean(reference)), n=len(ate))


def _row(name: str, values: Sequence[float], unit: str, failed: str) -> Row:
    if failed or not values:
        return Row(name, None, n=0, reason=failed or "no run")
    return Row(name, float(np.mean(values)), float(np.std(values)), len(values), unit)


def _cell(drive: str, case: str, seed: int) -> dict[str, Any]:
    """Errors in batch and online of one run, from the cache or measured now."""
    made = recorded_scenario(drive, case)
    key = sha256(describe(made, seed, True).encode()).hexdigest()[:12]
    return dict(kept(f"drive_{drive}_{case}_{seed}_{key}", lambda: run_cell(drive, case, seed)))


def run_cell(drive: str, case: str, seed: int) -> dict[str, Any]:
    """Errors in batch and online of one run."""
    recorded = load(drive, "none" if case == "none" else "slip", seed)
    dark = {"kind": "dropout", "sensor": "camera", "when": {"intervals": [_DARK_S]}}
    chain = [failure(dark)] if case == "dark30" else []
    try:
        made = replayed(recorded, recorded.config, chain, seed, batch=True)
    except FglocError as error:
        return {"failed": f"seed {seed}: {type(error).__name__}: {error}"}
    if made is None or made.batch is None:
        return {"failed": f"seed {seed}: no pose was ever found"}
    return {mode: asdict(errors(getattr(made, mode), recorded.config)) for mode in ("batch", "online")}


# --- Recordings -------------------------------------------------------------------------------------------------------


def recorded_scenario(drive: str, case: str) -> Scenario:
    """Scenario of a robot on the floor of a case."""
    floor = scenario("unequal_radii" if case == "none" else "patches", "test")
    robot = Robot() if drive == "differential" else load_suite(BUNDLED).find(_SCENARIOS[drive]).robot
    quick = {} if case == "none" else {"max_acceleration": 8.0, "max_angular_acceleration": 40.0}
    return floor.model_copy(
        update={
            "robot": robot.model_copy(update=quick),
            "duration_s": DURATION_S,
            "installation": Installation.as_installed(),
        }
    )


@lru_cache(maxsize=2)
def load(drive: str, case: str, seed: int) -> Recorded:
    """One recording, made first if it is not there."""
    made = recorded_scenario(drive, case)
    key = sha256(describe(made, seed, True).encode()).hexdigest()[:12]
    folder = cache_folder() / "drives" / f"{drive}_{case}_{seed}_{key}"
    if not is_recorded(made, seed, folder, True):
        record(made, seed, folder)
    config = config_of(robot_settings(made) | {"motion": {"use": False}})
    with open_recording(folder / "bag", config.recording) as recording:
        start_ns, duration_s, events = recording.span_ns[0], recording.duration_s, tuple(recording.events())
    none = np.empty(0)
    return Recorded(
        name=folder.name,
        bag=folder / "bag",
        map_path=folder / "map.yaml",
        config=config,
        landmarks=load_map(folder / "map.yaml"),
        events=events,
        start_ns=start_ns,
        slip_s=none,
        slipping=none.astype(bool),
        slip=np.empty((0, 3)),
        truth=np.empty((0, 4)),
        duration_s=duration_s,
    )


def record(made: Scenario, seed: int, folder: Path) -> None:
    """Record a run with corners in place of images."""
    began = time.monotonic()
    scene = make_scene(made, seed)
    log = simulate(scene)
    with atomic_folder(folder, own=RUN_FILES) as stage:
        with BagWriter(stage / "bag", compress=True) as bag:
            for _, write in heapq.merge(*streams(scene, log, bag, "corners"), key=itemgetter(0)):
                write()
        write_beside(stage, scene, made, camera=True)
    print(f"  recorded {folder.name}: {time.monotonic() - began:.1f} s", file=sys.stderr, flush=True)
