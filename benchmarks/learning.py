"""Worth of the learned motion, and of its adaptation: ``python -m benchmarks.learning [--quick] [--jobs N] [--json FILE]``.

A model of commands is trained here, on perfect recordings of the simulated robot on its grippy floor (``base``), and one
for each change (``native``): ``floor`` (friction 0.2 in place of 0.8), ``load`` (3 kg at the rear left), ``wheel`` (the
right one 4 % smaller) and ``both`` (the load on a floor of friction 0.3). Then other robots with the change, as
installed, drive by control functions that no training has seen: corners without rendering at 5 Hz, which are there for
120 s, then dark for 30 s and there for 30 s in turn, to 300 s. Online, one model in four ways: ``adapted`` (the default),
``frozen`` (`motion.adaptation_sigma` and `.scale_sigma` 0), ``native``, and ``none``.

- ``floor.CHANGE.WAY.drift30_percent``: of a robot that has commands alone; end errors of the dark stretches over the way
  in them, all seeds together; the spread is that of the seeds.
- ``floor.CHANGE.drift30_over_native``: of ``adapted``; ``.frozen_over_native`` beside it.
- ``floor.CHANGE.nees_over_3``: of ``adapted``, whole runs.
- ``never_worse``: share of all those runs (seeds, changes) in which the mean error of ``adapted`` is more than 5 % worse than
  that of ``frozen`` or of ``none``.
- ``worth.SENSORS.CHANGE.WAY.ate_mm``: runs of three seeds with wheels (``wheels``), with wheels and gyro (``gyro``): mean error.
- ``drive.DRIVE.WAY.{ate_mm,nees_over_3,drift30_percent}``: cars and mecanum robots, commands alone, with a model that was
  trained on such robots (``adapted``) and without; three seeds.
- ``wheels_only.dark60.MODE.{ate_mm,nees_over_3}``: robots of `benchmarks.installed` on slippery patches, a minute dark,
  whose gyro and model are taken away; ``.sound_named``: share of the runs in which a sound marker is accused.
- ``foreign.dark20.*``: likewise on a grippy floor, with a model of another robot in place of their own, dark from 1 to 21 s.
- ``step_over_frozen``: time of a step with adaptation over that without, of the runs of ``floor``; the spread is over them.

The form of the gains was chosen on free rollouts of seeds 131 to 135 of the changes floor, wheel and both, their noise on
seeds 161 and 162; none of them is reported here.
"""

# ruff: noqa: E501 (lines of the description)
from __future__ import annotations

import argparse
import hashlib
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

import fgloc_training
from benchmarks import drives
from benchmarks.common import MODELS, Row, main, mean_row
from benchmarks.recordings import SEEDS, Recorded, Split, Take, cache_folder, changed, load, scenario
from benchmarks.replays import failure, failures, kept, parallel, replayed
from benchmarks.scores import errors
from fgloc import se2
from fgloc.errors import FglocError
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.learned.card import Split as Parts
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import Event, FloatArray
from fgloc_datasets.sim.record import BUNDLED, Job, describe, load_suite, record_suite
from fgloc_datasets.sim.scenario import Installation, Payload, Scenario
from fgloc_training.config import DataConfig, NetworkConfig, OptimizationConfig, TrainConfig
from fgloc_training.data import load_run
from fgloc_training.train import train

CHANGES = ("floor", "load", "wheel", "both")
DRIVES = ("ackermann", "mecanum")
WAYS: dict[str, dict[str, Any]] = {
    "none": {"use": False},  # first: what a process does only once is not counted as adaptation
    "adapted": {},
    "frozen": {"adaptation_sigma": 0.0, "scale_sigma": 0.0},
    "native": {},
}
SENSORS: dict[str, tuple[type[Event], ...]] = {  # what a robot with these lacks
    "commands": (OdometryEvent, JointsEvent, ImuEvent),
    "wheels": (ImuEvent,),
    "gyro": (),
}
TEST_SEEDS: dict[Split, tuple[int, ...]] = {"test": tuple(range(171, 181)), "validation": tuple(range(161, 166))}
_WORTH_SEEDS, _WORTH_CHANGES = 3, ("floor", "wheel")
_DRIVE_WAYS = ("none", "adapted")
_TRAIN_SEEDS = {"train": (11, 12, 13), "validation": (21, 22)}
_DURATION_S, _FIXES_S, _DARK_S = 300.0, 120.0, 30.0
_WORSE = 1.05
_FOREIGN_DARK_S = (1.0, 21.0)
_DATA = DataConfig(smoothing_s=0.1)  # the truth is exact


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """One run: of a change, with these sensors, in one way."""

    change: str
    seed: int
    sensors: str
    way: str

    @property
    def name(self) -> str:
        """Name of the cell in the cache."""
        return f"learning_{self.change}_{self.sensors}_{self.way}_{self.seed}"


def measure(quick: bool, split: Split, jobs: int) -> Iterator[Row]:
    """Yield every row; a quick run has one seed and one change."""
    seeds, changes = (TEST_SEEDS[split][:1], CHANGES[:1]) if quick else (TEST_SEEDS[split], CHANGES)
    for change in ("base", *changes, *(() if quick else DRIVES)):
        model(change)
    cells = [Cell(c, s, "commands", way) for c in changes for s in seeds for way in WAYS]
    rest = [w for w in WAYS if w != "native"]
    worth = [c for c in _WORTH_CHANGES if c in changes]
    cells += [Cell(c, s, k, w) for c in worth for s in seeds[:_WORTH_SEEDS] for k in ("wheels", "gyro") for w in rest]
    others = () if quick else DRIVES
    cells += [Cell(c, s, "commands", w) for c in others for s in seeds[:_WORTH_SEEDS] for w in _DRIVE_WAYS]
    groups = [
        [cell for cell in cells if (cell.change, cell.seed) == key]
        for key in sorted({(c.change, c.seed) for c in cells})
    ]
    found: dict[Cell, dict[str, Any]] = {}
    for done in parallel(_run_group, groups, jobs):
        found.update(done)
    yield from _floor(found, changes, seeds)
    yield from _worth(found, worth, seeds[:_WORTH_SEEDS])
    yield from _drives(found, others, seeds[:_WORTH_SEEDS])
    ratios = [
        found[Cell(c, s, "commands", "adapted")]["step_ms"] / found[Cell(c, s, "commands", "frozen")]["step_ms"]
        for c in changes
        for s in seeds
    ]
    yield mean_row("step_over_frozen", ratios)
    yield from _installed(quick, split, jobs)


def _floor(found: dict[Cell, dict[str, Any]], changes: Sequence[str], seeds: Sequence[int]) -> Iterator[Row]:
    worse = 0
    for change in changes:
        drifts = {}
        for way in WAYS:
            ends = np.array([found[Cell(change, s, "commands", way)]["ends"] for s in seeds])
            per_seed = 100.0 * ends[:, 0] / ends[:, 1]
            drifts[way] = 100.0 * float(ends[:, 0].sum() / ends[:, 1].sum())
            name = f"floor.{change}.{way}.drift30_percent"
            yield Row(name, drifts[way], float(np.std(per_seed)), len(seeds), "%")
        yield Row(f"floor.{change}.drift30_over_native", drifts["adapted"] / drifts["native"], n=len(seeds))
        yield Row(f"floor.{change}.frozen_over_native", drifts["frozen"] / drifts["native"], n=len(seeds))
        nees = [found[Cell(change, s, "commands", "adapted")]["nees_over_3"] for s in seeds]
        yield mean_row(f"floor.{change}.nees_over_3", nees)
        for s in seeds:
            ate = {way: found[Cell(change, s, "commands", way)]["ate_mm"] for way in WAYS}
            worse += ate["adapted"] > _WORSE * min(ate["frozen"], ate["none"])
    yield Row("never_worse", worse / (len(changes) * len(seeds)), n=len(changes) * len(seeds))


def _worth(found: dict[Cell, dict[str, Any]], changes: Sequence[str], seeds: Sequence[int]) -> Iterator[Row]:
    for sensors in SENSORS:
        for change in changes:
            for way in (w for w in WAYS if w != "native"):
                ate = [found[Cell(change, s, sensors, way)]["ate_mm"] for s in seeds]
                yield mean_row(f"worth.{sensors}.{change}.{way}.ate_mm", ate, "mm")


def _drives(found: dict[Cell, dict[str, Any]], drives: Sequence[str], seeds: Sequence[int]) -> Iterator[Row]:
    for drive in drives:
        for way in _DRIVE_WAYS:
            runs = [found[Cell(drive, s, "commands", way)] for s in seeds]
            yield mean_row(f"drive.{drive}.{way}.ate_mm", [run["ate_mm"] for run in runs], "mm")
            yield mean_row(f"drive.{drive}.{way}.nees_over_3", [run["nees_over_3"] for run in runs])
            per_seed = [100.0 * run["ends"][0] / run["ends"][1] for run in runs]
            yield mean_row(f"drive.{drive}.{way}.drift30_percent", per_seed, "%")


# --- One run ----------------------------------------------------------------------------------------------------------


def _run_group(cells: Sequence[Cell]) -> dict[Cell, dict[str, Any]]:
    return {
        cell: dict(kept(f"{cell.name}_{_made(cell.change, True)[1]}", lambda cell=cell: run_cell(cell)))
        for cell in cells
    }  # type: ignore[misc]


def run_cell(cell: Cell) -> dict[str, Any]:
    """Errors of one run online."""
    recorded = drives.load_made(_made(cell.change, True)[0], cell.seed, f"learning/{cell.change}")
    recorded = replace(recorded, events=tuple(e for e in recorded.events if not isinstance(e, SENSORS[cell.sensors])))
    settings: dict[str, Any] = {
        "motion": {
            "model": model(cell.change if cell.way == "native" or cell.change in DRIVES else "base"),
            "use": True,
        }
    }
    settings["motion"] |= WAYS[cell.way]
    if cell.sensors == "commands":
        settings |= {"wheels": {"source": "command"}}
    dark = [(t, t + _DARK_S) for t in np.arange(_FIXES_S, _DURATION_S - 1.0, 2.0 * _DARK_S).tolist()]
    chain = [failure({"kind": "dropout", "sensor": "camera", "when": {"intervals": dark}})]
    began = time.process_time()
    made = replayed(recorded, changed(recorded.config, settings), chain, cell.seed, batch=False)
    if made is None:
        raise FglocError(f"{cell.name}: no pose was ever found")
    found = errors(made.online, recorded.config)
    ends = _ends(made.online, recorded, dark)
    return {
        "ate_mm": found.ate_mm,
        "nees_over_3": found.nees_over_3,
        "ends": ends,
        "step_ms": 1e3 * (time.process_time() - began) / len(made.steps),
    }


def _ends(result: Any, recorded: Recorded, dark: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Sum of the distances by which the dark stretches end elsewhere than the truth, each begun at it, and of their ways [m]."""
    trajectory = result.trajectory
    seconds = (trajectory.stamps_ns - recorded.start_ns) * 1e-9
    true_s, truth = recorded.truth[:, 0], recorded.truth[:, 1:]
    missed, way = 0.0, 0.0
    for start, end in dark:
        ours = [trajectory.poses[np.searchsorted(seconds, t)] for t in (start, end - 0.3)]
        at = [float(seconds[np.searchsorted(seconds, t)]) for t in (start, end - 0.3)]
        theirs = [_at(true_s, truth, t) for t in at]
        missed += float(np.hypot(*se2.between(se2.between(*ours), se2.between(*theirs))[:2]))
        inside = (true_s >= at[0]) & (true_s <= at[1])
        way += float(np.hypot(*np.diff(truth[inside, :2], axis=0).T).sum())
    return missed, way


def _at(times: FloatArray, poses: FloatArray, t: float) -> FloatArray:
    yaw = np.unwrap(poses[:, 2])
    return np.array([np.interp(t, times, column) for column in (poses[:, 0], poses[:, 1], yaw)])


# --- Robots and models ------------------------------------------------------------------------------------------------


def _made(change: str, test: bool) -> tuple[Scenario, str]:
    """Scenario of the changed robot, as installed and driven otherwise for tests; and a hash of it."""
    made = scenario("calibrated", "test" if test else "train")
    robot = load_suite(BUNDLED).find(change).robot if change in DRIVES else made.robot
    floor = made.world.floor
    if change in ("load", "both"):
        robot = robot.model_copy(update={"payload": Payload(mass_kg=3.0, shift_at_s=1.0)})
    if change == "wheel":
        robot = robot.model_copy(update={"radius_scale": (1.0, 0.96)})
    if change in ("floor", "both"):
        floor = floor.model_copy(update={"mu": 0.2 if change == "floor" else 0.3})
    world = made.world.model_copy(update={"floor": floor})
    installation = Installation.as_installed() if test else None
    update = {"name": change, "robot": robot, "world": world, "duration_s": _DURATION_S, "installation": installation}
    made = made.model_copy(update=update)
    return made, hashlib.sha256(describe(made, 0, test).encode() + _sources()).hexdigest()[:12]


@cache
def _sources() -> bytes:
    """Code on which models and cells depend, beside that of `benchmarks.replays.kept`."""
    paths = [Path(__file__), Path(drives.__file__), *sorted(Path(fgloc_training.__file__).parent.glob("*.py"))]
    return b"".join(path.read_bytes() for path in paths)


@cache
def model(change: str) -> Path:
    """File of the model of a robot of this change (``base``: of none), trained first if it is not there."""
    made, key = _made(change, False)
    folder = cache_folder() / "learning"
    path = folder / f"{change}_{key}.safetensors"
    if path.is_file():
        return path
    control = {
        part: next(
            run.control
            for entry in load_suite(BUNDLED).entries
            if entry.scenario.name == "calibrated"
            for run in entry.runs
            if run.split == part
        )
        for part in _TRAIN_SEEDS
    }
    jobs = [
        Job(made.model_copy(update={"control": control[part]}), seed, f"{change}_{key}_{part}_{seed}", part)
        for part, seeds in _TRAIN_SEEDS.items()
        for seed in seeds
    ]
    record_suite(jobs, folder, camera=False, workers=os.cpu_count() or 1)
    network = NetworkConfig(inputs=("commands", "sideways") if change == "mecanum" else ("commands",))
    runs = {j.folder: load_run(folder / j.folder / "bag", j.folder, network.dt_s, _DATA.history_s, _DATA) for j in jobs}
    parts = {part: tuple(j.folder for j in jobs if j.split == part) for part in _TRAIN_SEEDS}
    split = Parts(train=parts["train"], validation=parts["validation"])
    given = {"robot": f"simulated, {change}", "recordings": {name: Path(name) for name in runs}, "split": split}
    torch.set_num_threads(1)
    train(
        TrainConfig(**given, data=_DATA, network=network, optimization=OptimizationConfig()),
        split,
        runs,
        path,
        "benchmarks.learning",
    )  # type: ignore[arg-type]
    return path


# --- Robots of `benchmarks.installed` in the dark --------------------------------------------------------------------


def _installed(quick: bool, split: Split, jobs: int) -> Iterator[Row]:
    seeds = SEEDS[split][: 1 if quick else None]
    kinds = ("wheels_only", "foreign")
    cells = dict(parallel(_installed_cell, [(kind, split, seed) for kind in kinds for seed in seeds], jobs))
    for kind, name in zip(kinds, ("wheels_only.dark60", "foreign.dark20"), strict=True):
        found = [cells[kind, split, seed] for seed in seeds]
        for mode in ("batch", "online"):
            yield mean_row(f"{name}.{mode}.ate_mm", [cell[mode][0] for cell in found], "mm")
            yield mean_row(f"{name}.{mode}.nees_over_3", [cell[mode][1] for cell in found])
        yield Row(f"{name}.sound_named", sum(cell["named"] > 0 for cell in found) / len(found), n=len(found))


def _installed_cell(key: tuple[str, Split, int]) -> tuple[tuple[str, Split, int], dict[str, Any]]:
    kind, split, seed = key
    return key, dict(kept(f"learning_{kind}_{split}_{seed}", lambda: run_installed(kind, split, seed)))


def run_installed(kind: str, split: Split, seed: int) -> dict[str, Any]:
    """Error and NEES/3 in batch and online, and how often a sound marker was named, of a robot without a gyro.

    Args:
        kind: ``wheels_only`` (slippery patches, a minute dark) or ``foreign`` (a grippy floor and a model of another
            robot, 20 s dark before the sightings could show that it is one).
        split: of the seed.
        seed: of `benchmarks.installed`.
    """
    recorded = load(Take("installed", "patches" if kind == "wheels_only" else "unequal_radii", split, seed))
    recorded = replace(recorded, events=tuple(e for e in recorded.events if not isinstance(e, ImuEvent)))
    motion = {"use": False} if kind == "wheels_only" else {"model": MODELS / "all.safetensors", "use": True}
    config = changed(recorded.config, {"motion": motion})
    dark = {"kind": "dropout", "sensor": "camera", "when": {"intervals": [_FOREIGN_DARK_S]}}
    chain = failures("dark60", recorded) if kind == "wheels_only" else [failure(dark)]
    made = replayed(recorded, config, chain, seed, batch=True)
    if made is None or made.batch is None:
        raise FglocError(f"{kind}, seed {seed}: no pose was ever found")
    unknown = made.unknown_ns(recorded.start_ns)
    scores = {mode: errors(getattr(made, mode), config, unknown) for mode in ("batch", "online")}
    named = sum(d.reason in ("quarantined", "landmark_moved") for d in made.online.decisions)
    return {mode: (found.ate_mm, found.nees_over_3) for mode, found in scores.items()} | {"named": named}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    known, rest = parser.parse_known_args()
    main(lambda quick: measure(quick, known.split, known.jobs), __doc__ or "", rest)
