"""Whether a set-up explains an excerpt: a small batch problem with every pose, marker and parameter of it.

The cost is the negative log-likelihood of corners, wheel motion and gyro with the priors of the configuration, so that
two set-ups can be compared by their costs. Poses of the images are free; wheels and gyro tie each to the next one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.diagnosis.excerpt import GRID_S, Stretch
from fgloc.diagnosis.window import rigid
from fgloc.graph.installation import Installation, installation_of
from fgloc.graph.observation import CornerBatch
from fgloc.sensors.cameras import pinhole, undistort_points
from fgloc.sensors.pnp import marker_pose_candidates
from fgloc.types import Camera, CornerMeasurement, FloatArray, IntArray, Landmark, LandmarkMap

EXTRAS = ("size", "map_scale", "radius", "track", "yaw_per_m", "late_s", "gyro_late_s", "gyro_scale", "gyro_bias")
_SIZE, _MAP = 0, 1
_WHEELS = slice(2, 6)  # what the wheels' motion depends on
_LATE, _GYRO_LATE, _GYRO_SCALE, _GYRO_BIAS = 5, 6, 7, 8
_SIZE_SIGMA = 0.005  # share: prints are exact to a millimetre in 0.2 m
_MAP_SIGMA = 1e-3  # share of all its distances
_SIGMA_PX = 0.2  # px: of corners in motion, on top of the configured noise
_WHEELS_FLOOR = np.array([0.001, 0.001, 0.001])  # m, m, rad: of the integration on a grid
_GYRO_FLOOR_RAD = 0.0005
_KERNEL = 9.0  # squared Cauchy constant, per degree of freedom
_ITERATIONS = 12
_NUDGE = 1e-6
_FEWEST = 8  # sightings of a stretch
_SPREAD_M = 0.4  # of the markers that they are of
_LEAST_INFORMATION = 1e-9  # of a pose that nothing ties down
_DONE = 1e-3  # share of the cost by which an iteration has to improve it


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """What a run is told, and by how much the motion is changed against the excerpt's.

    Attributes:
        turned: signs or rotation of the wheels' twist ``(3, 3)``.
        extras: ``(9,)`` values of `EXTRAS` about which the fit starts.
    """

    config: Config
    landmark_map: LandmarkMap
    camera: Camera
    turned: FloatArray = field(default_factory=lambda: np.eye(3))
    extras: FloatArray = field(default_factory=lambda: np.zeros(len(EXTRAS)))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well a set-up explains an excerpt.

    Attributes:
        cost: negative log-likelihood.
        costs: its part in each stretch ``(s,)``, without priors.
        misfit: median squared whitened residual of the markers, per degree of freedom; 1 is expected.
        poses: ``(n, 3)`` of the images.
        values: found value and prior sigma by name.
        markers: mean squared whitened residual of each marker, by id.
        normal: normal matrix and gradient at the solution; the last columns are those of ``values``, in order.
    """

    cost: float
    costs: FloatArray
    misfit: float
    poses: FloatArray
    values: Mapping[str, tuple[float, float]]
    markers: Mapping[int, float]
    normal: tuple[FloatArray, FloatArray]

    def gain(self, free: Mapping[str, float]) -> float:
        """By how much the cost would fall, to second order, with other prior sigmas for some values."""
        A, b = self.normal[0].copy(), self.normal[1].copy()
        first = len(b) - len(self.values)
        for k, (name, (value, sigma)) in enumerate(self.values.items(), first):
            if name in free:
                less = sigma**-2.0 - free[name] ** -2.0
                A[k, k] -= less
                b[k] -= less * value
        prior = sum(0.5 * (v / s) ** 2 - 0.5 * (v / free[n]) ** 2 for n, (v, s) in self.values.items() if n in free)
        return float(prior + 0.5 * b @ np.linalg.solve(A, b))


class Problem:
    """The stretches under one set-up."""

    def __init__(self, stretches: Sequence[Stretch], setup: Setup, free: Mapping[str, float]) -> None:
        """Prepare.

        Args:
            stretches: of the excerpt.
            setup: to be judged.
            free: prior sigmas, by name, that replace those of an ordinary installation.
        """
        self._stretches, self._setup = stretches, setup
        known = setup.landmark_map.landmarks
        seen = [
            (i, m.marker_id, m.corners_px)
            for i, p in enumerate(p for s in stretches for p in s.pictures)
            for m in p.seen
            if m.marker_id in known and known[m.marker_id].size_m > 0.0
        ]
        self._frame: IntArray = np.array([i for i, _, _ in seen], dtype=np.int64)
        self._ids = [i for _, i, _ in seen]
        self._corners = [c for _, _, c in seen]
        self._of_stretch = np.concatenate([np.full(len(s.pictures), k) for k, s in enumerate(stretches)])
        held = LandmarkMap({i: known[i] for i in sorted(set(self._ids))}, setup.landmark_map.dictionary)
        self._held = held
        has_gyro = any(s.gyro is not None for s in stretches)
        self._installation = _installation(setup.config, held, has_gyro, free)
        self._sigmas = np.array([free.get(n, s) for n, s in _extra_sigmas(setup.config, has_gyro).items()])
        ideal = pinhole(setup.camera)
        sigma = float(np.hypot(setup.config.markers.sigma_px, _SIGMA_PX))
        self._measured = [
            CornerMeasurement(0, i, undistort_points(setup.camera, c), sigma, ideal)
            for i, c in zip(self._ids, self._corners, strict=True)
        ]
        self._pairs = np.flatnonzero(np.diff(self._of_stretch) == 0)

    @property
    def sightings(self) -> int:
        """How many sightings of known markers there are."""
        return len(self._ids)

    @property
    def pairs(self) -> int:
        """How many pairs of images are tied by the motion between them."""
        return len(self._pairs)

    def solve(self, poses: FloatArray | None = None, iterations: int = _ITERATIONS) -> Fit | None:
        """Levenberg–Marquardt with Cauchy weights; None if the images do not tell where the robot was.

        Args:
            poses: ``(n, 3)`` to start from; None: wheel motion is laid onto the markers.
            iterations: at most so many.
        """
        poses = self._start() if poses is None else poses
        if poses is None:
            return None
        theta, extras = np.zeros(len(self._installation)), self._setup.extras.copy()
        damping = 1e-6
        state = self._linearized(poses, theta, extras)
        for _ in range(iterations):
            cost, A, b = state[0], state[1], state[2]
            step = np.linalg.solve(A + np.diag(damping * np.diag(A) + _LEAST_INFORMATION), -b)
            moved = self._moved(poses, theta, extras, step)
            trial = self._linearized(*moved)
            if trial[0] < cost:
                (poses, theta, extras), state, damping = moved, trial, max(0.1 * damping, 1e-9)
                if cost - trial[0] < _DONE * cost:
                    break
            else:
                damping = max(100.0 * damping, 1e-4)
        return self._fit(poses, theta, extras, state)

    # --- the parts ---

    def _linearized(
        self, poses: FloatArray, theta: FloatArray, extras: FloatArray
    ) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Cost, normal matrix and gradient; the cost by stretch; the squared residual of each sighting."""
        n, p = len(poses), len(theta)
        size = 3 * n + p + len(EXTRAS)
        A, b = np.zeros((size, size)), np.zeros(size)
        by_stretch = np.zeros(len(self._stretches))
        # 1. Corners
        r, J, columns = self._corner_rows(poses, theta, extras)
        squares = _add(A, b, r, J, columns, by_stretch, self._of_stretch[self._frame])
        # 2. Wheels and gyro
        for r, J, columns in self._motion_rows(poses, extras, 3 * n + p):
            _add(A, b, r, J, columns, by_stretch, self._of_stretch[self._pairs])
        # 3. Priors
        information = np.concatenate([self._installation.sigmas, self._sigmas]) ** -2.0
        x = np.concatenate([theta, extras])
        A[range(3 * n, size), range(3 * n, size)] += information
        b[3 * n :] += information * x
        return float(by_stretch.sum() + 0.5 * information @ x**2), A, b, by_stretch, squares

    def _corner_rows(
        self, poses: FloatArray, theta: FloatArray, extras: FloatArray
    ) -> tuple[FloatArray, FloatArray, IntArray]:
        n, p = len(poses), len(theta)
        at = poses[self._frame]
        batch = self._batch(extras[_SIZE], extras[_MAP])
        stack = batch.evaluate(at, theta)
        larger = self._batch(extras[_SIZE] + 1e-4, extras[_MAP]).evaluate(at, theta, by_installation=False)
        by_size = (larger.residual - stack.residual) / 1e-4
        places = np.array([self._held.landmarks[i].position for i in self._ids]) * np.exp(extras[_MAP])
        by_map = np.einsum("mdk,mk->md", stack.H[:, :, 12:15], places)
        J = np.concatenate([stack.J, stack.H, by_size[:, :, None], by_map[:, :, None]], axis=2)
        own = 3 * self._frame[:, None] + np.arange(3)
        extra = np.broadcast_to(3 * n + p + np.array([_SIZE, _MAP]), (len(at), 2))
        columns = np.concatenate([own, 3 * n + stack.columns, extra], axis=1)
        return np.clip(stack.residual, -1e4, 1e4), np.clip(J, -1e7, 1e7), columns

    def _motion_rows(
        self, poses: FloatArray, extras: FloatArray, first: int
    ) -> list[tuple[FloatArray, FloatArray, IntArray]]:
        i = self._pairs
        a, c = poses[i], poses[i + 1]
        cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
        dx, dy = c[:, 0] - a[:, 0], c[:, 1] - a[:, 1]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        turn = se2.wrap_array(c[:, 2] - a[:, 2])
        went, sigmas, seconds = self._motions(extras)
        r = np.column_stack([x, y, turn]) - went
        r[:, 2] = se2.wrap_array(r[:, 2])
        J = np.zeros((len(i), 3, 10))
        J[:, 0, 0] = J[:, 1, 1] = J[:, 2, 2] = -1.0
        J[:, 0, 2], J[:, 1, 2] = y, -x
        ct, st = np.cos(turn), np.sin(turn)
        J[:, 0, 3], J[:, 0, 4], J[:, 1, 3], J[:, 1, 4], J[:, 2, 5] = ct, -st, st, ct, 1.0
        for k in range(4):
            nudged = extras.copy()
            nudged[_WHEELS.start + k] += _NUDGE
            J[:, :, 6 + k] = -(self._motions(nudged)[0] - went) / _NUDGE
        ends = np.concatenate([3 * i[:, None] + np.arange(3), 3 * (i + 1)[:, None] + np.arange(3)], axis=1)
        wheels = np.broadcast_to(first + np.arange(_WHEELS.start, _WHEELS.stop), (len(i), 4))
        rows = [(r / sigmas, J / sigmas[:, :, None], np.concatenate([ends, wheels], axis=1))]
        turned, by_late, has = self._turned(extras[_GYRO_LATE])
        sigma = np.hypot(self._setup.config.gyro.yaw_per_sqrt_s * np.sqrt(seconds), _GYRO_FLOOR_RAD)
        sigma = np.where(has, sigma, 1e9)
        scale = 1.0 + extras[_GYRO_SCALE]
        r = se2.wrap_array(turn - scale * turned + extras[_GYRO_BIAS] * seconds)
        J = np.zeros((len(i), 1, 5))
        J[:, 0, 0], J[:, 0, 1], J[:, 0, 2], J[:, 0, 3], J[:, 0, 4] = -1.0, 1.0, -scale * by_late, -turned, seconds
        ends = np.column_stack([3 * i + 2, 3 * i + 5])
        gyro = np.broadcast_to(first + np.array([_GYRO_LATE, _GYRO_SCALE, _GYRO_BIAS]), (len(i), 3))
        rows.append(((r / sigma)[:, None], J / sigma[:, None, None], np.concatenate([ends, gyro], axis=1)))
        return rows

    def _motions(self, extras: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Wheel motion ``(k, 3)`` between images, its sigmas, and the time between them [s]."""
        radius, track, pull, late = extras[_WHEELS]
        noise = self._setup.config.wheels.noise
        motions, sigmas, spans = [], [], []
        for s in self._stretches:
            steps = s.wheels @ self._setup.turned.T
            forward = np.exp(radius) * steps[:, :2]
            turns = np.exp(radius - track) * steps[:, 2] + pull * forward[:, 0]
            at = s.times - late
            x, y, yaw = (_at(at, v) for v in _path(forward, turns))
            c, d = np.cos(yaw[:-1]), np.sin(yaw[:-1])
            ax, ay, turn = np.diff(x), np.diff(y), np.diff(yaw)
            motions.append(np.column_stack([c * ax + d * ay, c * ay - d * ax, turn]))
            dt = np.diff(s.times)
            way = np.diff(_at(at, _summed(np.hypot(forward[:, 0], forward[:, 1]))))
            bend = np.diff(_at(at, _summed(np.abs(turns))))
            q = np.column_stack(
                [
                    noise.x_per_sqrt_m**2 * way + noise.xy_per_sqrt_rad**2 * bend + noise.xy_per_sqrt_s**2 * dt,
                    noise.y_per_sqrt_m**2 * way + noise.xy_per_sqrt_rad**2 * bend + noise.xy_per_sqrt_s**2 * dt,
                    noise.yaw_per_sqrt_m**2 * way + noise.yaw_per_sqrt_rad**2 * bend + noise.yaw_per_sqrt_s**2 * dt,
                ]
            )
            sigmas.append(np.sqrt(q + _WHEELS_FLOOR**2))
            spans.append(dt)
        return np.concatenate(motions), np.concatenate(sigmas), np.concatenate(spans)

    def _turned(self, late: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotation by the gyro between images ``(k,)``, its derivative by the lateness, and where there is any."""
        turned, slope, has = [], [], []
        for s in self._stretches:
            k = len(s.times) - 1
            if s.gyro is None:
                turned.append(np.zeros(k))
                slope.append(np.zeros(k))
            else:
                angles, at = _summed(s.gyro), s.times - late
                turned.append(np.diff(_at(at, angles)))
                slope.append(-np.diff(_at(at, np.append(s.gyro, s.gyro[-1]) / GRID_S)))
            has.append(np.full(k, s.gyro is not None))
        return np.concatenate(turned), np.concatenate(slope), np.concatenate(has)

    def _start(self) -> FloatArray | None:
        """Poses ``(n, 3)``: each stretch of wheel motion laid rigidly onto the markers that it saw."""
        T, size = self._setup.camera.T_base_cam, np.exp(self._setup.extras[_SIZE])
        base = np.full((len(self._ids), 2), np.nan)
        for k, (i, corners) in enumerate(zip(self._ids, self._corners, strict=True)):
            found = marker_pose_candidates(self._setup.camera, corners, size * self._held.landmarks[i].size_m)
            if found:
                base[k] = (T[:3, :3] @ found[0][0][:3, 3] + T[:3, 3])[:2]
        places = np.array([self._held.landmarks[i].position[:2] for i in self._ids]).reshape(-1, 2)
        radius, track, _, late = self._setup.extras[_WHEELS]
        poses, first = [], 0
        for s in self._stretches:
            steps = s.wheels @ self._setup.turned.T
            path = np.column_stack(
                [
                    _at(s.times - late, v)
                    for v in _path(np.exp(radius) * steps[:, :2], np.exp(radius - track) * steps[:, 2])
                ]
            )
            own = np.isfinite(base[:, 0]) & (self._frame >= first) & (self._frame < first + len(path))
            place = _laid(path[self._frame[own] - first], base[own], places[own])
            if place is None:
                return None
            poses += [se2.compose(place, p) for p in path]
            first += len(path)
        return np.array(poses)

    def _batch(self, size: float, scale: float) -> CornerBatch:
        factor, stretch = np.exp(size), np.exp(scale)
        landmarks = {
            i: Landmark(i, stretch * m.position, m.rotation, factor * m.size_m) for i, m in self._held.landmarks.items()
        }
        return CornerBatch(self._measured, landmarks, self._installation)

    def _moved(
        self, poses: FloatArray, theta: FloatArray, extras: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        n, p = len(poses), len(theta)
        by = step[: 3 * n].reshape(n, 3)
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        moved = poses + np.column_stack([c * by[:, 0] - s * by[:, 1], s * by[:, 0] + c * by[:, 1], by[:, 2]])
        return moved, theta + step[3 * n : 3 * n + p], extras + step[3 * n + p :]

    def _fit(
        self,
        poses: FloatArray,
        theta: FloatArray,
        extras: FloatArray,
        state: tuple[float, FloatArray, FloatArray, FloatArray, FloatArray],
    ) -> Fit:
        names = (*self._installation.names, *EXTRAS)
        sigmas = np.concatenate([self._installation.sigmas, self._sigmas])
        found = zip(names, np.concatenate([theta, extras]).tolist(), sigmas.tolist(), strict=True)
        per = state[4] / 8.0
        ids = np.array(self._ids)
        markers = {int(i): float(per[ids == i].mean()) for i in np.unique(ids)}
        return Fit(
            state[0],
            state[3],
            float(np.median(per)),
            poses,
            {name: (v, s) for name, v, s in found},
            markers,
            (state[1], state[2]),
        )


def tells_place(stretch: Stretch, landmark_map: LandmarkMap) -> bool:
    """Whether the markers seen in a stretch are enough, and far enough apart, to tell where the robot was."""
    known = landmark_map.landmarks
    ids = [m.marker_id for p in stretch.pictures for m in p.seen if m.marker_id in known]
    ids = [i for i in ids if known[i].size_m > 0.0]
    places = np.array([known[i].position[:2] for i in ids]).reshape(-1, 2)
    return len(ids) >= _FEWEST and float(places.var(axis=0).sum()) > _SPREAD_M**2


def _installation(config: Config, held: LandmarkMap, has_gyro: bool, free: Mapping[str, float]) -> Installation:
    """Camera and markers, without clocks and wheels, which `EXTRAS` holds."""
    plain = installation_of(config, held, corners=True, has_gyro=has_gyro, most=10_000, has_model=False)
    sigmas = dict(zip(plain.names, plain.sigmas.tolist(), strict=True))
    kept = {n: free.get(n, s) for n, s in sigmas.items() if n.startswith(("camera.", "map."))}
    return Installation(kept | {"camera.time_offset_s": 1e-9})


def _extra_sigmas(config: Config, has_gyro: bool) -> dict[str, float]:
    wheels, camera = config.wheels, config.camera
    late = float(np.hypot(camera.time_offset_sigma_s, wheels.time_offset_sigma_s))
    sigmas = (
        _SIZE_SIGMA,
        _MAP_SIGMA,
        max(wheels.scale_sigma, 1e-4),
        max(wheels.turn_scale_sigma, 1e-4),
        max(wheels.yaw_per_m_sigma, 1e-4),
        late,
        camera.time_offset_sigma_s,
        config.gyro.scale_sigma if has_gyro else 1e-4,
        config.gyro.bias_sigma if has_gyro else 1e-4,
    )
    return dict(zip(EXTRAS, sigmas, strict=True))


def _add(
    A: FloatArray,
    b: FloatArray,
    r: FloatArray,
    J: FloatArray,
    columns: IntArray,
    costs: FloatArray,
    stretch: IntArray,
) -> FloatArray:
    """Add blocks of residuals ``(m, d)`` with Jacobians ``(m, d, c)`` and Cauchy weights; their squares ``(m,)``."""
    squares = (r**2).sum(axis=1)
    bound = _KERNEL * r.shape[1]
    weights = 1.0 / (1.0 + squares / bound)
    np.add.at(costs, stretch, 0.5 * bound * np.log1p(squares / bound))
    weighted = J * weights[:, None, None]
    H = np.einsum("mdi,mdj->mij", weighted, J)
    np.add.at(A, (columns[:, :, None], columns[:, None, :]), H)
    np.add.at(b, columns, np.einsum("mdi,md->mi", weighted, r))
    return squares


def _summed(steps: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(steps)])


def _path(forward: FloatArray, turns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses at the grid points from steps ``(g, 2)`` [m] and ``(g,)`` [rad]: x, y, yaw ``(g + 1,)``."""
    yaw = _summed(turns)
    middle = yaw[:-1] + 0.5 * turns
    c, s = np.cos(middle), np.sin(middle)
    x = _summed(c * forward[:, 0] - s * forward[:, 1])
    return x, _summed(s * forward[:, 0] + c * forward[:, 1]), yaw


def _at(times: FloatArray, values: FloatArray) -> FloatArray:
    """Values of the grid points at some times [s]."""
    return np.asarray(np.interp(times, np.arange(len(values)) * GRID_S, values))


def _laid(path: FloatArray, seen: FloatArray, places: FloatArray) -> FloatArray | None:
    """Pose ``(3,)`` of a path's start that brings what was seen from it onto the map; without the worst third."""
    c, s = np.cos(path[:, 2]), np.sin(path[:, 2])
    points = path[:, :2] + np.column_stack([c * seen[:, 0] - s * seen[:, 1], s * seen[:, 0] + c * seen[:, 1]])
    weights = 1.0 / np.maximum((seen**2).sum(axis=1), 0.01)
    place: FloatArray | None = None
    for _ in range(3):
        if len(points) < 4:
            return None
        place = rigid(points, places, weights)
        if place is None:
            return None
        c0, s0 = np.cos(place[2]), np.sin(place[2])
        off = points @ np.array([[c0, s0], [-s0, c0]]) + place[:2] - places
        distance = np.hypot(off[:, 0], off[:, 1])
        near = distance <= max(float(np.quantile(distance, 0.67)), 0.05)
        points, places, weights = points[near], places[near], weights[near]
    return place
