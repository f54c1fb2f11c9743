"""Which odometry messages and joint states can be used, and what of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fgloc.sensors.field_checks import EMPTIED, PLANAR, Changes, FieldChecks
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import Event, FloatArray

_MAX_ANGLE = 1e9  # rad, of a joint
_NO_TWIST = dict(linear=np.full(3, np.nan), angular=np.full(3, np.nan), twist_cov=np.zeros((6, 6)))
_NO_POSE = dict(position=np.full(3, np.nan), orientation=np.full(4, np.nan), pose_cov=np.zeros((6, 6)))


def odometry(checks: FieldChecks) -> Callable[[OdometryEvent], Event | str]:
    """Validator of odometry: pose and twist are judged apart."""
    bounds = checks.config

    def validate(event: OdometryEvent) -> Event | str:
        config = bounds
        changes: Changes = {}
        vx, vy, vz = event.linear.tolist()
        wx, wy, wz = event.angular.tolist()
        if not math.isfinite(vx + vy + vz + wx + wy + wz):
            twist = "non_finite"
        elif max(abs(vx), abs(vy), abs(vz)) > config.max_speed:
            twist = "speed_bound"
        elif max(abs(wx), abs(wy), abs(wz)) > config.max_yaw_rate:
            twist = "yaw_rate_bound"
        else:
            twist = checks.covariance(event.topic, "twist", event.twist_cov, PLANAR, "twist_cov", changes)
        x, y, z = event.position.tolist()
        if not math.isfinite(x + y + z):
            pose = "non_finite"
        elif max(abs(x), abs(y), abs(z)) > config.max_position:
            pose = "position_bound"
        else:
            pose = checks.quaternion(event.orientation, "orientation", changes) or checks.covariance(
                event.topic, "pose", event.pose_cov, PLANAR, "pose_cov", changes
            )
        if twist:
            checks.rejections[f"odometry.twist_{twist}"] += 1
            changes |= _NO_TWIST
        if pose:
            checks.rejections[f"odometry.pose_{pose}"] += 1
            changes |= _NO_POSE
        if twist and pose:
            return EMPTIED
        return replace(event, **changes) if changes else event

    return validate


def joints(checks: FieldChecks) -> Callable[[JointsEvent], Event | str]:
    """Validator of joint states: entries are judged one by one."""
    bounds = checks.config

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
            if n == 0 or len(values) not in (0, n):
                return "length"
            good = [abs(value) <= bound and math.isfinite(value) for value in values]
            if name != "effort":
                usable += sum(good)
            if all(good):
                continue
            if all(math.isnan(value) for value in values):  # a driver's way to say that it has none
                checks.note(f"{event.topic}: every {name} is NaN in some messages; taken as not given")
                changes[name] = np.empty(0)
            else:
                finite = all(math.isfinite(value) for value in values)
                checks.rejections["joints." + (wild if finite else f"{name}_non_finite")] += 1
                changes[name] = np.where(good, array, np.nan)
        if not usable:
            return "non_finite"
        return replace(event, **changes) if changes else event

    return validate
