"""Approximate poses of markers: from single views of each, and by aligning two surveys that share some of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.sensors.pnp import marker_pose_candidates
from fgloc.types import FloatArray, PixelMeasurement

_AGREE_M, _AGREE_PER_M, _AGREE_RAD = 0.15, 0.08, 0.6  # views of one marker that are nearer than this mean the same
_VOTERS = 40  # views of a marker that propose where it is
_LEAST_SHARE = 0.5  # of the views that have to agree
_ALIGNED_M, _ALIGNED_RAD = 0.4, 0.5  # a marker in two surveys
_SPREAD_M = 0.25  # standard deviation of places that determine a direction


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """Where a marker is, about.

    Attributes:
        T: ``(4, 4)`` takes its coordinates to those of the trajectory.
        agreeing: stamps of the views that agree.
        views: how many there were.
    """

    T: FloatArray
    agreeing: frozenset[int]
    views: int


def guess(
    poses: FloatArray, seen: Sequence[Sequence[PixelMeasurement]], sizes: Mapping[int, float], least: int
) -> tuple[dict[int, Guess], dict[int, str]]:
    """Where the views of each marker agree that it is.

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
        best = np.eye(4)
        best[:3, 3] = np.median(chosen[:, :3, 3], axis=0)
        best[:3, :3] = Rotation.from_matrix(chosen[:, :3, :3]).mean().as_matrix()
    support = np.flatnonzero(_near(best, both, depths).any(axis=1))
    return Guess(best, frozenset(views[i][0] for i in support), len(views))


def _near(one: FloatArray, both: FloatArray, depths: FloatArray) -> FloatArray:
    """Whether each pose of each view is about this one ``(n, 2)``."""
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
    """``(4, 4)`` of a pose on the floor."""
    x, y, yaw = pose
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = x, y
    return T


def moved_poses(motion: FloatArray, poses: FloatArray) -> FloatArray:
    """Poses ``(n, 3)`` in another frame."""
    return np.array([se2.compose(motion, pose) for pose in poses]).reshape(-1, 3)
