"""The first pose: found from sightings alone, carried along by the motion until they agree on one place."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.carry import carry
from fgloc.config import Config
from fgloc.graph.estimator import fuse
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.log import Belief
from fgloc.graph.weights import Fit, joint_fit
from fgloc.sensors.pnp import candidates_from_points, planar_base_candidates
from fgloc.types import (
    CornerMeasurement,
    FloatArray,
    LandmarkMap,
    LandmarkMeasurement,
    MarkerPoseMeasurement,
    MotionMeasurement,
    RangeBearingMeasurement,
    Readings,
    Step,
)

_WEAK_PRIOR = np.diag([100.0, 100.0, 10.0])  # m², m², rad²: the sightings themselves say where the robot is
_MAX_COST_PER_DOF = 4.0
_MARGIN = 9.0  # how much more a rival place has to cost (in units of squared sigma)
_SAME_PLACE = np.array([0.3, 0.3, 0.35])  # candidates nearer than this are one place
_MAX_SIGMA = np.array([1.0, 1.0, 0.5])  # m, m, rad: a place less certain than this is not one yet
_MAX_STEPS = 400
# Where no place explains the sightings (a wrong map, a robot that is lost) every step tries anew: this bounds its time.
_MAX_FITTED, _MAX_ROUGH, _MAX_SEEDS = 48, 12, 12  # sightings for the fit, for the rough fit, for places to start from
_MAX_PLACES = 4  # that are fitted to the end
_ITERATIONS, _ROUGH_ITERATIONS = 16, 4


@dataclass(frozen=True, slots=True, eq=False)
class Collected:
    """One step of the time before the first pose was known."""

    step: Step
    motions: tuple[MotionMeasurement, ...]
    sightings: tuple[LandmarkMeasurement, ...]
    readings: Readings


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """The place that explains the collected sightings.

    Attributes:
        steps: what was collected, oldest first; the first one's motions are to be ignored.
        first: weak prior for the oldest step, to be followed by all its sightings.
        newest: pose at the newest step with the covariance that the sightings give.
    """

    steps: tuple[Collected, ...]
    first: Belief
    newest: Belief


class Initializer:
    """Collects steps while the pose is unknown.

    Attributes:
        waiting: whether the first pose is still looked for.
    """

    def __init__(self, config: Config, landmark_map: LandmarkMap | None, factors: LandmarkFactors) -> None:
        self._config = config
        self._map = landmark_map
        self._factors = factors
        self._steps: deque[Collected] = deque(maxlen=_MAX_STEPS)
        self.waiting = True

    def reset(self) -> None:
        """Look for the pose again."""
        self._steps.clear()
        self.waiting = True

    def collect(
        self,
        step: Step,
        motions: Sequence[MotionMeasurement],
        sightings: Sequence[LandmarkMeasurement],
        readings: Readings | None = None,
    ) -> Start | None:
        """Add a step; return the start once one place explains what was seen and no other does.

        Args:
            step: the next one.
            motions: factors of the motion over it.
            sightings: made in it.
            readings: what the motions were made of, kept for the replay.
        """
        self._steps.append(Collected(step, tuple(motions), tuple(sightings), readings or Readings()))
        horizon = step.stamp_ns - round(self._config.estimator.initialise_s * 1e9)
        while self._steps[0].step.stamp_ns < horizon:
            self._steps.popleft()
        newest = self._solve() if sightings else None
        if newest is None:
            return None
        self.waiting = False
        back = se2.inverse(self._travelled())
        steps = tuple(self._steps)
        self._steps.clear()
        return Start(steps, Belief(se2.compose(newest.pose, back), _WEAK_PRIOR.copy()), newest)

    def _solve(self) -> Belief | None:
        here = _spread(list(self._carried()), _MAX_FITTED)
        few = _spread(here, _MAX_ROUGH)
        rough = [fit for c in self._candidates(here) if (fit := self._fit(c, few, _ROUGH_ITERATIONS)) is not None]
        places: list[FloatArray] = []
        for fit in sorted(rough, key=lambda fit: fit.cost):
            if len(places) < _MAX_PLACES and all(_apart(fit.pose, other) for other in places):
                places.append(fit.pose)
        attempts = [self._fit(place, here, _ITERATIONS) for place in places]
        fits = sorted((fit for fit in attempts if fit is not None), key=lambda fit: fit.cost)
        if not fits:
            return None
        best = fits[0]
        rivals = [fit for fit in fits[1:] if _apart(best.pose, fit.pose)]
        if best.dof < 4 or best.cost > _MAX_COST_PER_DOF * best.dof:
            return None
        if (np.sqrt(np.diag(best.cov)) > _MAX_SIGMA).any():
            return None
        if rivals and rivals[0].cost < best.cost + _MARGIN:
            return None
        return Belief(best.pose, best.cov)

    def _fit(self, start: FloatArray, sightings: Sequence[LandmarkMeasurement], iterations: int) -> Fit | None:
        return joint_fit(start, sightings, self._factors, self._config, iterations)

    def _candidates(self, sightings: Sequence[LandmarkMeasurement]) -> Iterator[FloatArray]:
        if self._map is None:
            return
        points = []
        whole = [m for m in sightings if not isinstance(m, RangeBearingMeasurement)]  # that give a place each
        for m in [*_spread(whole, _MAX_SEEDS), *(m for m in sightings if isinstance(m, RangeBearingMeasurement))]:
            landmark = self._map.landmarks[m.landmark_id]
            if isinstance(m, CornerMeasurement):
                yield from (pose for pose, _ in planar_base_candidates(m.camera, m.corners_px, landmark))
            elif isinstance(m, MarkerPoseMeasurement):
                yield se2.compose(landmark.planar, se2.inverse(m.pose))
            elif isinstance(m, RangeBearingMeasurement):
                points.append((landmark.position[:2], m.range_m, m.bearing_rad))
        yield from candidates_from_points(points)

    def _carried(self) -> Iterator[LandmarkMeasurement]:
        """Every collected sighting as seen from the newest step."""
        motion, cov = np.zeros(3), np.zeros((3, 3))  # T_newest_then, and its covariance
        for index in range(len(self._steps) - 1, -1, -1):
            collected = self._steps[index]
            for m in collected.sightings:
                size_m = self._map.landmarks[m.landmark_id].size_m if self._map is not None else 0.0
                yield carry(m, motion, cov, size_m, len(collected.sightings))
            if collected.motions and index > 0:
                step, step_cov = fuse(collected.motions)
                back = se2.inverse(step)
                ad = se2.adjoint(step)
                motion, cov = se2.compose(motion, back), se2.compose_cov(cov, back, ad @ step_cov @ ad.T)

    def _travelled(self) -> FloatArray:
        """``T_oldest_newest``."""
        travelled = np.zeros(3)
        for collected in list(self._steps)[1:]:
            if collected.motions:
                travelled = se2.compose(travelled, fuse(collected.motions)[0])
        return travelled


def _spread(sightings: Sequence[LandmarkMeasurement], most: int) -> Sequence[LandmarkMeasurement]:
    """All of them or, of too many, every second, third and so on."""
    return sightings[:: max(1, -(-len(sightings) // most))]


def _apart(a: FloatArray, b: FloatArray) -> bool:
    """Whether two poses are two places."""
    return bool((np.abs(se2.log(se2.between(a, b))) > _SAME_PLACE).any())
