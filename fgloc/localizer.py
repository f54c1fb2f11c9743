"""The core loop: measure, judge, fuse, record. Replay and live streams call `Localizer.update` alike."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from fgloc.config import Config
from fgloc.graph.estimators import make_estimator
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.instrumentation import Stopwatch
from fgloc.relocalization.initialization import Initialization
from fgloc.relocalization.recorder import Recorder
from fgloc.relocalization.tracking_state import Tracking
from fgloc.robust.motion_judge import MotionJudge
from fgloc.robust.sighting_judge import SightingJudge
from fgloc.sensors.equipment import MotionCompensation, MotionSensors, PoseSensors
from fgloc.types import Estimate, LandmarkMap, LandmarkMeasurement, MotionReadings, Step


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
        """Put the parts together.

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
        self._recorder = Recorder(config, self.tracking, self.motion, self.sightings, self._compensation)
        self.counts = self._recorder.counts
        self._initialization = Initialization(
            self.tracking, self.estimator, self.motion, self.sightings, self._recorder, self._advance, keep_all
        )

    def update(self, step: Step) -> Estimate | None:
        """Take in one step; return the newest pose, or None while the first pose is not yet known."""
        since_fix_s = self.tracking.since_fix_s
        self.tracking.advance_time(step.dt)
        self._initialization.prepare(step)
        # 1. Measure: one call per sensor; a sensor without data yields nothing
        with self.stopwatch("motion"):
            readings = self.motion.read(step, since_fix_s)
        with self.stopwatch("sightings"):
            sightings = self._compensation.measure(step, self.factors.time_offset_s)
        # 2. No pose yet, or lost: collect steps and search the map
        if self.tracking.initializing:
            return self._initialization.add(step, readings, sightings)
        return self._advance(step, readings, sightings)

    def _advance(self, step: Step, readings: MotionReadings, sightings: Sequence[LandmarkMeasurement]) -> Estimate:
        """The loop from one keyframe to the next."""
        # 3. Judge: the motion sources against each other, the sightings against the predicted pose
        with self.stopwatch("weigh"):
            motion = self.motion.judge(step, readings)
            motion, seen = self.sightings.judge(step, sightings, motion)
        if seen.elsewhere is not None:
            return self._initialization.jump(step, seen.elsewhere, [*motion.revisions, *seen.decisions])
        # 4. Fuse: if the graph cannot be solved with them, the estimator leaves the sightings out
        with self.stopwatch("fuse"):
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
        self.motion.commit(motion, belief if seen.accepted else None, seen.observes_yaw)
        moved, pose_changed = self.sightings.exclude_moved(step, motion, seen)
        if pose_changed:
            self.motion.restart()
        # 6. Record
        rows = [*motion.revisions, *seen.places, *motion.decisions(frame.k), *seen.decisions, *moved]
        return self._recorder.record(step, frame, rows)

    def restart_at(self, pose: PoseWithCovariance) -> None:
        """At the next step, go on from a pose that is known from elsewhere: an earlier run, or the user.

        Sightings that contradict it do not hold: the map is searched.
        """
        self._initialization.restart_at(pose)

    def finish(self, no_landmark_sensor: bool = False) -> list[Estimate]:
        """The run is over: if its first pose was never found, start from the most probable place.

        Args:
            no_landmark_sensor: nothing could have seen a landmark: then the map's origin is as probable as any place.

        Returns:
            The estimates of its steps; none if there is nothing to make up for.
        """
        return self._initialization.finish(no_landmark_sensor)

    @property
    def rejections(self) -> Counter[str]:
        """What was not used so far, by reason."""
        return self._recorder.rejections + self.motion.rejections + self.sightings.rejections

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know so far, one sentence each."""
        return (*self.tracking.notes, *self.sightings.notes, *self.motion.notes)
