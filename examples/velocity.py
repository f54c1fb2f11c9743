"""Velocity of the base as motion source, from a message type that fgloc does not read itself, in one file.

Optical flow, a radar or a motor driver of its own often tells the body's velocity alone. A stream with the role of a
built-in sensor makes its events: here those of wheel odometry without a pose. They are checked, integrated, compared
with gyro and learned motion, and their constants estimated as those of wheels are (section ``wheels``). There is one
odometry: a topic of ``nav_msgs/Odometry`` beside it needs ``recording.topics.odometry`` to say which one is meant.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import numpy as np

from fgloc.config import Section
from fgloc.sensors.base import Context, Stream, When, matrix, xyz
from fgloc.sensors.measurements import LandmarkMeasurement
from fgloc.sensors.wheels.events import OdometryEvent, odometry_validator
from fgloc.types import Event

_UNKNOWN = np.full(3, np.nan)


class VelocityConfig(Section):
    """No settings of its own: it has those of ``wheels``."""


def from_twist(message: Any, when: When) -> Event:
    """From `geometry_msgs/TwistWithCovarianceStamped` of the base frame."""
    twist = message.twist
    return OdometryEvent(
        *when,
        "",
        message.header.frame_id,
        _UNKNOWN,
        np.full(4, np.nan),
        np.zeros((6, 6)),
        xyz(twist.twist.linear),
        xyz(twist.twist.angular),
        matrix(twist.covariance, 6),
    )


class Velocity:
    """Velocity of the base, in place of wheel odometry."""

    name: ClassVar[str] = "velocity"
    Config: ClassVar[type[Section]] = VelocityConfig
    streams: ClassVar[tuple[Stream, ...]] = (
        Stream(
            "odometry",
            OdometryEvent,
            {"geometry_msgs/msg/TwistWithCovarianceStamped": from_twist},
            ("velocity",),
            validator=odometry_validator,
        ),
    )
    failures: ClassVar[tuple[type[Section], ...]] = ()

    @classmethod
    def build(cls, context: Context) -> Velocity | None:
        """None: its events are the wheels', which measure them."""
        return None

    def measure(self, event: Any) -> Iterable[LandmarkMeasurement]:
        """None."""
        return ()

    @property
    def notes(self) -> tuple[str, ...]:
        """None."""
        return ()
