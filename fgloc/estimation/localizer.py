"""The core loop and how it begins: measure, judge, fuse, record. Replay and live streams call `Localizer.update`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.estimation.integrity import Fix, ProtectionLevels
from fgloc.estimation.log import JUMP, mode_decisions, place_decision, segment_decision
from fgloc.estimation.motion import MotionJudge, in_silence
from fgloc.estimation.place import InitialPose
from fgloc.estimation.sightings import JudgedSightings, SightingJudge
from fgloc.estimation.tracking import Tracking
from fgloc.graph.estimators import Estimator, make_estimator
from fgloc.graph.ground import spatial
from fgloc.graph.measurement_log import Keyframe, PoseWithCovariance
from fgloc.instrumentation import Stopwatch
from fgloc.sensors.equipment import MotionCompensation, MotionSensors, PoseSensors
from fgloc.sensors.measurements import LandmarkMeasurement
from fgloc.types import Decision, Estimate, FloatArray, Ground, LandmarkMap, Mode, MotionReadings, Step

# --- The loop ---------------------------------------------------------------------------------------------------------


class Localizer:
    """Estimates ``T_map_base``, one Step at a time.

    Attributes:
        estimator: the filter, whose log the batch smoother starts from.
        factors: maker of landmark factors, shared with the batch smoother.
        motion: what of the motion sources enters the graph.
        sightings: what of the sightings enters the graph.
        tracking: whether the robot is where it is estimated to be.
        counts: factors added, by kind.
        stopwatch: time spent in each phase.
    """

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | None,
        motion: MotionSensors,
        poses: PoseSensors,
        keep_all: bool = False,
    ) -> None:
        """Build the parts of the loop.

        Args:
            config: everything tunable.
            landmark_map: the known map; None: landmarks become variables and the first pose is the origin.
            motion: sensors of the motion.
            poses: sensors of landmarks, and registered ones.
            keep_all: keep the measurement log of the whole run, for the batch smoother.
        """
        self.estimator = make_estimator(config, landmark_map, motion, poses, keep_all)
        self.factors = self.estimator.factors
        self.motion = MotionJudge(config, motion, self.estimator)
        self.tracking = Tracking(config, landmark_map, self.factors, keep_all)
        self.sightings = SightingJudge(config, self.estimator, self.tracking)
        self.stopwatch = Stopwatch()
        self._compensation = MotionCompensation(poses, motion, config.camera.time_jitter_s)
        self._recorder = Recorder(
            config,
            self.tracking,
            self.motion,
            self.sightings,
            self._compensation,
            self.estimator,
            makes_map=landmark_map is None,
        )
        self.counts = self._recorder.counts
        self._keep_all = keep_all
        self._segment = -1
        self._prior: PoseWithCovariance | None = None  # where the segment starts, if that is known without sightings
        self._restart: PoseWithCovariance | None = None  # where the next step is to begin anew

    def update(self, step: Step) -> Estimate | None:
        """Return the pose at the end of a step; None while the first pose is not known."""
        since_fix_s = self.tracking.since_fix_s
        self.tracking.advance_time(step.dt)
        self._prepare(step)
        # 1. Measure: one call per sensor; a sensor without data yields nothing
        with self.stopwatch("motion"):
            readings = self.motion.read(step, since_fix_s)
        with self.stopwatch("sightings"):
            sightings = self._compensation.measure(step, self.factors.time_offset_s)
        # 2. No pose yet, or lost: collect steps and search the map
        if self.tracking.initializing:
            return self._begin(step, readings, sightings)
        return self._advance(step, readings, sightings)

    def _advance(self, step: Step, readings: MotionReadings, sightings: Sequence[LandmarkMeasurement]) -> Estimate:
        """The loop from one keyframe to the next."""
        # 3. Judge the motion sources against each other, then the sightings against the pose that they predict
        with self.stopwatch("judge"):
            motion = self.motion.judge(step, readings)
            motion, seen = self.sightings.judge(step, sightings, motion)
        if seen.elsewhere is not None:
            return self._jump(step, seen.elsewhere, [*motion.revisions, *seen.decisions])
        # 4. Fuse: if the graph cannot be solved with them, the estimator leaves the sightings out
        with self.stopwatch("fuse"):
            seen = self.sightings.give_states(motion, seen)
            rebuilt = self.estimator.rebuilt
            belief = self.estimator.update(
                step.stamp_ns, step.dt, motion.factors, seen.accepted, seen.logged, seen.predicted
            )
        frame = self.estimator.newest
        frame.readings, frame.budget = motion.readings, motion.budget
        if self.estimator.rebuilt > rebuilt:
            self._recorder.rejections["estimator.window_rebuilt"] += 1
            seen = seen.dropped("window_rebuilt")
        self._recorder.count(frame)
        # 5. Judge by the fused pose: the motion sources' drift, and landmarks that were moved
        if seen.accepted:
            self.tracking.record_fix()
            self.tracking.confirm({s.measurement.row_kind for s in seen.accepted})
        self.motion.commit(motion, belief if seen.accepted else None, seen.observes_yaw)
        moved, pose_changed = self.sightings.exclude_moved(step, motion, seen)
        if pose_changed:
            self.motion.restart()
        # 6. Record
        rows = [*motion.revisions, *seen.places, *motion.decisions(frame.k), *seen.decisions, *moved]
        return self._recorder.record(step, frame, rows, seen)

    def restart_at(self, pose: PoseWithCovariance) -> None:
        """At the next step, go on from a pose that is known from elsewhere: an earlier run, or the user.

        Sightings that contradict it do not hold: the map is searched.
        """
        self._restart = pose

    def finish(self, no_landmark_sensor: bool = False) -> list[Estimate]:
        """The segment is over: if its first pose was never found, start from the most probable place.

        Args:
            no_landmark_sensor: nothing could have seen a landmark: then the map's origin is as probable as any place.

        Returns:
            The estimates of its steps; none if there is nothing to make up for.
        """
        found = self.tracking.give_up(no_landmark_sensor)
        if found is None:
            return []
        first, mode = self.estimator.k + 1, Mode.LOST if self.tracking.lost else Mode.UNCONFIRMED
        estimates = self._replay(found)
        frames = [frame for k, frame in self.estimator.log.keyframes.items() if k >= first]
        return self._recorder.never_confirmed(estimates, frames, mode)

    def _prepare(self, step: Step) -> None:
        """Before a step is measured: begin a segment where nothing connects it to the last, or search if lost."""
        if step.segment != self._segment or self._restart is not None:
            self._begin_segment(step)
        elif not self.tracking.initializing and self.tracking.is_unlocalized(self.estimator.belief):
            self.sightings.modes.forget()
            self.tracking.get_lost()
        elif self.motion.sources.measured_again and not self.tracking.is_unlocalized(self.estimator.belief):
            self.tracking.go_on()

    def _begin_segment(self, step: Step) -> None:
        if self._keep_all:
            self.finish()
        if self._segment not in (-1, step.segment):
            self._recorder.clock_jumped(self.estimator.k + 1, step)
        self._segment = step.segment
        known, self._restart = self._restart, None
        self._recorder.begin_segment(told=known is not None)
        self.motion.begin_segment(step)
        self.sightings.association.begin_segment()
        self._prior = self.tracking.begin_segment(self.estimator.belief, known)

    def _begin(self, step: Step, readings: MotionReadings, sightings: Sequence[LandmarkMeasurement]) -> Estimate | None:
        """Process a step while the pose is searched for; return its estimate, if there is one already."""
        if self._prior is not None:
            prior, self._prior = self._prior, None  # it does not hold once the robot got lost
            self.tracking.global_search.initializing = False
            return self._start(step, prior, sightings)
        motions = self.motion.combine(step, readings)
        self.estimator.level(motions)
        found = self.tracking.global_search.collect(step, motions, sightings, readings)
        if found is None and self.tracking.lost:
            return self._advance(step, readings, ())
        if found is None:
            return self._recorder.unconfirmed(self.estimator.k + 1, step)
        if self.tracking.lost:
            return self._jump(step, found, ())
        estimates = self._replay(found)
        return replace(estimates[-1], decisions=tuple(d for estimate in estimates for d in estimate.decisions))

    def _jump(self, step: Step, found: InitialPose, decisions: Sequence[Decision]) -> Estimate:
        """Go on from a place that nothing connects with the estimated pose; ``decisions``: that led there."""
        before, place = self.estimator.belief, found.newest
        if before is not None:
            row = place_decision(self.estimator.k + 1, step.stamp_ns, before, place, JUMP)
            decisions = [*decisions, row]
            self.tracking.found(before, place, "" if self.motion.is_carried else found.witness, row.nis)
        self.estimator.forget_contradictions()
        self.motion.restart()
        self.sightings.association.forget_contradictions()
        self._recorder.jumped()
        decisions = [*decisions, *self.sightings.exclude_displaced(self.estimator.k + 1, step, found)]
        estimate = self._start(step, place, ())
        return replace(estimate, decisions=(*decisions, *estimate.decisions))

    def _replay(self, found: InitialPose) -> list[Estimate]:
        """Run the collected steps through the loop."""
        first, *rest = found.steps
        self.motion.begin_replay()
        displaced = self.sightings.exclude_displaced(self.estimator.k + 1, first.step, found)
        estimates = [self._start(first.step, found.first, first.sightings)]
        estimates[0] = replace(estimates[0], decisions=(*displaced, *estimates[0].decisions))
        return estimates + [self._advance(later.step, later.readings, later.sightings) for later in rest]

    def _start(self, step: Step, prior: PoseWithCovariance, sightings: Sequence[LandmarkMeasurement]) -> Estimate:
        self.estimator.forget_ground()
        seen = self.sightings.associate(step, sightings, prior)
        pose = self.estimator.start(step.stamp_ns, prior, seen.accepted)
        self.sightings.begin_graph(seen, pose)
        self.tracking.record_fix(bool(seen.accepted))
        self.motion.record_fix()
        self._recorder.count(self.estimator.newest)
        return self._recorder.record(step, self.estimator.newest, seen.decisions)

    @property
    def rejections(self) -> Counter[str]:
        """Number of measurements that were not used so far, by reason."""
        return self._recorder.rejections + self.motion.rejections + self.sightings.rejections

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user about the run so far."""
        return (*self.tracking.notes, *self.sightings.notes, *self.motion.notes)


# --- Record -----------------------------------------------------------------------------------------------------------

_COMPARED = 200  # poses, over the run
_ARM_M = 0.1  # between the two points by which a pose is compared: a robot's length
_MOVED_M, _MOVED_RAD = 0.001, 0.001  # by more than the newest pose moves without a loop


class MapFrame:
    """Frame of the map while it is being made: that in which the poses already given move least.

    Without a map nothing fixes its frame. The graph's has its origin in the first pose: when the robot comes back to
    where it was, the drift since then is taken from all later poses at once, and what was noted in the poses given
    before (places to go to, a picture of the way) is off by it. Instead the whole map is moved.
    """

    def __init__(self) -> None:
        """Begin with the graph's frame."""
        self.T_map_graph = np.zeros(3)
        self._given: dict[int, FloatArray] = {}  # poses in the map's frame, by keyframe, evenly thinned out
        self._every, self._last = 1, (-1, np.zeros(3))
        self._loose = math.inf  # first keyframe that nothing connects yet with those before it

    def begin_segment(self) -> None:
        """Let the poses to come fix no frame until the graph moves them to those before: nothing else connects them."""
        self._loose = min(self._loose, self._last[0] + 1)

    def place(self, k: int, pose: FloatArray, estimator: Estimator) -> FloatArray:
        """Pose ``(3,)`` of the newest keyframe ``k`` in the map's frame."""
        before = estimator.smoothed(self._last[0]) if self._given else None
        if before is not None:
            x, y, yaw = se2.between(self._last[1], before)
            if np.hypot(x, y) > _MOVED_M or abs(yaw) > _MOVED_RAD:
                self._move(estimator)
        self._last = k, pose
        placed = se2.compose(self.T_map_graph, pose)
        if k % self._every == 0:
            self._given[k] = placed
            if len(self._given) > 2 * _COMPARED:
                self._every *= 2
                self._given = {i: p for i, p in self._given.items() if i % self._every == 0}
        return placed

    def _move(self, estimator: Estimator) -> None:
        now = {k: pose for k in self._given if (pose := estimator.smoothed(k)) is not None}
        if settled := {k: pose for k, pose in now.items() if k < self._loose}:
            now, self._given = settled, {k: pose for k, pose in self._given.items() if k < self._loose}
        self._loose = math.inf
        if now:
            given = np.array([self._given[k] for k in now])
            self.T_map_graph = se2.rigid(_points(np.array(list(now.values()))), _points(given))


def _points(poses: FloatArray) -> FloatArray:
    """Two points ``(2 n, 2)`` of each pose ``(n, 3)``, by which it is compared with another."""
    ahead = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    return np.vstack([poses[:, :2], poses[:, :2] + _ARM_M * ahead])


class Recorder:
    """Adds to the graph's covariance what the graph does not know: clock, kidnapping, the whole map where lost.

    Attributes:
        counts: factors added, by kind.
        rejections: what was not used, by reason, beside what the judges rejected.
    """

    def __init__(
        self,
        config: Config,
        tracking: Tracking,
        motion: MotionJudge,
        sightings: SightingJudge,
        compensation: MotionCompensation,
        estimator: Estimator,
        makes_map: bool,
    ) -> None:
        """Store the parts that know clock, mode and installation."""
        self.counts: Counter[str] = Counter()
        self.rejections: Counter[str] = Counter()
        self._clock_sigma_s = config.recording.clock_sigma_s
        self._dead_reckoning_after_s = config.estimator.dead_reckoning_after_s
        self._tracking, self._motion, self._sightings, self._compensation = tracking, motion, sightings, compensation
        self._installation = tracking.installation
        self._levels = ProtectionLevels(config.integrity, sightings.modes)
        self._last_ground: FloatArray | None = None
        self._clock_jumps: list[Decision] = []  # not yet reported with an estimate
        self._estimator = estimator
        self._makes_map = makes_map and config.estimator.ground == "flat"
        self._frame = MapFrame() if self._makes_map else None

    def begin_segment(self, told: bool) -> None:
        """Connect what comes with the poses given before only by the graph; a told pose is in the graph's frame."""
        if self._frame is not None and not told:
            self._frame.begin_segment()
        elif self._makes_map:
            self._frame = MapFrame()

    def count(self, frame: Keyframe) -> None:
        """Count the factors of a new keyframe."""
        self.counts.update(() if frame.prior is None else ("prior",))
        self.counts.update(m.source for m in frame.motions)
        self.counts.update(s.measurement.row_kind for s in frame.sightings)

    def jumped(self) -> None:
        """Count that the robot was found at another place; its next bounds allow for an error in that."""
        self.rejections["motion.jump"] += 1
        self._levels.jumped()

    def clock_jumped(self, k: int, step: Step) -> None:
        """Note a new segment, to be reported with its first estimate."""
        self._clock_jumps.append(segment_decision(k, step.start_ns))

    def record(
        self, step: Step, frame: Keyframe, decisions: Sequence[Decision], seen: JudgedSightings | None = None
    ) -> Estimate:
        """The estimate of the newest keyframe; its mode and added covariance are kept in the log for the smoother.

        Args:
            step: that ends at it.
            frame: the keyframe.
            decisions: made in this step.
            seen: its sightings; None: it is the first keyframe after a start.
        """
        tracking, belief = self._tracking, frame.belief
        frame.step, frame.mode = step, tracking.mode
        if self._motion.is_carried and frame.mode is Mode.OK and tracking.since_fix_s > 0.0:
            frame.mode = Mode.DEAD_RECKONING
        twist = self._compensation.twist(step, step.stamp_ns)
        clock_variance = self._clock_sigma_s**2 + self._motion.sources.clock_sigma_s(frame) ** 2
        by_clock = np.asarray(np.outer(twist, twist) * clock_variance)
        carried, around = tracking.kidnapped(self._sightings.association.contradicting, belief)
        frame.added_cov = by_clock + tracking.doubt_cov(belief) + in_silence(frame.readings)
        frame.carried_cov = carried * around  # of a mixture of two Gaussians, the second one wide
        if frame.mode is Mode.LOST:
            frame.added_cov = frame.added_cov + tracking.lost_cov(belief)
        modes = mode_decisions(frame.k, step.stamp_ns, frame.mode, tracking.since_fix_s, self._dead_reckoning_after_s)
        before, self._clock_jumps = [*self._clock_jumps, *self._motion.take_signs()], []
        added = frame.added_cov + frame.carried_cov
        cov = se2.rotate_cov(belief.cov + added, float(belief.pose[2]))
        ground = spatial(belief, self._installation, added)
        if ground is not None:
            frame.ground_clock_cov = self._ground_by_clock(step, ground, clock_variance)
            ground = replace(ground, cov=ground.cov + frame.ground_clock_cov)
        pose = belief.pose
        if self._frame is not None:
            pose = self._frame.place(frame.k, pose, self._estimator)
            cov = se2.rotate_cov(cov, float(self._frame.T_map_graph[2]))
        checked = self._motion.sources.is_checked(frame.readings, frame.budget.rejected)
        fix = None
        if seen is not None and seen.lines is not None:
            known = seen.predicted.installation or self._estimator.installed
            fix = Fix(seen.predicted, known, seen.lines, step.dt)
        protection = self._levels.of(
            belief.cov + frame.added_cov,
            twist,
            tracking.since_fix_s,
            checked,
            self._motion.slips_per_s,
            fix,
            self._estimator.if_as_seen(),
            (carried, around),
        )
        return Estimate(step.stamp_ns, pose, cov, frame.mode, (*before, *decisions, *modes), ground, protection)

    def _ground_by_clock(self, step: Step, ground: Ground, clock_variance: float) -> FloatArray:
        """Covariance ``(6, 6)`` of height, roll and pitch for a clock that is off, as `record` has it of x, y, yaw."""
        now, before = np.array([ground.z, ground.roll, ground.pitch]), self._last_ground
        self._last_ground = now
        rates: FloatArray = np.zeros(6)
        if before is not None and step.dt > 0.0:
            rates[2:5] = (now - before) / step.dt
        return np.asarray(np.outer(rates, rates) * clock_variance)

    def unconfirmed(self, k: int, step: Step) -> Estimate | None:
        """Estimate before the sightings suffice to begin the graph; None: it is too uncertain."""
        belief = self._tracking.unconfirmed()
        if belief is None:
            return None
        cov = se2.rotate_cov(belief.cov, float(belief.pose[2]))
        rows = mode_decisions(k, step.stamp_ns, Mode.UNCONFIRMED, self._tracking.since_fix_s, np.nan)
        return Estimate(step.stamp_ns, belief.pose, cov, Mode.UNCONFIRMED, rows)

    def never_confirmed(self, estimates: Sequence[Estimate], frames: Sequence[Keyframe], mode: Mode) -> list[Estimate]:
        """Estimates of a segment whose first pose was never found, in the mode for it.

        Args:
            estimates: as recorded from the most probable place on.
            frames: their keyframes.
            mode: ``UNCONFIRMED``; or ``LOST``, with a covariance that allows for the whole map.
        """
        for frame in frames:
            if mode is Mode.LOST is not frame.mode:
                frame.added_cov = frame.added_cov + self._tracking.lost_cov(frame.belief)
            frame.mode = mode
        if mode is not Mode.LOST:
            return [replace(e, mode=mode) for e in estimates]
        covs = {
            f.stamp_ns: se2.rotate_cov(f.belief.cov + f.added_cov + f.carried_cov, float(f.belief.pose[2]))
            for f in frames
        }
        return [_with_cov(replace(e, mode=mode), covs.get(e.stamp_ns)) for e in estimates]


def _with_cov(estimate: Estimate, cov: FloatArray | None) -> Estimate:
    if cov is None:
        return estimate
    ground = estimate.ground
    return replace(estimate, cov=cov, ground=None if ground is None else ground.with_planar(cov))
