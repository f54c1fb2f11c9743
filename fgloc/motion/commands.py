"""Commands as a function of time: each holds until the next."""

from __future__ import annotations

import numpy as np

from fgloc.types import CommandEvent, FloatArray

_FOREVER_S = 1e4  # a last command holds on; who asks decides whether to believe it


class CommandTrack:
    """Zero-order hold over commands, integrated once so that any mean over time is two look-ups.

    Before the first command the robot is taken to be at rest.
    """

    def __init__(self, commands: tuple[CommandEvent, ...], origin_ns: int) -> None:
        """Integrate.

        Args:
            commands: at least one, in order of stamp.
            origin_ns: time zero of all the later questions.
        """
        n = len(commands)
        times = np.empty(n + 1)
        times[:n] = [c.stamp_ns - origin_ns for c in commands]
        times[:n] *= 1e-9
        times[n] = times[n - 1] + _FOREVER_S
        integrals = np.zeros((2, n + 1))
        steps = np.diff(times)
        np.cumsum(np.multiply([c.v for c in commands], steps), out=integrals[0, 1:])
        np.cumsum(np.multiply([c.omega for c in commands], steps), out=integrals[1, 1:])
        self._times = times
        self._integrals = integrals

    def means(self, limits_s: FloatArray) -> FloatArray:
        """Mean (v, ω) between neighboring limits.

        Args:
            limits_s: ``(..., m)`` times since the origin, strictly monotonic along the last axis.

        Returns:
            ``(..., m - 1, 2)``.
        """
        widths = np.diff(limits_s)
        out = np.empty((*widths.shape, 2))
        for axis in (0, 1):
            integral = np.interp(limits_s, self._times, self._integrals[axis])
            np.divide(np.diff(integral), widths, out=out[..., axis])
        return out
