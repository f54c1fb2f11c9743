"""The rendered camera against projected truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fgloc.config import MarkersConfig
from fgloc.frames import quaternion_matrix
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.types import FloatArray
from fgloc_datasets.sim.camera import Image, Renderer, RenderError, Shot, exposures, pose_at
from fgloc_datasets.sim.physics import Log, Scene, make_scene, simulate
from fgloc_datasets.sim.scenario import Camera, Control, Scenario
from fgloc_datasets.sim.scene import camera_rotation, intrinsics

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def second() -> tuple[Scene, Log, list[tuple[Shot, Image]]]:
    """One rendered second: a spin in place."""
    camera = Camera(rate_hz=5, max_exposure_s=0.006)
    control = Control(functions=("spin",), rest_s=0.2)
    scene = make_scene(Scenario(name="test", duration_s=1.0, camera=camera, control=control), 2)
    try:
        Renderer(scene).close()
    except RenderError as error:
        pytest.skip(str(error))
    log = simulate(scene)
    return scene, log, [(shot, take()) for shot, take in exposures(scene, log)]


def project(scene: Scene, log: Log, stamp_s: float, marker_id: int) -> FloatArray:
    camera = scene.scenario.camera
    assert camera is not None
    position, quaternion = pose_at(log, stamp_s)
    R_map_base = quaternion_matrix(quaternion)
    R_map_cam = R_map_base @ camera_rotation(camera)
    corners = scene.landmarks.landmarks[marker_id].corners()
    in_cam = (corners - position - R_map_base @ camera.position) @ R_map_cam
    return cv2.projectPoints(in_cam, np.zeros(3), np.zeros(3), intrinsics(camera), np.array(camera.distortion))[0][:, 0]


def test_detected_corners_lie_where_truth_projects(second: tuple[Scene, Log, list[tuple[Shot, Image]]]) -> None:
    scene, log, taken = second
    detector = MarkerDetector(scene.landmarks.dictionary, MarkersConfig())
    errors = [
        found - project(scene, log, shot.stamp_s, marker_id)
        for shot, image in taken
        for marker_id, found in detector.find(image)
    ]
    assert len(errors) >= 6
    flat = np.concatenate(errors)
    assert np.abs(flat.mean(axis=0)).max() < 0.1
    assert np.sqrt((flat**2).mean(axis=0)).max() < 0.5


def test_frames_are_stamped_in_the_middle_of_the_exposure(second: tuple[Scene, Log, list[tuple[Shot, Image]]]) -> None:
    _, _, taken = second
    assert len(taken) == 5
    starts = np.array([f.stamp_s - 0.5 * f.exposure_s for f, _ in taken])
    np.testing.assert_allclose(np.diff(starts), 0.2, atol=1e-9)
    assert all(f.exposure_s == pytest.approx(0.006) for f, _ in taken)
