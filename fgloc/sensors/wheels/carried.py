"""What wheels report of a robot that is carried: in the air, or across a piece of the recording that was cut out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fgloc import se2
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.sensors.failures import Carriage
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import Event, FloatArray


def carried(carriage: Carriage) -> Callable[[Event], Event]:
    """Wheels in the air stand or spin, and go on from there afterwards.

    Raises:
        ValueError: as `_rate`.
    """
    rate, held = _rate(carriage), dict[str, _Held]()

    def tell(event: Event) -> Event:
        assert isinstance(event, JointsEvent | OdometryEvent)
        topic = held.setdefault(event.topic, _Held(rate, carriage.spin_m_s))
        return topic.tell(event, carriage.interval(event) is not None)

    return tell


class JoinedWheels:
    """One topic of wheel angles or odometry poses without a jump at the cuts."""

    def __init__(self) -> None:
        self._shift = 0
        self._offset: FloatArray | None = None  # added to angles; T_told_recorded of poses
        self._last: FloatArray | None = None  # as reported

    def join(self, event: Event, shift: int) -> Event:
        """The event as if nothing had been cut out before it; ``shift`` is how much was [ns]."""
        assert isinstance(event, JointsEvent | OdometryEvent)
        angles = isinstance(event, JointsEvent)
        now = event.position if isinstance(event, JointsEvent) else _pose(event)
        carried, self._shift = shift != self._shift, shift
        if carried and self._last is not None and len(self._last) == len(now):
            self._offset = self._last - now if angles else se2.compose(self._last, se2.inverse(now))
        if self._offset is not None and len(self._offset) == len(now):
            now = now + self._offset if angles else se2.compose(self._offset, now)
            event = _told(event, now)
        self._last = now
        return event


def _pose(event: OdometryEvent) -> FloatArray:
    return np.array([event.position[0], event.position[1], quaternion_yaw(event.orientation)])


def _told(event: JointsEvent | OdometryEvent, now: FloatArray) -> JointsEvent | OdometryEvent:
    if isinstance(event, JointsEvent):
        return replace(event, position=now)
    position = np.array([now[0], now[1], event.position[2]])
    return replace(event, position=position, orientation=yaw_quaternion(float(now[2])))


def _rate(carriage: Carriage) -> float:
    """Rate of the wheels [rad/s] at this speed of their rims [m/s].

    Raises:
        ValueError: the wheels spin and the configuration has no radius.
    """
    spin, wheels = carriage.spin_m_s, carriage.scene.config.wheels
    radii = [r for r in (wheels.left_radius, wheels.right_radius) if r is not None]
    if spin and not radii:
        raise ValueError("lift with wheels that spin needs wheels.left_radius and wheels.right_radius")
    return spin / float(np.mean(radii)) if radii else 0.0


class _Held:
    """One topic of wheel angles or odometry: in the air it goes on from its last value, and afterwards from there."""

    def __init__(self, rate: float, speed: float) -> None:
        self._rate, self._speed = rate, speed  # rad/s, m/s in the air
        self._offset: FloatArray | None = None  # added to angles; T_told_recorded of poses
        self._last: FloatArray | None = None  # as reported
        self._last_ns = 0

    def tell(self, event: JointsEvent | OdometryEvent, lifted: bool) -> JointsEvent | OdometryEvent:
        """The event as the wheels in the air, or on the floor again, would make it."""
        angles = isinstance(event, JointsEvent)
        now = event.position if isinstance(event, JointsEvent) else _pose(event)
        dt = (event.stamp_ns - self._last_ns) * 1e-9
        if lifted and self._last is not None and len(self._last) == len(now):
            if angles:
                self._offset = self._last + self._rate * dt - now
            else:
                told = se2.compose(self._last, (self._speed * dt, 0.0, 0.0))
                self._offset = se2.compose(told, se2.inverse(now))
        if self._offset is not None and len(self._offset) == len(now):
            now = now + self._offset if angles else se2.compose(self._offset, now)
            event = self._told(event, now, lifted)
        self._last, self._last_ns = now, event.stamp_ns
        return event

    def _told(self, event: JointsEvent | OdometryEvent, now: FloatArray, lifted: bool) -> JointsEvent | OdometryEvent:
        if isinstance(event, JointsEvent):
            if not lifted:
                return replace(event, position=now)
            velocity = np.full_like(event.velocity, self._rate)
            return replace(event, position=now, velocity=velocity, effort=np.zeros_like(event.effort))
        position = np.array([now[0], now[1], event.position[2]])
        event = replace(event, position=position, orientation=yaw_quaternion(float(now[2])))
        if not lifted:
            return event
        return replace(event, linear=np.array([self._speed, 0.0, 0.0]), angular=np.zeros(3))
