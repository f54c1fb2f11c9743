"""Which sightings enter the graph, and what the others mean: a moved or misread landmark, a wrong motion, a wrong pose.

The chi-square gate and its better explanations are in `Association`, moved landmarks in `LandmarkModes`, the search of
the map in `Tracking`; here they are asked in turn.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.estimators import Estimator
from fgloc.graph.measurement_log import LandmarkFactor, PoseWithCovariance
from fgloc.relocalization.global_search import InitialPose
from fgloc.relocalization.tracking_state import CONTRADICTS, Tracking
from fgloc.robust.association import Association
from fgloc.robust.decision_log import OVERRULED, moved_decision, moved_notes, place_decision
from fgloc.robust.landmark_modes import LandmarkModes
from fgloc.robust.motion_judge import JudgedMotion
from fgloc.types import Decision, LandmarkMeasurement, PointMeasurement, PoseMeasurement, Step


@dataclass(frozen=True, slots=True, eq=False)
class JudgedSightings:
    """The sightings of one step as they enter the graph.

    Attributes:
        accepted: to be fused.
        rejected: not to be fused.
        logged: those of them that the batch smoother and the landmark modes may know of.
        decisions: rows of ``steps.csv``, one per sighting.
        places: rows for places that sightings tell beside the predicted one.
        predicted: the pose that they were held against.
        elsewhere: where on the map the robot is instead; None: it is where it was predicted.
    """

    accepted: Sequence[LandmarkFactor]
    rejected: Sequence[LandmarkFactor]
    logged: Sequence[LandmarkFactor]
    decisions: Sequence[Decision]
    predicted: PoseWithCovariance
    places: Sequence[Decision] = ()
    elsewhere: InitialPose | None = None

    @property
    def observes_yaw(self) -> bool:
        """Whether any accepted one determines the yaw by itself."""
        return any(not isinstance(s.measurement, PoseMeasurement) or s.measurement.observes_yaw for s in self.accepted)

    def dropped(self, reason: str) -> JudgedSightings:
        """The same where the graph could not take any of them."""
        decisions = [replace(d, weight=0.0, reason=d.reason or reason) for d in self.decisions]
        return replace(self, accepted=(), decisions=decisions)


class SightingJudge:
    """Holds the sightings of each step against the predicted pose."""

    def __init__(self, config: Config, estimator: Estimator, tracking: Tracking) -> None:
        """Take what knows the pose, and where else the robot may be."""
        self._estimator = estimator
        self._tracking = tracking
        self._association = Association(config, estimator.factors)
        self._rejections: Counter[str] = Counter()

    @property
    def modes(self) -> LandmarkModes:
        """Which landmarks were moved."""
        return self._association.modes

    @property
    def rejections(self) -> Counter[str]:
        """What was not used so far, by reason."""
        return self._rejections + self._association.rejections

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know of landmarks, one sentence each."""
        return tuple(moved_notes(self.modes.displacements))

    @property
    def contradicting(self) -> int:
        """How many landmarks were rejected since a sighting was accepted."""
        return self._association.contradicting

    def begin_segment(self) -> None:
        """The clock jumped: nothing is known of when landmarks were seen last."""
        self._association.begin_segment()

    def restart(self) -> None:
        """The robot was found at another place."""
        self._association.forget_contradictions()

    def judge(
        self, step: Step, sightings: Sequence[LandmarkMeasurement], motion: JudgedMotion
    ) -> tuple[JudgedMotion, JudgedSightings]:
        """Sort the sightings of a step; the motion is returned too, with more noise where they found it to be wrong."""
        predicted = self._estimator.predict(motion.factors)
        seen = self.associate(step, sightings, predicted)
        if seen.accepted:
            return motion, seen
        outliers = [m for m in (s.measurement for s in seen.rejected) if self._may_tell_place(m)]
        found = self._tracking.search(step, motion.factors, outliers, motion.readings, predicted)
        if found is not None and self._tracking.keeps_initial_pose:
            self._tracking.record_conflict(predicted, found.newest)
            row = place_decision(self._estimator.k + 1, step.stamp_ns, predicted, found.newest, CONTRADICTS)
            return motion, replace(seen, places=(row,))
        if found is not None or self._tracking.keeps_initial_pose:
            return motion, replace(seen, elsewhere=found)
        fit = self._association.nearby_consensus(seen.rejected, seen.decisions, predicted)
        if fit is None:
            return motion, seen
        nearby = PoseWithCovariance(fit.pose, fit.cov)
        row = place_decision(self._estimator.k + 1, step.stamp_ns, predicted, nearby, OVERRULED)
        self._rejections["motion.overruled"] += 1
        motion = motion.overruled(np.diag(se2.log(se2.between(predicted.pose, fit.pose)) ** 2))
        seen = self.associate(step, sightings, self._estimator.predict(motion.factors))
        return motion, replace(seen, places=(row,))

    def _may_tell_place(self, m: LandmarkMeasurement) -> bool:
        """Whether the search may know of a rejected sighting: it judges by itself whether a beacon was moved."""
        return isinstance(m, PointMeasurement) or not self.modes.excludes(m.landmark_id)

    def associate(
        self, step: Step, sightings: Sequence[LandmarkMeasurement], predicted: PoseWithCovariance
    ) -> JudgedSightings:
        """Accept or reject each sighting against one pose; against a given first pose that holds, reject all."""
        judged = self._association.judge(self._estimator.k + 1, step.stamp_ns, sightings, predicted)
        accepted, rejected, decisions = self._tracking.gate_initial_pose(*judged)
        if held := sum(d.reason == CONTRADICTS for d in decisions):
            self._rejections["sightings.contradict_initial_pose"] += held
        if self._tracking.keeps_initial_pose:
            self.modes.forget()  # they all seem moved from there
        logged = () if self._tracking.keeps_initial_pose else rejected
        return JudgedSightings(accepted, rejected, logged, decisions, predicted)

    def exclude_displaced(self, k: int, step: Step, found: InitialPose) -> list[Decision]:
        """Leave out what the search found to be moved, and no longer what it found in place."""
        return [
            moved_decision(k, step.stamp_ns, landmark_id, one.evidence, self.modes.alarm)
            for landmark_id, one in (found.displaced or {}).items()
            if self.modes.exclude_if_moved(landmark_id, one.by, one.evidence)
        ]

    def begin_graph(self, seen: JudgedSightings, belief: PoseWithCovariance) -> None:
        """The graph begins with these sightings, which made a pose of the predicted one."""
        self.modes.restart()
        self.modes.observe((), seen.predicted, belief, seen.accepted)

    def exclude_moved(self, step: Step, motion: JudgedMotion, seen: JudgedSightings) -> tuple[list[Decision], bool]:
        """Leave out a landmark that was moved; take back what it did to the newest pose.

        Returns:
            The rows of ``steps.csv``, and whether the pose was set anew.
        """
        k = self._estimator.k
        belief = self._estimator.log.keyframes[k].belief
        moved = self.modes.observe(motion.factors, seen.predicted, belief, seen.accepted, seen.logged)
        if moved is None:
            return [], False
        without, nis = self.modes.exclude(moved, belief)
        if without is not belief:
            self._estimator.correct(without, moved)
        return [moved_decision(k, step.stamp_ns, moved, nis, self.modes.alarm)], without is not belief
