"""From what robots report to a timeline of body twist: the common part, and commands that stand in for wheels."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from typing import Any

from fgloc.sensors.wheels.config import WheelsConfig
from fgloc.sensors.wheels.timeline import Twist, TwistTimeline
from fgloc.types import ControlEvent, MotionEvent, Step

MAX_SPEED, MAX_TURN = 10.0, 20.0  # m/s, rad/s: a difference of two readings beyond them is a reset
MAX_GAP_S = 5.0  # over a longer gap no difference is used: the robot may have been restarted


class Track:
    """One source of wheel motion: events in, a timeline out.

    Attributes:
        kind: name of the source.
        timeline: the body's twist, without the delay.
        rejections: readings that could not be used, by reason.
        notes: what the user should know, by what it is about.
    """

    kind = ""
    events: type[MotionEvent] = MotionEvent  # that it reads

    def __init__(self, config: WheelsConfig) -> None:
        """Start with nothing received."""
        self.timeline = TwistTimeline()
        self.rejections: Counter[str] = Counter()
        self.notes: dict[str, str] = {}
        self._config = config
        self._hold_ns = int(config.hold_s * 1e9)
        self._last_ns: int | None = None  # the newest stamp taken in
        self._forget()

    def ingest(self, step: Step) -> None:
        """Take in the step's events that are newer than all before."""
        found: Sequence[Any] = step.of(self.events)
        first = 0 if self._last_ns is None else bisect_right(found, self._last_ns, key=lambda e: e.stamp_ns)
        for event in found[first:]:
            if self._last_ns is None or event.stamp_ns > self._last_ns:
                self._take(event)

    def reset(self) -> None:
        """A new segment: nothing before is connected with what comes."""
        self.timeline = TwistTimeline()
        self._last_ns = None
        self._forget()

    def _take(self, event: Any) -> None:
        raise NotImplementedError

    def _forget(self) -> None:
        raise NotImplementedError

    def _true(self, twist: Twist) -> Twist:
        """What the robot did when it reports this."""
        vx, vy, w = twist
        config = self._config
        if math.hypot(vx, vy) < config.zero_speed:
            vx = vy = 0.0
        if abs(w) < config.zero_yaw_rate:
            w = 0.0
        scale = config.scale_v * max(0.0, 1.0 - config.slowdown * abs(w))
        vx, vy = scale * vx, scale * vy
        return vx, vy, config.scale_omega * w + config.yaw_per_m * vx

    def _extend(self, stamp_ns: int, twist: Twist | None, held: Twist | None) -> None:
        """Continue the timeline with ``twist`` or, if that is None, with ``held`` as long as it holds."""
        if self._last_ns is None:
            self.timeline.begin(stamp_ns)
        elif twist is not None:
            self.timeline.extend(stamp_ns, self._true(twist))
        else:
            if held is not None:
                self.timeline.extend(min(stamp_ns, self._last_ns + self._hold_ns), self._true(held))
            self.timeline.extend(stamp_ns, None)

    def _reach(self, stamp_ns: int, held: Twist | None) -> None:
        """This was the newest reading; ``held`` is taken to hold beyond it."""
        self._last_ns = stamp_ns
        if held is not None:
            self.timeline.hold(self._true(held), stamp_ns + self._hold_ns)


class CommandTrack(Track):
    """Commands stand in for wheels: each holds until the next, for ``hold_s`` at most."""

    kind = "command"
    events = ControlEvent

    def _forget(self) -> None:
        self._command: Twist | None = None

    def _take(self, event: ControlEvent) -> None:
        self._extend(event.stamp_ns, None, self._command)
        self._command = (event.v, 0.0, event.omega)
        self._reach(event.stamp_ns, self._command)


def mean_twist(a: Twist | None, b: Twist | None) -> Twist | None:
    """Mean of two twists, or the one that is known."""
    if a is None or b is None:
        return a or b
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])
