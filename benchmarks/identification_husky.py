"""A model of DRIVE's skid-steered Husky: rows of `benchmarks.identification`.

Windows of 2 s, three to a calibration step of the recording; a step's windows stay together. The first 120 steps train,
the next 30 stop the training early and calibrate, the last 51 test. The model predicts 1.5 s of each test window, from
0.3 s after its start, from commands and wheel speeds (``husky``), or from the gyro as well (``husky_gyro``); the errors
are means over the windows. One window in twenty is left out, as its ICP falls silent before. ``husky.wheels_...`` is
wheel odometry with the nominal track; the gyro's bias is taken as 0, as a window holds no rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from benchmarks.common import Row
from fgloc.config import load_config
from fgloc.recording.reader import open_recording
from fgloc.recording.storage import find_beside
from fgloc.recording.truth import base_pose
from fgloc.sensors.learned.card import Input, Split
from fgloc.sensors.learned.sensor import load_model
from fgloc.types import Event, TruthEvent
from fgloc_datasets import drive
from fgloc_training.config import CalibrationConfig, DataConfig, NetworkConfig, OptimizationConfig, TrainConfig
from fgloc_training.data import Run, SensorRecord, make_run
from fgloc_training.evaluate import evaluate
from fgloc_training.rollouts import Rollout, roll_model, roll_wheels
from fgloc_training.train import train

_STEPS = {"train": range(120), "validation": range(120, 150), "test": range(150, 201)}  # of the calibration
_HORIZON_S = 1.5
_DT_S = 0.1
_APART_NS = 10_000_000_000  # of a silence between two windows
_HISTORY_S = 0.3  # of a window, before the prediction starts
_DATA = DataConfig(smoothing_s=0.3, max_truth_gap_s=0.4, margin_s=0.0, shortest_s=_HORIZON_S)
_CALIBRATION = CalibrationConfig(horizons_s=(1.0, _HORIZON_S), short_s=(0.1, 0.5), window_s=_HORIZON_S)


def measure(source: Path, seeds: range, optimization: OptimizationConfig, scratch: Path) -> Iterator[Row]:
    """Train once per kind of input and seed, and yield the rows.

    Args:
        source: the CSV file of the windows.
        seeds: of the training.
        optimization: of the training, but for the seed and the lengths that the windows allow.
        scratch: folder for bags and models.
    """
    parts = {part: _windows(source, steps, part, scratch) for part, steps in _STEPS.items()}
    runs = {run.name: run for part in parts.values() for run in part}
    names = {part: tuple(run.name for run in found) for part, found in parts.items()}
    split = Split(train=names["train"], validation=names["validation"], test=names["test"])
    wheels = _ends([roll_wheels(run, _DT_S) for run in parts["test"]])
    yield Row("husky.wheels_end_m", wheels[0], unit="m")
    yield Row("husky.wheels_end_rad", wheels[1], unit="rad")
    inputs: dict[str, tuple[Input, ...]] = {
        "husky": ("commands", "wheels"),
        "husky_gyro": ("commands", "gyro", "wheels"),
    }
    short = {"horizon_s": _HORIZON_S, "variance_horizon_s": _HORIZON_S, "validation_s": (_HORIZON_S,)}
    for name, reads in inputs.items():
        per_seed = []
        for seed in seeds:
            config = TrainConfig(
                robot="benchmark",
                recordings={run: Path(run) for run in runs},
                split=split,
                data=_DATA,
                network=NetworkConfig(inputs=reads, dt_s=_DT_S, edges_s=(0.0, 0.1, 0.2, 0.3, 0.4)),
                optimization=optimization.model_copy(update={"seed": seed, **short}),
                calibration=_CALIBRATION,
            )
            train(config, split, runs, scratch / "model.safetensors", "benchmarks.identification_husky")
            model = load_model(scratch / "model.safetensors")
            per_seed.append([roll_model(model, run, _DT_S) for run in parts["test"]])
        yield from _rows(name, per_seed)


def _windows(source: Path, steps: range, part: str, scratch: Path) -> list[Run]:
    """The windows of some steps, each a run of its own."""
    bag = drive.convert(source, scratch / part, calibration=steps)
    robot_yaml = find_beside(bag, "robot.yaml")
    if robot_yaml is None:
        raise FileNotFoundError(f"the converter wrote no robot.yaml beside {bag}")
    settings = load_config(robot_yaml)
    with open_recording(bag, settings.recording) as recording:
        events = sorted(recording.events(), key=lambda e: e.stamp_ns)
    runs = []
    for k, window in enumerate(_apart(events)):
        truth = [e for e in window if isinstance(e, TruthEvent)]
        if truth[-1].stamp_ns < window[0].stamp_ns + round((_HISTORY_S + _HORIZON_S) * 1e9):
            continue
        stamps, poses = np.array([e.stamp_ns for e in truth]), np.array([base_pose(e, settings.truth) for e in truth])
        runs.append(make_run(f"{part}_{k}", SensorRecord(window, settings), stamps, poses, _DT_S, _HISTORY_S, _DATA))
    return runs


def _apart(events: list[Event]) -> list[list[Event]]:
    """Events in order of stamp, cut where nothing was heard for long."""
    stamps = np.array([e.stamp_ns for e in events])
    number = np.concatenate([[0], np.cumsum(np.diff(stamps) > _APART_NS)])
    return [[e for _, e in group] for _, group in groupby(zip(number, events, strict=True), key=lambda pair: pair[0])]


def _rows(name: str, per_seed: list[list[Rollout]]) -> Iterator[Row]:
    ends = np.array([_ends(rollouts) for rollouts in per_seed])
    for unit, column in zip(("m", "rad"), ends.T, strict=True):
        yield Row(f"{name}.end_{unit}", float(column.mean()), float(column.std()), len(column), unit)
    for label, horizon in (("cov", _DT_S), ("cov1500ms_", _HORIZON_S)):
        shares = np.array([evaluate(rollouts, horizon).coverage for rollouts in per_seed], dtype=float)
        for i, column in enumerate(shares.T, 1):
            yield Row(f"{name}.{label}{i}", float(column.mean()), float(column.std()), len(column))


def _ends(rollouts: list[Rollout]) -> tuple[float, float]:
    """Mean distance [m] and mean angle [rad] at the ends of the windows."""
    ends = np.concatenate([rollout.errors(_HORIZON_S) for rollout in rollouts])
    return float(np.hypot(ends[:, 0], ends[:, 1]).mean()), float(np.abs(ends[:, 2]).mean())
