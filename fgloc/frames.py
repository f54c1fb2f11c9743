"""Names of the base frame, rotations, and the flattening of 3D poses to the plane."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

OPTICAL_TO_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Optical axes (x right, y down, z ahead) in body axes (x ahead, y left, z up), REP 103."""
BASE_NAMES = ("base_link", "base_footprint", "base")  # what robots call our "base", first match wins


def quaternion_yaw(quaternion: Sequence[float] | FloatArray) -> float:
    """Yaw [rad] of a unit quaternion x, y, z, w."""
    x, y, z, w = map(float, quaternion)  # numpy's numbers warn of an overflow
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def yaw_quaternion(yaw: float) -> FloatArray:
    """Quaternion x, y, z, w of a rotation about z by yaw [rad]."""
    return np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)])


def quaternion_matrix(quaternion: Sequence[float] | FloatArray) -> FloatArray:
    """Rotation matrix ``(3, 3)`` of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def homogeneous(rotation: FloatArray, translation: Sequence[float] | FloatArray = (0.0, 0.0, 0.0)) -> FloatArray:
    """Homogeneous ``(4, 4)`` of a rotation matrix ``(3, 3)`` and a translation [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


def transform_matrix(translation: Sequence[float] | FloatArray, quaternion: Sequence[float] | FloatArray) -> FloatArray:
    """Homogeneous ``(4, 4)`` of a translation [m] and a unit quaternion x, y, z, w."""
    return homogeneous(quaternion_matrix(quaternion), translation)


def rotation_of(vector: Sequence[float] | FloatArray) -> FloatArray:
    """Rotation matrix ``(3, 3)`` about a vector, by its length [rad] (Rodrigues' formula)."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * angle
    k = math.sin(half) / angle if angle > 1e-12 else 0.5
    return quaternion_matrix((k * x, k * y, k * z, math.cos(half)))


def roll_pitch(rotation: FloatArray) -> tuple[float, float]:
    """Fixed-axis roll and pitch [rad] of a rotation matrix ``(3, 3)``."""
    return math.atan2(rotation[2, 1], rotation[2, 2]), -math.asin(min(max(rotation[2, 0], -1.0), 1.0))


def rpy_quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of fixed-axis roll, pitch, yaw [rad]."""
    cr, sr, cp, sp, cy, sy = (f(0.5 * a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def rpy_matrix(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Rotation matrix ``(3, 3)`` of fixed-axis roll, pitch, yaw [rad], as ROS and URDF use them."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def sensor_pose(T: FloatArray, optical: bool) -> tuple[float, float, float, float, float, float]:
    """x, y, z [m], roll, pitch, yaw [rad] of a sensor at ``T_base_sensor (4, 4)``; optical axes have z forward."""
    R = T[:3, :3] @ OPTICAL_TO_BODY.T if optical else T[:3, :3]
    x, y, z = T[:3, 3].tolist()
    return x, y, z, *roll_pitch(R), math.atan2(R[1, 0], R[0, 0])


def rotations(angles: FloatArray) -> FloatArray:
    """``Ry(pitch) Rx(roll)`` ``(m, 3, 3)`` of angles roll, pitch ``(m, 2)``."""
    cr, sr, cp, sp = (f(angles[:, i]) for i in range(2) for f in (np.cos, np.sin))
    zero = np.zeros_like(cr)
    return np.stack([cp, sp * sr, sp * cr, zero, cr, -sr, -sp, cp * sr, cp * cr], axis=1).reshape(-1, 3, 3)
