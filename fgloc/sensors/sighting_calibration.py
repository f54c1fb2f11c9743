"""Calibration of the sightings while they are used: a range scale and a bearing offset that hold for the whole run.

A sensor's systematic errors do not average out as noise does: taken for noise they make the covariance too small, and
the pose wrong in the same direction at every sighting of a landmark. `Calibrator` finds them online in a filter of its
own (pose and calibration together, so that it knows what it cannot tell apart); the batch smoother refines them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence

import numpy as np

from fgloc import se2
from fgloc.config import LandmarksConfig
from fgloc.types import FloatArray, LandmarkMap, LandmarkMeasurement, RangeBearingMeasurement

_GATE = 13.8  # χ², 2 dof, 0.999


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Corrections of ranges (log scale) and bearings [rad], with covariance ``(2, 2)``."""

    value: FloatArray
    cov: FloatArray

    def apply(self, m: LandmarkMeasurement) -> LandmarkMeasurement:
        """The sighting corrected; what is not known of the correction is added to its covariance."""
        if not isinstance(m, RangeBearingMeasurement):
            return m
        log_scale, offset = self.value
        corrected = shifted(m, log_scale, offset)
        J = np.array([[0.0, 1.0], [corrected.range_m, 0.0]])
        return dataclasses.replace(corrected, cov=corrected.cov + J @ self.cov @ J.T)


def shifted(m: RangeBearingMeasurement, log_scale: float, offset: float) -> RangeBearingMeasurement:
    """The sighting with its range scaled by exp(log_scale) and the offset [rad] taken off its bearing."""
    return dataclasses.replace(m, range_m=m.range_m * math.exp(log_scale), bearing_rad=se2.wrap(m.bearing_rad - offset))


def prior(config: LandmarksConfig) -> FloatArray:
    """Covariance ``(2, 2)`` of log scale and bearing offset before anything was seen."""
    return np.diag([config.range_scale_sigma**2, config.bearing_bias_sigma_rad**2])


class Calibrator:
    """Extended Kalman filter over pose (right perturbation), log range scale and bearing offset.

    Source: the textbook EKF (Thrun, Burgard, Fox, Probabilistic Robotics, 2005, chapter 7), state augmented by the
    calibration.
    """

    def __init__(self, config: LandmarksConfig, landmark_map: LandmarkMap) -> None:
        self._map = landmark_map
        self._pose = np.zeros(3)
        self._value = np.zeros(2)
        self._cov = np.zeros((5, 5))
        self._cov[3:, 3:] = prior(config)

    @property
    def calibration(self) -> Calibration:
        """What is known now."""
        return Calibration(self._value.copy(), self._cov[3:, 3:].copy())

    def start(self, pose: FloatArray, cov: FloatArray) -> None:
        """A new segment: a pose unconnected to the one before; the calibration is kept."""
        self._pose = pose.copy()
        calibration = self._cov[3:, 3:].copy()
        self._cov = np.zeros((5, 5))
        self._cov[:3, :3], self._cov[3:, 3:] = cov, calibration

    def take(self, pose: FloatArray, value: FloatArray, cov: FloatArray) -> None:
        """Another filter over the same state knows better; ``cov`` (5, 5) of pose and calibration."""
        self._pose, self._value, self._cov = pose.copy(), value.copy(), cov.copy()

    def step(self, motion: FloatArray, cov: FloatArray, sightings: Iterable[LandmarkMeasurement]) -> None:
        """Move, then take in sightings as they were before correction (with the covariance they are used with)."""
        F = np.eye(5)
        F[:3, :3] = se2.adjoint(se2.inverse(motion))
        self._pose = se2.compose(self._pose, motion)
        self._cov = F @ self._cov @ F.T
        self._cov[:3, :3] += cov
        for m in sightings:
            if isinstance(m, RangeBearingMeasurement):
                self._see(m)

    def _see(self, m: RangeBearingMeasurement) -> None:
        seen = shifted(m, *self._value)
        landmark = self._map.landmarks[m.landmark_id].position
        x, y, _ = se2.compose(se2.inverse(self._pose), (landmark[0], landmark[1], 0.0))
        r2 = x * x + y * y
        r = math.sqrt(r2)
        difference = np.array([se2.wrap(seen.bearing_rad - math.atan2(y, x)), seen.range_m - r])
        d_point = np.array([[-1.0, 0.0, y], [0.0, -1.0, -x]])
        H = np.zeros((2, 5))  # derivative of the difference: bearing, range
        H[:, :3] = -np.array([[-y / r2, x / r2], [x / r, y / r]]) @ d_point
        H[0, 4], H[1, 3] = -1.0, seen.range_m
        S = H @ self._cov @ H.T + m.cov
        if float(difference @ np.linalg.solve(S, difference)) > _GATE:
            return
        K = np.linalg.solve(S, H @ self._cov).T
        update = -K @ difference
        self._pose = se2.compose(self._pose, se2.exp(update[:3]))
        self._value = self._value + update[3:]
        rest = np.eye(5) - K @ H
        self._cov = rest @ self._cov @ rest.T + K @ m.cov @ K.T


def calibration_gradient(
    poses: Sequence[FloatArray],
    sightings: Sequence[RangeBearingMeasurement],
    landmark_map: LandmarkMap,
    cauchy_k: float,
) -> FloatArray:
    """Gradient ``(2,)`` of the robust cost ``½ Σ ρ`` with respect to the calibration, poses fixed.

    Args:
        poses: base pose of each sighting.
        sightings: as corrected so far.
        landmark_map: known map.
        cauchy_k: Cauchy constant of the kernel.

    Returns:
        Derivatives by log scale and bearing offset.
    """
    gradient = np.zeros(2)
    for pose, m in zip(poses, sightings, strict=True):
        landmark = landmark_map.landmarks[m.landmark_id].position
        x, y, _ = se2.compose(se2.inverse(pose), (landmark[0], landmark[1], 0.0))
        difference = np.array([se2.wrap(m.bearing_rad - math.atan2(y, x)), m.range_m - math.hypot(x, y)])
        information = np.linalg.inv(m.cov)
        J = np.array([[0.0, -1.0], [m.range_m, 0.0]])
        weight = 1.0 / (1.0 + float(difference @ information @ difference) / cauchy_k**2)
        gradient += weight * J.T @ information @ difference
    return gradient
