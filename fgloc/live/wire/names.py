"""How ROS 2 names topics and types in DDS."""

from __future__ import annotations

OWN = "/fgloc/"  # topics below are outputs of `fgloc live`, of this process or another
_TOPIC = "rt/"


def dds_topic(topic: str) -> str:
    """``/odom`` as ``rt/odom``."""
    return _TOPIC + topic.lstrip("/")


def ros_topic(dds: str) -> str | None:
    """``rt/odom`` as ``/odom``; None: no topic of ROS (a service, an action's part, another program's)."""
    return "/" + dds.removeprefix(_TOPIC) if dds.startswith(_TOPIC) else None


def dds_type(message_type: str) -> str:
    """``nav_msgs/msg/Odometry`` as ``nav_msgs::msg::dds_::Odometry_``."""
    package, kind, name = message_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(dds: str) -> str | None:
    """``nav_msgs::msg::dds_::Odometry_`` as ``nav_msgs/msg/Odometry``; None: no message type of ROS."""
    parts = dds.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return None
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"
