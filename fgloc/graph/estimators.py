"""The estimator of a run, by its configuration."""

from __future__ import annotations

from fgloc.config import Config
from fgloc.graph.ekf import ExtendedKalmanFilter
from fgloc.graph.estimator import Estimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import installation_of
from fgloc.graph.isam2 import IncrementalEstimator
from fgloc.sensors.equipment import MotionSensors, PoseSensors
from fgloc.types import LandmarkMap


def make_estimator(
    config: Config, landmark_map: LandmarkMap | None, motion: MotionSensors, poses: PoseSensors, keep_all: bool
) -> Estimator:
    """Fixed-lag smoother, whole graph or extended Kalman filter.

    Args:
        config: ``estimator.kind`` says which.
        landmark_map: the known map; None: landmarks are variables.
        motion: sensors that have parameters in the installation.
        poses: likewise.
        keep_all: keep the measurement log of the whole run, for the batch smoother.

    Raises:
        ConfigError: the kind needs a known map.
    """
    installation = installation_of(
        config,
        landmark_map,
        poses.landmarks.sees_corners,
        has_gyro=motion.gyro is not None,
        has_model=motion.learned is not None,
    )
    kind = ExtendedKalmanFilter if config.estimator.kind == "ekf" else IncrementalEstimator
    return kind(config.estimator, LandmarkFactors(landmark_map, installation), keep_all)
