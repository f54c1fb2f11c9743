"""A sighting that is moved to its keyframe is as uncertain as the motion by which it was moved."""

from __future__ import annotations

import numpy as np
import pytest

from fgloc import se2
from fgloc.sensors.measurements import FrameMeasurement, PointMeasurement

MOTION = np.array([-0.3, 0.1, 0.4])
MOTION_COV = np.diag([0.02, 0.01, 0.03]) ** 2


def normal(rng, cov):
    """4000 draws of zero mean."""
    return rng.standard_normal((4000, len(cov))) @ np.linalg.cholesky(cov).T


@pytest.mark.parametrize("own", [1e-4, 0.02])
def test_covariance_of_a_compensated_marker_pose_holds_that_of_the_motion(own):
    """Against the spread of 4000 draws of motion and sighting; the sighting's own part alone would be too small."""
    rng = np.random.default_rng(3)
    pose, cov = np.array([2.0, -0.5, 2.5]), np.eye(3) * own**2
    found = FrameMeasurement(0, 7, pose, cov).compensated(MOTION, MOTION_COV)
    draws = []
    for slip, noise in zip(normal(rng, MOTION_COV), normal(rng, cov), strict=True):
        motion, seen = se2.compose(MOTION, se2.exp(slip)), se2.compose(pose, se2.exp(noise))
        draws.append(se2.log(se2.between(found.pose, se2.compose(motion, seen))))
    spread = np.cov(np.array(draws).T)
    whitened = np.linalg.solve(np.linalg.cholesky(found.cov), np.linalg.cholesky(spread))
    np.testing.assert_allclose(np.linalg.svd(whitened, compute_uv=False), 1.0, atol=0.05)
    assert np.trace(found.cov) > np.trace(cov) + 0.5 * np.trace(MOTION_COV)


def test_covariance_of_a_compensated_range_and_bearing_holds_that_of_the_motion():
    rng = np.random.default_rng(4)
    cov = np.diag([0.005, 0.01]) ** 2  # bearing, range
    found = PointMeasurement(0, 7, 2.0, 0.3, cov).compensated(MOTION, MOTION_COV)
    draws = []
    for slip, noise in zip(normal(rng, MOTION_COV), normal(rng, cov), strict=True):
        motion = se2.compose(MOTION, se2.exp(slip))
        bearing, distance = np.array([0.3, 2.0]) + noise
        x, y, _ = se2.compose(motion, (distance * np.cos(bearing), distance * np.sin(bearing), 0.0))
        draws.append((np.arctan2(y, x) - found.bearing_rad, np.hypot(x, y) - found.range_m))
    spread = np.cov(np.array(draws).T)
    whitened = np.linalg.solve(np.linalg.cholesky(found.cov), np.linalg.cholesky(spread))
    np.testing.assert_allclose(np.linalg.svd(whitened, compute_uv=False), 1.0, atol=0.05)
