"""The core loop. Replay and live streams call `Localizer.update` alike."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from fgloc import se2
from fgloc.carry import carry
from fgloc.config import Config
from fgloc.graph.ekf import ExtendedKalmanFilter
from fgloc.graph.estimator import Estimator, fuse
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.incremental import IncrementalEstimator
from fgloc.graph.interval import interval_scale
from fgloc.graph.log import Belief, Sighting
from fgloc.graph.weights import NEAR_M, NEAR_RAD, Fit, Weights
from fgloc.initializer import Initializer
from fgloc.motion.joint import JointCalibration
from fgloc.motion.source import LearnedMotion
from fgloc.motions import MotionSources
from fgloc.selfcal import Calibration, Calibrator
from fgloc.sensors.gyro import Gyro
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.wheels import WheelMotion
from fgloc.timing import Stopwatch
from fgloc.trust import SourceTrust, Trust
from fgloc.types import (
    Decision,
    Estimate,
    FloatArray,
    LandmarkMap,
    LandmarkMeasurement,
    Mode,
    MotionMeasurement,
    Readings,
    Step,
)

_REASONS = {
    "slip": "they slipped",
    "frozen": "they stood still while the robot moved",
    "left_wheel_dead": "the left wheel's encoder stood still",
    "right_wheel_dead": "the right wheel's encoder stood still",
}
_ORIGIN = np.diag([1e-6, 1e-6, 1e-6])  # without a map the first pose is its origin
_NOWHERE_M, _NOWHERE_RAD = 3.0, 0.7  # sigmas above which no sighting can be judged by the prediction
_ANYWHERE = np.diag([100.0, 100.0, 10.0])  # m², m², rad²: how far the robot may be after a jump of the clock


class Localizer:
    """Estimates ``T_map_base``, one Step at a time.

    Attributes:
        estimator: the filter, whose log the batch smoother starts from.
        factors: maker of landmark factors, shared with the batch smoother.
        counts: factors added, by kind.
        rejections: what was not used, by reason.
        stopwatch: time spent in each phase.
    """

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | None,
        wheels: WheelMotion,
        landmarks: LandmarkSensor,
        learned: LearnedMotion | None = None,
        joint: JointCalibration | None = None,
        keep_all: bool = False,
        gyro: Gyro | None = None,
    ) -> None:
        """Put the parts together.

        Args:
            config: everything tunable.
            landmark_map: the known map; None: landmarks become variables and the first pose is the origin.
            wheels: wheel odometry.
            landmarks: sightings to measurements.
            learned: the learned motion, if any.
            joint: its correlation with the wheels; None: the two are taken as independent.
            keep_all: keep the measurement log of the whole run, for the batch smoother.
            gyro: the gyro, if any.
        """
        self.config = config
        self.factors = LandmarkFactors(landmark_map)
        kind = ExtendedKalmanFilter if config.estimator.kind == "ekf" else IncrementalEstimator
        self.estimator: Estimator = kind(config.estimator, self.factors, keep_all)
        self.weights = Weights(config, self.factors)
        self.counts: Counter[str] = Counter()
        self.rejections: Counter[str] = Counter()
        self.stopwatch = Stopwatch()
        self.sources = MotionSources(config, wheels, learned, joint, gyro)
        self.trust = SourceTrust(config.weights, self.sources, config.wheels.track)
        self._wheels = wheels
        self._landmarks = landmarks
        known = landmark_map.landmarks.values() if landmark_map is not None else ()
        self._sizes = {landmark.landmark_id: landmark.size_m for landmark in known}
        self.calibrator: Calibrator | None = None
        if landmark_map is not None and config.landmarks.self_calibrating:
            self.calibrator = Calibrator(config.landmarks, landmark_map)
        self._initializer = Initializer(config, landmark_map, self.factors)
        self._segment = -1
        self._prior: Belief | None = None  # where the segment starts, if that is known without sightings
        self._last_fix_s = self._last_fix_elapsed_s = 0.0
        self._clock_s = 0.0
        self._lost = False

    def update(self, step: Step) -> Estimate | None:
        """Take in one step; return the newest pose, or None while the first pose is not yet known."""
        self._clock_s += step.dt
        if step.segment != self._segment:
            self._begin_segment(step)
        elif not self._initializer.waiting and self._nowhere():
            self._get_lost()
        # 1. Measure: one call per sensor; a silent sensor yields nothing
        with self.stopwatch("motion"):
            readings = self.sources.read(step, self._clock_s - step.dt - self._last_fix_s)
        with self.stopwatch("sightings"):
            sightings = self._measure_landmarks(step)
        if self._initializer.waiting:
            return self._initialize(step, readings, sightings)
        return self._advance(step, readings, sightings)

    def _measure_landmarks(self, step: Step) -> list[LandmarkMeasurement]:
        measured: list[LandmarkMeasurement] = []
        for event in step.sightings:
            found = self._landmarks.measure(event)
            if found and event.stamp_ns != step.stamp_ns:
                motion, cov = self._wheels.carry(step, step.stamp_ns, event.stamp_ns)
                found = tuple(carry(m, motion, cov, self._sizes.get(m.landmark_id, 0.0), len(found)) for m in found)
            measured.extend(found)
        return measured

    def _begin_segment(self, step: Step) -> None:
        """The clock jumped, or this is the first step: nothing connects the robot to where it was."""
        self._segment = step.segment
        self._lost = False
        self.sources.begin_segment()
        self.trust.reset()
        self.weights.begin_segment()
        self._initializer.reset()
        given = self.config.estimator.initial_pose
        last = self.estimator.belief
        if given is not None and last is None:
            self._prior = Belief(np.array(given), np.diag(np.square(self.config.estimator.initial_sigmas)))
        elif not self.factors.known:
            self._prior = Belief(np.zeros(3), _ORIGIN) if last is None else Belief(last.pose, _ANYWHERE.copy())
        else:
            self._prior = None

    def _initialize(self, step: Step, readings: Readings, sightings: Sequence[LandmarkMeasurement]) -> Estimate | None:
        """Collect steps until the first pose is clear, then run them all through the estimator."""
        if self._prior is not None:
            prior, self._prior = self._prior, None  # it says nothing of where the robot is once it got lost
            self._initializer.waiting = False
            return self._start(step, prior, sightings)
        started = self._initializer.collect(step, self.sources.combine(readings), sightings, readings)
        if started is None:
            return self._advance(step, readings, ()) if self._lost else None
        if self._lost:
            return self._found(step, started.newest)
        first, *rest = started.steps
        estimate = self._start(first.step, started.first, first.sightings)
        decisions = [*estimate.decisions]
        for later in rest:
            estimate = self._advance(later.step, later.readings, later.sightings)
            decisions += estimate.decisions
        return dataclasses.replace(estimate, decisions=tuple(decisions))

    def _start(self, step: Step, prior: Belief, sightings: Sequence[LandmarkMeasurement]) -> Estimate:
        k = self.estimator.k + 1
        believed, _, decisions = self.weights.weigh(k, step.stamp_ns, sightings, prior, self._calibration())
        if self.calibrator is not None:
            self.calibrator.start(prior.pose, prior.cov)
        belief = self.estimator.start(step.stamp_ns, prior, believed)
        self.counts["prior"] += 1
        self._count_landmarks(decisions)
        self._fixed()
        return self._estimate(step, belief, decisions)

    def _advance(self, step: Step, readings: Readings, sightings: Sequence[LandmarkMeasurement]) -> Estimate:
        k = self.estimator.k + 1
        # 2. Weigh: the motion sources against each other, back to where they began to disagree; the sightings against
        # the prediction; and the motion against sightings that agree it is wrong
        with self.stopwatch("weigh"):
            trust = self.trust.judge(step, readings)
            decisions = self._revise(k, trust)
            motions = self.sources.combine(readings, trust.off)
            if not motions:
                motions = [self.sources.unknown(step)]
                self.rejections["motion.silent"] += 1
            motions, returned = self._return(k, step, motions, sightings)
            decisions += returned
            predicted = self.estimator.predict(motions)
            believed, refused, weighed = self.weights.weigh(k, step.stamp_ns, sightings, predicted, self._calibration())
            found = self._search(step, readings, refused, believed)
            if found is not None:
                return self._found(step, found)
            fit = None if believed else self.weights.overruled(refused, weighed, predicted)
            if fit is not None:
                motions = [doubted(m, predicted, fit) for m in motions]
                self.rejections["motion.overruled"] += 1
                predicted = self.estimator.predict(motions)
                believed, refused, weighed = self.weights.weigh(
                    k, step.stamp_ns, sightings, predicted, self._calibration()
                )
        # 3. Fuse
        with self.stopwatch("fuse"):
            rebuilt = self.estimator.rebuilt
            belief = self.estimator.update(step.stamp_ns, step.dt, motions, believed, refused, predicted)
        if self.estimator.rebuilt > rebuilt:
            self.rejections["estimator.window_rebuilt"] += 1
            believed = []
            weighed = [dataclasses.replace(d, weight=0.0, reason=d.reason or "window_rebuilt") for d in weighed]
        if self.calibrator is not None:
            self.calibrator.step(*fuse(motions), [s.raw for s in believed])
        self.counts.update(m.source for m in motions)
        self._count_landmarks(weighed)
        if believed:
            self._fixed()
        self.sources.went(readings, belief if believed else None)
        self._watch_for_loss(believed)
        frame = self.estimator.log.keyframes[k]
        frame.readings, frame.off = readings, trust.off
        decisions += motion_decisions(k, motions, readings, trust, "overruled by sightings" if fit is not None else "")
        return self._estimate(step, belief, [*decisions, *weighed])

    def _revise(self, k: int, trust: Trust) -> list[Decision]:
        """Take back what a source that is not believed any more has said in the steps before this one."""
        if trust.span < 2:
            return []
        log = self.estimator.log.keyframes
        frames = [log[i] for i in range(k - trust.span + 1, k) if i in log and log[i].prior is None]
        changed, decisions = {}, []
        for frame in frames:
            frame.off = {**frame.off, **trust.off}
            changed[frame.k] = motions = self.sources.combine(frame.readings, frame.off)
            if motions:
                decisions += motion_decisions(frame.k, motions, frame.readings, trust, "")
            else:
                del changed[frame.k]
        self.estimator.revise(changed)
        return decisions

    def _return(
        self,
        k: int,
        step: Step,
        motions: list[MotionMeasurement],
        sightings: Sequence[LandmarkMeasurement],
    ) -> tuple[list[MotionMeasurement], list[Decision]]:
        """After dead reckoning, let the interval's covariances grow to what the returning sightings say of it."""
        usable = [m for m in sightings if not self.weights.quarantine.holds(m.landmark_id)]
        blind_s = self._clock_s - self._last_fix_s
        adaptive = self.config.weights.adaptive and self.factors.known and not self._lost
        if not adaptive or not usable or blind_s <= self.config.estimator.dead_reckoning_after_s:
            return motions, []
        scale, nis = interval_scale(self.estimator.predict(motions), usable, self.factors, self.config)
        reason = "interval_nis" if scale > 1.0 else ""
        if reason:
            self.estimator.inflate(self._last_fix_elapsed_s, scale)
            motions = [dataclasses.replace(m, cov=m.cov * scale) for m in motions]
            self.rejections["motion.interval_nis"] += 1
        residual = math.sqrt(max(nis, 0.0))
        return motions, [Decision(k, step.stamp_ns, "interval", -1, residual, nis, 3, 1.0 / scale, reason)]

    def _search(
        self, step: Step, readings: Readings, refused: Sequence[Sighting], believed: Sequence[Sighting]
    ) -> Belief | None:
        """While nothing is believed, look for another place that explains what is refused: the robot may be there.

        Returns:
            A place far from where the robot is believed to be, told by two landmarks or more; nearer ones are the
            business of `Weights.overruled`.
        """
        if believed:
            self._initializer.forget()
        contrary = [s.raw for s in refused if not self.weights.quarantine.holds(s.measurement.landmark_id)]
        searching = bool(contrary) or self._initializer.searching
        if (
            believed
            or not searching
            or self._initializer.waiting
            or not (self.config.weights.adaptive and self.factors.known)
        ):
            return None
        started = self._initializer.collect(step, self.sources.combine(readings), contrary, readings, known=True)
        if started is None or self.estimator.belief is None:
            return None
        x, y, yaw = se2.between(self.estimator.belief.pose, started.newest.pose)
        return started.newest if math.hypot(x, y) > NEAR_M or abs(yaw) > NEAR_RAD else None

    def _found(self, step: Step, place: Belief) -> Estimate:
        """Go on from a place that nothing connects with where the robot was believed to be."""
        self._lost = False
        self.rejections["motion.jump"] += 1
        self.sources.begin_segment()
        self.trust.reset()
        self.weights.forget_refusals()
        self._initializer.forget()
        return self._start(step, place, ())

    def _fixed(self) -> None:
        """Sightings were believed at the newest keyframe."""
        self._last_fix_s, self._last_fix_elapsed_s = self._clock_s, self.estimator.elapsed_s

    def _watch_for_loss(self, believed: Sequence[object]) -> None:
        """After many refusals without one belief in between, look for the robot anywhere on the map."""
        if believed:
            self._lost = False
        elif self.factors.known and self.weights.contradicted():
            self._get_lost()

    def _nowhere(self) -> bool:
        """Whether the pose is so little known that only a search of the map can find it again."""
        belief = self.estimator.belief
        if belief is None or not self.factors.known:
            return False
        x, y, yaw = np.sqrt(np.diag(belief.cov))
        return bool(max(x, y) > _NOWHERE_M or yaw > _NOWHERE_RAD)

    def _get_lost(self) -> None:
        self._lost = True
        self.weights.forget_refusals()
        self._initializer.waiting = True

    def _estimate(self, step: Step, belief: Belief, decisions: Sequence[Decision]) -> Estimate:
        mode = Mode.OK
        if self._lost:
            mode = Mode.LOST
        elif self._clock_s - self._last_fix_s > self.config.estimator.dead_reckoning_after_s:
            mode = Mode.DEAD_RECKONING
        frame = self.estimator.log.keyframes[self.estimator.k]
        frame.step, frame.mode = step, mode
        cov = se2.rotate_cov(belief.cov, float(belief.pose[2]))
        return Estimate(step.stamp_ns, belief.pose, cov, mode, tuple(decisions))

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know so far, one sentence each."""
        notes = []
        for landmark_id, moved in self.weights.quarantine.displacements.items():
            notes.append(
                f"marker {landmark_id} does not stand where the map has it: it seems to be {math.hypot(*moved):.2f} m "
                f"off (x {moved[0]:+.2f}, y {moved[1]:+.2f}) and was not used; correct the map or take it down"
            )
        for kind, n in sorted(self.trust.flags.items()):
            source, reason = kind.split(".")
            notes.append(f"the {source} disagreed with the other motion sources {n} time(s): {_REASONS[reason]}")
        return tuple(notes)

    def _calibration(self) -> Calibration | None:
        return None if self.calibrator is None else self.calibrator.calibration

    def _count_landmarks(self, decisions: Sequence[Decision]) -> None:
        self.counts.update(d.kind for d in decisions if not d.reason)


def doubted(m: MotionMeasurement, predicted: Belief, fit: Fit) -> MotionMeasurement:
    """The motion with room in its covariance for the place that the sightings agree on."""
    miss = se2.log(se2.between(predicted.pose, fit.pose))
    return dataclasses.replace(m, cov=m.cov + np.diag(miss**2))


def motion_decisions(
    k: int, motions: Sequence[MotionMeasurement], readings: Readings, trust: Trust, reason: str
) -> list[Decision]:
    """Rows of ``steps.csv`` for the motion of a step: the residual is that against the wheels.

    Sources that are not believed have weight 0 and say why. A ``reason`` says why the covariance of all the others was
    inflated; their weight is then 0 too, as they no longer hold the pose. A step that was judged again has more than
    one row for a source; the last one holds.
    """
    rows = []
    used = {m.source: m for m in motions}
    for source in ("wheels", "learned", "gyro", "unknown"):
        reading = getattr(readings, source, None) or used.get(source)
        why = trust.off.get(source, reason)
        if reading is None or (source not in used and not why):
            continue
        nis = 0.0
        if readings.wheels is not None and source != "wheels":
            difference: FloatArray = se2.log(se2.between(readings.wheels.motion, reading.motion))
            nis = float(difference @ np.linalg.solve(readings.wheels.cov + reading.cov, difference))
        weight = 0.0 if why else 1.0
        rows.append(Decision(k, reading.stamp_ns, source, -1, nis**0.5, nis, 3, weight, why))
    return rows
