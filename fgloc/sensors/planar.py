"""What a rotation in space is in the plane."""

from __future__ import annotations

import math

from fgloc.types import FloatArray, Landmark


def planar_yaw(R_base_marker: FloatArray, landmark: Landmark | None) -> float:
    """Yaw by the rule of Landmark.planar; the map, if known, says whether the marker stands or lies."""
    standing = abs((R_base_marker if landmark is None else landmark.rotation)[2, 2]) < 0.7
    axis = R_base_marker[:, 2] if standing else R_base_marker[:, 0]
    return math.atan2(axis[1], axis[0])
