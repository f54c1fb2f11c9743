"""Motion that enters the graph: the sources are read, tested against each other, and combined to factors.

Five things can be wrong with a motion, each with its own test: wheels or learned motion are faulty
(`MotionFaultMonitor`), an odometry beside the wheels is (`OdometriesBeside`), dead reckoning is further off between
fixes than it says (`ExcessDrift`), the robot is carried (`LiftMonitor`), or sightings agree on a place nearby that the
motion did not lead to (`fgloc.estimation.sightings.Association.nearby_consensus`, then `JudgedMotion.overruled`).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fgloc import se2
from fgloc.config import MOTION_SOURCES, Config, WeightsConfig
from fgloc.estimation.beside import OdometriesBeside
from fgloc.estimation.faults import Contradicted, FaultAttribution, FaultVerdict, GlrResult, GlrTest, LiftMonitor
from fgloc.estimation.log import flag_notes, motion_decisions
from fgloc.graph.estimators import Estimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.ground import planar_turn, predict
from fgloc.graph.joint import FAR_M2
from fgloc.graph.measurement_log import Keyframe, PoseWithCovariance
from fgloc.graph.noise import COVARIANCE_FACTOR, DOUBTED, FusionRules, NoiseBudget, moves, with_yaw
from fgloc.sensors.base import Turn
from fgloc.sensors.equipment import MotionSensors
from fgloc.sensors.learned.sensor import left_out_note
from fgloc.sensors.wheels.motion import commanded_to_move
from fgloc.stats import GATE, chi2_bound
from fgloc.types import Decision, FloatArray, MotionMeasurement, MotionReadings, Step

# --- Read -------------------------------------------------------------------------------------------------------------

_SKID = 0.05  # of a turn: by so much wheels are wrong in one turn and not in the next
_USUAL_SPEED = 0.5  # m/s, before the robot has driven
_CHANGES_S = 600.0  # after such a time what the wheels are off by may be something else
_MODEL_CLOCK_S = 0.02  # how much sooner or later than its model a robot obeys: by load, floor, other robots of its kind
_MEMORIES = 2.0  # times what a yaw remembers of the gyro: two yaws so far apart measure the turn without it


class TurnComparison:
    """Turns of gyro and wheels compared, for a robot whose yaw nothing fixes: what the gyro's bias is likely to be.

    A Kalman filter of the rate by which the two differ while the wheels turn [rad/s] and of the share of their turn by
    which wheels turn too little. The rate is the gyro's bias and the yaw that unequal wheels gain; only their priors
    divide it. (Speeds that change would tell the two apart, if errors of gyro and wheels were white, which lags and
    skidding are not.)
    """

    def __init__(self, config: Config) -> None:
        """Start from the priors of gyro and wheels."""
        wheels, gyro = config.wheels, config.gyro
        share = math.hypot(wheels.turn_scale_sigma, wheels.scale_sigma, gyro.scale_sigma)
        self._per_m, self._walk = wheels.yaw_per_m_sigma, gyro.bias_walk
        self._mean = np.zeros(2)
        self._cov = np.diag([gyro.bias_sigma**2 + (self._per_m * _USUAL_SPEED) ** 2, share**2])
        self._change = np.array([[self._walk**2, 0.0], [0.0, share**2 / _CHANGES_S]])
        self._way = self._driven_s = 0.0

    def compare(self, seconds: float, turned: Turn, bias: float, wheels: MotionMeasurement | None) -> None:
        """Correct the difference by a step.

        Args:
            seconds: length of the step.
            turned: by the gyro, with this ``bias`` [rad/s] subtracted.
            bias: of the gyro, as it was learned at rest.
            wheels: as they report it; None: they were silent.
        """
        self._cov = self._cov + self._change * seconds
        if wheels is None or not wheels.motion.any():
            return
        self._way += float(np.hypot(*wheels.motion[:2]))
        self._driven_s += seconds
        turn = float(wheels.motion[2])
        by = np.array([seconds, turn])
        noise = turned.noise + float(wheels.cov[2, 2]) + (_SKID * turn) ** 2
        error, gain = turned.yaw + bias * seconds - turn - by @ self._mean, self._cov @ by
        variance = float(by @ gain) + noise
        if error**2 > chi2_bound(GATE, 1) * variance:  # slip, or turned by hand
            return
        self._mean = self._mean + gain * (error / variance)
        self._cov = self._cov - np.outer(gain, gain) / variance

    def corrected(self, turned: Turn, seconds: float, since_s: float, bias: float, variance: float) -> Turn:
        """The gyro's turn with the bias that is likely beside these wheels.

        Args:
            turned: by the gyro, with ``bias`` subtracted.
            seconds: length of the step.
            since_s: how long before the step nothing has fixed the yaw.
            bias: of the gyro, as it was learned at rest [rad/s].
            variance: of that [rad²/s²].
        """
        change, left = 0.0, variance
        if self._driven_s > 0.0:
            of_wheels = (self._per_m * (self._way / self._driven_s)) ** 2 + float(self._cov[0, 0])
            share = variance / (variance + of_wheels)
            change, left = share * (float(self._mean[0]) - bias), variance * (1.0 - share)
        drift = left * ((since_s + seconds) ** 2 - since_s**2)
        return replace(turned, yaw=turned.yaw - change * seconds, variance=turned.noise + drift)


_STEADY_S = 2.0  # time constant of a speed that nothing measures
_FOLLOWED_S = 1.0  # between two fixes that tell the speed


class SteadyMotion:
    """Predicts the motion of a robot, or of a camera, that no source measures, by its speed at the last fixes.

    The speed is a first-order Gauss-Markov process: it stays for `_STEADY_S`, and then is what any speed may be.

    Source: Singer 1970, "Estimating optimal tracking filter performance for manned maneuvering targets", for speeds.
    """

    def __init__(self, sigmas: FloatArray) -> None:
        """Set the standard deviations ``(3,)`` of a speed of which nothing is known [m/s, m/s, rad/s]."""
        self._any = np.square(sigmas)
        self.begin_segment()

    def begin_segment(self) -> None:
        """Forget speed and place."""
        self._twist, self._variance = np.zeros(3), self._any
        self._fix: PoseWithCovariance | None = None
        self._fixed_ns = 0

    def predict(self, start_ns: int, stamp_ns: int) -> tuple[FloatArray, FloatArray] | None:
        """Motion ``(3,)`` between two times, and its covariance ``(3, 3)``; None: there was no fix yet."""
        if self._fix is None:
            return None
        before, after = (max(t - self._fixed_ns, 0) * 1e-9 for t in (start_ns, stamp_ns))
        stays = _STEADY_S * (math.exp(-before / _STEADY_S) - math.exp(-after / _STEADY_S))
        return self._twist * stays, np.diag(self._gone(after) - self._gone(before))

    def _gone(self, seconds: float) -> FloatArray:
        """Variance ``(3,)`` of the way since the last fix."""
        t = min(seconds, _STEADY_S)
        density = 2.0 * self._any / _STEADY_S
        return np.asarray(self._variance * t**2 + density * t**3 / 3.0 + density * _STEADY_S**2 * (seconds - t))

    def fix(self, belief: PoseWithCovariance, stamp_ns: int) -> None:
        """Update the speed by a pose that sightings have fixed."""
        last, seconds = self._fix, (stamp_ns - self._fixed_ns) * 1e-9
        self._fix, self._fixed_ns = belief, stamp_ns
        if last is None or not 0.0 < seconds < _FOLLOWED_S:
            self._twist, self._variance = np.zeros(3), self._any
            return
        kept = math.exp(-seconds / _STEADY_S)
        expected, variance = kept * self._twist, kept**2 * self._variance + (1.0 - kept**2) * self._any
        went = se2.log(se2.between(last.pose, belief.pose)) / seconds
        of_poses, of_change = np.diag(last.cov + belief.cov) / seconds**2, self._any * seconds / 3.0
        gain = variance / (variance + of_poses + of_change)
        self._twist, self._variance = expected + gain * (went - expected), (1.0 - gain) * variance


class MotionSources:
    """Reads wheels, learned motion, gyro, inclination and odometries beside; follows what is known of their drift."""

    def __init__(self, config: Config, sensors: MotionSensors, factors: LandmarkFactors | None = None) -> None:
        """Set up for the sensors of a run.

        Args:
            config: of all of them.
            sensors: to be read.
            factors: hold what is known of the installation; None: motions are taken as they are reported.
        """
        self._config = config
        # Sigmas of a speed that is not measured: the gate's bound is the quantile of GATE
        speed, turn = config.gate.max_speed, config.gate.max_yaw_rate
        self._widest = 1.0 / math.sqrt(chi2_bound(GATE, 1)) * np.array([speed, speed, turn])
        self.factors = LandmarkFactors(None) if factors is None else factors
        # m²/s of wheels that stand, with the way of encoders that jitter; of silent ones it is hundreds of times more
        self._known_rest = 10.0 * config.wheels.noise.xy_per_sqrt_s**2
        self._wheels, self._learned, self._joint = sensors.wheels, sensors.learned, sensors.joint
        self.gyro, self.attitude = sensors.gyro, sensors.attitude
        self._wheels.turn_known = self.gyro is not None
        self.beside: OdometriesBeside | None = None  # set by the judge, which compares them
        self._alone = TurnComparison(config) if sensors.alone and sensors.gyro is not None else None
        self._turn: Turn | None = None  # by the gyro, of the step that was read last
        self._steady = SteadyMotion(self._widest) if sensors.unmeasured else None
        self._yaw_indirect_s = 0.0  # how far back the yaw rests on the gyro, where fixes observe it along the way only
        self._silent_s = 0.0  # how long there was neither a motion source nor a fix

    @property
    def unmeasured(self) -> bool:
        """Whether there is no source at all."""
        return self._steady is not None

    @property
    def rules(self) -> FusionRules:
        """How the sources depend on each other."""
        return FusionRules(
            wheels_are_commands=self._wheels.from_commands,
            learned_has_gyro=self._learned_has_gyro,
            joint=self._joint,
            stopped_speed=float(self._widest[0]),
            stopped_turn=float(self._widest[2]),
            turns_by_gyro=self._alone is not None and not self._wheels.from_commands,
        )

    def is_checked(self, readings: MotionReadings, rejected: Collection[str]) -> bool:
        """Whether the wheels of a step were compared with an independent source, and neither was rejected."""
        others = (self.learned_is_independent and readings.learned is not None) or bool(readings.beside)
        return readings.wheels is not None and others and not {"wheels", "learned"} & set(rejected)

    def clock_sigma_s(self, frame: Keyframe) -> float:
        """Sigma of the clock by which the robot moved to a keyframe [s]: of a model of commands that of its delay."""
        by_model = self._wheels.from_commands and any(m.source == "learned" for m in frame.motions)
        return _MODEL_CLOCK_S if by_model and frame.readings.gyro is None else 0.0

    def is_witnessed(self, readings: MotionReadings) -> bool:
        """Whether the wheels of a step can be held against another source, or there is an odometry beside them."""
        if readings.wheels is None or self._wheels.from_commands:
            return bool(readings.beside)
        by_model = readings.learned is not None and self.learned_is_independent
        return by_model or readings.gyro is not None or bool(readings.beside)

    @property
    def learned_is_independent(self) -> bool:
        """Whether the learned motion can be held against the wheels: it does not read them."""
        return self._learned is not None and not self._learned.model.card.reads("wheels")

    @property
    def _learned_has_gyro(self) -> bool:
        return self._learned is not None and self._learned.model.card.reads("gyro")

    def read(self, step: Step, since_fix_s: float = 0.0) -> MotionReadings:
        """Read every source once.

        Args:
            step: its events.
            since_fix_s: time before the step without a fix.
        """
        if step.dt <= 0.0:
            return MotionReadings()
        reported = wheels = self._wheels.measure(step)
        if reported is not None:
            by = self._wheels.derivatives(step, reported, self.factors.installation.index)
            wheels = self.factors.installed(reported, by)
        motion = np.zeros(3) if wheels is None else wheels.motion
        gyro = self._turn = None
        if self.gyro is not None:
            without_yaw_s = max(since_fix_s, self._yaw_indirect_s)
            turn = self.gyro.measure(step, None if wheels is None or commanded_to_move(step) else motion, without_yaw_s)
            if turn is not None:
                if self._alone is not None and not self._wheels.from_commands:
                    bias, variance = self.gyro.bias, self.gyro.bias_variance
                    self._alone.compare(step.dt, turn, bias, reported)
                    turn = self._alone.corrected(turn, step.dt, without_yaw_s, bias, variance)
                cov = np.diag([FAR_M2, FAR_M2, turn.variance])
                name, turned = "gyro", with_yaw(motion, turn.yaw)
                gyro = MotionMeasurement(name, step.start_ns, step.stamp_ns, turned, cov)
                gyro = self.factors.installed(gyro, self.gyro.derivatives(turned))
                self._turn = turn
                if reported is not None and wheels is not None:
                    wheels = replace(wheels, depends_on=self._by_fused_turn(step, reported, turn, wheels.depends_on))
        learned = self._with_drift(self._measure_learned(step))
        inertial = None if self.attitude is None else self.attitude.measure(step, self._wheels.twist)
        beside = () if self.beside is None else self.beside.read(step)
        readings = MotionReadings(wheels, learned, gyro, inertial, self._at_rest(step, reported), beside)
        if readings.wheels is not None or readings.learned is not None or readings.beside:
            self._silent_s = 0.0
        return readings

    @property
    def measured_again(self) -> Sequence[Step]:
        """Earlier steps whose motion is known anew since the newest one was read (`WheelMotion.measured_again`)."""
        return self._wheels.measured_again

    def read_again(self, step: Step, readings: MotionReadings) -> MotionReadings:
        """Readings of an earlier step with the wheels' motion as it is known now."""
        reported = self._wheels.measure(step)
        if reported is None or readings.wheels is None:
            return readings
        by = self._wheels.derivatives(step, reported, self.factors.installation.index)
        return replace(readings, wheels=self.factors.installed(reported, by))

    def _at_rest(self, step: Step, wheels: MotionMeasurement | None) -> bool:
        """Whether the robot rests by its wheels and gyro; False for commands in place of wheels."""
        if self.gyro is None or not self.gyro.at_rest or wheels is None or self._wheels.from_commands:
            return False
        return bool(wheels.cov[0, 0] <= self._known_rest * step.dt + 1e-11)

    def _by_fused_turn(
        self, step: Step, reported: MotionMeasurement, turn: Turn, known: Mapping[str, tuple[FloatArray, float]]
    ) -> dict[str, tuple[FloatArray, float]]:
        """Derivatives of the wheels' motion where its turn is that of wheels and gyro together.

        The derivative by a scale is the motion itself. With the wheels' own noise in it, derivative and residual are
        correlated, and the estimate of the scale is biased, the more certain the longer the run (errors in variables).
        The gyro is the instrument, as far as it is the better of the two. Source: Fuller 1987, "Measurement Error
        Models", section 1.4.
        """
        assert self.gyro is not None
        both = reported.cov[2, 2] + turn.noise
        weight = float(reported.cov[2, 2] / both) if both > 0.0 else 0.0
        fused = reported.motion[2] + weight * (turn.yaw - reported.motion[2])
        m = replace(reported, motion=with_yaw(reported.motion, fused))
        rates = self.gyro.rates_at(step.inertial, (step.start_ns, step.stamp_ns))
        by = self._wheels.derivatives(step, m, self.factors.installation.index, (weight, rates))
        return {name: (by[name], assumed) for name, (_, assumed) in known.items()}

    def _with_drift(self, learned: MotionMeasurement | None) -> MotionMeasurement | None:
        """The learned motion with the drift of the gyro that it reads, where no fix observes the yaw by itself."""
        if learned is None or self._turn is None or not self._learned_has_gyro or self._yaw_indirect_s == 0.0:
            return learned
        drift = max(self._turn.variance - self._turn.noise, 0.0)
        return replace(learned, cov=learned.cov + np.diag([0.0, 0.0, drift]))

    def _measure_learned(self, step: Step) -> MotionMeasurement | None:
        if self._learned is None:
            return None
        measured = self._learned.measure_adapted(step, 0.0 if self.gyro is None else self.gyro.bias)
        if measured is None:
            return None
        m, by = measured
        by_turn = [self.gyro.derivatives(m.motion)] if self.gyro and self._turn and self._learned_has_gyro else []
        return self.factors.installed(m, by, *by_turn)

    def unknown(
        self, step: Step, readings: MotionReadings | None = None, carried_s: float | None = None
    ) -> MotionMeasurement:
        """No source measured the motion: sigma grows with the time since the last, however many steps it is cut into.

        A gyro, if there is one, still measures the turn.

        Args:
            step: over which.
            readings: of it.
            carried_s: since when the robot is carried, so that its wheels do not measure [s]; None: it is not.
        """
        before = self._silent_s if carried_s is None else carried_s
        after = before + step.dt
        if carried_s is None:
            self._silent_s = after
        motion, cov = np.zeros(3), np.diag(np.square(self._widest)) * (after**2 - before**2)
        if self._steady is not None and carried_s is None:
            motion, cov = self._steady.predict(step.start_ns, step.stamp_ns) or (motion, cov)
        gyro = None if readings is None else readings.gyro
        if gyro is not None:
            motion, cov[2, 2] = with_yaw(motion, float(gyro.motion[2])), gyro.cov[2, 2]
        inertial = None if readings is None else readings.inertial
        return MotionMeasurement("unknown", step.start_ns, step.stamp_ns, motion, cov, inertial=inertial)

    def commit(
        self, readings: MotionReadings, fix: PoseWithCovariance | None, stamp_ns: int, observes_yaw: bool = True
    ) -> None:
        """Update bias and drift of the sources after a step.

        Args:
            readings: of that step.
            stamp_ns: of its end.
            fix: where sightings have it now; None if there were none.
            observes_yaw: whether one of them observes the yaw by itself. Positions and ranges do along the way: the yaw
                of a fix then rests on the gyro too, and only two fixes far apart correct its bias.
        """
        if fix is not None:
            self._silent_s = 0.0
            if self._steady is not None:
                self._steady.fix(fix, stamp_ns)
        if self.gyro is None:
            return
        if readings.gyro is None:
            self.gyro.forget_fix()
            return
        turn = readings.gyro
        seconds = (turn.stamp_ns - turn.start_ns) * 1e-9
        turned = float(turn.motion[2])
        if self.factors.installation.ground:  # the gyro turns about the robot's axis, the yaw about the map's
            known, inertial = self.factors.estimated.mean, readings.inertial
            turned = planar_turn(turn.motion, inertial, known, self.factors.installation)
        self.gyro.turned(turned, seconds)
        if fix is None:
            return
        yaw, variance = float(fix.pose[2]), float(fix.cov[2, 2])
        if observes_yaw:
            self._yaw_indirect_s = 0.0
            self.gyro.fix(yaw, variance)
        else:
            memory_s = self._yaw_memory_s(variance)
            self._yaw_indirect_s = min(self._yaw_indirect_s + seconds, memory_s, self._config.estimator.lag_s)
            self.gyro.fix(yaw, variance, apart_s=_MEMORIES * memory_s)

    def _yaw_memory_s(self, variance: float) -> float:
        """How far back [s] a yaw of this variance [rad²] can rest on the gyro alone.

        Over a time t its noise and its bias make a variance of q t + b² t²: where the yaw is known better than that,
        fixes have replaced the turns before.
        """
        if self.gyro is None or self._turn is None:
            return 0.0
        noise, bias = 0.5 * self._turn.noise_density, self.gyro.bias_variance
        return variance / (noise + math.sqrt(noise**2 + bias * variance))

    def begin_segment(self) -> None:
        """Forget the last fix, as nothing is known of the motion during a jump of the clock."""
        self._silent_s = self._yaw_indirect_s = 0.0
        if self._steady is not None:
            self._steady.begin_segment()
        if self.beside is not None:
            self.beside.begin_segment()
        if self.gyro is not None:
            self.gyro.forget_fix()


# --- Difference of two sources ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """Difference of two motion sources over a step, in the body frame.

    Attributes:
        value: ``(3,)``.
        cov: ``(3, 3)`` if both are right, of what differs from step to step.
        by_installation: ``(3, p)`` derivative by the parameters of the sources, whose error is always the same ...
        installation_cov: ... and their covariance ``(p, p)``.
    """

    value: FloatArray
    cov: FloatArray
    by_installation: FloatArray
    installation_cov: FloatArray


def source_difference(readings: MotionReadings, sources: MotionSources) -> Difference | None:
    """How far the wheels and their reference source are apart over the step.

    Returns:
        None where there is no reference source: a model that reads the wheels is none, nor is one of the commands
        that replace wheels.
    """
    wheels, learned, gyro, rules = readings.wheels, readings.learned, readings.gyro, sources.rules
    if wheels is None or rules.wheels_are_commands:
        return None
    if learned is not None and sources.learned_is_independent:
        d = se2.log(se2.between(wheels.motion, learned.motion))
        cov = wheels.cov + learned.cov
        if rules.joint is not None:
            cov = rules.joint.difference_cov(wheels.cov, learned.cov)
        return Difference(d, cov, *_systematic(wheels, learned, sources.factors))
    if gyro is None:
        return None
    d = np.array([0.0, 0.0, se2.wrap(float(gyro.motion[2] - wheels.motion[2]))])
    cov = np.diag([1.0, 1.0, wheels.cov[2, 2] + gyro.cov[2, 2]])
    return Difference(d, cov, *_systematic(wheels, gyro, sources.factors))


def _systematic(a: MotionMeasurement, b: MotionMeasurement, factors: LandmarkFactors) -> tuple[FloatArray, FloatArray]:
    """Derivative ``(3, p)`` of ``b`` less ``a`` by all parameters that are not of sightings, and their covariance.

    By all: steps are summed although the reference source may be another one in each.
    """
    installation = factors.installation
    rows = installation.motion_rows
    D = np.zeros((3, len(rows)))
    for i, row in enumerate(rows):
        name = installation.names[row]
        for m, sign in ((a, -1.0), (b, 1.0)):
            if name in m.depends_on:
                D[:, i] += sign * m.depends_on[name][0]
    return D, factors.estimated.cov[np.ix_(rows, rows)]


# --- Which sources are rejected, and since when -----------------------------------------------------------------------

_STILL = 0.02  # of the reference source's travel: encoders that jitter count less
_MOVED = 0.25  # of the reference source's travel: a wheel that turned less stood still, one that lacks less turned
# Travel by the reference source from which a wheel is known to have turned or to have stood. Over a shorter way a robot
# slides on with its wheels at rest: 0.08 m from 0.4 m/s at a friction of 0.1.
_LEAST_M = 0.15
KNOWN = "distrusted"  # a failure that the configuration states
CONTRADICTED = "contradicted"  # by sightings: why a motion model is rejected
_PROVEN_M = 0.5  # way over which wheels and model have agreed before the model may accuse the wheels


class MotionFaultMonitor:
    """Tests wheels against their reference source; known failures are taken as given.

    Where the two differ, wheels are taken to be wrong, unless sightings contradict the learned motion instead. Where
    sightings cannot tell, a model that never agreed with the wheels for longer than it differed, nor with sightings
    against them, accuses nobody: it is left out, and the wheels are kept with room for a slip.

    Attributes:
        flags: how often wheels were flagged, by "source.reason".
        compared_s: for how long there was a motion model to be compared with the wheels [s] ...
        left_out_s: ... and for how long it was left out, as sightings contradict it.
    """

    def __init__(
        self,
        config: WeightsConfig,
        sources: MotionSources,
        track_m: float | None,
        attribution: FaultAttribution | None = None,
    ) -> None:
        """Set up thresholds and sources.

        Args:
            config: thresholds, and known failures.
            sources: gives the difference of two readings with its covariance.
            track_m: distance of the wheels, to distinguish left from right; None: unknown.
            attribution: tells by sightings which of the two is wrong; None: always the wheels.
        """
        self.flags: Counter[str] = Counter()
        self.compared_s = self.left_out_s = 0.0
        self._config = config
        self._sources = sources
        self._attribution = attribution
        self._track_m = track_m
        self._glr = GlrTest(config)
        self._travels: deque[FloatArray] = deque()  # (5,): dt, ways of left and right wheel by wheels and by reference
        self._first_ns: int | None = None  # of the run
        self._wrong_before: dict[str, str] = {}  # as of the step before: sources, and why
        self._reason = "slip"  # of the wheels
        self._model_wrong_s = 0.0  # for how long the model is still left out
        self._tested_s = 0.0  # since a model that is left out was last tested
        self._differing_steps = 0  # for how many steps the two have differed
        self._agreed_m = self._disputed_m = 0.0  # ways over which they agreed, and differed without a judgement
        self._proven = False  # whether the model has agreed with the wheels for long, or with sightings against them
        self._doubted_steps = 0  # since both were doubted, and sightings have not told which was wrong

    def begin(self, step: Step) -> None:
        """Begin the test with the first step of the run, or of a segment."""
        if self._first_ns is None:
            self._first_ns = step.start_ns
        self._doubted_steps = 0
        self.reset()

    def reset(self) -> None:
        """Forget all steps, as nothing connects them with those to come."""
        self._glr.reset()
        self._travels.clear()

    def judge(self, step: Step, readings: MotionReadings) -> FaultVerdict:
        """Test the sources with the readings of a step that follows the last one."""
        rejected = self._known_failures(step)
        if "wheels" in rejected:  # nothing to be found out
            self.reset()
        readings = _without(readings, rejected)
        left_out = {"learned"} if self._model_wrong_s > 0.0 else set()
        difference = None
        if self._config.adaptive:
            difference = source_difference(_without(readings, left_out), self._sources)
        verdict = GlrResult(False, 0, math.nan, math.nan)
        if difference is not None:
            verdict = self._glr.judge(
                step.dt, difference.value, difference.cov, difference.by_installation, difference.installation_cov
            )
            self._travelled(step.dt, readings)
        wrong, span, doubted = self._wrong_sources(step, readings, verdict)
        scale = 1.0 if verdict.flagged else verdict.scale
        self.compared_s += step.dt * (readings.learned is not None)
        self.left_out_s += step.dt * ("learned" in wrong)
        budget, earlier = NoiseBudget({**wrong, **rejected}, scale), NoiseBudget(wrong if span else {}, scale)
        return FaultVerdict(budget, earlier, span or verdict.span, doubted, verdict.nis, verdict.bound)

    def _wrong_sources(
        self, step: Step, readings: MotionReadings, verdict: GlrResult
    ) -> tuple[dict[str, str], int, int]:
        """Wrong sources and why; number of newest steps for which that is news; steps since both were doubted."""
        since, was_left_out = verdict.since, self._model_wrong_s > 0.0
        self._differing_steps = since or self._differing_steps + 1
        found = self._contradicted(step, readings, verdict)
        contradicted = frozenset() if found is None else found.sources
        if self._attribution is not None and "learned" in contradicted:
            self._model_wrong_s = self._attribution.memory_s  # until it has agreed for as long: it mostly stays wrong
            self._proven, self._agreed_m, self._disputed_m = False, 0.0, 0.0
            if not was_left_out:
                self._glr.reset()  # wheels are compared with another source from now on
        elif found is not None:
            self._proven |= not was_left_out  # they differ, and it is not the model that sightings contradict
            self._model_wrong_s = max(self._model_wrong_s - self._config.window_s, 0.0)
        if verdict.flagged:
            self._reason = self._failure(since)
        wrong = {"learned": CONTRADICTED} if self._model_wrong_s > 0.0 else {}
        by_default = verdict.flagged and (was_left_out or "learned" not in contradicted)
        if "wheels" in contradicted or by_default:
            wrong["wheels"] = self._reason
        undecided = found is None and not was_left_out and self._compares_model(readings)
        if undecided:
            self._record_agreement(readings, verdict)
        self._doubted_steps += self._doubted_steps > 0
        if undecided and verdict.flagged and not self._proven and not self._stands_still():
            wrong = dict.fromkeys(("wheels", "learned"), DOUBTED)
            self._doubted_steps = max(self._doubted_steps, since, 1)
        before, self._wrong_before = self._wrong_before, wrong
        if verdict.flagged:
            self._count(before.get("wheels"), wrong.get("wheels"), since)
        news = "wheels" in contradicted or ("learned" in contradicted and not was_left_out)
        # A model of another robot is wrong all the time: it was while both were doubted
        doubted = self._doubted_steps if contradicted == {"learned"} else 0
        if found is not None or self._proven:
            self._doubted_steps = 0
        if since or found is None or not news or before.keys() == wrong.keys():
            return wrong, since or min(doubted, 1), doubted
        return wrong, found.steps, doubted

    def _compares_model(self, readings: MotionReadings) -> bool:
        """Whether the test of this step holds wheels against a model that does not read them."""
        return self._sources.learned_is_independent and None not in (readings.wheels, readings.learned)

    def _record_agreement(self, readings: MotionReadings, verdict: GlrResult) -> None:
        """Add the way of a step on which wheels and model agreed, or differed without a sighting that decides."""
        assert readings.wheels is not None
        if verdict.since:
            self._proven |= self._agreed_m > max(_PROVEN_M, self._disputed_m)
        way = max(self._sides(readings.wheels.motion))
        if verdict.flagged:
            self._disputed_m += way
        else:
            self._agreed_m += way

    def _contradicted(self, step: Step, readings: MotionReadings, verdict: GlrResult) -> Contradicted | None:
        """Motion sources that sightings contradict; None: sightings cannot decide, or no decision is due.

        They are asked while wheels and learned motion differ; of a model that is left out, once every window.
        """
        if self._attribution is None or readings.learned is None:
            return None
        if self._model_wrong_s == 0.0:
            self._tested_s = 0.0
            return self._attribution.contradicted(self._differing_steps) if verdict.flagged else None
        self._tested_s += step.dt
        if self._tested_s < self._config.window_s:
            return None
        found = self._attribution.contradicted(None)
        if found is not None:
            self._tested_s = 0.0
        return found

    def _count(self, before: str | None, why: str | None, since: int) -> None:
        """Count a failure of the wheels that is new; one that is seen better now takes the place of the one before."""
        if why is not None and (since or why != before):
            self.flags[f"wheels.{why}"] += 1
        if before is not None and not since and why != before:
            self.flags -= Counter({f"wheels.{before}": 1})

    def _known_failures(self, step: Step) -> dict[str, str]:
        start = (step.start_ns - (self._first_ns or 0)) * 1e-9
        end = start + step.dt
        return {d.source: KNOWN for d in self._config.distrust if start < d.end_s and end > d.start_s}

    def _travelled(self, dt: float, readings: MotionReadings) -> None:
        reference = readings.learned or readings.gyro
        if readings.wheels is None or reference is None:
            return
        self._travels.append(np.array([dt, *self._sides(readings.wheels.motion), *self._sides(reference.motion)]))
        total = np.sum(self._travels, axis=0)
        while len(self._travels) > 1 and (
            total[0] > self._config.window_s or (total[3:] - self._travels[0][3:] > _LEAST_M).all()
        ):
            total -= self._travels.popleft()

    def _failure(self, since: int) -> str:
        """Kind of the wheels' failure: frozen, one wheel dead, or slip at an onset; else the kind found before."""
        if since:  # what was before is no evidence
            self._travels = deque(list(self._travels)[-since:])
        _, *ways = np.sum(self._travels, axis=0)
        by_wheels, did = np.reshape(ways, (2, 2))
        went = did > _LEAST_M
        stood, turned = went & (by_wheels < _MOVED * did), went & (by_wheels > (1.0 - _MOVED) * did)
        if stood.all():
            return "frozen"
        if self._track_m is not None and stood[0] and turned[1]:
            return "left_wheel_dead"
        if self._track_m is not None and stood[1] and turned[0]:
            return "right_wheel_dead"
        return "slip" if since else self._reason

    def _stands_still(self) -> bool:
        """Whether a wheel that should have turned reports nothing, which no model of another robot feigns."""
        _, *ways = np.sum(self._travels, axis=0) if self._travels else np.zeros(5)
        by_wheels, did = np.reshape(ways, (2, 2))
        return self._reason != "slip" and bool(((did > _LEAST_M) & (by_wheels < _STILL * did)).any())

    def _sides(self, motion: FloatArray) -> tuple[float, float]:
        """How far the left and the right wheel went [m]."""
        forward, turn = float(motion[0]), 0.5 * (self._track_m or 0.0) * float(motion[2])
        return abs(forward - turn), abs(forward + turn)


def _without(readings: MotionReadings, sources: Collection[str]) -> MotionReadings:
    """Readings without those of these sources."""
    gone: dict[str, Any] = dict.fromkeys(name for name in sources if name in MOTION_SOURCES)
    beside = tuple(m for m in readings.beside if m.source not in sources)
    return replace(readings, **gone, beside=beside)


# --- Drift between fixes ----------------------------------------------------------------------------------------------

_STRETCH_S = 2.0  # between two fixes that are compared: about as long as errors of slips and of models last
_LONGEST_S = 10.0  # without a fix; a longer stretch is not compared
_CALM_S = 30.0  # of driving without any excess that are counted before the run
_REMEMBERED_S = 600.0  # of driving, after which floor and load may be others
_VAGUE = 0.25  # m², rad²: a stretch that is expected to be off by more says nothing
_MOST = 0.5  # of the way and of the turn, by which dead reckoning may be off; more is a wrong place ...
_ANYWAY = 0.15  # m, rad: ... so much aside


class ExcessDrift:
    """Drift of dead reckoning between fixes, as far as it exceeds its covariance: it is expected to go on, as noise.

    Wheels alone do not show that they slip, and a model of commands does not show that it is of another floor.
    Sightings do. From one fix to another, `_STRETCH_S` and more later, the squared error of dead reckoning less the
    variance that it expects is added to a sum, which forgets within `_REMEMBERED_S`.
    """

    def __init__(self, estimator: Estimator) -> None:
        """Set up for the estimator, whose installation it knows."""
        self._estimator = estimator
        self._belief: PoseWithCovariance | None = None  # by motion alone, since the fix where the stretch began
        self._names: tuple[str, ...] = ()  # of the parameters of that belief
        self._stretch_s = self._moving_s = self._unseen_s = 0.0
        self._way = self._turn = 0.0
        self._excess, self._doubt = np.zeros(2), np.zeros(2)  # m², rad²: sums, and what their variances are by chance
        self._driven_s = 0.0

    def forget_fix(self) -> None:
        """The pose is set anew, or no motion is known to have led there."""
        self._belief = None

    @property
    def density(self) -> FloatArray | None:
        """Densities ``(3,)`` of the noise to add, see `NoiseBudget`; None: dead reckoning is as good as it says."""
        sure = np.maximum(self._excess - np.sqrt(self._doubt), 0.0)  # m², rad²
        if not sure.any():
            return None
        along, turn = sure / (_CALM_S + self._driven_s)
        return np.array([0.5 * along, 0.5 * along, turn])

    def advance(self, step: Step, motions: Sequence[MotionMeasurement]) -> None:
        """Go on by the motions of a step, before sightings are held against them."""
        self._unseen_s += step.dt
        changed = self._names is not self._estimator.installation.names  # rows are of other landmarks now
        if self._belief is None or self._unseen_s > _LONGEST_S or changed or not motions:
            self._belief = None
            return
        before = self._belief
        self._belief = predict(before, self._estimator.installed, self._estimator.installation, motions)
        went = se2.between(before.pose, self._belief.pose)
        self._way, self._turn = self._way + math.hypot(*went[:2]), self._turn + abs(float(went[2]))
        self._stretch_s += step.dt
        self._moving_s += step.dt * moves(went, step.dt)

    def fix(self, belief: PoseWithCovariance) -> None:
        """Compare with a fix at the end of the step, and begin the next stretch there."""
        if self._belief is not None and self._stretch_s < _STRETCH_S:
            self._unseen_s = 0.0
            return
        if self._belief is not None and self._moving_s > 0.0:
            x, y, yaw = se2.between(self._belief.pose, belief.pose)
            most = _MOST * np.array([self._way, self._turn]) + _ANYWAY
            error = np.minimum([math.hypot(x, y), abs(yaw)], most) ** 2
            P = self._belief.cov + belief.cov
            expected = np.array([P[0, 0] + P[1, 1], P[2, 2]])
            if (expected < _VAGUE).all():
                kept = math.exp(-self._moving_s / _REMEMBERED_S)
                self._excess = kept * self._excess + error - expected
                self._doubt = kept**2 * self._doubt + 2.0 * expected**2
                self._driven_s = kept * self._driven_s + self._moving_s
        self._belief, self._names, self._unseen_s = belief, self._estimator.installation.names, 0.0
        self._stretch_s = self._moving_s = self._way = self._turn = 0.0


# --- Judge, and revise past steps -------------------------------------------------------------------------------------

_RATE_MEMORY_S = 60.0  # added to the time of a run, which at its beginning says little of a rate
_CARRIED = "carried"  # why nothing of a robot that was lifted enters


@dataclass(frozen=True, slots=True, eq=False)
class JudgedMotion:
    """The motion over one step as it enters the graph.

    Attributes:
        factors: independent of each other; at least one.
        readings: what they were made of, to make them anew; empty if the robot was carried.
        budget: the noise that they were made with.
        nis: of the difference of wheels and reference source, see `FaultVerdict` ...
        threshold: ... and what it is held against.
        revisions: rows of ``steps.csv`` of earlier steps whose motion was combined anew.
    """

    factors: tuple[MotionMeasurement, ...]
    readings: MotionReadings
    budget: NoiseBudget
    nis: float
    threshold: float
    revisions: tuple[Decision, ...] = ()

    def overruled(self, cov: FloatArray) -> JudgedMotion:
        """The motion where sightings found it to be wrong: ``cov (3, 3)`` is added to each factor."""
        budget = replace(self.budget, overruled_cov=cov)
        return replace(self, factors=tuple(budget.overruled(m) for m in self.factors), budget=budget)

    def decisions(self, k: int) -> list[Decision]:
        """Rows of ``steps.csv`` for this step; those of earlier ones are `revisions`."""
        return motion_decisions(k, self.factors, self.readings, self.budget, self.nis, self.threshold)


class MotionJudge:
    """Reads the motion sources of each step and decides what of them enters the graph.

    Attributes:
        sources: wheels, learned motion, gyro.
        rejections: steps without a usable motion, by reason.
    """

    def __init__(self, config: Config, sensors: MotionSensors, estimator: Estimator) -> None:
        """Set up for the sensors of a run, and the estimator whose past motions are revised."""
        self.sources = MotionSources(config, sensors, estimator.factors)
        self.rejections: Counter[str] = Counter()
        self._estimator = estimator
        by_sightings = FaultAttribution(config, estimator)
        attribution = by_sightings if self.sources.learned_is_independent else None
        self._faults = MotionFaultMonitor(config.weights, self.sources, sensors.wheels.track_m, attribution)
        if sensors.beside:
            self.sources.beside = OdometriesBeside(config.weights, sensors.beside, estimator.factors, by_sightings)
        self._lift = LiftMonitor(config.estimator.lag_s, None if sensors.gyro is None else sensors.gyro.up)
        # Of all motion sources together, where none shows the errors of another; else of the learned motion by itself
        told = config.weights.adaptive and estimator.factors.known and not estimator.installation.ground
        self._drifts = (ExcessDrift(estimator), ExcessDrift(estimator)) if told else None
        self._signs: list[Decision] = []  # of a lift, in the newest step

    def begin_segment(self, step: Step) -> None:
        """Begin a segment, after a jump of the clock or with the first step."""
        self._forget_fix()
        self._faults.begin(step)
        self._lift.reset()

    def begin_replay(self) -> None:
        """Prepare for earlier steps of the segment, which were collected until the first pose was known."""
        self._forget_fix()
        self._lift.reset()

    def restart(self) -> None:
        """Forget motion and faults, as the pose was set anew and no motion led there."""
        self._forget_fix()
        self._faults.reset()

    def _forget_fix(self) -> None:
        self.sources.begin_segment()
        for drift in self._drifts or ():
            drift.forget_fix()

    def read(self, step: Step, since_fix_s: float) -> MotionReadings:
        """Read every source once; one without data yields nothing.

        Args:
            step: the newest one.
            since_fix_s: time before it without a fix.
        """
        readings = self.sources.read(step, since_fix_s)
        self._signs = self._lift.observe(self._estimator.k + 1, step, readings)
        return readings

    def combine(
        self, step: Step, readings: MotionReadings, budget: NoiseBudget | None = None
    ) -> list[MotionMeasurement]:
        """Factors of a step: of the sources, or of a robot that is carried, or of one whose motion nothing measures."""
        if self._lift.carried:
            return [self.sources.unknown(step, readings, self._lift.carried_s(step))]
        made = (budget or NoiseBudget()).combine(readings, self.sources.rules)
        return made or [self.sources.unknown(step, readings)]

    def judge(self, step: Step, readings: MotionReadings) -> JudgedMotion:
        """Test the sources against each other, back to where they began to differ, and combine what is left of them."""
        self._end_silence()
        verdict = self._faults.judge(step, readings)
        revisions = self._revise(verdict)
        if self.sources.beside is not None:
            verdict, left_out = self._judge_beside(step, readings, verdict)
            revisions = (*revisions, *left_out)
        factors = tuple(self.combine(step, readings, verdict.budget))
        budget = self._with_drift(verdict.budget, step, readings, factors)
        if budget is not verdict.budget:
            factors = tuple(self.combine(step, readings, budget))
        if self._lift.carried:
            readings, budget = MotionReadings(), _carried()
        elif factors[0].source == "unknown" and not self.sources.unmeasured:
            self.rejections["motion.silent"] += 1
        return JudgedMotion(factors, readings, budget, verdict.nis, verdict.threshold, revisions)

    def _with_drift(
        self, budget: NoiseBudget, step: Step, readings: MotionReadings, factors: Sequence[MotionMeasurement]
    ) -> NoiseBudget:
        """The budget with the noise by which dead reckoning was further off between fixes than it says, if it was."""
        if self._drifts is None:
            return budget
        witnessed = self.sources.is_witnessed(readings)
        idle, drift = self._drifts if witnessed else self._drifts[::-1]
        idle.forget_fix()
        known = factors if factors[0].source != "unknown" else ()
        if witnessed:
            known = () if readings.learned is None else (readings.learned,)
        drift.advance(step, () if self._lift.carried else known)
        density = drift.density
        if density is None or self._lift.carried:
            return budget
        return replace(budget, learned_drift=density) if witnessed else replace(budget, drift=density)

    def _judge_beside(
        self, step: Step, readings: MotionReadings, verdict: FaultVerdict
    ) -> tuple[FaultVerdict, tuple[Decision, ...]]:
        """Verdict with the odometries beside the wheels that are wrong left out, and rows of the steps before."""
        assert self.sources.beside is not None
        others = verdict.budget.combine(replace(readings, beside=(), at_rest=False), self.sources.rules)
        found = self.sources.beside.judge(step, others)
        if not found.rejected:
            return verdict, ()
        newest = self._estimator.log.keyframes.get(self._estimator.k)
        before = {} if newest is None else newest.budget.rejected
        if "wheels" in found.rejected and "wheels" not in {**before, **verdict.budget.rejected}:
            self._faults.flags["wheels.slip"] += 1
        budgets = {
            frame.k: replace(frame.budget, rejected={**found.rejected, **frame.budget.rejected})
            for frame in self._newest_steps(found.span)
            if not found.rejected.keys() <= frame.budget.rejected.keys()
        }
        budget = replace(verdict.budget, rejected={**found.rejected, **verdict.budget.rejected})
        return replace(verdict, budget=budget), self._combine_anew(budgets, verdict)

    def commit(self, motion: JudgedMotion, fix: PoseWithCovariance | None, observes_yaw: bool) -> None:
        """Update bias and drift of the sources after a step, see `MotionSources.commit`."""
        if fix is not None:
            self.record_fix()
            for drift in self._drifts or ():
                drift.fix(fix)
        self.sources.commit(motion.readings, fix, motion.factors[0].stamp_ns, observes_yaw)

    def record_fix(self) -> None:
        """Note that sightings, or a given pose, have fixed where the robot is."""
        self._lift.fix()

    @property
    def slips_per_s(self) -> float:
        """Slips of the wheels that were found in this run, for each second of it."""
        return self._faults.flags["wheels.slip"] / (_RATE_MEMORY_S + self._estimator.elapsed_s)

    @property
    def is_carried(self) -> bool:
        """Whether the robot may be in the air, or was set down a short time ago."""
        return self._lift.carried

    def take_signs(self) -> list[Decision]:
        """Rows of ``steps.csv`` for signs of a lift in the newest step; each is given once."""
        signs, self._signs = self._signs, []
        return signs

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user about the motion sources."""
        beside = self.sources.beside
        flags, notes = (Counter[str](), ()) if beside is None else (beside.flags, beside.notes)
        return (*self._model_notes(), *flag_notes(self._faults.flags + flags), *notes)

    @property
    def mistakes(self) -> tuple[str, ...]:
        """The sentence on a motion model that sightings contradict most of the time."""
        return self._model_notes() if self._faults.left_out_s > 0.5 * self._faults.compared_s else ()

    def _model_notes(self) -> tuple[str, ...]:
        left_out_s = self._faults.left_out_s
        return (left_out_note(left_out_s),) if left_out_s > 0.0 else ()

    def _end_silence(self) -> None:
        """Give the steps within a silence of the wheels the motion that the reading after it tells.

        That they were taken to stand, and a gyro turned, was no slip.
        """
        again, frames = self.sources.measured_again, []
        for frame in reversed(self._estimator.log.keyframes.values()):
            if not again or frame.stamp_ns < again[0].stamp_ns:
                break
            if frame.step in again and frame.prior is None and frame.readings.wheels is not None:
                frames.append(frame)
        if any(f.sightings or f.readings.learned is not None or f.readings.beside for f in frames):
            return  # they tell more of the way than the ends of the silence
        changed: dict[int, Sequence[MotionMeasurement]] = {}
        for frame in frames:
            assert frame.step is not None
            rejected = {
                name: why for name, why in frame.budget.rejected.items() if name != "wheels" or why in (KNOWN, _CARRIED)
            }
            frame.budget = replace(frame.budget, rejected=rejected, scale=1.0)
            frame.readings = self.sources.read_again(frame.step, frame.readings)
            frame.added_cov = frame.added_cov + in_silence(frame.readings)
            if motions := frame.budget.combine(frame.readings, self.sources.rules):
                changed[frame.k] = motions
        if changed:
            self._estimator.revise(changed, anew=True)
            self._faults.reset()

    def _revise(self, verdict: FaultVerdict) -> tuple[Decision, ...]:
        """Combine the motion of earlier steps anew, back to where the sources began to differ.

        Wheels that are wrong are left out; before that is certain, covariances are scaled.
        """
        if not verdict.earlier.rejected and verdict.earlier.scale < COVARIANCE_FACTOR:
            return ()
        first = self._estimator.k - verdict.span + 2
        budgets = {}
        for frame in self._newest_steps(max(verdict.span, verdict.doubted)):
            judged = frame.budget.rejected.get("wheels", DOUBTED) != DOUBTED  # soundly, in a stretch of doubt
            if (frame.k >= first or not judged) and (revised := _revised(frame, verdict.earlier)) is not None:
                budgets[frame.k] = revised
        return self._combine_anew(budgets, verdict)

    def _newest_steps(self, span: int) -> list[Keyframe]:
        """Keyframes of so many newest steps, without that of the step which is judged now; with a motion to them."""
        log, newest = self._estimator.log.keyframes, self._estimator.k
        frames = (log[k] for k in range(newest - span + 2, newest + 1) if k in log)
        return [frame for frame in frames if frame.prior is None]

    def _combine_anew(self, budgets: Mapping[int, NoiseBudget], verdict: FaultVerdict) -> tuple[Decision, ...]:
        """Give keyframes other budgets; rows of ``steps.csv`` for the motions that enter the graph instead."""
        changed: dict[int, Sequence[MotionMeasurement]] = {}
        rows: list[Decision] = []
        for k, budget in budgets.items():
            frame = self._estimator.log.keyframes[k]
            frame.budget = budget
            if motions := budget.combine(frame.readings, self.sources.rules):
                changed[k] = motions
                rows += motion_decisions(k, motions, frame.readings, budget, verdict.nis, verdict.threshold)
        self._estimator.revise(changed)
        return tuple(rows)


def in_silence(readings: MotionReadings) -> FloatArray | float:
    """Covariance ``(3, 3)`` of a pose within a silence of the wheels that nothing else tells; 0: it is in none."""
    wheels = readings.wheels
    if wheels is None or wheels.end_variance is None or readings.learned is not None or readings.beside:
        return 0.0
    return np.diag(wheels.end_variance * (1.0, 1.0, readings.gyro is None))


def _carried() -> NoiseBudget:
    return NoiseBudget({"wheels": _CARRIED, "learned": _CARRIED})


def _revised(frame: Keyframe, now: NoiseBudget) -> NoiseBudget | None:
    """The budget of an earlier step by what is known now; None: it stays."""
    before = frame.budget
    if now.rejected:
        known = {
            name: why
            for name, why in before.rejected.items()
            if why in (KNOWN, _CARRIED)
            or name not in MOTION_SOURCES  # those beside the wheels have a judge of their own
        }
        if {**now.rejected, **known}.keys() == before.rejected.keys():
            return None
        return replace(before, rejected={**now.rejected, **known})
    if now.scale >= COVARIANCE_FACTOR * max(before.scale, 1.0):
        return replace(before, scale=now.scale)
    return None
