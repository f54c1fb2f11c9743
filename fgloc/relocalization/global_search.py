"""The first pose: found from sightings alone, carried along by the motion until they agree on one place."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.joint import fuse
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.relocalization.gaussian_sum import GaussianSum
from fgloc.relocalization.pose_consensus import MAX_COST_PER_DOF, MAX_SIGMA, PoseConsensus, apart
from fgloc.relocalization.pose_fit import Fit, PoseFit, joint_fit, sighting_costs
from fgloc.sensors.motion_compensation import carry
from fgloc.sensors.pnp import candidates_from_points, planar_base_candidates
from fgloc.types import (
    FloatArray,
    FrameMeasurement,
    LandmarkMap,
    LandmarkMeasurement,
    MotionMeasurement,
    MotionReadings,
    PixelMeasurement,
    PointMeasurement,
    PoseMeasurement,
    Step,
)

_WEAK_PRIOR = np.diag([100.0, 100.0, 10.0])  # m², m², rad²: the sightings determine the pose
ORIGIN = np.diag([1e-6, 1e-6, 1e-6])  # of a first pose that is the origin by definition
_MAX_STEPS = 400
_LEAST_SHARE = 0.1  # of the information that the best-seen landmark gives: one that gives less counts for none
_TRIMS = 3
_PATIENCE = 3.0  # times initialise_s, that a place waits for what could check it
_CHECKABLE = 3  # beacons of a map, from which on one of them can be left out
# Where no place explains the sightings (a wrong map, a robot that is lost) every step tries anew: this bounds its time.
_MAX_FITTED, _MAX_ROUGH, _MAX_SEEDS = 24, 12, 6  # sightings for the fit, for the rough fit, for places to start from
_KNOWN_SEEDS = 1  # of a robot whose place is known: the newest, which any other place has to explain, too
_HOPELESS = 2.0  # times the cost that a place may have: a rough fit above it will not come below
_MAX_CANDIDATES = 4  # places to start from, that are fitted roughly
_UNLIKELY = 1e3  # cost of a sighting that a place does not explain at all
_MAX_PLACES = 4  # that are fitted to the end
_ITERATIONS, _ROUGH_ITERATIONS = 16, 4
_LASTING = 0.8  # of the time that is collected
_POSE_SEEDS = 2  # measurements of registered sensors, whose places are tried ...
_YAWS = np.linspace(-np.pi, np.pi, 8, endpoint=False)  # ... with these yaws: a fit converges from 30 degrees off
# After initialise_s in vain it is tried no more often than this: a new sighting seldom changes the result of 5 s.
_RETRY_NS = 800_000_000


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
        by_sensors: told by registered sensors alone.
    """

    steps: tuple[SearchStep, ...]
    first: PoseWithCovariance
    newest: PoseWithCovariance
    by_sensors: bool = False


class GlobalSearch:
    """Collects steps while the pose is unknown.

    Attributes:
        waiting: whether the first pose is still looked for.
        hypotheses: where the robot may be before that is confirmed.
    """

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, factors: LandmarkFactors, keep_all: bool = False
    ) -> None:
        """Take the parts; ``keep_all``: steps that the search has forgotten are kept for the replay from the start."""
        self._config = config
        self._keep_all = keep_all
        self._window_ns = round(config.estimator.initialise_s * 1e9)
        self._map = landmark_map
        self._factors = factors
        self._steps: deque[SearchStep] = deque()
        self._earlier: list[SearchStep] = []  # with keep_all: before those, since the segment began
        self._first = False  # whether the segment has had no pose yet
        self.hypotheses = GaussianSum(config, landmark_map)
        self._since_ns: int | None = None  # the first sighting of the search
        self._tried_ns = 0  # when a place was looked for last
        self.waiting = True

    def reset(self) -> None:
        """Look for the pose again."""
        self.forget()
        self.waiting = self._first = True

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
        while self._steps[0].step.stamp_ns < horizon or len(self._steps) > _MAX_STEPS:
            forgotten = self._steps.popleft()
            if self._keep_all and self._first:
                self._earlier.append(forgotten)
        if self._first:
            self.hypotheses.add(motions if len(self._steps) + len(self._earlier) > 1 else (), sightings)
        if sightings and self._since_ns is None:
            self._since_ns = step.stamp_ns
        best = self._solve(known) if sightings and self._due(step.stamp_ns) else None
        if best is None:
            return None
        start = self._start(PoseWithCovariance(best.fit.pose, best.fit.cov))
        return dataclasses.replace(start, by_sensors=best.by_sensors)

    def _due(self, stamp_ns: int) -> bool:
        """Whether it is time to look for a place; bounds the work per second of a search that finds none."""
        since, patience_ns = self._since_ns or stamp_ns, self._config.estimator.initialise_s * 1e9
        waited = self._tried_ns <= since + _PATIENCE * patience_ns < stamp_ns  # what counts as enough has changed
        if stamp_ns > since + patience_ns and 0 <= stamp_ns - self._tried_ns < _RETRY_NS and not waited:
            return False
        self._tried_ns = stamp_ns
        return True

    def give_up(self) -> InitialPose | None:
        """The segment is over: all its steps, from the likeliest place; None if none are kept.

        Without any sighting the first pose is put at the map's origin, and the others are relative to it.
        """
        if not self._first or not self._steps:
            return None
        likeliest = self.hypotheses.likeliest()
        if likeliest is not None:
            return self._start(likeliest)
        origin = PoseWithCovariance(np.zeros(3), ORIGIN.copy())
        return dataclasses.replace(self._start(origin), first=origin)

    def _start(self, newest: PoseWithCovariance) -> InitialPose:
        self.waiting = False
        steps = (*self._earlier, *self._steps)
        first = PoseWithCovariance(se2.compose(newest.pose, se2.inverse(_travelled(steps))), _WEAK_PRIOR.copy())
        self.forget()
        return InitialPose(steps, first, newest)

    def _solve(self, known: bool) -> PoseConsensus | None:
        here = _spread(list(self._carried()), _MAX_FITTED)
        if known and len({m.landmark_id for m in here}) < 2 and not _lasting(here, self._window_ns):
            return None  # one landmark alone may have been moved, or misread
        fit_few = PoseFit(_spread(here, _MAX_ROUGH), self._factors, self._config)
        candidates = sorted(
            self._candidates(here, known), key=lambda c: float(np.minimum(fit_few.costs(c)[0], _UNLIKELY).sum())
        )
        rough = [fit for c in candidates[:_MAX_CANDIDATES] if (fit := fit_few.solve(c, _ROUGH_ITERATIONS)) is not None]
        if known and all(fit.cost > _HOPELESS * MAX_COST_PER_DOF * fit.dof for fit in rough):
            return None
        places: list[FloatArray] = []
        for fit in sorted(rough, key=lambda fit: fit.cost):
            if len(places) < _MAX_PLACES and all(apart(fit.pose, other) for other in places):
                places.append(fit.pose)
        found = [agreed for place in places if (agreed := self._agreed(place, here)) is not None]
        if not found:
            return None
        best = min(found, key=lambda agreed: (-agreed.share, agreed.fit.cost))
        if not best.certain or (known and not best.overrides_prior):
            return None
        if not known and not self._checked(best, here) and not (best.well_determined and self._waited()):
            return None
        return best

    def _waited(self) -> bool:
        """Whether that is not to be expected any more."""
        since = self._steps[-1].step.stamp_ns - (self._since_ns or 0)
        return since > _PATIENCE * self._config.estimator.initialise_s * 1e9

    def _checked(self, best: PoseConsensus, sightings: Sequence[LandmarkMeasurement]) -> bool:
        """Whether beacons determine this place even if any one of them is left out: one may have been moved."""
        agreeing = [
            m for m in sightings if m.landmark_id in best.agreeing and (m.stamp_ns, m.landmark_id) not in best.outliers
        ]
        few = self._map is not None and len(self._map) < _CHECKABLE
        if few or not all(isinstance(m, PointMeasurement) for m in agreeing):
            return True
        for landmark_id in best.agreeing:
            fit = self._fit(best.fit.pose, [m for m in agreeing if m.landmark_id != landmark_id], _ITERATIONS)
            if fit is None or (np.sqrt(np.diag(fit.cov)) > MAX_SIGMA).any() or apart(fit.pose, best.fit.pose):
                return False
        return True

    def _agreed(self, place: FloatArray, sightings: Sequence[LandmarkMeasurement]) -> PoseConsensus | None:
        """Fit a place to the sightings that it explains, as long as they get more."""
        fit = self._fit(place, sightings, _ITERATIONS)
        if fit is None:
            return None
        agreeing = list(sightings)
        for _ in range(_TRIMS):
            before = agreeing
            agreeing = self._explained(fit.pose, sightings)
            if len(agreeing) == len(before):
                break
            trimmed = self._fit(fit.pose, agreeing, _ITERATIONS) if agreeing else None
            if trimmed is None:
                return None
            fit = trimmed
        information_of: dict[int, float] = {}
        for m in agreeing:
            information_of[m.landmark_id] = information_of.get(m.landmark_id, 0.0) + _information(m)
        share = sum(information_of.values()) / sum(map(_information, sightings))
        contributing = {
            i for i, information in information_of.items() if information > _LEAST_SHARE * max(information_of.values())
        }
        residuals = {m.landmark_id: _residuals(m) for m in agreeing if m.landmark_id in contributing}
        if len(residuals) < 2:
            share = len(agreeing) / len(sightings)
        outliers = [m for m in sightings if not any(m is other for other in agreeing)]
        return PoseConsensus(
            fit,
            share,
            len(residuals),
            sum(residuals.values()) - 3,
            frozenset(information_of),
            frozenset(m.landmark_id for m in outliers) - frozenset(information_of),
            frozenset((m.stamp_ns, m.landmark_id) for m in outliers),
            all(isinstance(m, PoseMeasurement) for m in agreeing),
            _lasting(agreeing, self._window_ns),
        )

    def _explained(self, pose: FloatArray, sightings: Sequence[LandmarkMeasurement]) -> list[LandmarkMeasurement]:
        costs, dofs = sighting_costs(pose, sightings, self._factors, self._config)
        explained = (costs < MAX_COST_PER_DOF * dofs).tolist()
        return [m for m, kept in zip(sightings, explained, strict=True) if kept]

    def _fit(self, start: FloatArray, sightings: Sequence[LandmarkMeasurement], iterations: int) -> Fit | None:
        return joint_fit(start, sightings, self._factors, self._config, iterations)

    def _candidates(self, sightings: Sequence[LandmarkMeasurement], known: bool) -> Iterator[FloatArray]:
        if self._map is None:
            return
        points = []
        by_pose = [m for m in sightings if isinstance(m, PoseMeasurement)]
        for seed in by_pose[:: -(-len(by_pose) // _POSE_SEEDS) or 1]:
            yield from (np.array([*place, yaw]) for place in seed.places() for yaw in _YAWS)
        sightings = [m for m in sightings if not isinstance(m, PoseMeasurement)]
        whole = [m for m in sightings if not isinstance(m, PointMeasurement)]  # that give a place each
        seeds = whole[:_KNOWN_SEEDS] if known else _spread(whole, _MAX_SEEDS)
        for m in [*seeds, *(m for m in sightings if isinstance(m, PointMeasurement))]:
            landmark = self._map.landmarks[m.landmark_id]
            if isinstance(m, PixelMeasurement):
                yield from (pose for pose, _ in planar_base_candidates(m.camera, m.corners_px, landmark))
            elif isinstance(m, FrameMeasurement):
                yield se2.compose(landmark.planar, se2.inverse(m.pose))
            elif isinstance(m, PointMeasurement):
                points.append((landmark.position[:2], m.range_m, m.bearing_rad))
        yield from candidates_from_points(points)

    def _carried(self) -> Iterator[LandmarkMeasurement]:
        """Every collected sighting as seen from the newest step."""
        motion, cov = np.zeros(3), np.zeros((3, 3))  # T_newest_then, and its covariance
        for index in range(len(self._steps) - 1, -1, -1):
            collected = self._steps[index]
            for m in collected.sightings:
                yield carry(m, motion, cov)
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


def _spread(sightings: Sequence[LandmarkMeasurement], most: int) -> Sequence[LandmarkMeasurement]:
    """All of them or, of too many, every second, third and so on of each landmark: those seen in turns are all kept."""
    if len(sightings) <= most:
        return sightings
    return sorted(sightings, key=lambda m: m.landmark_id)[:: -(-len(sightings) // most)]


def _lasting(sightings: Sequence[LandmarkMeasurement], window_ns: int) -> bool:
    """Whether registered sensors alone have told of a place for most of a time."""
    stamps = [m.stamp_ns for m in sightings]
    by_sensors = all(isinstance(m, PoseMeasurement) for m in sightings)
    return bool(stamps) and by_sensors and max(stamps) - min(stamps) > _LASTING * window_ns


def _residuals(m: LandmarkMeasurement) -> int:
    return m.dof


def _information(m: LandmarkMeasurement) -> float:
    """What a sighting weighs, in comparison with others of its kind."""
    return 1.0 / (m.sigma_px**2 if isinstance(m, PixelMeasurement) else float(np.trace(m.cov[:2, :2])))
