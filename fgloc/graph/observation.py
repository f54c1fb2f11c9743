"""Sightings as functions of pose and installation: residuals with both Jacobians, for many sightings in one call."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

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
        self._corners = [i for i, m in enumerate(measurements) if isinstance(m, CornerMeasurement)]
        self._planar = [i for i, m in enumerate(measurements) if not isinstance(m, CornerMeasurement)]
        self._made: list[CornerBatch | PlanarBatch] = []
        if self._corners:
            seen = [m for m in measurements if isinstance(m, CornerMeasurement)]
            self._made.append(CornerBatch(seen, landmarks, installation))
        if self._planar:
            rest = [m for m in measurements if not isinstance(m, CornerMeasurement)]
            self._made.append(PlanarBatch(rest, landmarks, installation))

    def __len__(self) -> int:
        return self._count

    def linearize(self, poses: FloatArray, theta: FloatArray) -> list[Linearized]:
        """Every sighting at a pose ``(3,)``, or each at its own ``(m, 3)``, and an installation ``(n,)``."""
        each = np.broadcast_to(poses, (self._count, 3))
        found: dict[int, Linearized] = {}
        for rows, batch in zip([r for r in (self._corners, self._planar) if r], self._made, strict=True):
            found.update(zip(rows, batch.linearize(each[rows], theta), strict=True))
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
        self._moved = [m.motion_cov for m in seen]
        first = installation.blocks.get("camera")
        self._camera = None if first is None else np.arange(first[0], first[0] + 12)
        self._marker = np.array([installation.landmarks.get(m.landmark_id, (-1, 0))[0] for m in seen])
        self._marker[[installation.landmarks.get(m.landmark_id, (-1, 0))[1] != 6 for m in seen]] = -1

    def linearize(self, poses: FloatArray, theta: FloatArray) -> list[Linearized]:
        """As `Observations.linearize`, with a pose for each."""
        n = len(poses)
        camera = np.zeros(12) if self._camera is None else theta[self._camera]
        marker = np.zeros((n, 6))
        for i, first in enumerate(self._marker):
            if first >= 0:
                marker[i] = theta[first : first + 6]
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
        q = q + (camera[11] - self._offset)[:, None, None] * flow
        X = (q - self._t[:, None]) @ self._R
        X = X - camera[:3] - _cross(camera[3:6], X)
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
        B = A @ self._R.transpose(0, 2, 1)[:, None]  # by the point in the base frame
        scale = 1.0 / self._sigma
        J: FloatArray = np.stack(
            [-B[..., 0], -B[..., 1], B[..., 0] * q[..., None, 1] - B[..., 1] * q[..., None, 0]], axis=-1
        )
        H: FloatArray = np.empty((n, 4, 2, 18))
        H[..., :3] = -A
        H[..., 3:6] = _crossed(A, X)  # -A (φ x X) by φ
        H[..., 6] = f * image / (1.0 + camera[6])
        H[..., 7:9] = np.eye(2)
        H[..., 9] = f * np.stack([x, y], axis=2) * r2[..., None]
        H[..., 10] = H[..., 9] * r2[..., None]
        H[..., 11] = (B @ flow[..., None])[..., 0]
        M = B @ Rz.transpose(0, 2, 1)[:, None]
        H[..., 12:15] = M
        H[..., 15:] = -_crossed(M @ self._rotation[:, None], local)
        residual = ((predicted - self._pixels) * scale[:, None, None]).reshape(n, 8)
        J = (J * scale[:, None, None, None]).reshape(n, 8, 3)
        H = (H * scale[:, None, None, None]).reshape(n, 8, 18)
        return [self._one(i, residual[i], J[i], H[i], bool(behind[i])) for i in range(n)]

    def _one(self, i: int, residual: FloatArray, J: FloatArray, H: FloatArray, behind: bool) -> Linearized:
        shared = [self._jitter[i] * H[:, 11:12]]
        moved = self._moved[i]
        if moved is not None:
            shared.append(J @ _root(moved))
        first = self._marker[i]
        parts, columns = [], []
        if self._camera is not None:
            parts.append(H[:, :12])
            columns.append(self._camera)
        if first >= 0:
            parts.append(H[:, 12:])
            columns.append(np.arange(first, first + 6))
        used = np.concatenate(columns) if columns else np.zeros(0, dtype=int)
        return Linearized(residual, J, used, np.hstack(parts) if parts else np.zeros((8, 0)), np.hstack(shared), behind)


class PlanarBatch:
    """Ranges with bearings, as points in the base frame, and marker poses."""

    def __init__(
        self,
        seen: Sequence[RangeBearingMeasurement | MarkerPoseMeasurement],
        landmarks: Mapping[int, Landmark],
        installation: Installation,
    ) -> None:
        self._seen = list(seen)
        self._poses = [m if isinstance(m, MarkerPoseMeasurement) else None for m in seen]
        self._place = np.array([landmarks[m.landmark_id].planar for m in seen])
        self._point, whitenings = [], []
        for m in seen:
            point, cov = (m.pose[:2], m.cov) if isinstance(m, MarkerPoseMeasurement) else cartesian(m)
            self._point.append(point)
            whitenings.append(np.linalg.inv(np.linalg.cholesky(cov)))
        self._whitening = whitenings
        first = installation.blocks.get("sightings")
        self._sensor = None if first is None else np.arange(first[0], first[0] + 3)
        self._landmark = [installation.landmarks.get(m.landmark_id) for m in seen]
        self._rotation = [landmarks[m.landmark_id].rotation for m in seen]

    def linearize(self, poses: FloatArray, theta: FloatArray) -> list[Linearized]:
        """As `Observations.linearize`, with a pose for each."""
        return [self._one(i, pose, theta) for i, pose in enumerate(poses)]

    def _one(self, i: int, pose: FloatArray, theta: FloatArray) -> Linearized:
        m = self._seen[i]
        sensor = np.zeros(3) if self._sensor is None else theta[self._sensor]
        moved = np.zeros(3)
        block = self._landmark[i]
        if block is not None:
            moved[:2] = theta[block[0] : block[0] + 2]
            if block[1] == 6:
                moved[2] = self._rotation[i][2] @ theta[block[0] + 3 : block[0] + 6]
        place = self._place[i] + moved
        c, s = np.cos(pose[2]), np.sin(pose[2])
        R_base_map = np.array([[c, s], [-s, c]])
        q = R_base_map @ (place[:2] - pose[:2])
        flow = np.array([m.twist[0] - m.twist[2] * q[1], m.twist[1] + m.twist[2] * q[0], m.twist[2]])
        late = sensor[2] - m.offset_s
        co, so = np.cos(sensor[1]), np.sin(sensor[1])
        seen = (
            math.exp(max(-_MOST_LOG_SCALE, min(_MOST_LOG_SCALE, sensor[0])))
            * np.array([[co, so], [-so, co]])
            @ self._point[i]
        )
        J = np.array([[-1.0, 0.0, q[1]], [0.0, -1.0, -q[0]], [0.0, 0.0, -1.0]])
        H = np.zeros((3, 6))  # sensor, place, yaw of the landmark
        H[:2, 0], H[0, 1], H[1, 1], H[2, 1] = -seen, -seen[1], seen[0], 1.0
        H[:, 2], H[:2, 3:5], H[2, 5] = flow, R_base_map, 1.0
        residual = np.array([*(q + late * flow[:2] - seen), 0.0])
        if not isinstance(m, MarkerPoseMeasurement):
            residual, J, H = residual[:2], J[:2], H[:2]
        else:
            residual[2] = se2.wrap(place[2] - pose[2] + late * flow[2] - m.pose[2] + sensor[1])
            cm, sm = np.cos(m.pose[2]), np.sin(m.pose[2])
            turn = np.array([[cm, sm, 0.0], [-sm, cm, 0.0], [0.0, 0.0, 1.0]])
            residual, J, H = turn @ residual, turn @ J, turn @ H
        W = self._whitening[i]
        residual, J, H = W @ residual, W @ J, W @ H
        parts, columns = [], []
        if self._sensor is not None:
            parts.append(H[:, :3])
            columns.append(self._sensor)
        if block is not None:
            parts.append(H[:, 3:5])
            columns.append(np.arange(block[0], block[0] + 2))
            if block[1] == 6:
                parts.append(H[:, 5:] @ self._rotation[i][2][None])
                columns.append(np.arange(block[0] + 3, block[0] + 6))
        used = np.concatenate(columns) if columns else np.zeros(0, dtype=int)
        by_installation = np.hstack(parts) if parts else np.zeros((len(residual), 0))
        return Linearized(residual, J, used, by_installation, np.zeros((len(residual), 0)))


def cartesian(m: RangeBearingMeasurement) -> tuple[FloatArray, FloatArray]:
    """The sighting as a point ``(2,)`` in the base frame with covariance ``(2, 2)``.

    The frame turned by the bearing has range along its first axis and range times bearing across; first order in the
    bearing's sigma, which is exact enough below 0.2 rad.
    """
    c, s = np.cos(m.bearing_rad), np.sin(m.bearing_rad)
    r = m.range_m
    J = np.array([[-r * s, c], [r * c, s]])  # columns: bearing, range
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
