"""What an IMU reports."""

from __future__ import annotations

from dataclasses import dataclass

from fgloc.types import FloatArray, InertialEvent


@dataclass(frozen=True, slots=True, eq=False)
class ImuEvent(InertialEvent):
    """``sensor_msgs/Imu``."""

    angular_velocity_cov: FloatArray  # (3, 3)
