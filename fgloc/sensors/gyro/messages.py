"""ROS messages of an IMU as events."""

from __future__ import annotations

from typing import Any

from fgloc.sensors.base import When
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.sensors.messages import matrix, xyz
from fgloc.types import Event


def imu(m: Any, when: When) -> Event:
    """From ``sensor_msgs/Imu``."""
    return ImuEvent(
        *when,
        m.header.frame_id,
        xyz(m.angular_velocity),
        xyz(m.linear_acceleration),
        matrix(m.angular_velocity_covariance, 3),
    )
