"""Poses from single sightings: where a marker is in the camera, and where that puts the robot."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from fgloc import se2
from fgloc.sensors.cameras import without_distortion
from fgloc.types import Camera, FloatArray, Landmark

_MIN_DEPTH_M = 0.01
_EXPLAINED_PX = 3.0  # a surveyed map and a calibrated camera leave less
_ITERATIONS = 20
_SAME = 1e-3  # metres and radians: two refined poses nearer than this are one
_TILT_SIGMA = 1.0  # rad; what is known of a marker's orientation beforehand, so that a frontal view has a covariance


def marker_pose_candidates(
    camera: Camera, corners_px: FloatArray, size_m: float
) -> tuple[tuple[FloatArray, float], ...]:
    """Poses of one square marker that explain its corners, the better one first.

    A flat square seen with little perspective has two, mirrored about the line of sight.

    Args:
        camera: intrinsics; any lens model.
        corners_px: ``(4, 2)`` in the order of MarkerCorners.
        size_m: side.

    Returns:
        ``T_cam_marker (4, 4)`` and root mean square reprojection error [px], without distortion; up to two, none for
        degenerate corners.

    Source: Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 109, 2014 (OpenCV's IPPE_SQUARE).
    """
    ideal, corners = without_distortion(camera, corners_px)
    if not np.isfinite(corners).all():
        return ()
    # 1. Solve in a frame whose axes lie along the camera's: OpenCV turns the rotation into a vector and loses it where
    #    its angle is near 180 degrees, as that of an upright marker in an upright camera is.
    across = corners[1] - corners[0]
    quarter_turns = -round(math.atan2(across[1], across[0]) / (0.5 * math.pi))
    turned = np.roll(corners, -quarter_turns, axis=0)[::-1]  # from the bottom left, counter-clockwise in the image
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            _square(size_m), turned, ideal.K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
    except cv2.error:  # collinear corners
        return ()
    # 2. Turn back: half a turn about x, then as many quarter turns about z.
    c, s = round(math.cos(0.5 * math.pi * quarter_turns)), round(math.sin(0.5 * math.pi * quarter_turns))
    back = np.diag([1.0, -1.0, -1.0]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    found = []
    for r, t in zip(rotations, translations, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(r)[0] @ back, np.asarray(t).ravel()
        points = _square(size_m) @ T[:3, :3].T + T[:3, 3]
        if np.isfinite(T).all() and points[:, 2].min() > _MIN_DEPTH_M:
            found.append((T, _rms(_project(ideal.K, points) - corners)))
    return tuple(sorted(found, key=lambda f: f[1]))


def marker_pose_cov(camera: Camera, T_cam_marker: FloatArray, size_m: float, sigma_px: float) -> FloatArray:
    """Covariance ``(6, 6)`` of a pose from four corners with this noise: first order, about one solution.

    Order: translation, then rotation, both as left perturbations in the camera's axes.
    """
    rotated = _square(size_m) @ T_cam_marker[:3, :3].T
    points = rotated + T_cam_marker[:3, 3]
    information = np.diag([0.0] * 3 + [_TILT_SIGMA**-2] * 3)
    for arm, point in zip(rotated, points, strict=True):
        J = _pixel_jacobian(camera.K, point) @ np.hstack([np.eye(3), -_cross(arm)])
        information += J.T @ J / sigma_px**2
    cov = np.linalg.inv(information)
    return np.asarray(0.5 * (cov + cov.T))


def planar_base_candidates(camera: Camera, corners: FloatArray, landmark: Landmark) -> list[tuple[FloatArray, float]]:
    """Poses of the base on the floor that explain one known marker's corners, the better one first.

    Both solutions for the marker are flattened, then refined with the base kept upright and on the floor: this uses
    what a single-marker pose does not know, and mostly tells the two apart.

    Args:
        camera: intrinsics and mounting; any lens model.
        corners: ``(4, 2)`` pixels in the order of MarkerCorners.
        landmark: the marker, with its size.

    Returns:
        ``T_map_base (3,)`` and root mean square reprojection error [px]; none if the marker is a point, or is nowhere
        before the camera.
    """
    if landmark.size_m <= 0.0:
        return []
    ideal, pixels = without_distortion(camera, corners)
    T_map_marker = np.eye(4)
    T_map_marker[:3, :3], T_map_marker[:3, 3] = landmark.rotation, landmark.position
    T_cam_base = np.linalg.inv(camera.T_base_cam)
    found: list[tuple[FloatArray, float]] = []
    for T_cam_marker, _ in marker_pose_candidates(camera, corners, landmark.size_m):
        T = T_map_marker @ np.linalg.inv(T_cam_marker) @ T_cam_base
        start = np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])
        refined = _refine(ideal, pixels, landmark.corners(), start)
        if refined is not None and not any(np.abs(se2.log(se2.between(p, refined[0]))).max() < _SAME for p, _ in found):
            found.append(refined)
    return sorted(found, key=lambda f: f[1])


def up_in_base(camera: Camera, seen: Sequence[tuple[FloatArray, Landmark]]) -> FloatArray | None:
    """The map's z axis ``(3,)`` in the base's axes, from several known markers in one image.

    Args:
        camera: intrinsics and mounting; any lens model.
        seen: corners ``(4, 2)`` [px] of each marker, in the order of MarkerCorners.

    Returns:
        None where no pose explains them.

    Source: Terzakis and Lourakis, "A consistently fast and globally optimal solution to the perspective-n-point
    problem", ECCV 2020 (OpenCV's SQPNP).
    """
    ideal, pixels = without_distortion(camera, np.vstack([corners for corners, _ in seen]))
    points = np.vstack([landmark.corners() for _, landmark in seen])
    if not np.isfinite(pixels).all() or any(landmark.size_m <= 0.0 for _, landmark in seen):
        return None
    try:
        found, r, t = cv2.solvePnP(points, pixels, ideal.K, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        return None
    if not found or not np.isfinite(r).all() or not np.isfinite(t).all():
        return None
    R_cam_map = cv2.Rodrigues(r)[0]
    in_cam = points @ R_cam_map.T + np.asarray(t).ravel()
    if in_cam[:, 2].min() < _MIN_DEPTH_M or _rms(_project(ideal.K, in_cam) - pixels) > _EXPLAINED_PX:
        return None
    return np.asarray(camera.T_base_cam[:3, :3] @ R_cam_map[:, 2])


def _refine(
    camera: Camera, pixels: FloatArray, corners_map: FloatArray, pose: FloatArray
) -> tuple[FloatArray, float] | None:
    """Levenberg–Marquardt over x, y, yaw on the reprojection of known points; None if they fall behind the camera."""
    T_cam_base = np.linalg.inv(camera.T_base_cam)
    R, t = T_cam_base[:3, :3], T_cam_base[:3, 3]

    def linearise(at: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        c, s = math.cos(at[2]), math.sin(at[2])
        base = (corners_map - [at[0], at[1], 0.0]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        points = base @ R.T + t
        if points[:, 2].min() < _MIN_DEPTH_M:
            return None
        rows = []
        for (bx, by, _), point in zip(base, points, strict=True):
            moved = np.array([[-1.0, 0.0, by], [0.0, -1.0, -bx], [0.0, 0.0, 0.0]])  # of the point in the base
            rows.append(_pixel_jacobian(camera.K, point) @ R @ moved)
        return (_project(camera.K, points) - pixels).ravel(), np.vstack(rows)

    state = linearise(pose)
    damping = 1e-3
    for _ in range(_ITERATIONS):
        if state is None:
            return None
        residual, J = state
        normal = J.T @ J
        step = np.asarray(-np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), J.T @ residual))
        moved = se2.compose(pose, step)
        trial = linearise(moved)
        if trial is not None and trial[0] @ trial[0] < residual @ residual:
            pose, state, damping = moved, trial, 0.1 * damping
        else:
            damping *= 10.0
        if np.abs(step).max() < 1e-9 or damping > 1e12:
            break
    return None if state is None else (pose, _rms(state[0]))


def _square(size_m: float) -> FloatArray:
    h = 0.5 * size_m
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def _project(K: FloatArray, points: FloatArray) -> FloatArray:
    pixels = points @ K.T
    return np.asarray(pixels[:, :2] / pixels[:, 2:])


def _pixel_jacobian(K: FloatArray, point: FloatArray) -> FloatArray:
    """Of the pixel by the point in the camera ``(2, 3)``."""
    x, y, z = point
    return np.asarray(K[:2, :2] @ np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]]))


def _cross(v: FloatArray) -> FloatArray:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _rms(residuals: FloatArray) -> float:
    """Root mean square distance [px] of residuals ``(n, 2)`` or ``(2 n,)``."""
    return math.sqrt(float((np.asarray(residuals).reshape(-1, 2) ** 2).sum(axis=1).mean()))
