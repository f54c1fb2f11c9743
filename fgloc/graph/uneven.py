"""Prediction and factors of a step on uneven ground; the state beside the pose ends with its height, roll and pitch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from fgloc.graph.ground import Gravity, GroundStep, gravity, ground_key, ground_step
from fgloc.graph.installation import GROUND, Installation, InstallationEstimate
from fgloc.graph.joint import LINEAR_RAD, fuse_installed, joint_cov
from fgloc.graph.joint import predict as predict_on_plane
from fgloc.graph.linear_factors import INSTALLATION, linear_factor
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise_models import whitening_of
from fgloc.types import FloatArray, Ground, MotionMeasurement

_N = len(GROUND)


def predict(
    belief: PoseWithCovariance,
    known: InstallationEstimate,
    installation: Installation,
    motions: Sequence[MotionMeasurement],
) -> PoseWithCovariance:
    """Pose and installation after the motions of one step, on whichever ground."""
    if not installation.ground:
        return predict_on_plane(belief, known, installation, motions)
    step = step_of(motions, known.mean, installation)
    n, c = len(known.mean), installation.constants
    F = np.eye(n)
    F[c:, c:], F[c:, :c] = step.A, step.D
    cov = F @ known.cov @ F.T
    cov[c:, c:] += step.cov
    planar = predict_on_plane(belief, known, installation, step.motions)
    cross = planar.cross if planar.cross is not None else np.zeros((3, n))
    mean = np.concatenate([known.mean[:c], step.after])
    after = PoseWithCovariance(planar.pose, planar.cov, cross @ F.T, InstallationEstimate(mean, 0.5 * (cov + cov.T)))
    if step.turning is not None:
        H = np.zeros((2, 3 + n))
        H[:, 3 : 3 + c] = step.turning.D
        after = _corrected(after, step.turning.turn, H, step.turning.variance * np.eye(2))
        assert after.installation is not None
        mean = after.installation.mean
    return with_gravity(after, gravity(motions, mean[c:], mean, installation), installation)


def with_gravity(belief: PoseWithCovariance, seen: Gravity | None, installation: Installation) -> PoseWithCovariance:
    """Pose and installation corrected by the direction of gravity (Kalman update)."""
    known = belief.installation
    if seen is None or known is None:
        return belief
    H = np.zeros((2, 3 + len(known.mean)))
    H[:, 3 : 3 + installation.constants] = seen.D
    H[:, -2:] = np.eye(2)
    return _corrected(belief, seen.residual, H, seen.cov)


def _corrected(belief: PoseWithCovariance, residual: FloatArray, H: FloatArray, cov: FloatArray) -> PoseWithCovariance:
    known = belief.installation
    assert known is not None
    P = joint_cov(belief, known)
    gain = np.linalg.solve(H @ P @ H.T + cov, H @ P).T
    moved = -gain @ residual
    P = P - gain @ H @ P
    P = 0.5 * (P + P.T)
    theta = InstallationEstimate(known.mean + moved[3:], P[3:, 3:])
    return PoseWithCovariance(belief.pose, P[:3, :3], P[:3, 3:], theta)  # the pose itself hardly depends on it


def step_of(motions: Sequence[MotionMeasurement], theta: FloatArray, installation: Installation) -> GroundStep:
    """A step that begins at the height, roll and pitch with which ``theta (n,)`` ends."""
    return ground_step(motions, fuse_installed(motions), theta[installation.constants :], theta, installation)


def ground_factors(
    k: int, motions: Sequence[MotionMeasurement], step: GroundStep, theta: FloatArray, installation: Installation
) -> list[gtsam.NonlinearFactor]:
    """How height, roll and pitch go on from keyframe k - 1 to k, and what gravity tells of them at k."""
    made = list(step_factors(k, step, theta, installation))
    seen = gravity(motions, step.after, theta, installation)
    return made if seen is None else [*made, gravity_factor(k, seen, step.after, theta, installation)]


def step_factors(
    k: int, step: GroundStep, theta: FloatArray, installation: Installation
) -> Iterator[gtsam.NonlinearFactor]:
    """How height, roll and pitch go on from keyframe k - 1 to k, and what that tells of the IMU."""
    c = installation.constants
    if step.turning is not None and c:
        at = gtsam.Values()
        at.insert(INSTALLATION, theta[:c])
        sigma = math.sqrt(step.turning.variance)
        yield linear_factor({INSTALLATION: step.turning.D / sigma}, step.turning.turn / sigma, at)
    values = gtsam.Values()
    values.insert(ground_key(k - 1), step.before)
    values.insert(ground_key(k), step.after)
    W = whitening_of(step.cov)
    blocks = {ground_key(k - 1): -W @ step.A, ground_key(k): W}
    if c:
        values.insert(INSTALLATION, theta[:c])
        blocks[INSTALLATION] = -W @ step.D
    yield linear_factor(blocks, np.zeros(_N), values)


def gravity_factor(
    k: int, seen: Gravity, ground: FloatArray, theta: FloatArray, installation: Installation
) -> gtsam.NonlinearFactor:
    """The direction of gravity at keyframe k, linear about a height, roll and pitch and an installation."""
    values = gtsam.Values()
    values.insert(ground_key(k), ground)
    W = whitening_of(seen.cov)
    blocks = {ground_key(k): W @ np.eye(_N)[1:]}
    if installation.constants:
        values.insert(INSTALLATION, theta[: installation.constants])
        blocks[INSTALLATION] = W @ seen.D
    return linear_factor(blocks, W @ seen.residual, values)


def ground_prior(k: int, ground: FloatArray, cov: FloatArray) -> gtsam.NonlinearFactor:
    """Prior on height, roll and pitch of keyframe k."""
    return gtsam.PriorFactorVector(ground_key(k), ground, gtsam.noiseModel.Gaussian.Covariance(cov))


def starting(known: InstallationEstimate, installation: Installation) -> InstallationEstimate:
    """At a first pose: the ground there may be anything, about what was known last of roll and pitch."""
    if not installation.ground:
        return known
    prior, c = installation.prior(), installation.constants
    mean, cov = known.mean.copy(), known.cov.copy()
    mean[c] = prior.mean[c]
    cov[c:, :], cov[:, c:] = 0.0, 0.0
    cov[c:, c:] = prior.cov[c:, c:]
    return InstallationEstimate(mean, cov)


def levelled(
    known: InstallationEstimate, motions: Sequence[MotionMeasurement], installation: Installation
) -> InstallationEstimate:
    """While no pose is known: roll and pitch by gravity alone, about any height."""
    if not installation.ground:
        return known
    begun = starting(known, installation)
    mean = np.concatenate([begun.mean[: installation.constants], np.zeros(_N)])
    seen = gravity(motions, mean[-_N:], mean, installation)
    if seen is None:
        return begun
    direct = replace(seen, cov=seen.noise)  # it is far from level, not wrong
    nowhere = PoseWithCovariance(np.zeros(3), np.eye(3), None, InstallationEstimate(mean, begun.cov))
    found = with_gravity(nowhere, direct, installation).installation
    assert found is not None
    return found


def spatial(belief: PoseWithCovariance, installation: Installation, added: FloatArray) -> Ground | None:
    """Height, roll and pitch of a belief; None: the floor is flat.

    Args:
        belief: with its installation, which ends with them.
        installation: its parameters.
        added: ``(3, 3)`` to the covariance of the pose, in the body frame.
    """
    known = belief.installation
    if not installation.ground or known is None:
        return None
    cov = np.zeros((6, 6))
    cov[:3, :3], cov[3:, 3:] = belief.cov + added, known.cov[-_N:, -_N:]
    if belief.cross is not None:
        cov[:3, 3:], cov[3:, :3] = belief.cross[:, -_N:], belief.cross[:, -_N:].T
    return ground_at(known.mean[-_N:], cov, float(belief.pose[2]))


def ground_at(ground: FloatArray, cov: FloatArray, yaw: float) -> Ground:
    """Height, roll and pitch ``(3,)``, with the covariance ``(6, 6)`` of x, y, yaw (right perturbation) and those."""
    T = np.zeros((6, 6))
    c, s = math.cos(yaw), math.sin(yaw)
    T[:2, :2] = [[c, -s], [s, c]]
    T[5, 2] = 1.0
    T[2:5, 3:] = np.eye(_N)
    z, roll, pitch = ground.tolist()
    return Ground(z, roll, pitch, T @ cov @ T.T)


def is_level_known(known: InstallationEstimate, installation: Installation) -> bool:
    """Whether sightings are as good as linear over what roll and pitch may be."""
    return not installation.ground or bool((np.diag(known.cov)[-2:] < LINEAR_RAD**2).all())
