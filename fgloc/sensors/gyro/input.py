"""Rates and accelerations from plain numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fgloc.sensors.event_input import BASE, EventInput
from fgloc.sensors.gyro.events import ImuEvent


class GyroInput(EventInput):
    """What an IMU reports."""

    def imu(
        self,
        stamp_ns: int,
        angular_velocity: ArrayLike,
        linear_acceleration: ArrayLike = (0.0, 0.0, 0.0),
        frame_id: str = BASE,
    ) -> None:
        """Gyro rates ``(3,)`` [rad/s] and accelerations ``(3,)`` [m/s²] in the IMU's axes."""
        rates, accelerations = (np.asarray(a, dtype=float) for a in (angular_velocity, linear_acceleration))
        self._deliver(ImuEvent(*self._when("imu", stamp_ns), frame_id, rates, accelerations, np.zeros((3, 3))))
