"""Pose among beacons: a bounded Gaussian sum over every place that their sightings allow.

One range and bearing leaves the pose free to turn about the beacon. That ring is cut into Gaussians, each with its own
extended Kalman filter and its own weight; later sightings of other beacons decide between them. In exponential
coordinates on the right the ring is a straight line, so that each piece of it is represented exactly.

Three things can be wrong, each with its own prior. A sighting has a wrong id: then it is one of another beacon, or of
nothing in the map. A beacon does not stand where the map has it: then its sightings say nothing of the place, but they
agree with each other, and count as one contradiction, however often it was seen. The robot was carried or pushed: then
it may be anywhere on the ring of the first sighting that the most probable place refuses.

Source: Alspach and Sorenson, "Nonlinear Bayesian estimation using Gaussian sum approximations", IEEE TAC 17(4), 1972;
rotation about a point of the body as a one-parameter subgroup: Solà et al., "A micro Lie theory", 2018.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.config import Config
from fgloc.estimation.landmark_modes import MOST_HYPOTHESES
from fgloc.estimation.pose_fit import MAX_SIGMA
from fgloc.graph.joint import FAR_M2, LINEAR_M, LINEAR_RAD, MOST_JOINT, fuse
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import repetition
from fgloc.sensors.measurements import LandmarkMeasurement, PointMeasurement, points_of
from fgloc.stats import GATE, chi2_bound
from fgloc.types import FloatArray, LandmarkMap, MotionMeasurement

# --- Geometry of ranges and bearings ----------------------------------------------------------------------------------

RING = 24  # pieces of a ring, 15 degrees apart


@dataclass(slots=True, eq=False)
class Track:
    """Position of a beacon in the base frame ``(2,)`` [m], covariance ``(2, 2)``, and number of its sightings."""

    point: FloatArray
    cov: FloatArray
    count: int = 1

    def move(self, motion: FloatArray, cov: FloatArray) -> None:
        """Move by a motion ``(3,)`` of the robot with covariance ``(3, 3)`` (right perturbation)."""
        back = se2.adjoint(se2.inverse(motion))[:2, :2]
        x, y = self.point = back @ (self.point - motion[:2])
        J = np.array([[-1.0, 0.0, y], [0.0, -1.0, -x]])
        self.cov = back @ self.cov @ back.T + J @ cov @ J.T


class SeenBeacons:
    """Positions of beacons in the base frame, each by its own sightings alone, without the map.

    Each has two tracks at most, as sightings with a wrong id, or before the robot was pushed, agree with no others.
    """

    def __init__(self) -> None:
        self._tracks: dict[int, list[Track]] = {}  # the one that agreed last first

    def move(self, motion: FloatArray, cov: FloatArray) -> None:
        """Move the beacons by a motion ``(3,)`` of the robot with covariance ``(3, 3)`` (right perturbation)."""
        for track in (track for tracks in self._tracks.values() for track in tracks):
            track.move(motion, cov)

    def place(self, landmark_id: int) -> FloatArray:
        """Position ``(2,)`` [m] of a beacon in the base frame by the track with most sightings."""
        return max(self._tracks[landmark_id], key=lambda track: track.count).point

    def take(self, m: PointMeasurement, R: FloatArray, least: float) -> float | None:
        """Add a sighting with the covariance ``R``; its log density given those before, None if below the least."""
        tracks = self._tracks.setdefault(m.landmark_id, [])
        for track in tracks:
            residual, by_pose = residuals(np.zeros((1, 3)), track.point, m)
            J = -by_pose[0, :, :2]
            S = J @ track.cov @ J.T + R
            if (density := float(log_density(residual, S[None])[0])) > least:
                gain = track.cov @ J.T @ np.linalg.inv(S)
                track.point, track.cov = track.point + gain @ residual[0], track.cov - gain @ S @ gain.T
                track.count += 1
                tracks.sort(key=lambda other: other is not track)
                return density
        at = _point_by_sighting(m)
        self._tracks[m.landmark_id] = [Track(m.point, at @ R @ at.T), *tracks[:1]]
        return None


def ring(place: FloatArray, m: PointMeasurement, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses ``(n, 3)`` all around a beacon seen so, with covariances that let each reach the next."""
    yaws = np.linspace(-math.pi, math.pi, RING, endpoint=False)
    x, y = m.point
    c, s = np.cos(yaws), np.sin(yaws)
    poses = np.column_stack([place[0] - c * x + s * y, place[1] - s * x - c * y, yaws])
    about = np.array([y, -x, 1.0])  # turning about the point (x, y) of the body
    at = _point_by_sighting(m)
    cov = np.zeros((3, 3))
    cov[:2, :2] = at @ R @ at.T
    cov += np.outer(about, about) * (math.pi / RING) ** 2
    return poses, np.repeat(cov[None], RING, axis=0)


def residuals(poses: FloatArray, place: FloatArray, m: PointMeasurement) -> tuple[FloatArray, FloatArray]:
    """Measured minus predicted bearing and range ``(n, 2)``, and the prediction's Jacobian ``(n, 2, 3)``."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = place[..., 0] - poses[:, 0], place[..., 1] - poses[:, 1]
    x, y = c * dx + s * dy, c * dy - s * dx
    r = np.maximum(np.hypot(x, y), LINEAR_M)
    residual = np.column_stack([se2.wrap_array(m.bearing_rad - np.arctan2(y, x)), m.range_m - r])
    J = np.zeros((len(poses), 2, 3))
    J[:, 0] = np.column_stack([y / r**2, -x / r**2, -np.ones_like(r)])
    J[:, 1] = np.column_stack([-x / r, -y / r, np.zeros_like(r)])
    return residual, J


def _point_by_sighting(m: PointMeasurement) -> FloatArray:
    """Derivative ``(2, 2)`` of a point in the base frame by bearing and range."""
    c, s = math.cos(m.bearing_rad), math.sin(m.bearing_rad)
    return np.array([[-m.range_m * s, c], [m.range_m * c, s]])


def log_density(residual: FloatArray, S: FloatArray) -> FloatArray:
    """Log density ``(n,)`` of sightings with residuals ``(n, 2)`` and covariances ``(n, 2, 2)``."""
    nis = np.einsum("ni,ni->n", residual, np.linalg.solve(S, residual[:, :, None])[:, :, 0])
    return np.asarray(-math.log(2.0 * math.pi) - 0.5 * (nis + np.log(np.linalg.det(S))))


def moments(poses: FloatArray, covs: FloatArray, weights: FloatArray) -> PoseWithCovariance:
    """Mean and covariance of a sum of Gaussians ``(n, 3)``, ``(n, 3, 3)``, ``(n,)``, with what bent rings add."""
    variances, axes = np.linalg.eigh(covs)
    spread = axes * np.sqrt(se2.DOF * np.maximum(variances, 0.0))[:, None, :]
    points = np.stack(
        [
            se2.compose_array(poses, se2.exp_array(sign * spread[:, :, j]))
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


# --- The sum ----------------------------------------------------------------------------------------------------------

# Prior probability that a landmark is not where the map has it, each independently; and that an id is wrong, which is
# learned from then on
WRONG_LANDMARK = 0.05
CARRIED = 1e-3  # prior probability that a robot was carried away when a sighting contradicts its pose
_IN_PLACE, _MOVED = math.log(1.0 - WRONG_LANDMARK), math.log(WRONG_LANDMARK)
_CERTAIN = 0.99  # probability from which the graph begins at a place; and that a robot is among its beacons
_UNIFORM = -math.log(2.0 * math.pi * math.sqrt(FAR_M2))  # log density of a sighting: any bearing [rad] and range [m]
# Log weight below the most probable one's that a hypothesis may yet gain: what carrying costs, and two sightings.
_NEGLIGIBLE = math.log(RING / CARRIED) - 2.0 * math.log(1.0 - GATE)
_AROUND, _LEAST_AROUND_M = 2.0, 2.0  # a robot is where the beacons are: prior sigmas, in theirs, and at least
_SAME = np.array([LINEAR_M, LINEAR_M, LINEAR_RAD])  # two hypotheses this near are one


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """Displacement of a landmark from its place on the map ``(2,)`` [m], and twice the log odds that it was moved."""

    by: FloatArray
    evidence: float


class GaussianSum:
    """Hypotheses of the pose, each a Gaussian with a weight.

    Attributes:
        poses: ``(n, 3)`` ``T_map_base``.
        covs: ``(n, 3, 3)`` of right perturbations.
        places: ``(L, 2)`` of all landmarks in the map.
    """

    def __init__(self, config: Config, landmark_map: LandmarkMap | None) -> None:
        self._config = config.landmarks
        known = list(landmark_map.landmarks.values()) if landmark_map is not None else []
        self._index = {m.landmark_id: k for k, m in enumerate(known)}
        self.places = places = np.array([m.position[:2] for m in known]).reshape(-1, 2)
        self._middle = places.mean(axis=0) if len(places) else np.zeros(2)
        around = np.cov(places.T, bias=True) if len(places) else np.eye(2)
        self._nearness = np.linalg.inv(_AROUND**2 * around + np.eye(2) * _LEAST_AROUND_M**2)
        self.reset()

    def reset(self) -> None:
        """Forget all hypotheses and sightings."""
        self.poses, self.covs = np.zeros((0, 3)), np.zeros((0, 3, 3))
        self._log_prior = np.zeros(0)  # (n,), with what was merged into each
        self._log_elsewhere = 0.0  # log prior of all places but a tracked one
        # Sightings with right ids, and with wrong ones, by the most probable hypothesis; the prior counts as well
        self._ids = np.array([1.0 / WRONG_LANDMARK - 1.0, 1.0])
        self._last_ns: dict[int, int] = {}  # by landmark
        self._rows: dict[int, int] = {}  # of landmarks in what follows
        self._in_place = np.zeros((0, 0))  # (n, L) log likelihood of each one's sightings if it is where the map has it
        self._moved, self._all_misread = np.zeros(0), np.zeros(0)  # (L,) if it is not; if each of them has a wrong id
        self._beacons = SeenBeacons()

    def add(
        self,
        motions: Sequence[MotionMeasurement],
        sightings: Sequence[LandmarkMeasurement],
        tracked: PoseWithCovariance | None = None,
    ) -> None:
        """Predict by the motions of one step and update by its sightings, with bounded work.

        Args:
            motions: over the step.
            sightings: made in it.
            tracked: where the robot is after them if it is where it was estimated to be; of the first step.
        """
        if motions and len(self.poses):
            self._predict(*fuse(motions))
        beacons = [m for m in points_of(sightings) if m.landmark_id in self._index]
        if beacons and tracked is not None and not self.has_seen:
            self.poses, self.covs, self._log_prior = tracked.pose[None].copy(), tracked.cov[None].copy(), np.zeros(1)
            self._in_place, self._log_elsewhere = np.zeros((1, 0)), math.log(CARRIED)
        for m in beacons[:: -(-len(beacons) // MOST_JOINT) or 1]:
            self._take(m)

    @property
    def has_seen(self) -> bool:
        """Whether there was any sighting of a beacon."""
        return bool(self._rows)

    @property
    def log_weights(self) -> FloatArray:
        """Log weights ``(n,)`` of the hypotheses: prior and likelihood of all sightings so far, not normalized."""
        if not len(self.poses):
            return np.zeros(0)
        return np.asarray(self._log_prior + self._by_landmark().sum(1))

    def _by_landmark(self) -> FloatArray:
        """Log likelihood ``(n, L)`` of each landmark's sightings, summed over "in place" and "moved"."""
        return np.logaddexp(_IN_PLACE + self._in_place, _MOVED + self._moved)

    def confirmed(self, tracked: PoseWithCovariance | None = None) -> PoseWithCovariance | None:
        """The most probable hypothesis if it is known well enough, and so probable that it may be taken as known.

        Args:
            tracked: where the robot is estimated to be; then it has to be elsewhere.
        """
        best = self.most_probable()
        if best is None or (np.sqrt(np.diag(best.cov)) > MAX_SIGMA).any():
            return None
        off = np.abs(self.poses - best.pose)
        off[:, 2] = np.abs(se2.wrap_array(off[:, 2]))
        there = (off < MAX_SIGMA).all(1) if tracked is None else (off < MAX_SIGMA).all(1) & self._differs_from(tracked)
        elsewhere = self._log_elsewhere + (_MOVED + self._moved).sum()  # with all landmarks moved
        weights = np.append(self.log_weights, elsewhere)
        weights = np.exp(weights - weights.max())
        return best if weights[:-1][there].sum() > _CERTAIN * weights.sum() else None

    def _differs_from(self, pose: PoseWithCovariance) -> NDArray[np.bool_]:
        """Which hypotheses are not this pose."""
        off = self.poses - pose.pose
        off[:, 2] = se2.wrap_array(off[:, 2])
        covs = [se2.rotate_cov(cov, yaw) for cov, yaw in zip(self.covs, self.poses[:, 2], strict=True)]
        cov = np.array(covs) + se2.rotate_cov(pose.cov, float(pose.pose[2]))
        nis = np.einsum("ni,ni->n", off, np.linalg.solve(cov, off[:, :, None])[:, :, 0])
        return np.asarray(nis > chi2_bound(GATE, se2.DOF))

    def belief(self) -> PoseWithCovariance | None:
        """Mean and covariance of the whole sum, with what the bent rings add; None before the first sighting."""
        if not len(self.poses):
            return None
        weights = np.exp(self.log_weights - self.log_weights.max())
        weights[weights < 1.0 - GATE] = 0.0
        return moments(self.poses, self.covs, weights / weights.sum())

    def most_probable(self) -> PoseWithCovariance | None:
        """The hypothesis with the largest weight; None before the first sighting."""
        if not len(self.poses):
            return None
        best = int(self.log_weights.argmax())
        return PoseWithCovariance(self.poses[best], self.covs[best])

    def displaced(self) -> dict[int, Displacement]:
        """Displacement of each beacon seen, by id, under the most probable hypothesis of the pose."""
        if not len(self.poses):
            return {}
        best = int(self.log_weights.argmax())
        odds = 2.0 * (_MOVED + self._moved - _IN_PLACE - self._in_place[best])
        stands = {i: se2.compose(self.poses[best], [*self._beacons.place(i), 0.0])[:2] for i in self._rows}
        return {i: Displacement(stands[i] - self.places[self._index[i]], odds[row]) for i, row in self._rows.items()}

    def _predict(self, motion: FloatArray, cov: FloatArray) -> None:
        self.poses = se2.compose_array(self.poses, np.broadcast_to(motion, self.poses.shape))
        ad = se2.adjoint(se2.inverse(motion))
        self.covs = ad @ self.covs @ ad.T + cov
        self._beacons.move(motion, cov)

    def _take(self, m: PointMeasurement) -> None:
        R, new = self._cov(m), m.landmark_id not in self._rows
        right, wrong = self._ids
        self._right_id, self._wrong_id = math.log(right / (right + wrong)), math.log(wrong / (right + wrong)) + _UNIFORM
        self._last_ns[m.landmark_id] = m.stamp_ns
        if new:
            self._rows[m.landmark_id] = len(self._rows)
            self._in_place = np.pad(self._in_place, ((0, 0), (0, 1)))
            self._moved, self._all_misread = np.append(self._moved, 0.0), np.append(self._all_misread, 0.0)
        row = self._rows[m.landmark_id]
        rings = [(self._log_elsewhere, self._all_misread.copy())] if new and not self._log_elsewhere else []
        before = self._log_prior, self._by_landmark()
        unexplained = self._anywhere(m, R, row, new)
        if len(self.poses):
            best = int((before[0] + before[1].sum(1)).argmax())
            refused = not self._update(m, R, row)[best]
            self._ids[int(refused and unexplained)] += 1.0
            if refused:  # the robot may have been carried away just now; that each beacon was moved is asked anew
                rings.append((before[0][best] + math.log(CARRIED), before[1][best]))
        for log_prior, in_place in rings:
            self._add_ring(m, R, row, log_prior, in_place)
        self._all_misread[row] += self._wrong_id
        self._prune()

    def _add_ring(self, m: PointMeasurement, R: FloatArray, row: int, log_prior: float, in_place: FloatArray) -> None:
        """Hypotheses all around the beacon of a sighting, with this prior and ``(L,)`` evidence of those before it."""
        poses, covs = ring(self.places[self._index[m.landmark_id]], m, R)
        off = poses[:, :2] - self._middle
        near = np.logaddexp(-0.5 * np.einsum("ni,ij,nj->n", off, self._nearness, off), math.log(1.0 - _CERTAIN))
        self.poses = np.concatenate([self.poses, poses])
        self.covs = np.concatenate([self.covs, covs])
        self._log_prior = np.concatenate([self._log_prior, log_prior + near - math.log(RING)])
        in_place = np.tile(in_place, (len(poses), 1))
        in_place[:, row] += self._right_id + _UNIFORM
        self._in_place = np.concatenate([self._in_place, in_place])

    def _update(self, m: PointMeasurement, R: FloatArray, row: int) -> NDArray[np.bool_]:
        """Kalman update of the hypotheses that accept a sighting ``(n,)``; for the others it is an outlier."""
        residual, J = residuals(self.poses, self.places[self._index[m.landmark_id]], m)
        PJ = self.covs @ J.transpose(0, 2, 1)
        S = J @ PJ + R
        fits, misread = self._right_id + log_density(residual, S), self._misread_density(m, R)
        self._in_place[:, row] += np.maximum(fits, misread)
        good: NDArray[np.bool_] = (fits > misread) & (_IN_PLACE + self._in_place[:, row] > _MOVED + self._moved[row])
        gain = np.linalg.solve(S, PJ.transpose(0, 2, 1)).transpose(0, 2, 1)
        poses = se2.compose_array(self.poses, se2.exp_array(np.einsum("nij,nj->ni", gain, residual)))
        kept = np.eye(3) - gain @ J
        covs = kept @ self.covs @ kept.transpose(0, 2, 1) + gain @ R @ gain.transpose(0, 2, 1)
        self.poses = np.where(good[:, None], poses, self.poses)
        self.covs = np.where(good[:, None, None], covs, self.covs)
        return good

    def _misread_density(self, m: PointMeasurement, R: FloatArray) -> FloatArray:
        """Log likelihood ``(n,)`` of a sighting whose id is wrong: of any other beacon, or of nothing in the map."""
        off = se2.placed(self.poses, m.point)[:, None] - self.places
        distances = np.einsum("nld,nld->nl", off, off)
        distances[:, self._index[m.landmark_id]] = np.inf
        residual, J = residuals(self.poses, self.places[distances.argmin(1)], m)
        density = log_density(residual, J @ self.covs @ J.transpose(0, 2, 1) + R) - math.log(
            max(len(self.places) - 1, 1)
        )
        density[distances.min(1) == np.inf] = -np.inf  # the map has no other
        return np.asarray(self._wrong_id - math.log(2.0) + np.logaddexp(0.0, density - _UNIFORM))

    def _anywhere(self, m: PointMeasurement, R: FloatArray, row: int, new: bool) -> bool:
        """Add the evidence of a beacon that may stand anywhere; whether this sighting contradicts its others."""
        likely = self._beacons.take(m, R, self._wrong_id - self._right_id)
        if likely is not None:
            self._moved[row] += self._right_id + likely
        else:
            self._moved[row] += self._right_id + _UNIFORM if new else self._wrong_id
        return likely is None

    def _cov(self, m: PointMeasurement) -> FloatArray:
        """Covariance ``(2, 2)`` of a sighting with its systematic errors, larger if it soon repeats its landmark."""
        config = self._config
        placed = config.position_sigma_m
        cov = m.cov + np.diag(
            [
                config.bearing_bias_sigma_rad**2 + (placed / max(m.range_m, placed, 1e-9)) ** 2,
                (config.range_scale_sigma * m.range_m) ** 2 + placed**2,
            ]
        )
        return cov * repetition(config.repeat_s, self._last_ns.get(m.landmark_id), m.stamp_ns)

    def _prune(self) -> None:
        """Merge what has become the same, and drop what is negligible."""
        log_weights = self.log_weights
        order = np.argsort(-log_weights)
        order = order[log_weights[order] > log_weights[order[0]] - _NEGLIGIBLE]
        off = np.abs(self.poses[order, None] - self.poses[order])
        off[..., 2] = np.abs(se2.wrap_array(off[..., 2]))
        before = np.tril((off < _SAME).all(-1), -1)  # the more probable ones that each is the same as
        kept = np.ones(len(order), dtype=np.bool_)
        for i in np.flatnonzero(before.any(1)):
            same = np.flatnonzero(before[i] & kept)
            if len(same):
                kept[i], into = False, order[same[0]]
                together = np.logaddexp(log_weights[into], log_weights[order[i]])
                self._log_prior[into] += together - log_weights[into]
                log_weights[into] = together
        best = order[kept][:MOST_HYPOTHESES]
        self.poses, self.covs, self._log_prior = self.poses[best], self.covs[best], self._log_prior[best]
        self._in_place = self._in_place[best]
