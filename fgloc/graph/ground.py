"""Uneven ground: height, roll and pitch of the base from step to step, beside its planar pose.

The pose is ``T_map_base = (x, y, yaw)`` in the plane, and ``(z, roll, pitch)``: rotations are ``Rz(yaw) Ry(pitch)
Rx(roll)``. Motion sources measure in the robot's own plane; here their motions are projected to the map's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from fgloc import se2
from fgloc.frames import rotations
from fgloc.graph.factors import INSTALLATION, ground_key, linear_factor
from fgloc.graph.installation import GROUND, Installation, InstallationEstimate
from fgloc.graph.joint import LINEAR_RAD, as_installed, fuse_installed, predict_on_plane
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import whitening_of
from fgloc.sensors.gyro import BIASES, LEVELS, TILTS
from fgloc.types import FloatArray, Ground, InertialReading, MotionMeasurement

# --- Motion and gravity on uneven ground ------------------------------------------------------------------------------

GRAVITY = 9.81  # m/s²
_CONTACT_M = 0.09  # of the wheelbase: the axle climbs a slope before the chassis has tilted by all of it
_PATH_PER_SQRT_M = 0.003  # m/√m: height of a path beside what the tilt of the chassis says
_SINK_PER_SQRT_S = 1e-4  # m/√s: of a standing robot, so that no covariance is singular
_TILT_PER_SQRT_M = 0.5  # rad/√m: without an IMU, how fast the slope changes: the edge of a ramp of 15° under 0.25 m ...
_TILT_PER_SQRT_RAD = 0.02  # rad/√rad: ... and what a turn in place does to it
_SMOOTH_PER_SQRT_M = 0.02  # rad/√m: the same of what an IMU shows to be a smooth stretch ...
_SMOOTH_PER_SQRT_RAD = 0.01  # rad/√rad: ... or a turn in place
_STILL_RAD = 2e-4  # of a robot that stands
_SLOPE_RAD = 0.15  # rad: ... about level, by as much as `fgloc.graph.installation` allows for at the start
_SUDDEN = 3.0  # Cauchy constant of the gravity's direction, in units of its sigma: slips and bumps are accelerations
_EPS = 1e-6


def _turned(vectors: FloatArray) -> FloatArray:
    """Rotations ``(m, 3, 3)`` about vectors ``(m, 3)`` by their length (Rodrigues' formula)."""
    angle = np.linalg.norm(vectors, axis=1)
    a, b = np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) + a[:, None, None] * K + b[:, None, None] * (K @ K))


def driven(angles: FloatArray, motions: FloatArray, turns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Motions in the robot's own plane, seen in the map.

    Args:
        angles: roll and pitch ``(m, 2)`` before them.
        motions: ``(m, 3)`` x, y, yaw in the robot's plane.
        turns: ``(m, 2)`` about the robot's x and y meanwhile [rad].

    Returns:
        Planar motions ``(m, 3)`` in the plane of the map, heights climbed ``(m,)``, roll and pitch ``(m, 2)`` after.
    """
    before = rotations(angles)
    half = np.column_stack([0.5 * turns, np.zeros(len(turns))])
    way = np.einsum("mij,mjk,mk->mi", before, _turned(half), motions * [1.0, 1.0, 0.0])
    R = before @ _turned(np.column_stack([turns, motions[:, 2]]))
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    after = np.column_stack([np.arctan2(R[:, 2, 1], R[:, 2, 2]), np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))])
    return np.column_stack([way[:, :2], yaw]), way[:, 2], after


@dataclass(frozen=True, slots=True, eq=False)
class GroundStep:
    """One step on uneven ground.

    Attributes:
        motions: projected to the plane of the map.
        before: height, roll, pitch ``(3,)`` at its start.
        after: ``(3,)`` at its end, as predicted.
        A: ``(3, 3)`` derivative by those before.
        D: ``(3, constants)`` derivative by the installation.
        cov: ``(3, 3)`` of what is added on the way.
        turning: what the step tells of the installation alone; None: nothing measured its turn.
    """

    motions: tuple[MotionMeasurement, ...]
    before: FloatArray
    after: FloatArray
    A: FloatArray
    D: FloatArray
    cov: FloatArray
    turning: Turning | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """A robot on smooth ground turns about its own z axis alone: what else is measured are bias and mounting.

    Attributes:
        turn: ``(2,)`` about x and y [rad], as measured, with the installation as it is known.
        D: ``(2, constants)`` its derivative by the installation.
        variance: of each, about 0.
    """

    turn: FloatArray
    D: FloatArray
    variance: float


def ground_step(
    motions: Sequence[MotionMeasurement],
    fused: tuple[FloatArray, FloatArray, Mapping[str, tuple[FloatArray, float]]],
    ground: FloatArray,
    theta: FloatArray,
    installation: Installation,
) -> GroundStep:
    """A step from its motions in the robot's plane.

    Args:
        motions: at least one.
        fused: of these, as `fgloc.graph.joint.fuse_installed` makes it.
        ground: height, roll and pitch ``(3,)`` at the start.
        theta: ``(n,)`` installation.
        installation: its parameters.
    """
    motion, motion_cov, depends = fused
    motion, by_theta = as_installed(motion, depends, installation, theta, installation.constants)
    inertial = motions[0].inertial
    measured, by_bias = _turn_of(inertial, float(motion[2]), theta, installation)
    smooth = _smooth(motion, measured)
    share = 0.0 if inertial is None else smooth / (smooth + inertial.turn_variance)
    turn = share * measured
    planar, ends, slopes = _perturbed(motions, motion, turn, ground)
    P = np.column_stack([se2.log(se2.between(planar[0], planar[5 + i])) for i in range(3)]) / _EPS
    by_turn, by_motion = slopes[:, 2:4], slopes[:, 4:]
    A = np.column_stack([np.eye(3)[:, 0], slopes[:, :2]])
    cov = by_motion @ motion_cov @ by_motion.T + _added(inertial, motion, A, ends[0, 1:] - ground[1:])
    if inertial is None:
        A = A.copy()
        A[:, 1:] *= _kept(motion)
        ends[0, 1:] *= _kept(motion)
    else:
        cov += by_turn @ by_turn.T * (share * inertial.turn_variance)
    projected = tuple(_projected(m, planar[8 + i], P) for i, m in enumerate(motions))
    turning = None if inertial is None else Turning(measured, by_bias, smooth + inertial.turn_variance)
    D = by_motion @ by_theta + share * by_turn @ by_bias
    return GroundStep(projected, ground, ends[0], A, D, cov, turning)


def planar_turn(
    motion: FloatArray, inertial: InertialReading | None, theta: FloatArray, installation: Installation
) -> float:
    """Turn [rad] about the map's z axis of a motion ``(3,)`` in the robot's plane, on ground as it is known now."""
    turn, _ = _turn_of(inertial, float(motion[2]), theta, installation)
    angles = theta[installation.constants + 1 :]
    return float(driven(angles[None], motion[None], turn[None])[0][0, 2])


def _smooth(motion: FloatArray, turn: FloatArray) -> float:
    """Variance of a turn about x or y by the ground; where a large one is measured, it is not smooth."""
    way, turned = math.hypot(motion[0], motion[1]), abs(float(motion[2]))
    usual = _SMOOTH_PER_SQRT_M**2 * way + _SMOOTH_PER_SQRT_RAD**2 * turned + _STILL_RAD**2
    return usual + float(turn @ turn)


def _projected(m: MotionMeasurement, planar: FloatArray, P: FloatArray) -> MotionMeasurement:
    """A motion in the plane of the map; ``P (3, 3)``: its derivative by that in the robot's plane."""
    depends = {name: (P @ derivative, at) for name, (derivative, at) in m.depends_on.items()}
    cov = P @ m.cov @ P.T
    return replace(m, motion=planar, cov=0.5 * (cov + cov.T), depends_on=depends)


def _perturbed(
    motions: Sequence[MotionMeasurement], motion: FloatArray, turn: FloatArray, ground: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A step as it is, and a little changed.

    Returns:
        Planar motions ``(8 + k, 3)``: as it is; by roll, pitch, both turns and the motion (right perturbation) changed;
        those of each of the k motions. Height, roll and pitch after them ``(8 + k, 3)``. Their derivatives ``(3, 7)``.
    """
    rows = 8 + len(motions)
    angles, moves, turns = np.tile(ground[1:], (rows, 1)), np.tile(motion, (rows, 1)), np.tile(turn, (rows, 1))
    angles[1:3] += _EPS * np.eye(2)
    turns[3:5] += _EPS * np.eye(2)
    for i, direction in enumerate(np.eye(3)):
        moves[5 + i] = se2.compose(motion, se2.exp(_EPS * direction))
    moves[8:] = [m.motion for m in motions]
    planar, climbed, tilted = driven(angles, moves, turns)
    ends = np.column_stack([ground[0] + climbed, tilted])
    return planar, ends, (ends[1:8] - ends[0]).T / _EPS


def _turn_of(
    inertial: InertialReading | None, yaw: float, theta: FloatArray, installation: Installation
) -> tuple[FloatArray, FloatArray]:
    """Turn ``(2,)`` about x and y, rid of its bias and of the yaw in it, and its derivative ``(2, constants)``."""
    by_bias = np.zeros((2, installation.constants))
    if inertial is None:
        return np.zeros(2), by_bias
    turn = inertial.turn.copy()
    dt = inertial.seconds
    (bias_x, bias_y), (roll, pitch) = BIASES, TILTS
    columns = {bias_x: (0, -dt), bias_y: (1, -dt), roll: (1, -yaw), pitch: (0, yaw)}
    for name, (row, gain) in columns.items():
        if name in installation.index:
            i = installation.index[name]
            turn[row] += gain * theta[i]
            by_bias[row, i] = gain
    return turn, by_bias


def _kept(motion: FloatArray) -> float:
    """Share of a tilt that is left after a way, where nothing measures it: it returns to level."""
    return math.exp(-0.5 * (_TILT_PER_SQRT_M / _SLOPE_RAD) ** 2 * math.hypot(motion[0], motion[1]))


def _added(inertial: InertialReading | None, motion: FloatArray, A: FloatArray, tilted: FloatArray) -> FloatArray:
    """Covariance ``(3, 3)`` of what the path does beside the tilt of the chassis."""
    way, turned = math.hypot(motion[0], motion[1]), abs(float(motion[2]))
    climbed = (_CONTACT_M * float(np.hypot(*tilted)) if way > 0.0 else 0.0) ** 2
    added = np.zeros((3, 3))
    added[0, 0] = climbed + _PATH_PER_SQRT_M**2 * way + _SINK_PER_SQRT_S**2 * 0.1
    if inertial is None:
        added[1, 1] = added[2, 2] = _TILT_PER_SQRT_M**2 * way + _TILT_PER_SQRT_RAD**2 * turned + 1e-10
        added[0, 0] += (0.5 * way) ** 2 * _TILT_PER_SQRT_M**2 * way
    return added


@dataclass(frozen=True, slots=True, eq=False)
class Gravity:
    """Roll and pitch by the direction of gravity.

    Attributes:
        residual: ``(2,)`` predicted minus measured, at an attitude and an installation.
        D: ``(2, constants)`` derivative by the installation; by roll and pitch it is the identity.
        cov: ``(2, 2)``; larger the more the force is not gravity's.
        noise: ``(2, 2)`` of that what is usual.
    """

    residual: FloatArray
    D: FloatArray
    cov: FloatArray
    noise: FloatArray


def gravity(
    motions: Sequence[MotionMeasurement], ground: FloatArray, theta: FloatArray, installation: Installation
) -> Gravity | None:
    """Measurement of roll and pitch by the newest step's specific force; None: there is none.

    Args:
        motions: of the step.
        ground: height, roll, pitch ``(3,)`` at its end, as predicted.
        theta: ``(n,)`` installation.
        installation: its parameters.
    """
    inertial = motions[0].inertial if motions else None
    if inertial is None or inertial.force is None:
        return None
    x, y, z = inertial.force
    measured = np.array([math.atan2(y, z), math.atan2(-x, math.hypot(y, z))])
    D = np.zeros((2, installation.constants))
    residual = ground[1:] - measured
    for pair in (TILTS, LEVELS):
        for row, name in enumerate(pair):
            if name in installation.index:
                D[row, installation.index[name]] = 1.0
                residual[row] += theta[installation.index[name]]
    variance = inertial.force_variance / GRAVITY**2
    off = (math.hypot(x, y, z) - GRAVITY) ** 2 / GRAVITY**2
    usual = variance * np.eye(2)
    variance += off + float(residual @ residual) / _SUDDEN**2
    return Gravity(residual, D, variance * np.eye(2), usual)


# --- Prediction and factors of a step; the state beside the pose ends with height, roll and pitch ---------------------

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
    P = belief.joint_cov(known)
    gain = np.linalg.solve(H @ P @ H.T + cov, H @ P).T
    moved = -gain @ residual
    P = P - gain @ H @ P
    P = 0.5 * (P + P.T)
    return PoseWithCovariance.jointly(belief.pose, known.mean + moved[3:], P)  # the pose itself hardly depends on it


def step_of(motions: Sequence[MotionMeasurement], theta: FloatArray, installation: Installation) -> GroundStep:
    """A step that begins at the height, roll and pitch with which ``theta (n,)`` ends."""
    return ground_step(motions, fuse_installed(motions), theta[installation.constants :], theta, installation)


def ground_factors(
    k: int, motions: Sequence[MotionMeasurement], step: GroundStep, theta: FloatArray, installation: Installation
) -> list[gtsam.NonlinearFactor]:
    """Factors between the ground at keyframes k - 1 and k, and the factor of gravity at k, if it was measured."""
    made = list(step_factors(k, step, theta, installation))
    seen = gravity(motions, step.after, theta, installation)
    return made if seen is None else [*made, gravity_factor(k, seen, step.after, theta, installation)]


def step_factors(
    k: int, step: GroundStep, theta: FloatArray, installation: Installation
) -> Iterator[gtsam.NonlinearFactor]:
    """Factors between the ground at keyframes k - 1 and k, and the factor of the IMU's turn on the installation."""
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
    """Installation at a first pose: the ground's prior about a level height and the last known roll and pitch."""
    if not installation.ground:
        return known
    prior, c = installation.prior(), installation.constants
    mean = np.append(prior.mean[c], known.mean[c + 1 :])
    return known.anew(np.arange(c, len(known.mean)), prior.cov[c:, c:], mean)


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
