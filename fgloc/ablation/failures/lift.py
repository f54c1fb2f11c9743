"""The robot is picked up and carried while the recording goes on: wheels in the air, hands that shake the IMU."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from fgloc import se2
from fgloc.ablation.failures.base import EVENTS, Failure, Scene, When
from fgloc.frames import quaternion_yaw, rpy_matrix, yaw_quaternion
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, Event, FloatArray

_BOUNCE_HZ, _BOUNCE_M_S2 = 1.9, 1.0  # vertical acceleration of what a walking person carries: amplitude
_SWAY_HZ, _SWAY_RAD = 0.7, 0.03  # of the hands, in roll and pitch
_TILT_RAD = 0.12  # largest tilt at which it is held


class Lift(Failure):
    """Inside each interval the robot is lifted, carried along the way that the recording drives, and set down.

    No time is cut out (`Kidnap` does that), and the truth stays: it is carried where it went, turning as it did.
    Wheels stand, or spin in the air at ``spin_m_s`` of their rims without load; commands are zero, or ask for that
    spinning. The IMU keeps its turning and its horizontal accelerations; added are the rise and descent by ``height_m``
    (minimum jerk, ``rise_s`` each), the bounce of a walking person, a tilt and the hands' sway. The IMU is taken to be
    level. Markers are hidden unless ``markers`` is "shown". Times are stamps, from the first message received.
    """

    kind: Literal["lift"] = "lift"
    when: When = When(bursts=1)
    wheels: Literal["still", "spin"] = "still"
    spin_m_s: float = Field(0.3, description="m/s, of the rims")
    markers: Literal["hidden", "shown"] = "hidden"
    height_m: float = Field(0.5, gt=0, description="m")
    rise_s: float = Field(1.0, gt=0, description="s")

    @model_validator(mode="after")
    def _bounded(self) -> Lift:
        if self.when.share != 1.0 or not (self.when.intervals or self.when.bursts):
            raise ValueError("lift needs a beginning and an end: give 'when' intervals or bursts, and no share")
        return self

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The events, in order of receipt."""
        spin = self.spin_m_s if self.wheels == "spin" else 0.0
        rate, held = _rate(scene, spin), dict[str, _Held]()
        hands = [_Hands(a, b, self, scene.rng) for a, b in self.when.schedule(scene).intervals]
        for event in events:
            t = (event.stamp_ns - scene.start_ns) * 1e-9
            hand = next((h for h in hands if h.start_s <= t < h.end_s), None)
            if isinstance(event, JointsEvent | OdometryEvent):
                topic = held.setdefault(event.topic, _Held(rate, spin))
                changed: Event | None = topic.tell(event, hand is not None)
            elif hand is None:
                changed = event
            elif isinstance(event, ImuEvent):
                changed = hand.shake(event, t)
            elif isinstance(event, ControlEvent):
                changed = replace(event, v=spin, omega=0.0)
            else:
                changed = None if self.markers == "hidden" and isinstance(event, EVENTS["camera"]) else event
            if changed is not event:
                self.touch(scene)
            if changed is not None:
                yield changed


def _rate(scene: Scene, spin: float) -> float:
    """Rate of the wheels [rad/s] at this speed of their rims [m/s].

    Raises:
        ValueError: the wheels spin and the configuration has no radius.
    """
    radii = [r for r in (scene.config.wheels.left_radius, scene.config.wheels.right_radius) if r is not None]
    if spin and not radii:
        raise ValueError("lift with wheels that spin needs wheels.left_radius and wheels.right_radius")
    return spin / float(np.mean(radii)) if radii else 0.0


class _Hands:
    """What the hands do to the IMU in one interval."""

    def __init__(self, start_s: float, end_s: float, lift: Lift, rng: np.random.Generator) -> None:
        self.start_s, self.end_s = start_s, end_s
        self._rise_s, self._height = min(lift.rise_s, 0.5 * (end_s - start_s)), lift.height_m
        self._tilt = rng.uniform(-_TILT_RAD, _TILT_RAD, 2)
        self._phase = rng.uniform(0.0, 2.0 * math.pi, 3)

    def shake(self, event: ImuEvent, t: float) -> ImuEvent:
        """The message with the hands' motion added."""
        s = min(t - self.start_s, self.end_s - t) / self._rise_s  # 0 on the floor, 1 up
        up, rate, rises = _minimum_jerk(s)
        sign = 1.0 if t - self.start_s < self.end_s - t else -1.0
        swing = 2.0 * math.pi * _SWAY_HZ
        angles = self._phase[:2] + swing * t
        tilt = up * (self._tilt + _SWAY_RAD * np.sin(angles))
        turning = up * _SWAY_RAD * swing * np.cos(angles)
        turning = turning + sign * rate / self._rise_s * (self._tilt + _SWAY_RAD * np.sin(angles))
        vertical = self._height * rises / self._rise_s**2
        vertical += up * _BOUNCE_M_S2 * math.sin(2.0 * math.pi * _BOUNCE_HZ * t + self._phase[2])
        R = rpy_matrix(tilt[0], tilt[1], 0.0)
        force = R.T @ (event.linear_acceleration + np.array([0.0, 0.0, vertical]))
        rates = R.T @ event.angular_velocity + np.array([turning[0], turning[1], 0.0])
        return replace(event, angular_velocity=rates, linear_acceleration=force)


def _minimum_jerk(s: float) -> tuple[float, float, float]:
    """Height and its first and second derivative on the way from 0 to 1 in unit time.

    Source: Flash, Hogan 1985, "The coordination of arm movements".
    """
    if s >= 1.0:
        return 1.0, 0.0, 0.0
    return (
        10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5,
        30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4,
        60.0 * s - 180.0 * s**2 + 120.0 * s**3,
    )


class _Held:
    """One topic of wheel angles or odometry: in the air it goes on from its last value, and afterwards from there."""

    def __init__(self, rate: float, speed: float) -> None:
        self._rate, self._speed = rate, speed  # rad/s, m/s in the air
        self._offset: FloatArray | None = None  # added to angles; T_told_recorded of poses
        self._last: FloatArray | None = None  # as told
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


def _pose(event: OdometryEvent) -> FloatArray:
    return np.array([event.position[0], event.position[1], quaternion_yaw(event.orientation)])
