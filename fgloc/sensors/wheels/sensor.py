"""The wheels as a sensor: their topics, settings and failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from fgloc.sensors.base import BuiltIn, Joined, RawMistake, Stream
from fgloc.sensors.wheels import messages, validation
from fgloc.sensors.wheels.channels import CHANNELS
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.sensors.wheels.findings import OdometryChecks
from fgloc.sensors.wheels.first_settings import FIRST_SETTINGS
from fgloc.sensors.wheels.role import ROLE
from fgloc.types import Event

if TYPE_CHECKING:
    from fgloc.config import Config, Section
    from fgloc.sensors.failures import Carriage


def _failures() -> tuple[type[Section], ...]:
    from fgloc.sensors.wheels import failures as speeds
    from fgloc.sensors.wheels import message_failures as contents

    return (
        speeds.WheelSlip,
        speeds.EncoderDead,
        contents.EncoderFrozen,
        speeds.EncoderQuantized,
        contents.EncoderRollover,
        speeds.WheelScaleDrift,
        contents.OdometryReset,
        contents.WheelNan,
        contents.WrongCovariance,
    )


def _carried(carriage: Carriage) -> Callable[[Event], Event]:
    from fgloc.sensors.wheels.carried import carried

    return carried(carriage)


def _mistakes(motion: Sequence[Event], config: Config) -> tuple[RawMistake, ...]:
    from fgloc.sensors.wheels.roll_over import mistakes

    return mistakes(motion, config)


def _joined() -> Joined:
    from fgloc.sensors.wheels.carried import JoinedWheels

    return JoinedWheels()


WHEELS = BuiltIn(
    name="wheels",
    first_settings=FIRST_SETTINGS,
    streams=(
        Stream(
            "odometry",
            OdometryEvent,
            {"nav_msgs/msg/Odometry": messages.odometry},
            ("odom", "wheel_odom", "wheel_odometry", "wheel/odometry", "wheels/odom"),
            validator=validation.odometry,
            findings=OdometryChecks,
        ),
        Stream(
            "joints",
            JointsEvent,
            {"sensor_msgs/msg/JointState": messages.joints},
            ("joint_states",),
            validator=validation.joints,
        ),
    ),
    motion=ROLE,
    channels=CHANNELS,
    mistakes=_mistakes,
    failures=_failures,
    carried=_carried,
    joined=_joined,
)
