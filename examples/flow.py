"""Optical flow as a motion source beside the wheels, from a message type that fgloc does not read itself, in one file.

A stream with the role ``odometries`` makes events of odometries beside the wheels. Its topic is listed as that of any
other in ``recording.odometries``; covariance, mounting, scale, clock and faults are handled as theirs are.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import numpy as np

from fgloc.config import Section
from fgloc.sensors.base import Context, Stream, When, matrix, xyz
from fgloc.sensors.measurements import LandmarkMeasurement
from fgloc.sensors.odometry import BesideEvent
from fgloc.sensors.wheels.events import odometry_validator
from fgloc.types import Event


class FlowConfig(Section):
    """No settings of its own: it has those of ``recording.odometries``."""


def from_twist(message: Any, when: When) -> Event:
    """From `geometry_msgs/TwistWithCovarianceStamped` of the camera that looks at the floor."""
    twist = message.twist
    no_pose = np.full(3, np.nan), np.full(4, np.nan), np.zeros((6, 6))
    moves = xyz(twist.twist.linear), xyz(twist.twist.angular), matrix(twist.covariance, 6)
    return BesideEvent(*when, "", message.header.frame_id, *no_pose, *moves)


class Flow:
    """Optical flow, beside wheel odometry."""

    name: ClassVar[str] = "flow"
    Config: ClassVar[type[Section]] = FlowConfig
    streams: ClassVar[tuple[Stream, ...]] = (
        Stream(
            "odometries",
            BesideEvent,
            {"geometry_msgs/msg/TwistWithCovarianceStamped": from_twist},
            (),
            validator=odometry_validator,
        ),
    )
    failures: ClassVar[tuple[type[Section], ...]] = ()

    @classmethod
    def build(cls, context: Context) -> Flow | None:
        """None: its events are those of an odometry beside the wheels, which measures them."""
        return None

    def measure(self, event: Any) -> Iterable[LandmarkMeasurement]:
        """None."""
        return ()

    @property
    def notes(self) -> tuple[str, ...]:
        """None."""
        return ()
