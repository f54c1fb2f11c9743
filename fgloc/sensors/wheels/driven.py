"""Body twist from the joints of two wheels or of any drive: angles or ticks, rates, and steering."""

from __future__ import annotations

import math
from collections.abc import Sequence
from difflib import get_close_matches

import numpy as np

from fgloc.config import WheelsConfig
from fgloc.drives.base import Drive
from fgloc.errors import ConfigError
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.sensors.wheels.naming import by_side
from fgloc.sensors.wheels.tracks import MAX_GAP_S, MAX_SPEED, Track, Twist
from fgloc.types import FloatArray

_MOST_SEEN = 1000  # names
PATIENCE = 20  # messages without the wheels' joints before a note is made
Moved = tuple[Twist, FloatArray | None]  # twist, and its derivatives (3, p) by the drive's parameters


class JointsTrack(Track):
    """Differences of the wheels' angles or, in messages without angles, their rates, with the steering between them.

    All joints come in one message. Angles that roll over are unwrapped both ways; an encoder that jumps otherwise (set
    to zero) is re-based, which ``rejections`` counts as wheels.encoder_reset.
    """

    kind = "ticks"
    events = JointsEvent
    _roll: float | None  # where positions roll over
    _roll_key: str  # setting of that
    _per_position = 1.0  # [rad]

    def __init__(self, config: WheelsConfig) -> None:
        """Start with nothing received."""
        super().__init__(config)
        self._without = 0  # messages without the wheels

    def _forget(self) -> None:
        self._angles: FloatArray | None = None
        self._rates: FloatArray | None = None
        self._steering: FloatArray | None = None
        self._moving: Moved | None = None  # the newest that is known

    def _take(self, event: JointsEvent) -> None:
        places = self._places(event.names)
        if places is None:
            return
        steering = self._steered(event)
        angles = _entries(event.position, places)
        rates = _entries(event.velocity, places) if self._config.in_radians else None
        if steering is None or (angles is None and rates is None):
            return self._lack_values()
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
            turned, roll = angles - self._angles, self._roll
            if roll is not None:
                if seconds > self._config.hold_s:  # nobody knows how often it rolled over
                    return None
                turned = np.array([math.remainder(turn, roll) for turn in turned.tolist()])
            moved = self._twist(turned / seconds * self._per_position, between, seconds, MAX_SPEED)
            if moved is not None:
                return moved
            self.rejections["wheels.encoder_reset"] += 1
            hint = f"; if the angle rolls over, set {self._roll_key}" if roll is None else ""
            by = " and ".join(f"{turn:.3g}" for turn in turned) + (" rad" if self._config.in_radians else "")
            self.notes["reset"] = (
                f"wheel angles jumped {self.rejections['wheels.encoder_reset']} time(s), the last by {by} in "
                f"{seconds:.3g} s: taken as a reset{hint}"
            )
        if rates is None or seconds > self._config.hold_s:
            return None
        return self._twist(rates if self._rates is None else 0.5 * (rates + self._rates), between)

    def _places(self, names: Sequence[str]) -> list[int] | None:
        """Indices of the driven joints; None if this message lacks one of the joints."""
        raise NotImplementedError

    def _steered(self, event: JointsEvent) -> FloatArray | None:
        """Angles [rad] of the steered joints; None if one is not known."""
        return np.empty(0)

    def _lack_values(self) -> None:
        """Note a message in which a joint has no value."""

    def _twist(
        self, rates: FloatArray, steering: FloatArray, seconds: float = math.inf, fastest: float = math.inf
    ) -> Moved | None:
        """Twist of joint rates [rad/s] and steering angles [rad]; None if no robot moves like this.

        Differences of angles may be those of an encoder that jumps: over ``seconds`` they make no more than
        ``fastest`` [m/s].
        """
        raise NotImplementedError


class TicksTrack(JointsTrack):
    """Two wheels, each with its radius, as the section `wheels` has them."""

    _roll_key = "expert.wheels.angle_range"

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
        self._roll = config.angle_range
        self._wheels: tuple[str, str] | None = None

    def _twist(
        self, rates: FloatArray, steering: FloatArray, seconds: float = math.inf, fastest: float = math.inf
    ) -> Moved | None:
        left, right = rates.tolist()
        left, right = self._left_radius * left, self._right_radius * right
        twist = 0.5 * (left + right), 0.0, (right - left) / self._width
        judged = math.isfinite(fastest)  # rates as reported are taken: in another unit they have to be seen
        return (twist, None) if not judged or self._possible(twist, seconds, fastest) else None

    def _places(self, names: Sequence[str]) -> list[int] | None:
        if self._wheels is None:
            self._wheels = wheel_names(names, self._config.left_joint, self._config.right_joint)
        if self._wheels is not None and {*self._wheels} <= {*names}:
            return [names.index(name) for name in self._wheels]
        self._without += 1
        if self._without == PATIENCE and self._last_ns is None:
            text = (
                f"{PATIENCE} messages of joint states, and none holds both wheels{self._configured(names)}; the last "
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
    wheels = by_side([name for name in names if "wheel" in name.lower()])
    for side, given, named in zip(("left", "right"), (left, right), wheels, strict=True):
        found = [given] if given else named
        if len(found) > 1:
            raise ConfigError(
                f"{len(found)} joints could be the {side} wheel ({', '.join(found)}); set wheels.{side}_joint"
            )
        pair += found
    return (pair[0], pair[1]) if len(pair) == 2 else None


class DriveTrack(JointsTrack):
    """The joints of `wheels.drive`. Rates of joints that count ticks are not used: their unit is no one's.

    ``rejections`` counts wheels.joints_incomplete too: messages in which one of the joints lacks its value.
    """

    _roll_key = "rolls_over"

    def __init__(self, config: WheelsConfig) -> None:
        """Start with nothing received."""
        assert config.drive is not None
        super().__init__(config)
        self._drive: Drive = config.drive
        self._roll = self._drive.rolls_over
        self._per_position = 1.0 if config.in_radians else math.tau / (self._drive.ticks_per_turn or 1.0)
        self._seen: set[str] = set()  # joints of messages without the wheels

    def _lack_values(self) -> None:
        self.rejections["wheels.joints_incomplete"] += 1
        self._wait(
            f"their values are incomplete: {', '.join(self._drive.driven)} need angles or rates, steering an angle. "
            "Correct wheels.drive"
        )

    def _twist(
        self, rates: FloatArray, steering: FloatArray, seconds: float = math.inf, fastest: float = math.inf
    ) -> Moved | None:
        try:
            twist, by, _ = self._drive.moves(rates.tolist(), steering.tolist())
        except np.linalg.LinAlgError:  # steered so far that the wheels do not determine a motion
            return None
        vx, vy, w = twist.tolist()
        return ((vx, vy, w), by) if self._possible((vx, vy, w), seconds, fastest) else None

    def _steered(self, event: JointsEvent) -> FloatArray | None:
        if not self._drive.steered:
            return np.empty(0)
        found = _entries(event.position, [event.names.index(name) for name in self._drive.steered])
        return None if found is None else np.array([self._drive.steering(value) for value in found.tolist()])

    def _places(self, names: Sequence[str]) -> list[int] | None:
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
