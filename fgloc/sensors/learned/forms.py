"""What identified motion models have in common: from inputs to the motion of the base over a step, with covariance.

All forms cut a step into equal parts no longer than the card's ``dt_s`` and compose them, so that a step may last any
time and two halves give what the whole gives.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fgloc import se2
from fgloc.errors import ModelError
from fgloc.sensors.learned.card import Kinematics, ModelCard
from fgloc.sensors.learned.commands import CommandHistory
from fgloc.sensors.learned.joint import JointCalibration
from fgloc.sensors.learned.signals import Signals
from fgloc.sensors.noise_density import NoiseDensity
from fgloc.types import ControlEvent, FloatArray

_SMALL = 1e-9
Triple = Sequence[float]  # of x, y and yaw


@dataclass(frozen=True, slots=True, eq=False)
class MotionPrediction:
    """``T_start_end`` of the base with right-perturbation covariance, and the body velocity at the end."""

    motion: FloatArray  # (3,)
    cov: FloatArray  # (3, 3)
    velocity: FloatArray  # (2,) v [m/s], ω [rad/s]


class MotionModel(Protocol):
    """What the localizer knows of a learned model: its card, its calibration against the wheels, its predictions."""

    card: ModelCard
    joint: JointCalibration | None

    def predict(
        self,
        commands: tuple[ControlEvent, ...],
        start_ns: int,
        end_ns: int,
        velocity: FloatArray | None,
        signals: Signals | None = None,
    ) -> MotionPrediction | None:
        """Motion over ``[start_ns, end_ns]``.

        Args:
            commands: in order of stamp, from ``card.history_s`` before the start (or the first there is) to the end.
            start_ns: start of the step.
            end_ns: its end.
            velocity: ``(2,)`` body velocity v, ω at the start, if known. None: by the commands before the start.
            signals: what was measured, if the model reads any of it.

        Returns:
            None if the network's output is not finite.

        Raises:
            ModelError: there is no command, the step has no length, or a signal that the model reads is not given.
        """
        ...


def calibrated(kinematics: Kinematics, track: CommandHistory, limits: FloatArray) -> FloatArray:
    """Mean body twists ``(n, 3)`` between limits [s] of the calibrated kinematics."""
    return np.asarray(track.means(limits - kinematics.delay_s) @ gains(kinematics))


def gains(kinematics: Kinematics) -> FloatArray:
    """``(2, 3)``: commands (v, ω) times it are body twists."""
    v = kinematics.scale_v
    return np.array([[v, 0.0, kinematics.yaw_per_m * v], [0.0, 0.0, kinematics.scale_omega]])


def noise_density(noise: NoiseDensity, v: float, omega: float) -> tuple[float, float, float]:
    """Variances per second of x, y, yaw at a velocity."""
    v, omega = abs(v), abs(omega)
    turning = noise.xy_per_sqrt_rad**2 * omega + noise.xy_per_sqrt_s**2
    yaw = noise.yaw_per_sqrt_m**2 * v + noise.yaw_per_sqrt_rad**2 * omega + noise.yaw_per_sqrt_s**2
    return noise.x_per_sqrt_m**2 * v + turning, noise.y_per_sqrt_m**2 * v + turning, yaw


def composed(twists: Iterable[Triple], variances: Iterable[Triple]) -> tuple[FloatArray, FloatArray]:
    """Motion ``(3,)`` and covariance ``(3, 3)`` of consecutive parts.

    Scalars, because a step has two or three parts: five times as fast here as `fgloc.se2` on small arrays.

    Args:
        twists: of each part, held over it, times its length.
        variances: of x, y and yaw of each part's right perturbation, independent.
    """
    x = y = yaw = 0.0
    xx = xy = xt = yy = yt = tt = 0.0
    for (vx, vy, turn), (qx, qy, qt) in zip(twists, variances, strict=True):
        sine, cosine = math.sin(turn), math.cos(turn)
        a, b = (sine / turn, (1.0 - cosine) / turn) if abs(turn) > _SMALL else (1.0, 0.5 * turn)
        px, py = a * vx - b * vy, b * vx + a * vy
        # 1. Pose: compose with the exponential of the twist
        c, s = math.cos(yaw), math.sin(yaw)
        x, y, yaw = x + c * px - s * py, y + s * px + c * py, yaw + turn
        # 2. Covariance: Ad(p⁻¹) P Ad(p⁻¹)ᵀ + Q. The lever arm first, then the rotation
        xx, xy, yy = (
            xx - 2.0 * py * xt + py * py * tt,
            xy + px * xt - py * yt - px * py * tt,
            yy + 2.0 * px * yt + px * px * tt,
        )
        xt, yt = xt - py * tt, yt + px * tt
        rxx = cosine * (cosine * xx + 2.0 * sine * xy) + sine * sine * yy
        rxy = (cosine * cosine - sine * sine) * xy + cosine * sine * (yy - xx)
        ryy = cosine * (cosine * yy - 2.0 * sine * xy) + sine * sine * xx
        xx, xy, yy = rxx + qx, rxy, ryy + qy
        xt, yt, tt = cosine * xt + sine * yt, cosine * yt - sine * xt, tt + qt
    return np.array([x, y, se2.wrap(yaw)]), np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])


def joint_of(card: ModelCard) -> JointCalibration | None:
    """The card's calibration against the wheels, ready for use."""
    return None if card.joint is None else JointCalibration(card.joint.W, card.joint.N, card.joint.C)


def duration_of(commands: tuple[ControlEvent, ...], start_ns: int, end_ns: int) -> float:
    """Length of the step [s]; raises `ModelError` if there is none, or no command."""
    if not commands:
        raise ModelError("no command to predict from; the step needs the last command at or before its start")
    if end_ns <= start_ns:
        raise ModelError(f"the step ends at {end_ns} ns, not after its start {start_ns} ns")
    return (end_ns - start_ns) * 1e-9


def follow(track: CommandHistory | None, commands: tuple[ControlEvent, ...]) -> CommandHistory:
    """The track of these commands, continued from the last step's where it can be."""
    return CommandHistory(commands) if track is None else track.following(commands)


def sub_steps(duration: float, longest_s: float) -> int:
    """How many equal parts, no longer than the longest."""
    return max(1, math.ceil(duration / longest_s - 1e-6))
