"""Wheel motion from the angles of two driven wheels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from difflib import get_close_matches

from fgloc.errors import ConfigError
from fgloc.sensors.wheels.config import WheelsConfig
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.sensors.wheels.timeline import Twist
from fgloc.sensors.wheels.tracks import MAX_GAP_S, MAX_SPEED, MAX_TURN, Track, mean_twist
from fgloc.types import FloatArray

_PATIENCE = 20  # messages without the wheels' joints before a note is made


class TicksTrack(Track):
    """Differences of wheel angles or, in messages without angles, wheel rates.

    Both wheels come in one message. Angles that roll over after ``angle_range`` are unwrapped both ways; an encoder
    that jumps otherwise (set to zero) is re-based.
    """

    kind = "ticks"
    events = JointsEvent

    def __init__(self, config: WheelsConfig) -> None:
        """Start with nothing received.

        Raises:
            ConfigError: the wheels' geometry is incomplete.
        """
        super().__init__(config)
        if config.left_radius is None or config.right_radius is None or config.track is None:
            raise ConfigError(
                f"wheels.source is {config.source}, but wheel angles need the geometry; set wheels.left_radius, "
                "wheels.right_radius and wheels.track"
            )
        self._left_radius, self._right_radius, self._width = config.left_radius, config.right_radius, config.track
        self._wheels: tuple[str, str] | None = None
        self._without = 0  # messages without the wheels

    def _forget(self) -> None:
        self._angles: tuple[float, float] | None = None
        self._reported: Twist | None = None
        self._moving: Twist | None = None  # the newest twist that is known

    def _take(self, event: JointsEvent) -> None:
        found = self._find(event.names)
        if found is None:
            return
        angles, rates = _pair(event.position, *found), _pair(event.velocity, *found)
        if angles is None and rates is None:
            return
        reported = None if rates is None else self._twist(*rates)
        piece = None
        if self._last_ns is not None:
            seconds = (event.stamp_ns - self._last_ns) * 1e-9
            piece = self._turned(angles, seconds)
            if piece is None and reported is not None and seconds <= self._config.hold_s:
                piece = mean_twist(self._reported, reported)
        self._extend(event.stamp_ns, piece, self._moving)
        self._angles, self._reported, self._moving = angles, reported, reported or piece or self._moving
        self._reach(event.stamp_ns, self._moving)

    def _turned(self, angles: tuple[float, float] | None, seconds: float) -> Twist | None:
        """The twist that turned the wheels from the last message's angles to these; None if they cannot tell."""
        if angles is None or self._angles is None or seconds > MAX_GAP_S:
            return None
        left, right = angles[0] - self._angles[0], angles[1] - self._angles[1]
        roll = self._config.angle_range
        if roll is not None:
            if seconds > self._config.hold_s:  # nobody knows how often it rolled over
                return None
            left, right = math.remainder(left, roll), math.remainder(right, roll)
        twist = self._twist(left / seconds, right / seconds)
        if abs(twist[0]) > MAX_SPEED or abs(twist[2]) > MAX_TURN:
            self.rejections["wheels.encoder_reset"] += 1
            hint = "; if the angle rolls over, set wheels.angle_range" if roll is None else ""
            self.notes["reset"] = (
                f"wheel angles jumped {self.rejections['wheels.encoder_reset']} time(s), the last by {left:.3g} and "
                f"{right:.3g} rad in {seconds:.3g} s: taken as a reset{hint}"
            )
            return None
        return twist

    def _twist(self, left: float, right: float) -> Twist:
        """Body twist of wheel rates [rad/s]."""
        left, right = self._left_radius * left, self._right_radius * right
        return 0.5 * (left + right), 0.0, (right - left) / self._width

    def _find(self, names: Sequence[str]) -> tuple[int, int] | None:
        """Indices of the left and the right wheel; None if this message has not both."""
        if self._wheels is None:
            self._wheels = wheel_names(names, self._config.left_joint, self._config.right_joint)
        if self._wheels is not None and self._wheels[0] in names and self._wheels[1] in names:
            return names.index(self._wheels[0]), names.index(self._wheels[1])
        self._without += 1
        if self._without == _PATIENCE and self._last_ns is None:
            text = (
                f"{_PATIENCE} messages of joint states, and none holds both wheels{self._configured(names)}; the last "
                f"holds {', '.join(names)}: set wheels.left_joint and wheels.right_joint"
            )
            if self._config.source == "ticks":
                raise ConfigError(text)
            self.notes["joints"] = text
        return None

    def _configured(self, names: Sequence[str]) -> str:
        """The configured joints that are not among the names, with the name that is most like each."""
        wanted = {"left_joint": self._config.left_joint, "right_joint": self._config.right_joint}
        missing = []
        for key, joint in wanted.items():
            if joint is not None and joint not in names:
                near = get_close_matches(joint, names, n=1)
                missing.append(f"wheels.{key}: {joint}" + (f", did you mean '{near[0]}'?" if near else ""))
        return f" ({'; '.join(missing)})" if missing else ""


def wheel_names(names: Sequence[str], left: str | None, right: str | None) -> tuple[str, str] | None:
    """Joints of the left and the right wheel, as configured or guessed; None if there are none among the names.

    Raises:
        ConfigError: several could be meant.
    """
    pair: list[str] = []
    for side, given in (("left", left), ("right", right)):
        found = [given] if given else [name for name in names if side in name.lower() and "wheel" in name.lower()]
        if len(found) > 1:
            raise ConfigError(
                f"{len(found)} joints could be the {side} wheel ({', '.join(found)}); set wheels.{side}_joint"
            )
        pair += found
    return (pair[0], pair[1]) if len(pair) == 2 else None


def _pair(values: FloatArray, left: int, right: int) -> tuple[float, float] | None:
    """Two finite entries of an array that may be empty."""
    if len(values) <= max(left, right):
        return None
    pair = float(values[left]), float(values[right])
    return pair if math.isfinite(pair[0] + pair[1]) else None
