"""The motion sources side by side, and what of them enters the graph."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.measurement_log import Belief, Keyframe
from fgloc.graph.slip_noise import Footing
from fgloc.motion.joint import JointCalibration
from fgloc.motion.source import LearnedMotion
from fgloc.sensors.gyro import Gyro
from fgloc.sensors.wheels import WheelMotion
from fgloc.types import FloatArray, MotionMeasurement, Readings, Step

_SAYS_NOTHING = 1e2  # m²: a gyro knows no position
_LIKELY = 0.2  # of the gate's bounds: sigma of the speed of a robot whose motion nothing tells
_SLIP_SPEED, _SLIP_TURN = 0.1, 0.2  # m/s, rad/s: a slipping wheel may be this wrong even when it hardly turns ...
_COMMANDED_NS = 1_000_000_000  # how long before a step a command still moves the robot
_WRONG_LASTS_S = 1.0  # ... for this long in one direction


class MotionSources:
    """Wheels, learned motion and gyro."""

    def __init__(
        self,
        config: Config,
        wheels: WheelMotion,
        learned: LearnedMotion | None = None,
        joint: JointCalibration | None = None,
        gyro: Gyro | None = None,
    ) -> None:
        """Take the sources.

        Args:
            config: of all of them.
            wheels: wheel odometry.
            learned: the learned motion, if any.
            joint: its correlation with the wheels; None: the two are taken as independent.
            gyro: the gyro, if any.
        """
        self._config = config
        self._wheels = wheels
        self._learned = learned
        self._joint = joint
        self.gyro = gyro
        self._silent_s = 0.0  # how long neither a motion source nor a fix has told where the robot went
        self._way_m = self._turn_rad = 0.0  # what the wheels have told since the last fix

    @property
    def gyro_is_read(self) -> bool:
        """Whether the learned motion has the gyro in it already."""
        return self._learned is not None and "gyro" in self._learned.model.card.inputs

    def read(self, step: Step, blind_s: float = 0.0, velocity: FloatArray | None = None) -> Readings:
        """Ask every source once.

        Args:
            step: what was heard.
            blind_s: time before the step without a fix.
            velocity: ``(2,)`` at its start, if known better than by the learned model itself.
        """
        if step.dt <= 0.0:
            return Readings()
        wheels = self._with_systematic_error(self._wheels.measure(step))
        motion = np.zeros(3) if wheels is None else wheels.motion
        gyro = None
        if self.gyro is not None:
            turn = self.gyro.measure(step, None if wheels is None or _told_to_move(step) else motion, blind_s)
            if turn is not None:
                cov = np.diag([_SAYS_NOTHING, _SAYS_NOTHING, turn.variance])
                gyro = MotionMeasurement("gyro", step.start_ns, step.stamp_ns, _turned(motion, turn.yaw), cov)
        readings = Readings(wheels, self._measure_learned(step, velocity), gyro)
        if readings.wheels is not None or readings.learned is not None:
            self._silent_s = 0.0
        return readings

    def _with_systematic_error(self, m: MotionMeasurement | None) -> MotionMeasurement | None:
        """Add what a wrong radius or track adds: the same error all along, so that its sigma grows with the way.

        As with the bias of the gyro, a step gets the growth of the variance since the last fix.
        """
        if m is None:
            return None
        config = self._config.wheels
        way, turn = math.hypot(m.motion[0], m.motion[1]), abs(float(m.motion[2]))
        forth = (self._way_m + way) ** 2 - self._way_m**2
        around = (self._turn_rad + turn) ** 2 - self._turn_rad**2
        yaw = config.yaw_per_m_sigma**2 * forth + config.turn_scale_sigma**2 * around
        return replace(m, cov=m.cov + np.diag([config.scale_sigma**2 * forth, 0.0, yaw]))

    def read_again(self, readings: Readings, step: Step, velocity: FloatArray) -> Readings:
        """The readings with the learned motion evaluated at a better velocity."""
        return replace(readings, learned=self._measure_learned(step, velocity))

    def _measure_learned(self, step: Step, velocity: FloatArray | None) -> MotionMeasurement | None:
        if self._learned is None:
            return None
        return self._learned.measure(step, velocity, 0.0 if self.gyro is None else self.gyro.bias)

    def combine(
        self, readings: Readings, off: Mapping[str, str] | None = None, footing: Footing | None = None
    ) -> list[MotionMeasurement]:
        """Factors of a step, independent of each other.

        Args:
            readings: what the sources say.
            off: sources that are not to be trusted, and why. The wheels' factor is then left out or, if nothing else
                knows the distance, kept with room for a slip.
            footing: at the start of the step; what the sources miss there, they miss alike, so that as many factors as
                there are each get that many times the room.
        """
        off = off or {}
        wheels, learned, gyro = readings.wheels, readings.learned, readings.gyro
        if learned is None or "learned" in off:
            learned = None
        if gyro is None or "gyro" in off or (learned is not None and self.gyro_is_read):
            gyro = None
        if wheels is not None and "wheels" in off:
            wheels = None if learned is not None else self._doubtful(wheels, off["wheels"])
        elif wheels is not None and learned is not None:
            if self._wheels.stands_in:  # made of the very commands that the model reads
                wheels = None
            elif self._joint is not None:
                learned = self._joint.decorrelate(wheels, learned)
        known = [m for m in (wheels, learned) if m is not None]
        if known and footing is not None and self._config.weights.adaptive:
            room = footing.room(known[-1], off.get("wheels") == "slip")
            known = [worsened(m, doubt=len(known) * room) for m in known]
        if gyro is not None and known:
            known.append(replace(gyro, motion=_turned(known[0].motion, float(gyro.motion[2]))))
        return known

    def _doubtful(self, wheels: MotionMeasurement, why: str) -> MotionMeasurement:
        """Wheels that are not believed, where nothing else knows the way."""
        if why == "slip":
            return with_room(wheels, _SLIP_SPEED, _SLIP_TURN)
        return with_room(wheels, _LIKELY * self._config.gate.max_speed, _LIKELY * self._config.gate.max_yaw_rate)

    def combine_again(self, frame: Keyframe, readings: Readings | None = None) -> list[MotionMeasurement]:
        """Factors of a keyframe as its readings (or better ones) and what is thought of them now make them."""
        made = self.combine(readings or frame.readings, frame.off, frame.footing)
        return [worsened(m, frame.scale, frame.doubt) for m in made]

    def disagreement(self, readings: Readings) -> tuple[FloatArray, FloatArray] | None:
        """How far the wheels and the sources that witness their slip are apart over the step.

        Returns:
            Difference ``(3,)`` in the body frame and the covariance ``(3, 3)`` that it has if both are right; None
            where there is no witness: a model that reads the wheels is none, nor is one of the commands that stand in
            for wheels.
        """
        wheels, learned, gyro = readings.wheels, readings.learned, readings.gyro
        if wheels is None or self._wheels.stands_in:
            return None
        if learned is not None and self._learned is not None and not self._learned.model.card.reads_wheels:
            d = se2.log(se2.between(wheels.motion, learned.motion))
            if self._joint is None:
                return d, wheels.cov + learned.cov
            return d, self._joint.difference_cov(wheels.cov, learned.cov)
        if gyro is None:
            return None
        d = np.array([0.0, 0.0, se2.wrap(float(gyro.motion[2] - wheels.motion[2]))])
        return d, np.diag([1.0, 1.0, wheels.cov[2, 2] + gyro.cov[2, 2]])

    def unknown(self, step: Step, readings: Readings | None = None) -> MotionMeasurement:
        """Nothing told the way: sigma grows with the time of silence, however many steps it is cut into.

        A gyro, if there is one, still tells the turn.
        """
        before, self._silent_s = self._silent_s, self._silent_s + max(step.dt, 0.01)
        gate = self._config.gate
        speed, turn = _LIKELY * gate.max_speed, _LIKELY * gate.max_yaw_rate
        cov = np.diag(np.square([speed, speed, turn])) * (self._silent_s**2 - before**2)
        motion, gyro = np.zeros(3), None if readings is None else readings.gyro
        if gyro is not None:
            motion, cov[2, 2] = _turned(motion, float(gyro.motion[2])), gyro.cov[2, 2]
        return MotionMeasurement("unknown", step.start_ns, step.stamp_ns, motion, cov)

    def went(self, readings: Readings, fix: Belief | None) -> None:
        """The robot went on by a step.

        Args:
            readings: what the sources said of it.
            fix: where sightings have it now; None if there were none.
        """
        if fix is not None:
            self._silent_s = self._way_m = self._turn_rad = 0.0
        elif readings.wheels is not None:
            self._way_m += math.hypot(*readings.wheels.motion[:2])
            self._turn_rad += abs(float(readings.wheels.motion[2]))
        if self.gyro is None:
            return
        if readings.gyro is None:
            self.gyro.forget_fix()
            return
        turn = readings.gyro
        self.gyro.turned(float(turn.motion[2]), (turn.stamp_ns - turn.start_ns) * 1e-9)
        if fix is not None:
            self.gyro.fix(float(fix.pose[2]), float(fix.cov[2, 2]))

    def begin_segment(self) -> None:
        """The clock jumped: nothing is known of what happened in between."""
        self._silent_s = self._way_m = self._turn_rad = 0.0
        if self.gyro is not None:
            self.gyro.forget_fix()


def worsened(m: MotionMeasurement, scale: float = 1.0, doubt: FloatArray | None = None) -> MotionMeasurement:
    """The motion with its covariance scaled, and with room ``(3, 3)`` for what sightings say against it."""
    return replace(m, cov=m.cov * scale + (0.0 if doubt is None else doubt))


def with_room(m: MotionMeasurement, speed: float, turn: float) -> MotionMeasurement:
    """The wheels' motion with room: the robot may do anything between what they say and nothing, or these speeds.

    Args:
        m: what the wheels say.
        speed: that they may be wrong by, even when they hardly turn [m/s].
        turn: likewise [rad/s].
    """
    seconds = max((m.stamp_ns - m.start_ns) * 1e-9, 1e-3)
    told, turned = np.hypot(*m.motion[:2]) / seconds, abs(float(m.motion[2])) / seconds
    density = np.square([max(told, speed), 0.3 * max(told, speed), max(turned, turn)])
    return replace(m, cov=m.cov + np.diag(density * _WRONG_LASTS_S * seconds))


def _turned(motion: FloatArray, yaw: float) -> FloatArray:
    return np.array([motion[0], motion[1], yaw])


def _told_to_move(step: Step) -> bool:
    """Whether a command of the step, or the one it began with, is not to stand: still wheels may then be dead ones."""
    since = step.start_ns - _COMMANDED_NS
    return any((c.v != 0.0 or c.omega != 0.0) and c.stamp_ns >= since for c in step.commands)
