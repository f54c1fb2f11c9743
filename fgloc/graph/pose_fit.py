"""The place that sightings tell: the pose that explains them best, and how well it does."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.stats import chi2

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.factors import LandmarkFactors
from fgloc.types import CornerMeasurement, FloatArray, LandmarkMeasurement

_GAUSS_NEWTON_STEPS = 4
_HUBER = 0.95
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

    Gauss-Newton with Cauchy weights, so that one wrong sighting does not spoil the place. What is not known of the
    installation is taken for noise of each sighting by itself.
    """
    fitted = PoseFit(sightings, factors, config)
    return fitted.solve(start, iterations)


class PoseFit:
    """Sightings of one base, to be fitted from several starting poses."""

    def __init__(self, sightings: Sequence[LandmarkMeasurement], factors: LandmarkFactors, config: Config) -> None:
        self._observed = factors.observe(sightings)
        self._factors = factors
        self._k = [cauchy_k(m, config) for m in sightings]

    def solve(self, start: FloatArray, iterations: int) -> Fit | None:
        """As `joint_fit`."""
        theta, pose, previous = self._factors.believed.mean, start, math.inf
        whiten: list[FloatArray] | None = None
        for step in range(iterations):
            lines = self._observed.linearize(pose, theta)
            if whiten is None or step == 1:  # the noise hardly depends on the pose, once it is about right
                whiten = [np.eye(8) if one.behind else self._factors.whitening(one) for one in lines]
            normal, pull, cost, dof = np.zeros((3, 3)), np.zeros(3), 0.0, 0
            for one, W, k in zip(lines, whiten, self._k, strict=True):
                dof += len(one.residual)
                if one.behind:
                    cost += _BEHIND_COST  # cannot be projected: as wrong as can be, and without a pull
                    continue
                r, J = W @ one.residual, W @ one.J
                square = float(r @ r)
                weight = k**2 / (k**2 + square / len(r) * 2.0)  # as if of one two-dimensional sighting
                cost += _robust_cost(square, len(r), k)
                normal += weight * J.T @ J
                pull += weight * J.T @ r
            if np.linalg.matrix_rank(normal, tol=1e-9 * max(np.trace(normal), 1e-300)) < 3:
                return None
            if abs(previous - cost) < 1e-6 * max(cost, 1e-9):
                break
            previous = cost
            pose = se2.compose(pose, se2.exp(np.asarray(np.linalg.solve(normal, -pull), dtype=np.float64)))
        cov = np.linalg.inv(normal)
        return Fit(pose, 0.5 * (cov + cov.T), cost, dof)


def sighting_costs(
    pose: FloatArray, sightings: Sequence[LandmarkMeasurement], factors: LandmarkFactors, config: Config
) -> list[tuple[float, int] | None]:
    """Robust cost and degrees of freedom of each sighting made from a pose; None if it cannot have been."""
    costs: list[tuple[float, int] | None] = []
    for m, one in zip(sightings, factors.linearize(sightings, pose), strict=True):
        if one.behind:
            costs.append(None)
            continue
        r = factors.whitening(one) @ one.residual
        costs.append((_robust_cost(float(r @ r), len(r), cauchy_k(m, config)), len(r)))
    return costs


def cauchy_k(m: LandmarkMeasurement, config: Config) -> float:
    """Cauchy constant of a sighting of this kind, in units of its sigma."""
    return (config.markers if isinstance(m, CornerMeasurement) else config.landmarks).cauchy_k


def _robust_cost(square: float, dof: int, k: float) -> float:
    """Cauchy's cost of a squared whitened residual, as if it were that of two-dimensional sightings."""
    pairs = dof / 2.0
    return k**2 * math.log1p(square / pairs / k**2) * pairs


def robust_weight(nis: float, dof: int) -> float:
    """Huber's weight of a sighting with this squared Mahalanobis distance: 1 up to what one in twenty exceeds."""
    bound = chi2_bound(_HUBER, dof)
    return 1.0 if nis <= bound else math.sqrt(bound / nis)
