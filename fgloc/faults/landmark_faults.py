"""What the sightings of a whole run say together: how their sensor is off, and which beacon is."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.estimator import Estimator
from fgloc.graph.gating import Weights
from fgloc.graph.joint import fuse
from fgloc.graph.measurement_log import Belief, Sighting
from fgloc.graph.moved_landmark_glr import Accusation, Suspects
from fgloc.types import Decision, FloatArray, LandmarkMap, MotionMeasurement, RangeBearingMeasurement

_MOST_BEACONS = 500  # one filter each: with more of them a step takes too long
_ASTRAY = 25.0  # squared Mahalanobis distance to the estimate, above which the filters have lost the way: begun anew


class Suspicion:
    """Listens to the estimator's measurements; accuses a beacon, and takes back what it has done.

    Beacons are landmarks without a size. A marker's corners or pose are precise enough for the gate to refuse a moved
    one: see `fgloc.graph.moved_landmark_votes`.

    """

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, estimator: Estimator, weights: Weights
    ) -> None:
        self._suspects: Suspects | None = None
        landmarks = () if landmark_map is None else landmark_map.landmarks.values()
        beacons = not any(m.size_m for m in landmarks) and len(landmarks) <= _MOST_BEACONS
        if landmark_map is not None and beacons and config.weights.adaptive:
            self._suspects = Suspects(landmark_map, config.landmarks.repeat_s)
        self._estimator, self._weights = estimator, weights

    def start(self, prior: Belief, believed: Sequence[Sighting]) -> None:
        """A first pose, and the sightings at it."""
        self._begin(prior)
        if self._suspects is not None:
            self._suspects.step(np.zeros(3), np.zeros((3, 3)), self._beacons(believed))

    def look(
        self,
        k: int,
        stamp_ns: int,
        motions: Sequence[MotionMeasurement],
        believed: Sequence[Sighting],
        refused: Sequence[Sighting],
    ) -> list[Decision]:
        """Take in what the estimator was given for its newest keyframe; say whom that accuses.

        The accused goes to quarantine, and the estimate to where it is without it.
        """
        motion, cov = fuse(motions)
        if self._suspects is None:
            return []
        beacons = self._beacons([*believed, *refused])
        self._suspects.step(motion, cov, beacons)
        if believed and self._astray(self._estimator.log.keyframes[k].belief):
            self._begin(self._estimator.log.keyframes[k].belief)
        accused = self._suspects.accused if beacons else None
        return [] if accused is None else [self._convict(k, stamp_ns, accused)]

    def _beacons(self, sightings: Sequence[Sighting]) -> list[RangeBearingMeasurement]:
        """Those that may say something: neither the start nor what is known already speaks against them."""
        return [
            s.alone
            for s in sightings
            if isinstance(s.alone, RangeBearingMeasurement)
            and not self._weights.quarantine.holds(s.alone.landmark_id)
            and (s.alone.stamp_ns, s.alone.landmark_id) not in self._weights.contrary
        ]

    def _begin(self, belief: Belief) -> None:
        if self._suspects is None:
            return
        value, cov = np.zeros(2), np.zeros((5, 5))
        cov[:3, :3] = belief.cov
        installation, known = self._estimator.installation, self._estimator.installed
        if "sightings" in installation.blocks:
            first = installation.blocks["sightings"][0]
            value, cov[3:, 3:] = known.mean[first : first + 2], known.cov[first : first + 2, first : first + 2]
        self._suspects.start(belief.pose, value, cov)

    def _astray(self, belief: Belief) -> bool:
        assert self._suspects is not None
        pose, cov = self._suspects.belief
        miss: FloatArray = se2.log(se2.between(belief.pose, pose))
        return float(miss @ np.linalg.solve(belief.cov + cov, miss)) > _ASTRAY

    def _convict(self, k: int, stamp_ns: int, accused: Accusation) -> Decision:
        assert self._suspects is not None
        self._weights.quarantine.accuse(accused.landmark_id, accused.displacement)
        self._estimator.correct(Belief(accused.pose, accused.cov[:3, :3]), accused.landmark_id)
        self._suspects.start(accused.pose, accused.calibration, accused.cov)
        nis = accused.evidence
        return Decision(k, stamp_ns, "place", accused.landmark_id, math.sqrt(nis), nis, 2, 1.0, "landmark_moved")
