"""The pose that explains sightings best, how well it does, and when a place that they agree on is certain."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.joint import MOST_STEPS
from fgloc.graph.observation import Batch, Stacked
from fgloc.sensors.measurements import LandmarkMeasurement
from fgloc.stats import ROUNDING, chi2_bound
from fgloc.types import FloatArray, IntArray

# --- The fit ----------------------------------------------------------------------------------------------------------

REDUNDANT = se2.DOF  # residuals more than a pose needs that check it: two markers, but three beacons
# Times its own: variance by the installation of a sighting next to the image plane, and squared residual of one behind
_TELLS_NOTHING = 1.0 / ROUNDING


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
        return self.dof - se2.DOF

    def is_checked(self, probability: float) -> bool:
        """Whether sightings that fit it so well check each other; a sound fit passes with this probability."""
        return self.redundancy >= REDUNDANT and self.cost <= chi2_bound(probability, self.redundancy)


def fit_pose(
    start: FloatArray,
    sightings: Sequence[LandmarkMeasurement],
    factors: LandmarkFactors,
) -> Fit | None:
    """Best pose of one base for sightings all made from it, from a starting pose; None if it is not determined.

    Gauss-Newton with Cauchy weights, so that one wrong sighting does not corrupt the place. What is not known of the
    installation is taken for noise of each sighting by itself.
    """
    return PoseFit(sightings, factors).solve(start)


def _kernel(m: LandmarkMeasurement) -> float:
    """Constant k of the Cauchy kernel in the fit of a pose [sigma]; `benchmarks.mechanisms` takes it away."""
    return m.cauchy_k


class PoseFit:
    """Sightings of one base, to be fitted from several starting poses."""

    def __init__(self, sightings: Sequence[LandmarkMeasurement], factors: LandmarkFactors) -> None:
        self._observed = factors.observe(sightings)
        self._theta, self._cov = factors.estimated.mean, factors.estimated.cov
        self._k = np.array([_kernel(m) for m in sightings])
        self._whitening: dict[int, FloatArray] = {}  # by kind

    def solve(self, start: FloatArray) -> Fit | None:
        """Fit the pose from a starting pose, as `fit_pose` does; None if the sightings do not determine it."""
        pose, previous = start, math.inf
        for step in range(MOST_STEPS):
            normal, pull, cost, dof = np.zeros((se2.DOF, se2.DOF)), np.zeros(se2.DOF), 0.0, 0
            for r, J, behind, d, k in self._white(pose, anew=step < 2):  # the noise hardly depends on the pose then
                square = np.where(behind, _TELLS_NOTHING, np.einsum("ni,ni->n", r, r))
                weight = np.where(behind, 0.0, k**2 / (k**2 + 2.0 * square / d))  # as if of two-dimensional sightings
                cost += float(_robust_costs(square, d, k).sum())
                dof += int(d.sum())
                normal += np.einsum("n,nij,nik->jk", weight, J, J)
                pull += np.einsum("n,nij,ni->j", weight, J, r)
            if np.linalg.matrix_rank(normal, rtol=ROUNDING) < se2.DOF:
                return None
            if abs(previous - cost) <= ROUNDING * cost:
                break
            previous = cost
            pose = se2.compose(pose, se2.exp(np.asarray(np.linalg.solve(normal, -pull), dtype=np.float64)))
        cov = np.linalg.inv(normal)
        return Fit(pose, 0.5 * (cov + cov.T), cost, dof)

    def costs(self, pose: FloatArray) -> tuple[FloatArray, IntArray]:
        """Robust cost of each sighting at a pose (the largest: it cannot have been made there), and its residuals."""
        costs, dofs = np.zeros(len(self._observed)), np.zeros(len(self._observed), dtype=int)
        for (rows, _), (r, _, behind, d, k) in zip(self._observed.batches, self._white(pose, anew=True), strict=True):
            square = np.where(behind, _TELLS_NOTHING, np.einsum("ni,ni->n", r, r))
            costs[rows] = _robust_costs(square, d, k)
            dofs[rows] = d
        return costs, dofs

    def _whiten(self, batch: Batch, stack: Stacked) -> FloatArray:
        """Whitening matrices ``(n, d, d)``; uncertainty of installation, stamps and motion between counts as noise."""
        n, d = stack.residual.shape
        cov = np.broadcast_to(np.eye(d), (n, d, d))
        if len(self._cov):
            P = self._cov[stack.columns[:, :, None], stack.columns[:, None, :]]
            cov = cov + stack.H @ P @ stack.H.transpose(0, 2, 1)
        cov = cov + np.array([g @ g.T for g in batch.shared(stack)])
        useless = stack.behind | ~(np.trace(cov, axis1=1, axis2=2) < _TELLS_NOTHING)
        noise = np.where(stack.behind, 1.0, _TELLS_NOTHING)
        cov = np.where(useless[:, None, None], noise[:, None, None] * np.eye(d), cov)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))

    def _white(
        self, pose: FloatArray, anew: bool
    ) -> Iterator[tuple[FloatArray, FloatArray, NDArray[np.bool_], IntArray, FloatArray]]:
        """For each kind: white residuals and Jacobians, mask of those behind the camera, dimensions, Cauchy k."""
        for i, (rows, batch) in enumerate(self._observed.batches):
            stack = batch.evaluate(np.broadcast_to(pose, (len(rows), 3)), self._theta, by_installation=anew)
            if anew:
                self._whitening[i] = self._whiten(batch, stack)
            W = self._whitening[i]
            r = np.einsum("nij,nj->ni", W, stack.residual)
            yield r, W @ stack.J, stack.behind, np.array(batch.rows), self._k[rows]


def _robust_costs(square: FloatArray, dof: IntArray, k: FloatArray) -> FloatArray:
    """Cauchy's costs of squared whitened residuals, as if they were those of two-dimensional sightings."""
    pairs = dof / 2.0
    return np.asarray(k**2 * np.log1p(square / pairs / k**2) * pairs)


# --- The consensus ----------------------------------------------------------------------------------------------------

MAX_SIGMA = np.array([1.0, 1.0, 0.5])  # m, m, rad: a place less certain than this is not one yet
_NEAR = 0.5  # m, rad: as far as a wheel may slip from one fix to the next; farther is another place
# Of sightings of several landmarks a place has to explain more than half, as any other place explains less then: the
# rest have wrong ids, or were moved. One that explains less than this ...
WHOLE_SHARE = 0.8
# ... has to be known better. So has the yaw by positions and ranges alone, which tell it by the motion: over a
# short way their fit has several minima. At 0.1 rad the way is ten times as long as the positions are uncertain.
_SHARP_SIGMA = 0.1  # m, rad


@dataclass(frozen=True, slots=True, eq=False)
class PoseConsensus:
    """A place, fitted to the sightings that it explains: their share of all, and of how many landmarks they are.

    The share is of the information, because of what was carried far any place explains anything; that of a landmark
    alone is of the number.
    """

    fit: Fit
    share: float
    landmarks: int
    redundancy: int  # residuals more than a pose has coordinates, each landmark counted once
    outlier_landmarks: frozenset[int]  # landmarks that it does not explain
    images: int  # or other messages, of which it explains sightings
    by_sensors: bool = False  # from registered sensors alone

    @property
    def certain(self) -> bool:
        """Whether the place explains enough sightings, and its covariance is small enough."""
        whole = self.share >= WHOLE_SHARE
        if not (whole or (self.landmarks > 1 and self.share > 0.5)) or self.fit.redundancy < 1:
            return False
        if (self.outlier_landmarks or not whole) and self.redundancy < REDUNDANT:
            return False
        if self.by_sensors and self._sigmas[2] > _SHARP_SIGMA:
            return False
        return bool((self._sigmas <= (MAX_SIGMA if whole else _SHARP_SIGMA)).all())

    @property
    def _sigmas(self) -> FloatArray:
        return np.sqrt(np.diag(self.fit.cov))


def apart(a: FloatArray, b: FloatArray) -> bool:
    """Whether two poses are further apart than `_NEAR` in position or yaw."""
    x, y, yaw = se2.between(a, b)
    return math.hypot(x, y) > _NEAR or abs(yaw) > _NEAR
