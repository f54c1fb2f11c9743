"""Body twist from the joints of any drive: angles or ticks, rates, and steering."""

from __future__ import annotations

import math
from collections.abc import Sequence
from difflib import get_close_matches

import numpy as np

from fgloc.config import WheelsConfig
from fgloc.drives.base import Drive
from fgloc.errors import ConfigError
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.sensors.wheels.tracks import MAX_GAP_S, MAX_SPEED, PATIENCE, Track, Twist
from fgloc.types import FloatArray

_MOST_SEEN = 1000  # names
Moved = tuple[Twist, FloatArray]  # twist, and its derivatives (3, p) by the drive's parameters


class DriveTrack(Track):
    """Differences of the wheels' angles or, in messages without angles, their rates, with the steering between them.

    All joints of the drive come in one message. Angles that roll over after ``rolls_over`` are unwrapped both ways;
    an encoder that jumps otherwise is re-based. Rates of joints that count ticks are not used: their unit is no one's.

    ``rejections`` counts wheels.encoder_reset, and wheels.joints_incomplete: messages that lack one of the joints, or
    its value.
    """

    kind = "ticks"
    events = JointsEvent

    def __init__(self, config: WheelsConfig) -> None:
        """Start with nothing received."""
        assert config.drive is not None
        super().__init__(config)
        self._drive: Drive = config.drive
        self._per_position = 1.0 if config.in_radians else math.tau / (self._drive.ticks_per_turn or 1.0)
        self._without = 0  # messages without the wheels
        self._seen: set[str] = set()  # joints of those

    def _forget(self) -> None:
        self._angles: FloatArray | None = None
        self._rates: FloatArray | None = None
        self._steering: FloatArray | None = None
        self._moving: Moved | None = None  # the newest that is known

    def _take(self, event: JointsEvent) -> None:
        names = self._drive.driven
        places = self._places(event.names)
        if places is None:
            return
        steering = self._steered(event)
        angles = _entries(event.position, places)
        rates = _entries(event.velocity, places) if self._config.in_radians else None
        if steering is None or (angles is None and rates is None):
            self.rejections["wheels.joints_incomplete"] += 1
            self._wait(
                f"their values are incomplete: {', '.join(names)} need angles or rates, steering an angle. "
                "Correct wheels.drive"
            )
            return
        moved, steady = None, False
        if self._last_ns is not None:
            moved = self._moved(angles, rates, steering, (event.stamp_ns - self._last_ns) * 1e-9)
            steady = moved is not None and self._possible(moved[0], math.inf)
        before = None if self._moving is None else self._moving[0]
        self._extend(event.stamp_ns, None if moved is None else moved[0], before, None if moved is None else moved[1])
        now = None if rates is None else self._twist(rates, steering)
        self._angles, self._rates, self._steering = angles, rates, steering
        self._moving = now or (moved if steady else self._moving)
        self._reach(event.stamp_ns, *(self._moving or (None,)))

    def _moved(
        self, angles: FloatArray | None, rates: FloatArray | None, steering: FloatArray, seconds: float
    ) -> Moved | None:
        """Mean twist since the last message; None if neither angles nor rates give it."""
        between = steering if self._steering is None else 0.5 * (steering + self._steering)
        if angles is not None and self._angles is not None and seconds <= MAX_GAP_S:
            turned, roll = angles - self._angles, self._drive.rolls_over
            if roll is not None:
                if seconds > self._config.hold_s:  # nobody knows how often it rolled over
                    return None
                turned = np.array([math.remainder(turn, roll) for turn in turned.tolist()])
            moved = self._twist(turned * (self._per_position / seconds), between, seconds, MAX_SPEED)
            if moved is not None:
                return moved
            self.rejections["wheels.encoder_reset"] += 1
            hint = "; if the angle rolls over, set rolls_over" if roll is None else ""
            self.notes["reset"] = (
                f"wheel angles jumped {self.rejections['wheels.encoder_reset']} time(s), the last by "
                f"{', '.join(f'{turn:.3g}' for turn in turned)} in {seconds:.3g} s: taken as a reset{hint}"
            )
        if rates is None or seconds > self._config.hold_s:
            return None
        return self._twist(rates if self._rates is None else 0.5 * (rates + self._rates), between)

    def _twist(
        self, rates: FloatArray, steering: FloatArray, seconds: float = math.inf, fastest: float = math.inf
    ) -> Moved | None:
        """Twist of joint rates [rad/s] and steering angles [rad]; None if no robot moves like this.

        Differences of angles may be those of an encoder that jumps: over ``seconds`` they make no more than
        ``fastest`` [m/s].
        """
        try:
            twist, by, _ = self._drive.moves(rates.tolist(), steering.tolist())
        except np.linalg.LinAlgError:  # steered so far that the wheels do not determine a motion
            return None
        vx, vy, w = twist.tolist()
        return ((vx, vy, w), by) if self._possible((vx, vy, w), seconds, fastest) else None

    def _steered(self, event: JointsEvent) -> FloatArray | None:
        """Angles [rad] of the steered joints; None if one is not known."""
        if not self._drive.steered:
            return np.empty(0)
        found = _entries(event.position, [event.names.index(name) for name in self._drive.steered])
        return None if found is None else np.array([self._drive.steering(value) for value in found.tolist()])

    def _places(self, names: Sequence[str]) -> list[int] | None:
        """Indices of the driven joints; None if this message lacks one of the drive's joints."""
        wanted = (*self._drive.driven, *self._drive.steered)
        missing = [name for name in wanted if name not in names]
        if not missing:
            return [names.index(name) for name in self._drive.driven]
        if len(self._seen) < _MOST_SEEN:
            self._seen.update(names)
        if {*wanted} <= self._seen:
            self._wait(
                f"none holds all joints of wheels.drive: {', '.join(wanted)} come in several. Publish them in one "
                "(joint_state_publisher merges), or each part on a topic of its own, which recording.joints names"
            )
            return None
        near = [(name, get_close_matches(name, names, n=1)) for name in missing]
        told = ", ".join(name + (f" (did you mean '{close[0]}'?)" if close else "") for name, close in near)
        self._wait(
            f"none holds all joints of wheels.drive; missing: {told}; the last holds {', '.join(names)}. "
            "Correct wheels.drive"
        )
        return None

    def _wait(self, why: str) -> None:
        """Note a message that could not be used.

        Raises:
            ConfigError: there were many, and none before them could be.
        """
        self._without += 1
        if self._without == PATIENCE and self._last_ns is None:
            raise ConfigError(f"{PATIENCE} messages of joint states, and {why}")


def _entries(values: FloatArray, places: Sequence[int]) -> FloatArray | None:
    """Finite entries of an array that may be empty."""
    if len(values) <= max(places):
        return None
    found = values[list(places)]
    return found if np.isfinite(found).all() else None
