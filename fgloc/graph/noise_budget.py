"""The noise of one step's motion factors: which sources are left out, and what is added to the covariance of the rest.

All changes of a motion's covariance are made here, from one frozen object, so that a step can be combined again later:
by the revision of past steps, and by the batch smoother.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fgloc.sensors import registry
from fgloc.sensors.equipment import ErrorCorrelation
from fgloc.types import FloatArray, MotionMeasurement, MotionReadings

_SLIP = 0.1  # m/s, rad/s: a slipping wheel may be this wrong even when it hardly turns ...
_WRONG_LASTS_S = 1.0  # ... for this long in one direction
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
    """

    wheels_are_commands: bool = False
    learned_has_gyro: bool = False
    joint: ErrorCorrelation | None = None
    stopped_speed: float = 0.0
    stopped_turn: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class NoiseBudget:
    """What one step's motion sources are worth.

    Attributes:
        rejected: sources that are left out, and why.
        scale: on the covariance of the wheels, as they and the other sources differ. The learned motion's follows.
        overruled_cov: ``(3, 3)`` added to each factor, as sightings found the motion wrong; None: they did not.
    """

    rejected: Mapping[str, str] = field(default_factory=dict)
    scale: float = 1.0
    overruled_cov: FloatArray | None = None

    @property
    def scales(self) -> dict[str, float]:
        """Factors on the covariances of wheels and learned motion, where they are not left out.

        That of the learned motion follows the wheels' up to what it is worth beside wrong wheels; below 1 by the root,
        as it is not known which of the two has too large a covariance.
        """
        names = registry.motion_names()
        if names.odometer in self.rejected:
            return {names.model: COVARIANCE_FACTOR}
        scale = self.scale
        learned = min(scale, COVARIANCE_FACTOR) if scale > 1.0 else math.sqrt(scale)
        return {names.odometer: scale, names.model: learned}

    def combine(self, readings: MotionReadings, rules: FusionRules) -> list[MotionMeasurement]:
        """Factors of a step, independent of each other; none where no source that is left measured the distance.

        A robot at rest stays where it is, to within a tick of its encoders: one measurement, whoever else agrees.
        Rejected wheels are left out or, if nothing else knows the distance, kept with room for a slip.

        Args:
            readings: of the sources.
            rules: how they depend on each other.
        """
        wheels, learned, gyro = readings.wheels, readings.learned, readings.gyro
        scales, names = self.scales, registry.motion_names()
        if readings.at_rest and wheels is not None and names.odometer not in self.rejected:
            cov = np.eye(3) * _REST_PER_SQRT_S**2 * (wheels.stamp_ns - wheels.start_ns) * 1e-9
            return [self.overruled(replace(wheels, cov=cov, inertial=readings.inertial))]
        if wheels is not None:
            wheels = _scaled(wheels, scales.get(names.odometer, 1.0))
        learned = None if learned is None or names.model in self.rejected else _scaled(learned, scales[names.model])
        if gyro is None or names.rate in self.rejected or (learned is not None and rules.learned_has_gyro):
            gyro = None
        if wheels is not None and names.odometer in self.rejected:
            wheels = None if learned is not None else self._with_slip(wheels, rules)
        elif wheels is not None and learned is not None:
            if rules.wheels_are_commands:
                wheels = None
            elif rules.joint is not None:
                learned = rules.joint.decorrelate(wheels, learned)
        known = [m for m in (wheels, learned) if m is not None]
        if gyro is not None and known:
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
        slips = self.rejected[wheels.source] == "slip" and wheels.motion.any()
        speed, turn = (_SLIP, _SLIP) if slips else (rules.stopped_speed, rules.stopped_turn)
        seconds = (wheels.stamp_ns - wheels.start_ns) * 1e-9
        speed = max(speed, float(np.hypot(*wheels.motion[:2])) / seconds)
        turn = max(turn, abs(float(wheels.motion[2])) / seconds)
        density = np.square([speed, speed, turn])
        return replace(wheels, cov=wheels.cov + np.diag(density * _WRONG_LASTS_S * seconds))


def with_yaw(motion: FloatArray, yaw: float) -> FloatArray:
    """The motion ``(3,)`` with another rotation [rad]."""
    return np.array([motion[0], motion[1], yaw])


def _scaled(m: MotionMeasurement, scale: float) -> MotionMeasurement:
    return m if scale == 1.0 else replace(m, cov=m.cov * scale)
