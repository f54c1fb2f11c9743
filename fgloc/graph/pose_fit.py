"""The place that sightings tell: the pose that explains them best, and how well it does."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import lru_cache

import gtsam
import numpy as np
from scipy.stats import chi2

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.factors import MIN_DEPTH_M, LandmarkFactors, pose_key, whitened
from fgloc.graph.measurement_log import Belief, Sighting
from fgloc.types import CornerMeasurement, FloatArray, LandmarkMeasurement

_GAUSS_NEWTON_STEPS = 4
_FAIR = 1.0  # half the squared sigmas of a residual; 0.5 are expected
_BEHIND_COST = 1e3  # of a marker that was seen although it is behind the camera


@lru_cache(maxsize=256)
def chi2_bound(probability: float, dof: int) -> float:
    """χ² quantile."""
    return float(chi2.ppf(probability, dof))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose that sightings alone give: covariance of the right perturbation, robust cost, number of residuals."""

    pose: FloatArray
    cov: FloatArray
    cost: float
    dof: int

    @property
    def redundancy(self) -> int:
        """How many residuals there are more than are needed for a pose."""
        return self.dof - 3

    def bound(self, probability: float) -> float:
        """What the cost exceeds as seldom as one minus this."""
        return chi2_bound(probability, max(self.redundancy, 1))


def joint_fit(
    start: FloatArray,
    sightings: Sequence[LandmarkMeasurement],
    factors: LandmarkFactors,
    config: Config,
    iterations: int = 4 * _GAUSS_NEWTON_STEPS,
) -> Fit | None:
    """Best pose of one base for sightings all made from it, from a starting pose; None if it is not determined.

    Gauss–Newton with Cauchy weights, so that one wrong sighting does not spoil the place.
    """
    made = [(m, factors.make(0, m, None)) for m in sightings]
    pose, previous = start, math.inf
    for _ in range(iterations):
        normal, pull, cost, dof = np.zeros((3, 3)), np.zeros(3), 0.0, 0
        values = values_at(0, pose)
        for m, unary in made:
            if _is_behind(m, pose, factors):
                cost, dof = cost + _BEHIND_COST, dof + 8  # cannot be projected: as wrong as can be, and without a pull
                continue
            r, J = whitened(unary, values, None)
            k = cauchy_k(m, config)
            weight = k**2 / (k**2 + float(r @ r) / len(r) * 2.0)  # as if of one two-dimensional sighting
            cost += _robust_cost(r, k)
            dof += len(r)
            normal += weight * J.T @ J
            pull += weight * J.T @ r
        if np.linalg.matrix_rank(normal, tol=1e-9 * max(np.trace(normal), 1e-300)) < 3:
            return None
        if abs(previous - cost) < 1e-6 * max(cost, 1e-9):
            break
        previous = cost
        pose = se2.compose(pose, se2.exp(_solve(normal, -pull)))
    cov = np.linalg.inv(normal)
    return Fit(pose, 0.5 * (cov + cov.T), cost, dof)


def sighting_cost(
    pose: FloatArray, m: LandmarkMeasurement, factors: LandmarkFactors, config: Config
) -> tuple[float, int] | None:
    """Robust cost and degrees of freedom of one sighting made from a pose; None if it cannot have been."""
    if _is_behind(m, pose, factors):
        return None
    r, _ = whitened(factors.make(0, m, None), values_at(0, pose), None)
    return _robust_cost(r, cauchy_k(m, config)), len(r)


def cauchy_k(m: LandmarkMeasurement, config: Config) -> float:
    """Cauchy constant of a sighting of this kind, in units of its sigma."""
    return (config.markers if isinstance(m, CornerMeasurement) else config.landmarks).cauchy_k


def _robust_cost(residual: FloatArray, k: float) -> float:
    """Cauchy's cost of a whitened residual, as if it were that of two-dimensional sightings."""
    pairs = len(residual) / 2.0
    return k**2 * math.log1p(float(residual @ residual) / pairs / k**2) * pairs


def joint_nis(
    k: int, sighting: Sighting, predicted: Belief, factors: LandmarkFactors, residual: FloatArray, J: FloatArray
) -> float:
    """Least ``|x ⊖ predicted|²_P + |h(x)|²_R`` over poses x: the NIS without the linearisation at the prediction."""
    information = np.asarray(np.linalg.inv(predicted.cov), dtype=np.float64)
    m = sighting.measurement
    pose, offset, best = predicted.pose, np.zeros(3), float(residual @ residual)
    for _ in range(_GAUSS_NEWTON_STEPS):
        pose = se2.compose(pose, _newton_step(information, offset, residual, J))
        if _is_behind(m, pose, factors):
            break
        residual, J = whitened(sighting.factors, values_at(k, pose), sighting.cauchy_k)
        offset = se2.log(se2.between(predicted.pose, pose))
        best = min(best, float(offset @ information @ offset + residual @ residual))
    return best


def likeliest(k: int, predicted: Belief, sightings: Sequence[Sighting], factors: LandmarkFactors) -> FloatArray:
    """Pose that prediction and believed sightings together make likeliest: where to linearize first.

    Robust kernels weigh residuals where they are linearized: at a prediction that is far off they take sound sightings
    for outliers, and hold the pose back. Where two landmarks or more agree on a pose, it is the prediction that is off.
    """
    if len({s.measurement.landmark_id for s in sightings}) < 2 or not factors.known:
        return predicted.pose
    if any(_is_behind(s.measurement, predicted.pose, factors) for s in sightings):
        return predicted.pose
    if _fit(k, predicted.pose, sightings):
        return predicted.pose
    information = np.asarray(np.linalg.inv(predicted.cov), dtype=np.float64)
    pose = predicted.pose
    for _ in range(2):
        values, offset = values_at(k, pose), se2.log(se2.between(predicted.pose, pose))
        rows = [whitened(s.factors, values, s.cauchy_k) for s in sightings]
        residual, J = np.concatenate([r for r, _ in rows]), np.vstack([J for _, J in rows])
        pose = se2.compose(pose, _newton_step(information, offset, residual, J))
        if any(_is_behind(s.measurement, pose, factors) for s in sightings):
            return predicted.pose
    return pose if _fit(k, pose, sightings) else predicted.pose


def _is_behind(m: LandmarkMeasurement, pose: FloatArray, factors: LandmarkFactors) -> bool:
    return isinstance(m, CornerMeasurement) and factors.depth(m, pose) < MIN_DEPTH_M


def _fit(k: int, pose: FloatArray, sightings: Sequence[Sighting]) -> bool:
    """Whether the sightings are where they are expected, within their own noise."""
    values = values_at(k, pose)
    cost = sum(f.error(values) for s in sightings for f in s.factors)
    return bool(cost < _FAIR * sum(len(s.factors) * s.factors[0].dim() for s in sightings))


def _newton_step(information: FloatArray, offset: FloatArray, residual: FloatArray, J: FloatArray) -> FloatArray:
    gradient = information @ offset + J.T @ residual
    return se2.exp(_solve(information + J.T @ J, -gradient))


def _solve(A: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(A, b), dtype=np.float64)


def values_at(k: int, pose: FloatArray) -> gtsam.Values:
    """GTSAM values of one keyframe's pose."""
    values = gtsam.Values()
    values.insert(pose_key(k), gtsam.Pose2(*pose))
    return values
