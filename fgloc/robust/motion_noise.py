"""Changes of the covariance of a motion, and what of a step they depend on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fgloc.types import FloatArray, MotionMeasurement, Step

_COMMANDED_NS = 1_000_000_000  # how long before a step a command still moves the robot
_WRONG_LASTS_S = 1.0  # ... for this long in one direction
_LEARNED_BESIDE_WRONG_WHEELS = 4.0  # times its covariance: squared errors over 1 s of a slip, 2 to 5 times


def noise_scales(off: Mapping[str, str], scale: float) -> dict[str, float]:
    """Factors on the covariances of wheels and learned motion.

    Args:
        off: sources that are left out, and why.
        scale: on the wheels' covariance, as they and the other sources differ (`MotionFaultMonitor`). The learned
            motion's follows, up to what it is worth beside wrong wheels; below 1 by the root, as it is not known
            which of the two has too large a covariance.
    """
    if "wheels" in off:
        return {"learned": _LEARNED_BESIDE_WRONG_WHEELS}
    return {"wheels": scale, "learned": min(scale, _LEARNED_BESIDE_WRONG_WHEELS) if scale > 1.0 else math.sqrt(scale)}


def with_noise(m: MotionMeasurement, scale: float = 1.0, extra_cov: FloatArray | None = None) -> MotionMeasurement:
    """The motion with its covariance scaled, and with ``extra_cov (3, 3)``, its disagreement with sightings, added."""
    if scale == 1.0 and extra_cov is None:
        return m
    return replace(m, cov=m.cov * scale + (0.0 if extra_cov is None else extra_cov))


def add_slip_noise(m: MotionMeasurement, speed: float, turn: float) -> MotionMeasurement:
    """The wheels' motion with slip noise: the true speed may be anything between theirs and zero, or off by these.

    Args:
        m: motion of the wheels.
        speed: that they may be wrong by, even when they hardly turn [m/s].
        turn: likewise [rad/s].
    """
    seconds = max((m.stamp_ns - m.start_ns) * 1e-9, 1e-3)
    speed_of_wheels, turned = np.hypot(*m.motion[:2]) / seconds, abs(float(m.motion[2])) / seconds
    density = np.square([max(speed_of_wheels, speed), 0.3 * max(speed_of_wheels, speed), max(turned, turn)])
    return replace(m, cov=m.cov + np.diag(density * _WRONG_LASTS_S * seconds))


def turned_by(motion: FloatArray, yaw: float) -> FloatArray:
    """The motion ``(3,)`` with another rotation [rad]."""
    return np.array([motion[0], motion[1], yaw])


def is_commanded_to_move(step: Step) -> bool:
    """Whether a command of the step, or the one it began with, is not to stand: still wheels may then be dead ones."""
    since = step.start_ns - _COMMANDED_NS
    return any((c.v != 0.0 or c.omega != 0.0) and c.stamp_ns >= since for c in step.controls)
