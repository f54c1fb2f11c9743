"""Failures of wheels, odometry and encoders, and what they measure while the robot is carried."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from fgloc import se2
from fgloc.config import WheelsConfig
from fgloc.sensors.failures import Carriage, EventFailure, Failure, Scene
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent, PoseAndTwistEvent
from fgloc.sensors.wheels.naming import by_side
from fgloc.types import Event, FloatArray


@dataclass(frozen=True, slots=True)
class Roll:
    """Motion of the wheels by one source up to one message."""

    source: str  # a topic's positions or rates: each is corrupted with a memory of its own
    speeds: FloatArray  # (2,) left, right: surface speeds [m/s]
    dt: float  # s since the message before
    seconds: float  # s since the recording's first message
    phase: float  # 0 to 1 through the active interval; 0 if it has no end


Distort = Callable[[Roll], FloatArray]


class WheelFailure(Failure):
    """A failure of the wheels' surface speeds, reported alike by odometry (twist and pose) and to joints.

    Odometry is split to wheels by the configured track, else by ``track_m``; joints are changed only where the
    configuration gives the wheels' radii. What was wrongly counted stays counted when the failure is over.
    """

    track_m: float = Field(0.3, gt=0, description="m, where the configuration gives none")

    @abstractmethod
    def distort(self, scene: Scene) -> Distort:
        """Return the function that changes the reported speeds of the wheels, with the state of one run."""

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The corrupted events, in order of receive time."""
        schedule, distort = self.when.schedule(scene), self.distort(scene)
        wheels = scene.config.wheels
        track = wheels.track or self.track_m
        odometers: dict[str, _Odometer] = {}
        encoders: dict[str, _Encoders] = {}
        for event in events:
            if not isinstance(event, OdometryEvent | JointsEvent):
                yield event
                continue
            interval = schedule.inside(event)
            active = schedule.hits(event)
            seconds = scene.seconds(event)
            phase = 0.0
            if interval is not None and math.isfinite(interval[1] - interval[0]):
                phase = (seconds - interval[0]) / (interval[1] - interval[0])

            def corrupt(
                source: str,
                speeds: FloatArray,
                dt: float,
                active: bool = active,
                seconds: float = seconds,
                phase: float = phase,
            ) -> FloatArray:
                return distort(Roll(source, speeds, dt, seconds, phase)) if active else speeds

            changed: Event
            if isinstance(event, OdometryEvent):
                changed = odometers.setdefault(event.topic, _Odometer(track)).rewrite(event, corrupt)
            else:
                changed = encoders.setdefault(event.topic, _Encoders(wheels)).rewrite(event, corrupt)
            if changed is not event and active:
                self.touch(scene)
            yield changed


class WheelSlip(WheelFailure):
    """The wheels turn more than the robot moves: an added motion of a stated profile.

    Added are a forward ``speed`` and a ``yaw_rate``, both times the profile, and ``share`` of what the wheels report.
    """

    sizes: ClassVar[tuple[str, ...]] = ("speed", "yaw_rate", "share")
    kind: Literal["wheel_slip"] = "wheel_slip"
    speed: float = Field(0.0, description="m/s, forward")
    yaw_rate: float = Field(0.0, description="rad/s, counter-clockwise")
    share: float = Field(0.0, ge=-1, description="of the reported speeds; -0.5: the robot is pushed at double speed")
    profile: Literal["step", "ramp", "pulse"] = Field(
        "step", description="1 throughout; 0 to 1 over the interval; half a sine over the interval"
    )

    def distort(self, scene: Scene) -> Distort:
        """Return the function that adds the motion to the wheels' speeds."""
        half = 0.5 * (scene.config.wheels.track or self.track_m)
        added = np.array([self.speed - half * self.yaw_rate, self.speed + half * self.yaw_rate])
        shapes: dict[str, Callable[[float], float]] = {
            "step": lambda phase: 1.0,
            "ramp": lambda phase: phase,
            "pulse": lambda phase: math.sin(math.pi * phase),
        }
        shape = shapes[self.profile]
        return lambda roll: np.asarray(roll.speeds + shape(roll.phase) * (added + self.share * roll.speeds))


class EncoderDead(WheelFailure):
    """The encoder of one wheel, or of both, counts nothing: the wheel seems to stand still."""

    kind: Literal["encoder_dead"] = "encoder_dead"
    wheel: Literal["left", "right", "both"] = "both"

    def distort(self, scene: Scene) -> Distort:
        """Return the function that sets the speed of the dead encoders to zero."""
        alive = {"left": [0.0, 1.0], "right": [1.0, 0.0], "both": [0.0, 0.0]}[self.wheel]
        return lambda roll: np.asarray(roll.speeds * alive)


class EncoderQuantized(WheelFailure):
    """Wheels are counted in whole ticks of ``tick_m`` of the wheel's surface; what is left over counts later."""

    sizes: ClassVar[tuple[str, ...]] = ("tick_m",)
    kind: Literal["encoder_quantized"] = "encoder_quantized"
    tick_m: float = Field(0.01, gt=0, description="m")

    def distort(self, scene: Scene) -> Distort:
        """Return the function that rounds the distance since the start down to whole ticks."""
        totals: dict[str, FloatArray] = {}
        ticks: dict[str, FloatArray] = {}

        def quantize(roll: Roll) -> FloatArray:
            total = totals.get(roll.source, np.zeros(2)) + roll.speeds * roll.dt
            whole = np.floor(total / self.tick_m + 1e-9)
            new = whole - ticks.get(roll.source, np.zeros(2))
            totals[roll.source], ticks[roll.source] = total, whole
            return np.asarray(new * self.tick_m / roll.dt)

        return quantize


class WheelScaleDrift(WheelFailure):
    """The wheels seem to grow: reported speeds change by these shares per minute since the recording's start."""

    sizes: ClassVar[tuple[str, ...]] = ("left_per_min", "right_per_min")
    kind: Literal["wheel_scale_drift"] = "wheel_scale_drift"
    left_per_min: float = Field(0.01, description="share per minute")
    right_per_min: float = Field(0.01, description="share per minute")

    def distort(self, scene: Scene) -> Distort:
        """Return the function that scales the speeds by the time since the recording's start."""
        rate = np.array([self.left_per_min, self.right_per_min])
        return lambda roll: np.asarray(roll.speeds * (1.0 + rate * roll.seconds / 60.0))


Corrupt = Callable[[str, FloatArray, float], FloatArray]


class _Odometer:
    """Rewrites one odometry topic: its twist, and its pose from the corrupted increments."""

    def __init__(self, track: float) -> None:
        self._track = track
        self._before: tuple[int, FloatArray] | None = None  # stamp and pose as recorded
        self._reported: FloatArray | None = None  # pose as reported; None while it is the recorded one

    def rewrite(self, event: OdometryEvent, corrupt: Corrupt) -> OdometryEvent:
        pose = event.pose
        before, self._before = self._before, (event.stamp_ns, pose)
        dt = 0.0 if before is None else (event.stamp_ns - before[0]) * 1e-9
        if before is None or dt <= 0.0:
            return event if self._reported is None else event.with_pose(self._reported)
        twist = np.array([event.linear[0], event.angular[2]])
        corrupted = self._of_wheels(f"{event.topic} rates", twist, dt, corrupt)
        changed = event
        if not np.array_equal(corrupted, twist, equal_nan=True):
            linear, angular = event.linear.copy(), event.angular.copy()
            linear[0], angular[2] = corrupted
            changed = replace(event, linear=linear, angular=angular)
        moved = se2.log(se2.between(before[1], pose))
        rates = np.array([moved[0], moved[2]]) / dt
        reported = self._of_wheels(f"{event.topic} positions", rates, dt, corrupt)
        if self._reported is None and np.array_equal(reported, rates, equal_nan=True):
            return changed
        start = before[1] if self._reported is None else self._reported
        self._reported = se2.compose(start, se2.exp((reported[0] * dt, moved[1], reported[1] * dt)))
        return changed.with_pose(self._reported)

    def _of_wheels(self, source: str, rates: FloatArray, dt: float, corrupt: Corrupt) -> FloatArray:
        """Forward speed and yaw rate ``(2,)`` by way of the wheels."""
        v, omega = rates
        half = 0.5 * self._track
        speeds = np.array([v - half * omega, v + half * omega])
        left_right = corrupt(source, speeds, dt)
        if left_right is speeds:
            return rates
        left, right = left_right
        return np.array([0.5 * (left + right), (right - left) / self._track])


class _Encoders:
    """Rewrites one topic of joint states: the angles and rates of the two wheels."""

    def __init__(self, wheels: WheelsConfig) -> None:
        radii = (wheels.left_radius, wheels.right_radius)
        self._radii = None if None in radii else np.array(radii, dtype=float)
        self._wanted = (wheels.left_joint, wheels.right_joint)
        self._before: tuple[int, FloatArray] | None = None  # stamp and angles as recorded
        self._offset = np.zeros(2)  # reported minus recorded angles

    def rewrite(self, event: JointsEvent, corrupt: Corrupt) -> JointsEvent:
        pair = self._indices(event)
        if self._radii is None or pair is None:
            return event
        radii, changed = self._radii, event
        angles = event.position[pair] if len(event.position) else np.zeros(2)
        before, self._before = self._before, (event.stamp_ns, angles)
        dt = 0.0 if before is None else (event.stamp_ns - before[0]) * 1e-9
        if before is not None and dt > 0.0:
            speeds = (angles - before[1]) / dt * radii
            if len(event.position):
                reported = corrupt(f"{event.topic} positions", speeds, dt)
                if reported is not speeds:
                    self._offset = self._offset + (reported - speeds) * dt / radii
            if len(event.velocity):
                rates = event.velocity[pair] * radii
                reported = corrupt(f"{event.topic} rates", rates, dt)
                if reported is not rates:
                    velocity = event.velocity.copy()
                    velocity[pair] = reported / radii
                    changed = replace(changed, velocity=velocity)
        if len(event.position) and self._offset.any():
            position = event.position.copy()
            position[pair] += self._offset
            changed = replace(changed, position=position)
        return changed

    def _indices(self, event: JointsEvent) -> list[int] | None:
        """Places of the left and of the right wheel in the message; None if it does not hold both."""
        sides = zip(self._wanted, by_side(event.names), strict=True)
        pair = [given or next(iter(named), "") for given, named in sides]
        return [event.names.index(name) for name in pair] if {*pair} <= {*event.names} else None


class EncoderFrozen(Failure):
    """Odometry and wheel angles go on with new stamps but repeat their last values; then they jump to the present.

    Joint efforts, which motor drivers measure, go on as they are.
    """

    kind: Literal["encoder_frozen"] = "encoder_frozen"

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The corrupted events, in order of receive time."""
        schedule = self.when.schedule(scene)
        last: dict[str, Event] = {}
        for event in events:
            if not isinstance(event, (OdometryEvent, JointsEvent)):
                yield event
            elif schedule.hits(event) and event.topic in last:
                self.touch(scene)
                frozen = replace(last[event.topic], stamp_ns=event.stamp_ns, received_ns=event.received_ns)
                if isinstance(frozen, JointsEvent) and isinstance(event, JointsEvent):
                    frozen = replace(frozen, names=event.names, effort=event.effort)
                yield frozen
            else:
                last[event.topic] = event
                yield event


class EncoderRollover(EventFailure):
    """Joint angles are counted modulo ``range_rad``: they fall back to 0 when they reach it."""

    changes: ClassVar[tuple[type[Event], ...]] = (JointsEvent,)
    kind: Literal["encoder_rollover"] = "encoder_rollover"
    range_rad: float = Field(6.283185307179586, gt=0, description="rad")

    def change(self, event: JointsEvent, scene: Scene) -> Event:
        """Wrap the angles."""
        return replace(event, position=np.mod(event.position, self.range_rad))


class OdometryReset(Failure):
    """At the start of each interval odometry and wheel angles begin again at zero; after it they jump back."""

    kind: Literal["odometry_reset"] = "odometry_reset"

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The corrupted events, in order of receive time."""
        schedule = self.when.schedule(scene)
        origins: dict[tuple[str, float], FloatArray] = {}
        for event in events:
            interval = schedule.inside(event)
            if interval is None or not isinstance(event, OdometryEvent | JointsEvent) or not schedule.hits(event):
                yield event
                continue
            self.touch(scene)
            key = (event.topic, interval[0])
            if isinstance(event, JointsEvent):
                origin = origins.setdefault(key, event.position)
                same = len(origin) == len(event.position)
                yield replace(event, position=event.position - origin) if same else event
                continue
            pose = event.pose
            yield event.with_pose(se2.between(origins.setdefault(key, pose), pose))


class WheelNan(EventFailure):
    """Odometry's pose and twist, joints' angles and rates are not a number."""

    changes: ClassVar[tuple[type[Event], ...]] = (OdometryEvent, JointsEvent)
    kind: Literal["wheel_nan"] = "wheel_nan"

    def change(self, event: OdometryEvent | JointsEvent, scene: Scene) -> Event:
        """Fill pose and twist, angles and rates with NaN."""
        pose = ("position", "orientation", "linear", "angular")
        names = pose if isinstance(event, OdometryEvent) else ("position", "velocity")
        filled: dict[str, Any] = {name: np.full_like(getattr(event, name), np.nan) for name in names}
        return replace(event, **filled)


class WrongCovariance(EventFailure):
    """Odometry's covariances are ``factor`` times what they were: 0 is unknown, a negative one invalid."""

    changes: ClassVar[tuple[type[Event], ...]] = (OdometryEvent,)
    kind: Literal["wrong_covariance"] = "wrong_covariance"
    factor: float = Field(0.01, description="of variances")

    def change(self, event: OdometryEvent, scene: Scene) -> Event:
        """Multiply the covariances."""
        return replace(event, pose_cov=event.pose_cov * self.factor, twist_cov=event.twist_cov * self.factor)


def carried(carriage: Carriage) -> Callable[[Event], Event]:
    """Return the function that lets wheels in the air stand or spin, and continues from there on the floor.

    Raises:
        ValueError: as `_rate`.
    """
    rate, held = _rate(carriage), dict[str, _Held]()

    def tell(event: Event) -> Event:
        assert isinstance(event, JointsEvent | OdometryEvent)
        topic = held.setdefault(event.topic, _Held(rate, carriage.spin_m_s))
        return topic.tell(event, carriage.interval(event) is not None)

    return tell


class _Continued:
    """One topic of wheel angles or odometry poses, which goes on from other values than those recorded."""

    def __init__(self) -> None:
        self._offset: FloatArray | None = None  # added to angles; T_told_recorded of poses
        self._last: FloatArray | None = None  # as reported

    def _told(
        self, event: JointsEvent | PoseAndTwistEvent, expected: FloatArray | None
    ) -> JointsEvent | PoseAndTwistEvent:
        """Event with the present offset, or with that by which it has the expected angles or pose; the event: none."""
        angles = isinstance(event, JointsEvent)
        now = event.position if isinstance(event, JointsEvent) else event.pose
        if expected is not None and len(expected) == len(now):
            self._offset = expected - now if angles else se2.compose(expected, se2.inverse(now))
        if self._offset is not None and len(self._offset) == len(now):
            now = now + self._offset if angles else se2.compose(self._offset, now)
            event = replace(event, position=now) if isinstance(event, JointsEvent) else event.with_pose(now)
        self._last = now
        return event


class JoinedWheels(_Continued):
    """One topic of wheel angles or odometry poses without a jump at the cuts."""

    def __init__(self) -> None:
        super().__init__()
        self._shift = 0

    def __call__(self, event: Event, shift: int) -> Event:
        """Event as if nothing had been cut out before it; ``shift`` is the length of what was cut out [ns]."""
        assert isinstance(event, JointsEvent | PoseAndTwistEvent)
        cut, self._shift = shift != self._shift, shift
        return self._told(event, self._last if cut else None)


def _rate(carriage: Carriage) -> float:
    """Rate of the wheels [rad/s] in the air, from the speed of their rims.

    Raises:
        ValueError: the wheels spin and the configuration has no radius.
    """
    spin, wheels = carriage.spin_m_s, carriage.scene.config.wheels
    radii = [r for r in (wheels.left_radius, wheels.right_radius) if r is not None]
    if spin and not radii:
        raise ValueError("lift with wheels that spin needs wheels.left_radius and wheels.right_radius")
    return spin / float(np.mean(radii)) if radii else 0.0


class _Held(_Continued):
    """One topic of wheel angles or odometry: in the air it goes on from its last value, and afterwards from there."""

    def __init__(self, rate: float, speed: float) -> None:
        super().__init__()
        self._rate, self._speed = rate, speed  # rad/s, m/s in the air
        self._last_ns = 0

    def tell(self, event: JointsEvent | PoseAndTwistEvent, lifted: bool) -> JointsEvent | PoseAndTwistEvent:
        """Event as the wheels in the air, or on the floor again, would report it."""
        dt = (event.stamp_ns - self._last_ns) * 1e-9
        expected = None
        if lifted and self._last is not None:
            way = (self._speed * dt, 0.0, 0.0)
            angles = isinstance(event, JointsEvent)
            expected = self._last + self._rate * dt if angles else se2.compose(self._last, way)
        told = self._told(event, expected)
        self._last_ns = event.stamp_ns
        if not lifted or told is event:
            return told
        if isinstance(told, JointsEvent):
            velocity = np.full_like(told.velocity, self._rate)
            return replace(told, velocity=velocity, effort=np.zeros_like(told.effort))
        return replace(told, linear=np.array([self._speed, 0.0, 0.0]), angular=np.zeros(3))
