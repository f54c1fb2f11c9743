"""Robots with several cameras: each has its topics, place, clock and counts; the others go on where one is dark."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robot_world import CAMERA, SIGMA_PX, START_NS, T_BASE_CAM, World, project, room
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.calibration.installation import with_settings
from fgloc.config import Config, config_of, load_config, yaml_of
from fgloc.diagnosis.mistakes import find_mistakes, of_camera
from fgloc.errors import RecordingError
from fgloc.evaluation.metrics import match_result
from fgloc.graph.estimators import make_estimator
from fgloc.live import Live
from fgloc.recording.reader import open_recording
from fgloc.replay import RunMode
from fgloc.runner import RunResult, run
from fgloc.sensors.equipment import LandmarkSensor, MotionSensors, PoseSensors
from fgloc.sensors.maps import write_map
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Finding, LandmarkMap, Severity
from fgloc_datasets.bag import BagWriter

SECTIONS = {
    "wheels": {"source": "twist"},
    "markers": {"sigma_px": SIGMA_PX},
    "cameras": {"front": {"sightings": "/front/tags"}, "rear": {"sightings": "/rear/tags"}},
}
SIDES = {"front": 0.0, "rear": math.pi}  # [rad] where they look


def both(**changes) -> Config:
    return config_of(SECTIONS | changes)


def recorded(folder: Path, late_s: float = 0.0, front_until_s: float = math.inf) -> Path:
    """Bag of a circle, seen by a front and a rear camera; the stamps of the rear one may be late."""
    rng, world = np.random.default_rng(4), World(room(), seconds=12.0, rate=5)
    folder.mkdir(exist_ok=True)
    with BagWriter(folder / "bag") as bag:
        for name, turn in SIDES.items():
            T = np.eye(4)
            T[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
            T = T @ T_BASE_CAM
            bag.camera_info(f"/{name}/camera_info", START_NS, (640, 480), CAMERA.K, [0.0] * 4, frame_id=name)
            turned = tuple(Rotation.from_matrix(T[:3, :3]).as_quat())
            bag.static_transform(START_NS, "base_link", name, T[:3, 3], turned)
        for event in world.events():
            stamp, pose = event.stamp_ns, world.truth(event.stamp_ns)
            if isinstance(event, OdometryEvent):
                bag.odometry("/odom", stamp, pose, (event.linear[0], event.angular[2]))
                bag.planar_truth("/truth", stamp, pose)
            if not isinstance(event, CornersEvent):
                continue
            for name, turn in SIDES.items():
                if name == "front" and (stamp - START_NS) * 1e-9 >= front_until_s:
                    continue
                at = se2.compose(pose, (0.0, 0.0, turn))
                views = {i: project(at, m) for i, m in room().landmarks.items()}
                seen = {i: c + rng.normal(0.0, SIGMA_PX, (4, 2)) for i, c in views.items() if c is not None}
                stamped = stamp + round(1e9 * (late_s if name == "rear" else 0.0))
                bag.corners(f"/{name}/tags", stamped, seen, frame_id=name, received_ns=stamp + 40_000_000)
    write_map(room(), folder / "map.yaml")
    return folder / "bag"


def ran(bag: Path, config: Config, mode: RunMode = "batch") -> RunResult:
    return run(bag, bag.parent / "map.yaml", config, mode, check=False)


def worst_mm(result: RunResult) -> float:
    matched = match_result(result, result.config or Config())
    return float(1e3 * np.max(matched.distances))


def test_each_of_two_cameras_has_its_place_its_calibration_and_its_rows(tmp_path):
    bag = recorded(tmp_path)
    result = ran(bag, both())
    assert result.counts["front/corners"] > 30
    assert result.counts["rear/corners"] > 30
    assert {"cameras.front.x", "cameras.rear.yaw", "cameras.rear.focal_scale"} <= result.installation.keys()
    assert not any(name.startswith("camera.") for name in result.installation)
    assert {d.kind for d in result.decisions} >= {"front/corners", "rear/corners"}
    one = ran(bag, config_of(SECTIONS | {"cameras": {"front": {"sightings": "/front/tags"}}}))
    assert np.median(np.linalg.det(result.trajectory.covs)) < np.median(np.linalg.det(one.trajectory.covs))
    assert worst_mm(result) < 30.0


def test_the_estimator_has_the_constants_of_each_camera():
    sensor = LandmarkSensor(both(), room(), [replace(CAMERA, name=name) for name in SIDES], None)
    motion = MotionSensors(WheelMotion(both().wheels))
    made = make_estimator(both(), room(), motion, PoseSensors(sensor), keep_all=False)
    assert {"cameras.front.x_m", "cameras.rear.x_m"} <= set(made.installation.names)


def test_the_clock_of_each_camera_is_found_by_itself(tmp_path):
    held = {"time_offset_sigma_s": 0.05, "rotation_sigma_rad": 1e-5, "position_sigma_m": 1e-5}  # on a circle, alike
    config = both(cameras={name: part | held for name, part in SECTIONS["cameras"].items()})
    found = ran(recorded(tmp_path, late_s=0.04), config)
    front, rear = (found.installation[f"cameras.{name}.time_offset_s"][0] for name in SIDES)
    assert rear - front == pytest.approx(0.04, abs=0.01)  # in a steady turn only the difference shows
    written = with_settings(config, found.found.settings)
    offsets = written.recording.stamp_offset_s
    assert offsets["rear/sightings"] - offsets["front/sightings"] == pytest.approx(-0.04, abs=0.01)
    assert written.cameras["rear"].pose is not None


@pytest.mark.parametrize("mode", ["batch", "online"])
def test_one_goes_on_where_the_other_is_dark(tmp_path, mode):
    whole, dark = recorded(tmp_path / "whole"), recorded(tmp_path / "dark", front_until_s=4.0)
    assert worst_mm(ran(dark, both(), mode)) < 2.0 * worst_mm(ran(whole, both(), mode)) + 5.0


def test_a_camera_without_messages_is_named_and_the_run_goes_on(tmp_path):
    bag = recorded(tmp_path, front_until_s=-1.0)
    result = ran(bag, both())
    assert result.counts.keys() & {"front/corners", "rear/corners"} == {"rear/corners"}
    assert any("cameras.front.sightings" in f.text for f in result.findings)
    with pytest.raises(RecordingError, match=r"cameras\.front\.sightings"):
        ran(bag, config_of(SECTIONS | {"cameras": {"front": {"sightings": "/front/tags"}}}))


def test_rejections_are_counted_by_camera(tmp_path):
    bag = recorded(tmp_path)
    (tmp_path / "map.yaml").unlink()
    write_map(LandmarkMap({i: m for i, m in room().landmarks.items() if i != 3}, "DICT_4X4_50"), tmp_path / "map.yaml")
    rejected = ran(bag, both()).rejections
    assert rejected["front/sightings.unknown_id"] > 0
    assert rejected["rear/sightings.unknown_id"] > 0
    assert "sightings.unknown_id" not in rejected


def test_findings_on_one_of_several_cameras_name_it_and_its_keys():
    turned = Finding(
        "sightings.mounting",
        "The sensor looks elsewhere: set recording.sightings_pose: [0, 0].",
        Severity.ERROR,
        {"recording.sightings_pose": "[0, 0]"},
    )
    late = Finding("clock.image", "Late: set it.", lines={"recording.stamp_offset_s": "{image: -0.1}"})
    other = Finding("imu.axes", "The IMU lies on its side.", Severity.ERROR)
    found = of_camera([turned, late, other], "rear")
    assert found[0].lines == {"cameras.rear.pose": "[0, 0]"}
    assert "cameras.rear.pose" in found[0].text
    assert found[1].lines == {"recording.stamp_offset_s": "{rear/image: -0.1}"}
    assert found[2].text == other.text
    assert of_camera([turned], "") == [turned]


def test_a_sound_set_up_of_two_cameras_has_no_mistake(tmp_path):
    assert not find_mistakes(recorded(tmp_path), tmp_path / "map.yaml", both()).grave


def test_live_poses_of_two_cameras_are_those_of_the_recording(tmp_path):
    bag, config = recorded(tmp_path), both()
    online = ran(bag, config, "online")
    poses = {}
    roles = ("odometry", "front/sightings", "rear/sightings")
    with open_recording(bag, config.recording) as recording, Live(config, tmp_path / "map.yaml", roles=roles) as live:
        live.subscribe(lambda e: poses.update({e.stamp_ns: e.pose}))
        for event in recording.events():
            live.push(event)
        live.wait()
        status = live.status()
    assert not status.dropped
    shared = sorted(set(poses) & set(online.trajectory.stamps_ns.tolist()))
    assert len(shared) > 40
    for stamp in shared[len(shared) // 2 :]:
        np.testing.assert_allclose(poses[stamp], online.trajectory.interpolate(stamp), atol=0.02)


def test_a_configuration_of_several_cameras_is_read_as_it_is_written(tmp_path):
    (tmp_path / "lens.yaml").write_text("x")
    config = both(cameras={"front": {"image": "/front/image_raw", "file": str(tmp_path / "lens.yaml")}})
    path = tmp_path / "robot.yaml"
    path.write_text(yaml_of(config, tmp_path))
    assert load_config(path) == config


@pytest.mark.parametrize(
    "sections",
    [
        {"cameras": {"front": {}}},  # no topic
        {"cameras": {"front/left": {"image": "/i"}}},
        {"cameras": {"front": {"image": "/i", "tilt": 1}}},
        {"camera": {"focal_scale": 1.1}, "cameras": {"front": {"image": "/i"}}},
    ],
)
def test_cameras_that_cannot_be_are_refused(tmp_path, sections):
    with pytest.raises(ValueError, match="camera"):
        config_of(sections)


def test_one_camera_of_several_is_taken_apart_and_put_back():
    config = both(recording={"stamp_offset_s": {"rear/sightings": -0.1}, "received_stamps": ["front/sightings"]})
    alone = config.of_camera("rear")
    assert alone.recording.stamp_offset_s == {"sightings": -0.1}
    assert alone.recording.topics.sightings == "/rear/tags"
    assert config.with_camera("rear", alone) == config
