"""Which IMU messages can be used, and what of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fgloc.sensors.field_checks import Changes, FieldChecks
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.types import Event

_MAX_ACCELERATION = 1e3  # m/s²


def imu(checks: FieldChecks) -> Callable[[ImuEvent], Event | str]:
    """Validator of IMU messages."""
    bounds = checks.config

    def validate(event: ImuEvent) -> Event | str:
        changes: Changes = {}
        cov = event.angular_velocity_cov
        if cov[0, 0] == -1.0:  # REP 145
            checks.note(f"{event.topic}: says that it has no gyroscope (its covariance starts with -1)")
            return "unavailable"
        wx, wy, wz = event.angular_velocity.tolist()
        if not math.isfinite(wx + wy + wz):
            return "non_finite"
        if max(abs(wx), abs(wy), abs(wz)) > bounds.max_yaw_rate:
            return "yaw_rate_bound"
        if reason := checks.covariance(
            event.topic, "angular velocity", cov, (0, 1, 2), "angular_velocity_cov", changes
        ):
            return reason
        ax, ay, az = event.linear_acceleration.tolist()
        if not abs(ax) + abs(ay) + abs(az) <= _MAX_ACCELERATION:  # also NaN
            checks.rejections["imu.acceleration"] += 1
            changes["linear_acceleration"] = np.full(3, np.nan)
        return replace(event, **changes) if changes else event

    return validate
