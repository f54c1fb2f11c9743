"""The search of the map: steps are collected, their sightings moved to the newest one, until a place explains them."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.estimation.beacons import Displacement, GaussianSum
from fgloc.estimation.pose_fit import WHOLE_SHARE, Fit, PoseConsensus, PoseFit, apart, fit_pose
from fgloc.estimation.unnamed import Constellations
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.joint import FAR_M2, MOST_JOINT, MOST_STEPS, fuse
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import COVARIANCE_FACTOR
from fgloc.sensors.measurements import LandmarkMeasurement, points_of
from fgloc.stats import ROUNDING
from fgloc.types import FloatArray, LandmarkMap, MotionMeasurement, MotionReadings, Step

# --- Candidates, rough fits, a consensus ------------------------------------------------------------------------------

# Where no place explains the sightings (a wrong map, a robot that is lost) every step tries anew: this bounds its time.
_MAX_SEEDS = 6  # places to start from, and sightings that tell them
_KNOWN_SEEDS = 1  # of a robot whose place is known: the newest, which any other place has to explain, too
_MOST_SENSED = 64  # readings of registered sensors that are weighed together where no pose is known: two rows each
_MOST_RANKING = 12  # of them, by which the hundreds of candidates about anchors are ranked
_SELDOM_MISREAD = 3  # landmarks of one image: so many with wrong ids do not agree with any place
_POSE_SEEDS = 2  # measurements of registered sensors, whose places are tried


class PlaceSearch:
    """Looks for the robot by sightings alone, without regard to where it may have been before."""

    def __init__(self, config: Config, landmark_map: LandmarkMap | None, factors: LandmarkFactors) -> None:
        self._map, self._factors = landmark_map, factors
        self._window_ns = round(config.estimator.initialise_s * 1e9)

    def find(self, sightings: Sequence[LandmarkMeasurement], known: bool) -> PoseConsensus | None:
        """The place that nearly all sightings agree on; None: there is none, or it is not certain.

        Args:
            sightings: as seen from the pose that is looked for.
            known: the robot has an estimated pose elsewhere, so that it takes more to find it here.
        """
        sensed = not known and not any(m.of_landmark for m in sightings)
        here = _spread(sightings, _MOST_SENSED if sensed else MOST_JOINT)
        if known and len({m.landmark_id for m in here}) < 2 and not _lasting(here, self._window_ns):
            return None  # one landmark alone may have been moved, or misread
        fitted = PoseFit(here, self._factors)
        rough = PoseFit(_spread(here, _MOST_RANKING), self._factors) if sensed else fitted
        candidates = sorted(self._candidates(here, known), key=lambda c: float(rough.costs(c)[0].sum()))
        fits = [fit for c in candidates[:_MAX_SEEDS] if (fit := fitted.solve(c)) is not None]
        places: list[Fit] = []
        for fit in sorted(fits, key=lambda fit: fit.cost):
            if all(apart(fit.pose, other.pose) for other in places):
                places.append(fit)
        found = [agreed for fit in places if (agreed := self._agreed(fit, fitted, here)) is not None]
        if not found:
            return None
        best = min(found, key=lambda agreed: (-agreed.share, agreed.fit.cost))
        if known and not best.by_sensors and best.landmarks < _SELDOM_MISREAD and best.images < 2:
            return None  # two misread ids agree with some place where markers hang in rows, but not twice
        return best if best.certain else None

    def _agreed(self, fit: Fit, fitted: PoseFit, sightings: Sequence[LandmarkMeasurement]) -> PoseConsensus | None:
        """Fit a place to the sightings that it explains, as long as they get more."""
        agreeing = list(sightings)
        for _ in range(MOST_STEPS):
            before = agreeing
            costs, dofs = fitted.costs(fit.pose)
            explained = costs < COVARIANCE_FACTOR * dofs
            agreeing = [m for m, kept in zip(sightings, explained.tolist(), strict=True) if kept]
            if len(agreeing) == len(before):
                break
            trimmed = fit_pose(fit.pose, agreeing, self._factors) if agreeing else None
            if trimmed is None:
                return None
            fit = trimmed
        information_of: dict[int, float] = {}
        for m in agreeing:
            information_of[m.landmark_id] = information_of.get(m.landmark_id, 0.0) + m.information
        share = sum(information_of.values()) / sum(m.information for m in sightings)
        residuals = {m.landmark_id: m.dof for m in agreeing}
        if len(residuals) < 2:
            share = len(agreeing) / len(sightings)
        seen = {m.landmark_id for m in sightings}
        return PoseConsensus(
            fit,
            share,
            len(residuals),
            sum(residuals.values()) - se2.DOF,
            frozenset(seen - information_of.keys()),
            len({m.stamp_ns for m in agreeing}),
            not any(m.of_landmark for m in agreeing),
        )

    def _candidates(self, sightings: Sequence[LandmarkMeasurement], known: bool) -> Iterator[FloatArray]:
        if self._map is None:
            return
        others = [m for m in sightings if not m.of_landmark]
        whole = [m for m in sightings if m.gives_pose]
        seeds = whole[:_KNOWN_SEEDS] if known else _spread(whole, _MAX_SEEDS)
        for m in (*others[:: -(-len(others) // _POSE_SEEDS) or 1], *seeds):
            yield from m.poses(self._map.landmarks)


def _spread(sightings: Sequence[LandmarkMeasurement], most: int) -> Sequence[LandmarkMeasurement]:
    """At most ``most`` sightings, thinned out evenly within each landmark."""
    if len(sightings) <= most:
        return sightings
    return sorted(sightings, key=lambda m: m.landmark_id)[:: -(-len(sightings) // most)]


def _lasting(sightings: Sequence[LandmarkMeasurement], window_ns: int) -> bool:
    """Whether a place follows from registered sensors alone for most of a time."""
    stamps = [m.stamp_ns for m in sightings]
    by_sensors = not any(m.of_landmark for m in sightings)
    return bool(stamps) and by_sensors and max(stamps) - min(stamps) > WHOLE_SHARE * window_ns


# --- The search over time ---------------------------------------------------------------------------------------------

ANYWHERE = np.diag([FAR_M2, FAR_M2, se2.ANY_YAW])  # the yaw may be any, with equal probability
ORIGIN = ROUNDING * np.eye(se2.DOF)  # of a first pose that is the origin by definition
# After initialise_s in vain, or by registered sensors alone, it is tried no more often: a new sighting changes little.
_RETRY_S = 1.0
_SENSORS_WINDOW_S = 60.0  # positions and ranges without a map tell the yaw by the way: a robot goes 12 m at 0.2 m/s


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
        first: prior for the oldest step, to be followed by its sightings and all others.
        newest: pose at the newest step with the covariance that the sightings give.
        gathered: from registered sensors or beacons, which come one at a time.
        displaced: of each beacon seen, whether it is where the map has it; None: the place is not of beacons.
    """

    steps: tuple[SearchStep, ...]
    first: PoseWithCovariance
    newest: PoseWithCovariance
    gathered: bool = False
    displaced: dict[int, Displacement] | None = None

    @property
    def witness(self) -> str:
        """The one receiver of positions that all was seen by; empty: several, or landmarks or anchors, which differ."""
        seen = [m for collected in self.steps for m in collected.sightings]
        kinds = {m.row_kind for m in seen}
        return kinds.pop() if len(kinds) == 1 and not any(m.of_landmark or m.dof < 2 for m in seen) else ""


class GlobalSearch:
    """Collects steps while the pose is unknown.

    Attributes:
        initializing: whether the first pose is still looked for.
        hypotheses: where the robot may be before that is confirmed.
        constellations: of hits that are of no named beacon.
    """

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, factors: LandmarkFactors, keep_all: bool = False
    ) -> None:
        """Set up for a map; ``keep_all``: steps that the search has forgotten are kept for the replay."""
        self._config = config
        self._keep_all = keep_all
        self._window_ns = round(config.estimator.initialise_s * 1e9)
        self._unseen_ns = self._window_ns  # as far back as a robot is looked for that has no pose
        if landmark_map is not None and not len(landmark_map):
            self._unseen_ns = max(self._window_ns, round(_SENSORS_WINDOW_S * 1e9))
        self._places = PlaceSearch(config, landmark_map, factors)
        self._steps: deque[SearchStep] = deque()
        self._earlier: list[SearchStep] = []  # with keep_all: before those, since the segment began
        self._first = False  # whether the segment has had no pose yet
        self.hypotheses = GaussianSum(config, landmark_map)
        self.constellations = Constellations(config, landmark_map)
        self._since_ns: int | None = None  # the first sighting of the search
        self._tried_ns = 0  # when a place was looked for last
        self.initializing = True

    def reset(self) -> None:
        """Begin a new search of the first pose."""
        self.forget()
        self.initializing = self._first = True

    @property
    def searching(self) -> bool:
        """Whether any steps are collected."""
        return bool(self._steps)

    def forget(self) -> None:
        """Discard the collected steps and hypotheses: the robot is where it was estimated to be."""
        self._steps.clear()
        self._earlier.clear()
        self.hypotheses.reset()
        self.constellations.reset()
        self._first = False
        self._since_ns = None

    def collect(
        self,
        step: Step,
        motions: Sequence[MotionMeasurement],
        sightings: Sequence[LandmarkMeasurement],
        readings: MotionReadings | None = None,
        tracked: PoseWithCovariance | None = None,
    ) -> InitialPose | None:
        """Add a step; return the start once one place explains what was seen.

        Args:
            step: the next one.
            motions: factors of the motion over it.
            sightings: made in it.
            readings: what the motions were made of, kept for the replay.
            tracked: where the robot is estimated to be after the step. Then it takes two markers, and nearly
                everything to agree on another place: some wrong ids agree with some place always. Among beacons another
                place has to be so much more probable.
        """
        self._steps.append(SearchStep(step, tuple(motions), tuple(sightings), readings or MotionReadings()))
        horizon = step.stamp_ns - (self._unseen_ns if tracked is None else self._window_ns)
        while self._steps[0].step.stamp_ns < horizon:
            forgotten = self._steps.popleft()
            if self._keep_all and self._first:
                self._earlier.append(forgotten)
        named = [m for m in sightings if not m.unnamed]
        self.hypotheses.add(motions, named, tracked)
        place = self.hypotheses.confirmed(tracked)
        if place is not None:
            return self._start(place, gathered=True, displaced=self.hypotheses.displaced())
        if (place := self._told_by_constellation(step, motions, sightings, tracked)) is not None:
            return self._start(place, gathered=True, displaced={})
        if self.hypotheses.has_seen and all(m.is_point for c in self._steps for m in c.sightings):
            return None
        if named and self._since_ns is None:
            self._since_ns = step.stamp_ns
        sensed = not any(m.of_landmark for c in self._steps for m in c.sightings)
        due = named and self._due(step.stamp_ns, sensed)
        best = self._places.find(list(self._compensated()), tracked is not None) if due else None
        if best is None:
            return None
        return self._start(PoseWithCovariance(best.fit.pose, best.fit.cov), best.by_sensors)

    def _told_by_constellation(
        self,
        step: Step,
        motions: Sequence[MotionMeasurement],
        sightings: Sequence[LandmarkMeasurement],
        tracked: PoseWithCovariance | None,
    ) -> PoseWithCovariance | None:
        """Place by hits of beacons without identity; None: there is none, or it is not certain."""
        if motions:
            self.constellations.move(*fuse(motions))
        unnamed = [m for m in points_of(sightings) if m.unnamed]
        self.constellations.take(unnamed)
        return self.constellations.place(step.stamp_ns, tracked is not None) if unnamed else None

    def _due(self, stamp_ns: int, sensed: bool) -> bool:
        """Whether it is time to look for a place; bounds the work per second of a search that finds none.

        Args:
            stamp_ns: of the step.
            sensed: there are ranges and positions only, of which the yaw follows from the way of seconds.
        """
        since, patience_ns = self._since_ns or stamp_ns, self._config.estimator.initialise_s * 1e9
        if (sensed or stamp_ns > since + patience_ns) and 0 <= stamp_ns - self._tried_ns < _RETRY_S * 1e9:
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

    def _start(
        self,
        newest: PoseWithCovariance,
        gathered: bool = False,
        displaced: dict[int, Displacement] | None = None,
    ) -> InitialPose:
        self.initializing = False
        steps = (*self._earlier, *self._steps)
        *_, oldest = _back(newest, steps)
        self.forget()
        # The sightings that follow are in it already; those of markers say themselves which of them are wrong
        cov = ANYWHERE.copy() if displaced is None else COVARIANCE_FACTOR * oldest.cov
        return InitialPose(steps, PoseWithCovariance(oldest.pose, cov), newest, gathered, displaced)

    def _compensated(self) -> Iterator[LandmarkMeasurement]:
        """Every collected sighting, moved to the newest step."""
        here = PoseWithCovariance(np.zeros(3), np.zeros((3, 3)))
        for collected, then in zip(reversed(self._steps), _back(here, self._steps), strict=True):
            for m in (m for m in collected.sightings if not m.unnamed):
                yield m.compensated(then.pose, then.cov)


def _back(newest: PoseWithCovariance, steps: Sequence[SearchStep]) -> Iterator[PoseWithCovariance]:
    """Poses at these steps, from the newest back, if the robot is at ``newest`` now."""
    pose, cov = newest.pose, newest.cov
    yield newest
    for collected in reversed(list(steps)[1:]):
        if collected.motions:
            step, step_cov = fuse(collected.motions)
            back, ad = se2.inverse(step), se2.adjoint(step)
            pose, cov = se2.compose(pose, back), se2.compose_cov(cov, back, ad @ step_cov @ ad.T)
        yield PoseWithCovariance(pose, cov)
