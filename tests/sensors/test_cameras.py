"""Calibrations: what is read, what is refused, and that corners are rid of what Cal3DS2 cannot model."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from marker_scenes import forward_camera, project, standing
from real_data import real_data
from refusal import refusal

from fgloc.errors import CameraError
from fgloc.sensors.cameras import camera_from_info, load_camera, pinhole, rescaled, undistort_points, without_distortion
from fgloc.types import Camera, CameraInfoEvent

T = np.eye(4)
K = np.array([[525.0, 0.0, 319.5], [0.0, 520.0, 239.5], [0.0, 0.0, 1.0]])
LENSES = {
    "plumb_bob": (-0.25, 0.08, 0.001, -0.002),
    "plumb_bob with k3": (-0.25, 0.08, 0.001, -0.002, -0.01),
    "rational_polynomial": (0.4, 0.1, 0.001, -0.0005, 0.01, 0.7, 0.15, 0.02),
    "equidistant": (-0.013, 0.009, 0.012, -0.004),
}


def info(K: np.ndarray = K, D: tuple[float, ...] = (0.0,) * 5, model: str = "plumb_bob") -> CameraInfoEvent:
    return CameraInfoEvent(1, 1, "/camera/camera_info", "optical", 640, 480, model, np.asarray(K), np.array(D))


def camera(name: str) -> Camera:
    return replace(forward_camera(D=LENSES[name]), model=name.split()[0])


def test_camera_info_gives_the_camera() -> None:
    mounted = np.diag([1.0, -1.0, -1.0, 1.0])
    c = camera_from_info(info(D=(0.1, 0.2, 0.3, 0.4, 0.0)), mounted)
    assert (c.width, c.height, c.model, c.frame_id, c.notes) == (640, 480, "plumb_bob", "optical", ())
    assert np.array_equal(c.K, K)
    assert np.array_equal(c.T_base_cam, mounted)
    assert c.D.tolist() == [0.1, 0.2, 0.3, 0.4, 0.0]


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((280, 160), (262.5, 260.0, 139.5, 79.5)),
        (None, (262.5, 260.0, 139.5, 79.5)),
        ((640, 480), (525, 520, 319.5, 239.5)),
    ],
)
def test_fault_39_calibration_of_all_pixels_for_images_of_a_part_of_them(size, expected) -> None:
    part = replace(info(), roi=(40, 80, 560, 320), binning=(2, 2))
    c = camera_from_info(part, T, size)
    assert (c.width, c.height) == (size or (280, 160))
    assert (c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]) == pytest.approx(expected)


def test_rectified_images_have_the_projection_and_no_distortion() -> None:
    P = np.hstack([np.diag([480.0, 481.0, 1.0]), np.zeros((3, 1))])
    raw = replace(info(D=(0.1, 0.2, 0.3, 0.4, 0.5)), P=P)
    assert camera_from_info(raw, T).K[0, 0] == 525.0
    c = camera_from_info(raw, T, rectified=True)
    assert c.K.tolist() == P[:, :3].tolist()
    assert not c.D.any()
    assert camera_from_info(replace(raw, P=np.zeros((3, 4))), T, rectified=True).D.any()  # it has no projection


def test_fault_37_matrix_all_zeros() -> None:
    with pytest.raises(CameraError, match=r"/camera/camera_info.*all zeros.*not calibrated"):
        camera_from_info(info(np.zeros((3, 3))), T)


@pytest.mark.parametrize(
    ("row", "column", "value"), [(0, 0, np.nan), (1, 1, -5.0), (0, 0, 0.0), (2, 2, 0.0), (0, 2, np.inf)]
)
def test_fault_37_impossible_matrix(row: int, column: int, value: float) -> None:
    wrong = K.copy()
    wrong[row, column] = value
    with pytest.raises(CameraError, match="K"):
        camera_from_info(info(wrong), T)


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant", ""])
def test_fault_38_empty_distortion_is_zero_and_said(model: str) -> None:
    c = camera_from_info(info(D=(), model=model), T)
    assert c.model == (model or "plumb_bob")
    assert c.D.tolist() == [0.0] * 4
    [note] = c.notes
    assert "distortion" in note


@pytest.mark.parametrize(
    ("model", "D"), [("plumb_bob", (0.1,)), ("equidistant", (0.1,) * 5), ("plumb_bob", (np.nan,) * 5)]
)
def test_impossible_distortion_is_refused(model: str, D: tuple[float, ...]) -> None:
    with pytest.raises(CameraError, match=str(len(D))):
        camera_from_info(info(D=D, model=model), T)


def test_unknown_distortion_model_is_refused_with_the_known_ones() -> None:
    with pytest.raises(CameraError, match=r"'fov'.*plumb_bob.*equidistant"):
        camera_from_info(info(model="fov"), T)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_fault_39_rescaled_calibration_sees_the_same_rays(scale: float) -> None:
    original = camera("plumb_bob")
    scaled = rescaled(original, round(640 * scale), round(480 * scale))
    assert (scaled.width, scaled.height) == (640 * scale, 480 * scale)
    assert "scaled" in scaled.notes[-1]
    points = standing(0, (2.0, 0.3, 0.4), 3.0).corners()
    pixels, larger = (project(c, (0.0, 0.0, 0.0), points) for c in (original, scaled))
    assert np.abs((pixels + 0.5) * scale - 0.5 - larger).max() < 1e-6  # pixel centers are at whole numbers


def test_fault_39_another_shape_is_refused() -> None:
    with pytest.raises(CameraError, match=r"640x480 .* 640x360"):
        rescaled(camera("plumb_bob"), 640, 360)


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_corners_are_those_of_the_pinhole_camera(name: str) -> None:
    lens = camera(name)
    ideal = pinhole(lens)
    assert ideal.model == "plumb_bob"
    assert len(ideal.D) == 4
    for y in (-0.7, 0.0, 0.8):
        corners = standing(0, (2.0, y, 0.6), np.pi).corners()
        recorded = project(lens, (0.0, 0.0, 0.0), corners)
        expected = project(ideal, (0.0, 0.0, 0.0), corners)
        assert np.abs(undistort_points(lens, recorded) - expected).max() < 1e-3
        bare, pixels = without_distortion(lens, recorded)
        assert not bare.D.any()
        assert np.abs(pixels - project(bare, (0.0, 0.0, 0.0), corners)).max() < 1e-3


def test_what_cal3ds2_models_is_left_alone() -> None:
    lens = camera("plumb_bob")
    corners = np.array([[10.0, 20.0], [600.0, 400.0]])
    assert pinhole(lens) is lens
    assert np.array_equal(undistort_points(lens, corners), corners)


# --- files ---

ROS = """
image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [525.0, 0, 319.5, 0, 520.0, 239.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, -0.002, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [525.0, 0, 319.5, 0, 0, 520.0, 239.5, 0, 0, 0, 1, 0]}
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 525., 0., 319.5, 0., 520., 239.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.1, -0.2, 0.001, -0.002, 0. ]
"""
KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [525.0, 520.0, 319.5, 239.5]
  distortion_model: radtan
  distortion_coeffs: [0.1, -0.2, 0.001, -0.002]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  intrinsics: [405.76, 404.8, 158.0, 107.6]
  distortion_model: equidistant
  distortion_coeffs: [-0.013, 0.009, 0.012, -0.004]
  resolution: [320, 240]
  rostopic: /cam1/image_raw
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "camera.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("text", [ROS, OPENCV, KALIBR], ids=["ros", "opencv", "kalibr"])
def test_calibration_files_give_the_same_camera(tmp_path: Path, text: str) -> None:
    c = load_camera(written(tmp_path, text), T)
    assert (c.width, c.height, c.model) == (640, 480, "plumb_bob")
    assert np.array_equal(c.K, K)
    assert c.D[:4].tolist() == [0.1, -0.2, 0.001, -0.002]
    assert not c.D[4:].any()


def test_the_camera_of_a_kalibr_file_is_that_of_the_images_topic(tmp_path: Path) -> None:
    path = written(tmp_path, KALIBR)
    for topic in (None, "/cam10/image_raw"):
        first = load_camera(path, T, topic)
        assert (first.model, first.width) == ("plumb_bob", 640)
        assert re.search("cam0 .*cam1", first.notes[-1])
    assert load_camera(path, T, "/cam0/image_raw").notes == ()
    for topic in ("/cam1/image_raw", "/cam1/image_raw/compressed"):
        second = load_camera(path, T, topic)
        assert (second.model, second.width, second.notes) == ("equidistant", 320, ())


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("camera_matrix: [1, 2]", r"camera\.yaml:1: "),
        (ROS.replace("640", "wide"), r"camera\.yaml:2: .*'wide'"),
        (ROS.replace("525.0, 0, 319.5, 0, 520.0, 239.5, 0, 0, 1]", "0, 0, 0, 0, 0, 0, 0, 0, 0]", 1), "K.* zeros"),
        (KALIBR.replace("pinhole", "omni", 1), r"camera\.yaml:3.*'omni'"),
        ("a: 1", "camera_matrix"),
        ("", "empty"),
        ("%YAML:1.0\n---\na: 1\n", "camera_matrix"),
        ("{", "not YAML"),
    ],
)
def test_wrong_calibration_files_are_refused_with_the_place(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(CameraError, match=match):
        load_camera(written(tmp_path, text), T)


def test_missing_calibration_file_is_named(tmp_path: Path) -> None:
    with refusal(CameraError, tmp_path / "absent.yaml", cause=FileNotFoundError):
        load_camera(tmp_path / "absent.yaml", T)


@pytest.mark.real_data
def test_opencvs_own_calibrations_are_read() -> None:
    c = load_camera(real_data("marker_images", "opencv_aruco", "tutorial_camera_charuco.yml"), T)
    assert (c.width, c.height) == (640, 480)
    assert abs(c.K[0, 0] - 452.51072) < 1e-4
    sizeless = load_camera(real_data("marker_images", "opencv_aruco", "tutorial_camera_params.yml"), T)
    assert sizeless.width == 0
    assert "size" in sizeless.notes[0]


@pytest.mark.parametrize("head", ["", "%YAML:1.0\n---\n", "a: !!opencv-matrix\n"])
def test_deep_nesting_ends_no_process(tmp_path: Path, head: str) -> None:
    with pytest.raises(CameraError):
        load_camera(written(tmp_path, head + "camera_matrix: " + "[" * 100_000), T)


@pytest.mark.parametrize("width", [".Inf", ".NaN", "1e300", "-640."])
def test_a_size_that_is_none_is_refused(tmp_path: Path, width: str) -> None:
    with pytest.raises(CameraError):
        load_camera(written(tmp_path, OPENCV.replace("image_width: 640", f"image_width: {width}")), T)


def test_only_a_regular_file_of_some_size_is_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(8 << 30)
    for path in (Path("/dev/zero"), tmp_path / "pipe", tmp_path / "sparse", tmp_path / "a\0b"):
        with pytest.raises(CameraError):
            load_camera(path, T)
