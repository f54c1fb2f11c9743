"""The search for the robot: steps are collected, their sightings moved to the newest one, until a place is found."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.joint import FAR_M2, fuse
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.relocalization.gaussian_sum import GaussianSum
from fgloc.relocalization.place_search import PlaceSearch
from fgloc.sensors.motion_compensation import compensated
from fgloc.types import (
    FloatArray,
    LandmarkMap,
    LandmarkMeasurement,
    MotionMeasurement,
    MotionReadings,
    Step,
)

ANYWHERE = np.diag([FAR_M2, FAR_M2, math.pi**2 / 3.0])  # the yaw may be any, with equal probability
ORIGIN = 1e-6 * np.eye(se2.DOF)  # of a first pose that is the origin by definition
_PATIENCE = 3.0  # times initialise_s, that a place waits for what could check it
# After initialise_s in vain it is tried no more often than this: a new sighting seldom changes the result of 5 s.
_RETRY_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class SearchStep:
    """One step of the time before the first pose was known."""

    step: Step
    motions: tuple[MotionMeasurement, ...]
    sightings: tuple[LandmarkMeasurement, ...]
    readings: MotionReadings


@dataclass(frozen=True, slots=True, eq=False)
class InitialPose:
    """The place that explains the collected sightings.

    Attributes:
        steps: what was collected, oldest first; the first one's motions are to be ignored.
        first: weak prior for the oldest step, to be followed by all its sightings.
        newest: pose at the newest step with the covariance that the sightings give.
        by_sensors: from registered sensors alone.
    """

    steps: tuple[SearchStep, ...]
    first: PoseWithCovariance
    newest: PoseWithCovariance
    by_sensors: bool = False


class GlobalSearch:
    """Collects steps while the pose is unknown.

    Attributes:
        initializing: whether the first pose is still looked for.
        hypotheses: where the robot may be before that is confirmed.
    """

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, factors: LandmarkFactors, keep_all: bool = False
    ) -> None:
        """Take the parts; ``keep_all``: steps that the search has forgotten are kept for the replay from the start."""
        self._config = config
        self._keep_all = keep_all
        self._window_ns = round(config.estimator.initialise_s * 1e9)
        self._places = PlaceSearch(config, landmark_map, factors)
        self._steps: deque[SearchStep] = deque()
        self._earlier: list[SearchStep] = []  # with keep_all: before those, since the segment began
        self._first = False  # whether the segment has had no pose yet
        self.hypotheses = GaussianSum(config, landmark_map)
        self._since_ns: int | None = None  # the first sighting of the search
        self._tried_ns = 0  # when a place was looked for last
        self.initializing = True

    def reset(self) -> None:
        """Look for the pose again."""
        self.forget()
        self.initializing = self._first = True

    @property
    def searching(self) -> bool:
        """Whether there is anything collected."""
        return bool(self._steps)

    def forget(self) -> None:
        """What was collected is of no use any more: the robot is where it was estimated to be."""
        self._steps.clear()
        self._earlier.clear()
        self.hypotheses.reset()
        self._first = False
        self._since_ns = None

    def collect(
        self,
        step: Step,
        motions: Sequence[MotionMeasurement],
        sightings: Sequence[LandmarkMeasurement],
        readings: MotionReadings | None = None,
        known: bool = False,
    ) -> InitialPose | None:
        """Add a step; return the start once one place explains what was seen.

        Args:
            step: the next one.
            motions: factors of the motion over it.
            sightings: made in it.
            readings: what the motions were made of, kept for the replay.
            known: the robot has an estimated pose elsewhere. Then it takes two landmarks, and nearly everything to
                agree: some wrong ids agree with some place always.
        """
        self._steps.append(SearchStep(step, tuple(motions), tuple(sightings), readings or MotionReadings()))
        horizon = step.stamp_ns - self._window_ns
        while self._steps[0].step.stamp_ns < horizon:
            forgotten = self._steps.popleft()
            if self._keep_all and self._first:
                self._earlier.append(forgotten)
        if self._first:
            self.hypotheses.add(motions if len(self._steps) + len(self._earlier) > 1 else (), sightings)
        if sightings and self._since_ns is None:
            self._since_ns = step.stamp_ns
        due = sightings and self._due(step.stamp_ns)
        best = self._places.find(list(self._compensated()), known, self._waited()) if due else None
        if best is None:
            return None
        start = self._start(PoseWithCovariance(best.fit.pose, best.fit.cov))
        return dataclasses.replace(start, by_sensors=best.by_sensors)

    def _due(self, stamp_ns: int) -> bool:
        """Whether it is time to look for a place; bounds the work per second of a search that finds none."""
        since, patience_ns = self._since_ns or stamp_ns, self._config.estimator.initialise_s * 1e9
        waited = self._tried_ns <= since + _PATIENCE * patience_ns < stamp_ns  # what counts as enough has changed
        if stamp_ns > since + patience_ns and 0 <= stamp_ns - self._tried_ns < _RETRY_S * 1e9 and not waited:
            return False
        self._tried_ns = stamp_ns
        return True

    def give_up(self) -> InitialPose | None:
        """The segment is over: all its steps, from the most probable place; None if none are kept.

        Without any sighting the first pose is put at the map's origin, and the others are relative to it.
        """
        if not self._first or not self._steps:
            return None
        best = self.hypotheses.most_probable()
        if best is not None:
            return self._start(best)
        origin = PoseWithCovariance(np.zeros(3), ORIGIN.copy())
        return dataclasses.replace(self._start(origin), first=origin)

    def _start(self, newest: PoseWithCovariance) -> InitialPose:
        self.initializing = False
        steps = (*self._earlier, *self._steps)
        first = PoseWithCovariance(se2.compose(newest.pose, se2.inverse(_travelled(steps))), ANYWHERE.copy())
        self.forget()
        return InitialPose(steps, first, newest)

    def _waited(self) -> bool:
        """Whether that is not to be expected any more."""
        since = self._steps[-1].step.stamp_ns - (self._since_ns or 0)
        return since > _PATIENCE * self._config.estimator.initialise_s * 1e9

    def _compensated(self) -> Iterator[LandmarkMeasurement]:
        """Every collected sighting as seen from the newest step."""
        motion, cov = np.zeros(3), np.zeros((3, 3))  # T_newest_then, and its covariance
        for index in range(len(self._steps) - 1, -1, -1):
            collected = self._steps[index]
            for m in collected.sightings:
                yield compensated(m, motion, cov)
            if collected.motions and index > 0:
                step, step_cov = fuse(collected.motions)
                back = se2.inverse(step)
                ad = se2.adjoint(step)
                motion, cov = se2.compose(motion, back), se2.compose_cov(cov, back, ad @ step_cov @ ad.T)


def _travelled(steps: Sequence[SearchStep]) -> FloatArray:
    """``T_oldest_newest``."""
    travelled = np.zeros(3)
    for collected in steps[1:]:
        if collected.motions:
            travelled = se2.compose(travelled, fuse(collected.motions)[0])
    return travelled
