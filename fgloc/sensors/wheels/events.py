"""Events of wheels: odometry and joint states, their messages, and the checks of which parts can be used."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from fgloc.config import Config
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.sensors.base import BASE, Converter, EventInput, When, matrix, vector, xyz, xyzw
from fgloc.sensors.checks import (
    EMPTIED,
    PLANAR,
    Changes,
    FieldChecks,
    Table,
    count,
    finite_rows,
    spikes,
    times,
    unit_length,
)
from fgloc.types import Event, FloatArray, MotionEvent, OdometerPose


@dataclass(frozen=True, slots=True, eq=False)
class PoseAndTwistEvent(MotionEvent):
    """Content of ``nav_msgs/Odometry``: pose of ``child_frame_id`` in ``frame_id`` and body twist."""

    frame_id: str
    child_frame_id: str
    position: FloatArray  # (3,) m
    orientation: FloatArray  # (4,) quaternion x, y, z, w
    pose_cov: FloatArray  # (6, 6) ROS order: translation, rotation
    linear: FloatArray  # (3,) m/s
    angular: FloatArray  # (3,) rad/s
    twist_cov: FloatArray  # (6, 6)

    @property
    def pose(self) -> FloatArray:
        """Planar part ``(3,)`` of the pose."""
        return np.array([self.position[0], self.position[1], quaternion_yaw(self.orientation)])

    def with_pose(self, pose: FloatArray) -> Self:
        """Copy with another planar pose ``(3,)``; the height stays."""
        position = np.array([pose[0], pose[1], self.position[2]])
        return replace(self, position=position, orientation=yaw_quaternion(float(pose[2])))


@dataclass(frozen=True, slots=True, eq=False)
class OdometryEvent(PoseAndTwistEvent):
    """``nav_msgs/Odometry`` of the wheels."""

    @property
    def base_frame_id(self) -> str:
        """The frame whose pose it is."""
        return self.child_frame_id

    @property
    def odometer(self) -> OdometerPose | None:
        """Planar part of the odometry."""
        return OdometerPose(self.frame_id, self.pose, np.array([*self.linear[:2], self.angular[2]]))


@dataclass(frozen=True, slots=True, eq=False)
class JointsEvent(MotionEvent):
    """``sensor_msgs/JointState``. An array that the message left empty has length 0."""

    names: tuple[str, ...]
    position: FloatArray  # (n,) rad
    velocity: FloatArray  # (n,) rad/s
    effort: FloatArray  # (n,) Nm

    @property
    def publisher(self) -> tuple[str, ...]:
        """Wheels and arm may share the topic: the joints tell them apart."""
        return self.names

    def of(self, joints: Sequence[str], what: Literal["position", "velocity", "effort"]) -> list[float]:
        """Values of some joints; NaN where the message does not hold the joint, or nothing of this kind."""
        values: list[float] = getattr(self, what).tolist()
        at = [self.names.index(name) if name in self.names else -1 for name in joints]
        return [values[i] if i >= 0 and len(values) == len(self.names) else math.nan for i in at]


NOT_GIVEN = np.full((6, 6), np.nan)
"""Covariance of a pose or a twist that a message does not have; its values are NaN, too."""


def odometry_converters(kind: type[PoseAndTwistEvent]) -> dict[str, Converter]:
    """Converters into one class of odometry events, by message type.

    Messages that have no pose, or no twist, have NaN for it.
    """

    def whole(m: Any, when: When) -> Event:
        pose, twist = (xyz(m.pose.pose.position), xyzw(m.pose.pose.orientation)), m.twist.twist
        covariances = matrix(m.pose.covariance, 6), matrix(m.twist.covariance, 6)
        frames = m.header.frame_id, m.child_frame_id
        return kind(*when, *frames, *pose, covariances[0], xyz(twist.linear), xyz(twist.angular), covariances[1])

    def twist_only(m: Any, twist: Any, covariance: FloatArray, when: When) -> Event:
        none = np.full(3, np.nan), np.full(4, np.nan), NOT_GIVEN
        return kind(*when, "", m.header.frame_id, *none, xyz(twist.linear), xyz(twist.angular), covariance)

    def pose_only(m: Any, pose: Any, covariance: FloatArray, when: When) -> Event:
        known = xyz(pose.position), xyzw(pose.orientation), covariance
        return kind(*when, m.header.frame_id, "", *known, np.full(3, np.nan), np.full(3, np.nan), NOT_GIVEN)

    def transform(m: Any, when: When) -> Event:
        known = xyz(m.transform.translation), xyzw(m.transform.rotation), none
        frames = m.header.frame_id, m.child_frame_id
        return kind(*when, *frames, *known, np.full(3, np.nan), np.full(3, np.nan), NOT_GIVEN)

    none = np.zeros((6, 6))
    return {
        "nav_msgs/msg/Odometry": whole,
        "geometry_msgs/msg/TwistWithCovarianceStamped": lambda m, when: twist_only(
            m, m.twist.twist, matrix(m.twist.covariance, 6), when
        ),
        "geometry_msgs/msg/TwistStamped": lambda m, when: twist_only(m, m.twist, none, when),
        "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m, when: pose_only(
            m, m.pose.pose, matrix(m.pose.covariance, 6), when
        ),
        "geometry_msgs/msg/PoseStamped": lambda m, when: pose_only(m, m.pose, none, when),
        "geometry_msgs/msg/TransformStamped": transform,
    }


def from_joints(m: Any, when: When) -> Event:
    """Event of a ``sensor_msgs/JointState``."""
    return JointsEvent(*when, tuple(m.name), vector(m.position), vector(m.velocity), vector(m.effort))


def from_ackermann(m: Any, when: When) -> Event:
    """Event of an ``ackermann_msgs/AckermannDrive`` that was measured: joints ``steering_angle`` and ``speed``."""
    nan = math.nan
    position, velocity = np.array([m.steering_angle, nan]), np.array([m.steering_angle_velocity, m.speed])
    return JointsEvent(*when, ("steering_angle", "speed"), position, velocity, np.empty(0))


_MAX_ANGLE = 1e15  # rad or ticks, of a joint: beyond it a double has no whole ticks
_MOST_JOINTS = 1000  # of a message: a humanoid with hands has a hundred
_TURNS, _IDLE = 0.5, 20  # rad/s, and so many messages: no joint turns for so long and stays at position 0
_NO_TWIST = dict(linear=np.full(3, np.nan), angular=np.full(3, np.nan), twist_cov=np.zeros((6, 6)))
_NO_POSE = dict(position=np.full(3, np.nan), orientation=np.full(4, np.nan), pose_cov=np.zeros((6, 6)))


_NOT_GIVEN = "not_given"


def _not_given(covariance: FloatArray, *values: FloatArray) -> bool:
    """Whether a message has no such part: everything of it is NaN."""
    return math.isnan(covariance[0, 0]) and all(np.isnan(part).all() for part in (covariance, *values))


def odometry_validator(checks: FieldChecks) -> Callable[[PoseAndTwistEvent], Event | str]:
    """Validator of odometry: pose and twist are judged apart."""
    bounds = checks.config

    def validate(event: PoseAndTwistEvent) -> Event | str:
        config = bounds
        changes: Changes = {}
        vx, vy, vz = event.linear.tolist()
        wx, wy, wz = event.angular.tolist()
        if _not_given(event.twist_cov, event.linear, event.angular):
            twist = _NOT_GIVEN
        elif not math.isfinite(vx + vy + vz + wx + wy + wz):
            twist = "non_finite"
        elif max(abs(vx), abs(vy), abs(vz)) > config.max_speed:
            twist = "speed_bound"
        elif max(abs(wx), abs(wy), abs(wz)) > config.max_yaw_rate:
            twist = "yaw_rate_bound"
        else:
            twist = checks.covariance(event.topic, "twist", event.twist_cov, PLANAR, "twist_cov", changes)
        x, y, z = event.position.tolist()
        if _not_given(event.pose_cov, event.position, event.orientation):
            pose = _NOT_GIVEN
        elif not math.isfinite(x + y + z):
            pose = "non_finite"
        elif max(abs(x), abs(y), abs(z)) > config.max_position:
            pose = "position_bound"
        else:
            pose = checks.quaternion(event.orientation, "orientation", changes) or checks.covariance(
                event.topic, "pose", event.pose_cov, PLANAR, "pose_cov", changes
            )
        if twist:
            changes |= _NO_TWIST
        if pose:
            changes |= _NO_POSE
        if twist == pose == _NOT_GIVEN:
            return "non_finite"
        for part, reason in (("twist", twist), ("pose", pose)):
            if reason and reason != _NOT_GIVEN:
                checks.rejections[f"odometry.{part}_{reason}"] += 1
        if twist and pose:
            return EMPTIED
        return replace(event, **changes) if changes else event

    return validate


def joints_validator(checks: FieldChecks) -> Callable[[JointsEvent], Event | str]:
    """Validator of joint states: entries are judged one by one."""
    bounds = checks.config
    measured: set[tuple[str, str, str]] = set()  # topic, joint and array of every value that was finite

    idle: dict[tuple[str, ...], FloatArray] = {}  # messages in a row whose joint turns at position 0, by their joints

    def turns_at_zero(event: JointsEvent) -> Any:
        """Joints that turn on and on at position 0: a driver's way to say that it measures rates alone."""
        at_zero = event.position == 0.0
        before = idle.get(event.names)
        if not at_zero.any():
            if before is not None:
                del idle[event.names]
            return at_zero
        count = np.where(at_zero, (0 if before is None else before) + (np.abs(event.velocity) > _TURNS), 0)
        if before is not None or len(idle) < _MOST_JOINTS:
            idle[event.names] = count
        return at_zero & (count >= _IDLE)

    def given(event: JointsEvent, name: str, i: int) -> bool:
        """Whether a NaN is a gap: of a joint that measures this at times, or nothing else now."""
        at_position = name == "position"
        other: FloatArray = event.velocity if at_position else event.position
        otherwise = len(other) == len(event.names) and abs(other[i]) <= (
            bounds.max_wheel_rate if at_position else _MAX_ANGLE
        )
        return not otherwise or (event.topic, event.names[i], name) in measured

    def validate(event: JointsEvent) -> Event | str:
        n = len(event.names)
        changes: Changes = {}
        usable = 0  # angles and rates
        for name, bound, wild in (
            ("position", _MAX_ANGLE, "position_bound"),
            ("velocity", bounds.max_wheel_rate, "wheel_rate_bound"),
            ("effort", math.inf, ""),
        ):
            array: FloatArray = getattr(event, name)
            values: list[float] = array.tolist()
            if not 0 < n <= _MOST_JOINTS or len(values) not in (0, n):
                return "length"
            good = [abs(value) <= bound and math.isfinite(value) for value in values]
            if name != "effort":
                usable += sum(good)
                if len(measured) < _MOST_JOINTS * 4:
                    measured.update((event.topic, event.names[i], name) for i in range(len(values)) if good[i])
            if all(good):
                continue
            if all(math.isnan(value) for value in values):  # a driver's way to say that it has none
                checks.note(f"{event.topic}: every {name} is NaN in some messages; taken as not given")
                changes[name] = np.empty(0)
            elif name != "effort" and not any(
                given(event, name, i) or not math.isnan(values[i]) for i in range(n) if not good[i]
            ):
                unknown = ", ".join(event.names[i] for i in range(n) if not good[i])
                checks.note(f"{event.topic}: the {name} of {unknown} is NaN; taken as not measured")
            else:
                finite = all(math.isfinite(value) for value in values)
                checks.rejections["joints." + (wild if finite else f"{name}_non_finite")] += 1
                changes[name] = np.where(good, array, np.nan)
        if not usable:
            return "non_finite"
        checked = replace(event, **changes) if changes else event
        if len(checked.position) != len(checked.velocity) or not (silent := turns_at_zero(checked)).any():
            return checked
        named = ", ".join(name for name, one in zip(event.names, silent, strict=True) if one)
        checks.note(f"{event.topic}: the position of {named} stays 0 while it turns; taken as not measured")
        return replace(checked, position=np.empty(0) if silent.all() else np.where(silent, np.nan, checked.position))

    return validate


_MOVED_M = 0.1  # a pose that moved further did move


class OdometryChecks:
    """Checks of a topic of odometry: pose, twist and covariances against each other and the gate's bounds."""

    def __init__(self) -> None:
        self._rows = Table(12)

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, PoseAndTwistEvent)
        self._rows.add(
            *event.position[:2],
            *event.orientation,
            *event.linear[:2],
            event.angular[2],
            float(np.abs(event.pose_cov).max()),
            float(np.abs(event.twist_cov).max()),
            event.stamp_ns * 1e-9,
        )

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each."""
        rows = self._rows.array()
        found = []
        posed, moved = (not np.isnan(rows[:, column]).all() for column in (9, 10))  # whether messages have the part
        finite = finite_rows(rows[:, (0 if posed else 6) : (9 if moved else 6)])
        if not finite.all():
            found.append(f"{topic}: {count(~finite)} hold NaN or infinity and will be rejected.")
        if posed:
            found += unit_length(topic, rows[finite, 2:6])
        zero = [name for name, column in (("pose", 9), ("twist", 10)) if not rows[:, column].any()]
        if zero:
            found.append(f"{topic}: the covariance of {' and '.join(zero)} is all zero; the configured noise is used.")
        if finite.sum() > 1:
            found += self._motion(topic, rows[finite], seconds[finite], config)
        return found

    @staticmethod
    def _motion(topic: str, rows: FloatArray, seconds: FloatArray, config: Config) -> list[str]:
        x, y, qx, qy, qz, qw = rows[:, :6].T
        speed, rate = np.hypot(rows[:, 6], rows[:, 7]), np.abs(rows[:, 8])
        found = spikes(topic, "yaw rate", "rad/s", rate, config.gate.max_yaw_rate, seconds)
        found += spikes(topic, "speed", "m/s", speed, config.gate.max_speed, seconds)
        dt = np.maximum(np.diff(seconds), 0.0)
        if np.isnan(x).all():
            steps, turns = speed[:-1] * dt, rate[:-1] * dt
        else:
            steps = np.hypot(np.diff(x), np.diff(y))
            turns = np.abs(np.diff(np.unwrap(np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)))))
        jumped = steps > config.gate.max_speed * dt + 0.5
        if jumped.any():
            at = int(np.argmax(np.where(jumped, steps, 0)))
            found.append(
                f"{topic}: the pose jumps {times(int(jumped.sum()))}, by up to {steps[at]:.3g} m "
                f"at {seconds[at + 1]:.1f} s: reset, or another robot."
            )
        whole = ~jumped & (dt <= config.gate.gap_s)  # what happened in a gap only the pose can know
        path, turned = float(steps[whole].sum()), float(turns[whole].sum())
        has_twist = not np.isnan(speed).all()
        if has_twist and path > _MOVED_M and not speed.any() and not rate.any():
            found.append(
                f"{topic}: the twist is always zero while the pose moves {path:.1f} m; "
                "motion is taken from the pose (wheels.source: pose)."
            )
            return found
        sane = (rate[:-1] <= config.gate.max_yaw_rate) & whole
        for name, unit, by_twist, by_pose, least in (
            ("speed", "m", float((speed[:-1] * dt)[whole].sum()), path, 1.0),
            ("yaw rate", "rad", float((rate[:-1] * dt)[sane].sum()), float(turns[sane].sum()), 1.0),
        ):
            if has_twist and by_pose > least and not 0.7 < by_twist / by_pose < 1.4:
                degrees = " (degrees for radians?)" if unit == "rad" and 40 < by_twist / by_pose < 75 else ""
                found.append(
                    f"{topic}: the twist's {name} adds up to {by_twist:.1f} {unit}, the pose's to {by_pose:.1f} {unit}"
                    f"{degrees}."
                )
        if path <= _MOVED_M and turned <= _MOVED_M:
            found.append(f"{topic}: the robot does not move ({path:.2f} m, {turned:.2f} rad).")
        return found


def planar(pose: Sequence[float] | None, twist: Sequence[float] | None) -> tuple[FloatArray, ...]:
    """Fields of a `PoseAndTwistEvent` from its position on, by planar pose and twist ``(3,)``; None: it has none."""
    unknown = np.full(3, np.nan)
    x, y, yaw = unknown if pose is None else np.asarray(pose, dtype=float)
    vx, vy, w = unknown if twist is None else np.asarray(twist, dtype=float)
    orientation = np.full(4, np.nan) if np.isnan(yaw) else yaw_quaternion(float(yaw))
    pose_cov, twist_cov = (NOT_GIVEN if part is None else np.zeros((6, 6)) for part in (pose, twist))
    return np.array([x, y, 0.0]), orientation, pose_cov, np.array([vx, vy, 0.0]), np.array([0.0, 0.0, w]), twist_cov


class WheelsInput(EventInput):
    """Methods that make the events of wheels: odometry and joint states."""

    def odometry(
        self,
        stamp_ns: int,
        pose: Sequence[float] | None = None,
        twist: Sequence[float] | None = None,
        frame_id: str = "odom",
    ) -> None:
        """Wheel odometry.

        Args:
            stamp_ns: when it was measured.
            pose: x, y [m], yaw [rad] in the odometry's own frame; None: it has none.
            twist: forward, left [m/s], yaw rate [rad/s] of the base; None: it has none.
            frame_id: of the pose.
        """
        self._deliver(OdometryEvent(*self._when("odometry", stamp_ns), frame_id, BASE, *planar(pose, twist)))

    def joints(
        self,
        stamp_ns: int,
        names: Sequence[str],
        position: ArrayLike = (),
        velocity: ArrayLike = (),
        effort: ArrayLike = (),
    ) -> None:
        """Joint states: angles [rad], rates [rad/s] and torques [Nm] by joint; what is not measured is left out."""
        arrays = (np.asarray(a, dtype=float) for a in (position, velocity, effort))
        self._deliver(JointsEvent(*self._when("joints", stamp_ns), tuple(names), *arrays))
