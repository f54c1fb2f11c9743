"""Truth of recordings on slopes, as a motion model sees it: in the robot's own plane."""

from __future__ import annotations

import numpy as np

from fgloc.frames import rotations
from fgloc.types import FloatArray

_LEVEL_RAD = 0.01  # a positioning system measures roll and pitch no better; below, the floor is flat


def in_robots_plane(poses: FloatArray, ground: FloatArray) -> FloatArray:
    """The path that would be driven on a flat floor by the same motions in the robot's plane.

    Args:
        poses: ``(m, 3)`` in the map, in order of time.
        ground: ``(m, 3)`` height, roll and pitch there.

    Returns:
        ``(m, 3)``, beginning at the first pose; of a flat floor the poses as they are.
    """
    if np.ptp(ground[:, 1:], axis=0).max() < _LEVEL_RAD:
        return poses
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    Rz = np.zeros((len(poses), 3, 3))
    Rz[:, 0, 0], Rz[:, 0, 1], Rz[:, 1, 0], Rz[:, 1, 1], Rz[:, 2, 2] = c, -s, s, c, 1.0
    R = Rz @ rotations(ground[:, 1:])
    moved = np.diff(np.column_stack([poses[:, :2], ground[:, 0]]), axis=0)
    way = np.einsum("mji,mj->mi", R[:-1], moved)  # in the axes of the robot
    turn = np.einsum("mji,mjk->mik", R[:-1], R[1:])
    yaw = poses[0, 2] + np.concatenate([[0.0], np.cumsum(0.5 * (turn[:, 1, 0] - turn[:, 0, 1]))])
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    steps = np.column_stack([c * way[:, 0] - s * way[:, 1], s * way[:, 0] + c * way[:, 1]])
    return np.column_stack([poses[0, :2] + np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), yaw])
