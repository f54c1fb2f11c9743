"""What motion models may read of the gyro."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fgloc.sensors.base import MotionRole
from fgloc.sensors.channels import Channel, Mounting
from fgloc.sensors.signals import Signal, of_stamps
from fgloc.types import InertialEvent


def _rate(events: Sequence[InertialEvent], origin_ns: int, mounting: Mounting) -> Signal | None:
    """Yaw rate [rad/s], its bias taken out."""
    if not events:
        return None
    rates = np.concatenate([e.angular_velocity for e in events]).reshape(-1, 3)
    rates = rates @ np.asarray(mounting.imu_up) - np.asarray(mounting.gyro_bias)
    return of_stamps([e.stamp_ns for e in events], rates[None], origin_ns)


CHANNELS = (Channel("gyro", 1, 0, InertialEvent, _rate, MotionRole.RATE),)
