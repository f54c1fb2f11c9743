"""What the sightings of a whole run say together: how their sensor is off, and which beacon is."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.estimator import Estimator
from fgloc.graph.joint import fuse
from fgloc.graph.measurement_log import LandmarkFactor, PoseWithCovariance
from fgloc.robust.association import Association
from fgloc.robust.moved_landmark_glr import ALARM, MovedLandmark, MovedLandmarkBank
from fgloc.types import Decision, FloatArray, LandmarkMap, MotionMeasurement, RangeBearingMeasurement

_MOST_BEACONS = 500  # one filter each: with more of them a step takes too long
_ASTRAY = 25.0  # squared Mahalanobis distance to the estimate, above which the filters have lost the way: begun anew


class LandmarkFaultMonitor:
    """Listens to the estimator's measurements; accuses a beacon, and takes back what it has done.

    Beacons are landmarks without a size. A marker's corners or pose are precise enough for the gate to refuse a moved
    one: see `fgloc.robust.moved_landmark_votes`.

    """

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, estimator: Estimator, weights: Association
    ) -> None:
        self._bank: MovedLandmarkBank | None = None
        landmarks = () if landmark_map is None else landmark_map.landmarks.values()
        beacons = not any(m.size_m for m in landmarks) and len(landmarks) <= _MOST_BEACONS
        if landmark_map is not None and beacons and config.weights.adaptive:
            self._bank = MovedLandmarkBank(landmark_map, config.landmarks.repeat_s)
        self._estimator, self._association = estimator, weights

    def start(self, prior: PoseWithCovariance, believed: Sequence[LandmarkFactor]) -> None:
        """A first pose, and the sightings at it."""
        self._begin(prior)
        if self._bank is not None:
            self._bank.step(np.zeros(3), np.zeros((3, 3)), self._beacons(believed))

    def observe(
        self,
        k: int,
        stamp_ns: int,
        motions: Sequence[MotionMeasurement],
        believed: Sequence[LandmarkFactor],
        refused: Sequence[LandmarkFactor],
    ) -> list[Decision]:
        """Take in what the estimator was given for its newest keyframe; say whom that accuses.

        The accused goes to quarantine, and the estimate to where it is without it.
        """
        motion, cov = fuse(motions)
        if self._bank is None:
            return []
        beacons = self._beacons([*believed, *refused])
        self._bank.step(motion, cov, beacons)
        if believed and self._astray(self._estimator.log.keyframes[k].belief):
            self._begin(self._estimator.log.keyframes[k].belief)
        accused = self._bank.accused if beacons else None
        return [] if accused is None else [self._remove(k, stamp_ns, accused)]

    def _beacons(self, sightings: Sequence[LandmarkFactor]) -> list[RangeBearingMeasurement]:
        """Those that may say something: neither the start nor what is known already speaks against them."""
        return [
            s.alone
            for s in sightings
            if isinstance(s.alone, RangeBearingMeasurement)
            and not self._association.exclusion.excludes(s.alone.landmark_id)
            and (s.alone.stamp_ns, s.alone.landmark_id) not in self._association.outliers
        ]

    def _begin(self, belief: PoseWithCovariance) -> None:
        if self._bank is None:
            return
        value, cov = np.zeros(2), np.zeros((5, 5))
        cov[:3, :3] = belief.cov
        installation, known = self._estimator.installation, self._estimator.installed
        if "sightings" in installation.blocks:
            first = installation.blocks["sightings"][0]
            value, cov[3:, 3:] = known.mean[first : first + 2], known.cov[first : first + 2, first : first + 2]
        self._bank.start(belief.pose, value, cov)

    def _astray(self, belief: PoseWithCovariance) -> bool:
        assert self._bank is not None
        pose, cov = self._bank.belief
        miss: FloatArray = se2.log(se2.between(belief.pose, pose))
        return float(miss @ np.linalg.solve(belief.cov + cov, miss)) > _ASTRAY

    def _remove(self, k: int, stamp_ns: int, accused: MovedLandmark) -> Decision:
        assert self._bank is not None
        self._association.exclusion.exclude(accused.landmark_id, accused.displacement)
        self._estimator.correct(PoseWithCovariance(accused.pose, accused.cov[:3, :3]), accused.landmark_id)
        self._bank.start(accused.pose, accused.calibration, accused.cov)
        nis = accused.evidence
        return Decision(k, stamp_ns, "place", accused.landmark_id, math.sqrt(nis), nis, 2, 1.0, "landmark_moved", ALARM)
