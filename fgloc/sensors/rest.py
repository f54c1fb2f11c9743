"""Whether a robot stands: by its wheels, and by what it is commanded."""

from __future__ import annotations

import math

from fgloc.types import FloatArray, Step

_COMMANDED_NS = 1_000_000_000  # how long before a step a command still moves the robot
_QUANTIZATION = 1e-3  # m, rad: of encoders, in a second; less is no motion
_LEAST_S = 0.1  # a shorter step has as large a quantization


def is_standing(motion: FloatArray, seconds: float) -> bool:
    """Whether a motion ``(3,)`` that wheels measured over a step of this length is none."""
    x, y, yaw = motion
    return bool(max(math.hypot(x, y), abs(yaw)) < _QUANTIZATION * max(seconds, _LEAST_S))


def commanded_to_move(step: Step) -> bool | None:
    """Whether a command of the step, or of the second before it, is not to stand; None: there is none."""
    since = step.start_ns - _COMMANDED_NS
    recent = [c.v != 0.0 or c.omega != 0.0 for c in step.controls if c.stamp_ns >= since]
    return any(recent) if recent else None
