"""Poses and maps as standard ROS messages: nested mappings for `fgloc.recording.messages.Messages.encode`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fgloc.frames import rpy_quaternion, yaw_quaternion
from fgloc.types import FloatArray, Ground, Landmark, LandmarkMap, Mode

MAP_FRAME = "map"  # REP 105
STALE = 3  # DiagnosticStatus
_LEVEL = {Mode.OK: 0, Mode.UNCONFIRMED: 1, Mode.DEAD_RECKONING: 1, Mode.LOST: 2}  # DiagnosticStatus: OK, WARN, ERROR
_THICKNESS_M = 0.01  # of a marker's plate, as drawn
_POINT_M = 0.1  # size of a landmark without one
_WHITE = {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0}
_CUBE, _SPHERE, _TEXT = 1, 2, 9  # visualization_msgs/Marker
_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))  # x, y, yaw of ROS' x, y, z, roll, pitch, yaw

Message = dict[str, Any]


def header(stamp_ns: int, frame_id: str) -> Message:
    """std_msgs/Header."""
    return {"stamp": {"sec": stamp_ns // 1_000_000_000, "nanosec": stamp_ns % 1_000_000_000}, "frame_id": frame_id}


def pose_with_covariance(pose: FloatArray, cov: FloatArray, ground: Ground | None = None) -> Message:
    """geometry_msgs/PoseWithCovariance of ``pose (3,)`` and ``cov (3, 3)`` in the map frame.

    Without ``ground`` height, roll and pitch are zero, with no variance: the robot is taken to move in the plane.
    """
    return {"pose": _pose(pose, ground), "covariance": _spatial(cov) if ground is None else ground.cov.ravel()}


def pose_stamped(stamp_ns: int, pose: FloatArray) -> Message:
    """geometry_msgs/PoseStamped in the map."""
    return {"header": header(stamp_ns, MAP_FRAME), "pose": _pose(pose)}


def pose_with_covariance_stamped(
    stamp_ns: int, pose: FloatArray, cov: FloatArray, ground: Ground | None = None, frame: str = MAP_FRAME
) -> Message:
    """geometry_msgs/PoseWithCovarianceStamped in the map."""
    return {"header": header(stamp_ns, frame), "pose": pose_with_covariance(pose, cov, ground)}


def vector_stamped(stamp_ns: int, vector: FloatArray, frame: str) -> Message:
    """geometry_msgs/Vector3Stamped of three numbers ``(3,)``."""
    return {"header": header(stamp_ns, frame), "vector": xyz(*vector)}


def odometry(
    stamp_ns: int,
    pose: FloatArray,
    cov: FloatArray,
    twist: FloatArray,
    base_frame: str,
    twist_cov: FloatArray | None = None,
    ground: Ground | None = None,
    frame: str = MAP_FRAME,
) -> Message:
    """nav_msgs/Odometry of the base in the map; ``twist (3,)`` and its covariance are in the base's axes."""
    covariance = {} if twist_cov is None else {"covariance": _spatial(twist_cov)}
    return {
        "header": header(stamp_ns, frame),
        "child_frame_id": base_frame,
        "pose": pose_with_covariance(pose, cov, ground),
        "twist": {"twist": {"linear": xyz(*twist[:2]), "angular": xyz(z=twist[2])}, **covariance},
    }


def transform(
    stamp_ns: int, T_map_child: FloatArray, child_frame: str, ground: Ground | None = None, frame: str = MAP_FRAME
) -> Message:
    """tf2_msgs/TFMessage with one transform from the map."""
    pose = _pose(T_map_child, ground)
    value = {"translation": pose["position"], "rotation": pose["orientation"]}
    return {"transforms": [{"header": header(stamp_ns, frame), "child_frame_id": child_frame, "transform": value}]}


def path(stamps_ns: Iterable[int], poses: Iterable[FloatArray], stamp_ns: int) -> Message:
    """nav_msgs/Path in the map."""
    stamped = [pose_stamped(stamp, pose) for stamp, pose in zip(stamps_ns, poses, strict=True)]
    return {"header": header(stamp_ns, MAP_FRAME), "poses": stamped}


def diagnostics(
    stamp_ns: int, mode: Mode | None, message: str, values: Mapping[str, str], wrong: bool = False, name: str = "fgloc"
) -> Message:
    """diagnostic_msgs/DiagnosticArray; ``wrong``: the pose is not to be trusted.

    ``mode`` None: there is no pose yet, or none of now. ``name`` is that of the node.
    """
    status = {
        "level": _LEVEL[Mode.LOST] if wrong else STALE if mode is None else _LEVEL[mode],
        "name": f"{name}: localization",
        "message": message,
        "hardware_id": name,
        "values": [{"key": key, "value": value} for key, value in values.items()],
    }
    return {"header": header(stamp_ns, ""), "status": [status]}


def map_markers(landmarks: LandmarkMap, stamp_ns: int = 0, frame: str = MAP_FRAME) -> Message:
    """visualization_msgs/MarkerArray: a plate (a ball for a point) for each landmark, and its number above it."""
    return {"markers": [m for landmark in landmarks.landmarks.values() for m in _markers(landmark, stamp_ns, frame)]}


def rotation(yaw: float) -> dict[str, float]:
    """geometry_msgs/Quaternion of a yaw [rad]."""
    return dict(zip("xyzw", yaw_quaternion(yaw).tolist(), strict=True))


def xyz(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, float]:
    """geometry_msgs/Point or Vector3."""
    return {"x": float(x), "y": float(y), "z": float(z)}


def _pose(pose: FloatArray, ground: Ground | None = None) -> Message:
    if ground is None:
        return {"position": xyz(*pose[:2]), "orientation": rotation(float(pose[2]))}
    quaternion = rpy_quaternion(ground.roll, ground.pitch, float(pose[2]))
    position = xyz(float(pose[0]), float(pose[1]), ground.z)
    return {"position": position, "orientation": dict(zip("xyzw", quaternion, strict=True))}


def _spatial(cov: FloatArray) -> FloatArray:
    """The ``(36,)`` covariance of ROS from that of x, y and yaw ``(3, 3)``."""
    covariance = np.zeros((6, 6))
    covariance[_PLANAR] = cov
    return covariance.ravel()


def _markers(landmark: Landmark, stamp_ns: int, frame: str) -> list[Message]:
    size, point = landmark.size_m or _POINT_M, landmark.size_m == 0.0
    x, y, z = landmark.position
    shared = {"header": header(stamp_ns, frame), "id": landmark.landmark_id, "color": _WHITE}
    quaternion = dict(zip("xyzw", Rotation.from_matrix(landmark.rotation).as_quat().tolist(), strict=True))
    body = {
        **shared,
        "ns": "landmarks",
        "type": _SPHERE if point else _CUBE,
        "pose": {"position": xyz(x, y, z), "orientation": quaternion},
        "scale": xyz(size, size, size if point else _THICKNESS_M),
    }
    above = {"position": xyz(x, y, z + size), "orientation": {"w": 1.0}}
    text = {**shared, "ns": "ids", "type": _TEXT, "pose": above, "scale": xyz(z=0.5 * size)}
    return [body, {**text, "text": str(landmark.landmark_id)}]
