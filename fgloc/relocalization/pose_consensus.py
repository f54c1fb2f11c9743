"""A place that sightings agree on, and when it is certain."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.relocalization.pose_fit import REDUNDANT, Fit
from fgloc.types import FloatArray

MAX_SIGMA = np.array([1.0, 1.0, 0.5])  # m, m, rad: a place less certain than this is not one yet
_NEAR = 0.5  # m, rad: as far as a wheel may slip from one fix to the next; farther is another place
# Of sightings of several landmarks a place has to explain more than half, as any other place explains less then: the
# rest have wrong ids, or were moved. One that explains less than this ...
WHOLE_SHARE = 0.8
# ... has to be known better. So has the yaw by positions and ranges alone, which tell it by the motion: over a
# short way their fit has several minima. At 0.1 rad the way is ten times as long as the positions are uncertain.
_SHARP_SIGMA = 0.1  # m, rad


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
    outlier_landmarks: frozenset[int]  # landmarks that it does not explain
    by_sensors: bool = False  # from registered sensors alone ...
    lasting: bool = False  # ... over as long as is collected
    repeated: int = 0  # landmarks that agree in two images or more

    @property
    def certain(self) -> bool:
        """Whether it explains enough, and is known well enough."""
        whole = self.share >= WHOLE_SHARE
        if not (whole or (self.landmarks > 1 and self.share > 0.5)) or self.fit.redundancy < 1:
            return False
        if (self.outlier_landmarks or not whole) and self.redundancy < REDUNDANT:
            return False
        if self.by_sensors and self._sigmas[2] > _SHARP_SIGMA:
            return False
        return bool((self._sigmas <= (MAX_SIGMA if whole else _SHARP_SIGMA)).all())

    @property
    def _sigmas(self) -> FloatArray:
        return np.sqrt(np.diag(self.fit.cov))

    def overrides_prior(self) -> bool:
        """Whether it is evidence that the robot is elsewhere than estimated.

        One landmark alone may have been moved, and two in one image may be misread so that they agree, unless nearly
        everything else agrees with them.
        """
        sharp = bool((self._sigmas <= _SHARP_SIGMA).all())
        whole = sharp and self.share >= WHOLE_SHARE and self.fit.redundancy >= 2 * REDUNDANT
        return self.repeated > 1 or (whole and (self.landmarks > 1 or self.lasting))


def apart(a: FloatArray, b: FloatArray) -> bool:
    """Whether two poses are two places."""
    x, y, yaw = se2.between(a, b)
    return math.hypot(x, y) > _NEAR or abs(yaw) > _NEAR
