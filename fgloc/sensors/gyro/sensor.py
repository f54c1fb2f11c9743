"""The gyro as a sensor: its topic, settings and failures."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from fgloc.sensors.base import BuiltIn, Stream
from fgloc.sensors.gyro import messages, validation
from fgloc.sensors.gyro.channels import CHANNELS
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.sensors.gyro.findings import ImuChecks
from fgloc.sensors.gyro.role import ROLE
from fgloc.types import Event

if TYPE_CHECKING:
    from fgloc.config import Section
    from fgloc.sensors.failures import Carriage


def _failures() -> tuple[type[Section], ...]:
    from fgloc.sensors.gyro.failures import ImuBias

    return (ImuBias,)


def _carried(carriage: Carriage) -> Callable[[Event], Event]:
    from fgloc.sensors.gyro.carried import carried

    return carried(carriage)


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
    failing_as="imu",
    motion=ROLE,
    channels=CHANNELS,
    failures=_failures,
    carried=_carried,
)
