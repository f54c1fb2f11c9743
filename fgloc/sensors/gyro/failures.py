"""Failures of an IMU."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from fgloc.sensors.failures import Change, EventFailure, Scene
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.types import Event


class ImuBias(EventFailure):
    """The gyroscope's yaw rate is off by ``yaw_rate`` and the accelerometer by ``acceleration``."""

    kind: Literal["imu_bias"] = "imu_bias"
    yaw_rate: float = Field(0.05, description="rad/s, about z")
    acceleration: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="m/s², in the sensor's axes")

    def targets(self) -> tuple[type[Event], ...]:
        """IMU messages."""
        return (ImuEvent,)

    def begin(self, scene: Scene) -> Change:
        """Add."""
        rates, accelerations = np.array([0.0, 0.0, self.yaw_rate]), np.array(self.acceleration)

        def bias(event: Event) -> Event:
            assert isinstance(event, ImuEvent)
            return replace(
                event,
                angular_velocity=event.angular_velocity + rates,
                linear_acceleration=event.linear_acceleration + accelerations,
            )

        return bias
