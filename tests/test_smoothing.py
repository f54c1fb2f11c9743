"""Batch smoothing: velocities of a trajectory, and the smoother against the filter."""

from __future__ import annotations

import numpy as np
import pytest

from fgloc import se2
from fgloc.smoothing import smoothed_velocities

STEP_NS = 100_000_000


def arc(v: float, omega: float, n: int) -> np.ndarray:
    return np.array([se2.exp((v * 0.1 * k, 0.0, omega * 0.1 * k)) for k in range(n)])


@pytest.mark.parametrize(("v", "omega"), [(0.5, 0.0), (0.4, 0.6), (-0.3, -0.8), (0.0, 1.0)])
def test_velocities_on_an_arc_are_its_own(v, omega):
    stamps = np.arange(60, dtype=np.int64) * STEP_NS
    velocities = smoothed_velocities(stamps, arc(v, omega, 60))
    assert velocities.shape == (60, 2)
    inside = velocities[3:-3]  # within 0.3 s of the ends the differences reach less far
    assert np.allclose(inside[:, 1], omega, atol=1e-9)
    assert np.allclose(inside[:, 0], v, atol=2e-3)
    assert np.allclose(velocities, (v, omega), atol=5e-3)


def test_velocity_is_that_at_the_start_of_the_step():
    """Speed rises by 1 m/s²: at the start of the step from t - 0.1 to t it is t - 0.1."""
    t = np.arange(60) * 0.1
    poses = np.column_stack([0.5 * t**2, np.zeros(60), np.zeros(60)])
    velocities = smoothed_velocities((t * 1e9).round().astype(np.int64), poses)
    assert np.allclose(velocities[5:-5, 0], t[5:-5] - 0.1, atol=0.01)


def test_velocity_through_the_turn_of_yaw():
    stamps = np.arange(80, dtype=np.int64) * STEP_NS
    velocities = smoothed_velocities(stamps, arc(0.3, 1.0, 80))  # yaw wraps at 3.14 s
    assert np.allclose(velocities[3:-3, 1], 1.0, atol=1e-9)
