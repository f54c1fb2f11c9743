"""Whether a robot stands: by its wheels, and by what it is commanded."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from fgloc.types import FloatArray, Step

_COMMANDED_NS = 1_000_000_000  # how long before a step a command still moves the robot
_QUANTIZATION = 1e-3  # m, rad: of encoders, in a second; less is no motion
_WINDOW_S = 1.0  # in which encoders that jitter by a tick come back to where they were ...
_JITTER = 2e-3  # ... to within a tick of each wheel [rad]
_LEAST_S = 0.1  # a shorter step has as large a quantization


def is_standing(motion: FloatArray, seconds: float) -> bool:
    """Whether a motion ``(3,)`` that wheels measured over a step of this length is none."""
    x, y, yaw = motion
    return bool(max(math.hypot(x, y), abs(yaw)) < _QUANTIZATION * max(seconds, _LEAST_S))


class Standing:
    """Whether wheels have stood, step by step or, as encoders jitter between two ticks, over a second."""

    def __init__(self) -> None:
        self._steps: deque[tuple[float, FloatArray]] = deque()

    def fork(self) -> Standing:
        """A copy that may go on without changing this one."""
        forked = Standing()
        forked._steps.extend(self._steps)
        return forked

    def observe(self, motion: FloatArray | None, seconds: float) -> bool:
        """Whether the wheels stand still, after the next step.

        Args:
            motion: ``(3,)`` of the wheels over the step; None: unknown, or they are commanded to move.
            seconds: length of the step.
        """
        if motion is None:
            self._steps.clear()
            return False
        self._steps.append((seconds, motion))
        while sum(s for s, _ in self._steps) - self._steps[0][0] >= _WINDOW_S:
            self._steps.popleft()
        if is_standing(motion, seconds):
            return True
        x, y, yaw = np.sum([m for _, m in self._steps], axis=0)
        whole = sum(s for s, _ in self._steps) >= _WINDOW_S
        return bool(whole and math.hypot(x, y) < _QUANTIZATION and abs(yaw) < _JITTER)


def commanded_to_move(step: Step) -> bool | None:
    """Whether a command of the step, or of the second before it, is not to stand; None: there is none."""
    since = step.start_ns - _COMMANDED_NS
    recent = [c.v != 0.0 or c.omega != 0.0 for c in step.controls if c.stamp_ns >= since]
    return any(recent) if recent else None
