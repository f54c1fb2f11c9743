"""Messages to events: one converter for each message type of each role. No validation: that is the gate's part.

AprilTag corners. ``apriltag_msgs`` passes on the AprilTag library's corners: bottom-left, bottom-right, top-right,
top-left of the tag as that library holds it upright, in pixels whose first pixel's *corner* is (0, 0). OpenCV's
DICT_APRILTAG_* dictionaries hold the same tags turned by half a turn, and OpenCV's first pixel's *centre* is (0, 0).
Measured with both detectors: on 60 rendered tags of 36h11, 25h9 and 16h5 and 7 photographed ones OpenCV's order is the
library's [1, 0, 3, 2] in every case; on 5 rendered tags in random rotation the library's corners lie 0.50 px
right of and below the truth in OpenCV's convention (mean of each axis 0.49 to 0.51), OpenCV's within 0.01 px.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fgloc.config import RecordingConfig, Role
from fgloc.sensors import registry
from fgloc.types import (
    CameraInfoEvent,
    CommandEvent,
    CornersEvent,
    Event,
    FloatArray,
    ImageEvent,
    ImuEvent,
    JointsEvent,
    MarkerCorners,
    MarkerPose,
    MarkerPosesEvent,
    OdometryEvent,
    RangeBearing,
    RangeBearingEvent,
    TransformEvent,
    TruthEvent,
)

When = tuple[int, int, str]  # stamp_ns, received_ns, topic: an Event's first fields
TF_TYPES = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
HEADERLESS = frozenset({"geometry_msgs/msg/Twist", "geometry_msgs/msg/Pose2D"})

_OPENCV_ORDER = (1, 0, 3, 2)
_OPENCV_SHIFT_PX = -0.5
_ID = re.compile(r"(?:^|[^0-9A-Za-z])(\d+)$")  # "7", "tag36h11:7", "marker_7"; not the 11 of "tag36h11"


def header_stamp(message: Any) -> int | None:
    """Stamp [ns] of the message's header; None if it has none."""
    header = getattr(message, "header", None)
    return None if header is None else _nanoseconds(header.stamp)


def transforms(message: Any, received_ns: int, topic: str, static: bool) -> list[TransformEvent]:
    """Events of a TFMessage."""
    return [
        TransformEvent(
            _nanoseconds(t.header.stamp),
            received_ns,
            topic,
            t.header.frame_id,
            t.child_frame_id,
            _xyz(t.transform.translation),
            _xyzw(t.transform.rotation),
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


def _odometry(m: Any, when: When) -> Event:
    return OdometryEvent(
        *when,
        m.header.frame_id,
        m.child_frame_id,
        _xyz(m.pose.pose.position),
        _xyzw(m.pose.pose.orientation),
        _matrix(m.pose.covariance, 6),
        _xyz(m.twist.twist.linear),
        _xyz(m.twist.twist.angular),
        _matrix(m.twist.covariance, 6),
    )


def _twist(m: Any, when: When) -> Event:
    return CommandEvent(*when, float(m.linear.x), float(m.angular.z))


def _twist_stamped(m: Any, when: When) -> Event:
    return _twist(m.twist, when)


def _joints(m: Any, when: When) -> Event:
    return JointsEvent(*when, tuple(m.name), _vector(m.position), _vector(m.velocity), _vector(m.effort))


def _imu(m: Any, when: When) -> Event:
    return ImuEvent(
        *when,
        m.header.frame_id,
        _xyz(m.angular_velocity),
        _xyz(m.linear_acceleration),
        _matrix(m.angular_velocity_covariance, 3),
    )


def _image(m: Any, when: When) -> Event:
    return ImageEvent(
        *when, m.header.frame_id, m.encoding, False, m.width, m.height, m.step, bool(m.is_bigendian), _bytes(m.data)
    )


def _compressed_image(m: Any, when: When) -> Event:
    return ImageEvent(*when, m.header.frame_id, m.format, True, 0, 0, 0, False, _bytes(m.data))


def _camera_info(m: Any, when: When) -> Event:
    K, D = (m.K, m.D) if hasattr(m, "K") else (m.k, m.d)  # ROS 1 has capitals
    return CameraInfoEvent(*when, m.header.frame_id, m.width, m.height, m.distortion_model, _matrix(K, 3), _vector(D))


def _apriltags(m: Any, when: When) -> Event:
    sightings = []
    for tag in m.detections:
        corners = np.array([(c.x, c.y) for c in tag.corners], dtype=float)[list(_OPENCV_ORDER)] + _OPENCV_SHIFT_PX
        sightings.append(MarkerCorners(int(tag.id), corners))
    return CornersEvent(*when, m.header.frame_id, tuple(sightings))


def _aruco_poses(m: Any, when: When) -> Event:
    frame = m.header.frame_id or next((marker.header.frame_id for marker in m.markers), "")
    return MarkerPosesEvent(*when, frame, tuple(_marker_pose(int(marker.id), marker.pose) for marker in m.markers))


def _detections(m: Any, when: When) -> Event:
    """Things whose id holds no number are no markers; a message of nothing else is an error."""
    named = [(_detection_id(d, d.results[0]), d.results[0].pose) for d in m.detections if d.results]
    sightings = tuple(_marker_pose(marker_id, pose) for marker_id, pose in named if marker_id is not None)
    if named and not sightings:
        raise ValueError("no detection's id holds a number")
    return MarkerPosesEvent(*when, m.header.frame_id, sightings)


def _landmarks(m: Any, when: When) -> Event:
    sightings = tuple(RangeBearing(int(k.id), float(k.range), float(k.bearing)) for k in m.landmarks)
    return RangeBearingEvent(*when, m.header.frame_id, sightings)


def _pose_truth(m: Any, when: When) -> Event:
    return TruthEvent(*when, m.header.frame_id, _xyz(m.pose.position), _xyzw(m.pose.orientation))


def _covariance_truth(m: Any, when: When) -> Event:
    return TruthEvent(*when, m.header.frame_id, _xyz(m.pose.pose.position), _xyzw(m.pose.pose.orientation))


def _planar_truth(m: Any, when: When) -> Event:
    half = 0.5 * float(m.theta)
    orientation = np.array([0.0, 0.0, math.sin(half), math.cos(half)]) if math.isfinite(half) else np.full(4, math.nan)
    return TruthEvent(*when, "", np.array([m.x, m.y, 0.0]), orientation)


CONVERTERS: dict[Role, dict[str, Callable[[Any, When], Event]]] = {
    "odometry": {"nav_msgs/msg/Odometry": _odometry},
    "command": {"geometry_msgs/msg/Twist": _twist, "geometry_msgs/msg/TwistStamped": _twist_stamped},
    "joints": {"sensor_msgs/msg/JointState": _joints},
    "imu": {"sensor_msgs/msg/Imu": _imu},
    "image": {"sensor_msgs/msg/Image": _image, "sensor_msgs/msg/CompressedImage": _compressed_image},
    "camera_info": {"sensor_msgs/msg/CameraInfo": _camera_info},
    "sightings": {
        "apriltag_msgs/msg/AprilTagDetectionArray": _apriltags,
        "aruco_msgs/msg/MarkerArray": _aruco_poses,
        "vision_msgs/msg/Detection3DArray": _detections,
        "landmark_msgs/msg/LandmarkArray": _landmarks,
    },
    "truth": {
        "geometry_msgs/msg/PoseStamped": _pose_truth,
        "geometry_msgs/msg/PoseWithCovarianceStamped": _covariance_truth,
        "geometry_msgs/msg/Pose2D": _planar_truth,
        "nav_msgs/msg/Odometry": _covariance_truth,
    },
}


def converters_of(role: Role) -> Mapping[str, Callable[[Any, When], Event]]:
    """Converters of any role, by message type."""
    return CONVERTERS[role] if role in CONVERTERS else registry.converters(role)


# --- Parts ------------------------------------------------------------------------------------------------------------


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _xyz(v: Any) -> FloatArray:
    return np.array((v.x, v.y, v.z), dtype=float)


def _xyzw(q: Any) -> FloatArray:
    return np.array((q.x, q.y, q.z, q.w), dtype=float)


def _vector(values: Any) -> FloatArray:
    return np.asarray(values, dtype=float)


def _matrix(values: Any, n: int) -> FloatArray:
    return np.asarray(values, dtype=float).reshape(n, n)


def _bytes(values: Any) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.asarray(values, dtype=np.uint8)


def _marker_pose(marker_id: int, pose: Any) -> MarkerPose:
    """From a PoseWithCovariance."""
    return MarkerPose(marker_id, _xyz(pose.pose.position), _xyzw(pose.pose.orientation), _matrix(pose.covariance, 6))


def _detection_id(detection: Any, result: Any) -> int | None:
    """Marker number of a Detection3D: its hypothesis' class, in older definitions its result's id, else its own id."""
    hypothesis = getattr(result, "hypothesis", None)
    for value in (getattr(hypothesis, "class_id", ""), getattr(result, "id", ""), getattr(detection, "id", "")):
        if isinstance(value, int):
            return value
        if match := _ID.search(value.strip()):
            return int(match.group(1))
    return None
