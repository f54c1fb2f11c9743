"""What a range and bearing of a beacon tells: a ring of poses, residuals and their derivatives, likelihoods."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.graph.joint import LINEAR_M
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.types import FloatArray, PointMeasurement

RING = 24  # pieces of a ring, 15 degrees apart


@dataclass(slots=True, eq=False)
class Track:
    """Where a beacon is in the base frame by some of its sightings: ``(2,)`` [m], ``(2, 2)``, and how many."""

    point: FloatArray
    cov: FloatArray
    count: int = 1


class SeenBeacons:
    """Where beacons are in the base frame, each by its own sightings: wherever it stands in the map.

    Each has two tracks at most, as sightings with a wrong id, or before the robot was pushed, agree with no others.
    """

    def __init__(self) -> None:
        self._tracks: dict[int, list[Track]] = {}  # the one that agreed last first

    def move(self, motion: FloatArray, cov: FloatArray) -> None:
        """The robot moved: ``(3,)``, with the covariance ``(3, 3)`` of a right perturbation."""
        back = se2.adjoint(se2.inverse(motion))[:2, :2]
        for track in (track for tracks in self._tracks.values() for track in tracks):
            x, y = track.point = back @ (track.point - motion[:2])
            J = np.array([[-1.0, 0.0, y], [0.0, -1.0, -x]])
            track.cov = back @ track.cov @ back.T + J @ cov @ J.T

    def place(self, landmark_id: int) -> FloatArray:
        """Where most sightings put it ``(2,)``."""
        return max(self._tracks[landmark_id], key=lambda track: track.count).point

    def take(self, m: PointMeasurement, R: FloatArray, least: float) -> float | None:
        """Add a sighting with the covariance ``R``; its log density given those before, None if below the least."""
        tracks = self._tracks.setdefault(m.landmark_id, [])
        for track in tracks:
            residual, by_pose = residuals(np.zeros((1, 3)), track.point, m)
            J = -by_pose[0, :, :2]
            S = J @ track.cov @ J.T + R
            if (density := float(log_density(residual, S[None])[0])) > least:
                gain = track.cov @ J.T @ np.linalg.inv(S)
                track.point, track.cov = track.point + gain @ residual[0], track.cov - gain @ S @ gain.T
                track.count += 1
                tracks.sort(key=lambda other: other is not track)
                return density
        at = _point_by_sighting(m)
        self._tracks[m.landmark_id] = [Track(m.point, at @ R @ at.T), *tracks[:1]]
        return None


def ring(place: FloatArray, m: PointMeasurement, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses ``(n, 3)`` all around a beacon seen so, with covariances that let each reach the next."""
    yaws = np.linspace(-math.pi, math.pi, RING, endpoint=False)
    x, y = m.point
    c, s = np.cos(yaws), np.sin(yaws)
    poses = np.column_stack([place[0] - c * x + s * y, place[1] - s * x - c * y, yaws])
    about = np.array([y, -x, 1.0])  # turning about the point (x, y) of the body
    at = _point_by_sighting(m)
    cov = np.zeros((3, 3))
    cov[:2, :2] = at @ R @ at.T
    cov += np.outer(about, about) * (math.pi / RING) ** 2
    return poses, np.repeat(cov[None], RING, axis=0)


def residuals(poses: FloatArray, place: FloatArray, m: PointMeasurement) -> tuple[FloatArray, FloatArray]:
    """Measured minus predicted bearing and range ``(n, 2)``, and the prediction's Jacobian ``(n, 2, 3)``."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = place[..., 0] - poses[:, 0], place[..., 1] - poses[:, 1]
    x, y = c * dx + s * dy, c * dy - s * dx
    r = np.maximum(np.hypot(x, y), LINEAR_M)
    residual = np.column_stack([se2.wrap_array(m.bearing_rad - np.arctan2(y, x)), m.range_m - r])
    J = np.zeros((len(poses), 2, 3))
    J[:, 0] = np.column_stack([y / r**2, -x / r**2, -np.ones_like(r)])
    J[:, 1] = np.column_stack([-x / r, -y / r, np.zeros_like(r)])
    return residual, J


def _point_by_sighting(m: PointMeasurement) -> FloatArray:
    """Derivative ``(2, 2)`` of a point in the base frame by bearing and range."""
    c, s = math.cos(m.bearing_rad), math.sin(m.bearing_rad)
    return np.array([[-m.range_m * s, c], [m.range_m * c, s]])


def log_density(residual: FloatArray, S: FloatArray) -> FloatArray:
    """Of sightings: residuals ``(n, 2)`` and their covariances ``(n, 2, 2)``."""
    nis = np.einsum("ni,ni->n", residual, np.linalg.solve(S, residual[:, :, None])[:, :, 0])
    return np.asarray(-math.log(2.0 * math.pi) - 0.5 * (nis + np.log(np.linalg.det(S))))


def moments(poses: FloatArray, covs: FloatArray, weights: FloatArray) -> PoseWithCovariance:
    """Mean and covariance of a sum of Gaussians ``(n, 3)``, ``(n, 3, 3)``, ``(n,)``, with what bent rings add."""
    variances, axes = np.linalg.eigh(covs)
    spread = axes * np.sqrt(se2.DOF * np.maximum(variances, 0.0))[:, None, :]
    points = np.stack(
        [
            se2.compose_array(poses, se2.exp_array(sign * spread[:, :, j]))
            for j in range(se2.DOF)
            for sign in (-1.0, 1.0)
        ],
        1,
    )
    share = np.repeat(weights / (2 * se2.DOF), 2 * se2.DOF)
    x, y, yaw = points.reshape(-1, 3).T
    middle = math.atan2(float(share @ np.sin(yaw)), float(share @ np.cos(yaw)))
    mean = np.array([share @ x, share @ y, middle])
    off = np.column_stack([x - mean[0], y - mean[1], se2.wrap_array(yaw - middle)])
    mean[2] = se2.wrap(middle + float(share @ off[:, 2]))
    off[:, 2] -= share @ off[:, 2]
    return PoseWithCovariance(mean, se2.rotate_cov((off * share[:, None]).T @ off, -float(mean[2])))
