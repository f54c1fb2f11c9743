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
from fgloc.diagnosis.excerpt import Stretch, usable
from fgloc.diagnosis.setup_motion import EXTRAS, Motion, extra_sigmas, laid
from fgloc.graph.corner_batch import CornerBatch
from fgloc.graph.installation import CAMERA, Installation, installation_of
from fgloc.sensors import registry
from fgloc.sensors.cameras import pinhole, undistort_points
from fgloc.sensors.pnp import marker_pose_candidates
from fgloc.types import Camera, FloatArray, IntArray, Landmark, LandmarkMap, PixelMeasurement

_SIZE, _MAP = 0, 1
_SIGMA_PX = 0.2  # px: of corners in motion, on top of the configured noise
_EXACT = 1e-6  # sigma of what is no unknown here
_KERNEL = 9.0  # squared Cauchy constant, per degree of freedom
_ITERATIONS = 12
_LEAST_INFORMATION = 1e-9  # of a pose that nothing ties down
_DONE = 1e-3  # share of the cost by which an iteration has to improve it


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """The set-up of a run, and by how much the motion is changed against the excerpt's.

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
        ideal = pinhole(setup.camera)
        sigma = float(np.hypot(registry.raw_landmarks().sigma_px(setup.config), _SIGMA_PX))
        self._motion = Motion(stretches, setup.turned, setup.config)
        self._corners: list[FloatArray] = []
        self._measured: list[PixelMeasurement] = []
        frames = []
        for i, picture in enumerate(p for s in stretches for p in s.pictures):
            for m in usable(picture, setup.landmark_map):
                corners = undistort_points(setup.camera, m.corners_px)
                if np.isfinite(corners).all():
                    frames.append(i)
                    self._corners.append(m.corners_px)
                    self._measured.append(PixelMeasurement(0, m.landmark_id, corners, sigma, ideal))
        self._frame: IntArray = np.array(frames, dtype=np.int64)
        self._ids = [m.landmark_id for m in self._measured]
        self._held = LandmarkMap({i: setup.landmark_map.landmarks[i] for i in sorted(set(self._ids))})
        has_gyro = any(s.gyro is not None for s in stretches)
        self._installation = _installation(setup.config, self._held, has_gyro, free)
        self._sigmas = np.array([free.get(n, s) for n, s in extra_sigmas(setup.config, has_gyro).items()])

    @property
    def sightings(self) -> int:
        """How many sightings of known markers there are."""
        return len(self._ids)

    @property
    def pairs(self) -> int:
        """How many pairs of images are tied by the motion between them."""
        return len(self._motion.pairs)

    def solve(self, poses: FloatArray | None = None, iterations: int = _ITERATIONS) -> Fit | None:
        """Levenberg–Marquardt with Cauchy weights; None if the images do not determine where the robot was.

        Args:
            poses: ``(n, 3)`` to start from; None: wheel motion is laid onto the markers.
            iterations: at most so many.
        """
        poses = self._start() if poses is None else poses
        try:
            return None if poses is None else self._descended(poses, iterations)
        except np.linalg.LinAlgError:  # numbers beyond all bounds: such a set-up explains nothing
            return None

    def _descended(self, poses: FloatArray, iterations: int) -> Fit:
        theta, extras, damping = np.zeros(len(self._installation)), self._setup.extras.copy(), 1e-6
        state = self._linearized(poses, theta, extras)
        for _ in range(iterations):
            cost, A, b = state[:3]
            step = np.asarray(
                np.linalg.solve(A + np.diag(damping * np.diag(A) + _LEAST_INFORMATION), -b), dtype=np.float64
            )
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
        by_stretch, stretch_of = np.zeros(len(self._stretches)), self._motion.stretch_of
        # 1. Corners
        r, J, columns = self._corner_rows(poses, theta, extras)
        squares = _add(A, b, r, J, columns, by_stretch, stretch_of[self._frame])
        # 2. Wheels and gyro
        for r, J, columns in self._motion.rows(poses, extras, 3 * n + p):
            _add(A, b, r, J, columns, by_stretch, stretch_of[self._motion.pairs])
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

    def _start(self) -> FloatArray | None:
        """Poses ``(n, 3)``: each stretch of wheel motion laid rigidly onto the markers that it saw."""
        T, size = self._setup.camera.T_base_cam, np.exp(self._setup.extras[_SIZE])
        base = np.full((len(self._ids), 2), np.nan)
        for k, (i, corners) in enumerate(zip(self._ids, self._corners, strict=True)):
            found = marker_pose_candidates(self._setup.camera, corners, size * self._held.landmarks[i].size_m)
            if found:
                base[k] = (T[:3, :3] @ found[0][0][:3, 3] + T[:3, 3])[:2]
        places = np.array([self._held.landmarks[i].position[:2] for i in self._ids]).reshape(-1, 2)
        poses: list[FloatArray] = []
        for k in range(len(self._stretches)):
            path, first = self._motion.path(k, self._setup.extras), len(poses)
            own = np.isfinite(base[:, 0]) & (self._frame >= first) & (self._frame < first + len(path))
            place = laid(path[self._frame[own] - first], base[own], places[own])
            if place is None:
                return None
            poses += [se2.compose(place, p) for p in path]
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


def _installation(config: Config, held: LandmarkMap, has_gyro: bool, free: Mapping[str, float]) -> Installation:
    """Camera and markers, without clocks and wheels, which `EXTRAS` holds."""
    plain = installation_of(config, held, corners=True, has_gyro=has_gyro, most=10_000, has_model=False)
    sigmas = dict(zip(plain.names, plain.sigmas.tolist(), strict=True))
    camera = {f"camera.{name}": sigmas.get(f"camera.{name}", _EXACT) for name in CAMERA}
    markers = {n: s for n, s in sigmas.items() if n.startswith("map.")}
    return Installation({n: free.get(n, s) for n, s in (camera | {"camera.time_offset_s": _EXACT} | markers).items()})


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
    squares = np.asarray((r**2).sum(axis=1))
    bound = _KERNEL * r.shape[1]
    weights = 1.0 / (1.0 + squares / bound)
    np.add.at(costs, stretch, 0.5 * bound * np.log1p(squares / bound))
    weighted = J * weights[:, None, None]
    H = np.einsum("mdi,mdj->mij", weighted, J)
    np.add.at(A, (columns[:, :, None], columns[:, None, :]), H)
    np.add.at(b, columns, np.einsum("mdi,md->mi", weighted, r))
    return squares
