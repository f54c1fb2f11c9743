"""Markers that may be turned in either of two directions.

A flat square seen from about one direction and with little perspective looks the same when it is mirrored about the
line of sight. Both directions are minima of the cost, so that what was found is compared with its mirror image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from fgloc.graph.installation import Installation
from fgloc.graph.observation import Observations
from fgloc.types import FloatArray, Landmark, PixelMeasurement

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
    cameras = np.array([_camera(m, pose) for m, pose in zip(measurements, poses, strict=True)])
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


def _camera(m: PixelMeasurement, pose: FloatArray) -> FloatArray:
    x, y, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    a, b, height = m.camera.T_base_cam[:3, 3]
    return np.array([x + c * a - s * b, y + s * a + c * b, height])
