"""Beacons that stand a little off their place: found by what all sightings say together, the believed ones too.

One sighting is too coarse to show that a beacon was moved by less than a metre: it passes the gate and pulls the
estimate. Here every beacon in turn is supposed to have been moved, in a filter that holds its displacement as a
variable. The one whose displacement makes all that is seen much more likely than any other's does is accused; those
that only look moved because the pose was dragged along are not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.graph.planar_batch import cartesian
from fgloc.types import FloatArray, IntArray, LandmarkMap, RangeBearingMeasurement

_MOVED_SIGMA_M = 0.4  # of a displacement, on each axis; the gate finds what was moved by metres
_MISREAD = 16.0  # squared whitened residual above which a sighting moves nothing: its id is wrong, say
_CAUCHY = 4.0  # squared constant of the kernel: of misread sightings it takes many to accuse
ALARM = 24.0  # twice the logarithm of how much more likely all is if this beacon was moved ...
_MARGIN = 7.0  # ... and more than if another one was
_LEAST_M, _MOST_M = 0.2, 1.5  # of a displacement, beyond twice its own sigma
_LEAST_SIGHTINGS, _LEAST_SHARE = 6, 0.6  # explained by the displacement: how many, and of all those of the accused ...
_LEAST_OF_OTHERS, _NEAR_M = 0.15, 1.0  # ... and as a share of those of what stands near there, which may be misread
_CLEARED = -12.0  # with less evidence than this a beacon is looked at anew, as it may be moved from now on


@dataclass(frozen=True, slots=True, eq=False)
class MovedLandmark:
    """A beacon that was moved, and what is known if it was.

    Attributes:
        landmark_id: the beacon.
        displacement: ``(2,)`` [m] in the map.
        evidence: twice the logarithm of the likelihood ratio.
        pose: ``(3,)`` of the robot.
        calibration: ``(2,)`` log range scale, bearing offset.
        cov: ``(5, 5)`` of pose (right perturbation) and calibration.
    """

    landmark_id: int
    displacement: FloatArray
    evidence: float
    pose: FloatArray
    calibration: FloatArray
    cov: FloatArray


class MovedLandmarkBank:
    """Extended Kalman filters over pose, calibration and the displacement of one beacon each; the first one has none.

    Errors of one beacon's sightings are correlated over ``repeat_s``: those closer in time share their information.

    Source: generalised likelihood ratio test (Willsky and Jones 1976, "A generalized likelihood ratio approach to the
    detection and estimation of jumps in linear systems"), with a Gaussian prior on the jump.
    """

    def __init__(self, landmark_map: LandmarkMap, repeat_s: float) -> None:
        self._ids = sorted(landmark_map.landmarks)
        self._row = {landmark_id: n for n, landmark_id in enumerate(self._ids, 1)}
        self._places = {i: landmark.position[:2] for i, landmark in landmark_map.landmarks.items()}
        self._repeat_s = repeat_s
        self._last_ns: dict[int, int] = {}
        n = len(self._ids) + 1
        self._pose, self._calibration, self._moved = np.zeros((n, 3)), np.zeros((n, 2)), np.zeros((n, 2))
        self._cov = np.zeros((n, 7, 7))
        self._misfit = np.zeros(n)  # minus twice the logarithm of the likelihood
        self._seen = np.zeros((n, n))  # sightings of every beacon since this one is suspected ...
        self._explained = np.zeros(n)  # ... and those of itself that its displacement explains

    def start(self, pose: FloatArray, calibration: FloatArray, cov: FloatArray) -> None:
        """Suspect nobody: everything is as `MovedLandmark` has it."""
        self._pose[:], self._calibration[:], self._cov[0] = pose, calibration, 0.0
        self._cov[0, :5, :5] = cov
        self._misfit[:] = 0.0
        self._suspect_anew(np.arange(1, len(self._pose)))

    @property
    def belief(self) -> tuple[FloatArray, FloatArray]:
        """Pose ``(3,)`` and covariance ``(3, 3)`` if no beacon was moved."""
        return self._pose[0], self._cov[0, :3, :3]

    def step(self, motion: FloatArray, cov: FloatArray, sightings: Sequence[RangeBearingMeasurement]) -> None:
        """Move, then take in sightings: before calibration, and none whose information is shared already."""
        F = np.eye(7)
        F[:3, :3] = se2.adjoint(se2.inverse(motion))
        self._add(np.broadcast_to(motion, self._pose.shape))
        self._cov = F @ self._cov @ F.T
        self._cov[:, :3, :3] += cov
        for m in sightings:
            self._see(m)
        cleared = np.flatnonzero(self._misfit[0] - self._misfit < _CLEARED)
        if len(cleared):
            self._suspect_anew(cleared)

    def _suspect_anew(self, rows: IntArray) -> None:
        self._pose[rows], self._calibration[rows], self._moved[rows] = self._pose[0], self._calibration[0], 0.0
        self._cov[rows], self._misfit[rows] = self._cov[0], self._misfit[0]
        self._cov[rows, 5, 5] = self._cov[rows, 6, 6] = _MOVED_SIGMA_M**2
        self._seen[rows], self._explained[rows] = 0.0, 0.0

    def _add(self, step: FloatArray) -> None:
        """Compose each pose with a motion ``(n, 3)`` in its own frame."""
        c, s = np.cos(self._pose[:, 2]), np.sin(self._pose[:, 2])
        self._pose[:, 0] += c * step[:, 0] - s * step[:, 1]
        self._pose[:, 1] += s * step[:, 0] + c * step[:, 1]
        self._pose[:, 2] += step[:, 2]

    def _see(self, m: RangeBearingMeasurement) -> None:
        row, n = self._row[m.landmark_id], len(self._pose)
        # 1. The beacon as a point in the base frame: seen, and expected; one filter has it elsewhere than the others
        distance = m.range_m * np.exp(self._calibration[:, 0])
        bearing = m.bearing_rad - self._calibration[:, 1]
        seen = distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        place = np.tile(self._places[m.landmark_id], (n, 1))
        place[row] += self._moved[row]
        arm = place - self._pose[:, :2]
        c, s = np.cos(self._pose[:, 2]), np.sin(self._pose[:, 2])
        expected = np.stack([c * arm[:, 0] + s * arm[:, 1], c * arm[:, 1] - s * arm[:, 0]], axis=1)
        residual = seen - expected
        # 2. Derivative of their difference
        H = np.zeros((n, 2, 7))
        H[:, 0, 0] = H[:, 1, 1] = -1.0
        H[:, 0, 2], H[:, 1, 2] = expected[:, 1], -expected[:, 0]
        H[:, :, 3] = -seen
        H[:, 0, 4], H[:, 1, 4] = -seen[:, 1], seen[:, 0]
        H[row, :, 5:] = [[c[row], s[row]], [-s[row], c[row]]]
        # 3. Weigh, and correct those that can explain it
        PH = self._cov @ H.transpose(0, 2, 1)
        S = H @ PH + cartesian(m)[1] * self._shared(m)
        inverse, det = _inverse(S)
        nis = np.einsum("ni,nij,nj->n", residual, inverse, residual)
        explains = nis < _MISREAD
        self._misfit += _CAUCHY * np.log1p(nis / _CAUCHY) + np.log(det)
        self._seen[:, row] += 1.0
        self._explained[row] += explains[row]
        K = PH @ inverse * explains[:, None, None]
        correction = np.einsum("nij,nj->ni", K, residual)
        self._add(correction[:, :3])
        self._calibration += correction[:, 3:5]
        self._moved += correction[:, 5:]
        cov = self._cov - K @ PH.transpose(0, 2, 1)
        self._cov = 0.5 * (cov + cov.transpose(0, 2, 1))

    def _shared(self, m: RangeBearingMeasurement) -> float:
        """Scale on the covariance of a sighting that follows the last of its beacon."""
        last = self._last_ns.get(m.landmark_id)
        self._last_ns[m.landmark_id] = m.stamp_ns
        return 1.0 if last is None else max(1.0, self._repeat_s / max(abs(m.stamp_ns - last) * 1e-9, 0.01))

    @property
    def accused(self) -> MovedLandmark | None:
        """The beacon that was moved, if one was and there is no doubt which."""
        evidence = self._misfit[0] - self._misfit[1:]
        if len(evidence) < 2:
            return None
        second, best = np.partition(evidence, -2)[-2:]
        row = int(np.argmax(evidence)) + 1
        if best < ALARM or best < second + _MARGIN:
            return None
        moved = self._moved[row]
        far = math.hypot(*moved)
        if not _LEAST_M < far < _MOST_M or self._misread(row):
            return None
        sigma = math.sqrt(float(moved @ self._cov[row, 5:, 5:] @ moved)) / far
        if far < _LEAST_M + 2.0 * sigma:
            return None
        cov = self._cov[row, :5, :5].copy()
        pose, calibration = self._pose[row].copy(), self._calibration[row].copy()
        pose[2] = se2.wrap(float(pose[2]))
        return MovedLandmark(self._ids[row - 1], moved.copy(), float(best), pose, calibration, cov)

    def _misread(self, row: int) -> bool:
        """Whether others may have been read as this one: seldom, and where they stand."""
        places = np.array([self._places[i] for i in self._ids])
        apart = np.hypot(*(places - places[row - 1] - self._moved[row]).T)
        apart[row - 1] = math.inf
        of_others = self._seen[row, 1:][apart < _NEAR_M].sum()
        least = max(_LEAST_SIGHTINGS, _LEAST_SHARE * self._seen[row, row], _LEAST_OF_OTHERS * of_others)
        return bool(self._explained[row] < least)


def _inverse(S: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverses ``(n, 2, 2)`` and determinants ``(n,)`` of symmetric matrices ``(n, 2, 2)``."""
    a, b, d = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    det = a * d - b * b
    return np.stack([d, -b, -b, a], axis=1).reshape(-1, 2, 2) / det[:, None, None], det
