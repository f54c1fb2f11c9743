"""Ranges with bearings, and marker poses: residuals and Jacobians of many in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fgloc import se2
from fgloc.graph.installation import Installation
from fgloc.graph.linearized import Stacked, landmark_block
from fgloc.types import (
    FloatArray,
    FrameMeasurement,
    Landmark,
    PointMeasurement,
)

_MOST_LOG_SCALE = 3.0  # of ranges: an estimate that diverges goes on to be refused, not to overflow


class PlanarBatch:
    """Ranges with bearings, as points in the base frame, and marker poses."""

    def __init__(
        self,
        seen: Sequence[PointMeasurement | FrameMeasurement],
        landmarks: Mapping[int, Landmark],
        installation: Installation,
    ) -> None:
        poses = [m.pose if isinstance(m, FrameMeasurement) else None for m in seen]
        self.rows = [2 if pose is None else 3 for pose in poses]
        self._whole = np.array([pose is not None for pose in poses])
        self._yaw = np.array([0.0 if pose is None else pose[2] for pose in poses])
        self._place = np.array([landmarks[m.landmark_id].planar for m in seen])
        self._point = np.zeros((len(seen), 2))
        self._whitening = np.zeros((len(seen), 3, 3))  # of the residual in the base frame
        for i, m in enumerate(seen):
            if isinstance(m, FrameMeasurement):
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
        place = np.array([landmark_block(installation, m.landmark_id, 2) for m in seen])
        turn = np.array([landmark_block(installation, m.landmark_id, 6) for m in seen])
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
        predicted = q + late[:, None] * flow[:, :2]
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
        H = np.zeros((n, 3, 8))  # by scale and bearing of the predicted point: the noise of the measured one would bias
        H[:, :2, 0], H[:, 0, 1], H[:, 1, 1], H[:, 2, 1] = -predicted, -predicted[:, 1], predicted[:, 0], 1.0
        H[:, :, 2], H[:, :2, 3:5], H[:, 2, 5:] = flow, turn @ R, self._up
        H = np.where(self._columns[:, None] >= 0, H, 0.0)
        W = self._whitening
        return Stacked(np.einsum("nij,nj->ni", W, residual), W @ J, W @ H, self._columns, np.zeros(n, dtype=np.bool_))

    def shared_all(self, stack: Stacked) -> FloatArray:
        """`shared` of all sightings ``(m, 3, 0)``."""
        return np.zeros((*stack.residual.shape, 0))

    def shared(self, i: int, J: FloatArray, H: FloatArray) -> FloatArray:
        """As `Linearized` has it: the noise of these sightings has all in it."""
        return np.zeros((len(J), 0))


def cartesian(m: PointMeasurement) -> tuple[FloatArray, FloatArray]:
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
