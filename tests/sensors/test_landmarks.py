"""Sightings to measurements: corners, ranges and bearings, marker poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from marker_scenes import BODY_OPTICAL, forward_camera, image_event, project, render, standing, transform
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.config import Config
from fgloc.errors import CameraError, ConfigError
from fgloc.frames import rpy_matrix
from fgloc.sensors.equipment import LandmarkSensor
from fgloc.sensors.marker_pose import MarkerPose, MarkerPosesEvent
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.measurements import FrameMeasurement, PixelMeasurement, PointMeasurement
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.types import FloatArray, Landmark, LandmarkMap

CAMERA = forward_camera()
FISHEYE = replace(forward_camera(D=(-0.013, 0.009, 0.012, -0.004)), model="equidistant")


def config(**landmarks: object) -> Config:
    return Config.model_validate({"landmarks": landmarks})


def known(*landmarks: Landmark) -> LandmarkMap:
    return LandmarkMap({m.landmark_id: m for m in landmarks}, "DICT_4X4_50")


def corners_event(*sightings: tuple[int, FloatArray]) -> CornersEvent:
    return CornersEvent(5, 6, "/camera/image", "optical", tuple(MarkerCorners(i, c) for i, c in sightings))


def ranges_event(*sightings: tuple[int, float, float]) -> RangeBearingEvent:
    return RangeBearingEvent(5, 6, "/landmarks", "base", tuple(RangeBearing(*s) for s in sightings))


def poses_event(*sightings: tuple[int, Sequence[float], FloatArray]) -> MarkerPosesEvent:
    found = (
        MarkerPose(i, np.array(p, dtype=float), Rotation.from_matrix(R).as_quat(), np.zeros((6, 6)))
        for i, p, R in sightings
    )
    return MarkerPosesEvent(5, 6, "/markers", "optical", tuple(found))


# --- corners, known map ---


def test_an_image_becomes_corner_measurements_with_no_residual_at_truth() -> None:
    rng = np.random.default_rng(11)
    pose = (0.3, -0.2, 0.1)
    markers = [standing(0, (2.2, 0.3, 0.4), np.pi + 0.4), standing(7, (3.0, -0.4, 0.3), np.pi - 0.3)]
    config = Config()
    found = MarkerDetector("DICT_4X4_50", config.markers).detect(
        image_event(render(CAMERA, pose, markers, "DICT_4X4_50", rng))
    )
    sensor = LandmarkSensor(config, known(*markers), CAMERA, None)
    measured = sensor.measure(found)
    assert [m.landmark_id for m in measured] == [0, 7]  # the nearer one is larger
    for m, marker in zip(measured, markers, strict=True):
        assert isinstance(m, PixelMeasurement)
        assert (m.stamp_ns, m.sigma_px) == (found.stamp_ns, config.markers.sigma_px)
        residual = m.corners_px - project(m.camera, pose, marker.corners())
        assert np.abs(residual).max() < 2.0 * m.sigma_px
    assert not sensor.rejections


def test_fisheye_corners_are_rid_of_the_lens() -> None:
    marker = standing(3, (2.0, 0.9, 0.6), np.pi)
    [m] = LandmarkSensor(Config(), known(marker), FISHEYE, None).measure(
        corners_event((3, project(FISHEYE, np.zeros(3), marker.corners())))
    )
    assert isinstance(m, PixelMeasurement)
    assert (m.camera.model, m.camera.D.any()) == ("plumb_bob", False)
    assert np.abs(m.corners_px - project(m.camera, np.zeros(3), marker.corners())).max() < 1e-3


def test_cameras_are_one_object_over_all_measurements() -> None:
    marker = standing(3, (2.0, 0.5, 0.6), np.pi)
    sensor = LandmarkSensor(Config(), known(marker), FISHEYE, None)
    event = corners_event((3, project(FISHEYE, np.zeros(3), marker.corners())))
    first, second = (sensor.measure(event)[0] for _ in range(2))
    assert first.camera is second.camera  # type: ignore[union-attr]


def test_fault_43_ids_of_a_larger_dictionary_are_rejected() -> None:
    """The map says DICT_4X4_50, detection ran with DICT_4X4_1000: same ids for the map's markers, others are false."""
    rng = np.random.default_rng(43)
    mine, foreign = standing(3, (2.0, 0.3, 0.3), np.pi), standing(512, (2.0, -0.3, 0.3), np.pi)
    image = image_event(render(CAMERA, (0, 0, 0), [mine, foreign], "DICT_4X4_1000", rng))
    sensor = LandmarkSensor(Config(), known(mine), CAMERA, None)
    found = MarkerDetector("DICT_4X4_1000", Config().markers).detect(image)
    assert [s.landmark_id for s in found.sightings] == [3, 512]
    assert [m.landmark_id for m in sensor.measure(found)] == [3]
    assert sensor.rejections == {"sightings.unknown_id": 1}


def test_fault_44_two_markers_with_one_id_in_view() -> None:
    markers = [standing(3, (2.0, 0.3, 0.3), np.pi), standing(4, (2.0, -0.3, 0.3), np.pi)]
    a, b = (project(CAMERA, np.zeros(3), m.corners()) for m in markers)
    sensor = LandmarkSensor(Config(), known(*markers), CAMERA, None)
    measured = sensor.measure(corners_event((3, a), (3, a + 90.0), (4, b)))
    assert [m.landmark_id for m in measured] == [4]
    assert sensor.rejections == {"sightings.duplicate_id": 2}


def test_fault_44_holds_for_ranges_and_poses() -> None:
    sensor = LandmarkSensor(Config(), None, None, None)
    assert [m.landmark_id for m in sensor.measure(ranges_event((1, 2.0, 0.1), (1, 3.0, 0.1), (2, 2.0, 0.0)))] == [2]
    upright = np.eye(3)
    assert len(sensor.measure(poses_event((1, (0, 0, 2), upright), (1, (0, 0, 3), upright)))) == 0
    assert sensor.rejections == {"sightings.duplicate_id": 4}


def test_fault_50_ids_outside_the_map_are_counted() -> None:
    sensor = LandmarkSensor(Config(), known(standing(3, (2.0, 0.3, 0.3), np.pi)), None, None)
    assert [m.landmark_id for m in sensor.measure(ranges_event((3, 2.0, 0.1), (8, 2.0, 0.5)))] == [3]
    assert sensor.rejections == {"sightings.unknown_id": 1}


def test_the_largest_markers_are_used_when_there_are_too_many() -> None:
    markers = [standing(i, (1.5 + 0.4 * i, 0.0, 0.3), np.pi) for i in range(6)]
    config = Config.model_validate({"markers": {"max_sightings": 4}})
    sensor = LandmarkSensor(config, known(*markers), CAMERA, None)
    event = corners_event(*((m.landmark_id, project(CAMERA, np.zeros(3), m.corners())) for m in markers[::-1]))
    assert [m.landmark_id for m in sensor.measure(event)] == [0, 1, 2, 3]
    assert sensor.rejections == {"sightings.beyond_max": 2}


def test_fault_36_corners_without_a_camera() -> None:
    with pytest.raises(CameraError, match=r"/camera/image.*CameraInfo.*camera\.file"):
        LandmarkSensor(Config(), None, None, None).measure(corners_event((1, np.zeros((4, 2)))))


# --- corners, unknown map ---


def single_view(size: float | None, yaw_sigma: float | None) -> Config:
    return Config.model_validate({"markers": {"default_size_m": size}, "landmarks": {"yaw_sigma_rad": yaw_sigma}})


def test_corners_without_a_map_need_the_size() -> None:
    with pytest.raises(ConfigError, match=r"markers\.default_size_m"):
        LandmarkSensor(single_view(None, None), None, CAMERA, None).measure(corners_event((1, np.eye(4, 2))))


def test_corners_without_a_map_give_range_and_bearing() -> None:
    rng = np.random.default_rng(6)
    sensor = LandmarkSensor(single_view(0.2, None), None, CAMERA, None)
    marker = standing(9, (2.6, 0.6, 0.4), np.pi + 0.5)
    corners = project(CAMERA, np.zeros(3), marker.corners())
    normalised = []
    for _ in range(200):
        [m] = sensor.measure(corners_event((9, corners + rng.normal(0.0, 0.5, (4, 2)))))
        assert isinstance(m, PointMeasurement)
        error = np.array([m.bearing_rad - np.arctan2(0.6, 2.6), m.range_m - np.hypot(2.6, 0.6)])
        normalised.append(error @ np.linalg.solve(m.cov, error))
    assert 1.4 < np.mean(normalised) < 2.8  # chi-square of two degrees of freedom
    assert np.sqrt(m.cov[0, 0]) < 0.002
    assert 0.01 < np.sqrt(m.cov[1, 1]) < 0.08


def test_corners_without_a_map_give_a_pose_whose_yaw_counts_where_it_is_clear() -> None:
    sensor = LandmarkSensor(single_view(0.2, 0.05), None, CAMERA, None)
    near = standing(9, (1.0, 0.1, 0.4), np.pi + 0.7)
    [m] = sensor.measure(corners_event((9, project(CAMERA, np.zeros(3), near.corners()))))
    assert isinstance(m, FrameMeasurement)
    assert np.abs(se2.between(near.planar, m.pose)).max() < 1e-3
    assert m.cov[2, 2] >= 0.05**2
    far = standing(9, (4.0, 0.1, 0.4), np.pi + 0.1)
    [m] = sensor.measure(corners_event((9, project(CAMERA, np.zeros(3), far.corners()))))
    assert isinstance(m, FrameMeasurement)  # a landmark that is a variable is of one kind for the whole run
    assert np.hypot(*(m.pose[:2] - far.planar[:2])) < 1e-3
    assert m.cov[2, 2] >= 1.0


# --- ranges and bearings ---


def test_range_and_bearing_are_calibrated() -> None:
    settings = config(
        range_scale=1.02, range_bias_m=0.1, bearing_bias_rad=0.01, range_sigma_m=0.05, range_sigma_per_m=0.03
    )
    [m] = LandmarkSensor(settings, None, None, None).measure(ranges_event((4, 2.1, 0.31)))
    assert isinstance(m, PointMeasurement)
    assert np.allclose([m.range_m, m.bearing_rad], [2.04, 0.3])
    assert np.allclose(m.cov, np.diag([0.02**2, (0.05 + 0.03 * 2.04) ** 2]), atol=1e-12)
    assert (m.stamp_ns, m.landmark_id) == (5, 4)


def test_range_along_the_axis_becomes_a_range() -> None:
    settings = config(range_along_axis=True)
    [m] = LandmarkSensor(settings, None, None, None).measure(ranges_event((4, 2.0, 0.4)))
    assert isinstance(m, PointMeasurement)
    assert np.allclose([m.range_m, m.bearing_rad], [2.0 / np.cos(0.4), 0.4])
    assert m.cov[1, 1] > (0.1 / np.cos(0.4)) ** 2  # the bearing's error adds to the range's
    sensor = LandmarkSensor(settings, None, None, None)
    assert sensor.measure(ranges_event((4, 2.0, 1.5))) == ()
    assert sensor.rejections == {"sightings.bearing_bound": 1}


def test_the_sensors_place_is_taken_out_with_its_covariance() -> None:
    rng = np.random.default_rng(8)
    T = transform((0.4, -0.2, 0.3), rpy_matrix(0.0, 0.0, 0.7))
    sensor = LandmarkSensor(config(range_sigma_m=0.03, bearing_sigma_rad=0.02), None, None, T)
    truth = np.array([2.5, 1.0])
    local = rpy_matrix(0.0, 0.0, 0.7)[:2, :2].T @ (truth - [0.4, -0.2])
    r, b = np.hypot(*local), np.arctan2(local[1], local[0])
    [m] = sensor.measure(ranges_event((1, r, b)))
    assert isinstance(m, PointMeasurement)
    assert np.allclose([m.range_m, m.bearing_rad], [np.hypot(*truth), np.arctan2(1.0, 2.5)])
    noisy = [
        sensor.measure(ranges_event((1, r + rng.normal(0, 0.03), b + rng.normal(0, 0.02))))[0] for _ in range(2000)
    ]
    sample = np.cov([[n.bearing_rad, n.range_m] for n in noisy], rowvar=False)  # type: ignore[union-attr]
    assert np.allclose(sample, m.cov, rtol=0.12, atol=4e-5)


def test_a_range_that_calibration_makes_negative_is_rejected() -> None:
    sensor = LandmarkSensor(config(range_bias_m=0.5), None, None, None)
    assert sensor.measure(ranges_event((1, 0.4, 0.0))) == ()
    assert sensor.rejections == {"sightings.range": 1}


# --- marker poses ---

OPTICAL = transform((0.1, 0.0, 0.25), BODY_OPTICAL)


def seen_from(T_base_sensor: FloatArray, marker: Landmark) -> tuple[int, FloatArray, FloatArray]:
    T = np.linalg.inv(T_base_sensor) @ transform(marker.position, marker.rotation)
    return marker.landmark_id, T[:3, 3], T[:3, :3]


def test_marker_poses_give_range_and_bearing_in_the_base() -> None:
    marker = standing(2, (3.0, 1.0, 0.4), np.pi)
    sensor = LandmarkSensor(config(range_sigma_m=0.1, bearing_sigma_rad=0.02), None, None, OPTICAL)
    event = poses_event(seen_from(OPTICAL, marker))
    assert event.sightings[0].position[2] > 2.5  # optical: z is ahead
    [m] = sensor.measure(event)
    assert isinstance(m, PointMeasurement)
    assert np.allclose([m.range_m, m.bearing_rad], [np.hypot(3.0, 1.0), np.arctan2(1.0, 3.0)])
    assert 0.015 < np.sqrt(m.cov[0, 0]) < 0.025
    assert 0.09 < np.sqrt(m.cov[1, 1]) < 0.11


@pytest.mark.parametrize("map_known", [False, True])
@pytest.mark.parametrize("rotation", ["standing", "lying"])
def test_marker_poses_give_planar_poses_if_their_yaw_is_believed(map_known: bool, rotation: str) -> None:
    marker = standing(2, (3.0, 1.0, 0.4), 2.5)
    if rotation == "lying":
        marker = replace(marker, rotation=rpy_matrix(0.0, 0.0, 0.8))
    sensor = LandmarkSensor(config(yaw_sigma_rad=0.1), known(marker) if map_known else None, None, OPTICAL)
    [m] = sensor.measure(poses_event(seen_from(OPTICAL, marker)))
    assert isinstance(m, FrameMeasurement)
    assert np.abs(se2.between(marker.planar, m.pose)).max() < 1e-9
    assert np.allclose(m.cov[2], [0.0, 0.0, 0.01])
    assert np.linalg.eigvalsh(m.cov)[0] > 0.0
    ray = np.array([2.9, 1.0]) / np.hypot(2.9, 1.0)  # from the sensor; range error along it
    c, s = np.cos(m.pose[2]), np.sin(m.pose[2])
    in_base = np.array([[c, -s], [s, c]]) @ m.cov[:2, :2] @ np.array([[c, s], [-s, c]])
    assert np.isclose(ray @ in_base @ ray, 0.1**2)


def test_the_map_says_whether_a_marker_stands() -> None:
    """A standing marker whose seen tilt is far wrong is still read by the yaw of its face."""
    marker = standing(2, (3.0, 0.0, 0.4), np.pi)
    number, position, R = seen_from(OPTICAL, marker)
    tilted = R @ rpy_matrix(-0.85, 0.0, 0.0)
    [m] = LandmarkSensor(config(yaw_sigma_rad=0.3), known(marker), None, OPTICAL).measure(
        poses_event((number, position, tilted))
    )
    assert isinstance(m, FrameMeasurement)
    assert abs(se2.wrap(m.pose[2] - np.pi)) < 0.01


def test_a_point_of_the_map_has_no_yaw() -> None:
    point = Landmark(2, np.array([3.0, 1.0, 0.0]), np.eye(3), 0.0)
    sensor = LandmarkSensor(config(yaw_sigma_rad=0.1), known(point), None, OPTICAL)
    [m] = sensor.measure(poses_event(seen_from(OPTICAL, standing(2, (3.0, 1.0, 0.4), 2.5))))
    assert isinstance(m, PointMeasurement)
