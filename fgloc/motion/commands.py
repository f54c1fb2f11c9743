"""Commands as a function of time: each holds until the next."""

from __future__ import annotations

import numpy as np

from fgloc.types import CommandEvent, FloatArray

_FOREVER_S = 1e4  # a last command holds on; who asks decides whether to believe it
_MIN_CAPACITY = 4096


class CommandTrack:
    """Zero-order hold over commands, integrated once so that any mean over time is two look-ups.

    Before the first command the robot is taken to be at rest.
    """

    def __init__(self, commands: tuple[CommandEvent, ...], origin_ns: int | None = None) -> None:
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
        self._integrals = np.zeros((2, capacity))
        times = self._times[:n]
        times[:] = [c.stamp_ns - self.origin_ns for c in commands]
        times *= 1e-9
        steps = np.diff(times)
        np.cumsum(np.multiply([c.v for c in commands[:-1]], steps), out=self._integrals[0, 1:n])
        np.cumsum(np.multiply([c.omega for c in commands[:-1]], steps), out=self._integrals[1, 1:n])
        self._extend(())

    def following(self, commands: tuple[CommandEvent, ...]) -> CommandTrack:
        """This track, extended by what is new in the next step's commands; a new one if they do not continue it."""
        last = self._events[-1]
        i = len(commands) - 1
        while i >= 0 and commands[i] is not last:
            i -= 1
        first = len(self._events) - 1 - i  # our index of commands[0], if they are the same
        full = len(self._events) + len(commands) - i >= len(self._times)
        if i < 0 or first < 0 or self._events[first] is not commands[0] or full:
            return CommandTrack(commands)
        self._extend(commands[i + 1 :])
        return self

    def integrals(self, times_s: FloatArray) -> FloatArray:
        """Integrals of v and ω ``(2, ...)`` up to times ``(...)`` since the origin."""
        n = len(self._events) + 1
        known = self._times[:n]
        out = np.empty((2, *times_s.shape))
        out[0] = np.interp(times_s, known, self._integrals[0, :n])
        out[1] = np.interp(times_s, known, self._integrals[1, :n])
        return out

    def means(self, limits_s: FloatArray) -> FloatArray:
        """Mean (v, ω) between neighboring limits.

        Args:
            limits_s: ``(..., m)`` times since the origin, strictly monotonic along the last axis.

        Returns:
            ``(..., m - 1, 2)``.
        """
        means = np.diff(self.integrals(limits_s)) / np.diff(limits_s)
        return np.ascontiguousarray(np.moveaxis(means, 0, -1))

    def _extend(self, events: tuple[CommandEvent, ...]) -> None:
        """Append, then one more entry, overwritten by the next command: the last one holds.

        In plain floats: reading single elements of arrays would take most of the time.
        """
        times, (integral_v, integral_omega) = self._times, self._integrals
        k, last = len(self._events), self._events[-1]
        t, v, omega = float(times[k - 1]), float(integral_v[k - 1]), float(integral_omega[k - 1])
        for event in events:
            now = (event.stamp_ns - self.origin_ns) * 1e-9
            v, omega, t = v + last.v * (now - t), omega + last.omega * (now - t), now
            times[k], integral_v[k], integral_omega[k] = t, v, omega
            k, last = k + 1, event
        self._events.extend(events)
        times[k] = t + _FOREVER_S
        integral_v[k], integral_omega[k] = v + last.v * _FOREVER_S, omega + last.omega * _FOREVER_S
