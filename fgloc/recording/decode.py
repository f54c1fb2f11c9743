"""Messages to events: transforms, calibration and truth; the sensors bring converters of their own.

No validation: that is the gate's part.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fgloc.config import RecordingConfig, Role
from fgloc.sensors import registry
from fgloc.sensors.base import Converter, When, matrix, nanoseconds, vector, xyz, xyzw
from fgloc.types import CameraInfoEvent, Event, TransformEvent, TruthEvent

TF_TYPES = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
HEADERLESS = frozenset({"geometry_msgs/msg/Twist", "geometry_msgs/msg/Pose2D"})


def header_stamp(message: Any) -> int | None:
    """Stamp [ns] of the message's header; None if it has none."""
    header = getattr(message, "header", None)
    return None if header is None else nanoseconds(header.stamp)


def transforms(message: Any, received_ns: int, topic: str, static: bool) -> list[TransformEvent]:
    """Events of a TFMessage."""
    return [
        TransformEvent(
            nanoseconds(t.header.stamp),
            received_ns,
            topic,
            t.header.frame_id,
            t.child_frame_id,
            xyz(t.transform.translation),
            xyzw(t.transform.rotation),
            static,
        )
        for t in message.transforms
    ]


def events_of(
    content: Any, message_type: str, role: Role | None, received_ns: int, topic: str, config: RecordingConfig
) -> list[Event]:
    """Events of one message in a role (None: none but that of tf), stamped as the configuration has it.

    Raises:
        KeyError, ValueError, AttributeError: the message is not what its type says.
    """
    if message_type in TF_TYPES:
        return list(transforms(content, received_ns, topic, topic.rstrip("/").endswith("tf_static")))
    if role is None:
        return []
    stamp_ns = None if role in config.received_stamps else header_stamp(content)
    stamp_ns = received_ns if stamp_ns is None else stamp_ns
    stamp_ns += round(config.stamp_offset_s.get(role, 0.0) * 1e9)
    return [converters_of(role)[message_type](content, (stamp_ns, received_ns, topic))]


# --- One converter for each type --------------------------------------------------------------------------------------


def _camera_info(m: Any, when: When) -> Event:
    K, D = (m.K, m.D) if hasattr(m, "K") else (m.k, m.d)  # ROS 1 has capitals
    return CameraInfoEvent(*when, m.header.frame_id, m.width, m.height, m.distortion_model, matrix(K, 3), vector(D))


def _pose_truth(m: Any, when: When) -> Event:
    return TruthEvent(*when, m.header.frame_id, xyz(m.pose.position), xyzw(m.pose.orientation))


def _covariance_truth(m: Any, when: When) -> Event:
    return TruthEvent(*when, m.header.frame_id, xyz(m.pose.pose.position), xyzw(m.pose.pose.orientation))


def _planar_truth(m: Any, when: When) -> Event:
    half = 0.5 * float(m.theta)
    orientation = np.array([0.0, 0.0, math.sin(half), math.cos(half)]) if math.isfinite(half) else np.full(4, math.nan)
    return TruthEvent(*when, "", np.array([m.x, m.y, 0.0]), orientation)


CONVERTERS: dict[Role, dict[str, Converter]] = {
    "camera_info": {"sensor_msgs/msg/CameraInfo": _camera_info},
    "truth": {
        "geometry_msgs/msg/PoseStamped": _pose_truth,
        "geometry_msgs/msg/PoseWithCovarianceStamped": _covariance_truth,
        "geometry_msgs/msg/Pose2D": _planar_truth,
        "nav_msgs/msg/Odometry": _covariance_truth,
    },
}
"""Of the roles that no sensor has."""


def converters_of(role: Role) -> Mapping[str, Converter]:
    """Converters of any role, by message type."""
    return CONVERTERS[role] if role in CONVERTERS else registry.converters(role)
