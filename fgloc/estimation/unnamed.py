"""Beacons without identity: the predicted pose names each hit, and a constellation of hits tells the first pose.

A hit is named by the nearest beacon, where no other explains it nearly as well; what is in doubt is rejected, as a
wrong name drags the pose along. Once named, a hit is a sighting like any other: the gate, joint compatibility and the
whole-run estimator take the name as it is.

Without a pose, hits are followed in the robot's own frame until they form a constellation: pairs of hits on pairs of
beacons give places, and one that explains enough hits, and more of them than any other place does, is the robot's.

Sources: Bar-Shalom, Fortmann 1988, "Tracking and data association" (nearest neighbour with validation gate); Bailey
2002, "Mobile robot localisation and mapping in extensive outdoor environments", chapter 3 (constellations of features).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.estimation.beacons import CARRIED, WRONG_LANDMARK, Track
from fgloc.estimation.pose_fit import MAX_SIGMA, apart
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.joint import MOST_JOINT, correct, innovation, is_linear, nis_of_each
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.sensors.measurements import PointMeasurement
from fgloc.stats import chi2_bound
from fgloc.types import FloatArray, IntArray, Landmark, LandmarkMap

# --- Names by the predicted pose --------------------------------------------------------------------------------------

UNMATCHED, AMBIGUOUS, OUTNUMBERED = "unmatched", "ambiguous", "outnumbered"  # why a hit gets no name
_SURE = 2.0 * math.log(100.0)  # NIS by which another beacon explains a hit worse: a hundredth as probable
_STRANGE = 0.3  # prior probability that a bright thing is not in the map
_MOST_RIVALS = 12  # beacons within reach of one hit: among more, none is tried
_SLACK_M = 0.5  # beyond the sigmas of the pose, for what the installation may be off


@dataclass(frozen=True, slots=True, eq=False)
class Nameless:
    """A hit that got no name: the least NIS of any beacon (NaN: none is near), and why."""

    hit: PointMeasurement
    nis: float
    reason: str


def contradictions(nameless: Sequence[Nameless]) -> int:
    """Number of named beacons whose contradiction is as probable as that of these hits, if the pose is right.

    Bright things that are not in the map are more common than beacons that were moved.
    """
    strange = sum(one.reason != AMBIGUOUS for one in nameless)
    return int(strange * math.log(_STRANGE) / math.log(WRONG_LANDMARK))


class Naming:
    """Names hits by the beacons of the map."""

    def __init__(self, config: Config, factors: LandmarkFactors) -> None:
        """Take the points of the known map."""
        self._factors = factors
        self._bound = chi2_bound(config.estimator.gate_probability, 2)
        self._ids, self._places = points_of_map(factors.landmarks)

    def name(
        self, hits: Sequence[PointMeasurement], predicted: PoseWithCovariance
    ) -> tuple[list[PointMeasurement], list[Nameless]]:
        """Name each hit that one beacon explains and no other nearly as well; the surest first, which help the others.

        In a scan most of which is not in the map the robot is elsewhere: what fits there fits by accident.

        Args:
            hits: of one step, perhaps of several scans.
            predicted: the pose.
        """
        known = predicted.installation or self._factors.estimated
        belief, left, named = predicted, list(hits), list[PointMeasurement]()
        found = self._explained(left, named, belief, known)
        while left:
            margins = [self._margin(i, left, found) for i in range(len(left))]
            i = int(np.argmax(margins))
            explained = found[i]
            if margins[i] < _SURE or not explained:
                break
            m = next(iter(explained.values()))[1]
            named.append(m)
            del left[i], found[i]
            corrected = correct(belief, known, [m], self._factors) if not is_linear(belief) else None
            if corrected is not None and len(named) < MOST_JOINT:
                belief = corrected[0]
                known = belief.installation or known
                found = self._explained(left, named, belief, known)
            else:
                for own, hit in zip(found, left, strict=True):
                    if hit.scan_ns == m.scan_ns and own:
                        own.pop(m.landmark_id, None)
        nameless = [Nameless(m, *self._refused(explained)) for m, explained in zip(left, found, strict=True)]
        strange = Counter(one.hit.scan_ns for one in nameless if one.reason == UNMATCHED)
        usual = Counter(m.scan_ns for m in named)
        doubted = {scan for scan, n in strange.items() if n >= usual[scan]}
        nameless += [Nameless(m, math.nan, OUTNUMBERED) for m in named if m.scan_ns in doubted]
        return [m for m in named if m.scan_ns not in doubted], nameless

    def _refused(self, explained: Mapping[int, tuple[float, PointMeasurement]] | None) -> tuple[float, str]:
        if explained is None:
            return math.nan, AMBIGUOUS
        nis = min((nis for nis, _ in explained.values()), default=math.nan)
        return nis, AMBIGUOUS if nis <= self._bound else UNMATCHED

    def _margin(self, i: int, hits: Sequence[PointMeasurement], found: Sequence[_Explained | None]) -> float:
        """NIS by which the next explanation of a hit is worse: by another beacon, or of its beacon by another hit."""
        own = found[i]
        if not own:
            return -math.inf
        (landmark_id, (nis, _)), *others = own.items()
        if nis > self._bound:
            return -math.inf
        rivals = [other for _, (other, _) in others[:1]]
        for j, (hit, explained) in enumerate(zip(hits, found, strict=True)):
            if j != i and hit.scan_ns == hits[i].scan_ns and explained and landmark_id in explained:
                rivals.append(explained[landmark_id][0])
        return min(rivals, default=math.inf) - nis

    def _explained(
        self,
        hits: Sequence[PointMeasurement],
        named: Sequence[PointMeasurement],
        belief: PoseWithCovariance,
        known: InstallationEstimate,
    ) -> list[_Explained | None]:
        """For each hit the beacons within reach, best first; None: there are too many."""
        taken = {(m.scan_ns, m.landmark_id) for m in named}
        as_if: list[PointMeasurement] = []
        spans: list[slice | None] = []
        x, y, yaw = np.sqrt(np.diag(belief.cov))
        for m in hits:
            at = se2.compose(belief.pose, (*m.point, 0.0))[:2]
            sigma_m = math.hypot(x, y, m.range_m * yaw, math.sqrt(m.cov[1, 1]), m.range_m * math.sqrt(m.cov[0, 0]))
            reach = math.sqrt(self._bound + _SURE) * sigma_m + _SLACK_M
            near = self._ids[np.hypot(*(self._places - at).T) <= reach].tolist()
            near = [i for i in near if (m.scan_ns, i) not in taken]
            if len(near) > _MOST_RIVALS:
                spans.append(None)
                continue
            spans.append(slice(len(as_if), len(as_if) + len(near)))
            as_if += [replace(m, landmark_id=i) for i in near]
        P = belief.joint_cov(known)
        nis: list[float] = []
        if as_if:
            lines = self._factors.observe(as_if).together(belief.pose, known.mean)
            nis = nis_of_each(innovation(P, lines), lines)
        ranked = [sorted(zip(nis[s], as_if[s], strict=True), key=lambda e: e[0]) if s else None for s in spans]
        return [None if own is None else {m.landmark_id: (n, m) for n, m in own} for own in ranked]


_Explained = dict[int, tuple[float, PointMeasurement]]
"""NIS of a hit as one of each beacon, and that sighting, by the beacon's id, the best first."""


def points_of_map(landmarks: Mapping[int, Landmark]) -> tuple[IntArray, FloatArray]:
    """Ids ``(n,)`` and places ``(n, 2)`` of the landmarks that are points."""
    points = {i: m.position[:2] for i, m in landmarks.items() if m.is_point}
    return np.array(list(points), dtype=np.int64), np.array(list(points.values())).reshape(-1, 2)


# --- The first pose by constellations ---------------------------------------------------------------------------------

_MATURE = 3  # hits from which on a track stands for something that is there
_LEAST_BEACONS = 3  # of a place: two are the same from either side
_CERTAIN = 0.999  # probability of a place from which on it is taken
_AROUND_M = 10.0  # beyond the beacons, where bright things may be seen
_SAME, _LOST_M = (
    chi2_bound(0.999, 2),
    1.0,
)  # a hit is of a track within this NIS; a track less certain than this is none
_MOST_TRACKS, _MOST_PAIRS, _MOST_SEEDS, _MOST_PLACES = 32, 24, 1000, 30
_EVERY_NS = 500_000_000  # a search takes up to 0.1 s among hundreds of beacons


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    pose: FloatArray  # (3,)
    cov: FloatArray  # (3, 3) of the right perturbation
    beacons: int  # that explain a track
    log_weight: float


class Constellations:
    """Tracks of unnamed hits in the robot's frame, and the place on the map that they tell."""

    def __init__(self, config: Config, landmark_map: LandmarkMap | None) -> None:
        """Take the points of the map; None: there is none."""
        self._bound = chi2_bound(config.estimator.gate_probability, 2)
        self._map_variance = config.map.position_sigma_m**2
        _, self._places = points_of_map({} if landmark_map is None else landmark_map.landmarks)
        extent = np.ptp(self._places, axis=0) if len(self._places) else np.zeros(2)
        self._log_area = math.log(float(np.prod(extent + 2.0 * _AROUND_M)))
        self.reset()

    @cached_property
    def _tree(self) -> Any:
        """The beacons by place."""
        from scipy.spatial import cKDTree  # takes a tenth of a second to load, and most runs search nothing

        return cKDTree(self._places)

    def reset(self) -> None:
        """Forget all tracks."""
        self._tracks: list[Track] = []
        self._tried_ns = 0

    def move(self, motion: FloatArray, cov: FloatArray) -> None:
        """Move the tracks by a motion ``(3,)`` of the robot with covariance ``(3, 3)`` (right perturbation)."""
        for track in self._tracks:
            track.move(motion, cov)
        self._tracks = [track for track in self._tracks if track.cov.trace() < _LOST_M**2]

    def take(self, hits: Sequence[PointMeasurement]) -> None:
        """Add the hits of one step; one that may be of two tracks is of none."""
        for m in hits:
            point, R = m.cartesian()
            near = []
            for track in self._tracks:
                off = point - track.point
                if off @ np.linalg.solve(track.cov + R, off) <= _SAME:
                    near.append(track)
            if len(near) == 1:
                (track,) = near
                gain = track.cov @ np.linalg.inv(track.cov + R)
                track.point = track.point + gain @ (point - track.point)
                # Errors repeat from scan to scan: many hits are as good as one
                track.cov = 0.5 * R + (np.eye(2) - gain) @ track.cov
                track.count += 1
                self._tracks.remove(track)
                self._tracks.append(track)
            elif not near:
                self._tracks.append(Track(point, R))
        del self._tracks[:-_MOST_TRACKS]

    def place(self, stamp_ns: int, tracked: bool) -> PoseWithCovariance | None:
        """The robot's place, if the tracks determine one beyond doubt.

        Args:
            stamp_ns: now.
            tracked: the robot has an estimated pose, so that it takes more to find it elsewhere.
        """
        tracks = [track for track in self._tracks if track.count >= _MATURE]
        if not len(self._places) or len(tracks) < _LEAST_BEACONS or 0 <= stamp_ns - self._tried_ns < _EVERY_NS:
            return None
        self._tried_ns = stamp_ns
        points = np.array([track.point for track in tracks])
        covs = np.array([track.cov for track in tracks]) + self._map_variance * np.eye(2)
        places: list[_Place] = []
        for seed in self._seeds(points, covs):
            found = self._fitted(seed, points, covs)
            if found is not None and all(apart(found.pose, other.pose) for other in places):
                places.append(found)
        if not places:
            return None
        places.sort(key=lambda place: -place.log_weight)
        best = places[0]
        strange = len(tracks) * (math.log(_STRANGE) - self._log_area) - (math.log(CARRIED) if tracked else 0.0)
        weights = np.array([*(place.log_weight for place in places), strange])
        weights = np.exp(weights - weights.max())
        rival = max((place.beacons for place in places[1:]), default=0)
        if (
            best.beacons < max(_LEAST_BEACONS, rival + 1)
            or 2 * best.beacons <= len(tracks)
            or (np.sqrt(np.diag(best.cov)) > MAX_SIGMA).any()
            or weights[0] < _CERTAIN * weights.sum()
        ):
            return None
        return PoseWithCovariance(best.pose, best.cov)

    def _seeds(self, points: FloatArray, covs: FloatArray) -> FloatArray:
        """Poses ``(n, 3)`` that put a pair of tracks on a pair of beacons and explain most tracks, best first."""
        sigmas = np.sqrt(np.trace(covs, axis1=1, axis2=2))
        i, j = np.triu_indices(len(points), 1)
        lengths = np.hypot(*(points[j] - points[i]).T)
        known = self._places[None] - self._places[:, None]  # [a, b]: from a to b
        distances = np.hypot(known[..., 0], known[..., 1])
        np.fill_diagonal(distances, -np.inf)
        made = []
        for k in np.argsort(-lengths / (sigmas[i] + sigmas[j]))[:_MOST_PAIRS]:
            if lengths[k] < sigmas[i[k]] + sigmas[j[k]]:
                continue  # it tells no direction
            a, b = np.nonzero(np.abs(distances - lengths[k]) <= 3.0 * (sigmas[i[k]] + sigmas[j[k]]))
            seen = points[j[k]] - points[i[k]]
            yaws = np.arctan2(known[a, b, 1], known[a, b, 0]) - math.atan2(seen[1], seen[0])
            middle = 0.5 * (points[i[k]] + points[j[k]])
            at = 0.5 * (self._places[a] + self._places[b]) - se2.turned(middle, yaws)
            made.append(np.column_stack([at, yaws]))
        poses = np.concatenate(made) if made else np.zeros((0, 3))
        off = self._tree.query(_seen_from(poses, points).reshape(-1, 2))[0].reshape(len(poses), len(points))
        share = off / (3.0 * sigmas)
        costs = np.minimum(share, 2.0).sum(axis=1)
        explained = (share <= 2.0).sum(axis=1)
        order = np.lexsort((costs, -explained))
        order = order[explained[order] >= _LEAST_BEACONS][:_MOST_SEEDS]
        kept: list[FloatArray] = []
        for pose in poses[order]:
            if all(apart(pose, other) for other in kept):
                kept.append(pose)
                if len(kept) == _MOST_PLACES:
                    break
        return np.array(kept).reshape(-1, 3)

    def _fitted(self, seed: FloatArray, points: FloatArray, covs: FloatArray) -> _Place | None:
        """Best pose near a seed, by the tracks that it explains; None: it explains too few."""
        pose, wide = seed, 4.0
        for _ in range(6):
            matched, nis, J, W, r = self._matched(pose, points, covs, wide)
            if len(matched) < _LEAST_BEACONS:
                return None
            A = (W @ J).reshape(-1, 3)
            normal = A.T @ A
            if np.linalg.matrix_rank(normal) < se2.DOF:
                return None
            step = np.linalg.solve(normal, -A.T @ (W @ r[..., None]).reshape(-1))
            pose, wide = se2.compose(pose, se2.exp(np.asarray(step, dtype=np.float64))), 1.0
        matched, nis, J, W, _ = self._matched(pose, points, covs, wide)
        if len(matched) < _LEAST_BEACONS:
            return None
        A = (W @ J).reshape(-1, 3)
        if np.linalg.matrix_rank(A) < se2.DOF:
            return None
        cov = np.linalg.inv(A.T @ A)
        strange = math.log(_STRANGE) - self._log_area
        density = -0.5 * nis - np.log(2.0 * math.pi) - 0.5 * np.linalg.slogdet(covs[matched])[1]
        usual = math.log((1.0 - _STRANGE) / len(self._places)) + density
        weight = np.logaddexp(usual, strange).sum() + strange * (len(points) - len(matched))
        prior = -self._log_area - math.log(2.0 * math.pi)
        volume = 0.5 * float(np.linalg.slogdet(2.0 * math.pi * cov)[1])
        return _Place(pose, 0.5 * (cov + cov.T), len(matched), float(weight) + prior + volume)

    def _matched(
        self, pose: FloatArray, points: FloatArray, covs: FloatArray, wide: float
    ) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Tracks that beacons explain, one for each: rows, NIS, derivatives, whitening matrices and residuals."""
        nearest = self._tree.query(_seen_from(pose[None], points)[0])[1]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        q = (self._places[nearest] - pose[:2]) @ np.array([[c, -s], [s, c]])
        r = q - points
        W = np.linalg.inv(np.linalg.cholesky(covs))
        nis = np.einsum("nij,nj->ni", W, r)
        nis = np.einsum("ni,ni->n", nis, nis)
        best: dict[int, int] = {}
        for k in np.argsort(nis).tolist():
            if nis[k] <= wide * self._bound:
                best.setdefault(int(nearest[k]), k)
        rows = np.array(sorted(best.values()), dtype=np.int64)
        J = np.zeros((len(points), 2, 3))
        J[:, 0, 0] = J[:, 1, 1] = -1.0
        J[:, 0, 2], J[:, 1, 2] = q[:, 1], -q[:, 0]
        return rows, nis[rows], J[rows], W[rows], r[rows]


def _seen_from(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Points ``(m, 2)`` of the base in the map ``(n, m, 2)``, from poses ``(n, 3)``."""
    c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x, y = points.T
    return np.stack([poses[:, 0, None] + c * x - s * y, poses[:, 1, None] + s * x + c * y], axis=-1)
