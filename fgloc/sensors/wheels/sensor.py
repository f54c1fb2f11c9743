"""The wheels as a sensor: their topics, settings and failures."""

from __future__ import annotations

from fgloc.sensors.base import BuiltIn, Stream
from fgloc.sensors.wheels import messages, validation
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.sensors.wheels.findings import OdometryChecks

WHEELS = BuiltIn(
    name="wheels",
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
)
