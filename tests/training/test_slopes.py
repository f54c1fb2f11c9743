"""Slopes in training: truth in the robot's plane, and the direction of gravity as an input."""

from __future__ import annotations

import numpy as np
import pytest

from fgloc import se2
from fgloc.frames import rpy_matrix
from fgloc.graph.ground import GRAVITY, driven
from fgloc.sensors.base import Mounting
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.learned.card import CHANNELS
from fgloc_training.data import in_robots_plane


def test_the_truth_on_a_slope_is_unrolled_to_the_robots_plane() -> None:
    """Driven over changing slopes by motions in its own plane, the robot's truth gives these motions back."""
    rng = np.random.default_rng(2)
    poses, ground, flat = [np.array([1.0, -1.0, 0.4])], [np.array([0.1, 0.05, -0.2])], [np.array([1.0, -1.0, 0.4])]
    for _ in range(300):
        motion, turn = np.array([0.008, 0.0, rng.normal(0.0, 0.02)]), rng.normal(0.0, 0.004, 2)
        planar, climbed, after = driven(ground[-1][None, 1:], motion[None], turn[None])
        poses.append(se2.compose(poses[-1], planar[0]))
        ground.append(np.array([ground[-1][0] + climbed[0], *after[0]]))
        flat.append(se2.compose(flat[-1], motion))
    found = in_robots_plane(np.array(poses), np.array(ground))
    np.testing.assert_allclose(found[:, :2], np.array(flat)[:, :2], atol=2e-3)
    np.testing.assert_allclose(se2.wrap_array(found[:, 2] - np.array(flat)[:, 2]), 0.0, atol=1e-3)
    assert np.abs(np.array(poses)[-1] - found[-1])[:2].max() > 0.01  # in the map it went elsewhere


def test_a_flat_floor_is_left_as_it_is() -> None:
    poses = np.random.default_rng(1).normal(0.0, 1.0, (10, 3))
    assert in_robots_plane(poses, np.zeros((10, 3))) is poses


@pytest.mark.parametrize("mounted", [np.eye(3), rpy_matrix(np.pi, 0.0, 0.0), rpy_matrix(0.0, 0.3, 0.0)])
def test_models_may_read_the_direction_of_gravity(mounted) -> None:
    """Nose up by 10 degrees, left side up by 5; the IMU may be upside down, or nod."""
    channel = CHANNELS["gravity"]
    force = rpy_matrix(np.radians(5.0), -np.radians(10.0), 0.7).T @ np.array([0.0, 0.0, GRAVITY])
    events = [
        ImuEvent(i * 10**7, i * 10**7, "/imu", "imu", np.zeros(3), mounted.T @ force, np.zeros((3, 3)))
        for i in range(20)
    ]
    signal = channel.signal(events, 0, Mounting(imu_up=mounted[2]))
    assert signal is not None
    found = signal.means(np.array([0.05, 0.15]))
    np.testing.assert_allclose(found[0], force[:2] / GRAVITY, atol=1e-6)
    still = [ImuEvent(0, 0, "/imu", "imu", np.zeros(3), np.zeros(3), np.zeros((3, 3)))]
    assert channel.signal(still, 0, Mounting()) is None


def test_the_order_of_channels_that_models_were_trained_with_is_kept() -> None:
    assert list(CHANNELS) == ["gyro", "effort", "wheels", "gravity"]
