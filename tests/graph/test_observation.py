"""Sightings by pose and installation: residuals against GTSAM's, derivatives against finite differences."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from robot_world import config, standing

from fgloc import se2
from fgloc.graph.installation import CAMERA, MARKER, PLACE, SENSOR, Installation, installation_of
from fgloc.graph.noise import sighting_whitening
from fgloc.graph.observation import MIN_DEPTH_M, Observations
from fgloc.sensors.measurements import FrameMeasurement, PixelMeasurement, PointMeasurement
from fgloc.sensors.uwb import BIAS, SCALE, UwbRange
from fgloc.types import Camera, Landmark, LandmarkMap

K = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
D = np.array([0.05, -0.02, 0.001, -0.002])
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x right, y down, z forward


def rotation(rng, size: float) -> np.ndarray:
    return gtsam.Rot3.Expmap(rng.normal(0.0, size, 3)).matrix()


def scene(seed: int, n: int = 5):
    """Poses, markers in front of a tilted, distorting camera, and what it sees of them, not quite where they are."""
    rng = np.random.default_rng(seed)
    poses, markers, seen = [], {}, []
    for i in range(n):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = FORWARD @ rotation(rng, 0.1), rng.normal((0.1, 0.0, 0.3), 0.1)
        pose = np.array([*rng.uniform(-2, 2, 2), rng.uniform(-3, 3)])
        x, y, yaw = se2.compose(pose, (rng.uniform(1.5, 4.0), rng.uniform(-0.5, 0.5), np.pi + rng.uniform(-0.5, 0.5)))
        flat = standing(i, x, y, yaw, 0.2)
        place = flat.position + np.array([0.0, 0.0, 0.2])
        markers[i] = replace(flat, position=place, rotation=flat.rotation @ rotation(rng, 0.1))
        camera = Camera(640, 480, "plumb_bob", K, D, T)
        poses.append(pose)
        seen.append(PixelMeasurement(0, i, np.zeros((4, 2)), 0.5, camera))
    at_truth = Observations(seen, markers, Installation({})).linearize(np.array(poses), np.zeros(0))
    seen = [
        replace(
            m,
            corners_px=0.5 * one.residual.reshape(4, 2) + rng.normal(0.0, 2.0, (4, 2)),
            twist=rng.normal(0.0, 0.5, 3),
            offset_s=rng.normal(0.0, 0.02),
            jitter_s=0.002,
        )
        for m, one in zip(seen, at_truth, strict=True)
    ]
    return np.array(poses), LandmarkMap(markers), seen


def planar_scene(seed: int, n: int = 6):
    rng = np.random.default_rng(seed)
    poses, landmarks, seen = [], {}, []
    for i in range(n):
        pose = np.array([*rng.uniform(-2, 2, 2), rng.uniform(-3, 3)])
        place = standing(i, *rng.uniform(-4, 4, 2), rng.uniform(-3, 3), 0.2 if i % 2 else 0.0)
        landmarks[i] = replace(place, rotation=place.rotation @ rotation(rng, 0.02))
        noise, twist, offset = rng.normal(0.0, 0.02, 3), rng.normal(0.0, 0.5, 3), rng.normal(0.0, 0.02)
        x, y, yaw = se2.between(pose, landmarks[i].planar) + noise
        if i % 2:
            A = rng.normal(0.0, 0.03, (3, 3))
            m = FrameMeasurement(0, i, np.array([x, y, yaw]), A @ A.T + 1e-4 * np.eye(3), twist, offset)
        else:
            cov = np.diag([0.02, 0.05]) ** 2
            m = PointMeasurement(0, i, float(np.hypot(x, y)), float(np.arctan2(y, x)), cov, twist, offset)
        poses.append(pose)
        seen.append(m)
    return np.array(poses), LandmarkMap(landmarks), seen


def differences(observed, poses, theta, i: int, h: float = 1e-6):
    """Derivatives of a residual by pose and installation, by central differences."""

    def at(by_pose, by_theta):
        moved = np.array([se2.compose(p, se2.exp(by_pose)) for p in poses])
        return observed.linearize(moved, theta + by_theta)[i].residual

    def columns(n, call):
        return np.array([(call(h * e) - call(-h * e)) / (2 * h) for e in np.eye(n)]).T

    J = columns(3, lambda e: at(e, np.zeros(len(theta))))
    return J, columns(len(theta), lambda e: at(np.zeros(3), e)) if len(theta) else np.zeros((len(J), 0))


OF_THE_PREDICTED = ("sightings.range_scale", "sightings.bearing_offset_rad")  # not of the measured point, with noise


def noisy(installation):
    return {installation.index[name] for name in OF_THE_PREDICTED}


def check(observed, poses, theta, atol: float, left_out=frozenset()):
    for i, one in enumerate(observed.linearize(poses, theta)):
        J, H = differences(observed, poses, theta, i)
        assert np.abs(one.J - J).max() < 1e-4 * np.abs(J).max()
        dense = np.zeros_like(H)
        dense[:, one.columns] = one.H
        for name in set(range(H.shape[1])) - left_out:
            assert dense[:, name] == pytest.approx(H[:, name], rel=1e-4, abs=atol * max(np.abs(H[:, name]).max(), 1.0))


@pytest.mark.parametrize("seed", range(3))
def test_derivatives_of_corners_are_those_of_finite_differences(seed):
    poses, landmark_map, seen = scene(seed)
    installation = installation_of(config(), landmark_map, True)
    theta = np.zeros(len(installation))
    assert {f"camera.{name}" for name in CAMERA} <= set(installation.names)
    assert {f"map.0.{name}" for name in MARKER} <= set(installation.names)
    check(Observations(seen, landmark_map.landmarks, installation), poses, theta, 1e-4)


def test_derivatives_of_corners_away_from_the_prior_are_those_of_finite_differences():
    """Those by a marker's rotation to first order in it."""
    poses, landmark_map, seen = scene(4)
    installation = installation_of(config(), landmark_map, True)
    theta = np.random.default_rng(4).normal(0.0, installation.sigmas)
    observed = Observations(seen, landmark_map.landmarks, installation)
    for i, one in enumerate(observed.linearize(poses, theta)):
        J, H = differences(observed, poses, theta, i)
        dense = np.zeros_like(H)
        dense[:, one.columns] = one.H
        assert np.abs(one.J - J).max() < 1e-6 * np.abs(J).max()
        for column in range(H.shape[1]):
            scale = np.abs(H[:, column]).max()
            of_marker = ".r" in installation.names[column] and installation.names[column].startswith("map.")
            assert np.abs(dense[:, column] - H[:, column]).max() < (0.05 if of_marker else 1e-5) * scale + 1e-4


@pytest.mark.parametrize("placed", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_derivatives_of_planar_sightings_are_those_of_finite_differences(seed, placed):
    poses, landmark_map, seen = planar_scene(seed)
    installation = installation_of(config(landmarks={"position_sigma_m": placed}), landmark_map, False)
    assert {f"sightings.{name}" for name in SENSOR} <= set(installation.names)
    assert ({f"sightings.{name}" for name in PLACE} <= set(installation.names)) == (placed > 0.0)
    observed = Observations(seen, landmark_map.landmarks, installation)
    rng = np.random.default_rng(seed)
    check(observed, poses, np.zeros(len(installation)), 1e-4, noisy(installation))
    check(observed, poses, rng.normal(0.0, installation.sigmas), 1e-4, noisy(installation))


@pytest.mark.parametrize("seed", range(3))
def test_the_derivative_by_the_scale_of_ranges_is_the_predicted_point(seed):
    """With the noise of the range in it, scale and map would drift away together in a long run."""
    poses, landmark_map, seen = planar_scene(seed)
    installation = installation_of(config(), landmark_map, False)
    observed = Observations(seen, landmark_map.landmarks, installation)
    theta = np.zeros(len(installation))
    scale = installation.index["sightings.range_scale"]
    for i, one in enumerate(observed.linearize(poses, theta)):
        of_measured = differences(observed, poses, theta, i)[1][:, scale]
        by_scale = one.H[:, list(one.columns).index(scale)]
        if isinstance(seen[i], PointMeasurement):
            assert by_scale == pytest.approx(of_measured - one.residual, rel=1e-6, abs=1e-6)
            assert np.abs(one.residual).max() > 0.01


def test_a_marker_in_a_map_whose_states_are_six_turns_with_its_yaw():
    """Marker poses of markers that others see by corners."""
    poses, landmark_map, seen = planar_scene(1)
    names = [f"sightings.{n}" for n in SENSOR] + [f"map.{i}.{n}" for i in (1, 3) for n in MARKER]
    installation = Installation(dict.fromkeys(names, 0.01))
    check(
        Observations(seen, landmark_map.landmarks, installation),
        poses,
        np.zeros(len(installation)),
        1e-4,
        noisy(installation),
    )


@pytest.mark.parametrize("corners", [True, False])
def test_a_place_that_is_no_state_is_noise_of_its_sighting(corners):
    """The sighting tells the pose as much as with the place as a state whose prior it has."""
    poses, landmark_map, seen = scene(0) if corners else planar_scene(0)
    if corners:
        seen = [replace(m, jitter_s=0.004, sway_rad=0.005, blur_s=0.001) for m in seen]
    states, none = (installation_of(config(), landmark_map, corners, most=most) for most in (99, 0))
    assert not none.landmarks
    each = [
        Observations(seen, landmark_map.landmarks, made).linearize(poses, np.zeros(len(made)))
        for made in (states, none)
    ]
    for known, noise in zip(*each, strict=True):
        own = [i for i, column in enumerate(known.columns) if states.names[column].startswith("map.")]
        prior = states.prior().cov[np.ix_(known.columns[own], known.columns[own])]
        cov = known.noise() + known.H[:, own] @ prior @ known.H[:, own].T
        for a, b in ((known.J, noise.J), (known.residual, noise.residual), (known.H[:, :3], noise.H[:, :3])):
            weighed = known.J.T @ np.linalg.solve(cov, a)
            assert noise.J.T @ np.linalg.solve(noise.noise(), b) == pytest.approx(weighed, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_the_residual_of_corners_is_that_of_gtsam(seed):
    poses, landmark_map, seen = scene(seed)
    still = [replace(m, twist=np.zeros(3)) for m in seen]
    for installation in (Installation({}), installation_of(config(), landmark_map, True)):
        observed = Observations(still, landmark_map.landmarks, installation)
        for m, pose, one in zip(still, poses, observed.linearize(poses, np.zeros(len(installation))), strict=True):
            values = gtsam.Values()
            values.insert(0, gtsam.Pose2(*pose))
            calibration = gtsam.Cal3DS2(K[0, 0], K[1, 1], 0.0, K[0, 2], K[1, 2], *D)
            noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
            mounted = gtsam.Pose3(m.camera.T_base_cam)
            residual = []
            for corner, pixel in zip(landmark_map.landmarks[m.landmark_id].corners(), m.corners_px, strict=True):
                factor = gtsam.PlanarProjectionFactor1(0, corner, pixel, mounted, calibration, noise)
                residual.append(factor.whitenedError(values))
            assert one.residual == pytest.approx(np.concatenate(residual), abs=1e-8)
            assert not one.behind


def test_an_offset_that_was_compensated_leaves_nothing():
    """The stamp is late by what it was taken to be: then the twist does not matter."""
    poses, landmark_map, seen = scene(0)
    installation = installation_of(config(), landmark_map, True)
    theta = np.zeros(len(installation))
    theta[installation.index["camera.time_offset_s"]] = 0.013
    known = [replace(m, offset_s=0.013) for m in seen]
    still = [replace(m, twist=np.zeros(3)) for m in seen]
    a, b = (Observations(s, landmark_map.landmarks, installation).linearize(poses, theta) for s in (known, still))
    for one, other in zip(a, b, strict=True):
        assert one.residual == pytest.approx(other.residual, abs=1e-12)


def test_the_noise_that_an_image_shares_is_that_of_its_stamp_and_its_way():
    poses, landmark_map, seen = scene(2, n=1)
    cov = np.diag([0.01, 0.02, 0.03]) ** 2
    moved = [replace(seen[0], motion_cov=cov, jitter_s=0.004)]
    installation = installation_of(config(), landmark_map, True)
    (one,) = Observations(moved, landmark_map.landmarks, installation).linearize(poses, np.zeros(len(installation)))
    by_time = one.H[:, [list(one.columns).index(installation.index["camera.time_offset_s"])]]
    expected = np.eye(8) + 0.004**2 * by_time @ by_time.T + one.J @ cov @ one.J.T
    assert one.noise() == pytest.approx(expected, rel=1e-9)


def test_a_corner_behind_the_camera_is_said_to_be():
    poses, landmark_map, seen = scene(3, n=1)
    turned = np.array([se2.compose(poses[0], (0.0, 0.0, np.pi))])
    (one,) = Observations(seen, landmark_map.landmarks, Installation({})).linearize(turned, np.zeros(0))
    assert one.behind
    assert np.isfinite(one.residual).all()
    assert MIN_DEPTH_M > 0.0


def test_sightings_of_several_kinds_come_back_in_their_order():
    poses, corner_map, corners = scene(0, n=2)
    _, planar_map, planar = planar_scene(0, n=2)
    planar = [replace(m, landmark_id=m.landmark_id + 10) for m in planar]
    known = {**corner_map.landmarks, **{i + 10: m for i, m in planar_map.landmarks.items()}}
    mixed = [planar[0], corners[0], planar[1], corners[1]]
    each = np.array([poses[0]] * 4)
    one_by_one = [Observations([m], known, Installation({})).linearize(each[:1], np.zeros(0))[0] for m in mixed]
    for a, b in zip(Observations(mixed, known, Installation({})).linearize(each, np.zeros(0)), one_by_one, strict=True):
        assert a.residual == pytest.approx(b.residual, abs=1e-12)


def ranges(n: int = 4) -> tuple[np.ndarray, list[UwbRange]]:
    """Poses, and a range from each to an anchor."""
    rng = np.random.default_rng(6)
    poses = rng.uniform(-2.0, 2.0, (n, 3))
    anchors, tag = rng.uniform(-4.0, 4.0, (n, 3)), np.array([0.1, -0.2, 0.3])
    cov = np.array([[0.01]])
    return poses, [UwbRange(source="uwb", stamp_ns=0, cov=cov, range_m=3.0, anchor=a, tag=tag) for a in anchors]


def test_derivatives_of_a_registered_sensor_are_those_of_finite_differences_and_what_is_exact_is_none():
    poses, seen = ranges()
    for names in ((SCALE, BIAS), (BIAS,), ()):
        installation = Installation(dict.fromkeys(names, 0.1))
        observed = Observations(seen, {}, installation)
        check(observed, poses, np.full(len(names), 0.05), 1e-4)
        for one in observed.linearize(poses, np.zeros(len(names))):
            assert {installation.names[column] for column in one.columns} == set(names)


def test_a_range_of_a_registered_sensor_shares_the_noise_of_its_way_to_the_keyframe_and_has_none_at_it():
    poses, seen = ranges()
    way, cov = np.array([0.2, 0.1, 0.3]), np.diag([0.01, 0.02, 0.03]) ** 2
    moved = [m.compensated(way, cov) for m in seen]
    at, since = (Observations(s, {}, Installation({})).linearize(poses, np.zeros(0)) for s in (seen, moved))
    for here, later, m, pose in zip(at, since, seen, poses, strict=True):
        assert here.noise() == pytest.approx(np.eye(1))
        by_then = m.residual_at(se2.compose(pose, way))[1] / 0.1
        assert later.noise() == pytest.approx(np.eye(1) + by_then @ cov @ by_then.T, rel=1e-9)


def test_beside_the_camera_the_lens_distorts_no_more_than_at_the_edge_of_its_images():
    """Where a wrong id puts a marker there, its corners would agree with everything, by coefficients to any power."""
    T_base_cam = np.eye(4)
    T_base_cam[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    camera = Camera(640, 480, "plumb_bob", K, np.array([0.1, 0.05, 0.0, 0.0]), T_base_cam)
    place = np.array([0.3, 3.0, 0.5])  # 84 degrees to the left
    aside = Landmark(0, place, np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), 0.2)
    installation = Installation({f"camera.{name}": 0.005 for name in CAMERA})
    seen = [PixelMeasurement(0, 0, np.array([[300.0, 220], [340, 220], [340, 260], [300, 260]]), 0.5, camera)]
    lines = Observations(seen, {0: aside}, installation).together(np.zeros(3), np.zeros(len(installation)))
    assert not lines.behind.any()
    by_k2 = lines.H[:, 3 + installation.index["camera.k2"]]
    assert np.abs(lines.residual).max() > 100.0 * np.abs(0.005 * by_k2).max()


def test_whitening_survives_a_covariance_that_rounding_has_corrupted():
    rng = np.random.default_rng(0)
    S = rng.normal(size=(8, 1)) * 1e9
    inexact = np.eye(8) + S @ S.T  # eigenvalues 1 and 1e19
    W = sighting_whitening(inexact)
    assert np.isfinite(W).all()
    assert np.linalg.norm(W, 2) <= 1.0 + 1e-6  # no residual counts for more than its own noise lets it
    assert np.linalg.norm(W @ S) < 10.0
