"""The gyro as a sensor: its topic, settings and failures."""

from __future__ import annotations

from fgloc.sensors.base import BuiltIn, Stream
from fgloc.sensors.gyro import messages, validation
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.sensors.gyro.findings import ImuChecks

GYRO = BuiltIn(
    name="gyro",
    streams=(
        Stream(
            "imu",
            ImuEvent,
            {"sensor_msgs/msg/Imu": messages.imu},
            ("imu", "imu/data"),
            validator=validation.imu,
            findings=ImuChecks,
        ),
    ),
)
