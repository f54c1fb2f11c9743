"""Commands as a function of time: each holds until the next."""

from __future__ import annotations

import numpy as np

from fgloc.types import ControlEvent, FloatArray

_FOREVER_S = 1e4  # a last command holds on; who asks decides for how long
_MIN_CAPACITY = 4096


class CommandHistory:
    """Zero-order hold over commands, integrated once so that any mean over time is two look-ups.

    Before the first command the robot is taken to be at rest.
    """

    def __init__(self, commands: tuple[ControlEvent, ...], origin_ns: int | None = None) -> None:
        """Integrate.

        Args:
            commands: at least one, in order of stamp.
            origin_ns: time zero of all the later questions; None: the first command's.
        """
        self.origin_ns = commands[0].stamp_ns if origin_ns is None else origin_ns
        n = len(commands)
        capacity = max(_MIN_CAPACITY, 2 * n)
        self._events = list(commands)
        self._times = np.empty(capacity)
        self._integrals = np.zeros(capacity, dtype=np.complex128)  # of v + iω: both by one interpolation
        times = self._times[:n]
        times[:] = [c.stamp_ns - self.origin_ns for c in commands]
        times *= 1e-9
        steps = np.diff(times)
        np.cumsum(np.multiply([complex(c.v, c.omega) for c in commands[:-1]], steps), out=self._integrals[1:n])
        self._extend(())

    def following(self, commands: tuple[ControlEvent, ...]) -> CommandHistory:
        """This track, extended by what is new in the next step's commands; a new one if they do not continue it."""
        last = self._events[-1]
        i = len(commands) - 1
        while i >= 0 and commands[i] is not last:
            i -= 1
        first = len(self._events) - 1 - i  # our index of commands[0], if they are the same
        full = len(self._events) + len(commands) - i >= len(self._times)
        if i < 0 or first < 0 or self._events[first] is not commands[0] or full:
            return CommandHistory(commands)
        self._extend(commands[i + 1 :])
        return self

    def integrals(self, times_s: FloatArray) -> FloatArray:
        """Integrals of v and ω ``(..., 2)`` up to times ``(...)`` since the origin."""
        n = len(self._events) + 1
        integrals = np.interp(times_s, self._times[:n], self._integrals[:n])
        return integrals.view(np.float64).reshape(*times_s.shape, 2)

    def means(self, limits_s: FloatArray) -> FloatArray:
        """Mean (v, ω) between neighboring limits.

        Args:
            limits_s: ``(..., m)`` times since the origin, strictly monotonic along the last axis.

        Returns:
            ``(..., m - 1, 2)``.
        """
        return np.asarray(np.diff(self.integrals(limits_s), axis=-2) / np.diff(limits_s)[..., None])

    def _extend(self, events: tuple[ControlEvent, ...]) -> None:
        """Append, then one more entry, overwritten by the next command: the last one holds.

        In plain floats: reading single elements of arrays would take most of the time.
        """
        times, integrals = self._times, self._integrals
        k, last = len(self._events), self._events[-1]
        t, integral = float(times[k - 1]), complex(integrals[k - 1])
        for event in events:
            now = (event.stamp_ns - self.origin_ns) * 1e-9
            integral, t = integral + complex(last.v, last.omega) * (now - t), now
            times[k], integrals[k] = t, integral
            k, last = k + 1, event
        self._events.extend(events)
        times[k] = t + _FOREVER_S
        integrals[k] = integral + complex(last.v, last.omega) * _FOREVER_S
