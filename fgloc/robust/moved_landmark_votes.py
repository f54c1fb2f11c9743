"""Landmarks that do not stand where the map has them: found by their own refusals, set aside, named."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.measurement_log import LandmarkFactor
from fgloc.types import FloatArray

_REMEMBERED = 12  # displacements of a landmark
_AGREE_M, _AGREE_SHARE = 0.25, 0.15  # how far they may lie from their median: at least, and of the displacement
_LEAST_M, _LEAST_SHARE = 0.05, 0.05  # nearer to its place, plus this share of the distance: ill seen, not moved
_BELIEVED_COUNTS = 2.0  # a sighting that fits weighs as much as this many that do not
_MISREAD_SHARE = 0.15  # of the sightings of what stands there: rarer ones may be of that, misread
_ITERATIONS = 4


@dataclass(slots=True)
class _Record:
    """What speaks against one landmark."""

    score: float = 0.0
    places: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    distances: deque[float] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))  # that it was seen from [m]
    held: bool = False
    refused: int = 0  # sightings
    before: Counter[int] = field(default_factory=Counter)  # sightings of each landmark that had fitted until then


class LandmarkExclusion:
    """Counts, for every landmark, how often it was refused while others were believed.

    Wrong ids scatter: only a landmark whose refused sightings agree on another place has been moved.
    """

    def __init__(self, after: int) -> None:
        """Take how many refusals, in excess of what is believed, put a landmark into quarantine."""
        self._after = after
        self._cases: dict[int, _Record] = {}
        self._fitted: Counter[int] = Counter()  # sightings of each landmark

    @property
    def displacements(self) -> dict[int, FloatArray]:
        """Landmarks in quarantine and how far ``(2,)`` [m], in the map, they seem to stand from their place."""
        return {i: np.median(case.places, axis=0) for i, case in sorted(self._cases.items()) if case.held}

    def forget(self) -> None:
        """What was held against landmarks was held against them from a wrong place."""
        self._cases.clear()

    def exclude(self, landmark_id: int, displacement: FloatArray) -> None:
        """Other evidence says that this landmark stands so far ``(2,)`` [m] from its place."""
        case = self._cases[landmark_id] = _Record(held=True)
        case.places.append(displacement)

    def excludes(self, landmark_id: int) -> bool:
        """Whether sightings of this landmark are not to be used."""
        case = self._cases.get(landmark_id)
        return case is not None and case.held

    def accept(self, landmark_id: int) -> None:
        """A sighting of this landmark agreed with the prediction."""
        self._fitted[landmark_id] += 1
        case = self._cases.get(landmark_id)
        if case is None or case.held:
            return
        case.score -= _BELIEVED_COUNTS
        if case.score <= 0.0:
            del self._cases[landmark_id]

    def reject(self, refused: Iterable[LandmarkFactor], k: int, pose: FloatArray, factors: LandmarkFactors) -> None:
        """Sightings contradicted a prediction that others confirmed.

        Args:
            refused: these sightings.
            k: their keyframe.
            pose: ``(3,)`` predicted.
            factors: of the map.
        """
        for sighting in refused:
            landmark_id = sighting.measurement.landmark_id
            if landmark_id not in self._cases:
                self._cases[landmark_id] = _Record(before=self._fitted.copy())
            case = self._cases[landmark_id]
            if case.held:
                continue
            case.score += 1.0
            case.refused += 1
            place = displacement(sighting, pose, factors)
            if place is not None:
                case.places.append(place)
                case.distances.append(factors.distance(landmark_id, pose))
            moved = case.score >= self._after and self._moved(case)
            case.held = moved and not self._misread(landmark_id, case, factors)

    def _misread(self, landmark_id: int, case: _Record, factors: LandmarkFactors) -> bool:
        """Whether it may be others that are read as this one: it stands where they do, and is seen far less often."""
        moved = np.median(case.places, axis=0)
        others = factors.near(landmark_id, moved, max(_AGREE_M, _AGREE_SHARE * math.hypot(*moved)))
        of_others = sum(self._fitted[i] - case.before[i] for i in others)
        return case.refused < _MISREAD_SHARE * of_others

    def _moved(self, case: _Record) -> bool:
        if len(case.places) < self._after:
            return False
        places = np.array(case.places)
        median = np.median(places, axis=0)
        apart = np.hypot(*(places - median).T)
        moved = math.hypot(*median)
        if moved < _LEAST_M + _LEAST_SHARE * float(np.median(case.distances)):
            return False
        return bool(np.quantile(apart, 0.8) < max(_AGREE_M, _AGREE_SHARE * moved) and moved > np.median(apart))


def displacement(sighting: LandmarkFactor, pose: FloatArray, factors: LandmarkFactors) -> FloatArray | None:
    """How far ``(2,)`` [m] the landmark must have been moved on the map, unturned, to be seen so from this pose.

    Gauss-Newton: moving the landmark one way is moving the robot the other.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    R = np.array([[c, -s], [s, c]])
    moved = np.zeros(2)
    observed, theta = factors.observe([sighting.measurement]), factors.believed.mean
    W: FloatArray | None = None
    for _ in range(_ITERATIONS):
        x, y = pose[:2] - moved
        one = observed.linearize(np.array([x, y, pose[2]]), theta)[0]
        if one.behind:
            return None
        W = factors.whitening(one) if W is None else W
        step = np.linalg.lstsq(W @ one.J[:, :2] @ R.T, W @ one.residual, rcond=None)[0]
        moved = moved + step
    return moved if np.isfinite(moved).all() else None
