"""Measured signals as functions of time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fgloc.types import FloatArray

MAX_GAP_S = 0.25  # a signal without a sample for longer has a gap
_FOREVER_S = 1e4  # the first and the last values hold on; the caller decides whether to use them


class Signal:
    """One or more channels over time, integrated once so that any mean is two look-ups per channel."""

    def __init__(self, times_s: FloatArray, integrals: FloatArray) -> None:
        """Take the integrals.

        Args:
            times_s: ``(n,)`` increasing, at least two.
            integrals: ``(c, n)`` of the channels up to these times; between them each channel is constant.
        """
        n = len(times_s)
        self._times = np.empty(n + 2)
        self._times[1:-1] = times_s
        self._times[0], self._times[-1] = times_s[0] - _FOREVER_S, times_s[-1] + _FOREVER_S
        self._integrals = np.empty((len(integrals), n + 2))
        self._integrals[:, 1:-1] = integrals
        first = (integrals[:, 1] - integrals[:, 0]) / (times_s[1] - times_s[0])
        last = (integrals[:, -1] - integrals[:, -2]) / (times_s[-1] - times_s[-2])
        self._integrals[:, 0] = integrals[:, 0] - _FOREVER_S * first
        self._integrals[:, -1] = integrals[:, -1] + _FOREVER_S * last

    @classmethod
    def of_samples(cls, times_s: FloatArray, values: FloatArray) -> Signal:
        """From samples ``(c, n)``, joined by straight lines."""
        integrals = np.zeros(values.shape)
        np.cumsum(0.5 * (values[:, 1:] + values[:, :-1]) * np.diff(times_s), axis=1, out=integrals[:, 1:])
        return cls(times_s, integrals)

    def integrals(self, times_s: FloatArray) -> FloatArray:
        """Integrals of the channels ``(c, ...)`` up to times ``(...)``."""
        return np.array([np.interp(times_s, self._times, channel) for channel in self._integrals])

    def covers(self, start_s: float, end_s: float) -> bool:
        """Whether no moment between these times is farther than `MAX_GAP_S` from a sample."""
        times = self._times[1:-1]
        first = max(0, int(np.searchsorted(times, start_s, "right")) - 1)
        inside = times[first : int(np.searchsorted(times, end_s, "left")) + 1]
        if not len(inside) or inside[0] > start_s + MAX_GAP_S or inside[-1] < end_s - MAX_GAP_S:
            return False
        return bool((np.diff(inside) <= MAX_GAP_S).all())

    def means(self, limits_s: FloatArray) -> FloatArray:
        """Means ``(..., m - 1, c)`` between neighboring limits ``(..., m)``, strictly monotonic along the last axis."""
        means = np.diff(self.integrals(limits_s)) / np.diff(limits_s)
        return np.ascontiguousarray(np.moveaxis(means, 0, -1))


def of_stamps(stamps: Sequence[int], values: FloatArray, origin_ns: int) -> Signal | None:
    """From samples ``(c, n)`` at stamps [ns], joined by straight lines; None if they are fewer than two."""
    return Signal.of_samples(seconds(stamps, origin_ns), values) if len(stamps) > 1 else None


def seconds(stamps: Sequence[int], origin_ns: int) -> FloatArray:
    """Stamps [ns] as times ``(n,)`` [s] since an origin."""
    return np.array([stamp - origin_ns for stamp in stamps]) * 1e-9
