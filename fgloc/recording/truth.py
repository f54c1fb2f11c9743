"""What an external positioning system says of the robot's base."""

from __future__ import annotations

from fgloc import se2
from fgloc.config import TruthConfig
from fgloc.frames import quaternion_yaw
from fgloc.types import FloatArray, TruthEvent


def base_pose(event: TruthEvent, config: TruthConfig) -> FloatArray:
    """Planar pose ``(3,)`` of the base, from that of the body which the system tracks."""
    T_body_base = se2.inverse((*config.offset_m, config.yaw_offset_rad))
    return se2.compose((event.position[0], event.position[1], quaternion_yaw(event.orientation)), T_body_base)
