"""What looks wrong with the IMU of a recording."""

from __future__ import annotations

import numpy as np

from fgloc.config import Config
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.sensors.topic_checks import Table, count, finite_rows, spikes
from fgloc.types import Event, FloatArray


class ImuChecks:
    """Gyro and accelerometer for plausibility."""

    def __init__(self) -> None:
        self._rows = Table(6)

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, ImuEvent)
        self._rows.add(*event.angular_velocity, *event.linear_acceleration)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        rows = self._rows.array()
        found = []
        finite = finite_rows(rows)
        if not finite.all():
            found.append(f"{topic}: {count(~finite)} hold NaN or infinity and will be rejected.")
        found += spikes(topic, "yaw rate", "rad/s", np.abs(rows[:, 2]), config.gate.max_yaw_rate, seconds)
        if not rows[:, :3].any():
            found.append(f"{topic}: the gyro is always zero.")
        gravity = float(np.median(np.linalg.norm(rows[finite, 3:], axis=1))) if finite.any() else 0.0
        if 0.0 < gravity < 8.8 or gravity > 10.8:
            hint = " (unit g?)" if 0.9 < gravity < 1.1 else ""
            found.append(f"{topic}: the acceleration's median is {gravity:.2f} m/s², expected about 9.81{hint}.")
        return found
