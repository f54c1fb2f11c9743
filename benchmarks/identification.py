"""Motion models trained and judged: ``python -m benchmarks.identification``.

Every model is trained here, by the default configuration, once per seed; values are means over the seeds, spreads their
standard deviation. Drift is the summed end error over the summed distance, windows start every second and are pooled
over the robots. ``loro`` leaves one robot out of training, early stopping and calibration, and tests on it. ``seen``
trains on the first 60 % of each robot's run, stops and calibrates on the next 10 %, tests on the last 30 %. Where the
truth slides sideways faster than 0.012 m/s, as no wheel does, Vicon jumped: such samples are cut everywhere, and
``*.uncut_...`` tests the same models with them. Coverage at one step is that of a step of 0.2 s. ``finetune`` adapts
the models of ``loro`` to the first minute of the robot left out, and tests both on the rest. ``selftruth`` trains as
``loro`` does, once on Vicon's poses and once on what ``fgloc smooth`` makes of the same runs without a learned model,
each robot's commands calibrated by its own sightings (``fgloc calibrate``); both are tested against Vicon. ``limits``,
``husky`` and ``sim``: see `benchmarks.identification_limits`, `_husky` and `_sim`.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from benchmarks import identification_husky, identification_limits, identification_sim
from benchmarks.common import Row, main, not_run
from fgloc.calibrate import calibrate
from fgloc.config import load_config
from fgloc.recording.storage import find_beside
from fgloc.runner import run
from fgloc.sensors.learned.card import Kinematics, Split
from fgloc.sensors.learned.network import MotionModel
from fgloc.sensors.learned.sensor import load_model, model_of, read_model, save_model
from fgloc.types import ControlEvent, FloatArray
from fgloc_datasets import mrclam
from fgloc_training.calibrate import adapted
from fgloc_training.config import AdaptationConfig, DataConfig, NetworkConfig, OptimizationConfig, TrainConfig
from fgloc_training.data import Run, cut, make_run
from fgloc_training.evaluate import STEP_S, Figures, evaluate
from fgloc_training.rollouts import Rollout, roll_kinematics, roll_model
from fgloc_training.train import leave_one_out, train

_ROOT = Path(__file__).resolve().parent.parent
_DATA = Path(os.environ.get("FGLOC_REAL_DATA", _ROOT.parent / "shared" / "data"))
_MODEL = _ROOT / "fgloc" / "sensors" / "learned" / "models" / "mrclam" / "all.safetensors"
_HORIZONS_S = (10.0, 30.0, 60.0)
_SHARES = (0.6, 0.7)  # of a run: what trains ends, what validates ends
_WHOLE = DataConfig()
_CUT = DataConfig(max_sideways_mps=0.012)  # Vicon's axes are off by 1.2° at most and its point by 5 mm: 0.005 m/s
_SMOOTHED = DataConfig(max_truth_gap_s=0.35)  # keyframes may be 0.2 s apart
_SMOOTHED_SETTINGS = OptimizationConfig(horizon_s=8.0, batch=48)
_SMOOTHED_ADAPTATION = AdaptationConfig(after_training_s=60.0)
_MINUTE_S = 60.0
_QUICK = OptimizationConfig(iterations=60, validate_every=30, variance_iterations=20)
_COVERAGE = [f"cov{when}{i}" for when in ("", "10s_") for i in (1, 2, 3)]
_STEPS = 4000


def measure(quick: bool) -> Iterator[Row]:
    """Yield every row; a quick run has one seed, few iterations and leaves out the smoothing."""
    torch.set_num_threads(1)
    seeds = range(1) if quick else range(3)
    optimization = _QUICK if quick else OptimizationConfig()
    with tempfile.TemporaryDirectory() as scratch:
        yield from _mrclam(Path(scratch), seeds, optimization, quick)
        yield _inference("infer.step_us", load_model(_MODEL), quick)
        yield _inference("infer.ensemble5_us", _ensemble(Path(scratch)), quick)
        yield from _husky(Path(scratch), seeds, optimization)
        yield from identification_sim.measure(quick, seeds, optimization, Path(scratch))


def _husky(scratch: Path, seeds: range, optimization: OptimizationConfig) -> Iterator[Row]:
    sources = sorted((_DATA / "drive_husky").glob("*.csv"))
    if sources:
        yield from identification_husky.measure(sources[0], seeds, optimization, scratch)
    else:
        yield from not_run(["husky.end_m", "husky.end_rad"], f"no {_DATA / 'drive_husky'}; set FGLOC_REAL_DATA")


def _mrclam(scratch: Path, seeds: range, optimization: OptimizationConfig, quick: bool) -> Iterator[Row]:
    source = _DATA / "mrclam6"
    if not source.is_dir():
        names = [f"drift_{h:.0f}s" for h in _HORIZONS_S] + _COVERAGE
        ids = [f"{on}.{name}" for on in ("loro", "seen") for name in names]
        ids += ["seen.yaw_10s_deg", "selftruth.drift_ratio", "train.minutes"]
        yield from not_run(ids, f"no {source}; set FGLOC_REAL_DATA")
        return
    recorded = {f"robot{k}": mrclam.read(source, k) for k in mrclam.ROBOTS}
    runs, uncut = ({name: _run(r, name, data) for name, r in recorded.items()} for data in (_CUT, _WHOLE))
    commands = [roll_kinematics(Kinematics(), r, STEP_S) for r in uncut.values()]
    for horizon in _HORIZONS_S:
        yield Row(f"commands.drift_{horizon:.0f}s", evaluate(commands, horizon).drift_percent, unit="%")
    yield from identification_limits.measure(recorded)
    trainer = _Trainer(scratch, optimization)
    parts, split = _parts(runs)
    whole, _ = _parts(uncut)
    models = [trainer.trained(seed, split, parts) for seed in seeds]
    seen = [_tested(path, split, parts) for path in models]
    yield from _figures("seen", seen)
    yield _row("seen.yaw_10s_deg", [evaluate(r, 10.0).yaw_end_deg for r in seen], "deg")
    yield from _drifts("seen.uncut_", [_tested(path, split, whole) for path in models])
    left_out = [trainer.leave_one_out(seed, runs) for seed in seeds]
    loro = [[r for path, s in models for r in _tested(path, s, runs)] for models in left_out]
    yield from _figures("loro", loro)
    yield from _drifts("loro.uncut_", [[r for p, s in models for r in _tested(p, s, uncut)] for models in left_out])
    yield _row("train.minutes", trainer.minutes, "min")
    yield from _finetuned(left_out, runs)
    if quick:
        yield from not_run(["selftruth.drift_ratio"], "left out of a quick run")
        return
    own = {name: _smoothed(source, k, runs[name], scratch) for k, name in enumerate(runs, 1)}
    (scratch / "own").mkdir()
    trainer = _Trainer(scratch / "own", _SMOOTHED_SETTINGS, _SMOOTHED_ADAPTATION)
    ratios = []
    for seed, vicon in zip(seeds, loro, strict=True):
        rollouts = [r for path, s in trainer.leave_one_out(seed, own) for r in _tested(path, s, runs)]
        ratios.append(evaluate(rollouts, 30.0).drift_percent / evaluate(vicon, 30.0).drift_percent)
    yield _row("selftruth.drift_ratio", ratios)


class _Trainer:
    """Trains into a scratch folder and keeps the time that each model took."""

    def __init__(
        self, scratch: Path, optimization: OptimizationConfig, adaptation: AdaptationConfig | None = None
    ) -> None:
        self.minutes: list[float] = []
        self._scratch = scratch
        self._optimization = optimization
        self._adaptation = AdaptationConfig() if adaptation is None else adaptation

    def leave_one_out(self, seed: int, runs: dict[str, Run]) -> list[tuple[Path, Split]]:
        """For each run a model that has not seen it."""
        return [(self.trained(seed, split, runs), split) for split in leave_one_out(list(runs))]

    def trained(self, seed: int, split: Split, runs: dict[str, Run]) -> Path:
        """The file of a model of the split's training runs."""
        config = TrainConfig(
            robot="benchmark",
            recordings={name: Path(name) for name in runs},
            split=split,
            optimization=self._optimization.model_copy(update={"seed": seed}),
            adaptation=self._adaptation,
        )
        path = self._scratch / f"{split.test[0]}.{seed}.safetensors"
        began = time.perf_counter()
        train(config, split, runs, path, "benchmarks.identification")
        self.minutes.append((time.perf_counter() - began) / 60.0)
        return path


def _tested(path: Path, split: Split, runs: dict[str, Run]) -> list[Rollout]:
    """The split's test runs, predicted by a model."""
    model = load_model(path)
    return [roll_model(model, runs[name], STEP_S) for name in split.test]


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
    return _sampled(name, commands, recorded.truth_ns, recorded.truth, data)


def _sampled(name: str, commands: list[ControlEvent], stamps: FloatArray, poses: FloatArray, data: DataConfig) -> Run:
    return make_run(name, commands, stamps, poses, NetworkConfig().dt_s, data.history_s, data)


def _smoothed(source: Path, robot: int, recorded: Run, scratch: Path) -> Run:
    """The run with our own batch smoothing in place of its truth, its commands calibrated on the run."""
    bag = mrclam.convert(source, robot, scratch / f"robot{robot}")
    robot_yaml = find_beside(bag, "robot.yaml")
    if robot_yaml is None:
        raise FileNotFoundError(f"the converter wrote no robot.yaml beside {bag}")
    map_path = find_beside(bag, "map.yaml")
    config, _ = calibrate([bag], map_path, load_config(robot_yaml))
    trajectory = run(bag, map_path, config, "batch").trajectory
    return _sampled(recorded.name, list(recorded.commands), trajectory.stamps_ns, trajectory.poses, _SMOOTHED)


def _parts(runs: dict[str, Run]) -> tuple[dict[str, Run], Split]:
    """Beginning, middle and end of each run, and the split that they make."""
    parts: dict[str, Run] = {}
    roles = ("train", "validation", "test")
    for name, whole in runs.items():
        n = len(whole.poses)
        limits = [0, *(round(share * n) for share in _SHARES), n]
        for role, first, last in zip(roles, limits, limits[1:], strict=False):
            parts[f"{name}.{role}"] = cut(whole, f"{name}.{role}", first, last)
    train_names, validation, test = (tuple(p for p in parts if p.endswith(role)) for role in roles)
    return parts, Split(train=train_names, validation=validation, test=test)


def _figures(on: str, per_seed: list[list[Rollout]]) -> Iterator[Row]:
    """Drifts and coverage, the windows of all robots pooled."""
    yield from _drifts(f"{on}.", per_seed)
    for label, horizon in (("cov", STEP_S), ("cov10s_", 10.0)):
        shares = np.array([_coverage(evaluate(r, horizon)) for r in per_seed])
        for i, column in enumerate(shares.T, 1):
            yield _row(f"{on}.{label}{i}", column.tolist())


def _drifts(prefix: str, per_seed: list[list[Rollout]]) -> Iterator[Row]:
    for horizon in _HORIZONS_S:
        yield _row(f"{prefix}drift_{horizon:.0f}s", [evaluate(r, horizon).drift_percent for r in per_seed], "%")


def _coverage(figures: Figures) -> tuple[float, float, float]:
    if figures.coverage is None:
        raise ValueError("the model gave no covariance")
    return figures.coverage


def _row(name: str, values: list[float], unit: str = "") -> Row:
    return Row(name, float(np.mean(values)), float(np.std(values)), len(values), unit)


def _ensemble(scratch: Path) -> MotionModel:
    """Five networks of the shipped model's size; their weights do not change how long they take."""
    tensors, card = read_model(_MODEL)
    path = scratch / "ensemble.safetensors"
    stacked = {name: np.stack([tensor] * 5) for name, tensor in tensors.items()}
    save_model(path, stacked, card.model_copy(update={"members": 5}))
    return load_model(path)


def _inference(name: str, model: MotionModel, quick: bool) -> Row:
    """Median time of one prediction over 0.2 s with commands at 20 Hz, as the localizer asks for them."""
    period = 50_000_000
    rng = np.random.default_rng(0)
    told = rng.uniform([0.0, -0.5], [0.1, 0.5], (4 * _STEPS + 100, 2)).tolist()
    events = [ControlEvent(i * period, i * period, "/cmd_vel", v, omega) for i, (v, omega) in enumerate(told)]

    def median_us() -> float:
        times = []
        for k in range(_STEPS // 10 if quick else _STEPS):
            i = 40 + 4 * k
            commands = tuple(events[i - 30 : i + 5])
            began = time.perf_counter_ns()
            model.predict(commands, i * period, (i + 4) * period, None)
            times.append(time.perf_counter_ns() - began)
        return float(np.median(times)) * 1e-3

    return _row(name, [median_us() for _ in range(3)], "us")


if __name__ == "__main__":
    main(measure, __doc__ or "")
