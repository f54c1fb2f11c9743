"""What motion models may read of the gyro."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fgloc.sensors.base import MotionRole
from fgloc.sensors.channels import Channel, Mounting
from fgloc.sensors.signals import Signal, of_stamps
from fgloc.types import InertialEvent

_GRAVITY = 9.81  # m/s²


def _rate(events: Sequence[InertialEvent], origin_ns: int, mounting: Mounting) -> Signal | None:
    """Yaw rate [rad/s], its bias taken out."""
    if not events:
        return None
    rates = np.concatenate([e.angular_velocity for e in events]).reshape(-1, 3)
    rates = rates @ np.asarray(mounting.imu_up) - np.asarray(mounting.gyro_bias)
    return of_stamps([e.stamp_ns for e in events], rates[None], origin_ns)


def _gravity(events: Sequence[InertialEvent], origin_ns: int, mounting: Mounting) -> Signal | None:
    """Specific force along the robot's x and y over that of gravity: on a slope what pulls the robot, sign reversed.

    The IMU's x axis is taken to lie in the plane of the robot's x and z.
    """
    forces = np.array([e.linear_acceleration for e in events]).reshape(-1, 3)
    known = np.isfinite(forces).all(axis=1) & (np.abs(forces).sum(axis=1) > 0.0)
    if not known.any():
        return None
    up = np.asarray(mounting.imu_up) / np.linalg.norm(mounting.imu_up)
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    pulls = forces[known] @ np.array([ahead, np.cross(up, ahead)]).T / _GRAVITY
    return of_stamps([e.stamp_ns for e, there in zip(events, known, strict=True) if there], pulls.T, origin_ns)


CHANNELS = (
    Channel("gyro", 1, 0, InertialEvent, _rate, MotionRole.RATE),
    Channel("gravity", 2, 3, InertialEvent, _gravity),
)
