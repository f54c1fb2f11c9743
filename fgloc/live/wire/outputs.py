"""Poses as ROS messages: Odometry, PoseWithCovarianceStamped, /tf, diagnostics, and the map as markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fgloc import se2
from fgloc.live.wire.names import OWN
from fgloc.live.wire.participant import Participant
from fgloc.recording import standard_messages as standard
from fgloc.types import Estimate, FloatArray, Ground, LandmarkMap, Mode


@dataclass(frozen=True, slots=True, eq=False)
class BaseState:
    """Where the base is and how it moves."""

    stamp_ns: int
    pose: FloatArray  # (3,) T_map_base
    cov: FloatArray  # (3, 3) in the map frame
    twist: FloatArray  # (3,) of the base in its own axes: m/s, m/s, rad/s
    twist_cov: FloatArray  # (3, 3) likewise
    ground: Ground | None = None  # None: the floor is flat


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
        values = standard.odometry(
            state.stamp_ns, state.pose, state.cov, state.twist, base_frame, state.twist_cov, state.ground
        )
        self._write(OWN + "odometry", values)

    def pose(self, estimate: Estimate) -> None:
        """Publish one keyframe's estimate."""
        values = standard.pose_with_covariance_stamped(estimate.stamp_ns, estimate.pose, estimate.cov, estimate.ground)
        self._write(OWN + "pose", values)

    def transform(self, stamp_ns: int, T_map_child: FloatArray, child_frame: str) -> None:
        """Publish ``T_map_child (3,)`` on /tf."""
        self._write("/tf", standard.transform(stamp_ns, T_map_child, child_frame))

    def diagnostics(
        self, stamp_ns: int, mode: Mode | None, message: str, values: Mapping[str, str], wrong: bool
    ) -> None:
        """Publish the state; arguments as `standard_messages.diagnostics` has them."""
        self._write("/diagnostics", standard.diagnostics(stamp_ns, mode, message, values, wrong))

    def map(self, landmarks: LandmarkMap) -> None:
        """Publish the map, once: late subscribers get it too."""
        self._write(OWN + "map", standard.map_markers(landmarks))

    def _write(self, topic: str, values: Mapping[str, Any]) -> None:
        self._writers[topic].write(self._messages.encode(self._types[topic], values))


def odom_in_map(T_map_base: FloatArray, T_odom_base: FloatArray) -> FloatArray:
    """``T_map_odom (3,)`` from the base's pose in both frames at one time (REP 105)."""
    return se2.compose(T_map_base, se2.inverse(T_odom_base))
