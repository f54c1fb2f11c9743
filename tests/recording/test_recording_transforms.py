"""The frame tree."""

from __future__ import annotations

import numpy as np
import pytest

from fgloc.errors import RecordingError
from fgloc.frames import transform_matrix, yaw_quaternion
from fgloc.recording.transforms import FrameTree
from fgloc.types import TransformEvent


def edge(parent: str, child: str, x: float, yaw: float, static: bool = True) -> TransformEvent:
    return TransformEvent(0, 0, "/tf", parent, child, np.array([x, 0.0, 0.0]), yaw_quaternion(yaw), static)


def test_composes_along_and_against_the_edges():
    tree = FrameTree(
        [edge("base", "mast", 1.0, 0.5), edge("mast", "camera", 0.2, -0.3), edge("base", "lidar", 0.4, 0.1)]
    )
    T_base_camera = transform_matrix([1, 0, 0], yaw_quaternion(0.5)) @ transform_matrix(
        [0.2, 0, 0], yaw_quaternion(-0.3)
    )
    np.testing.assert_allclose(tree.lookup("base", "camera"), T_base_camera, atol=1e-12)
    np.testing.assert_allclose(tree.lookup("camera", "base"), np.linalg.inv(T_base_camera), atol=1e-12)
    T_base_lidar = transform_matrix([0.4, 0, 0], yaw_quaternion(0.1))
    np.testing.assert_allclose(tree.lookup("lidar", "camera"), np.linalg.inv(T_base_lidar) @ T_base_camera, atol=1e-12)
    np.testing.assert_array_equal(tree.lookup("base", "base"), np.eye(4))
    assert tree.frames == ("base", "camera", "lidar", "mast")


def test_ros1_slashes_do_not_matter():
    tree = FrameTree([edge("/base", "/camera", 1.0, 0.0)])
    assert tree.lookup("base", "/camera")[0, 3] == 1.0
    assert "/base" in tree


def test_repeated_and_moving_transforms():
    fixed = [edge("base", "camera", 1.0, 0.0, static=False) for _ in range(3)]
    moving = [edge("odom", "base", 0.1 * k, 0.0, static=False) for k in range(3)]
    tree = FrameTree(fixed + moving)
    assert tree.lookup("base", "camera")[0, 3] == 1.0
    with pytest.raises(RecordingError, match="'base' moves against 'odom'"):
        tree.lookup("odom", "camera")
    turning = FrameTree([edge("base", "pan", 0.0, 0.3 * k, static=False) for k in range(2)])
    with pytest.raises(RecordingError, match="'pan' moves against 'base'"):
        turning.lookup("base", "pan")


def test_two_trees_and_nonsense():
    tree = FrameTree(
        [
            edge("a", "b", 1.0, 0.0),
            edge("c", "d", 1.0, 0.0),
            edge("self", "self", 1.0, 0.0),
            TransformEvent(0, 0, "/tf", "a", "zero", np.zeros(3), np.zeros(4), True),
            TransformEvent(0, 0, "/tf", "a", "huge", np.zeros(3), np.full(4, 1e300), True),
            TransformEvent(0, 0, "/tf", "a", "nan", np.full(3, np.nan), yaw_quaternion(0.0), True),
        ]
    )
    assert tree.frames == ("a", "b", "c", "d")
    with pytest.raises(RecordingError, match=r"'a'.*'d'"):
        tree.lookup("a", "d")
