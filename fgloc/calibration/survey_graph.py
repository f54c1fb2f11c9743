"""The graph of a survey: trajectories of all drives, poses of the markers, and the rest of the installation."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgloc.calibration.drives import Drive
from fgloc.calibration.mirrored import mirrored, moved_by
from fgloc.config import Config
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import Installation, InstallationEstimate, installation_of
from fgloc.graph.measurement_log import Keyframe, LandmarkFactor, MeasurementLog, PoseWithCovariance
from fgloc.types import FloatArray, Landmark, LandmarkMap, PixelMeasurement

_WIDE_M, _WIDE_RAD = 0.5, 0.5  # sigmas of an unknown marker: next to nothing is known of it
_FREE = np.diag(np.square([10.0, 10.0, 3.0]))  # of the first pose of a drive that finds itself by the markers
_ORIGIN = np.diag(np.square([1e-4, 1e-4, 1e-5]))  # of the one that is the map's origin
_ROUNDS = 6
_MOST_VIEWS = 100  # of a marker that decide which way round it is ...
_DECIDED = 12.0  # ... if they are by this much likelier one way (twice the log of the likelihood)
_STILL_M, _STILL_RAD = 1e-3, 5e-3  # markers that move less were linearized well


@dataclass(frozen=True, slots=True)
class Distance:
    """A distance that was measured between the middles of two markers."""

    first: int
    second: int
    metres: float
    sigma_m: float = 0.002

    def of(self, landmarks: Mapping[int, Landmark]) -> float:
        """As these landmarks have it [m]."""
        return float(np.linalg.norm(landmarks[self.second].position - landmarks[self.first].position))


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """A drive in the frame of the map.

    Attributes:
        drive: what was recorded.
        poses: ``(n, 3)``, about.
        agreeing: stamps of the views of each marker that agree on where it is; the others are looked at later.
        free: whether it is placed by the markers; otherwise its first pose is the origin.
    """

    drive: Drive
    poses: FloatArray
    agreeing: Mapping[int, frozenset[int]]
    free: bool


class SurveyGraph:
    """All drives and markers as one batch.

    A marker is a deviation from where it was last found, exact to the second order of its rotation; it is solved again
    from there until it stays.

    Attributes:
        installation: the parameters, the markers among them ...
        belief: ... and what was found of them.
        undecided: markers that fit in two directions about alike.
        landmark_map: the markers that these are deviations from.
    """

    def __init__(
        self,
        legs: Sequence[Leg],
        landmarks: Mapping[int, Landmark],
        anchors: set[int],
        config: Config,
        distances: Sequence[Distance] = (),
    ) -> None:
        """Put the graph together.

        Args:
            legs: the drives.
            landmarks: where the markers are, about; of those given, as they are given.
            anchors: ids of those given.
            config: all settings.
            distances: between markers.
        """
        self._legs, self._anchors, self._config, self._distances = legs, anchors, config, distances
        self._poses = np.vstack([leg.poses for leg in legs])
        wide = np.diag([_WIDE_M**2] * 3 + [_WIDE_RAD**2] * 3)
        held = {i: m if i in anchors else replace(m, cov=wide) for i, m in landmarks.items()}
        self.landmark_map = LandmarkMap(held)
        self._views: Counter[int] = Counter()
        self.undecided: set[int] = set()
        self.installation = self._installation()
        self.belief = self.installation.prior()

    def solve(self) -> None:
        """Find everything.

        Raises:
            EstimatorError: there is no solution.
        """
        for _ in range(_ROUNDS):
            self.installation = self._installation()
            factors = LandmarkFactors(self.landmark_map, self.installation)
            start = self.belief.mean.copy()
            for i, (first, count) in self.installation.landmarks.items():
                if i not in self._anchors:
                    start[first : first + count] = 0.0
            factors.estimated = InstallationEstimate(start, self.installation.prior().cov)
            solver = BatchSmoother(
                self._log(factors), factors, self._config.batch, self._config.estimator.gate_probability
            )
            self.belief, self._poses = solver.installed(), solver.poses()
            self._views = Counter(s.measurement.landmark_id for held in solver.accepted.values() for s in held)
            better = self._look_from_the_other_side(solver)
            if self._still() and not better:
                break
            moved = {i: m if i in self._anchors else self._found(m) for i, m in self.landmark_map.landmarks.items()}
            self.landmark_map = LandmarkMap(moved | better)

    def landmarks(self) -> dict[int, Landmark]:
        """Markers as they were found, with covariances ``(6, 6)``."""
        out = {}
        for i, landmark in self.landmark_map.landmarks.items():
            first, count = self.installation.landmarks[i]
            part = slice(first, first + count)
            cov = self.belief.cov[part, part]
            out[i] = replace(self._found(landmark), cov=0.5 * (cov + cov.T))
        return out

    def views(self) -> Counter[int]:
        """Accepted sightings, by marker."""
        return self._views

    def misfit(self, d: Distance) -> float:
        """By how many sigmas a distance that is in the graph differs from its estimate by everything else.

        What is left of a difference r with variance S, once a measurement of variance R is in, is r R / S, and the
        variance of the value is R - R² / S.
        """
        row = self._along(d, self.installation)
        left = d.metres - d.of(self.landmarks())
        share = d.sigma_m**2 - float(row @ self.belief.cov @ row)
        return abs(left) / math.sqrt(max(share, 1e-12))

    def _found(self, landmark: Landmark) -> Landmark:
        first, _ = self.installation.landmarks[landmark.landmark_id]
        move = self.belief.mean[first : first + 6]
        return moved_by(landmark, move)

    def _look_from_the_other_side(self, solver: BatchSmoother) -> dict[int, Landmark]:
        """Markers that fit better the other way round; of those that fit both ways about alike, note the ids."""
        seen: dict[int, list[tuple[PixelMeasurement, FloatArray]]] = {}
        for frame, pose in zip(solver.frames, self._poses, strict=True):
            for s in (*frame.sightings, *frame.rejected):
                if isinstance(s.measurement, PixelMeasurement):
                    seen.setdefault(s.measurement.landmark_id, []).append((s.measurement, pose))
        better = {}
        self.undecided = set()
        for i, views in seen.items():
            views = views[:: 1 + len(views) // _MOST_VIEWS]
            if i in self._anchors:
                continue
            poses = np.array([pose for _, pose in views])
            found = self._found(self.landmark_map.landmarks[i])
            other = mirrored(found, [m for m, _ in views], poses, self.installation, self.belief.mean)
            if other is not None and other.gain > 0.0:
                better[i] = other.landmark
            if other is not None and abs(other.gain) < _DECIDED:
                self.undecided.add(i)
        return better

    def _still(self) -> bool:
        for i, (first, _) in self.installation.landmarks.items():
            move = np.abs(self.belief.mean[first : first + 6])
            if i not in self._anchors and (move[:3].max() > _STILL_M or move[3:].max() > _STILL_RAD):
                return False
        return True

    def _installation(self) -> Installation:
        has_gyro = any(leg.drive.parts.localizer.motion.sources.gyro is not None for leg in self._legs)
        made = installation_of(self._config, self.landmark_map, True, has_gyro, len(self.landmark_map))
        for d in self._distances:
            made.measured(self._along(d, made), d.metres - d.of(self.landmark_map.landmarks), d.sigma_m)
        return made

    def _along(self, d: Distance, installation: Installation) -> FloatArray:
        """Derivative ``(n,)`` of a distance by the parameters."""
        at, row = self.landmark_map.landmarks, np.zeros(len(installation))
        along = (at[d.second].position - at[d.first].position) / max(d.of(at), 1e-9)
        for i, sign in ((d.first, -1.0), (d.second, 1.0)):
            row[installation.landmarks[i][0] : installation.landmarks[i][0] + 3] = sign * along
        return row

    def _log(self, factors: LandmarkFactors) -> MeasurementLog:
        """Keyframes of all drives, one after the other, with the corners seen from each."""
        log = MeasurementLog(math.inf, keep_all=True)
        sizes = {i: m.size_m for i, m in self.landmark_map.landmarks.items()}
        offset_s = self.installation.time_offset(self.belief)
        for leg in self._legs:
            for n, (frame, seen) in enumerate(zip(leg.drive.frames, leg.drive.measure(sizes, offset_s), strict=True)):
                k = len(log)
                pose = self._poses[k]
                prior = None
                if frame.prior is not None:
                    origin = n == 0 and not leg.free
                    prior = PoseWithCovariance(frame.prior.pose, _ORIGIN) if origin else PoseWithCovariance(pose, _FREE)
                accepted: list[LandmarkFactor] = []
                rejected: list[LandmarkFactor] = []
                for m in seen:
                    agrees = m.stamp_ns in leg.agreeing.get(m.landmark_id, ())
                    (accepted if agrees else rejected).append(factors.sighting(k, m, m.cauchy_k))
                log.keyframes[k] = Keyframe(
                    k,
                    frame.stamp_ns,
                    0.0,
                    PoseWithCovariance(pose, _FREE),
                    prior,
                    frame.motions,
                    tuple(accepted),
                    tuple(rejected),
                )
        return log
