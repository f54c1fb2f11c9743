"""A sighting that is moved to its keyframe is as uncertain as the motion by which it was moved."""

from __future__ import annotations

import numpy as np
import pytest

from fgloc import se2
from fgloc.config import Config, GyroConfig
from fgloc.sensors.equipment import LandmarkSensor, MotionCompensation, MotionSensors, PoseSensors
from fgloc.sensors.gyro import Gyro, ImuEvent
from fgloc.sensors.measurements import FrameMeasurement, PointMeasurement
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Landmark, LandmarkMap, Step, by_class

START, RATE = 10**18, 0.6

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


def seen_late(age_s, hz, rate=RATE):
    """Bearing at the end of a step of a beacon that was straight ahead so long before; the wheels report no turn."""
    config = Config.model_validate({"wheels": {"source": "twist"}})
    end, zeros = START + 500_000_000, np.zeros((6, 6))
    times = [START + round(k * 5e8 / (0.5 * hz)) for k in range(round(0.5 * hz) + 1)]
    turns = [ImuEvent(t, t, "/imu", "imu", np.array([0.0, 0.0, rate]), np.zeros(3), np.zeros((3, 3))) for t in times]
    still = (np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), zeros, np.zeros(3), np.zeros(3), zeros)
    wheels = [OdometryEvent(t, t, "/odom", "odom", "base_link", *still) for t in (START, end)]
    then = end - round(age_s * 1e9)
    seen = RangeBearingEvent(then, then, "/landmarks", "base_link", (RangeBearing(1, 3.0, 0.0),))
    landmarks = LandmarkMap({1: Landmark(1, np.array([3.0, 0.0, 0.0]), np.eye(3), 0.0)})
    sensors = MotionSensors(WheelMotion(config.wheels), gyro=Gyro(GyroConfig()))
    moved = MotionCompensation(PoseSensors(LandmarkSensor(config, landmarks, None, None)), sensors, 0.0)
    (found,) = moved.measure(Step(0, 0, START, end, by_class((*wheels, *turns)), (seen,)), 0.0)
    return found.bearing_rad


@pytest.mark.parametrize("age_s", [0.05, 0.3, 0.5])
def test_a_sighting_is_moved_by_the_turn_of_the_gyro_however_old_it_is(age_s):
    """A dead wheel reported half of the turn: sightings half a second old agreed on a yaw that was 0.2 rad off."""
    assert seen_late(age_s, hz=50.0) == pytest.approx(-RATE * age_s, abs=1e-6)


def test_a_gyro_that_is_silent_for_long_does_not_move_a_sighting():
    assert seen_late(0.5, hz=4.0) == 0.0
