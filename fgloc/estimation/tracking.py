"""Whether the robot is where it is estimated to be: its first pose, fixes, contradictions, and the search for it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.estimation.beacons import CARRIED, WRONG_LANDMARK
from fgloc.estimation.place import ANYWHERE, ORIGIN, GlobalSearch, InitialPose
from fgloc.estimation.pose_fit import MAX_SIGMA, apart
from fgloc.estimation.unnamed import AMBIGUOUS
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.measurement_log import LoggedSighting, PoseWithCovariance
from fgloc.sensors.measurements import LandmarkMeasurement
from fgloc.types import Decision, FloatArray, Grave, LandmarkMap, Mode, MotionMeasurement, MotionReadings, Step

_CONFIRMED = 2  # sightings in excess of those that contradict it: more confirm a given pose
CONTRADICTS = "contradicts initial_pose"
_CONTRADICTED = 50.0  # NIS of a place of three coordinates: one in 10^10 by chance
_NOWHERE_M = 3.0  # sigma of a position above which no sighting can be judged by the prediction


class Tracking:
    """Looks for the robot while its place is unknown or contradicted, and keeps the time since the last fix.

    A first pose that was given, and that sightings contradict from the start, holds against them: whether it or the map
    is wrong, only the user can decide. They are rejected and reported.

    Attributes:
        global_search: on the whole map.
        lost: nothing explains where the robot is.
        initial_pose_conflict: pose ``(3,)`` at which sightings put the robot, in the frame of the given first pose that
            they contradict; None: they did not.
    """

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, factors: LandmarkFactors, keep_all: bool = False
    ) -> None:
        """Set up for a map; ``keep_all``: the steps before the first pose are all kept for the replay."""
        self._config = config.estimator
        self._adaptive = config.weights.adaptive and factors.known
        self._known, self.installation = factors.known, factors.installation
        self.global_search = GlobalSearch(config, landmark_map, factors, keep_all)
        self.lost = False
        self.initial_pose_conflict: FloatArray | None = None
        self._clock_s = self._fix_s = 0.0
        self._given = False  # whether the first pose was given, and nothing is known yet of its worth
        self._confirming = self._contradicting = 0  # sightings
        self._jump: FloatArray | None = None  # the first one ...
        self._jump_count = 0  # ... of so many
        self._doubt = np.zeros(2)  # [m] in the map, from where motion had led to where one source alone is ...
        self._witness = ""  # ... and that source
        self._doubted: tuple[str, float, float] | None = None  # the first such source, how far, and by how many sigmas
        self._reported = False  # whether an unconfirmed pose was reported
        self._places = self.global_search.hypotheses.places
        self._never_found = False

    def begin_segment(
        self, last: PoseWithCovariance | None, known: PoseWithCovariance | None = None
    ) -> PoseWithCovariance | None:
        """Begin a segment after a jump of the clock, or the run; return the start if it is known without sightings.

        Args:
            last: of the segment before.
            known: where it starts, by the user or an earlier run.
        """
        self.lost = self._given = self._reported = False
        self._doubt, self._witness = np.zeros(2), ""
        self.global_search.reset()
        if known is not None:
            return known
        given = self._config.initial_pose
        if given is not None and last is None:
            self._given, self._confirming, self._contradicting = True, 0, 0
            return PoseWithCovariance(np.array(given), np.diag(np.square(self._config.initial_sigmas)))
        if self._known:
            return None
        return (
            PoseWithCovariance(np.zeros(3), ORIGIN.copy())
            if last is None
            else PoseWithCovariance(last.pose, ANYWHERE.copy())
        )

    def advance_time(self, seconds: float) -> None:
        """Advance the clock [s]."""
        self._clock_s += seconds

    @property
    def since_fix_s(self) -> float:
        """Time since the last fix [s]."""
        return self._clock_s - self._fix_s

    @property
    def dead_reckoning(self) -> bool:
        """Whether the last fix is so long ago that the robot is dead reckoning."""
        return self.since_fix_s > self._config.dead_reckoning_after_s

    @property
    def initializing(self) -> bool:
        """Whether the pose is looked for on the whole map."""
        return self.global_search.initializing

    @property
    def mode(self) -> Mode:
        """Mode of the newest estimate: LOST, DEAD_RECKONING or OK."""
        if self.lost:
            return Mode.LOST
        return Mode.DEAD_RECKONING if self.dead_reckoning else Mode.OK

    @property
    def keeps_initial_pose(self) -> bool:
        """Whether sightings contradict a given first pose, and no more of them confirm it."""
        return self._given and self._contradicting >= max(self._confirming, 1)

    def gate_initial_pose(
        self, accepted: list[LoggedSighting], rejected: list[LoggedSighting], decisions: list[Decision]
    ) -> tuple[list[LoggedSighting], list[LoggedSighting], list[Decision]]:
        """Judge a given first pose by the verdicts of `Association.judge`; while it contradicts them, accept none.

        One that agrees with a contradicted pose does so by accident, and would drag it along.
        """
        if self.dead_reckoning and not self._contradicting:  # it is the motion that may be wrong by now
            self._given = False
        self._confirming += len(accepted)
        self._contradicting += len(rejected) - sum(d.reason == AMBIGUOUS for d in decisions)
        if self._confirming > self._contradicting + _CONFIRMED:
            self._given = False
        if not self.keeps_initial_pose:
            return accepted, rejected, decisions
        marked = [d if d.reason else replace(d, weight=0.0, reason=CONTRADICTS) for d in decisions]
        return [], [*rejected, *accepted], marked

    def record_fix(self, by_sightings: bool = True) -> None:
        """Note that the estimated pose is confirmed; ``by_sightings``: by accepted sightings."""
        self._fix_s = self._clock_s
        if by_sightings:
            self.lost = False
            self.global_search.forget()

    def record_conflict(self, predicted: PoseWithCovariance, place: PoseWithCovariance) -> None:
        """Note that sightings agree on another place than the given one."""
        self.initial_pose_conflict = se2.between(predicted.pose, place.pose)

    def kidnapped(self, contradicting: int, belief: PoseWithCovariance) -> tuple[float, FloatArray]:
        """Probability that a robot was carried away, as all landmarks seen since the last fix contradict its pose.

        Either each of them is wrong by itself, or the robot may be where the landmarks are.

        Args:
            contradicting: how many landmarks.
            belief: the pose.

        Returns:
            The probability, and the covariance ``(3, 3)`` of the pose's error if it holds.
        """
        if contradicting == 0 or not self._known or len(self._places) == 0:
            return 0.0, np.zeros((3, 3))
        return CARRIED / (CARRIED + WRONG_LANDMARK**contradicting), self._spread_of_map(belief)

    def lost_cov(self, belief: PoseWithCovariance) -> FloatArray:
        """Covariance ``(3, 3)`` to add to a lost robot's pose; 0 if the belief itself is wide enough to be lost."""
        if self.is_unlocalized(belief):
            return np.zeros((3, 3))
        return self._spread_of_map(belief)

    def _spread_of_map(self, belief: PoseWithCovariance) -> FloatArray:
        """Covariance ``(3, 3)`` about a pose of a robot that may be where any landmark is."""
        around = ANYWHERE.copy()
        if len(self._places):
            around[:2, :2] = np.eye(2) * np.mean((self._places - belief.pose[:2]) ** 2)
        return around

    def get_lost(self) -> None:
        """Look for the robot anywhere on the map."""
        self.lost = True
        self.global_search.initializing = True
        self.global_search.hypotheses.reset()

    def go_on(self) -> None:
        """End the search if the robot was lost: the motion since then has become known."""
        if self.lost:
            self.lost = self.global_search.initializing = False
            self.global_search.forget()

    def is_unlocalized(self, belief: PoseWithCovariance | None) -> bool:
        """Whether the pose is so little known that only a search of the map can find it again."""
        if belief is None or not self._known:
            return False
        x, y, yaw = np.sqrt(np.diag(belief.cov))
        # Twice the variance with which a place is taken, so that one just taken is not lost at once
        return bool(max(x, y) > _NOWHERE_M or yaw**2 > 2.0 * MAX_SIGMA[2] ** 2)

    def unconfirmed(self) -> PoseWithCovariance | None:
        """Pose by the sightings so far, before they are enough to check one another; None: it is too uncertain.

        Reported once the pose is known well enough to judge a sighting by it.
        """
        belief = self.global_search.hypotheses.belief()
        if belief is None or (not self._reported and self.is_unlocalized(belief)):
            return None
        self._reported = True
        return belief

    def give_up(self, no_landmark_sensor: bool) -> InitialPose | None:
        """The segment is over, and its first pose was not found: what is to be replayed, and from where.

        Args:
            no_landmark_sensor: nothing could have been seen: the map's origin is as probable as any place.
        """
        if not self.initializing or self.lost:
            return None
        belief = self.global_search.hypotheses.belief()
        start = self.global_search.give_up() if no_landmark_sensor or belief is not None else None
        if start is not None and (belief is None or self.is_unlocalized(belief)):
            self._never_found = True
            self.get_lost()
        return start

    def search(
        self,
        step: Step,
        motions: Sequence[MotionMeasurement],
        outliers: Sequence[LandmarkMeasurement],
        readings: MotionReadings,
        predicted: PoseWithCovariance,
    ) -> InitialPose | None:
        """While no sighting is accepted, look for another place that explains the rejected ones.

        Returns:
            A place found from two landmarks or more, and far from the predicted one: nearer ones are the business of
            `Association.nearby_consensus`, unless the first pose was given.
        """
        searching = bool(outliers) or self.global_search.searching
        decided = self.keeps_initial_pose and self.initial_pose_conflict is not None
        if not searching or decided or self.initializing or not self._adaptive:
            return None
        started = self.global_search.collect(step, motions, outliers, readings, predicted)
        if started is None or self.keeps_initial_pose or started.gathered:
            return started  # what is gathered has no consensus nearby: that may need all of the collected time
        return started if apart(predicted.pose, started.newest.pose) else None

    def found(
        self, estimated: PoseWithCovariance, place: PoseWithCovariance, witness: str = "", nis: float = 0.0
    ) -> None:
        """Note that the robot was found at another place than estimated, and end the search.

        Args:
            estimated: its pose before.
            place: its pose now.
            witness: the one source that says so, where nothing shows that the robot was lifted; empty: there are more.
            nis: of the difference of both, by their covariances.
        """
        if witness and nis > _CONTRADICTED and not self.lost:
            self._doubt = self._doubt + place.pose[:2] - estimated.pose[:2]
            self._witness = witness
            self._doubted = self._doubted or (witness, float(np.hypot(*self._doubt)), float(np.sqrt(nis)))
            if np.hypot(*self._doubt) < _NOWHERE_M * max(1.0, float(np.sqrt(estimated.cov[:2, :2].trace()))):
                self._doubt = np.zeros(2)  # it is back where motion had led to
        elif not witness:
            self._doubt = np.zeros(2)
        self._jump_count += 1
        if self._jump is None:
            self._jump = se2.between(estimated.pose, place.pose)
        self.lost = self._given = False
        self.global_search.forget()

    def confirm(self, witnesses: Collection[str]) -> None:
        """Note sources that agree with the pose: one beside that which a jump rests on ends the doubt of it."""
        if self._witness and not set(witnesses) <= {self._witness}:
            self._doubt, self._witness = np.zeros(2), ""

    def doubt_cov(self, belief: PoseWithCovariance) -> FloatArray:
        """Covariance ``(3, 3)`` to add, in the body frame, where motion and one other source contradict each other.

        Which of both is wrong is not known: the robot is as probably at the other place.
        """
        cov = np.zeros((3, 3))
        if self._doubt.any():
            c, s = np.cos(belief.pose[2]), np.sin(belief.pose[2])
            away = np.array([[c, s], [-s, c]]) @ self._doubt
            cov[:2, :2] = 0.5 * np.outer(away, away)
        return cov

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user about jumps, a first pose never found, and a contradicted first pose."""
        sentences = []
        if self._jump is not None:
            more = f", and {self._jump_count - 1} times more" if self._jump_count > 1 else ""
            sentences.append(f"sightings contradicted the estimated pose: jumped by {_far(self._jump)}{more}")
        if self._doubted is not None:
            witness, far_m, sigmas = self._doubted
            sentences.append(
                Grave(
                    f"the sensor {witness} alone put the robot {far_m:.2f} m from where its motion had led it "
                    f"({sigmas:.0f} sigma of both), and nothing showed that it was lifted: which of both is wrong is "
                    "not known, and the position is as uncertain from there on. Look at the trajectory; a receiver "
                    "that lost its signals may go on beside the truth with a small covariance"
                )
            )
        if self._never_found:
            sentences.append(
                "the sightings never determined where on the map the robot is: its poses are LOST, and right relative "
                "to one another at best (from the map's origin on if nothing was seen); give estimator.initial_pose, "
                "or let the robot see more landmarks"
            )
        if self.initial_pose_conflict is not None:
            sentences.append(
                f"sightings contradict the given first pose: they put the robot {_far(self.initial_pose_conflict)} off "
                "and were refused; correct estimator.initial_pose or the map, or leave the first pose to the sightings"
            )
        return tuple(sentences)


def _far(miss: FloatArray) -> str:
    x, y, yaw = miss
    return f"{np.hypot(x, y):.2f} m and {abs(np.degrees(yaw)):.0f} degrees (forward {x:+.2f}, left {y:+.2f})"
