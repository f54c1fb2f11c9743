"""How the graph begins: at the run's first pose, after a jump of the clock, and where a lost robot is found again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from fgloc.graph.estimators import Estimator
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.relocalization.global_search import InitialPose
from fgloc.relocalization.recorder import Recorder
from fgloc.relocalization.tracking_state import Tracking
from fgloc.robust.decision_log import JUMP, place_decision
from fgloc.robust.motion_judge import MotionJudge
from fgloc.robust.sighting_judge import SightingJudge
from fgloc.types import Decision, Estimate, LandmarkMeasurement, Mode, MotionReadings, Step

Advance = Callable[[Step, MotionReadings, Sequence[LandmarkMeasurement]], Estimate]
"""Takes a step that follows the newest keyframe through the loop."""


class Initialization:
    """Collects steps until a first pose is clear, then runs them all through the loop."""

    def __init__(
        self,
        tracking: Tracking,
        estimator: Estimator,
        motion: MotionJudge,
        sightings: SightingJudge,
        recorder: Recorder,
        advance: Advance,
        keep_all: bool,
    ) -> None:
        """Take the parts of the loop.

        Args:
            tracking: searches the map.
            estimator: to be started.
            motion: is begun anew with it.
            sightings: likewise.
            recorder: makes the estimates.
            advance: see there.
            keep_all: a segment that never got a pose is made up for when it ends; otherwise when the run does.
        """
        self._tracking, self._estimator = tracking, estimator
        self._motion, self._sightings, self._recorder = motion, sightings, recorder
        self._advance, self._keep_all = advance, keep_all
        self._segment = -1
        self._prior: PoseWithCovariance | None = None  # where the segment starts, if that is known without sightings
        self._restart: PoseWithCovariance | None = None  # where the next step is to begin anew

    def restart_at(self, pose: PoseWithCovariance) -> None:
        """At the next step, go on from a pose that is known from elsewhere: see `Localizer.restart_at`."""
        self._restart = pose

    def prepare(self, step: Step) -> None:
        """Before a step is measured: begin a segment where nothing connects it to the last, or search if lost."""
        if step.segment != self._segment or self._restart is not None:
            self._begin_segment(step)
        elif not self._tracking.initializing and self._tracking.is_unlocalized(self._estimator.belief):
            self._sightings.modes.forget()
            self._tracking.get_lost()

    def _begin_segment(self, step: Step) -> None:
        if self._keep_all:
            self.finish()
        if self._segment not in (-1, step.segment):
            self._recorder.clock_jumped(self._estimator.k + 1, step)
        self._segment = step.segment
        self._motion.begin_segment(step)
        self._sightings.begin_segment()
        known, self._restart = self._restart, None
        self._prior = self._tracking.begin_segment(self._estimator.belief, known)

    def add(self, step: Step, readings: MotionReadings, sightings: Sequence[LandmarkMeasurement]) -> Estimate | None:
        """Take in a step while the pose is looked for; the estimate of it, if there is one by now."""
        if self._prior is not None:
            prior, self._prior = self._prior, None  # it does not hold once the robot got lost
            self._tracking.start_known()
            return self._start(step, prior, sightings)
        motions = self._motion.combine(step, readings)
        self._estimator.level(motions)
        found = self._tracking.collect(step, motions, sightings, readings)
        if found is None and self._tracking.lost:
            return self._advance(step, readings, ())
        if found is None:
            return self._recorder.unconfirmed(self._estimator.k + 1, step)
        if self._tracking.lost:
            return self.jump(step, found, ())
        estimates = self._replay(found)
        return replace(estimates[-1], decisions=tuple(d for estimate in estimates for d in estimate.decisions))

    def jump(self, step: Step, found: InitialPose, decisions: Sequence[Decision]) -> Estimate:
        """Go on from a place that nothing connects with the estimated pose; ``decisions``: that led there."""
        before, place = self._estimator.belief, found.newest
        if before is not None:
            decisions = [*decisions, place_decision(self._estimator.k + 1, step.stamp_ns, before, place, JUMP)]
            self._tracking.found(before, place)
        self._motion.restart()
        self._sightings.restart()
        self._recorder.rejections["motion.jump"] += 1
        decisions = [*decisions, *self._sightings.exclude_displaced(self._estimator.k + 1, step, found)]
        estimate = self._start(step, place, ())
        return replace(estimate, decisions=(*decisions, *estimate.decisions))

    def finish(self, no_landmark_sensor: bool = False) -> list[Estimate]:
        """The segment is over: if its first pose was never found, start from the most probable place.

        Args:
            no_landmark_sensor: nothing could have seen a landmark: then the map's origin is as probable as any place.

        Returns:
            The estimates of its steps; none if there is nothing to make up for.
        """
        found = self._tracking.give_up(no_landmark_sensor)
        if found is None:
            return []
        first, mode = self._estimator.k + 1, Mode.LOST if self._tracking.lost else Mode.UNCONFIRMED
        estimates = self._replay(found)
        frames = [frame for k, frame in self._estimator.log.keyframes.items() if k >= first]
        return self._recorder.never_confirmed(estimates, frames, mode)

    def _replay(self, found: InitialPose) -> list[Estimate]:
        """Run the collected steps through the loop."""
        first, *rest = found.steps
        self._motion.begin_replay()
        displaced = self._sightings.exclude_displaced(self._estimator.k + 1, first.step, found)
        estimates = [self._start(first.step, found.first, first.sightings)]
        estimates[0] = replace(estimates[0], decisions=(*displaced, *estimates[0].decisions))
        return estimates + [self._advance(later.step, later.readings, later.sightings) for later in rest]

    def _start(self, step: Step, prior: PoseWithCovariance, sightings: Sequence[LandmarkMeasurement]) -> Estimate:
        self._estimator.forget_ground()
        seen = self._sightings.associate(step, sightings, prior)
        pose = self._estimator.start(step.stamp_ns, prior, seen.accepted)
        self._sightings.begin_graph(seen, pose)
        self._tracking.record_fix(bool(seen.accepted))
        self._motion.record_fix()
        self._recorder.count(self._estimator.newest)
        return self._recorder.record(step, self._estimator.newest, seen.decisions)
