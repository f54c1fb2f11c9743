"""Where a sensor sits, as ``recording.sightings_pose`` has it."""

from __future__ import annotations

import math

import numpy as np

from fgloc.types import FloatArray

OPTICAL_TO_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def sensor_pose(T: FloatArray, optical: bool) -> tuple[float, float, float, float, float, float]:
    """x, y, z [m], roll, pitch, yaw [rad] of a sensor at ``T_base_sensor (4, 4)``; optical axes have z forward."""
    R = T[:3, :3] @ OPTICAL_TO_BODY.T if optical else T[:3, :3]
    roll, pitch = math.atan2(R[2, 1], R[2, 2]), math.asin(float(np.clip(-R[2, 0], -1.0, 1.0)))
    x, y, z = T[:3, 3].tolist()
    return x, y, z, roll, pitch, math.atan2(R[1, 0], R[0, 0])


def pose_text(T: FloatArray, optical: bool) -> str:
    """The line of the configuration that puts a sensor at ``T_base_sensor (4, 4)``."""
    values = ", ".join(f"{round(v, 4) + 0.0:g}" for v in sensor_pose(T, optical))
    return f"recording.sightings_pose: [{values}]"
