"""Models of the simulated robot, trained here on runs recorded here: rows of `benchmarks.identification`.

Ratios are the mean position error of the model over 5 s windows divided by that of the wheel odometry (the robot's
``robot.yaml``), on test runs whose seeds and control functions no training has seen. ``mu02`` and ``mu01``: a floor of
friction 0.2 and 0.1, a model of commands and gyro. ``radii``: unequal wheels, commands and wheel speed. ``patches``:
slippery patches, commands, gyro and effort; ``patches_plain`` the same of commands alone. Coverage at one step is that
of a step of 0.2 s. The gyro's bias is what the localizer's filter knew 10 s before, of rests and of fixes by the truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common import Row
from fgloc.sensors.learned.card import Input, Split
from fgloc.sensors.learned.sensor import load_model
from fgloc_datasets.sim.record import BUNDLED, Job, jobs, load_suite, record_suite
from fgloc_training.config import DataConfig, NetworkConfig, OptimizationConfig, TrainConfig
from fgloc_training.data import Run, load_run
from fgloc_training.evaluate import STEP_S, evaluate
from fgloc_training.rollouts import Rollout, roll_model, roll_wheels
from fgloc_training.train import train

_SEEDS = {"train": (11, 12, 13, 14), "validation": (21, 22, 23), "test": (31, 32, 33, 34)}
_WINDOW_S = 5.0
_DATA = DataConfig(smoothing_s=0.1)  # the truth is exact
_QUICK_S = 40.0


@dataclass(frozen=True, slots=True)
class _Record:
    name: str
    scenario: str
    inputs: tuple[Input, ...]


_CASES = (
    _Record("mu02", "slick", ("commands", "gyro")),
    _Record("mu01", "slippery", ("commands", "gyro")),
    _Record("radii", "unequal_radii", ("commands", "wheels")),
    _Record("patches", "patches", ("commands", "gyro", "effort")),
    _Record("patches_plain", "patches", ("commands",)),
)


def measure(quick: bool, seeds: range, optimization: OptimizationConfig, scratch: Path) -> Iterator[Row]:
    """Record, train once per case and seed, and yield the rows.

    Args:
        quick: one short run for each part of the split.
        seeds: of the training.
        optimization: of the training, but for the seed.
        scratch: folder for recordings and models.
    """
    names = {case.scenario for case in _CASES}
    todo = [job for job in _jobs(quick) if job.scenario.name in names]
    record_suite(todo, scratch, camera=False, workers=1)
    dt_s = NetworkConfig().dt_s
    for scenario in sorted(names):
        mine = [job for job in todo if job.scenario.name == scenario]
        runs = {
            job.folder: load_run(scratch / job.folder / "bag", job.folder, dt_s, _DATA.history_s, _DATA) for job in mine
        }
        parts = {part: tuple(job.folder for job in mine if job.split == part) for part in _SEEDS}
        split = Split(train=parts["train"], validation=parts["validation"], test=parts["test"])
        wheels = _error([roll_wheels(runs[name], STEP_S) for name in split.test])
        for case in _CASES:
            if case.scenario == scenario:
                per_seed = [_rollouts(case, s, split, runs, optimization, scratch) for s in seeds]
                yield from _rows(case.name, per_seed, wheels)


def _jobs(quick: bool) -> list[Job]:
    """The bundled suite's runs of robots as they are written, and more of their kind by other seeds."""
    out: dict[str, Job] = {}
    for job in jobs(load_suite(BUNDLED).perfect(), _QUICK_S if quick else None):
        for seed in _SEEDS[job.split][: 1 if quick else None]:
            folder = f"{job.scenario.name}/{job.split}_{seed}"
            out[folder] = replace(job, seed=seed, folder=folder)
    return list(out.values())


def _rollouts(
    case: _Record, seed: int, split: Split, runs: dict[str, Run], optimization: OptimizationConfig, scratch: Path
) -> list[Rollout]:
    """The test runs, predicted by a model of the training runs."""
    config = TrainConfig(
        robot="benchmark",
        recordings={name: Path(name) for name in runs},
        split=split,
        data=_DATA,
        network=NetworkConfig(inputs=case.inputs),
        optimization=optimization.model_copy(update={"seed": seed}),
    )
    path = scratch / "model.safetensors"
    train(config, split, runs, path, "benchmarks.identification_sim")
    return [roll_model(load_model(path), runs[name], STEP_S) for name in split.test]


def _rows(name: str, per_seed: list[list[Rollout]], wheels: float) -> Iterator[Row]:
    ratios = [_error(rollouts) / wheels for rollouts in per_seed]
    yield Row(f"sim.{name}_ratio", float(np.mean(ratios)), float(np.std(ratios)), len(ratios))
    for label, horizon in (("cov", STEP_S), ("cov10s_", 10.0)):
        shares = np.array([evaluate(rollouts, horizon).coverage for rollouts in per_seed], dtype=float)
        for i, column in enumerate(shares.T, 1):
            yield Row(f"sim.{name}.{label}{i}", float(np.mean(column)), float(np.std(column)), len(column))


def _error(rollouts: list[Rollout]) -> float:
    """Mean distance [m] between predicted and true ends of the windows."""
    return float(np.concatenate([np.hypot(*r.errors(_WINDOW_S)[:, :2].T) for r in rollouts]).mean())
