"""What robots report of their wheels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgloc.frames import quaternion_yaw
from fgloc.types import FloatArray, MotionEvent, OdometerPose


@dataclass(frozen=True, slots=True, eq=False)
class OdometryEvent(MotionEvent):
    """``nav_msgs/Odometry``: pose of ``child_frame_id`` in ``frame_id`` and body twist."""

    frame_id: str
    child_frame_id: str
    position: FloatArray  # (3,) m
    orientation: FloatArray  # (4,) quaternion x, y, z, w
    pose_cov: FloatArray  # (6, 6) ROS order: translation, rotation
    linear: FloatArray  # (3,) m/s
    angular: FloatArray  # (3,) rad/s
    twist_cov: FloatArray  # (6, 6)

    @property
    def base_frame_id(self) -> str:
        """The frame whose pose it is."""
        return self.child_frame_id

    @property
    def odometer(self) -> OdometerPose | None:
        """Its planar part."""
        pose = np.array([self.position[0], self.position[1], quaternion_yaw(self.orientation)])
        return OdometerPose(self.frame_id, pose, np.array([*self.linear[:2], self.angular[2]]))


@dataclass(frozen=True, slots=True, eq=False)
class JointsEvent(MotionEvent):
    """``sensor_msgs/JointState``. An array that the message left empty has length 0."""

    names: tuple[str, ...]
    position: FloatArray  # (n,) rad
    velocity: FloatArray  # (n,) rad/s
    effort: FloatArray  # (n,) Nm

    @property
    def publisher(self) -> tuple[str, ...]:
        """Wheels and arm may share the topic: the joints tell them apart."""
        return self.names
