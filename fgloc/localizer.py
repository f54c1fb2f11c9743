"""The core loop. Replay and live streams call `Localizer.update` alike."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.ekf import ExtendedKalmanFilter
from fgloc.graph.estimator import Estimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import installation_of
from fgloc.graph.isam2 import IncrementalEstimator
from fgloc.graph.measurement_log import LandmarkFactor, PoseWithCovariance
from fgloc.relocalization.global_search import InitialPose
from fgloc.relocalization.tracking_state import CONTRADICTS, Tracking
from fgloc.robust.association import Association
from fgloc.robust.decision_log import (
    JUMP,
    OVERRULED,
    flag_notes,
    mode_decisions,
    motion_decisions,
    moved_notes,
    place_decision,
    segment_decision,
)
from fgloc.robust.landmark_modes import ALARM
from fgloc.robust.lift import LiftMonitor
from fgloc.robust.motion_faults import FaultVerdict, MotionFaultMonitor
from fgloc.robust.motion_fusion import MotionFusion
from fgloc.robust.motion_noise import with_noise
from fgloc.sensors.base import Sensor
from fgloc.sensors.gyro.rate import Gyro
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.learned.joint import JointCalibration
from fgloc.sensors.learned.source import LearnedMotion
from fgloc.sensors.motion_compensation import MotionCompensation
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.timing import Stopwatch
from fgloc.types import (
    Decision,
    Estimate,
    FloatArray,
    LandmarkMap,
    LandmarkMeasurement,
    Mode,
    MotionMeasurement,
    MotionReadings,
    PoseMeasurement,
    Step,
)

_WORTH_A_REVISION = 4.0  # times the scale on its covariances: a step that disagrees more than it did is weighed anew


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
        sensors: Sequence[Sensor] = (),
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
            sensors: registered ones, whose measurements are judged and fused as sightings are.
        """
        self.config = config
        self.factors = LandmarkFactors(
            landmark_map,
            installation_of(
                config, landmark_map, landmarks.sees_corners, gyro is not None, has_model=learned is not None
            ),
        )
        kind = ExtendedKalmanFilter if config.estimator.kind == "ekf" else IncrementalEstimator
        self.estimator: Estimator = kind(config.estimator, self.factors, keep_all)
        self.association = Association(config, self.factors)
        self.counts: Counter[str] = Counter()
        self.rejections: Counter[str] = Counter()
        self.stopwatch = Stopwatch()
        self.sources = MotionFusion(config, wheels, learned, joint, gyro, self.factors)
        self.motion_faults = MotionFaultMonitor(config.weights, self.sources, config.wheels.track)
        self._lift = LiftMonitor()
        self._compensation = MotionCompensation(landmarks, wheels, gyro, config.camera.time_jitter_s, sensors)
        self._tracking = Tracking(config, landmark_map, self.factors, keep_all)
        self._keep_all = keep_all
        self._segment = -1
        self._clock_jumps: list[Decision] = []  # not yet reported with an estimate
        self._lifted: list[Decision] = []  # likewise
        self._prior: PoseWithCovariance | None = None  # where the segment starts, if that is known without sightings
        self._restart: PoseWithCovariance | None = None  # where the next step is to begin anew

    def update(self, step: Step) -> Estimate | None:
        """Take in one step; return the newest pose, or None while the first pose is not yet known."""
        blind_s = self._tracking.blind_s
        self._tracking.advance_time(step.dt)
        if step.segment != self._segment or self._restart is not None:
            self._begin_segment(step)
        elif not self._tracking.waiting and self._tracking.is_unlocalized(self.estimator.belief):
            self._get_lost()
        # 1. Measure: one call per sensor; a silent sensor yields nothing
        with self.stopwatch("motion"):
            readings = self.sources.read(step, blind_s)
            self._lifted = self._lift.observe(self.estimator.k + 1, step, readings)
        with self.stopwatch("sightings"):
            offset_s = self.factors.installation.time_offset(self.factors.believed)
            sightings = self._compensation.measure(step, offset_s)
        if self._tracking.waiting:
            return self._initialize(step, readings, sightings)
        return self._advance(step, readings, sightings)

    @property
    def blind_s(self) -> float:
        """Time since the last fix [s]."""
        return self._tracking.blind_s

    def restart_at(self, belief: PoseWithCovariance) -> None:
        """At the next step, go on from a pose that is known from elsewhere: an earlier run, or the user.

        Sightings that contradict it do not hold: the map is searched.
        """
        self._restart = belief

    def _begin_segment(self, step: Step) -> None:
        """The clock jumped, or this is the first step: nothing connects the robot to where it was."""
        if self._keep_all:
            self.finish()
        if self._segment not in (-1, step.segment):
            self._clock_jumps.append(segment_decision(self.estimator.k + 1, step.start_ns))
        self._segment = step.segment
        self.sources.begin_segment()
        self.motion_faults.begin(step)
        self._lift.reset()
        self.association.begin_segment()
        known, self._restart = self._restart, None
        self._prior = self._tracking.begin_segment(self.estimator.belief, known)

    def _initialize(
        self, step: Step, readings: MotionReadings, sightings: Sequence[LandmarkMeasurement]
    ) -> Estimate | None:
        """Collect steps until the first pose is clear, then run them all through the estimator."""
        if self._prior is not None:
            prior, self._prior = self._prior, None  # it says nothing of where the robot is once it got lost
            self._tracking.start_known()
            return self._start(step, prior, sightings)
        motions = self._motions(step, readings, FaultVerdict())
        started = self._tracking.collect(step, motions, sightings, readings)
        if started is None:
            return self._advance(step, readings, ()) if self._tracking.lost else self._unconfirmed(step)
        if self._tracking.lost:
            return self._found(step, started.newest, [])
        estimates = self._replay(started)
        decisions = [d for estimate in estimates for d in estimate.decisions]
        return dataclasses.replace(estimates[-1], decisions=tuple(decisions))

    def _unconfirmed(self, step: Step) -> Estimate | None:
        """The pose before the sightings are enough to begin the graph with."""
        belief = self._tracking.unconfirmed()
        if belief is None:
            return None
        cov = se2.rotate_cov(belief.cov, float(belief.pose[2]))
        told = mode_decisions(self.estimator.k + 1, step.stamp_ns, Mode.UNCONFIRMED, self._tracking.blind_s, np.nan)
        return Estimate(step.stamp_ns, belief.pose, cov, Mode.UNCONFIRMED, told)

    def _replay(self, started: InitialPose) -> list[Estimate]:
        """Run the collected steps through the estimator."""
        first, *rest = started.steps
        self._lift.reset()  # these steps are earlier ones
        self.sources.begin_segment()
        estimates = [self._start(first.step, started.first, first.sightings)]
        estimates += [self._advance(later.step, later.readings, later.sightings) for later in rest]
        return estimates

    def finish(self, blind: bool = False) -> list[Estimate]:
        """The run (or a segment of it) is over: if its first pose was never found, start from the likeliest place.

        Args:
            blind: no sensor was there that could have seen a landmark: then the map's origin is as likely as any place.

        Returns:
            The estimates of its steps; none if there is nothing to make up for.
        """
        started = self._tracking.give_up(blind)
        if started is None:
            return []
        first, mode = self.estimator.k + 1, Mode.LOST if self._tracking.lost else Mode.UNCONFIRMED
        estimates = self._replay(started)
        frames = [frame for k, frame in self.estimator.log.keyframes.items() if k >= first]
        for frame in frames:
            if mode is Mode.LOST is not frame.mode:
                frame.added_cov = frame.added_cov + self._tracking.lost_cov(frame.belief)
            frame.mode = mode
        covs = {f.stamp_ns: se2.rotate_cov(f.belief.cov + f.added_cov, float(f.belief.pose[2])) for f in frames}
        return [
            dataclasses.replace(
                e, mode=mode, cov=covs[e.stamp_ns] if mode is Mode.LOST and e.stamp_ns in covs else e.cov
            )
            for e in estimates
        ]

    def _start(self, step: Step, prior: PoseWithCovariance, sightings: Sequence[LandmarkMeasurement]) -> Estimate:
        k = self.estimator.k + 1
        believed, _, decisions = self._associate(k, step, sightings, prior)
        belief = self.estimator.start(step.stamp_ns, prior, believed)
        self.association.modes.restart()
        self.association.modes.observe((), prior, belief, believed)
        self.counts["prior"] += 1
        self._count_landmarks(decisions)
        self._tracking.record_fix(bool(believed))
        self._lift.fix()
        return self._estimate(step, belief, decisions)

    def _advance(self, step: Step, readings: MotionReadings, sightings: Sequence[LandmarkMeasurement]) -> Estimate:
        k = self.estimator.k + 1
        # 2. Weigh: the motion sources against each other, back to where they began to disagree; the sightings against
        # the prediction; and the motion against sightings that agree it is wrong
        with self.stopwatch("weigh"):
            trust = self.motion_faults.judge(step, readings)
            decisions = self._revise(k, trust)
            motions = self._motions(step, readings, trust)
            carried = self._lift.carried
            if carried:
                readings = MotionReadings()  # nor does the smoother take them
            elif motions[0].source == "unknown":
                self.rejections["motion.silent"] += 1
            predicted = self.estimator.predict(motions)
            believed, refused, weighed = self._associate(k, step, sightings, predicted)
            place = None
            if not believed:
                outliers = [
                    s.measurement for s in refused if not self.association.modes.excludes(s.measurement.landmark_id)
                ]
                place = self._tracking.search(step, motions, outliers, readings, predicted)
            if place is not None:
                if not self._tracking.keeps_initial_pose:
                    return self._found(step, place, [*decisions, *weighed])
                self._tracking.record_conflict(predicted, place)
                decisions.append(place_decision(k, step.stamp_ns, predicted, place, CONTRADICTS))
            fit, extra_cov = None, None
            if not believed and not self._tracking.keeps_initial_pose:
                fit = self.association.nearby_consensus(refused, weighed, predicted)
            if fit is not None:
                fitted = PoseWithCovariance(fit.pose, fit.cov)
                decisions.append(place_decision(k, step.stamp_ns, predicted, fitted, OVERRULED))
                extra_cov = np.diag(se2.log(se2.between(predicted.pose, fit.pose)) ** 2)
                motions = [with_noise(m, extra_cov=extra_cov) for m in motions]
                self.rejections["motion.overruled"] += 1
                predicted = self.estimator.predict(motions)
                believed, refused, weighed = self._associate(k, step, sightings, predicted)
        # 3. Fuse
        with self.stopwatch("fuse"):
            rebuilt = self.estimator.rebuilt
            kept = () if self._tracking.keeps_initial_pose else refused
            belief = self.estimator.update(step.stamp_ns, step.dt, motions, believed, kept, predicted)
        if self.estimator.rebuilt > rebuilt:
            self.rejections["estimator.window_rebuilt"] += 1
            believed = []
            weighed = [dataclasses.replace(d, weight=0.0, reason=d.reason or "window_rebuilt") for d in weighed]
        self.counts.update(m.source for m in motions)
        self._count_landmarks(weighed)
        if believed:
            self._tracking.record_fix()
            self._lift.fix()
        fix = belief if believed else None
        tells_yaw = any(not isinstance(s.measurement, PoseMeasurement) or s.measurement.tells_yaw for s in believed)
        self.sources.commit(readings, fix, tells_yaw)
        moved = self._judge_landmarks(step, motions, predicted, believed, kept)
        frame = self.estimator.log.keyframes[k]
        off = dict.fromkeys(("wheels", "learned"), "carried") if carried else trust.off
        frame.readings, frame.off, frame.scale, frame.extra_cov = readings, off, trust.scale, extra_cov
        decisions += motion_decisions(k, motions, readings, trust.off, OVERRULED if fit is not None else "", trust)
        return self._estimate(step, frame.belief, [*decisions, *weighed, *moved])

    def _motions(self, step: Step, readings: MotionReadings, trust: FaultVerdict) -> list[MotionMeasurement]:
        """Factors of the step: of the sources, or of a robot that is carried, or of one whose motion nothing tells."""
        if self._lift.carried:
            return [self._lift.motion(step, readings)]
        return self.sources.combine(readings, trust.off, trust.scale) or [self.sources.unknown(step, readings)]

    def _associate(
        self, k: int, step: Step, sightings: Sequence[LandmarkMeasurement], predicted: PoseWithCovariance
    ) -> tuple[list[LandmarkFactor], list[LandmarkFactor], list[Decision]]:
        """What is believed and refused, with the decisions; nothing against a given first pose that holds."""
        weighed = self.association.judge(k, step.stamp_ns, sightings, predicted)
        believed, refused, decisions = self._tracking.gate_initial_pose(*weighed)
        if held := sum(d.reason == CONTRADICTS for d in decisions):
            self.rejections["sightings.contradict_initial_pose"] += held
        if self._tracking.keeps_initial_pose:
            self.association.modes.forget()  # they all seem moved from there
        return believed, refused, decisions

    def _judge_landmarks(
        self,
        step: Step,
        motions: Sequence[MotionMeasurement],
        predicted: PoseWithCovariance,
        fused: Sequence[LandmarkFactor],
        refused: Sequence[LandmarkFactor],
    ) -> list[Decision]:
        """Leave out a landmark that was moved; take back what it did to the pose."""
        modes, belief = self.association.modes, self.estimator.log.keyframes[self.estimator.k].belief
        moved = modes.observe(motions, predicted, belief, fused, refused)
        if moved is None:
            return []
        without, evidence = modes.exclude(moved, belief)
        if without is not belief:
            self.estimator.correct(without, moved)
            self.sources.begin_segment()  # no motion leads from where it was thought to be
            self.motion_faults.reset()
        nis, k = evidence, self.estimator.k
        return [Decision(k, step.stamp_ns, "place", moved, math.sqrt(nis), nis, 2, 1.0, "landmark_moved", ALARM)]

    def _revise(self, k: int, trust: FaultVerdict) -> list[Decision]:
        """Weigh the motion of the steps before this one anew, back to where the disagreement began.

        Wheels that are wrong are left out; before that is certain, covariances are scaled.
        """
        log = self.estimator.log.keyframes
        changed, decisions = {}, []
        frames = (log[i] for i in range(k - trust.span + 1, k) if i in log)
        for frame in (f for f in frames if f.prior is None):
            if "wheels" in trust.off and "wheels" not in frame.off:
                frame.off = {**frame.off, "wheels": trust.off["wheels"]}
            elif "wheels" not in trust.off and trust.scale >= _WORTH_A_REVISION * max(frame.scale, 1.0):
                frame.scale = trust.scale
            else:
                continue
            if motions := self.sources.combine_again(frame):
                changed[frame.k] = motions
                decisions += motion_decisions(frame.k, motions, frame.readings, frame.off, "", trust)
        self.estimator.revise(changed)
        return decisions

    def _found(self, step: Step, place: PoseWithCovariance, decisions: Sequence[Decision]) -> Estimate:
        """Go on from a place that nothing connects with where the robot was believed to be."""
        if self.estimator.belief is not None:
            told = place_decision(self.estimator.k + 1, step.stamp_ns, self.estimator.belief, place, JUMP)
            decisions = [*decisions, told]
            self._tracking.found(self.estimator.belief, place)
        self.rejections["motion.jump"] += 1
        self.sources.begin_segment()
        self.motion_faults.reset()
        self.association.forget_contradictions()
        estimate = self._start(step, place, ())
        return dataclasses.replace(estimate, decisions=(*decisions, *estimate.decisions))

    def _get_lost(self) -> None:
        self.association.modes.forget()
        self._tracking.get_lost()

    def _estimate(self, step: Step, belief: PoseWithCovariance, decisions: Sequence[Decision]) -> Estimate:
        frame = self.estimator.log.keyframes[self.estimator.k]
        frame.step, frame.mode = step, self._tracking.mode
        if self._lift.carried and frame.mode is Mode.OK and self._tracking.blind_s > 0.0:
            frame.mode = Mode.DEAD_RECKONING
        frame.added_cov = self._by_clock(step) + self._tracking.kidnapped_cov(self.association.contradicting, belief)
        if frame.mode is Mode.LOST:
            frame.added_cov = frame.added_cov + self._tracking.lost_cov(belief)
        cov = se2.rotate_cov(belief.cov + frame.added_cov, float(belief.pose[2]))
        after_s = self.config.estimator.dead_reckoning_after_s
        modes = mode_decisions(self.estimator.k, step.stamp_ns, frame.mode, self._tracking.blind_s, after_s)
        jumps, self._clock_jumps = [*self._clock_jumps, *self._lifted], []
        self._lifted = []
        return Estimate(step.stamp_ns, belief.pose, cov, frame.mode, (*jumps, *decisions, *modes))

    def _by_clock(self, step: Step) -> FloatArray:
        """Covariance ``(3, 3)`` of the pose that comes from the clock to which the others are compared."""
        twist = self._compensation.twist(step, step.stamp_ns)
        return np.asarray(np.outer(twist, twist) * self.config.recording.clock_sigma_s**2)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know so far, one sentence each."""
        return (
            *self._tracking.notes,
            *moved_notes(self.association.modes.displacements),
            *flag_notes(self.motion_faults.flags),
        )

    def _count_landmarks(self, decisions: Sequence[Decision]) -> None:
        self.counts.update(d.kind for d in decisions if not d.reason)
