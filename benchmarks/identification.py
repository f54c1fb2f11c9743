"""Motion models trained and judged: ``python -m benchmarks.identification``.

Every model is trained here, by the default configuration, once per seed; values are means over the seeds, spreads their
standard deviation. Drift is the summed end error over the summed distance, windows start every second and are pooled
over the robots. Coverage at one step is that of a step of 0.2 s.

MRCLAM 6: ``loro`` leaves one robot out of training, early stopping and calibration, and tests on it. ``seen`` trains on
the first 60 % of each robot's run, stops and calibrates on the next 10 %, tests on the last 30 %. Where the truth
slides sideways faster than 0.012 m/s, as no wheel does, Vicon jumped: such samples are cut. ``finetune`` adapts the
models of ``loro`` to the first minute of the robot left out, and tests both on the rest. ``commands`` integrates the
commands.

``husky``: DRIVE's skid-steered robot, windows of 2 s, three to a calibration step of the recording; a step's windows
stay together. The first 120 steps train, the next 30 stop the training early and calibrate, the last 51 test. The model
predicts 1.5 s of each test window, from 0.3 s after its start, from commands and wheel speeds (``husky``), or from the
gyro as well (``husky_gyro``); the errors are means over the windows. One window in twenty is left out, as its ICP falls
silent before. ``husky.wheels_...`` is wheel odometry with the nominal track; the gyro's bias is taken as 0, as a window
holds no rest.

``sim``: models of the simulated robot, on runs recorded here. Ratios are the mean position error of the model over 5 s
windows divided by that of the wheel odometry (the robot's ``robot.yaml``), on test runs whose seeds and control
functions no training has seen. ``mu02`` and ``mu01``: a floor of friction 0.2 and 0.1, a model of commands and gyro.
``radii``: unequal wheels, commands and wheel speed. ``patches``: slippery patches, commands, gyro and effort;
``patches_plain`` the same of commands alone. The gyro's bias is what the localizer's filter knew 10 s before, of rests
and of fixes by the truth.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
import torch

from benchmarks.common import DATA, Row, main, mean_row, not_run
from benchmarks.recordings import MRCLAM
from fgloc.config import load_config
from fgloc.recording.reader import open_recording
from fgloc.recording.storage import find_beside
from fgloc.recording.truth import base_pose
from fgloc.sensors.learned.card import Input, Kinematics, Split
from fgloc.sensors.learned.sensor import load_model, model_of, read_model
from fgloc.types import ControlEvent, Event, TruthEvent
from fgloc_datasets import drive, mrclam
from fgloc_datasets.sim.record import BUNDLED, Job, jobs, load_suite, record_suite
from fgloc_training.calibrate import adapted
from fgloc_training.config import (
    AdaptationConfig,
    CalibrationConfig,
    DataConfig,
    NetworkConfig,
    OptimizationConfig,
    TrainConfig,
)
from fgloc_training.data import Run, SensorRecord, cut, load_run, make_run
from fgloc_training.evaluate import STEP_S, evaluate
from fgloc_training.rollouts import Rollout, roll_kinematics, roll_model, roll_sources
from fgloc_training.train import leave_one_out, train

_HORIZONS_S = (10.0, 30.0, 60.0)
_MINUTE_S = 60.0
_PARTS = (0.6, 0.7)  # of a run: what trains ends, what validates ends
_CUT = DataConfig(max_sideways_mps=0.012)  # Vicon's axes are off by 1.2° at most and its point by 5 mm: 0.005 m/s
_QUICK = OptimizationConfig(iterations=60, validate_every=30, variance_iterations=20)
_COVERAGE = [f"cov{when}{i}" for when in ("", "10s_") for i in (1, 2, 3)]

_WINDOWS = {"train": range(120), "validation": range(120, 150), "test": range(150, 201)}  # calibration steps
_HUSKY_S = 1.5
_HUSKY_DT_S = 0.1
_APART_NS = 10_000_000_000  # of a silence between two windows
_HISTORY_S = 0.3  # of a window, before the prediction starts
_HUSKY_DATA = DataConfig(smoothing_s=0.3, max_truth_gap_s=0.4, margin_s=0.0, shortest_s=_HUSKY_S)
_HUSKY_CALIBRATION = CalibrationConfig(horizons_s=(1.0, _HUSKY_S), short_s=(0.1, 0.5), window_s=_HUSKY_S)

_SIM_SEEDS = {"train": (11, 12, 13, 14), "validation": (21, 22, 23), "test": (31, 32, 33, 34)}
_SIM_S = 5.0
_SIM_DATA = DataConfig(smoothing_s=0.1)  # the truth is exact
_SIM_QUICK_S = 40.0
_SIM: dict[str, tuple[str, tuple[Input, ...]]] = {  # scenario and inputs
    "mu02": ("slick", ("commands", "gyro")),
    "mu01": ("slippery", ("commands", "gyro")),
    "radii": ("unequal_radii", ("commands", "wheels")),
    "patches": ("patches", ("commands", "gyro", "effort")),
    "patches_plain": ("patches", ("commands",)),
}


def measure(quick: bool) -> Iterator[Row]:
    """Yield every row; a quick run has one seed and few iterations."""
    torch.set_num_threads(1)
    seeds = range(1) if quick else range(3)
    optimization = _QUICK if quick else OptimizationConfig()
    with tempfile.TemporaryDirectory() as scratch:
        yield from _mrclam(Path(scratch), seeds, optimization)
        yield from _husky(Path(scratch), seeds, optimization)
        yield from _simulated(quick, seeds, optimization, Path(scratch))


def _trained(
    path: Path, split: Split, runs: dict[str, Run], optimization: OptimizationConfig, **config: object
) -> Path:
    """File of a model of the split's training runs."""
    given = {"robot": "benchmark", "recordings": {name: Path(name) for name in runs}, "split": split}
    train(TrainConfig(**given, optimization=optimization, **config), split, runs, path, "benchmarks.identification")
    return path


def _tested(path: Path, split: Split, runs: dict[str, Run], dt_s: float = STEP_S) -> list[Rollout]:
    """The split's test runs, predicted by a model."""
    model = load_model(path)
    return [roll_model(model, runs[name], dt_s) for name in split.test]


def _coverages(prefix: str, per_seed: list[list[Rollout]], horizons_s: dict[str, float]) -> Iterator[Row]:
    """Shares of the errors within one, two and three sigmas, by label of the horizon."""
    for label, horizon_s in horizons_s.items():
        shares = np.array([evaluate(rollouts, horizon_s).coverage for rollouts in per_seed], dtype=float)
        for i, column in enumerate(shares.T, 1):
            yield mean_row(f"{prefix}.{label}{i}", column.tolist())


def _ends(rollouts: list[Rollout], horizon_s: float) -> tuple[float, float]:
    """Mean distance [m] and mean angle [rad] between predicted and true ends of the windows."""
    ends = np.concatenate([rollout.errors(horizon_s) for rollout in rollouts])
    return float(np.hypot(ends[:, 0], ends[:, 1]).mean()), float(np.abs(ends[:, 2]).mean())


# --- MRCLAM -----------------------------------------------------------------------------------------------------------


def _mrclam(scratch: Path, seeds: range, optimization: OptimizationConfig) -> Iterator[Row]:
    if not MRCLAM.is_dir():
        names = [f"drift_{h:.0f}s" for h in _HORIZONS_S] + _COVERAGE
        ids = [f"{on}.{name}" for on in ("loro", "seen") for name in names]
        yield from not_run([*ids, "seen.yaw_10s_deg", "train.minutes"], f"no {MRCLAM}; set FGLOC_REAL_DATA")
        return
    recorded = {f"robot{k}": mrclam.read(MRCLAM, k) for k in mrclam.ROBOTS}
    runs, whole = ({name: _run(r, name, data) for name, r in recorded.items()} for data in (_CUT, DataConfig()))
    commands = [roll_kinematics(Kinematics(), r, STEP_S) for r in whole.values()]
    for horizon in _HORIZONS_S:
        yield Row(f"commands.drift_{horizon:.0f}s", evaluate(commands, horizon).drift_percent, unit="%")
    minutes: list[float] = []

    def trained(seed: int, split: Split, of: dict[str, Run]) -> Path:
        began = time.perf_counter()
        path = scratch / f"{split.test[0]}.{seed}.safetensors"
        _trained(path, split, of, optimization.model_copy(update={"seed": seed}))
        minutes.append((time.perf_counter() - began) / 60.0)
        return path

    parts, split = _parts(runs)
    seen = [_tested(trained(seed, split, parts), split, parts) for seed in seeds]
    yield from _figures("seen", seen)
    yield mean_row("seen.yaw_10s_deg", [evaluate(r, 10.0).yaw_end_deg for r in seen], "deg")
    left_out = [[(trained(seed, split, runs), split) for split in leave_one_out(list(runs))] for seed in seeds]
    yield from _figures("loro", [[r for path, s in models for r in _tested(path, s, runs)] for models in left_out])
    yield mean_row("train.minutes", minutes, "min")
    yield from _finetuned(left_out, runs)


def _finetuned(left_out: list[list[tuple[Path, Split]]], runs: dict[str, Run]) -> Iterator[Row]:
    """Models of other robots on all but the first minute of a robot, without and with adaptation to that minute."""
    before: list[list[Rollout]] = []
    after: list[list[Rollout]] = []
    for models in left_out:
        before.append([])
        after.append([])
        for path, split in models:
            run = runs[split.test[0]]
            n = round(_MINUTE_S / run.dt_s)
            minute, rest = cut(run, "minute", 0, n), cut(run, "rest", n, len(run.poses))
            tensors, card = read_model(path)
            fitted = adapted(tensors, card, [minute], AdaptationConfig())
            before[-1].append(roll_model(load_model(path), rest, STEP_S))
            after[-1].append(roll_model(model_of(tensors, fitted), rest, STEP_S))
    yield from _drifts("finetune.without_", before)
    yield from _drifts("finetune.", after)


def _run(recorded: mrclam.Run, name: str, data: DataConfig) -> Run:
    pairs = zip(recorded.commands_ns.tolist(), recorded.commands.tolist(), strict=True)
    commands = [ControlEvent(stamp, stamp, "/cmd_vel", v, omega) for stamp, (v, omega) in pairs]
    stamps, poses = recorded.truth_ns, recorded.truth
    return make_run(name, commands, stamps, poses, NetworkConfig().dt_s, data.history_s, data)


def _parts(runs: dict[str, Run]) -> tuple[dict[str, Run], Split]:
    """Beginning, middle and end of each run, and the split that they make."""
    parts: dict[str, Run] = {}
    roles = ("train", "validation", "test")
    for name, whole in runs.items():
        n = len(whole.poses)
        limits = [0, *(round(share * n) for share in _PARTS), n]
        for role, first, last in zip(roles, limits, limits[1:], strict=False):
            parts[f"{name}.{role}"] = cut(whole, f"{name}.{role}", first, last)
    train_names, validation, test = (tuple(p for p in parts if p.endswith(role)) for role in roles)
    return parts, Split(train=train_names, validation=validation, test=test)


def _figures(on: str, per_seed: list[list[Rollout]]) -> Iterator[Row]:
    """Drifts and coverage, the windows of all robots pooled."""
    yield from _drifts(f"{on}.", per_seed)
    yield from _coverages(on, per_seed, {"cov": STEP_S, "cov10s_": 10.0})


def _drifts(prefix: str, per_seed: list[list[Rollout]]) -> Iterator[Row]:
    for horizon in _HORIZONS_S:
        yield mean_row(f"{prefix}drift_{horizon:.0f}s", [evaluate(r, horizon).drift_percent for r in per_seed], "%")


# --- Husky ------------------------------------------------------------------------------------------------------------


def _husky(scratch: Path, seeds: range, optimization: OptimizationConfig) -> Iterator[Row]:
    sources = sorted((DATA / "drive_husky").glob("*.csv"))
    if not sources:
        yield from not_run(["husky.end_m", "husky.end_rad"], f"no {DATA / 'drive_husky'}; set FGLOC_REAL_DATA")
        return
    parts = {part: _windows(sources[0], steps, part, scratch) for part, steps in _WINDOWS.items()}
    runs = {run.name: run for part in parts.values() for run in part}
    names = {part: tuple(run.name for run in found) for part, found in parts.items()}
    split = Split(train=names["train"], validation=names["validation"], test=names["test"])
    wheels = _ends([roll_sources(run, _HUSKY_DT_S) for run in parts["test"]], _HUSKY_S)
    yield Row("husky.wheels_end_m", wheels[0], unit="m")
    yield Row("husky.wheels_end_rad", wheels[1], unit="rad")
    inputs: dict[str, tuple[Input, ...]] = {
        "husky": ("commands", "wheels"),
        "husky_gyro": ("commands", "gyro", "wheels"),
    }
    short = {"horizon_s": _HUSKY_S, "variance_horizon_s": _HUSKY_S, "validation_s": (_HUSKY_S,)}
    for name, reads in inputs.items():
        per_seed = []
        for seed in seeds:
            path = _trained(
                scratch / "model.safetensors",
                split,
                runs,
                optimization.model_copy(update={"seed": seed, **short}),
                data=_HUSKY_DATA,
                network=NetworkConfig(inputs=reads, dt_s=_HUSKY_DT_S, edges_s=(0.0, 0.1, 0.2, 0.3, 0.4)),
                calibration=_HUSKY_CALIBRATION,
            )
            per_seed.append(_tested(path, split, runs, _HUSKY_DT_S))
        ends = np.array([_ends(rollouts, _HUSKY_S) for rollouts in per_seed])
        for unit, column in zip(("m", "rad"), ends.T, strict=True):
            yield mean_row(f"{name}.end_{unit}", column.tolist(), unit)
        yield from _coverages(name, per_seed, {"cov": _HUSKY_DT_S, "cov1500ms_": _HUSKY_S})


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
        if truth[-1].stamp_ns < window[0].stamp_ns + round((_HISTORY_S + _HUSKY_S) * 1e9):
            continue
        stamps, poses = np.array([e.stamp_ns for e in truth]), np.array([base_pose(e, settings.truth) for e in truth])
        runs.append(
            make_run(f"{part}_{k}", SensorRecord(window, settings), stamps, poses, _HUSKY_DT_S, _HISTORY_S, _HUSKY_DATA)
        )
    return runs


def _apart(events: list[Event]) -> list[list[Event]]:
    """Events in order of stamp, cut where nothing was heard for long."""
    stamps = np.array([e.stamp_ns for e in events])
    number = np.concatenate([[0], np.cumsum(np.diff(stamps) > _APART_NS)])
    return [[e for _, e in group] for _, group in groupby(zip(number, events, strict=True), key=lambda pair: pair[0])]


# --- Simulator --------------------------------------------------------------------------------------------------------


def _simulated(quick: bool, seeds: range, optimization: OptimizationConfig, scratch: Path) -> Iterator[Row]:
    """Record, train once per case and seed, and yield the rows; quick: one short run for each part of the split."""
    names = {scenario for scenario, _ in _SIM.values()}
    todo = [job for job in _jobs(quick) if job.scenario.name in names]
    record_suite(todo, scratch, camera=False, workers=1)
    dt_s = NetworkConfig().dt_s
    for scenario in sorted(names):
        mine = [job for job in todo if job.scenario.name == scenario]
        runs = {
            job.folder: load_run(scratch / job.folder / "bag", job.folder, dt_s, _SIM_DATA.history_s, _SIM_DATA)
            for job in mine
        }
        parts = {part: tuple(job.folder for job in mine if job.split == part) for part in _SIM_SEEDS}
        split = Split(train=parts["train"], validation=parts["validation"], test=parts["test"])
        wheels, _ = _ends([roll_sources(runs[name], STEP_S) for name in split.test], _SIM_S)
        for name, (of, inputs) in _SIM.items():
            if of != scenario:
                continue
            per_seed = []
            for seed in seeds:
                path = _trained(
                    scratch / "model.safetensors",
                    split,
                    runs,
                    optimization.model_copy(update={"seed": seed}),
                    data=_SIM_DATA,
                    network=NetworkConfig(inputs=inputs),
                )
                per_seed.append(_tested(path, split, runs))
            yield mean_row(f"sim.{name}_ratio", [_ends(rollouts, _SIM_S)[0] / wheels for rollouts in per_seed])
            yield from _coverages(f"sim.{name}", per_seed, {"cov": STEP_S, "cov10s_": 10.0})


def _jobs(quick: bool) -> list[Job]:
    """The bundled suite's runs of robots as they are written, and more of their kind by other seeds."""
    out: dict[str, Job] = {}
    for job in jobs(load_suite(BUNDLED).perfect(), _SIM_QUICK_S if quick else None):
        for seed in _SIM_SEEDS[job.split][: 1 if quick else None]:
            folder = f"{job.scenario.name}/{job.split}_{seed}"
            out[folder] = replace(job, seed=seed, folder=folder)
    return list(out.values())


if __name__ == "__main__":
    main(measure, __doc__ or "")
