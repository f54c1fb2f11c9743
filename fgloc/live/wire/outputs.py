"""Poses as ROS messages: Odometry, PoseWithCovarianceStamped, /tf, diagnostics, and the map as markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.frames import yaw_quaternion
from fgloc.live.wire.names import OWN
from fgloc.live.wire.participant import Participant
from fgloc.types import Estimate, FloatArray, Landmark, LandmarkMap, Mode

MAP_FRAME = "map"  # REP 105
_LEVEL = {Mode.OK: 0, Mode.UNCONFIRMED: 1, Mode.DEAD_RECKONING: 1, Mode.LOST: 2}  # DiagnosticStatus: OK, WARN, ERROR
STALE = 3  # DiagnosticStatus
_THICKNESS_M = 0.01  # of a marker's plate, as drawn
_POINT_M = 0.1  # size of a landmark without one
_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))  # x, y, yaw of six
_WHITE = {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0}
_CUBE, _SPHERE, _TEXT = 1, 2, 9  # visualization_msgs/Marker


@dataclass(frozen=True, slots=True, eq=False)
class BaseState:
    """Where the base is and how it moves."""

    stamp_ns: int
    pose: FloatArray  # (3,) T_map_base
    cov: FloatArray  # (3, 3) in the map frame
    twist: FloatArray  # (3,) of the base in its own axes: m/s, m/s, rad/s
    twist_cov: FloatArray  # (3, 3) likewise


class Outputs:
    """Writers of everything that ``fgloc live`` publishes."""

    def __init__(self, participant: Participant) -> None:
        """Announce the topics."""
        self._messages = participant.messages
        self._types = {
            OWN + "odometry": "nav_msgs/msg/Odometry",
            OWN + "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
            "/tf": "tf2_msgs/msg/TFMessage",
            "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
            OWN + "map": "visualization_msgs/msg/MarkerArray",
        }
        self._writers = {
            topic: participant.writer(topic, kind, latched=topic == OWN + "map") for topic, kind in self._types.items()
        }

    def readers(self, name: str) -> int:
        """How many readers one of our own topics has: "odometry", "pose" or "map"."""
        return self._writers[OWN + name].readers

    def odometry(self, state: BaseState, base_frame: str) -> None:
        """Publish nav_msgs/Odometry of the base in the map."""
        self._write(
            OWN + "odometry",
            {
                "header": _header(state.stamp_ns, MAP_FRAME),
                "child_frame_id": base_frame,
                "pose": _pose_with_covariance(state.pose, state.cov),
                "twist": {
                    "twist": {"linear": _xyz(*state.twist[:2]), "angular": _xyz(z=state.twist[2])},
                    "covariance": _spatial(state.twist_cov),
                },
            },
        )

    def pose(self, estimate: Estimate) -> None:
        """Publish one keyframe's estimate."""
        values = {
            "header": _header(estimate.stamp_ns, MAP_FRAME),
            "pose": _pose_with_covariance(estimate.pose, estimate.cov),
        }
        self._write(OWN + "pose", values)

    def transform(self, stamp_ns: int, T_map_child: FloatArray, child_frame: str) -> None:
        """Publish ``T_map_child (3,)`` on /tf."""
        transform = {
            "header": _header(stamp_ns, MAP_FRAME),
            "child_frame_id": child_frame,
            "transform": {"translation": _xyz(*T_map_child[:2]), "rotation": _rotation(T_map_child[2])},
        }
        self._write("/tf", {"transforms": [transform]})

    def diagnostics(self, stamp_ns: int, mode: Mode | None, message: str, values: Mapping[str, str]) -> None:
        """Publish the state; ``mode`` None: there is no pose yet."""
        status = {
            "level": STALE if mode is None else _LEVEL[mode],
            "name": "fgloc: localization",
            "message": message,
            "hardware_id": "fgloc",
            "values": [{"key": key, "value": value} for key, value in values.items()],
        }
        self._write("/diagnostics", {"header": _header(stamp_ns, ""), "status": [status]})

    def map(self, landmarks: LandmarkMap) -> None:
        """Publish the map, once: late subscribers get it too."""
        drawn = [m for landmark in landmarks.landmarks.values() for m in _markers(landmark)]
        self._write(OWN + "map", {"markers": drawn})

    def _write(self, topic: str, values: Mapping[str, Any]) -> None:
        self._writers[topic].write(self._messages.encode(self._types[topic], values))


def odom_in_map(T_map_base: FloatArray, T_odom_base: FloatArray) -> FloatArray:
    """``T_map_odom (3,)`` from the base's pose in both frames at one time (REP 105)."""
    return se2.compose(T_map_base, se2.inverse(T_odom_base))


def _markers(landmark: Landmark) -> list[dict[str, Any]]:
    """A plate (a ball for a point) and its number above it."""
    size, point = landmark.size_m or _POINT_M, landmark.size_m == 0.0
    x, y, z = landmark.position
    shared = {"header": {"frame_id": MAP_FRAME}, "id": landmark.landmark_id, "color": _WHITE}
    body = {
        **shared,
        "ns": "landmarks",
        "type": _SPHERE if point else _CUBE,
        "pose": {"position": _xyz(x, y, z), "orientation": _quaternion(landmark.rotation)},
        "scale": _xyz(size, size, size if point else _THICKNESS_M),
    }
    above = {"position": _xyz(x, y, z + size), "orientation": {"w": 1.0}}
    text = {**shared, "ns": "ids", "type": _TEXT, "pose": above, "scale": _xyz(z=0.5 * size)}
    return [body, {**text, "text": str(landmark.landmark_id)}]


def _header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 1_000_000_000, "nanosec": stamp_ns % 1_000_000_000}, "frame_id": frame_id}


def _pose_with_covariance(pose: FloatArray, cov: FloatArray) -> dict[str, Any]:
    return {"pose": {"position": _xyz(*pose[:2]), "orientation": _rotation(pose[2])}, "covariance": _spatial(cov)}


def _spatial(cov: FloatArray) -> FloatArray:
    """``(36,)`` of ``(3, 3)``: height, roll and pitch are zero, with no variance: the robot moves in the plane."""
    covariance = np.zeros((6, 6))
    covariance[_PLANAR] = cov
    return covariance.ravel()


def _rotation(yaw: float) -> dict[str, float]:
    return dict(zip("xyzw", yaw_quaternion(yaw).tolist(), strict=True))


def _xyz(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, float]:
    return {"x": float(x), "y": float(y), "z": float(z)}


def _quaternion(rotation: FloatArray) -> dict[str, float]:
    """Of a rotation matrix ``(3, 3)``."""
    return dict(zip("xyzw", Rotation.from_matrix(rotation).as_quat().tolist(), strict=True))
