"""Free rollouts of a model over a run, by the very inference that the localizer uses, and their windows."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.config import Config
from fgloc.errors import ModelError
from fgloc.estimation.motion import MotionSources
from fgloc.graph.ground import predict
from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import NoiseBudget
from fgloc.sensors.equipment import MotionSensors
from fgloc.sensors.gyro import Gyro
from fgloc.sensors.learned.card import ErrorMemory, Kinematics, SignalReader
from fgloc.sensors.learned.network import MotionModel, calibrated
from fgloc.sensors.learned.sensor import LearnedMotion
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import FloatArray
from fgloc_training.data import Run

_FIX_RAD = 0.002  # of the truth's yaw
_SINCE_FIX_S = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Rollout:
    """Predicted motion of each step beside the truth."""

    run: Run
    step_s: float
    motions: FloatArray  # (n, 3)
    covs: FloatArray  # (n, 3, 3), zeros if the source gives none
    track: FloatArray  # (n + 1, 3) composed motions from the origin, yaw not wrapped
    truth: FloatArray  # (n + 1, 3)
    valid: NDArray[np.bool_]  # (n + 1,)
    memory: ErrorMemory | None = None  # of the errors from step to step

    def starts(self, horizon_s: float, every_s: float = 1.0) -> tuple[NDArray[np.int64], int]:
        """Indices at which windows of this length start with truth throughout, and their steps."""
        steps = round(horizon_s / self.step_s)
        broken = np.concatenate([[0], np.cumsum(~self.valid)])
        k = np.arange(0, len(self.motions) - steps + 1, max(1, round(every_s / self.step_s)))
        return k[broken[k + steps + 1] == broken[k]], steps

    def errors(self, horizon_s: float) -> FloatArray:
        """Right perturbations ``(m, 3)`` that take the predicted to the true end of each window."""
        k, n = self.starts(horizon_s)
        predicted, actual = (se2.between_array(poses[k], poses[k + n]) for poses in (self.track, self.truth))
        return logs(se2.between_array(predicted, actual))

    def end_covs(self, horizon_s: float) -> FloatArray:
        """Predicted covariances ``(m, 3, 3)`` at the ends of the windows, the memory of errors accounted for."""
        if self.memory is None:
            return self.composed(self.covs, horizon_s)
        factors = np.sqrt(self.memory.growth(horizon_s))
        return self.composed(self.covs * np.outer(factors, factors), horizon_s)

    def composed(self, step_covs: FloatArray, horizon_s: float) -> FloatArray:
        """Covariances ``(m, 3, 3)`` at the ends of the windows for covariances ``(n, 3, 3)`` of the steps."""
        k, n = self.starts(horizon_s)
        cov = np.zeros((len(k), 3, 3))
        for j in range(n):
            motion = self.motions[k + j]
            ad = adjoints(se2.between_array(motion, np.zeros_like(motion)))
            cov = ad @ cov @ ad.transpose(0, 2, 1) + step_covs[k + j]
        return cov


def roll_model(model: MotionModel, run: Run, step_s: float) -> Rollout:
    """Predict every step of a run, the model carrying its own velocity.

    Raises:
        ModelError: a prediction is not finite.
    """
    reader = SignalReader(model.card, run.sensors.imu_up)
    velocity: FloatArray | None = None

    def step(start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray]:
        nonlocal velocity
        events = run.sensors.step(start_ns, end_ns, model.card.history_s)
        commands = events.controls[: bisect_left(events.controls, end_ns, key=lambda c: c.stamp_ns)]
        signals = reader.read(events, run.sensors.gyro_bias(start_ns))
        if isinstance(signals, str):
            raise ModelError(f"{run.name}: the model reads {signals}, of which there is no message at {start_ns} ns")
        carried = velocity if model.card.family == "velocity" else None
        prediction = model.predict(commands, start_ns, end_ns, carried, signals)
        if prediction is None:
            raise ModelError(f"{run.name}: the model's output at {start_ns} ns is not finite")
        velocity = prediction.velocity
        return prediction.motion, prediction.cov

    return replace(_roll(run, step_s, step), memory=model.card.memory)


def roll_sources(run: Run, step_s: float, model: MotionModel | None = None, with_gyro: bool = False) -> Rollout:
    """Dead reckoning by the wheels, and by model and gyro with them, as the localizer measures and fuses them.

    The gyro's bias is as well known as with a fix at each step, its turn as vague as 10 s after the last one.

    Raises:
        ModelError: the recording holds no wheel odometry, or a gap of it.
    """
    if not run.sensors.has_wheels:
        raise ModelError(f"{run.name}: no wheel odometry in the recording")
    config = Config().model_copy(update={"wheels": run.sensors.wheels})
    gyro = Gyro(config.gyro, run.sensors.imu_up) if with_gyro else None
    learned = None if model is None else LearnedMotion(model, config.motion, run.sensors.imu_up)
    wheels, joint = WheelMotion(run.sensors.wheels), None if model is None else model.joint
    sources = MotionSources(config, MotionSensors(wheels, learned, joint, gyro))
    history_s = 0.0 if model is None else model.card.history_s
    origin = PoseWithCovariance(np.zeros(3), np.zeros((3, 3)))
    constants = InstallationEstimate(np.zeros(0), np.zeros((0, 0)))

    def step(start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray]:
        events = run.sensors.step(start_ns, end_ns, history_s)
        readings = sources.read(events, _SINCE_FIX_S)
        if readings.wheels is None:
            raise ModelError(f"{run.name}: no wheel motion at {start_ns} ns")
        motions = NoiseBudget().combine(readings, sources.rules)
        after = predict(origin, constants, sources.factors.installation, motions)
        if gyro is not None:
            known = round((end_ns - run.origin_ns) * 1e-9 / run.dt_s)
            if readings.gyro is None or not run.valid[known]:
                gyro.forget_fix()
            else:
                gyro.turned(float(readings.gyro.motion[2]), events.dt)
                gyro.fix(float(run.poses[known, 2]), _FIX_RAD**2)
        return after.pose, after.cov

    return _roll(run, step_s, step)


def roll_kinematics(kinematics: Kinematics, run: Run, step_s: float) -> Rollout:
    """Rollout of the calibrated kinematics alone, in place of wheel odometry where there is none."""

    def step(start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray]:
        start, end = ((t - run.origin_ns) * 1e-9 for t in (start_ns, end_ns))
        limits = np.linspace(start, end, max(1, round((end - start) / 0.05)) + 1)
        motion = np.zeros(3)
        for twist in calibrated(kinematics, run.track, limits) * (limits[1] - limits[0]):
            motion = se2.compose(motion, se2.exp(twist))
        return motion, np.zeros((3, 3))

    return _roll(run, step_s, step)


def _roll(run: Run, step_s: float, step: Callable[[int, int], tuple[FloatArray, FloatArray]]) -> Rollout:
    stride = max(1, round(step_s / run.dt_s))
    step_s = stride * run.dt_s
    n = (len(run.poses) - 1) // stride
    limits = [run.origin_ns + round(k * step_s * 1e9) for k in range(n + 1)]
    results = [step(a, b) for a, b in pairwise(limits)]
    motions, covs = np.array([r[0] for r in results]), np.array([r[1] for r in results])
    track = [np.zeros(3)]
    for motion in motions:
        pose = se2.compose(track[-1], motion)
        pose[2] = track[-1][2] + motion[2]
        track.append(pose)
    picked = slice(0, n * stride + 1, stride)
    return Rollout(run, step_s, motions, covs, np.array(track), run.poses[picked], run.valid[picked])


# --- SE(2) for many at once -------------------------------------------------------------------------------------------


def logs(poses: FloatArray) -> FloatArray:
    """Logarithms ``(n, 3)`` of poses with wrapped yaw."""
    half = 0.5 * poses[:, 2]
    small = np.abs(half) < 1e-5
    a = np.where(small, 1.0 - half**2 / 3.0, half / np.tan(np.where(small, 1.0, half)))
    return np.column_stack([a * poses[:, 0] + half * poses[:, 1], a * poses[:, 1] - half * poses[:, 0], poses[:, 2]])


def adjoints(poses: FloatArray) -> FloatArray:
    """Adjoints ``(n, 3, 3)`` of poses."""
    out = np.zeros((len(poses), 3, 3))
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    out[:, 0, 0] = out[:, 1, 1] = c
    out[:, 0, 1], out[:, 1, 0] = -s, s
    out[:, 0, 2], out[:, 1, 2], out[:, 2, 2] = poses[:, 1], -poses[:, 0], 1.0
    return out
