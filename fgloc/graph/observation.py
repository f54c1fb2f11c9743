"""Sightings as functions of pose and installation: residuals with both Jacobians, for many sightings in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.graph.installation import Installation
from fgloc.types import (
    CornerMeasurement,
    FloatArray,
    IntArray,
    Landmark,
    LandmarkMeasurement,
    MarkerPoseMeasurement,
    RangeBearingMeasurement,
)

_BLURRED_SIDE_PX = 20.0  # side of a marker that shrinks by as much as its corners are off; falls with the square
_MOST_BLURRED = 2.0
_MOST_LOG_SCALE = 3.0  # of ranges: an estimate that diverges goes on to be refused, not to overflow
MIN_DEPTH_M = 0.05  # a corner nearer to the image plane than this is not projected


@dataclass(frozen=True, slots=True, eq=False)
class Linearized:
    """Whitened residual and Jacobians of one sighting.

    Attributes:
        residual: ``(d,)`` predicted minus measured, in units of the sighting's own noise.
        J: ``(d, 3)`` by the right perturbation of the pose.
        columns: ``(c,)`` parameters of the installation that it depends on.
        H: ``(d, c)`` by these.
        shared: ``(d, s)`` square root of the covariance that comes on top of the identity: of the stamp's jitter and
            of the motion by which the sighting was moved to its keyframe; the same for all of one image.
        behind: whether a corner is behind the camera; the residual then means nothing.
    """

    residual: FloatArray
    J: FloatArray
    columns: IntArray
    H: FloatArray
    shared: FloatArray
    behind: bool = False

    def noise(self) -> FloatArray:
        """Covariance ``(d, d)`` of the residual without pose and installation."""
        return np.asarray(np.eye(len(self.residual)) + self.shared @ self.shared.T)


@dataclass(frozen=True, slots=True, eq=False)
class Stacked:
    """Residuals and Jacobians of sightings of one kind, whitened by their own noise.

    Attributes:
        residual: ``(m, d)``.
        J: ``(m, d, 3)`` by the pose.
        H: ``(m, d, c)`` by the parameters in `columns` ``(m, c)``; -1: none, then H is 0.
        columns: see above.
        behind: ``(m,)`` whether a corner is behind the camera.
    """

    residual: FloatArray
    J: FloatArray
    H: FloatArray
    columns: IntArray
    behind: NDArray[np.bool_]


class Observations:
    """Sightings prepared for being linearized, once or often."""

    def __init__(
        self, measurements: Sequence[LandmarkMeasurement], landmarks: Mapping[int, Landmark], installation: Installation
    ) -> None:
        """Collect what does not depend on pose and installation.

        Args:
            measurements: of known landmarks.
            landmarks: the map.
            installation: the parameters.
        """
        self._count = len(measurements)
        corners = [i for i, m in enumerate(measurements) if isinstance(m, CornerMeasurement)]
        planar = [i for i, m in enumerate(measurements) if not isinstance(m, CornerMeasurement)]
        self.batches: list[tuple[list[int], CornerBatch | PlanarBatch]] = []
        if corners:
            seen = [m for m in measurements if isinstance(m, CornerMeasurement)]
            self.batches.append((corners, CornerBatch(seen, landmarks, installation)))
        if planar:
            rest = [m for m in measurements if not isinstance(m, CornerMeasurement)]
            self.batches.append((planar, PlanarBatch(rest, landmarks, installation)))

    def __len__(self) -> int:
        return self._count

    def linearize(self, poses: FloatArray, theta: FloatArray) -> list[Linearized]:
        """Every sighting at a pose ``(3,)``, or each at its own ``(m, 3)``, and an installation ``(n,)``."""
        each = np.broadcast_to(poses, (self._count, 3))
        found: dict[int, Linearized] = {}
        for rows, batch in self.batches:
            stack = batch.evaluate(each[rows], theta)
            for i, row in enumerate(rows):
                used = stack.columns[i] >= 0
                d = batch.rows[i]
                H, J = stack.H[i, :d], stack.J[i, :d]
                shared = batch.shared(i, J, H)
                found[row] = Linearized(
                    stack.residual[i, :d], J, stack.columns[i][used], H[:, used], shared, bool(stack.behind[i])
                )
        return [found[i] for i in range(self._count)]


class CornerBatch:
    """Corners of markers in images.

    Source: pinhole camera with the distortion of Brown 1966 as OpenCV has it; perturbations on the right.
    """

    def __init__(
        self, seen: Sequence[CornerMeasurement], landmarks: Mapping[int, Landmark], installation: Installation
    ) -> None:
        held = [landmarks[m.landmark_id] for m in seen]
        half = np.array([0.5 * landmark.size_m for landmark in held])
        square = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
        self._local = half[:, None, None] * square  # (m, 4, 3) in the marker's frame
        self._position = np.array([landmark.position for landmark in held])
        self._rotation = np.array([landmark.rotation for landmark in held])
        T = np.array([m.camera.T_base_cam for m in seen])
        self._R, self._t = T[:, :3, :3], T[:, :3, 3]
        self._K = np.array([m.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] for m in seen])
        self._D = np.array([np.concatenate([m.camera.D, np.zeros(4)])[:4] for m in seen])
        self._pixels = np.array([m.corners_px for m in seen])
        self._sigma = np.array([m.sigma_px for m in seen])
        self._twist = np.array([m.twist for m in seen])
        self._offset = np.array([m.offset_s for m in seen])
        self._jitter = np.array([m.jitter_s for m in seen])
        self._moved = [None if m.motion_cov is None else _root(m.motion_cov) for m in seen]
        self._outward, self._small = _shrinking(self._pixels)
        self._blur_px = np.array([m.blur_s for m in seen]) * self._speed(2.0 * half)
        self._noise_px = np.hypot(self._sigma, self._blur_px)
        self.rows = [8] * len(seen)
        first = installation.blocks.get("camera")
        self._camera = None if first is None else np.arange(first[0], first[0] + 12)
        marker = np.array([_block(installation, m.landmark_id, 6) for m in seen])
        self._columns = np.full((len(seen), 18), -1)
        if self._camera is not None:
            self._columns[:, :12] = self._camera
        self._columns[:, 12:] = np.where(marker[:, None] >= 0, marker[:, None] + np.arange(6), -1)

    def evaluate(self, poses: FloatArray, theta: FloatArray, by_installation: bool = True) -> Stacked:
        """All sightings, each at its own pose ``(m, 3)``; without derivatives by the installation in half the time."""
        n = len(poses)
        camera = np.zeros(12) if self._camera is None else theta[self._camera]
        marker = np.append(theta, 0.0)[self._columns[:, 12:]]
        # 1. Corners in the map, in the base frame, at the exposure, in the camera
        turned = _cross(marker[:, None, 3:], self._local)
        local = self._local + turned + 0.5 * _cross(marker[:, None, 3:], turned)
        P = (self._position + marker[:, :3])[:, None] + local @ self._rotation.transpose(0, 2, 1)
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        Rz = np.zeros((n, 3, 3))  # R_map_base
        Rz[:, 0, 0], Rz[:, 0, 1], Rz[:, 1, 0], Rz[:, 1, 1], Rz[:, 2, 2] = c, -s, s, c, 1.0
        P[:, :, :2] -= poses[:, None, :2]
        q = P @ Rz
        flow = np.zeros_like(q)  # of the point in the base frame by a later stamp
        flow[:, :, 0] = self._twist[:, None, 0] - self._twist[:, None, 2] * q[:, :, 1]
        flow[:, :, 1] = self._twist[:, None, 1] + self._twist[:, None, 2] * q[:, :, 0]
        late = camera[11] - self._offset
        mounted = (q + late[:, None, None] * flow - self._t[:, None]) @ self._R
        X = mounted - camera[:3] - _cross(camera[3:6], mounted)
        depth = X[:, :, 2]
        behind = (depth < MIN_DEPTH_M).any(axis=1)
        Z = np.maximum(depth, MIN_DEPTH_M)
        # 2. Image
        x, y = X[:, :, 0] / Z, X[:, :, 1] / Z
        k1, k2 = self._D[:, None, 0] + camera[9], self._D[:, None, 1] + camera[10]
        p1, p2 = self._D[:, None, 2], self._D[:, None, 3]
        r2 = x * x + y * y
        radial = 1.0 + k1 * r2 + k2 * r2 * r2
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        f = self._K[:, None, :2] * (1.0 + camera[6])
        image = np.stack([xd, yd], axis=2)
        predicted = f * image + self._K[:, None, 2:] + camera[7:9]
        # 3. Derivatives: pixel by the point in the camera, (m, 4, 2, 3)
        dr = k1 + 2.0 * k2 * r2
        by_ray = np.empty((n, 4, 2, 2))
        by_ray[..., 0, 0] = radial + 2.0 * x * x * dr + 2.0 * p1 * y + 6.0 * p2 * x
        by_ray[..., 0, 1] = 2.0 * x * y * dr + 2.0 * p1 * x + 2.0 * p2 * y
        by_ray[..., 1, 0] = 2.0 * x * y * dr + 2.0 * p1 * x + 2.0 * p2 * y
        by_ray[..., 1, 1] = radial + 2.0 * y * y * dr + 6.0 * p1 * y + 2.0 * p2 * x
        by_ray *= f[:, :, :, None]
        A = np.empty((n, 4, 2, 3))
        A[..., :2] = by_ray / Z[..., None, None]
        A[..., 2] = -(by_ray[..., 0] * x[..., None] + by_ray[..., 1] * y[..., None]) / Z[..., None]
        # by the point in the base frame at the exposure
        B = (A - _cross(A, camera[3:6])) @ self._R.transpose(0, 2, 1)[:, None]
        by_time = (B @ flow[..., None])[..., 0]
        turn = (late * self._twist[:, 2])[:, None, None]
        B[..., 0], B[..., 1] = B[..., 0] + turn * B[..., 1], B[..., 1] - turn * B[..., 0]  # by that at the stamp
        scale = 1.0 / self._noise_px
        J: FloatArray = np.stack(
            [-B[..., 0], -B[..., 1], B[..., 0] * q[..., None, 1] - B[..., 1] * q[..., None, 0]], axis=-1
        )
        residual = ((predicted - self._pixels) * scale[:, None, None]).reshape(n, 8)
        J = (J * scale[:, None, None, None]).reshape(n, 8, 3)
        if not by_installation:
            return Stacked(residual, J, np.zeros((n, 8, 0)), self._columns, behind)
        H: FloatArray = np.empty((n, 4, 2, 18))
        H[..., :3] = -A
        H[..., 3:6] = _crossed(A, mounted)  # -A (φ x X) by φ
        H[..., 6] = f * image / (1.0 + camera[6])
        H[..., 7:9] = np.eye(2)
        H[..., 9] = f * np.stack([x, y], axis=2) * r2[..., None]
        H[..., 10] = H[..., 9] * r2[..., None]
        H[..., 11] = by_time
        M = B @ Rz.transpose(0, 2, 1)[:, None]
        H[..., 12:15] = M
        H[..., 15:] = -_crossed(M @ self._rotation[:, None], local)
        H[..., :12] *= self._camera is not None
        H[..., 12:] *= (self._columns[:, 12] >= 0)[:, None, None, None]
        H = (H * scale[:, None, None, None]).reshape(n, 8, 18)
        return Stacked(residual, J, H, self._columns, behind)

    def _speed(self, size_m: FloatArray) -> FloatArray:
        """How fast the corners move in the image ``(m,)`` [px/s] where they were seen, whatever marker it is.

        Not where they are expected: a marker that was misread may be expected near the image plane, where all is fast.
        """
        f = self._K[:, 0]
        side = np.linalg.norm(self._pixels - np.roll(self._pixels, 1, axis=1), axis=2).max(axis=1)
        off = np.linalg.norm((self._pixels.mean(axis=1) - self._K[:, 2:]) / self._K[:, :2], axis=1)
        depth = f * np.maximum(size_m, 1e-3) / np.maximum(side, 1.0)
        along = np.hypot(self._twist[:, 0], self._twist[:, 1]) * off / depth
        return np.asarray(f * (np.abs(self._twist[:, 2]) * (1.0 + off**2) + along))

    def shared(self, i: int, J: FloatArray, H: FloatArray) -> FloatArray:
        """As `Linearized` has it, of one sighting."""
        shrunk = self._outward[i, :, None] * (self._small[i] * self._blur_px[i] / self._noise_px[i])
        common = [shrunk, self._jitter[i] * H[:, 11:12]]
        moved = self._moved[i]
        if moved is not None:
            common.append(J @ moved)
        return np.hstack(common)


class PlanarBatch:
    """Ranges with bearings, as points in the base frame, and marker poses."""

    def __init__(
        self,
        seen: Sequence[RangeBearingMeasurement | MarkerPoseMeasurement],
        landmarks: Mapping[int, Landmark],
        installation: Installation,
    ) -> None:
        poses = [m.pose if isinstance(m, MarkerPoseMeasurement) else None for m in seen]
        self.rows = [2 if pose is None else 3 for pose in poses]
        self._whole = np.array([pose is not None for pose in poses])
        self._yaw = np.array([0.0 if pose is None else pose[2] for pose in poses])
        self._place = np.array([landmarks[m.landmark_id].planar for m in seen])
        self._point = np.zeros((len(seen), 2))
        self._whitening = np.zeros((len(seen), 3, 3))  # of the residual in the base frame
        for i, m in enumerate(seen):
            if isinstance(m, MarkerPoseMeasurement):
                self._point[i] = m.pose[:2]
                c, s = np.cos(m.pose[2]), np.sin(m.pose[2])
                turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
                self._whitening[i] = np.linalg.inv(np.linalg.cholesky(m.cov)) @ turn
            else:
                self._point[i], cov = cartesian(m)
                self._whitening[i, :2, :2] = np.linalg.inv(np.linalg.cholesky(cov))
        self._twist = np.array([m.twist for m in seen])
        self._offset = np.array([m.offset_s for m in seen])
        first = installation.blocks.get("sightings")
        self._sensor = None if first is None else np.arange(first[0], first[0] + 3)
        self._up = np.array([landmarks[m.landmark_id].rotation[2] for m in seen])
        place = np.array([_block(installation, m.landmark_id, 2) for m in seen])
        turn = np.array([_block(installation, m.landmark_id, 6) for m in seen])
        self._columns = np.full((len(seen), 8), -1)  # sensor, place, rotation of the landmark
        if self._sensor is not None:
            self._columns[:, :3] = self._sensor
        self._columns[:, 3:5] = np.where(place[:, None] >= 0, place[:, None] + np.arange(2), -1)
        self._columns[:, 5:] = np.where(turn[:, None] >= 0, turn[:, None] + np.arange(3, 6), -1)

    def evaluate(self, poses: FloatArray, theta: FloatArray, by_installation: bool = True) -> Stacked:
        """All sightings, each at its own pose ``(m, 3)``; without derivatives by the installation in half the time."""
        n = len(poses)
        held = np.append(theta, 0.0)
        sensor = np.zeros(3) if self._sensor is None else theta[self._sensor]
        place = self._place[:, :2] + held[self._columns[:, 3:5]]
        facing = self._place[:, 2] + np.einsum("ni,ni->n", self._up, held[self._columns[:, 5:]])
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        R = np.stack([np.stack([c, s], 1), np.stack([-s, c], 1)], 1)  # R_base_map
        q = np.einsum("nij,nj->ni", R, place - poses[:, :2])
        w = self._twist[:, 2]
        flow = np.stack([self._twist[:, 0] - w * q[:, 1], self._twist[:, 1] + w * q[:, 0], w], 1)
        late = sensor[2] - self._offset
        co, so = np.cos(sensor[1]), np.sin(sensor[1])
        scale = np.exp(np.clip(sensor[0], -_MOST_LOG_SCALE, _MOST_LOG_SCALE))
        seen = scale * self._point @ np.array([[co, so], [-so, co]]).T
        residual = np.zeros((n, 3))
        residual[:, :2] = q + late[:, None] * flow[:, :2] - seen
        turn = np.zeros((n, 2, 2))  # of the point by a later stamp
        turn[:, 0, 0] = turn[:, 1, 1] = 1.0
        turn[:, 0, 1], turn[:, 1, 0] = -late * w, late * w
        yaw = se2.wrap_array(facing - poses[:, 2] + late * w - self._yaw + sensor[1])
        residual[:, 2] = np.where(self._whole, yaw, 0.0)
        J = np.zeros((n, 3, 3))
        J[:, 0, 0] = J[:, 1, 1] = J[:, 2, 2] = -1.0
        J[:, 0, 2], J[:, 1, 2] = q[:, 1], -q[:, 0]
        J[:, :2] = turn @ J[:, :2]
        H = np.zeros((n, 3, 8))
        H[:, :2, 0], H[:, 0, 1], H[:, 1, 1], H[:, 2, 1] = -seen, -seen[:, 1], seen[:, 0], 1.0
        H[:, :, 2], H[:, :2, 3:5], H[:, 2, 5:] = flow, turn @ R, self._up
        H = np.where(self._columns[:, None] >= 0, H, 0.0)
        W = self._whitening
        return Stacked(np.einsum("nij,nj->ni", W, residual), W @ J, W @ H, self._columns, np.zeros(n, dtype=np.bool_))

    def shared(self, i: int, J: FloatArray, H: FloatArray) -> FloatArray:
        """As `Linearized` has it: the noise of these sightings has all in it."""
        return np.zeros((len(J), 0))


def _shrinking(pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors ``(m, 8)`` by which all four corners ``(m, 4, 2)`` move outwards, and how much a marker shrinks.

    Blur draws in the edges of a marker whose cells are not much wider than it.
    """
    outward = pixels - pixels.mean(axis=1, keepdims=True)
    side = np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=2).mean(axis=1)
    unit = outward / np.maximum(np.linalg.norm(outward, axis=2, keepdims=True), 1e-9)
    return unit.reshape(len(pixels), 8), np.minimum((_BLURRED_SIDE_PX / np.maximum(side, 1.0)) ** 2, _MOST_BLURRED)


def _block(installation: Installation, landmark_id: int, rows: int) -> int:
    """Where the state of a landmark begins, if it has as many rows; else -1."""
    first, count = installation.landmarks.get(landmark_id, (-1, 0))
    return first if count >= rows else -1


def cartesian(m: RangeBearingMeasurement) -> tuple[FloatArray, FloatArray]:
    """The sighting as a point ``(2,)`` in the base frame with covariance ``(2, 2)``.

    The frame turned by the bearing has range along its first axis and range times bearing across; first order in the
    bearing's sigma, which is exact enough below 0.2 rad. The true range, which may be off by its sigma, makes the
    sigma across: it does not vanish right at a landmark.
    """
    c, s = np.cos(m.bearing_rad), np.sin(m.bearing_rad)
    r, lever = m.range_m, np.sqrt(m.range_m**2 + m.cov[1, 1])
    J = np.array([[-lever * s, c], [lever * c, s]])  # columns: bearing, range
    cov = J @ m.cov @ J.T
    return np.array([r * c, r * s]), 0.5 * (cov + cov.T)


def _crossed(A: FloatArray, X: FloatArray) -> FloatArray:
    """``A [X]×``, rows of A ``(..., 2, 3)`` and points X ``(..., 3)``: derivative of ``-A (φ × X)`` by φ."""
    return _cross(A, X[..., None, :])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product along the last axis; a third of numpy's time for few points."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def _root(cov: FloatArray) -> FloatArray:
    """A square root of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(cov)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
