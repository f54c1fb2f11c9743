"""From a recording to the parts of a run: what does not fit is refused before the run, by name and with the remedy."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from motion_models import make_card, make_tensors
from refusal import refusal

from fgloc.assembly import assemble
from fgloc.config import Config, RecordingConfig
from fgloc.errors import CameraError, ConfigError, MapError, RecordingError
from fgloc.recording.reader import open_recording
from fgloc.sensor_setup import given_pose
from fgloc.sensors.learned.sensor import save_model
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
K = [[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
MAP = "dictionary: DICT_4X4_50\nlandmarks:\n  - {id: 0, position: [2, 0, 0.3], facing: 3.14159, size: 0.2}\n"
CAMERA_FILE = """image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [510, 0, 320, 0, 510, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
"""


def write_bag(
    folder, motion=True, info=(640, 480), image=(640, 480), camera_frame="camera_optical", sightings=False, **fields
):
    """A short recording; ``info`` and ``image`` are sizes or None, ``fields`` those of CameraInfo."""
    with BagWriter(folder / "bag") as bag:
        bag.static_transform(START_NS, "base_link", "camera_optical", (0.1, 0.0, 0.3), OPTICAL)
        if info is not None:
            bag.camera_info("/camera/camera_info", START_NS, info, K, [0.0] * 5, frame_id=camera_frame, **fields)
        for k in range(20):
            stamp = START_NS + k * 50_000_000
            if motion:
                bag.odometry("/odom", stamp, (0.0, 0.0, 0.0), (0.0, 0.0))
            if image is not None and k % 5 == 0:
                data = cv2.imencode(".png", np.full((image[1], image[0]), 128, np.uint8))[1].tobytes()
                bag.compressed_image("/camera/image/compressed", stamp, data, "png", frame_id=camera_frame)
            if sightings:
                bag.range_bearing("/landmarks", stamp, [(0, 2.0, 0.1)], frame_id="beacon_sensor")
    return folder / "bag"


def build(folder, config=None, map_text=MAP, **bag):
    config = Config.model_validate(config or {})
    map_path = folder / "map.yaml"
    if map_text is not None:
        map_path.write_text(map_text)
    with open_recording(write_bag(folder, **bag), RecordingConfig()) as recording:
        return assemble(recording, map_path if map_text != "" else None, config, keep_all=False)


def test_a_recording_with_camera_and_map_gives_all_parts(tmp_path):
    parts = build(tmp_path)
    assert parts.detector is not None
    assert parts.learned is None
    assert set(parts.landmark_map.landmarks) == {0}
    assert parts.config.estimator.kind == "fixed_lag"


def test_without_motion_the_topics_that_are_there_are_named(tmp_path):
    with refusal(RecordingError, "/camera/camera_info (sensor_msgs/msg/CameraInfo)"):
        build(tmp_path, motion=False, image=None)


def test_images_alone_are_enough(tmp_path):
    parts = build(tmp_path, motion=False)
    assert parts.localizer.motion.sources.unmeasured


def test_fault_36_images_without_camera_info_name_the_remedy(tmp_path):
    with pytest.raises(CameraError, match=r"no sensor_msgs/CameraInfo.*camera\.file"):
        build(tmp_path, info=None)


def test_fault_36_a_calibration_file_stands_in(tmp_path):
    (tmp_path / "camera.yaml").write_text(CAMERA_FILE)
    parts = build(tmp_path, {"camera": {"file": tmp_path / "camera.yaml"}}, info=None)
    assert parts.landmarks._context.camera.K[0, 0] == 510.0
    assert parts.landmarks._context.camera.T_base_cam[0, 3] == pytest.approx(0.1)


def test_fault_39_another_image_size_is_refused(tmp_path):
    with pytest.raises(CameraError, match=r"\b320x240\b.*\b640x480\b.*camera\.rescale"):
        build(tmp_path, image=(320, 240))


def test_fault_39_images_of_another_shape_are_not_to_be_rescaled(tmp_path):
    with refusal(CameraError, "640x360", "crop"):
        build(tmp_path, image=(640, 360))


def test_fault_39_binned_images_have_the_calibration_of_all_pixels(tmp_path):
    camera = build(tmp_path, image=(320, 240), binning_x=2, binning_y=2).landmarks._context.camera
    assert (camera.width, camera.height, camera.K[0, 0]) == (320, 240, 250.0)


def test_fault_39_rescaled_on_request(tmp_path):
    parts = build(tmp_path, {"camera": {"rescale": True}}, image=(320, 240))
    camera = parts.landmarks._context.camera
    assert (camera.width, camera.height) == (320, 240)
    assert camera.K[0, 0] == 250.0
    assert camera.K[0, 2] == pytest.approx(0.5 * (319.5 + 0.5) - 0.5)


def test_fault_66_a_camera_frame_without_transform_is_named(tmp_path):
    with pytest.raises(RecordingError, match="front_cam"):
        build(tmp_path, camera_frame="front_cam")


def test_fault_66_a_configured_pose_needs_no_transform(tmp_path):
    settings = {"recording": {"sightings_pose": (0.2, 0.0, 0.5, 0.0, 0.0, 0.0)}}
    parts = build(tmp_path, settings, camera_frame="front_cam")
    T = parts.landmarks._context.camera.T_base_cam
    assert np.allclose(T[:3, 3], (0.2, 0.0, 0.5))
    assert np.allclose(T[:3, 2], (1.0, 0.0, 0.0))  # the camera looks ahead
    assert np.allclose(T[:3, 1], (0.0, 0.0, -1.0))


def test_without_a_dictionary_it_is_asked_for(tmp_path):
    with pytest.raises(ConfigError, match=r"markers\.dictionary"):
        build(tmp_path, map_text=MAP.replace("dictionary: DICT_4X4_50\n", ""))


def test_a_missing_map_is_named(tmp_path):
    with pytest.raises(MapError, match=r"map\.yaml"):
        build(tmp_path, map_text=None)


def test_without_a_map_the_whole_run_estimator_is_taken_and_said(tmp_path):
    parts = build(tmp_path, map_text="", image=None, info=None, sightings=True)
    assert parts.config.estimator.kind == "isam2"
    assert any(note.startswith("No map") for note in parts.notes)


def test_a_sensor_without_transform_is_taken_to_be_at_the_base_and_that_is_said(tmp_path):
    parts = build(tmp_path, image=None, info=None, sightings=True)
    assert np.allclose(parts.landmarks._context.T_base_sensor, np.eye(4))
    assert any("beacon_sensor" in note and "recording.sightings_pose" in note for note in parts.notes)


def test_the_learned_model_is_loaded_only_if_it_is_used(tmp_path, motion_model):
    used = build(tmp_path, {"motion": {"model": motion_model}})
    assert used.learned is not None
    assert used.localizer.motion.sources.rules.joint is not None
    (tmp_path / "again").mkdir()
    unused = build(tmp_path / "again", {"motion": {"model": motion_model, "use": False}})
    assert unused.learned is None
    (tmp_path / "third").mkdir()
    apart = build(tmp_path / "third", {"motion": {"model": motion_model, "correlation": "independent"}})
    assert apart.learned is not None
    assert apart.localizer.motion.sources.rules.joint is None


@pytest.fixture
def motion_model(tmp_path):
    card = make_card("displacement")
    save_model(tmp_path / "model.safetensors", make_tensors(card, np.random.default_rng(0)), card)
    return tmp_path / "model.safetensors"


def test_a_configured_sensor_pose_by_axes():
    pose = {"recording": {"sightings_pose": (0.1, 0.2, 0.3, 0.0, 0.0, math.pi / 2)}}
    body = given_pose(Config.model_validate(pose), "body")
    optical = given_pose(Config.model_validate(pose), "optical")
    assert np.allclose(body[:3, 0], (0.0, 1.0, 0.0))  # turned left: its x axis points left
    assert np.allclose(optical[:3, 2], (0.0, 1.0, 0.0))  # so does the optical axis
    assert given_pose(Config(), "body") is None
