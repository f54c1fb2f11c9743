"""Noise models of checked covariances, and the noise of one step's motion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from fgloc import se2
from fgloc.errors import CovarianceError
from fgloc.sensors.learned.network import JointCalibration
from fgloc.types import FloatArray, MotionMeasurement, MotionReadings

# --- Noise models of GTSAM, and square roots of information -----------------------------------------------------------

_SAME_STAMP_S = 0.01  # sightings nearer than this are one


def repetition(correlation_s: float, last_ns: int | None, stamp_ns: int) -> float:
    """Scale on the covariance of a sighting by how soon it follows the last one of its landmark.

    Errors last for a time: what is seen again within it has its information in common with what was seen before.

    Args:
        correlation_s: that time [s].
        last_ns: stamp of the last one; None: there was none.
        stamp_ns: of this one.
    """
    if last_ns is None:
        return 1.0
    return max(1.0, correlation_s / max(abs(stamp_ns - last_ns) * 1e-9, _SAME_STAMP_S))


def gaussian(cov: FloatArray) -> gtsam.noiseModel.Base:
    """Noise model of a covariance, which is checked because GTSAM does not.

    Raises:
        CovarianceError: not finite, not symmetric or not positive definite.
    """
    problem = covariance_problem(cov)
    if problem:
        raise CovarianceError(f"{problem}: {cov.tolist()}; a measurement like this has to be rejected by the gate")
    return gtsam.noiseModel.Gaussian.Covariance(cov)


def robust(noise: gtsam.noiseModel.Base, cauchy_k: float | None) -> gtsam.noiseModel.Base:
    """Wrap a noise model in a Cauchy kernel (k in units of sigma); None leaves it Gaussian."""
    if cauchy_k is None:
        return noise
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(cauchy_k), noise)


def whitening_of(cov: FloatArray) -> FloatArray:
    """W with ``Wᵀ W`` the inverse of a covariance.

    Raises:
        CovarianceError: it is none.
    """
    try:
        if not np.isfinite(cov).all():
            raise np.linalg.LinAlgError("not finite")
        return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))
    except np.linalg.LinAlgError as error:
        raise CovarianceError(f"a covariance of diagonal {np.diag(cov).tolist()} is none: {error}") from error


def sighting_whitening(cov: FloatArray) -> FloatArray:
    """W with ``Wᵀ W`` the inverse of a covariance that is no less than the identity.

    Of a corner hardly in front of the camera it is so large that the identity is lost to rounding.

    Raises:
        CovarianceError: it is not finite.
    """
    if not np.isfinite(cov).all():
        raise CovarianceError(f"a covariance of diagonal {np.diag(cov).tolist()} is none: not finite")
    root, failed = dpotrf(cov, lower=1, clean=1)
    if not failed:
        return np.asarray(dtrtri(root, lower=1)[0])
    values, vectors = np.linalg.eigh(cov)
    return np.asarray((vectors / np.sqrt(np.maximum(values, 1.0))).T)


def covariance_problem(cov: FloatArray) -> str:
    """Defect of a covariance in words; "" if there is none.

    Sylvester's criterion in plain floats, because this runs for every factor of every step.
    """
    if cov.shape == (3, 3):
        (a, b, c), (d, e, f), (g, h, i) = cov.tolist()
        minors: tuple[float, ...] = a, a * e - b * d, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        skew = abs(b - d) + abs(c - g) + abs(f - h)
        size = abs(a) + abs(e) + abs(i)
    elif cov.shape == (2, 2):
        (a, b), (d, e) = cov.tolist()
        minors = (a, a * e - b * d)
        skew, size = abs(b - d), abs(a) + abs(e)
    elif cov.ndim == 2 and cov.shape[0] == cov.shape[1] > 0:
        minors = tuple(float(np.linalg.det(cov[:i, :i])) for i in range(1, len(cov) + 1))
        skew, size = float(np.abs(cov - cov.T).max()), float(np.abs(np.diag(cov)).sum())
    else:
        return f"covariance of shape {cov.shape}, expected a square matrix"
    if not math.isfinite(size + skew):
        return "covariance with NaN or Inf"
    if skew > 1e-9 * size:
        return "asymmetric covariance"
    return "" if min(minors) > 0.0 else "covariance is not positive definite"


# --- The noise of a step's motion factors -----------------------------------------------------------------------------

DOUBTED = "doubted"  # why wheels and a model that differ are both rejected, where nothing tells which of them is wrong
_SLIP = 0.1  # m/s, rad/s: a slipping wheel may be this wrong even when it hardly turns ...
_WRONG_LASTS_S = 1.0  # ... for this long in one direction
_STANDS = 0.01  # m/s, rad/s: slower, a robot stands
_REST_PER_SQRT_S = 3e-5  # m/√s, rad/√s of a robot whose wheels and gyro rest: 2 mm in an hour, by its floor and tyres
# What a motion's covariance may be off by: squared errors of the learned motion over 1 s of a slip are 2 to 5 times it.
COVARIANCE_FACTOR = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class FusionRules:
    """How the motion sources depend on each other: the same for all steps of a run.

    Attributes:
        wheels_are_commands: there are no wheels, and the commands that stand in for them are what the model reads.
        learned_has_gyro: the learned motion has the gyro in it already.
        joint: correlation of the errors of wheels and learned motion; None: independent.
        stopped_speed: that wheels may be wrong by, if their encoders stopped [m/s].
        stopped_turn: likewise [rad/s].
        turns_by_gyro: nothing fixes the yaw: the wheels' turns serve to learn the gyro's bias, and only it measures
            turns.
    """

    wheels_are_commands: bool = False
    learned_has_gyro: bool = False
    turns_by_gyro: bool = False
    joint: JointCalibration | None = None
    stopped_speed: float = 0.0
    stopped_turn: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class NoiseBudget:
    """Weights of one step's motion sources: which are left out, and factors on the covariances of the others.

    Attributes:
        rejected: sources that are left out, and why.
        scale: on the covariance of the wheels, as they and the other sources differ. The learned motion's follows.
        overruled_cov: ``(3, 3)`` added to each factor, as sightings found the motion wrong; None: they did not.
        drift: densities ``(3,)`` [m²/s, m²/s, rad²/s] that are added to the motion of a robot that moves, as dead
            reckoning was further off between fixes than its covariance says; None: it was not.
        learned_drift: likewise, of the learned motion by itself.
    """

    rejected: Mapping[str, str] = field(default_factory=dict)
    scale: float = 1.0
    overruled_cov: FloatArray | None = None
    drift: FloatArray | None = None
    learned_drift: FloatArray | None = None

    @property
    def scales(self) -> dict[str, float]:
        """Factors on the covariances of wheels and learned motion, where they are not left out.

        That of the learned motion follows the wheels' up to what it is worth beside wrong wheels; below 1 by the root,
        as it is not known which of the two has too large a covariance.
        """
        if "wheels" in self.rejected:
            return {"learned": COVARIANCE_FACTOR}
        scale = self.scale
        learned = min(scale, COVARIANCE_FACTOR) if scale > 1.0 else math.sqrt(scale)
        return {"wheels": scale, "learned": learned}

    def combine(self, readings: MotionReadings, rules: FusionRules) -> list[MotionMeasurement]:
        """Factors of a step, independent of each other; none where no source that is left measured the distance.

        A robot at rest stays where it is, to within a tick of its encoders: one measurement, whoever else agrees.
        Rejected wheels are left out or, if nothing else knows the distance, kept with room for a slip.

        Args:
            readings: of the sources.
            rules: how they depend on each other.
        """
        wheels, learned, gyro = readings.wheels, readings.learned, readings.gyro
        scales = self.scales
        if readings.at_rest and wheels is not None and "wheels" not in self.rejected:
            cov = np.eye(3) * _REST_PER_SQRT_S**2 * (wheels.stamp_ns - wheels.start_ns) * 1e-9
            return [self.overruled(replace(wheels, cov=cov, inertial=readings.inertial))]
        if wheels is not None:
            wheels = _scaled(wheels, scales.get("wheels", 1.0))
        learned = None if learned is None or "learned" in self.rejected else _scaled(learned, scales["learned"])
        if learned is not None and self.learned_drift is not None:
            learned = _drifting(learned, self.learned_drift)
        if gyro is None or "gyro" in self.rejected or (learned is not None and rules.learned_has_gyro):
            gyro = None
        beside = [m for m in readings.beside if m.source not in self.rejected]
        if wheels is not None and "wheels" in self.rejected:
            wheels = None if learned is not None or beside else self._with_slip(wheels, rules)
        elif wheels is not None and learned is not None:
            if rules.wheels_are_commands:
                wheels = None
            elif rules.joint is not None:
                learned = rules.joint.decorrelate(wheels, learned)
        known = [m for m in (wheels, learned, *beside) if m is not None]
        if self.drift is not None:
            known = [_drifting(m, len(known) * self.drift) for m in known]
        if gyro is not None and known:
            if rules.turns_by_gyro:
                known = [replace(m, cov=m.cov + np.diag([0.0, 0.0, se2.ANY_YAW * (m not in beside)])) for m in known]
            known.append(replace(gyro, motion=with_yaw(known[0].motion, float(gyro.motion[2]))))
        if readings.inertial is not None:
            known = [replace(m, inertial=readings.inertial) for m in known]
        return [self.overruled(m) for m in known]

    def overruled(self, m: MotionMeasurement) -> MotionMeasurement:
        """A motion with what sightings that found it wrong add to its covariance."""
        return m if self.overruled_cov is None else replace(m, cov=m.cov + self.overruled_cov)

    def _with_slip(self, wheels: MotionMeasurement, rules: FusionRules) -> MotionMeasurement:
        """Rejected wheels: the true speed may be anything between theirs and zero, or off by that of a slip.

        Where they report no motion at all their encoders may have stopped, and the robot may drive as fast as it can.
        """
        slips = self.rejected[wheels.source] in ("slip", DOUBTED) and wheels.motion.any()
        speed, turn = (_SLIP, _SLIP) if slips else (rules.stopped_speed, rules.stopped_turn)
        seconds = (wheels.stamp_ns - wheels.start_ns) * 1e-9
        speed = max(speed, float(np.hypot(*wheels.motion[:2])) / seconds)
        turn = max(turn, abs(float(wheels.motion[2])) / seconds)
        density = np.square([speed, speed, turn])
        return replace(wheels, cov=wheels.cov + np.diag(density * _WRONG_LASTS_S * seconds))


def moves(motion: FloatArray, seconds: float) -> bool:
    """Whether a motion ``(3,)`` over so long is more than that of a robot that stands."""
    return bool(math.hypot(*motion[:2]) + abs(float(motion[2])) > _STANDS * seconds)


def _drifting(m: MotionMeasurement, density: FloatArray) -> MotionMeasurement:
    """The motion with noise of these densities ``(3,)``, if it is one."""
    seconds = (m.stamp_ns - m.start_ns) * 1e-9
    return replace(m, cov=m.cov + np.diag(density * seconds)) if moves(m.motion, seconds) else m


def with_yaw(motion: FloatArray, yaw: float) -> FloatArray:
    """The motion ``(3,)`` with another rotation [rad]."""
    return np.array([motion[0], motion[1], yaw])


def _scaled(m: MotionMeasurement, scale: float) -> MotionMeasurement:
    return m if scale == 1.0 else replace(m, cov=m.cov * scale)
