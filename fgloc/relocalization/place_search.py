"""A place on the map that explains sightings, wherever on the map it is: candidates, rough fits, a consensus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.joint import MOST_JOINT, MOST_STEPS
from fgloc.graph.noise import COVARIANCE_FACTOR
from fgloc.relocalization.beacon_geometry import RING
from fgloc.relocalization.pose_consensus import WHOLE_SHARE, PoseConsensus, apart
from fgloc.relocalization.pose_fit import Fit, PoseFit, fit_pose
from fgloc.sensors.cameras import planar_base_candidates
from fgloc.types import (
    FloatArray,
    FrameMeasurement,
    LandmarkMap,
    LandmarkMeasurement,
    PixelMeasurement,
    PointMeasurement,
    PoseMeasurement,
)

# Where no place explains the sightings (a wrong map, a robot that is lost) every step tries anew: this bounds its time.
_MAX_SEEDS = 6  # places to start from, and sightings that tell them
_KNOWN_SEEDS = 1  # of a robot whose place is known: the newest, which any other place has to explain, too
_POSE_SEEDS = 2  # measurements of registered sensors, whose places are tried ...
_YAWS = np.linspace(-np.pi, np.pi, RING, endpoint=False)  # ... with these yaws


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
        here = _spread(sightings, MOST_JOINT)
        if known and len({m.landmark_id for m in here}) < 2 and not _lasting(here, self._window_ns):
            return None  # one landmark alone may have been moved, or misread
        fitted = PoseFit(here, self._factors)
        candidates = sorted(self._candidates(here, known), key=lambda c: float(fitted.costs(c)[0].sum()))
        fits = [fit for c in candidates[:_MAX_SEEDS] if (fit := fitted.solve(c)) is not None]
        places: list[Fit] = []
        for fit in sorted(fits, key=lambda fit: fit.cost):
            if all(apart(fit.pose, other.pose) for other in places):
                places.append(fit)
        found = [agreed for fit in places if (agreed := self._agreed(fit, fitted, here)) is not None]
        if not found:
            return None
        best = min(found, key=lambda agreed: (-agreed.share, agreed.fit.cost))
        if not best.certain or (known and not best.overrides_prior()):
            return None
        return best

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
            information_of[m.landmark_id] = information_of.get(m.landmark_id, 0.0) + _information(m)
        share = sum(information_of.values()) / sum(map(_information, sightings))
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
            all(isinstance(m, PoseMeasurement) for m in agreeing),
            _lasting(agreeing, self._window_ns),
            sum(n > 1 for n in Counter(i for i, _ in {(m.landmark_id, m.stamp_ns) for m in agreeing}).values()),
        )

    def _candidates(self, sightings: Sequence[LandmarkMeasurement], known: bool) -> Iterator[FloatArray]:
        if self._map is None:
            return
        by_pose = [m for m in sightings if isinstance(m, PoseMeasurement)]
        for seed in by_pose[:: -(-len(by_pose) // _POSE_SEEDS) or 1]:
            yield from (np.array([*place, yaw]) for place in seed.places() for yaw in _YAWS)
        sightings = [m for m in sightings if not isinstance(m, PoseMeasurement)]
        whole = [m for m in sightings if not isinstance(m, PointMeasurement)]  # that give a place each
        seeds = whole[:_KNOWN_SEEDS] if known else _spread(whole, _MAX_SEEDS)
        for m in seeds:
            landmark = self._map.landmarks[m.landmark_id]
            if isinstance(m, PixelMeasurement):
                yield from (pose for pose, _ in planar_base_candidates(m.camera, m.corners_px, landmark))
            elif isinstance(m, FrameMeasurement):
                yield se2.compose(landmark.planar, se2.inverse(m.pose))


def _spread(sightings: Sequence[LandmarkMeasurement], most: int) -> Sequence[LandmarkMeasurement]:
    """All of them or, of too many, every second, third and so on of each landmark: those seen in turns are all kept."""
    if len(sightings) <= most:
        return sightings
    return sorted(sightings, key=lambda m: m.landmark_id)[:: -(-len(sightings) // most)]


def _lasting(sightings: Sequence[LandmarkMeasurement], window_ns: int) -> bool:
    """Whether a place follows from registered sensors alone for most of a time."""
    stamps = [m.stamp_ns for m in sightings]
    by_sensors = all(isinstance(m, PoseMeasurement) for m in sightings)
    return bool(stamps) and by_sensors and max(stamps) - min(stamps) > WHOLE_SHARE * window_ns


def _information(m: LandmarkMeasurement) -> float:
    """What a sighting weighs, in comparison with others of its kind."""
    return 1.0 / (m.sigma_px**2 if isinstance(m, PixelMeasurement) else float(np.trace(m.cov[:2, :2])))
