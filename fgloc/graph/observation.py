"""Sightings as functions of pose and installation: residuals with both Jacobians, for many sightings in one call."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.frames import rotations
from fgloc.graph.installation import CAMERA, Installation, camera_block
from fgloc.sensors.measurements import (
    MIN_DEPTH_M,
    FrameMeasurement,
    LandmarkMeasurement,
    Model,
    PixelMeasurement,
    PointMeasurement,
    PoseMeasurement,
)
from fgloc.types import Camera, FloatArray, IntArray, Landmark

# --- Residuals and Jacobians ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Linearized:
    """Whitened residual and Jacobians of one sighting.

    Attributes:
        residual: ``(d,)`` predicted minus measured, in units of the sighting's own noise.
        J: ``(d, 3)`` by the right perturbation of the pose.
        columns: ``(c,)`` parameters of the installation that it depends on.
        H: ``(d, c)`` by these.
        shared: ``(d, s)`` square root of the covariance that comes on top of the identity: of the stamp's jitter, of
            the base's roll and pitch, and of the motion by which the sighting was moved to its keyframe; the same for
            all of one image.
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
        by_tilt: ``(m, d, 2)`` by roll and pitch of the base; None: they are states, or nothing depends on them.
        whitening: ``(m, d, d)`` by which all of these were multiplied, as the landmark's place is noise too; None: of
            none it is.
    """

    residual: FloatArray
    J: FloatArray
    H: FloatArray
    columns: IntArray
    behind: NDArray[np.bool_]
    by_tilt: FloatArray | None = None
    whitening: FloatArray | None = None

    def with_noise(self, by_landmark: FloatArray | None) -> Stacked:
        """Copy with noise of the landmarks' places, whose square root ``(m, d, s)`` is given; None: there is none."""
        if by_landmark is None:
            return self
        values, vectors = np.linalg.eigh(by_landmark @ np.swapaxes(by_landmark, 1, 2))
        scaled = vectors / np.sqrt(1.0 + np.maximum(values, 0.0))[:, None, :]
        W = scaled @ np.swapaxes(vectors, 1, 2)
        residual = (W @ self.residual[..., None])[..., 0]
        by_tilt = None if self.by_tilt is None else W @ self.by_tilt
        return Stacked(residual, W @ self.J, W @ self.H, self.columns, self.behind, by_tilt, W)


class Batch(Protocol):
    """Measurements of one `Model`, prepared for being evaluated at poses and installations.

    Attributes:
        rows: length of the residual of each.
        spatial: whether poses on uneven ground are ``(m, 6)``, with height, roll and pitch; else ``(m, 3)``.
        alike: whether the measurements of a recording are of one size, so that images of them can be stacked.
    """

    rows: list[int]
    spatial: ClassVar[bool]
    alike: ClassVar[bool]

    def evaluate(self, poses: FloatArray, theta: FloatArray, by_installation: bool = True) -> Stacked:
        """Residuals and Jacobians of all, each at its own pose ``(m, 3)``; without those by the installation faster."""
        ...

    def shared(self, stack: Stacked) -> FloatArray:
        """`Linearized.shared` of all ``(m, d, s)``, with rows and columns of 0 where one has fewer."""
        ...


def landmark_block(installation: Installation, landmark_id: int, rows: int) -> int:
    """First row of a landmark's state, if that has at least ``rows``; else -1."""
    first, count = installation.landmarks.get(landmark_id, (-1, 0))
    return first if count >= rows else -1


def place_roots(installation: Installation, ids: Sequence[int], size: int) -> FloatArray | None:
    """Square roots ``(m, size, size)`` of the covariances of places that are no states; 0 of others, None: of all."""
    if not any(i in installation.stateless for i in ids):
        return None
    roots = np.zeros((len(ids), size, size))
    for root, i in zip(roots, ids, strict=True):
        cov = installation.stateless.get(i)
        if cov is not None:
            n = min(size, len(cov))
            root[:n, :n] = np.linalg.cholesky(cov[:n, :n])
    return roots


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Sightings of one keyframe, linearized together: rows of all of them below each other.

    Attributes:
        residual: ``(d,)`` predicted minus measured, in units of each sighting's own noise.
        H: ``(d, 3 + n)`` by the right perturbation of the pose and by the installation.
        shared: ``(d, s)`` see `Linearized`; of sightings of one image the columns mean the same.
        dofs: number of rows of each sighting.
        behind: ``(m,)`` whether a corner is behind the camera; the rows of that one then mean nothing.
    """

    residual: FloatArray
    H: FloatArray
    shared: FloatArray
    dofs: Sequence[int]
    behind: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.dofs)

    @property
    def parts(self) -> list[slice]:
        """Rows of each sighting."""
        ends = list(accumulate(self.dofs))
        return [slice(end - d, end) for d, end in zip(self.dofs, ends, strict=True)]

    def noise(self) -> FloatArray:
        """Covariance ``(d, d)`` of the residual without pose and installation."""
        return np.asarray(np.eye(len(self.residual)) + self.shared @ self.shared.T)

    def only(self, members: Sequence[int]) -> Lines:
        """Those of some sightings, in this order."""
        if len(members) == len(self) and all(i == j for i, j in enumerate(members)):
            return self
        parts = self.parts
        rows = np.concatenate([np.arange(parts[i].start, parts[i].stop) for i in members])
        dofs = [self.dofs[i] for i in members]
        return Lines(self.residual[rows], self.H[rows], self.shared[rows], dofs, self.behind[list(members)])

    @classmethod
    def of(cls, each: Sequence[Linearized], n: int) -> Lines:
        """Sightings that were linearized one by one; ``n`` parameters has the installation."""
        dofs = [len(one.residual) for one in each]
        r = np.concatenate([one.residual for one in each]) if each else np.zeros(0)
        H = np.zeros((len(r), 3 + n))
        shared = np.zeros((len(r), max((one.shared.shape[1] for one in each), default=0)))
        found = cls(r, H, shared, dofs, np.array([one.behind for one in each], dtype=np.bool_))
        for part, one in zip(found.parts, each, strict=True):
            H[part, :3] = one.J
            H[part, 3 + one.columns] = one.H
            shared[part, : one.shared.shape[1]] = one.shared
        return found


# --- Corners of markers in images -------------------------------------------------------------------------------------

_BLURRED_SIDE_PX = 20.0  # side of a marker that shrinks by as much as its corners are off; falls with the square
_MOST_BLURRED = 2.0
_BEYOND_EDGE = 2.0  # of the squared radius of the image's corner, by which a lens may have drawn that in


class CornerBatch:
    """Corners of markers in images.

    Source: pinhole camera with the distortion of Brown 1966 as OpenCV has it; perturbations on the right.
    """

    spatial: ClassVar[bool] = True
    alike: ClassVar[bool] = True

    def __init__(
        self, seen: Sequence[PixelMeasurement], landmarks: Mapping[int, Landmark], installation: Installation
    ) -> None:
        held = [landmarks[m.landmark_id] for m in seen]
        half = np.array([0.5 * landmark.size_m for landmark in held])
        square = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
        self._local = half[:, None, None] * square  # (m, 4, 3) in the marker's frame
        self._position = np.array([landmark.position for landmark in held])
        self._rotation = np.array([landmark.rotation for landmark in held])
        cameras = {id(m.camera): m.camera for m in seen}
        order = {camera: i for i, camera in enumerate(cameras)}
        of = np.array([order[id(m.camera)] for m in seen])
        T = np.array([camera.T_base_cam for camera in cameras.values()])[of]
        self._R, self._t = T[:, :3, :3], T[:, :3, 3]
        self._K = np.array([camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in cameras.values()])[of]
        self._D = np.array([np.concatenate([camera.D, np.zeros(4)])[:4] for camera in cameras.values()])[of]
        self._widest = np.array([_widest(camera) for camera in cameras.values()])[of]
        self._pixels = np.array([m.corners_px for m in seen])
        self._sigma = np.array([m.sigma_px for m in seen])
        self._twist = np.array([m.twist for m in seen])
        self._tilting = np.array([(*m.tilting, 0.0) for m in seen]) if installation.ground else None
        self._offset = np.array([m.offset_s for m in seen])
        self._jitter = np.array([m.jitter_s for m in seen])
        self._sway = np.array([m.sway_rad for m in seen])
        self._moved = _roots([m.motion_cov for m in seen])
        self._outward, self._small = _shrinking(self._pixels)
        self._blur_px = np.array([m.blur_s for m in seen]) * self._speed(2.0 * half)
        self._noise_px = np.hypot(self._sigma, self._blur_px)
        self.rows = [8] * len(seen)
        firsts = [installation.blocks.get(camera_block(m.camera.name)) for m in seen]
        held_at = np.array([-1 if first is None else first[0] for first in firsts])
        self._camera = np.where(held_at[:, None] >= 0, held_at[:, None] + np.arange(len(CAMERA)), -1)  # (m, 12)
        marker = np.array([landmark_block(installation, m.landmark_id, 6) for m in seen])
        self._columns = np.full((len(seen), 18), -1)
        self._columns[:, :12] = self._camera
        self._columns[:, 12:] = np.where(marker[:, None] >= 0, marker[:, None] + np.arange(6), -1)
        self._constants = installation.constants
        self._roots = place_roots(installation, [m.landmark_id for m in seen], 6)

    def evaluate(self, poses: FloatArray, theta: FloatArray, by_installation: bool = True) -> Stacked:
        """All sightings, each at its own pose ``(m, 3)``; without derivatives by the installation in half the time.

        On uneven ground the poses are ``(m, 6)``, with height, roll and pitch at the end, and so are the Jacobians by
        them; of poses ``(m, 3)`` those are at the end of the installation, and so are the Jacobians.
        """
        if self._tilting is None or poses.shape[1] > 3:
            return self._evaluate(poses, theta, by_installation)
        ground = np.broadcast_to(theta[self._constants :], (len(poses), 3))
        stack = self._evaluate(np.column_stack([poses, ground]), theta, by_installation)
        return self._ground_in_installation(stack, by_installation)

    def _evaluate(self, poses: FloatArray, theta: FloatArray, by_installation: bool) -> Stacked:
        n = len(poses)
        installed = np.append(theta, 0.0)[self._columns]
        camera, marker = installed[:, :12], installed[:, 12:]
        # 1. Corners in the map, in the base frame, at the exposure, in the camera
        turned = _cross(marker[:, None, 3:], self._local)
        local = self._local + turned + 0.5 * _cross(marker[:, None, 3:], turned)
        P = (self._position + marker[:, :3])[:, None] + local @ self._rotation.transpose(0, 2, 1)
        Rz, tilt = _map_base(poses)
        P[:, :, :2] -= poses[:, None, :2]
        if tilt is not None:
            P[:, :, 2] -= poses[:, None, 3]
        q = P @ Rz
        flow = self._flow(q)
        late = camera[:, 11] - self._offset
        mounted = (q + late[:, None, None] * flow - self._t[:, None]) @ self._R
        turned = -_cross(camera[:, None, 3:6], mounted)
        X = mounted + turned - 0.5 * _cross(camera[:, None, 3:6], turned) - camera[:, None, :3]
        behind = (X[:, :, 2] < MIN_DEPTH_M).any(axis=1)
        # 2. Image, with its derivatives by the point in the camera, (m, 4, 2, 3), and by the lens
        predicted, A, by_lens = self._project(X, camera, by_installation)
        # 3. Derivatives
        # by the point in the base frame at the exposure
        across = _cross(A, camera[:, None, None, 3:6])
        B = (A - across + 0.5 * _cross(across, camera[:, None, None, 3:6])) @ self._R.transpose(0, 2, 1)[:, None]
        by_time = (B @ flow[..., None])[..., 0]
        turn = (late * self._twist[:, 2])[:, None, None]
        B[..., 0], B[..., 1] = B[..., 0] + turn * B[..., 1], B[..., 1] - turn * B[..., 0]  # by that at the stamp
        if self._tilting is not None:
            B = B + late[:, None, None, None] * _cross(B, self._tilting[:, None, None])
        scale = 1.0 / self._noise_px
        J: FloatArray = np.stack(
            [-B[..., 0], -B[..., 1], B[..., 0] * q[..., None, 1] - B[..., 1] * q[..., None, 0]], axis=-1
        )
        residual = ((predicted - self._pixels) * scale[:, None, None]).reshape(n, 8)
        if tilt is not None:
            J = _by_tilted_pose(B, q, tilt, poses[:, 4])
        J = (J * scale[:, None, None, None]).reshape(n, 8, -1)
        by_place = None
        if self._roots is not None:
            M = self._marker(B @ Rz.transpose(0, 2, 1)[:, None], local) * scale[:, None, None, None]
            by_place = M.reshape(n, 8, 6) @ self._roots
        if not by_installation:
            return Stacked(residual, J, np.zeros((n, 8, 0)), self._columns, behind).with_noise(by_place)
        assert by_lens is not None
        H: FloatArray = np.empty((n, 4, 2, 18))
        H[..., :3] = -A
        H[..., 3:6] = _crossed(A - 0.5 * across, mounted) + 0.5 * _crossed(A, turned)  # A (½ φ x (φ x X) - φ x X) by φ
        H[..., 6:11] = by_lens
        H[..., 11] = by_time
        by_tilt = None  # as the camera turns in its place: its way about the base is less than a millimetre
        if self._tilting is None:
            about = (H[..., 3:6] @ self._R.transpose(0, 2, 1)[:, None])[..., :2]
            by_tilt = (about * scale[:, None, None, None]).reshape(n, 8, 2)
        H[..., 12:] = self._marker(B @ Rz.transpose(0, 2, 1)[:, None], local)
        H[..., :12] *= (self._camera[:, 0] >= 0)[:, None, None, None]
        H[..., 12:] *= (self._columns[:, 12] >= 0)[:, None, None, None]
        H = (H * scale[:, None, None, None]).reshape(n, 8, 18)
        return Stacked(residual, J, H, self._columns, behind, by_tilt).with_noise(by_place)

    def _flow(self, q: FloatArray) -> FloatArray:
        """How points ``(m, 4, 3)`` in the base frame move by a later stamp [m/s]."""
        flow = np.zeros_like(q)
        flow[:, :, 0] = self._twist[:, None, 0] - self._twist[:, None, 2] * q[:, :, 1]
        flow[:, :, 1] = self._twist[:, None, 1] + self._twist[:, None, 2] * q[:, :, 0]
        return flow if self._tilting is None else flow + _cross(self._tilting[:, None], q)

    def _marker(self, M: FloatArray, local: FloatArray) -> FloatArray:
        """Derivatives ``(m, 4, 2, 6)`` by the marker's place, from those by a point in the map ``(m, 4, 2, 3)``."""
        return np.concatenate([M, -_crossed(M @ self._rotation[:, None], local)], axis=3)

    def _ground_in_installation(self, stack: Stacked, by_installation: bool) -> Stacked:
        """Derivatives by height, roll and pitch as the last ones by the installation."""
        n, J = len(stack.J), stack.J[:, :, :3]
        H, columns = stack.H, stack.columns
        if by_installation:
            H = np.concatenate([H, stack.J[:, :, 3:]], axis=2)
            last = np.broadcast_to(self._constants + np.arange(3), (n, 3))
            columns = np.concatenate([columns, last], axis=1)
        return Stacked(stack.residual, J, H, columns, stack.behind, None, stack.whitening)

    def _project(
        self, X: FloatArray, camera: FloatArray, with_lens: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Pixels of points in the camera's frame.

        Args:
            X: ``(m, 4, 3)`` [m].
            camera: ``(m, 12)`` what camera and clock are off by.
            with_lens: whether the derivatives by the lens are needed.

        Returns:
            Pixels ``(m, 4, 2)``, their derivatives by the points ``(m, 4, 2, 3)``, and those by focal length,
            principal point, k1 and k2 ``(m, 4, 2, 5)``.
        """
        Z = np.maximum(X[:, :, 2], MIN_DEPTH_M)
        x, y = X[:, :, 0] / Z, X[:, :, 1] / Z
        k1, k2 = self._D[:, None, 0] + camera[:, None, 9], self._D[:, None, 1] + camera[:, None, 10]
        p1, p2 = self._D[:, None, 2], self._D[:, None, 3]
        whole = x * x + y * y
        r2 = np.minimum(whole, self._widest[:, None])
        radial = 1.0 + k1 * r2 + k2 * r2 * r2
        xd = x * radial + 2.0 * p1 * x * y + p2 * (whole + 2.0 * x * x)
        yd = y * radial + p1 * (whole + 2.0 * y * y) + 2.0 * p2 * x * y
        f = self._K[:, None, :2] * (1.0 + camera[:, None, 6:7])
        image = np.stack([xd, yd], axis=2)
        predicted = f * image + self._K[:, None, 2:] + camera[:, None, 7:9]
        dr = (k1 + 2.0 * k2 * r2) * (whole <= self._widest[:, None])
        by_ray = np.empty((len(X), 4, 2, 2))
        by_ray[..., 0, 0] = radial + 2.0 * x * x * dr + 2.0 * p1 * y + 6.0 * p2 * x
        by_ray[..., 0, 1] = by_ray[..., 1, 0] = 2.0 * x * y * dr + 2.0 * p1 * x + 2.0 * p2 * y
        by_ray[..., 1, 1] = radial + 2.0 * y * y * dr + 6.0 * p1 * y + 2.0 * p2 * x
        by_ray *= f[:, :, :, None]
        A = np.empty((len(X), 4, 2, 3))
        A[..., :2] = by_ray / Z[..., None, None]
        A[..., 2] = -(by_ray[..., 0] * x[..., None] + by_ray[..., 1] * y[..., None]) / Z[..., None]
        if not with_lens:
            return predicted, A, None
        by_lens = np.empty((len(X), 4, 2, 5))
        by_lens[..., 0] = f * image / (1.0 + camera[:, None, 6:7])
        by_lens[..., 1:3] = np.eye(2)
        by_lens[..., 3] = f * np.stack([x, y], axis=2) * r2[..., None]
        by_lens[..., 4] = by_lens[..., 3] * r2[..., None]
        return predicted, A, by_lens

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

    def shared(self, stack: Stacked) -> FloatArray:
        """Square roots ``(m, 8, s)`` of the covariances that sightings share with their image, see `Linearized`."""
        shrunk = self._outward * (self._small * self._blur_px / self._noise_px)[:, None]
        if stack.whitening is not None:
            shrunk = (stack.whitening @ shrunk[..., None])[..., 0]
        jitter = self._jitter[:, None] * stack.H[:, :, 11]
        common = np.stack([shrunk, jitter], axis=2)
        if stack.by_tilt is not None:
            common = np.concatenate([common, self._sway[:, None, None] * stack.by_tilt], axis=2)
        if all(moved is None for moved in self._moved):
            return common
        roots = np.array([np.zeros((3, 3)) if moved is None else moved for moved in self._moved])
        return np.concatenate([common, stack.J[:, :, :3] @ roots], axis=2)


def _widest(camera: Camera) -> float:
    """Squared tangent of the angle from the optical axis up to which the lens distorts more and more.

    Beyond the image its polynomial means nothing, and grows without bound: a marker with a wrong id that is expected
    beside the camera would agree with everything, and make the lens known exactly. There the edge's distortion holds.
    """
    fx, fy, cx, cy = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    x, y = max(cx, camera.width - cx) / fx, max(cy, camera.height - cy) / fy
    return float(_BEYOND_EDGE * (x * x + y * y))


def _map_base(poses: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """R_map_base ``(m, 3, 3)`` of poses ``(m, 3)``; of ``(m, 6)`` of a base that is not level, and how it is tilted."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    Rz = np.zeros((len(poses), 3, 3))
    Rz[:, 0, 0], Rz[:, 0, 1], Rz[:, 1, 0], Rz[:, 1, 1], Rz[:, 2, 2] = c, -s, s, c, 1.0
    tilt = rotations(poses[:, 4:6]) if poses.shape[1] > 3 else None
    return (Rz, None) if tilt is None else (Rz @ tilt, tilt)


def _by_tilted_pose(B: FloatArray, q: FloatArray, tilt: FloatArray, roll: FloatArray) -> FloatArray:
    """Derivatives ``(m, 4, 2, 6)`` by x, y, yaw (right perturbation), z, roll and pitch.

    Args:
        B: ``(m, 4, 2, 3)`` by the point in the base's axes.
        q: ``(m, 4, 3)`` that point.
        tilt: ``(m, 3, 3)`` ``Ry(pitch) Rx(roll)``.
        roll: ``(m,)`` [rad].
    """
    zero = np.zeros_like(roll)
    axes = np.stack(
        [tilt[:, 2], np.stack([zero + 1.0, zero, zero], 1), np.stack([zero, np.cos(roll), -np.sin(roll)], 1)]
    )
    moved = [-tilt[:, i, None].repeat(4, axis=1) for i in range(2)]  # by x, y: minus those axes, as the base has them
    turned = [-_cross(axis[:, None], q) for axis in axes]  # by yaw, roll, pitch
    by = np.stack([*moved, turned[0], -tilt[:, 2, None].repeat(4, axis=1), *turned[1:]], axis=3)  # (m, 4, 3, 6)
    return np.asarray(B @ by)


def _shrinking(pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors ``(m, 8)`` by which all four corners ``(m, 4, 2)`` move outwards, and how much a marker shrinks.

    Blur draws in the edges of a marker whose cells are not much wider than it.
    """
    outward = pixels - pixels.mean(axis=1, keepdims=True)
    side = np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=2).mean(axis=1)
    unit = outward / np.maximum(np.linalg.norm(outward, axis=2, keepdims=True), 1e-9)
    return unit.reshape(len(pixels), 8), np.minimum((_BLURRED_SIDE_PX / np.maximum(side, 1.0)) ** 2, _MOST_BLURRED)


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


def _roots(covs: Sequence[FloatArray | None]) -> list[FloatArray | None]:
    """Square roots of covariances ``(3, 3)`` that may be singular; of one that several share, once."""
    kept = {id(cov): cov for cov in covs if cov is not None}
    if not kept:
        return [None] * len(covs)
    values, vectors = np.linalg.eigh(np.array(list(kept.values())))
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    by_id: dict[int, FloatArray] = dict(zip(kept, roots, strict=True))
    return [None if cov is None else by_id[id(cov)] for cov in covs]


# --- Ranges and bearings, poses of markers ----------------------------------------------------------------------------

_MOST_LOG_SCALE = 3.0  # of ranges: an estimate that diverges goes on to be refused, not to overflow


class PlanarBatch:
    """Ranges with bearings, as points in the base frame, and marker poses."""

    spatial: ClassVar[bool] = False
    alike: ClassVar[bool] = True

    def __init__(
        self,
        seen: Sequence[PointMeasurement | FrameMeasurement],
        landmarks: Mapping[int, Landmark],
        installation: Installation,
    ) -> None:
        self.rows = [m.dof for m in seen]
        self._whole = np.array([d == 3 for d in self.rows])
        self._yaw = np.zeros(len(seen))
        self._place = np.array([landmarks[m.landmark_id].planar for m in seen])
        self._point = np.zeros((len(seen), 2))
        self._whitening = np.zeros((len(seen), 3, 3))  # of the residual in the base frame
        for i, m in enumerate(seen):
            place, whitening = m.in_base()
            self._point[i], self._yaw[i] = place[:2], place[2] if m.dof == 3 else 0.0
            self._whitening[i, : m.dof, : m.dof] = whitening
        self._twist = np.array([m.twist for m in seen])
        self._offset = np.array([m.offset_s for m in seen])
        first = installation.blocks.get("sightings")
        sensor = [] if first is None else [first[0] + i for i in range(first[1])]
        self._sensor = np.array(sensor + [-1] * (5 - len(sensor)))
        self._up = np.array([landmarks[m.landmark_id].rotation[2] for m in seen])
        place = np.array([landmark_block(installation, m.landmark_id, 2) for m in seen])
        turn = np.array([landmark_block(installation, m.landmark_id, 6) for m in seen])
        self._columns = np.full((len(seen), 10), -1)  # sensor, place, rotation of the landmark
        self._columns[:, :5] = self._sensor
        self._columns[:, 5:7] = np.where(place[:, None] >= 0, place[:, None] + np.arange(2), -1)
        self._columns[:, 7:] = np.where(turn[:, None] >= 0, turn[:, None] + np.arange(3, 6), -1)
        self._roots = place_roots(installation, [m.landmark_id for m in seen], 2)

    def evaluate(self, poses: FloatArray, theta: FloatArray, by_installation: bool = True) -> Stacked:
        """All sightings, each at its own pose ``(m, 3)``; without derivatives by the installation in half the time."""
        n = len(poses)
        held = np.append(theta, 0.0)
        sensor = held[self._sensor]
        place = self._place[:, :2] + held[self._columns[:, 5:7]]
        facing = self._place[:, 2] + np.einsum("ni,ni->n", self._up, held[self._columns[:, 7:]])
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
        predicted = q + late[:, None] * flow[:, :2]
        predicted = predicted - sensor[3:]  # from the base as it is configured
        residual[:, :2] = predicted - seen
        turn = np.zeros((n, 2, 2))  # of the point by a later stamp
        turn[:, 0, 0] = turn[:, 1, 1] = 1.0
        turn[:, 0, 1], turn[:, 1, 0] = -late * w, late * w
        yaw = se2.wrap_array(facing - poses[:, 2] + late * w - self._yaw + sensor[1])
        residual[:, 2] = np.where(self._whole, yaw, 0.0)
        J = np.zeros((n, 3, 3))
        J[:, 0, 0] = J[:, 1, 1] = J[:, 2, 2] = -1.0
        J[:, 0, 2], J[:, 1, 2] = q[:, 1], -q[:, 0]
        J[:, :2] = turn @ J[:, :2]
        H = np.zeros(
            (n, 3, 10)
        )  # by scale and bearing of the predicted point: the noise of the measured one would bias
        H[:, :2, 0], H[:, 0, 1], H[:, 1, 1], H[:, 2, 1] = -predicted, -predicted[:, 1], predicted[:, 0], 1.0
        H[:, 0, 3], H[:, 1, 4] = -1.0, -1.0
        H[:, :, 2], H[:, :2, 5:7], H[:, 2, 7:] = flow, turn @ R, self._up
        H = np.where(self._columns[:, None] >= 0, H, 0.0)
        W = self._whitening
        made = Stacked(np.einsum("nij,nj->ni", W, residual), W @ J, W @ H, self._columns, np.zeros(n, dtype=np.bool_))
        return made if self._roots is None else made.with_noise(W[:, :, :2] @ turn @ R @ self._roots)

    def shared(self, stack: Stacked) -> FloatArray:
        """Matrices ``(m, 3, 0)``: the noise of these sightings has no shared part, see `Linearized`."""
        return np.zeros((*stack.residual.shape, 0))


# --- Measurements of registered sensors -------------------------------------------------------------------------------


class PoseBatch:
    """Measurements of any dimensions; see `PoseMeasurement`."""

    spatial: ClassVar[bool] = False
    alike: ClassVar[bool] = False

    def __init__(
        self, seen: Sequence[PoseMeasurement], landmarks: Mapping[int, Landmark], installation: Installation
    ) -> None:
        self._seen = seen
        self.rows = [len(m.cov) for m in seen]
        self._whitening = [np.asarray(np.linalg.inv(np.linalg.cholesky(m.cov))) for m in seen]
        self._columns = np.full((len(seen), max(len(m.constants) for m in seen)), -1, dtype=np.int64)
        for i, m in enumerate(seen):  # a constant that is exact is no state: it stays at 0
            self._columns[i, : len(m.constants)] = [installation.index.get(name, -1) for name in m.constants]

    def evaluate(self, poses: FloatArray, theta: FloatArray, by_installation: bool = True) -> Stacked:
        """All measurements, each at its own pose ``(m, 3)``; rows beyond a measurement's own are 0."""
        n, most = len(poses), max(self.rows)
        residual, J = np.zeros((n, most)), np.zeros((n, most, 3))
        H = np.zeros((n, most, self._columns.shape[1]))
        values = np.append(theta, 0.0)[self._columns]
        for i, (m, W, d) in enumerate(zip(self._seen, self._whitening, self.rows, strict=True)):
            c = len(m.constants)
            r, by_pose, by_value = m.by_constants_at_keyframe(poses[i], values[i, :c])
            residual[i, :d], J[i, :d], H[i, :d, :c] = W @ r, W @ by_pose, W @ by_value
        H *= (self._columns >= 0)[:, None]
        return Stacked(residual, J, H, self._columns, np.zeros(n, dtype=np.bool_))

    def shared(self, stack: Stacked) -> FloatArray:
        """Square roots ``(m, d, s)`` of the covariances by the motions to the keyframe, see `Linearized`."""
        moved = [(i, m, m.motion_cov) for i, m in enumerate(self._seen) if m.motion_cov is not None]
        shared = np.zeros((*stack.residual.shape, se2.DOF if moved else 0))
        for i, m, cov in moved:
            J = stack.J[i, : self.rows[i]]
            values, vectors = np.linalg.eigh(cov)
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            shared[i, : self.rows[i]] = J @ se2.adjoint(m.T_keyframe_then) @ root
        return shared


# --- Sightings of any kind --------------------------------------------------------------------------------------------

_BATCHES: Mapping[Model, Callable[[Sequence[Any], Mapping[int, Landmark], Installation], Batch]] = {
    Model.CORNERS: CornerBatch,
    Model.PLANAR: PlanarBatch,
    Model.POSE: PoseBatch,
}


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
        self.batches: list[tuple[list[int], Batch]] = []
        for model, batch in _BATCHES.items():
            members = [i for i, m in enumerate(measurements) if m.model is model]
            if members:
                self.batches.append((members, batch([measurements[i] for i in members], landmarks, installation)))

    def __len__(self) -> int:
        return self._count

    def squares(self, poses: FloatArray, theta: FloatArray) -> tuple[FloatArray, IntArray]:
        """Squared residual ``(m,)`` of each sighting by its own noise, infinite of one behind the camera, and its rows.

        Args:
            poses: ``(m, 3)`` of each; on uneven ground ``(m, 6)``, with height, roll and pitch.
            theta: ``(n,)`` installation.
        """
        found, rows = np.zeros(self._count), np.zeros(self._count, dtype=np.int64)
        for members, batch in self.batches:
            own = poses[members] if batch.spatial else poses[members, :3]
            stack = batch.evaluate(own, theta, by_installation=False)
            found[members] = np.where(stack.behind, np.inf, (stack.residual**2).sum(axis=1))
            rows[members] = batch.rows
        return found, rows

    def together(self, pose: FloatArray, theta: FloatArray) -> Lines:
        """All sightings at a pose ``(3,)`` and an installation ``(n,)``, as one system of rows."""
        if len(self.batches) == 1:
            batch = self.batches[0][1]
            stack = batch.evaluate(np.broadcast_to(pose, (self._count, 3)), theta)
            m, d = stack.residual.shape
            if batch.alike and min(batch.rows) == d:
                H = np.zeros((m, d, 4 + len(theta)))  # the last column takes what is no state
                H[:, :, :3] = stack.J
                columns = np.where(stack.columns < 0, len(theta), stack.columns) + 3
                H[np.arange(m)[:, None, None], np.arange(d)[:, None], columns[:, None]] = stack.H
                rows = H.reshape(m * d, -1)[:, :-1]
                return Lines(
                    stack.residual.ravel(), rows, batch.shared(stack).reshape(m * d, -1), batch.rows, stack.behind
                )
        return Lines.of(self.linearize(pose, theta), len(theta))

    def linearize(self, poses: FloatArray, theta: FloatArray) -> list[Linearized]:
        """Every sighting at a pose ``(3,)``, or each at its own ``(m, 3)``, and an installation ``(n,)``."""
        each = np.broadcast_to(poses, (self._count, 3))
        found: dict[int, Linearized] = {}
        for rows, batch in self.batches:
            stack = batch.evaluate(each[rows], theta)
            all_shared = batch.shared(stack)
            for i, row in enumerate(rows):
                used = stack.columns[i] >= 0
                d = batch.rows[i]
                H, J = stack.H[i, :d], stack.J[i, :d]
                found[row] = Linearized(
                    stack.residual[i, :d],
                    J,
                    stack.columns[i][used],
                    H[:, used],
                    all_shared[i, :d],
                    bool(stack.behind[i]),
                )
        return [found[i] for i in range(self._count)]
