"""A survey: places and orientations of unknown markers, from images or corners of one or several drives.

1. Each drive by itself gives a trajectory (odometry, and markers as points).
2. Seen from there, the views of each marker agree on its pose; drives are joined by the markers that they share.
3. One graph of all drives refines trajectories, markers and the rest of the installation together (`SurveyGraph`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.assembly import Assembly, assemble
from fgloc.calibration.installation import Found, found_values
from fgloc.config import Config, base_roles
from fgloc.errors import ConfigError, MapError, RecordingError
from fgloc.frames import homogeneous, rpy_matrix
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import Installation, InstallationEstimate, installation_of
from fgloc.graph.measurement_log import Keyframe, LoggedSighting, MeasurementLog, PoseWithCovariance
from fgloc.graph.observation import Observations
from fgloc.recording.reader import Recording, open_recording
from fgloc.replay import Progress, Replay, smooth_run
from fgloc.sensors.cameras import marker_pose_candidates
from fgloc.sensors.equipment import LandmarkSensor, MotionCompensation, MotionSensors, PoseSensors
from fgloc.sensors.markers.detector import fitting_dictionary
from fgloc.sensors.measurements import PixelMeasurement, corners_of
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import FloatArray, Landmark, LandmarkMap, SightingsEvent

# --- Drives, replayed without a map -----------------------------------------------------------------------------------

_SHARP_PX = 30.0  # side from which a marker's corners are as good as they get


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """One recording, its trajectory known from odometry and from single views of the markers.

    Attributes:
        bag: the recording.
        parts: of the run without a map.
        frames: its keyframes, in order.
        poses: ``(n, 3)`` smoothed; the first one is the origin.
        sightings: of each marker, by id.
        notes: what the user should know.
    """

    bag: Path
    parts: Assembly
    frames: list[Keyframe]
    poses: FloatArray
    sightings: Mapping[int, int]
    notes: tuple[str, ...]

    def measure(
        self, sizes: Mapping[int, float], late_s: float | Callable[[str], float] = 0.0
    ) -> list[list[PixelMeasurement]]:
        """Corners of these markers as seen from each keyframe.

        Args:
            sizes: side of each marker [m].
            late_s: how late the stamps of images are, as far as is known, or a function that gives it by camera.
        """
        named = LandmarkMap({i: Landmark(i, np.zeros(3), np.eye(3), size) for i, size in sizes.items()})
        config = self.parts.config
        sensor, wheels = LandmarkSensor(config, named, self.parts.cameras, None), WheelMotion(config.wheels)
        motion = MotionSensors(wheels, gyro=self.parts.localizer.motion.sources.gyro)
        moved = MotionCompensation(PoseSensors(sensor), motion, config.camera.time_jitter_s)
        seen: list[list[PixelMeasurement]] = []
        for frame in self.frames:
            found = []
            if frame.step is not None:
                wheels.measure(frame.step)
                found = corners_of(moved.measure(frame.step, late_s))
            seen.append([replace(m, sigma_px=m.sigma_px * _coarseness(m.corners_px)) for m in found])
        return seen


def sees_corners(bag: Path, config: Config) -> bool:
    """Whether landmarks are seen as markers in images, or as their corners."""
    with open_recording(bag, config.recording) as recording:
        if "image" in (kinds := base_roles(recording.roles)):
            return True
        if "sightings" not in kinds:
            return False
        first = next((e for e in recording.events() if isinstance(e, SightingsEvent)), None)
        return first is not None and first.in_pixels


def drive(bag: Path, config: Config, progress: Progress | None = None) -> Drive:
    """Replay and smooth a recording without a map.

    Args:
        bag: with images, or corners of markers.
        config: with dictionary (for images) and size of the markers.
        progress: called now and then.

    Raises:
        ConfigError: no dictionary, or no size.
        RecordingError: neither images nor corners, or no marker in them.
        EstimatorError: no trajectory was found.
    """
    with open_recording(bag, config.recording) as recording:
        _check(bag, recording, config)
        parts = assemble(recording, None, config, keep_all=True)
        seen: Counter[int] = Counter()
        for step in Replay(parts, recording, parts.detector, progress, {}).steps(recording.events()):
            seen.update(s.landmark_id for event in step.sightings if event.in_pixels for s in event.sightings)
            parts.localizer.update(step)
        parts.localizer.finish(False)
        notes = (*recording.notes, *parts.gate.notes)
    if not seen:
        searched = "" if parts.detector is None else f" with {parts.detector.dictionary} in the images"
        raise RecordingError(f"{bag}: no marker was seen{searched}; see `fgloc info {bag}`, and markers.dictionary")
    estimates = smooth_run(parts).estimates
    frames = list(parts.localizer.estimator.log.keyframes.values())
    return Drive(bag, parts, frames, np.array([e.pose for e in estimates]), dict(sorted(seen.items())), notes)


def _check(bag: Path, recording: Recording, config: Config) -> None:
    if not {"image", "sightings"} & base_roles(recording.roles):
        raise RecordingError(f"{bag}: no images and no corners of markers: nothing to survey; see `fgloc info {bag}`")
    if "image" in base_roles(recording.roles) and not config.markers.dictionary:
        fitting = fitting_dictionary(recording)
        listed = (
            f"what is seen fits {fitting}: --dictionary {fitting}" if fitting else "such as --dictionary DICT_4X4_50"
        )
        raise ConfigError(f"{bag}: no marker dictionary; {listed}, or markers.dictionary in --config")
    if config.markers.default_size_m is None:
        raise ConfigError(
            f"{bag}: the distance of markers follows from their size: give the side of the black square in "
            "metres, --size 0.16, or markers.default_size_m in --config"
        )


def check_flat(config: Config, surveyed: str) -> None:
    """Check that the floor is configured as flat.

    Raises:
        ConfigError: it is not; ``surveyed`` are markers or anchors.
    """
    if config.estimator.ground != "flat":
        raise ConfigError(
            f"estimator.ground: {config.estimator.ground}: {surveyed} are surveyed on a flat floor; drive where it is "
            "flat and set estimator.ground: flat for the survey"
        )


def _coarseness(corners: FloatArray) -> float:
    """Factor (1 or more) on the noise of corners ``(4, 2)`` of a marker seen small or from the side.

    Blur then shifts its edges by what the cells beside them are, alike in all views from there: with this the
    directions of a simulated survey are a third better.
    """
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())
    return max(1.0, (_SHARP_PX / max(side, 1.0)) ** 2)


# --- Approximate poses of markers, and of two surveys that share some -------------------------------------------------

_AGREE_M, _AGREE_PER_M, _AGREE_RAD = 0.15, 0.08, 0.6  # views of one marker that are nearer than this mean the same
_VOTERS = 40  # views of a marker that propose where it is
_LEAST_SHARE = 0.5  # of the views that have to agree
_ALIGNED_M, _ALIGNED_RAD = 0.4, 0.5  # a marker in two surveys
_SPREAD_M = 0.25  # standard deviation of places that determine a direction


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """Approximate pose of a marker.

    Attributes:
        T: ``(4, 4)`` takes its coordinates to those of the trajectory.
        agreeing: stamps of the views that agree.
    """

    T: FloatArray
    agreeing: frozenset[int]


def guess(
    poses: FloatArray, seen: Sequence[Sequence[PixelMeasurement]], sizes: Mapping[int, float], least: int
) -> tuple[dict[int, Guess], dict[int, str]]:
    """Approximate pose of each marker on which its views agree.

    Of the two poses that explain a view of a flat square, the right one stays in place as the robot moves, while the
    mirrored one wanders.

    Args:
        poses: ``(n, 3)`` of the base.
        seen: corners by pose.
        sizes: side of each marker [m].
        least: views that have to agree.

    Returns:
        The guesses, and of the markers left out the reason, by id.
    """
    views: dict[int, list[tuple[int, float, list[FloatArray]]]] = {}
    for pose, measurements in zip(poses, seen, strict=True):
        T_map_base = planar_matrix(pose)
        for m in measurements:
            found = marker_pose_candidates(m.camera, m.corners_px, sizes[m.landmark_id])
            if found:
                T_map_cam = T_map_base @ m.camera.T_base_cam
                depth = float(found[0][0][2, 3])
                views.setdefault(m.landmark_id, []).append((m.stamp_ns, depth, [T_map_cam @ T for T, _ in found]))
    guesses, left_out = {}, {}
    for i, of_it in sorted(views.items()):
        if len(of_it) < least:
            left_out[i] = f"seen {len(of_it)} times, needed are {least}"
            continue
        made = _agreed(of_it)
        if len(made.agreeing) < max(least, _LEAST_SHARE * len(of_it)):
            left_out[i] = f"only {len(made.agreeing)} of {len(of_it)} views agree on where it is"
        else:
            guesses[i] = made
    return guesses, left_out


def _agreed(views: list[tuple[int, float, list[FloatArray]]]) -> Guess:
    """The pose that most views agree with."""
    depths = np.array([depth for _, depth, _ in views])
    both = np.array([[*made, *made][:2] for _, _, made in views])  # (n, 2, 4, 4)
    best, most = both[0, 0], 0
    for one in both[:: max(1, len(both) // _VOTERS)].reshape(-1, 4, 4):
        agree = int(_near(one, both, depths).any(axis=1).sum())
        if agree > most:
            best, most = one, agree
    for _ in range(2):
        near = _near(best, both, depths)
        if not near.any():
            break
        turned = np.linalg.norm(both[..., :3, :3] - best[:3, :3], axis=(2, 3))
        chosen = both[np.arange(len(both)), np.where(near, turned, np.inf).argmin(axis=1)][near.any(axis=1)]
        mean = Rotation.from_matrix(chosen[:, :3, :3]).mean().as_matrix()
        best = homogeneous(mean, np.median(chosen[:, :3, 3], axis=0))
    support = np.flatnonzero(_near(best, both, depths).any(axis=1))
    return Guess(best, frozenset(views[i][0] for i in support))


def _near(one: FloatArray, both: FloatArray, depths: FloatArray) -> FloatArray:
    """Mask ``(n, 2)``: whether each of the two poses of each view is close to this one."""
    apart = np.linalg.norm(both[..., :3, 3] - one[:3, 3], axis=2)
    cos = 0.5 * (np.einsum("nkij,ij->nk", both[..., :3, :3], one[:3, :3]) - 1.0)
    return np.asarray((apart < _AGREE_M + _AGREE_PER_M * depths[:, None]) & (cos > np.cos(_AGREE_RAD)))


def aligned(known: Mapping[int, FloatArray], found: Mapping[int, FloatArray]) -> FloatArray | None:
    """The planar motion ``(3,)`` that takes markers found to where they are known to be.

    Args:
        known: ``(4, 4)`` by id.
        found: likewise, in a frame of its own, of which only the floor is the same.

    Returns:
        None if no markers are common, or no motion fits half of them.
    """
    common = sorted(set(known) & set(found))
    if not common:
        return None
    a = np.array([known[i] for i in common])
    b = np.array([found[i] for i in common])
    candidates = [_planar(x @ np.linalg.inv(y)) for x, y in zip(a, b, strict=True)]
    candidates += [pose for i in range(len(a)) if (pose := _from_points(a[[i, i - 1]], b[[i, i - 1]])) is not None]
    best = max(candidates, key=lambda pose: int(_fits(pose, a, b).sum()))
    for _ in range(2):
        inside = _fits(best, a, b)
        best = best if (better := _from_points(a[inside], b[inside])) is None else better
    return best if 2 * _fits(best, a, b).sum() >= len(common) else None


def _fits(pose: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    moved = planar_matrix(pose) @ b
    cos = 0.5 * (np.einsum("nij,nij->n", moved[:, :3, :3], a[:, :3, :3]) - 1.0)
    near = np.linalg.norm(moved[:, :2, 3] - a[:, :2, 3], axis=1) < _ALIGNED_M
    return np.asarray(near & (cos > np.cos(_ALIGNED_RAD)))


def _from_points(a: FloatArray, b: FloatArray) -> FloatArray | None:
    """Least squares over the places alone; None where they are nearly one point."""
    return se2.rigid_if_spread(b[:, :2, 3], a[:, :2, 3], spread_m=_SPREAD_M)


def _planar(T: FloatArray) -> FloatArray:
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])])


def planar_matrix(pose: Iterable[float]) -> FloatArray:
    """Homogeneous matrix ``(4, 4)`` of a pose on the floor."""
    x, y, yaw = pose
    return homogeneous(rpy_matrix(0.0, 0.0, yaw), (x, y, 0.0))


# --- Markers that may be turned in either of two directions -----------------------------------------------------------

_STEPS = 12
_MOST = 25.0  # of the squared Mahalanobis distance of a view: above it the view is of another marker
_ABSURD = 1e4  # sigmas of a residual: its derivatives mean nothing
_SAME_RAD = 0.08  # two solutions nearer than this are one
_DAMPING = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """The other direction that a marker may have.

    Attributes:
        landmark: the marker so.
        gain: by how much this lowers the cost (a squared Mahalanobis distance); negative: it explains the views worse.
    """

    landmark: Landmark
    gain: float


def mirrored(
    landmark: Landmark,
    measurements: Sequence[PixelMeasurement],
    poses: FloatArray,
    installation: Installation,
    theta: FloatArray,
) -> Turned | None:
    """The best direction near the mirror image of a marker, with trajectory and installation held.

    Args:
        landmark: as found.
        measurements: its views.
        poses: ``(n, 3)`` of the base at each.
        installation: the parameters, with this marker among them.
        theta: their values; those of the marker are not used.

    Returns:
        None if there is no other direction: seen from the front, or from all around.
    """
    mounted = np.array([m.camera.T_base_cam[:3, 3] for m in measurements])
    cameras = np.column_stack([se2.placed(poses, mounted[:, :2]), mounted[:, 2]])
    sight = cameras - landmark.position
    sight = (sight / np.linalg.norm(sight, axis=1)[:, None]).mean(axis=0)
    sight = sight / np.linalg.norm(sight)
    axis = np.cross(landmark.rotation[:, 2], sight)
    size = float(np.linalg.norm(axis))
    if size < 1e-3:
        return None
    angle = 2.0 * np.arctan2(size, float(landmark.rotation[:, 2] @ sight))
    turned = Rotation.from_rotvec(angle * axis / size).as_matrix() @ landmark.rotation
    here, cost = _refined(landmark, measurements, poses, installation, theta)
    other, other_cost = _refined(replace(landmark, rotation=turned), measurements, poses, installation, theta)
    if Rotation.from_matrix(here.rotation.T @ other.rotation).magnitude() < _SAME_RAD:
        return None
    return Turned(other, cost - other_cost)


def _refined(
    landmark: Landmark,
    measurements: Sequence[PixelMeasurement],
    poses: FloatArray,
    installation: Installation,
    theta: FloatArray,
) -> tuple[Landmark, float]:
    """Levenberg–Marquardt over the marker's pose alone; the pose and its cost, views that do not fit cut off."""
    first, _ = installation.landmarks[landmark.landmark_id]
    held = theta.copy()
    held[first : first + 6] = 0.0

    def linearize(at: Landmark) -> tuple[float, FloatArray, FloatArray]:
        cost, normal, pull = 0.0, np.zeros((6, 6)), np.zeros(6)
        for one in Observations(measurements, {at.landmark_id: at}, installation).linearize(poses, held):
            nis = _MOST
            if not one.behind and np.abs(one.residual).max() < _ABSURD:
                J = one.H[:, np.searchsorted(one.columns, np.arange(first, first + 6))]
                weighted = np.linalg.solve(one.noise(), np.column_stack([one.residual, J]))
                nis = float(one.residual @ weighted[:, 0])
                weight = min(1.0, _MOST / max(nis, 1e-9))
                normal += weight * J.T @ weighted[:, 1:]
                pull += weight * J.T @ weighted[:, 0]
            cost += min(nis, _MOST)
        return cost, normal, pull

    cost, normal, pull = linearize(landmark)
    damping = _DAMPING
    for _ in range(_STEPS):
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), pull)
        moved = moved_by(landmark, np.asarray(-step, dtype=np.float64))
        tried = linearize(moved)
        if tried[0] < cost:
            done = cost - tried[0] < 1e-3
            landmark, (cost, normal, pull), damping = moved, tried, 0.1 * damping
            if done:
                break
        else:
            damping *= 10.0
    return landmark, cost


def moved_by(landmark: Landmark, move: FloatArray) -> Landmark:
    """The marker moved by ``(6,)``: in the map frame, and turned about its own axes."""
    turned = landmark.rotation @ Rotation.from_rotvec(move[3:]).as_matrix()
    return replace(landmark, position=landmark.position + move[:3], rotation=turned)


# --- The graph --------------------------------------------------------------------------------------------------------

_WIDE_M, _WIDE_RAD = 0.5, 0.5  # sigmas of an unknown marker: next to nothing is known of it
FREE = np.diag(np.square([10.0, 10.0, 3.0]))  # of the first pose of a drive that finds itself by the markers
ORIGIN = np.diag(np.square([1e-4, 1e-4, 1e-5]))  # of the one that is the map's origin
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
        """Distance [m] between the two markers in this map."""
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
        views: accepted sightings, by marker.
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
        """Build the graph.

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
        self.views: Counter[int] = Counter()
        self.undecided: set[int] = set()
        self.installation = self._installation()
        self.belief = self.installation.prior()

    def solve(self) -> None:
        """Estimate markers, trajectories and installation.

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
            self.views = Counter(s.measurement.landmark_id for held in solver.accepted.values() for s in held)
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

    def misfit(self, d: Distance) -> float:
        """Difference [sigma] of a distance in the graph from its estimate by all other measurements.

        What is left of a difference r with variance S, once a measurement of variance R is in, is r R / S, and the
        variance of the value is R - R² / S.
        """
        row = self._along(d, self.installation)
        left = d.metres - d.of(self.landmarks())
        share = d.sigma_m**2 - float(row @ self.belief.cov @ row)
        return abs(left) / math.sqrt(max(share, 1e-12))

    def _found(self, landmark: Landmark) -> Landmark:
        first, _ = self.installation.landmarks[landmark.landmark_id]
        return moved_by(landmark, self.belief.mean[first : first + 6])

    def _look_from_the_other_side(self, solver: BatchSmoother) -> dict[int, Landmark]:
        """Markers that fit better in the mirrored direction; those that fit both equally are noted as undecided."""
        seen: dict[int, list[tuple[PixelMeasurement, FloatArray]]] = {}
        for frame, pose in zip(solver.frames, self._poses, strict=True):
            for m in corners_of(s.measurement for s in (*frame.sightings, *frame.rejected)):
                seen.setdefault(m.landmark_id, []).append((m, pose))
        better = {}
        self.undecided = set()
        for i in seen.keys() - self._anchors:
            views = seen[i][:: 1 + len(seen[i]) // _MOST_VIEWS]
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
        cameras = [camera.name for camera in self._legs[0].drive.parts.cameras]
        made = installation_of(self._config, self.landmark_map, True, has_gyro, len(self.landmark_map), cameras=cameras)
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
        late_s = partial(self.installation.time_offset, self.belief)
        for leg in self._legs:
            for n, (frame, seen) in enumerate(zip(leg.drive.frames, leg.drive.measure(sizes, late_s), strict=True)):
                k = len(log)
                pose = self._poses[k]
                prior = None
                if frame.prior is not None:
                    origin = n == 0 and not leg.free
                    prior = PoseWithCovariance(frame.prior.pose, ORIGIN) if origin else PoseWithCovariance(pose, FREE)
                accepted: list[LoggedSighting] = []
                rejected: list[LoggedSighting] = []
                for m in seen:
                    agrees = m.stamp_ns in leg.agreeing.get(m.landmark_id, ())
                    (accepted if agrees else rejected).append(factors.sighting(k, m, m.cauchy_k))
                log.keyframes[k] = Keyframe(
                    k,
                    frame.stamp_ns,
                    0.0,
                    PoseWithCovariance(pose, FREE),
                    prior,
                    frame.motions,
                    tuple(accepted),
                    tuple(rejected),
                )
        return log


# --- The whole --------------------------------------------------------------------------------------------------------

_KNOWN_M, _KNOWN_RAD = 0.1, 0.2  # sigmas of a marker that is not known yet
_CONTRADICTS = 4.0  # sigmas by which a measured distance may miss
_MOVED = 6.0  # sigmas by which a given marker may be moved


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Result of a survey.

    Attributes:
        landmarks: the map, each marker with its covariance ``(6, 6)``.
        views: sightings of each marker that the map is made of, by id.
        left_out: markers that were seen but are not in the map, with the reason.
        installation: what was found besides, by name.
        notes: what the user should know, one sentence each.
        errors: sentences on what was given and cannot be true, or why most markers are left out: the map is not to be
            trusted.
    """

    landmarks: LandmarkMap
    views: Mapping[int, int]
    left_out: Mapping[int, str]
    installation: Found
    notes: tuple[str, ...]
    errors: tuple[str, ...] = ()


def survey(
    bags: Sequence[Path],
    config: Config,
    given: LandmarkMap | None = None,
    distances: Sequence[Distance] = (),
    progress: Progress | None = None,
) -> Survey:
    """Survey markers.

    Args:
        bags: recordings of one robot, with images or corners.
        config: with dictionary and size of the markers.
        given: markers that are known, with their sigmas: they make the frame, and are refined. None: the first pose of
            the first recording is the origin.
        distances: measured between two markers' middles.
        progress: called now and then.

    Raises:
        FglocError: a recording cannot be used, nothing is seen often enough, or recordings have no marker in common.
    """
    check_flat(config, "markers")
    drives = [drive(bag, config, progress) for bag in bags]
    anchors = {i: m for i, m in (given.landmarks if given is not None else {}).items() if m.size_m > 0.0}
    seen = Counter({i: n for one in drives for i, n in one.sightings.items()})
    size = config.markers.default_size_m or 0.0
    sizes = dict.fromkeys(seen, size) | {i: m.size_m for i, m in anchors.items()}
    legs, start, left_out = _joined(drives, sizes, anchors, config.landmarks.min_sightings)
    _need_ends(distances, start, left_out)
    graph = SurveyGraph(legs, start, set(anchors), config, distances)
    graph.solve()
    surveyed, views = graph.landmarks(), graph.views
    left_out |= _undetermined(graph, surveyed, views, set(anchors), config.landmarks.min_sightings)
    kept = {i: m for i, m in surveyed.items() if i not in left_out}
    if not kept:
        raise _none_surveyed(drives, left_out)
    unseen = {i: m for i, m in (given.landmarks if given is not None else {}).items() if i not in kept}
    dictionary = config.markers.dictionary or (given.dictionary if given is not None else "")
    landmarks = LandmarkMap(dict(sorted((kept | unseen).items())), dictionary, "surveyed")
    first = drives[0].parts
    found = found_values(graph.installation, graph.belief, first.config, first.cameras, graph.landmark_map)
    notes = [note for one in drives for note in one.notes]
    notes += [f"Markers {sorted(unseen)} of the given map were not seen, and stay as given."] if unseen else []
    misfits = [(d, graph.misfit(d)) for d in distances]
    notes += [_missed(d, sigmas) for d, sigmas in misfits if sigmas > _CONTRADICTS]
    errors = (*_moved(graph, sorted(anchors & kept.keys())), *(_wrong(drives) if len(left_out) > len(kept) else ()))
    return Survey(landmarks, {i: views[i] for i in kept}, left_out, found, tuple(dict.fromkeys(notes)), errors)


def _none_surveyed(drives: Sequence[Drive], left_out: Mapping[int, str]) -> RecordingError:
    listed = "; ".join(f"marker {i}: {why}" for i, why in left_out.items()) or "none was seen"
    return RecordingError(" ".join([f"{drives[0].bag}: no marker can be surveyed: {listed}.", *_wrong(drives)]))


def _wrong(drives: Sequence[Drive]) -> dict[str, None]:
    """Sentences on signals of the drives that do not fit together, as where the camera is mounted otherwise."""
    return dict.fromkeys(finding.text for one in drives for finding in one.parts.diagnosis.findings())


def _moved(graph: SurveyGraph, markers: Iterable[int]) -> Iterator[str]:
    """Sentence on the given marker that the survey moves most, if by more than its sigmas allow.

    Others are drawn along by one that is wrong, and it by them: its residual is the largest in sigmas of residuals.

    Source: Baarda 1968, "A testing procedure for use in geodetic networks" (data snooping).
    """
    moves = {}
    for i in markers:
        first, count = graph.installation.landmarks[i]
        part = slice(first, first + count)
        move, variance = graph.belief.mean[part], np.square(graph.installation.sigmas[part])
        left = np.maximum(variance - np.diag(graph.belief.cov)[part], 1e-3 * variance + 1e-12)
        moves[i] = float((np.abs(move) / np.sqrt(left)).max()), move
    marker, (most, move) = max(moves.items(), key=lambda item: item[1][0], default=(-1, (0.0, np.zeros(6))))
    if most > _MOVED:
        turned = math.degrees(float(np.linalg.norm(move[3:])))
        yield (
            f"marker {marker} contradicts the other sightings: they move it by {np.linalg.norm(move[:3]):.2f} m and "
            f"{turned:.0f}°, {most:.0f} σ. Its place, the size of a marker, the camera's calibration or mounting is "
            "wrong, or the floor is not flat; the map that was written is not to be trusted"
        )


def _need_ends(distances: Sequence[Distance], start: Mapping[int, Landmark], left_out: Mapping[int, str]) -> None:
    absent = [i for d in distances for i in (d.first, d.second) if i not in start]
    if absent:
        raise MapError(
            f"marker {absent[0]}, to which a distance was measured, {left_out.get(absent[0], 'was not seen')}; "
            f"surveyed are {sorted(start)}"
        )


def _undetermined(
    graph: SurveyGraph, surveyed: Mapping[int, Landmark], views: Mapping[int, int], anchors: set[int], least: int
) -> dict[int, str]:
    """Markers that the solution does not determine well enough for a map, with the reason."""
    left_out = {}
    for i in sorted(set(surveyed) - anchors):
        sigma = np.sqrt(np.diag(surveyed[i].cov))  # type: ignore[arg-type]
        if views[i] < least:
            left_out[i] = f"{views[i]} of its sightings fit the rest"
        elif i in graph.undecided:
            left_out[i] = "its views fit two directions alike: look at it from the side and from nearer"
        elif sigma[:3].max() > _KNOWN_M or sigma[3:].max() > _KNOWN_RAD:
            left_out[i] = (
                f"known to {100.0 * sigma[:3].max():.0f} cm and {np.degrees(sigma[3:].max()):.0f} degrees only: look "
                "at it from nearer and from several places"
            )
    return left_out


def _joined(
    drives: Sequence[Drive], sizes: Mapping[int, float], anchors: Mapping[int, Landmark], least: int
) -> tuple[list[Leg], dict[int, Landmark], dict[int, str]]:
    """Drives and markers in one frame: that of the anchors, else of the first drive; and what is left out."""
    known = {i: homogeneous(m.rotation, m.position) for i, m in anchors.items()}
    legs: list[Leg] = []
    left_out: dict[int, str] = {}
    waiting = []
    for one in drives:
        guesses, reasons = guess(one.poses, one.measure(sizes), sizes, least)
        left_out |= reasons
        waiting.append((one, guesses))
    while waiting:
        if known:
            waiting.sort(key=lambda item: -len(set(item[1]) & set(known)))
        one, guesses = waiting.pop(0)
        motion = aligned(known, {i: g.T for i, g in guesses.items()}) if known else np.zeros(3)
        if motion is None:
            others = "the given map" if not legs else "the recordings before it"
            raise RecordingError(
                f"{one.bag}: has no marker in common with {others}, or they hang elsewhere: seen are "
                f"{sorted(guesses)}, known {sorted(known)}"
            )
        for i, g in guesses.items():
            known.setdefault(i, planar_matrix(motion) @ g.T)
        free = bool(anchors) or bool(legs)
        agreeing = {i: g.agreeing for i, g in guesses.items()}
        legs.append(Leg(one, se2.compose_array(motion, one.poses), agreeing, free))
    if not known:
        raise _none_surveyed(drives, left_out)
    start = {
        i: anchors[i] if i in anchors else Landmark(i, T[:3, 3], T[:3, :3], sizes[i]) for i, T in sorted(known.items())
    }
    seen = {i for leg in legs for i in leg.agreeing}
    return legs, {i: m for i, m in start.items() if i in seen}, {i: w for i, w in left_out.items() if i not in start}


def _missed(d: Distance, sigmas: float) -> str:
    return (
        f"The distance of markers {d.first} and {d.second}, {d.metres:g} m, is {sigmas:.0f} sigmas from what is seen: "
        "check it, and the markers' size."
    )
