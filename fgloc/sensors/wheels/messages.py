"""ROS messages of the wheels as events."""

from __future__ import annotations

from typing import Any

from fgloc.sensors.base import When
from fgloc.sensors.messages import matrix, vector, xyz, xyzw
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import Event


def odometry(m: Any, when: When) -> Event:
    """From ``nav_msgs/Odometry``."""
    return OdometryEvent(
        *when,
        m.header.frame_id,
        m.child_frame_id,
        xyz(m.pose.pose.position),
        xyzw(m.pose.pose.orientation),
        matrix(m.pose.covariance, 6),
        xyz(m.twist.twist.linear),
        xyz(m.twist.twist.angular),
        matrix(m.twist.covariance, 6),
    )


def joints(m: Any, when: When) -> Event:
    """From ``sensor_msgs/JointState``."""
    return JointsEvent(*when, tuple(m.name), vector(m.position), vector(m.velocity), vector(m.effort))
