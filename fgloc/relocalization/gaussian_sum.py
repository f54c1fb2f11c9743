"""The pose before it is confirmed: a bounded Gaussian sum over every place that the sightings of beacons allow.

One range and bearing leaves the pose free to turn about the beacon. That ring is cut into Gaussians, each with its own
extended Kalman filter and its own weight; later sightings of other beacons decide between them. In exponential
coordinates on the right the ring is a straight line, so that each piece of it is represented exactly.

Source: Alspach and Sorenson, "Nonlinear Bayesian estimation using Gaussian sum approximations", IEEE TAC 17(4), 1972;
rotation about a point of the body as a one-parameter subgroup: Solà et al., "A micro Lie theory", 2018.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.joint import FAR_M2, LINEAR_M, LINEAR_RAD, MOST_JOINT, fuse
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise_models import repetition
from fgloc.robust.landmark_modes import MOST_HYPOTHESES
from fgloc.stats import GATE
from fgloc.types import FloatArray, LandmarkMap, LandmarkMeasurement, MotionMeasurement, PointMeasurement

_RING = 24  # pieces of a ring, 15 degrees apart
OUTLIER = 0.02  # share of sightings with a wrong id, or of a beacon that was moved ...
_UNIFORM = 1.0 / (2.0 * math.pi * math.sqrt(FAR_M2))  # ... seen in any direction [1/rad], as far as that [1/m]
_NEGLIGIBLE = -math.log(1.0 - GATE)  # in log weight, below that of the most probable
_AROUND, _LEAST_AROUND_M = 2.0, 2.0  # a robot is where the beacons are: prior sigmas, in theirs, and at least
_SAME = np.array([LINEAR_M, LINEAR_M, LINEAR_RAD])  # two hypotheses this near are one


class GaussianSum:
    """Hypotheses of the pose, each a Gaussian with a weight.

    Attributes:
        poses: ``(n, 3)`` ``T_map_base``.
        covs: ``(n, 3, 3)`` of right perturbations.
        log_weights: ``(n,)`` of the likelihood of all sightings so far, not normalized.
    """

    def __init__(self, config: Config, landmark_map: LandmarkMap | None) -> None:
        self._config = config.landmarks
        known = landmark_map.landmarks.values() if landmark_map is not None else ()
        self._places = {m.landmark_id: m.position[:2] for m in known}
        places = np.array(list(self._places.values())).reshape(-1, 2)
        self._middle = places.mean(axis=0) if len(places) else np.zeros(2)
        around = np.cov(places.T, bias=True) if len(places) else np.eye(2)
        self._nearness = np.linalg.inv(_AROUND**2 * around + np.eye(2) * _LEAST_AROUND_M**2)
        self.reset()

    def reset(self) -> None:
        """Nothing is known of the pose."""
        self.poses, self.covs, self.log_weights = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)
        self._last_ns: dict[int, int] = {}  # by landmark
        self._none = 0.0  # log likelihood of all sightings if all of them are outliers

    def add(self, motions: Sequence[MotionMeasurement], sightings: Sequence[LandmarkMeasurement]) -> None:
        """Take in one step. The work is bounded: so many hypotheses, so many sightings."""
        if len(self.poses) and motions:
            self._predict(*fuse(motions))
        beacons = [m for m in sightings if isinstance(m, PointMeasurement) and m.landmark_id in self._places]
        for m in beacons[:: -(-len(beacons) // MOST_JOINT) or 1]:
            self._take(m)

    def belief(self) -> PoseWithCovariance | None:
        """Mean and covariance of the whole sum, with what the bent rings add; None before the first sighting."""
        if not len(self.poses):
            return None
        weights = np.exp(self.log_weights - self.log_weights.max())
        weights /= weights.sum()
        variances, axes = np.linalg.eigh(self.covs)
        spread = axes * np.sqrt(se2.DOF * np.maximum(variances, 0.0))[:, None, :]
        points = np.stack(
            [
                se2.compose_array(self.poses, se2.exp_array(sign * spread[:, :, j]))
                for j in range(se2.DOF)
                for sign in (-1.0, 1.0)
            ],
            1,
        )
        share = np.repeat(weights / (2 * se2.DOF), 2 * se2.DOF)
        x, y, yaw = points.reshape(-1, 3).T
        middle = math.atan2(float(share @ np.sin(yaw)), float(share @ np.cos(yaw)))
        mean = np.array([share @ x, share @ y, middle])
        off = np.column_stack([x - mean[0], y - mean[1], se2.wrap_array(yaw - middle)])
        mean[2] = se2.wrap(middle + float(share @ off[:, 2]))
        off[:, 2] -= share @ off[:, 2]
        return PoseWithCovariance(mean, se2.rotate_cov((off * share[:, None]).T @ off, -float(mean[2])))

    def most_probable(self) -> PoseWithCovariance | None:
        """The hypothesis with the largest weight; None before the first sighting."""
        if not len(self.poses):
            return None
        best = int(self.log_weights.argmax())
        return PoseWithCovariance(self.poses[best], self.covs[best])

    def _predict(self, motion: FloatArray, cov: FloatArray) -> None:
        self.poses = se2.compose_array(self.poses, np.broadcast_to(motion, self.poses.shape))
        ad = se2.adjoint(se2.inverse(motion))
        self.covs = ad @ self.covs @ ad.T + cov

    def _take(self, m: PointMeasurement) -> None:
        R = self._cov(m)
        seen_before = m.landmark_id in self._last_ns
        self._last_ns[m.landmark_id] = m.stamp_ns
        outlier = math.log(OUTLIER * _UNIFORM)
        if len(self.poses):
            self._update(m, R, outlier)
        if not seen_before:  # and everything before it may have been wrong
            poses, covs = _ring(self._places[m.landmark_id], m, R)
            off = poses[:, :2] - self._middle
            near = -0.5 * np.einsum("ni,ij,nj->n", off, self._nearness, off)
            born = near + self._none + math.log((1.0 - OUTLIER) * _UNIFORM / _RING)
            self.poses = np.concatenate([self.poses, poses])
            self.covs = np.concatenate([self.covs, covs])
            self.log_weights = np.concatenate([self.log_weights, born])
        self._none += outlier
        self._prune()

    def _update(self, m: PointMeasurement, R: FloatArray, outlier: float) -> None:
        """Kalman's update of each hypothesis that the sighting suits; for the others it is an outlier."""
        residual, J = _residuals(self.poses, self._places[m.landmark_id], m)
        PJ = self.covs @ J.transpose(0, 2, 1)
        S = J @ PJ + R
        weighed = np.linalg.solve(S, residual[:, :, None])[:, :, 0]
        nis = np.einsum("ni,ni->n", residual, weighed)
        fits = math.log((1.0 - OUTLIER) / (2.0 * math.pi)) - 0.5 * (nis + np.log(np.linalg.det(S)))
        good = fits > outlier
        gain = np.linalg.solve(S, PJ.transpose(0, 2, 1)).transpose(0, 2, 1)
        poses = se2.compose_array(self.poses, se2.exp_array(np.einsum("nij,nj->ni", gain, residual)))
        kept = np.eye(3) - gain @ J
        covs = kept @ self.covs @ kept.transpose(0, 2, 1) + gain @ R @ gain.transpose(0, 2, 1)
        self.poses = np.where(good[:, None], poses, self.poses)
        self.covs = np.where(good[:, None, None], covs, self.covs)
        self.log_weights = self.log_weights + np.maximum(fits, outlier)

    def _cov(self, m: PointMeasurement) -> FloatArray:
        """Of the sighting: with the errors that it shares with the last one of its landmark, and with all others."""
        config = self._config
        cov = m.cov + np.diag([config.bearing_bias_sigma_rad**2, (config.range_scale_sigma * m.range_m) ** 2])
        return cov * repetition(config.repeat_s, self._last_ns.get(m.landmark_id), m.stamp_ns)

    def _prune(self) -> None:
        """Merge what has become the same, and drop what is negligible."""
        order = np.argsort(-self.log_weights)
        order = order[self.log_weights[order] > self.log_weights[order[0]] - _NEGLIGIBLE]
        kept: list[int] = []
        weights = self.log_weights.copy()
        poses = self.poses
        for i in order:
            if kept:
                off = np.abs(poses[kept] - poses[i])
                off[:, 2] = np.abs(se2.wrap_array(poses[kept][:, 2] - poses[i, 2]))
                same = np.flatnonzero((off < _SAME).all(axis=1))
                if len(same):
                    weights[kept[same[0]]] = np.logaddexp(weights[kept[same[0]]], weights[i])
                    continue
            if len(kept) < MOST_HYPOTHESES:
                kept.append(int(i))
        self.poses, self.covs, self.log_weights = poses[kept], self.covs[kept], weights[kept]


def _ring(place: FloatArray, m: PointMeasurement, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses ``(n, 3)`` all around a beacon seen so, with covariances that let each reach the next."""
    yaws = np.linspace(-math.pi, math.pi, _RING, endpoint=False)
    x, y = m.range_m * math.cos(m.bearing_rad), m.range_m * math.sin(m.bearing_rad)
    c, s = np.cos(yaws), np.sin(yaws)
    poses = np.column_stack([place[0] - c * x + s * y, place[1] - s * x - c * y, yaws])
    about = np.array([y, -x, 1.0])  # turning about the point (x, y) of the body
    J = np.array([[-y / m.range_m**2, x / m.range_m**2], [x / m.range_m, y / m.range_m]])
    at = np.linalg.inv(J)  # of the point by bearing and range
    cov = np.zeros((3, 3))
    cov[:2, :2] = at @ R @ at.T
    cov += np.outer(about, about) * (math.pi / _RING) ** 2
    return poses, np.repeat(cov[None], _RING, axis=0)


def _residuals(poses: FloatArray, place: FloatArray, m: PointMeasurement) -> tuple[FloatArray, FloatArray]:
    """Measured minus predicted bearing and range ``(n, 2)``, and the prediction's Jacobian ``(n, 2, 3)``."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = place[0] - poses[:, 0], place[1] - poses[:, 1]
    x, y = c * dx + s * dy, c * dy - s * dx
    r = np.maximum(np.hypot(x, y), LINEAR_M)
    residual = np.column_stack([se2.wrap_array(m.bearing_rad - np.arctan2(y, x)), m.range_m - r])
    J = np.zeros((len(poses), 2, 3))
    J[:, 0] = np.column_stack([y / r**2, -x / r**2, -np.ones_like(r)])
    J[:, 1] = np.column_stack([-x / r, -y / r, np.zeros_like(r)])
    return residual, J
