"""Poses from single sightings: both solutions for a square, candidates for the base, points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from marker_scenes import base_transform, forward_camera, project, standing, transform

from fgloc import se2
from fgloc.frames import rpy_matrix
from fgloc.sensors.cameras import marker_pose_candidates, marker_pose_cov, planar_base_candidates
from fgloc.types import Camera, FloatArray, Landmark

LENSES = [
    forward_camera(),
    forward_camera(D=(-0.25, 0.08, 0.001, -0.002)),
    replace(forward_camera(D=(-0.013, 0.009, 0.012, -0.004)), model="equidistant"),
]


def true_pose(camera: Camera, pose: FloatArray, marker: Landmark) -> FloatArray:
    return np.linalg.inv(base_transform(pose) @ camera.T_base_cam) @ transform(marker.position, marker.rotation)


@pytest.mark.parametrize("camera", LENSES, ids=["pinhole", "plumb_bob", "equidistant"])
def test_exact_corners_give_the_exact_pose(camera: Camera) -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        pose = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2)])
        marker = standing(4, (rng.uniform(1.0, 2.5), 0.0, 0.4), np.pi + rng.uniform(0.3, 0.8))
        corners = project(camera, pose, marker.corners())
        T, rms = marker_pose_candidates(camera, corners, marker.size_m)[0]
        assert rms < 1e-3
        assert np.abs(T - true_pose(camera, pose, marker)).max() < 2e-3


@pytest.mark.parametrize("roll_deg", range(0, 360, 30))
def test_exact_pose_however_the_camera_is_rolled(roll_deg: int) -> None:
    """Also for rotations by 180 degrees, which OpenCV's IPPE cannot express."""
    upright = forward_camera()
    roll = transform((0.0, 0.0, 0.0), rpy_matrix(0.0, 0.0, np.radians(roll_deg)))
    camera = replace(upright, T_base_cam=upright.T_base_cam @ roll)
    for facing in (np.pi + 0.5, np.pi - 0.7):
        marker = standing(4, (1.6, 0.2, 0.4), facing)
        corners = project(camera, np.zeros(3), marker.corners())
        T, rms = marker_pose_candidates(camera, corners, marker.size_m)[0]
        assert rms < 1e-3
        assert np.abs(T - true_pose(camera, np.zeros(3), marker)).max() < 2e-3


def test_fault_48_planar_ambiguity_gives_both_hypotheses() -> None:
    """With noise the better-looking solution is at times the wrong one; the right one is always among the two."""
    rng = np.random.default_rng(48)
    camera, first_wrong, n = LENSES[0], 0, 60
    for _ in range(n):
        marker = standing(1, (3.5, 0.2, 0.35), np.pi + rng.uniform(0.15, 0.4) * rng.choice([-1, 1]))
        corners = project(camera, np.zeros(3), marker.corners()) + rng.normal(0.0, 0.3, (4, 2))
        found = marker_pose_candidates(camera, corners, marker.size_m)
        assert len(found) == 2
        assert found[0][1] <= found[1][1]
        normal = true_pose(camera, np.zeros(3), marker)[:3, 2]
        angles = [np.degrees(np.arccos(np.clip(T[:3, 2] @ normal, -1, 1))) for T, _ in found]
        assert min(angles) < 30.0
        first_wrong += angles[0] > angles[1]
    assert 3 < first_wrong < n / 2


def test_base_candidates_hold_the_true_pose_with_zero_cost() -> None:
    rng = np.random.default_rng(2)
    for camera in LENSES:
        for _ in range(10):
            pose = np.array([rng.uniform(-2, 2), rng.uniform(-2, 2), rng.uniform(-3, 3)])
            ahead = se2.compose(pose, [rng.uniform(1.0, 4.0), rng.uniform(-0.4, 0.4), np.pi + rng.uniform(-0.8, 0.8)])
            marker = standing(6, (ahead[0], ahead[1], rng.uniform(0.2, 0.6)), ahead[2])
            found = planar_base_candidates(camera, project(camera, pose, marker.corners()), marker)
            best, cost = found[0]
            assert cost < 1e-3
            assert np.abs(se2.log(se2.between(pose, best))).max() < 1e-3


def test_the_floor_tells_the_solutions_apart() -> None:
    """A robot that keeps upright on the floor explains the corners with one of the two solutions only."""
    rng = np.random.default_rng(3)
    camera, right, cheaper = LENSES[0], 0, 0
    n = 40
    for _ in range(n):
        marker = standing(1, (3.0, 0.3, 0.6), np.pi + rng.uniform(0.2, 0.6))
        corners = project(camera, np.zeros(3), marker.corners()) + rng.normal(0.0, 0.3, (4, 2))
        found = planar_base_candidates(camera, corners, marker)
        right += bool(np.abs(found[0][0]).max() < 0.4)
        T = transform(marker.position, marker.rotation) @ np.linalg.inv(
            marker_pose_candidates(camera, corners, marker.size_m)[0][0]
        )
        flattened = T @ np.linalg.inv(camera.T_base_cam)
        cheaper += bool(np.abs(flattened[:2, 3]).max() < 0.4)
    assert right >= 0.9 * n
    assert right > cheaper


def test_a_point_or_degenerate_corners_give_no_candidate() -> None:
    marker = standing(1, (3.0, 0.0, 0.3), np.pi)
    point = replace(marker, size_m=0.0)
    corners = project(LENSES[0], np.zeros(3), marker.corners())
    assert planar_base_candidates(LENSES[0], corners, point) == []
    for bad in (np.tile(corners[:1], (4, 1)), np.full((4, 2), np.nan), np.outer(np.arange(4), [5.0, 5.0]) + 100.0):
        assert planar_base_candidates(LENSES[0], bad, marker) == []


def test_pose_covariance_matches_repeated_measurement() -> None:
    rng = np.random.default_rng(5)
    camera, sigma = LENSES[0], 0.2
    marker = standing(1, (1.5, 0.2, 0.4), np.pi + 0.6)
    truth = true_pose(camera, np.zeros(3), marker)
    corners = project(camera, np.zeros(3), marker.corners())
    errors = []
    for _ in range(400):
        T, _ = marker_pose_candidates(camera, corners + rng.normal(0.0, sigma, (4, 2)), marker.size_m)[0]
        dR = T[:3, :3] @ truth[:3, :3].T
        rotation = 0.5 * np.array([dR[2, 1] - dR[1, 2], dR[0, 2] - dR[2, 0], dR[1, 0] - dR[0, 1]])
        errors.append([*(T[:3, 3] - truth[:3, 3]), *rotation])
    cov = marker_pose_cov(camera, truth, marker.size_m, sigma)
    ratio = np.std(errors, axis=0) / np.sqrt(np.diag(cov))
    assert (np.abs(ratio[:3] - 1.0) < 0.25).all()
    assert (np.abs(ratio[3:] - 1.0) < 0.4).all()


def test_range_error_grows_with_the_square_of_range() -> None:
    camera = LENSES[0]
    sigmas = []
    for distance in (1.0, 2.0, 4.0):
        marker = standing(1, (distance + 0.1, 0.0, 0.25), np.pi)
        cov = marker_pose_cov(camera, true_pose(camera, np.zeros(3), marker), 0.2, 0.3)
        sigmas.append(np.sqrt(cov[2, 2]))
    assert np.allclose(np.array(sigmas[1:]) / sigmas[:-1], 4.0, rtol=0.1)
