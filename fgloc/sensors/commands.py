"""Control inputs: the commanded velocity. Wheels and learned motion read them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fgloc.config import Config, GateConfig
from fgloc.sensors.base import BuiltIn, EventInput, Stream, When
from fgloc.sensors.checks import Table, spikes
from fgloc.types import ControlEvent, Event, FloatArray

if TYPE_CHECKING:
    from fgloc.drives.base import Drive
    from fgloc.sensors.failures import Carriage


class CommandInput(EventInput):
    """Method that makes the events of commanded velocities."""

    def command(self, stamp_ns: int, v: float, omega: float) -> None:
        """Forward speed [m/s] and yaw rate [rad/s] that the robot was commanded."""
        self._deliver(ControlEvent(*self._when("command", stamp_ns), float(v), float(omega)))


def from_twist(message: Any, when: When) -> Event:
    """Event of a ``geometry_msgs/Twist``."""
    return ControlEvent(*when, float(message.linear.x), float(message.angular.z), float(message.linear.y))


def from_ackermann(message: Any, when: When) -> Event:
    """Event of an ``ackermann_msgs/AckermannDrive``: its yaw rate follows from `wheels.drive`."""
    return ControlEvent(*when, float(message.speed), 0.0, steering=float(message.steering_angle))


def told(event: ControlEvent, drive: Drive | None) -> ControlEvent:
    """The command as a twist: that of a drive which is told a steering angle, else as it is."""
    twist = None if drive is None or event.steering is None else drive.commanded(event.v, event.steering)
    return event if twist is None else replace(event, v=twist[0], vy=twist[1], omega=twist[2], steering=None)


def check(event: ControlEvent, gate: GateConfig) -> Event | str:
    """The event, or why it cannot be used: it has to be finite, and within the gate's bounds."""
    if not math.isfinite(event.v + event.omega + (event.steering or 0.0)):
        return "non_finite"
    if abs(event.v) > gate.max_speed:
        return "speed_bound"
    return "yaw_rate_bound" if abs(event.omega) > gate.max_yaw_rate else event


class CommandChecks:
    """Checks of a topic of commands against the gate's bounds."""

    def __init__(self) -> None:
        self._rows = Table(2)

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, ControlEvent)
        self._rows.add(event.v, event.omega)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each."""
        rows = np.abs(self._rows.array())
        found = spikes(topic, "yaw rate", "rad/s", rows[:, 1], config.gate.max_yaw_rate, seconds)
        found += spikes(topic, "speed", "m/s", rows[:, 0], config.gate.max_speed, seconds)
        if not rows.any():
            found.append(f"{topic}: all {len(rows)} commands are zero.")
        return found


def carried(carriage: Carriage) -> Callable[[Event], Event]:
    """Return the function that replaces commands while the robot is carried: to stand, or to spin the wheels."""

    def tell(event: Event) -> Event:
        assert isinstance(event, ControlEvent)
        return event if carriage.interval(event) is None else replace(event, v=carriage.spin_m_s, omega=0.0)

    return tell


COMMANDS = BuiltIn(
    name="command",
    streams=(
        Stream(
            "command",
            ControlEvent,
            {
                "geometry_msgs/msg/Twist": from_twist,
                "geometry_msgs/msg/TwistStamped": lambda m, when: from_twist(m.twist, when),
                "ackermann_msgs/msg/AckermannDrive": from_ackermann,
                "ackermann_msgs/msg/AckermannDriveStamped": lambda m, when: from_ackermann(m.drive, when),
            },
            ("cmd_vel", "ackermann_cmd", "drive"),
            check=check,
            findings=CommandChecks,
        ),
    ),
    carried=carried,
)
