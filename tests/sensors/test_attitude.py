"""Roll and pitch by an IMU: turns over a step, and the specific force without the robot's own acceleration."""

from __future__ import annotations

import numpy as np
import pytest

from fgloc.config import GyroConfig
from fgloc.frames import rpy_matrix
from fgloc.graph.ground import GRAVITY
from fgloc.sensors.gyro import Attitude, ImuEvent
from fgloc.types import Step, by_class

START = 10**18


def step(rates, force, T_base_imu=None, seconds: float = 0.2, hz: float = 100.0) -> Step:
    """Rates and specific force in the base's axes, constant over the step."""
    R = np.eye(3) if T_base_imu is None else T_base_imu[:3, :3]
    events = []
    for i in range(-1, round(seconds * hz) + 2):
        stamp = START + round(i / hz * 1e9)
        events.append(
            ImuEvent(stamp, stamp, "/imu", "imu", R.T @ np.asarray(rates), R.T @ np.asarray(force), np.zeros((3, 3)))
        )
    return Step(0, 0, START, START + round(seconds * 1e9), by_class(events))


def still(step: Step, at_ns: int) -> np.ndarray:
    return np.zeros(3)


def test_at_rest_the_force_is_gravitys_in_the_axes_of_the_base() -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rpy_matrix(np.pi, 0.1, 0.4), (0.1, 0.0, 0.2)  # upside down
    up = rpy_matrix(0.1, -0.2, 0.0).T @ np.array([0.0, 0.0, GRAVITY])
    found = Attitude(GyroConfig(), T).measure(step(np.zeros(3), up, T), still)
    assert found is not None
    np.testing.assert_allclose(found.turn, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.force, up, atol=1e-9)


def test_turns_are_integrated_and_the_force_is_that_at_the_end() -> None:
    """Nose up by 0.1 rad over the step; the mean of the force is that of its middle."""
    rates, mid = np.array([0.0, -0.5, 0.0]), rpy_matrix(0.0, -0.05, 0.0).T @ np.array([0.0, 0.0, GRAVITY])
    found = Attitude(GyroConfig(), np.eye(4)).measure(step(rates, mid), still)
    assert found is not None
    np.testing.assert_allclose(found.turn, (0.0, -0.1), atol=1e-9)
    np.testing.assert_allclose(found.force, rpy_matrix(0.0, -0.1, 0.0).T @ [0.0, 0.0, GRAVITY], atol=1e-6)


def test_the_robots_own_acceleration_is_no_gravity() -> None:
    """It speeds up by 1 m/s² in a curve: forward, centripetal, and what the IMU's place adds."""
    place = np.eye(4)
    place[0, 3] = 0.1

    def speeding(step: Step, at_ns: int) -> np.ndarray:
        return np.array([0.3 + (at_ns - START) * 1e-9, 0.0, 0.5])

    force = np.array([1.0 - 0.5**2 * 0.1, 0.4 * 0.5, GRAVITY])  # 0.4 m/s in the mean
    found = Attitude(GyroConfig(), place).measure(step((0.0, 0.0, 0.5), force), speeding)
    assert found is not None
    np.testing.assert_allclose(found.force, [0.0, 0.0, GRAVITY], atol=0.02)


@pytest.mark.parametrize("force", [(np.nan, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_without_an_accelerometer_the_turn_is_left(force) -> None:
    found = Attitude(GyroConfig(), np.eye(4)).measure(step((0.1, 0.0, 0.0), force), still)
    assert found is not None
    assert found.force is None
    np.testing.assert_allclose(found.turn, (0.02, 0.0), atol=1e-9)


def test_a_silent_imu_measures_nothing() -> None:
    attitude, empty = Attitude(GyroConfig(), np.eye(4)), Step(0, 0, START, START + 200_000_000)
    assert attitude.measure(empty, still) is None
    assert attitude.measure(step(np.zeros(3), np.zeros(3), hz=5.0, seconds=1.0), still) is None
