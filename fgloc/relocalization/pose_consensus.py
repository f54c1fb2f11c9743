"""A place that sightings agree on, and when it is certain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.relocalization.pose_fit import Fit
from fgloc.types import FloatArray

MAX_COST_PER_DOF = 4.0
MAX_SIGMA = np.array([1.0, 1.0, 0.5])  # m, m, rad: a place less certain than this is not one yet
_SHARP = 0.4  # times that, of a place that one moved beacon could produce
_SAME_PLACE = np.array([0.3, 0.3, 0.35])  # candidates nearer than this are one place
_LEAST_SHARE = {
    1: 0.8,
    2: 0.6,
}  # of the sightings that a place has to explain, by the number of landmarks they are of ...
_LEAST_SHARE_OF_MANY = 0.52  # ... and of three or more: the rest have wrong ids, or were moved
_WHOLE_SHARE = 0.8  # a place that explains less takes a better fit, and has to be known better:
_PARTIAL_COST_PER_DOF = 1.5
_PARTIAL_SIGMA = np.array([0.1, 0.1, 0.1])  # m, m, rad
# Positions and ranges tell the yaw by the motion alone: over a short way their fit has several minima, and the sigma of
# one of them constrains the pose little. At 0.1 rad the way is ten times as long as the positions are uncertain.
_SENSORS_SIGMA = np.array([1.0, 1.0, 0.1])  # m, m, rad
REDUNDANT = 3  # of what agrees where something else does not: two markers, but three beacons

SightingKey = tuple[int, int]
"""Stamp [ns] and landmark of a sighting."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseConsensus:
    """A place, fitted to the sightings that it explains: their share of all, and of how many landmarks they are.

    The share is of the information, because of what was carried far any place explains anything; that of a landmark
    alone is of the number.
    """

    fit: Fit
    share: float
    landmarks: int
    redundancy: int  # residuals more than a pose has coordinates, each landmark counted once
    agreeing: frozenset[int]  # landmarks that it explains ...
    outlier_landmarks: frozenset[int]  # ... and those that it does not
    outliers: frozenset[SightingKey]  # sightings that it does not
    by_sensors: bool = False  # from registered sensors alone ...
    lasting: bool = False  # ... over as long as is collected

    @property
    def certain(self) -> bool:
        """Whether it explains enough, well enough, and is known well enough."""
        if self.share < _LEAST_SHARE.get(self.landmarks, _LEAST_SHARE_OF_MANY) or self.fit.dof < 4:
            return False
        whole = self.share >= _WHOLE_SHARE
        if (self.outlier_landmarks or not whole) and self.redundancy < REDUNDANT:
            return False
        cost, sigma = (MAX_COST_PER_DOF, MAX_SIGMA) if whole else (_PARTIAL_COST_PER_DOF, _PARTIAL_SIGMA)
        if self.by_sensors:
            sigma = np.minimum(sigma, _SENSORS_SIGMA)
        return bool(self.fit.cost <= cost * self.fit.dof and (np.sqrt(np.diag(self.fit.cov)) <= sigma).all())

    @property
    def well_determined(self) -> bool:
        """Whether it is known well enough to be a place although nothing checks it."""
        return bool((np.sqrt(np.diag(self.fit.cov)) <= _SHARP * MAX_SIGMA).all())

    @property
    def overrides_prior(self) -> bool:
        """Whether it is evidence that the robot is not where it was estimated to be."""
        known = bool((np.sqrt(np.diag(self.fit.cov)) <= _PARTIAL_SIGMA).all())
        checked = self.landmarks > 1 or self.lasting
        return known and self.share >= _WHOLE_SHARE and checked and self.fit.redundancy >= 2 * REDUNDANT


def apart(a: FloatArray, b: FloatArray) -> bool:
    """Whether two poses are two places."""
    return bool((np.abs(se2.log(se2.between(a, b))) > _SAME_PLACE).any())
