"""Pose and installation together: prediction, innovation and correction of their joint Gaussian.

Sources: Thrun, Burgard, Fox, Probabilistic Robotics, chapter 7, with the state augmented by the installation; Bell and
Cathey 1993, "The iterated Kalman filter update as a Gauss-Newton method".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from fgloc import se2
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import Installation, InstallationEstimate
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import sighting_whitening
from fgloc.graph.observation import Lines
from fgloc.sensors.measurements import LandmarkMeasurement
from fgloc.stats import ROUNDING
from fgloc.types import FloatArray, MotionMeasurement

FAR_M2 = 1e2  # m²: variance of a position that nothing tells
# Sightings of one step that are weighed together, of which the work grows with the square: more than an image shows
# come in a burst. Of more, those of the least NIS are; the others are held against what these agree on.
MOST_JOINT = 16
MOST_STEPS = 6  # of Gauss-Newton: it has arrived after two or three, or does not
LINEAR_M, LINEAR_RAD = 0.05, 0.02  # sigmas of a pose up to which a sighting is linear in it, to a fifth of a pixel
EXACT = 1e-5  # sigma of a state that is taken as exact, in its own unit
_STILL = math.sqrt(ROUNDING)  # sigmas: a step of Gauss-Newton this small is the last one


def fuse(motions: Sequence[MotionMeasurement]) -> tuple[FloatArray, FloatArray]:
    """One motion ``(3,)`` and covariance ``(3, 3)`` out of independent ones over the same interval.

    First order: the mean of the logarithms about the first motion, weighted by information.
    """
    motion, cov, _ = fuse_installed(motions)
    return motion, cov


def fuse_installed(
    motions: Sequence[MotionMeasurement],
) -> tuple[FloatArray, FloatArray, dict[str, tuple[FloatArray, float]]]:
    """Fused motion and covariance as `fuse`, and its derivatives by the parameters that it depends on."""
    first = motions[0]
    if len(motions) == 1:
        return first.motion, first.cov, dict(first.depends_on)
    weights = [np.linalg.inv(m.cov) for m in motions]
    cov = np.linalg.inv(np.sum(weights, axis=0))
    cov = 0.5 * (cov + cov.T)
    pull = np.zeros(3)
    depends: dict[str, tuple[FloatArray, float]] = {}
    for m, weight in zip(motions, weights, strict=True):
        share = cov @ weight
        pull += share @ se2.log(se2.between(first.motion, m.motion))
        for name, (derivative, assumed) in m.depends_on.items():
            before = depends.get(name, (np.zeros(3), assumed))[0]
            depends[name] = before + share @ derivative, assumed
    return se2.compose(first.motion, se2.exp(pull)), cov, depends


def transition(motions: Sequence[MotionMeasurement], installation: Installation) -> tuple[FloatArray, FloatArray]:
    """Derivatives ``(3, 3)`` and ``(3, n)`` of the pose after these motions by the pose before and the installation."""
    motion, _, depends = fuse_installed(motions)
    return se2.adjoint(se2.inverse(motion)), as_installed(motion, depends, installation)[1]


def as_installed(
    motion: FloatArray,
    depends: Mapping[str, tuple[FloatArray, float]],
    installation: Installation,
    theta: FloatArray | None = None,
    width: int | None = None,
) -> tuple[FloatArray, FloatArray]:
    """A motion ``(3,)`` with another installation, and its derivative ``(3, width)`` by the installation.

    Args:
        motion: with the installation that was assumed.
        depends: its derivatives, and what was assumed.
        installation: parameters.
        theta: ``(n,)`` the installation; None: as assumed.
        width: the first parameters of it by which the derivative is wanted; None: all.
    """
    D = np.zeros((3, len(installation) if width is None else width))
    for name, (derivative, assumed) in depends.items():
        if name in installation.index:
            i = installation.index[name]
            D[:, i] = derivative
            if theta is not None:
                motion = se2.compose(motion, se2.exp(derivative * (theta[i] - assumed)))
    return motion, D


def predict_on_plane(
    belief: PoseWithCovariance,
    known: InstallationEstimate,
    installation: Installation,
    motions: Sequence[MotionMeasurement],
) -> PoseWithCovariance:
    """Pose and installation after the motions of one step."""
    motion, cov, depends = fuse_installed(motions)
    motion, D = as_installed(motion, depends, installation, known.mean)
    A = se2.adjoint(se2.inverse(motion))
    cross = np.zeros_like(D) if belief.cross is None else belief.cross
    across = A @ cross
    after = A @ belief.cov @ A.T + across @ D.T + D @ across.T + D @ known.cov @ D.T + cov
    return PoseWithCovariance(se2.compose(belief.pose, motion), 0.5 * (after + after.T), across + D @ known.cov, known)


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """Innovation of the sightings of one step against a prediction.

    Attributes:
        residual: ``(d,)`` predicted minus measured.
        H: ``(d, 3 + n)`` by pose and installation.
        cov: ``(d, d)`` of the residual.
    """

    residual: FloatArray
    H: FloatArray
    cov: FloatArray


def innovation(P: FloatArray, lines: Lines) -> Innovation:
    """The innovation of sightings, linearized at the belief whose joint covariance ``P`` is."""
    return Innovation(lines.residual, lines.H, lines.H @ P @ lines.H.T + lines.noise())


def nis_of_each(found: Innovation, lines: Lines) -> list[float]:
    """Squared Mahalanobis distance of each sighting by itself."""
    m, d = len(lines), max(lines.dofs, default=0)
    if m * d == len(found.residual):  # all of one size: in one call
        each = np.arange(m)
        covs, r = found.cov.reshape(m, d, m, d)[each, :, each], found.residual.reshape(m, d)
        try:
            white = np.linalg.solve(np.linalg.cholesky(covs), r[:, :, None])
            return [float(nis) for nis in (white**2).sum(axis=(1, 2))]
        except np.linalg.LinAlgError:  # next to the image plane: one by one, without its tiny values
            pass
    return [
        float(np.sum((sighting_whitening(found.cov[part, part]) @ found.residual[part]) ** 2)) for part in lines.parts
    ]


def correct(
    belief: PoseWithCovariance,
    known: InstallationEstimate,
    measurements: Sequence[LandmarkMeasurement],
    factors: LandmarkFactors,
) -> tuple[PoseWithCovariance, float] | None:
    """Most probable pose and installation given prediction and sightings, by Gauss-Newton.

    Returns:
        The corrected belief, and the least squared Mahalanobis distance of sightings and prediction together (χ² of as
        many degrees of freedom as there are residuals); None where it does not converge.
    """
    observed = factors.observe(measurements)
    P = belief.joint_cov(known)
    n = len(known.mean)
    x = np.zeros(3 + n)  # tangent of the belief
    pose, theta = belief.pose, known.mean
    for _ in range(MOST_STEPS):
        lines = observed.together(pose, theta)
        if lines.behind.any():
            return None
        found = innovation(P, lines)
        try:
            factor = cho_factor(found.cov, check_finite=False)
        except np.linalg.LinAlgError:  # corners hardly in front of the camera
            return None
        gap = found.residual - found.H @ x
        after = -P @ found.H.T @ cho_solve(factor, gap, check_finite=False)
        cost = float(gap @ cho_solve(factor, gap, check_finite=False))
        step, x = after - x, after
        pose, theta = se2.compose(belief.pose, se2.exp(x[:3])), known.mean + x[3:]
        if (np.abs(step) < _STILL * np.sqrt(np.diag(P))).all():
            break
    if not np.isfinite(x).all() or (np.abs(step) > np.sqrt(np.diag(P))).any():
        return None
    gain = P @ found.H.T
    after_cov = P - gain @ cho_solve(factor, gain.T, check_finite=False)
    return PoseWithCovariance.jointly(pose, theta, 0.5 * (after_cov + after_cov.T)), cost


def conditioned(P: FloatArray, rows: Sequence[int]) -> FloatArray:
    """Joint covariance ``(m, m)`` where the states in these rows are known to be what they are expected to be."""
    gain = np.linalg.solve(P[np.ix_(rows, rows)] + EXACT**2 * np.eye(len(rows)), P[rows]).T
    rest = P - gain @ P[rows]
    return np.asarray(0.5 * (rest + rest.T))


def considered(P: FloatArray, rows: Sequence[int], prior: FloatArray) -> FloatArray:
    """Joint covariance ``(m, m)`` of an estimate that takes the states in these rows as exact, when they are not.

    Source: Bierman 1977, Factorization Methods for Discrete Sequential Estimation, chapter VIII, "consider" covariance.

    Args:
        P: with these states held by next to nothing: how the others follow them.
        rows: the states.
        prior: their covariance, which nothing that is measured makes smaller.
    """
    held = P[np.ix_(rows, rows)]
    gain = np.linalg.solve(held, P[rows]).T
    spread = P + gain @ (prior - held) @ gain.T
    return np.asarray(0.5 * (spread + spread.T))


def is_linear(belief: PoseWithCovariance) -> bool:
    """Whether sightings are as good as linear over what the pose may be."""
    cov = belief.cov
    return bool(max(cov[0, 0], cov[1, 1]) < LINEAR_M**2 and cov[2, 2] < LINEAR_RAD**2)
