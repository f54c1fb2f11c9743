"""Images of an installation: they show the truth, and what is written of the camera does not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from sim_bags import messages

from fgloc.config import MarkersConfig, load_config
from fgloc.frames import quaternion_matrix
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.types import FloatArray, Landmark
from fgloc_datasets.sim.camera import Renderer, RenderError, exposures, pose_at
from fgloc_datasets.sim.installed import MountedCamera, load_installed
from fgloc_datasets.sim.physics import Log, make_scene, simulate
from fgloc_datasets.sim.record import record
from fgloc_datasets.sim.scenario import Camera, Control, Installation, Scenario
from fgloc_datasets.sim.sensors import EPOCH_NS

pytestmark = pytest.mark.render

SCENARIO = Scenario(
    name="test", duration_s=1.0, camera=Camera(rate_hz=10), control=Control(functions=("straight",), rest_s=5.0)
)
FULL = SCENARIO.model_copy(update={"installation": Installation.as_installed()})


@pytest.fixture(scope="module", autouse=True)
def _opengl() -> None:
    try:
        Renderer(make_scene(SCENARIO, 2)).close()
    except RenderError as error:
        pytest.skip(str(error))


def project(camera: MountedCamera, landmark: Landmark, log: Log, stamp_s: float) -> FloatArray:
    position, quaternion = pose_at(log, stamp_s)
    R_map_base = quaternion_matrix(quaternion)
    in_cam = (landmark.corners() - position - R_map_base @ camera.position) @ (R_map_base @ camera.rotation)
    zero = np.zeros(3)
    return cv2.projectPoints(in_cam, zero, zero, camera.matrix, np.array(camera.distortion))[0][:, 0]


def test_images_show_the_true_markers_through_the_true_camera() -> None:
    true, believed = [], []
    for start in ((0.0, 0.0, 0.0), (0.5, 0.2, 2.0), (-0.5, 0.3, 4.0)):  # at rest, three views
        scene = make_scene(FULL.model_copy(update={"start": start}), 3)
        log, installed = simulate(scene), scene.installed
        detector = MarkerDetector(scene.landmarks.dictionary, MarkersConfig())
        hung = installed.map.landmark_map()
        assert installed.camera is not None
        assert installed.believed.camera is not None
        *_, (shot, image) = ((shot, take()) for shot, take in exposures(scene, log))
        for marker_id, found in detector.find(image):
            true.append(found - project(installed.camera, hung.landmarks[marker_id], log, shot.stamp_s))
            said = scene.surveyed.landmarks[marker_id]
            believed.append(found - project(installed.believed.camera, said, log, shot.stamp_s))
    assert len(true) >= 6
    assert np.abs(np.concatenate(true)).max() < 0.3
    assert np.median(np.linalg.norm(np.concatenate(believed), axis=1)) > 1.5


def test_bag_says_what_is_believed_of_the_camera_and_late_stamps(tmp_path: Path) -> None:
    without_wheels = Installation.as_installed().model_copy(
        update={"wheel_radius_share": 0.0, "wheel_difference_share": 0.0, "track_share": 0.0}
    )
    for name, installation in (("perfect", None), ("installed", without_wheels)):
        record(SCENARIO.model_copy(update={"installation": installation}), 3, tmp_path / name)
    before, after = (messages(tmp_path / name / "bag") for name in ("perfect", "installed"))
    installed = load_installed(tmp_path / "installed" / "installed.yaml")
    assert installed.camera is not None
    assert installed.believed.camera is not None
    images, images_before = after["/camera/image/compressed"], before["/camera/image/compressed"]
    assert len(images) == len(images_before) == 9
    assert all((a[2].data == b[2].data).all() for a, b in zip(images, images_before, strict=True))
    assert [row[1] for row in images] == [row[1] for row in images_before]
    late = np.array([a[0] - b[0] for a, b in zip(images, images_before, strict=True)]) * 1e-9
    assert abs(late.mean() - installed.camera.time_offset_s) < 0.003
    assert 0.0005 < late.std() < 0.004
    assert abs(installed.camera.time_offset_s) > 0.005
    for stamp, _, info in after["/camera/camera_info"]:
        assert stamp in [row[0] for row in images]
        np.testing.assert_array_equal(info.k.reshape(3, 3), installed.believed.camera.matrix)
        np.testing.assert_array_equal(info.d, installed.believed.camera.distortion)
        assert not np.allclose(info.k.reshape(3, 3), installed.camera.matrix, rtol=1e-4)


def test_tf_says_what_is_believed_of_the_mounting(tmp_path: Path) -> None:
    from fgloc.config import Config
    from fgloc.recording.reader import open_recording
    from fgloc.types import TransformEvent

    record(FULL.model_copy(update={"duration_s": 0.5}), 3, tmp_path / "run")
    installed = load_installed(tmp_path / "run" / "installed.yaml")
    assert installed.camera is not None
    assert installed.believed.camera is not None
    with open_recording(tmp_path / "run" / "bag", Config().recording) as recording:
        mounted = {e.child: e for e in recording.events() if isinstance(e, TransformEvent)}
    camera, imu = mounted["camera_optical"], mounted["imu_link"]
    np.testing.assert_array_equal(camera.translation, installed.believed.camera.position)
    rotation = quaternion_matrix(camera.rotation)
    np.testing.assert_allclose(rotation, installed.believed.camera.rotation, atol=1e-12)
    turned = np.degrees(np.linalg.norm(rotation - installed.camera.rotation) / np.sqrt(2.0))
    assert 0.05 < turned < 2.5
    assert 0.0005 < np.linalg.norm(camera.translation - np.array(installed.camera.position)) < 0.015
    np.testing.assert_array_equal(imu.rotation, (0.0, 0.0, 0.0, 1.0))
    assert np.abs(installed.imu.rpy).max() > 0.0


def test_a_rear_camera_is_recorded_as_it_is_believed_and_shows_what_is_behind(tmp_path: Path) -> None:
    rear = Camera(rate_hz=10, position=(-0.1, 0.0, 0.25), rpy_deg=(0.0, 0.0, 180.0))
    scenario = FULL.model_copy(update={"rear": rear})
    record(scenario, 3, tmp_path)
    config = load_config(tmp_path / "robot.yaml")
    assert list(config.cameras) == ["camera", "rear"]
    installed = load_installed(tmp_path / "installed.yaml")
    scene = make_scene(scenario, 3)
    log, hung = simulate(scene), installed.map.landmark_map()
    detector = MarkerDetector(scene.landmarks.dictionary, MarkersConfig())
    sent, seen = messages(tmp_path / "bag"), {}
    for name in config.cameras:
        stamp_ns, _, message = sent[f"/{name}/image/compressed"][-1]
        assert message.header.frame_id == f"{name}_optical"
        found = detector.find(cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE))
        seen[name] = {marker_id for marker_id, _ in found}
        true, at_s = installed.true_camera(name), (stamp_ns - EPOCH_NS) * 1e-9
        off = [corners - project(true, hung.landmarks[i], log, at_s) for i, corners in found]
        assert np.abs(np.concatenate(off)).max() < 0.5  # px
    assert not seen["camera"] & seen["rear"]
    assert installed.true_camera("rear").position != installed.believed_camera("rear").position
