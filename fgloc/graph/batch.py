"""The batch smoother: Levenberg–Marquardt over the whole log, started from the incremental result."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import gtsam
import numpy as np

from fgloc import se2
from fgloc.config import BatchConfig
from fgloc.errors import EstimatorError
from fgloc.graph.batch_solve import estimated_landmarks, initial_values, solvable, with_deep_stack, without_orphans
from fgloc.graph.factors import (
    INSTALLATION,
    LandmarkFactors,
    installed_motion_factor,
    pose_key,
    prior_factor,
    sighting_factors,
)
from fgloc.graph.installation import InstallationBelief
from fgloc.graph.measurement_log import LandmarkFactor, MeasurementLog
from fgloc.stats import chi2_bound
from fgloc.types import (
    FloatArray,
    IntArray,
    Landmark,
    MotionMeasurement,
    PixelMeasurement,
)

_LINEARIZATIONS = 6
_STILL = np.array([1e-4, 1e-4, 1e-5])  # m, m, rad: poses that move less have arrived ...
_STILL_SIGMAS = 0.02  # ... and an installation, in units of its prior


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """The result: keyframes in order."""

    stamps_ns: IntArray  # (n,)
    poses: FloatArray  # (n, 3)
    covs: FloatArray  # (n, 3, 3) right perturbation (body frame)
    landmarks: Mapping[int, Landmark]  # those that were variables
    factors: int  # held by the last graph
    error: float  # its GTSAM error


class BatchSmoother:
    """Solves the whole log, as often as what depends on the solution is measured again.

    It holds the sightings that were accepted online. Of an unknown map, sightings that the first solution finds less
    likely than ``1 - gate_probability`` are left out.

    Attributes:
        frames: the keyframes.
        accepted: the sightings in the graph, by keyframe.
    """

    def __init__(
        self,
        log: MeasurementLog,
        factors: LandmarkFactors,
        config: BatchConfig,
        gate_probability: float,
    ) -> None:
        """Take the log, whose filtered beliefs are the initial values.

        Raises:
            EstimatorError: the log is empty.
        """
        self.frames = list(log.keyframes.values())
        if not self.frames:
            raise EstimatorError("nothing to smooth: no keyframe was made; see the notes and the rejections of the run")
        self._factors = factors
        self._config = config
        self._probability = gate_probability
        self.accepted = {frame.k: frame.sightings for frame in self.frames}
        self._values = initial_values(self.frames, self.accepted, self._factors)
        self._optimize()
        if not factors.known:
            self._leave_out_unlikely()

    def _leave_out_unlikely(self) -> None:
        """Of an unknown map: leave out sightings that the solution finds unlikely, and solve again."""
        self.accepted = {
            k: tuple(s for s in held if _nis(s, self._values) <= chi2_bound(self._probability, _dof(s)))
            for k, held in self.accepted.items()
        }
        self._optimize()

    def stamps_ns(self) -> IntArray:
        """Times of the keyframes ``(n,)``."""
        return np.array([frame.stamp_ns for frame in self.frames], dtype=np.int64)

    def poses(self) -> FloatArray:
        """Smoothed poses ``(n, 3)``."""
        return np.array([_vector(self._values.atPose2(pose_key(frame.k))) for frame in self.frames])

    def replace_motions(self, motions: Mapping[int, tuple[MotionMeasurement, ...]]) -> None:
        """Take other motion measurements for these keyframes, and solve again from the last solution."""
        for frame in self.frames:
            frame.motions = motions.get(frame.k, frame.motions)
        self._optimize()

    def installed(self) -> InstallationBelief:
        """The installation that the last solution has found."""
        n = len(self._factors.installation)
        if not n:
            return InstallationBelief(np.zeros(0), np.zeros((0, 0)))
        marginals = self._marginals()
        return InstallationBelief(self._theta(), np.asarray(marginals.marginalCovariance(INSTALLATION)))

    def cost(self) -> float:
        """How badly the solution fits, half a sum of squares, for the comparison of ways to read one recording.

        Corners count by their own noise alone, ranges with the logarithm of the noise that they got on the way to their
        keyframe; a sighting that is left out counts as the least that would be refused.
        """
        total = float(self._of_motion().error(self._values))
        seen = [
            (pose, s)
            for frame, pose in zip(self.frames, self.poses(), strict=True)
            for s in (*frame.sightings, *frame.refused)
        ]
        if not self._factors.known or not seen:
            factors = [f for held in self.accepted.values() for s in held for f in s.factors]
            return total + sum(f.error(self._values) for f in factors)
        observed = self._factors.observe([s.measurement for _, s in seen])
        lines = observed.linearize(np.array([pose for pose, _ in seen]), self._theta())
        for (_, s), one in zip(seen, lines, strict=True):
            bound = chi2_bound(self._probability, len(one.residual))
            total += 0.5 * (bound if one.behind else min(bound, float(one.residual @ one.residual)))
            if not isinstance(s.measurement, PixelMeasurement):
                total += 0.5 * float(np.linalg.slogdet(s.alone.cov)[1])  # type: ignore[union-attr]
        return total

    def result(self) -> Smoothed:
        """The last solution with its covariances.

        Raises:
            EstimatorError: the graph leaves a pose undetermined.
        """
        marginals = self._marginals()
        return with_deep_stack(lambda: self._result(marginals))

    def _marginals(self) -> gtsam.Marginals | gtsam.ISAM2:
        """Covariances of the solution; of long stretches that hardly anything determines, by QR."""
        try:
            return with_deep_stack(lambda: gtsam.Marginals(self._graph, self._values))
        except RuntimeError:
            params = gtsam.ISAM2Params()
            params.setFactorization("QR")
            params.relinearizeSkip = 1
            solver = gtsam.ISAM2(params)
            solvable(lambda: with_deep_stack(lambda: solver.update(self._graph, self._values)))
            return solver

    def _result(self, marginals: gtsam.Marginals | gtsam.ISAM2) -> Smoothed:
        covs = [marginals.marginalCovariance(pose_key(frame.k)) for frame in self.frames]
        return Smoothed(
            stamps_ns=self.stamps_ns(),
            poses=self.poses(),
            covs=np.array(covs),
            landmarks={} if self._factors.known else estimated_landmarks(self.accepted, self._values, marginals),
            factors=self._graph.size(),
            error=self._graph.error(self._values),
        )

    def _theta(self) -> FloatArray:
        n = len(self._factors.installation)
        return np.asarray(self._values.atVector(INSTALLATION)) if n else np.zeros(0)

    def _optimize(self) -> None:
        """Linearize the sightings anew and solve, until poses and installation stay where they are."""
        for _ in range(_LINEARIZATIONS):
            poses, theta = self.poses(), self._theta()
            graph = self._linearized()
            values = self._solve(graph, without_orphans(self._values, graph))
            if not np.isfinite(graph.error(values)):
                raise EstimatorError("the batch optimum is not finite; look at steps.csv for what broke it")
            self._values, self._graph = values, graph
            moved = np.abs(self.poses() - poses)
            moved[:, 2] = np.abs(se2.wrap_array(moved[:, 2]))
            still = bool((moved < _STILL).all())
            if still and (np.abs(self._theta() - theta) < _STILL_SIGMAS * self._factors.installation.sigmas).all():
                break

    def _linearized(self) -> gtsam.NonlinearFactorGraph:
        graph = self._of_motion()
        seen = [(f.k, pose, s) for f, pose in zip(self.frames, self.poses(), strict=True) for s in self.accepted[f.k]]
        for factor in self._sighting_factors(seen):
            graph.add(factor)
        return graph

    def _of_motion(self) -> gtsam.NonlinearFactorGraph:
        """Priors and motions, linear about the solution."""
        graph = gtsam.NonlinearFactorGraph()
        for factor in self._priors():
            graph.add(factor)
        poses = self.poses()
        for i, frame in enumerate(self.frames):
            for motion in frame.motions:
                graph.add(installed_motion_factor(frame.k, motion, poses[i - 1], self._factors.installation))
        return graph

    def _priors(self) -> Iterator[gtsam.NonlinearFactor]:
        installation = self._factors.installation
        if len(installation):
            prior = installation.prior()
            yield gtsam.PriorFactorVector(INSTALLATION, prior.mean, gtsam.noiseModel.Gaussian.Covariance(prior.cov))
        for frame in self.frames:
            if frame.prior is not None:
                yield prior_factor(frame.k, frame.prior.pose, frame.prior.cov)

    def _sighting_factors(
        self, seen: Sequence[tuple[int, FloatArray, LandmarkFactor]]
    ) -> Iterator[gtsam.NonlinearFactor]:
        """Of sightings with their keyframes and poses, keyframes in order."""
        if not self._factors.known or not seen:
            for _, _, s in seen:
                yield from s.factors
            return
        theta = self._theta()
        observed = self._factors.observe([s.measurement for _, _, s in seen])
        lines = observed.linearize(np.array([pose for _, pose, _ in seen]), theta)
        for k, group in groupby(zip(seen, lines, strict=True), key=lambda item: item[0][0]):
            kept = [(pose, s, one) for (_, pose, s), one in group if not one.behind]
            if kept:
                sightings, ahead = [s for _, s, _ in kept], [one for _, _, one in kept]
                yield from sighting_factors(k, sightings, ahead, kept[0][0], theta)

    def _solve(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(self._config.max_iterations)
        params.setLinearSolverType("SEQUENTIAL_CHOLESKY")  # the multifrontal one overflows the stack on long chains
        params.setRelativeErrorTol(1e-7)
        return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def _nis(sighting: LandmarkFactor, values: gtsam.Values) -> float:
    """Squared whitened residual without the kernel, from ``e = k²/2 · log(1 + r²/k²)`` of each robust factor."""
    total = 0.0
    for factor in sighting.factors:
        error = factor.error(values)
        k2 = None if sighting.cauchy_k is None else sighting.cauchy_k**2
        total += 2.0 * error if k2 is None else k2 * math.expm1(min(2.0 * error / k2, 700.0))
    return total


def _dof(sighting: LandmarkFactor) -> int:
    return sum(factor.dim() for factor in sighting.factors)


def _vector(pose: gtsam.Pose2) -> FloatArray:
    return np.array([pose.x(), pose.y(), pose.theta()])
