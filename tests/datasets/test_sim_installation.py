"""Installations: their draws, what the physics makes of them, and what the recordings say."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from refusal import refusal
from rosbags.highlevel import AnyReader
from sim_bags import messages

from fgloc.config import Config, GateConfig, load_config
from fgloc.errors import ConfigError
from fgloc.frames import rpy_matrix
from fgloc.intake.validation import EventValidator
from fgloc.recording.reader import open_recording
from fgloc.sensors.maps import load_map
from fgloc_datasets.sim.installed import Installed, install, load_installed, survey, write_installed
from fgloc_datasets.sim.physics import base_twist, make_scene, simulate, slipping, wheel_twist
from fgloc_datasets.sim.record import BUNDLED, is_recorded, load_suite, record
from fgloc_datasets.sim.scenario import Camera, Control, Installation, Robot, Scenario, World
from fgloc_datasets.sim.scene import intrinsics, make_map
from fgloc_datasets.sim.sensors import odometry

FULL = Installation.as_installed()
SCENARIO = Scenario(name="test", duration_s=1.0, installation=FULL)
SAMPLES = Path(__file__).parent.parent.parent / "datasets" / "samples"


def digest(folder: Path) -> str:
    """Of all messages with their receive times, and of the map."""
    made = hashlib.sha256((folder / "map.yaml").read_bytes())
    with AnyReader([folder / "bag"]) as reader:
        for connection, received_ns, raw in reader.messages():
            made.update(f"{connection.topic} {received_ns} ".encode() + bytes(raw))
    return made.hexdigest()


def drawn(seed: int, scenario: Scenario = SCENARIO) -> Installed:
    return install(scenario, seed, make_map(scenario.world, seed))


def test_a_run_without_installation_is_recorded_as_before(tmp_path: Path) -> None:
    """The bundled first_run was recorded before there were installations."""
    scenario = load_suite(BUNDLED).find("first_run").model_copy(update={"duration_s": 3.0})
    record(scenario, 1, tmp_path / "run", camera=False)
    now, before = messages(tmp_path / "run" / "bag"), messages(SAMPLES / "first_run" / "bag", 3.0)
    for topic in ("/cmd_vel", "/odom", "/joint_states", "/truth", "/truth/slip"):
        assert [row[:2] for row in now[topic]] == [row[:2] for row in before[topic]]
    places = [
        [(m.pose.position.x, m.pose.position.y, m.pose.orientation.z) for *_, m in rows["/truth"]]
        for rows in (now, before)
    ]
    np.testing.assert_allclose(*places, atol=1e-6)
    efforts = [[m.effort for *_, m in rows["/joint_states"]] for rows in (now, before)]
    np.testing.assert_allclose(*efforts, atol=1e-4)
    assert (tmp_path / "run" / "map.yaml").read_bytes() == (SAMPLES / "first_run" / "map.yaml").read_bytes()


def test_no_installation_and_one_without_errors_give_the_same_messages(tmp_path: Path) -> None:
    perfect = Scenario(name="test", duration_s=1.0)
    for name, installation in (("none", None), ("zero", Installation())):
        record(perfect.model_copy(update={"installation": installation}), 5, tmp_path / name, camera=False)
    assert digest(tmp_path / "none") == digest(tmp_path / "zero")
    installed = load_installed(tmp_path / "none" / "installed.yaml")
    assert installed == load_installed(tmp_path / "zero" / "installed.yaml")
    assert installed.camera is not None
    assert installed.camera.model_dump(exclude={"time_offset_s"}) == installed.believed.camera.model_dump()
    assert installed.camera.time_offset_s == 0.0
    assert installed.imu.gyro_scale == 1.0


def test_draws_have_the_spread_that_is_asked_for() -> None:
    seeds = range(400)
    made = [drawn(seed) for seed in seeds]
    cameras, believed = [i.camera for i in made], [i.believed.camera for i in made]
    assert all(cameras)
    off = lambda name: np.subtract([getattr(b, name) for b in believed], [getattr(c, name) for c in cameras])  # noqa: E731
    wheels = np.array([(i.wheels.left_radius, i.wheels.right_radius, i.wheels.track) for i in made])
    believed_wheels = (0.05, 0.05, 0.26)
    ratios = wheels / believed_wheels - 1.0
    normal = [
        (off("position"), 0.003),
        (np.degrees(off("rpy")), 0.4),
        (off("distortion")[:, :2], 0.005),
        (np.degrees([i.imu.rpy for i in made]), 0.5),
        (np.array([i.imu.gyro_scale for i in made]) - 1.0, 0.005),
    ]
    uniform = [
        (np.divide([b.focal_px for b in believed], [c.focal_px for c in cameras]) - 1.0, 0.005),
        (off("principal_px"), 3.0),
        (np.array([c.time_offset_s for c in cameras]), 0.020),
        (np.array([i.wheels.time_offset_s for i in made]), 0.005),
        (np.array([i.imu.time_offset_s for i in made]), 0.005),
        (ratios[:, :2].mean(axis=1), 0.01),
        (ratios[:, 0] - ratios[:, 1], 0.004),
        (ratios[:, 2], 0.015),
    ]
    for values, sigma in normal:
        np.testing.assert_allclose(values.std(axis=0), sigma, rtol=0.15)
        np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=4 * sigma / np.sqrt(len(made)))
    for values, width in uniform:
        assert np.abs(values).max() <= 1.02 * width
        np.testing.assert_allclose(values.std(axis=0), width / np.sqrt(3.0), rtol=0.15)
    np.testing.assert_array_equal(off("distortion")[:, 2:], 0.0)


def test_the_map_is_measured_with_the_spread_that_is_asked_for() -> None:
    shifts, turns, tilts = [], [], []
    for seed in range(60):
        landmarks = make_map(SCENARIO.world, seed)
        measured = survey(FULL, seed, landmarks)
        for marker_id, true in landmarks.landmarks.items():
            said = measured.landmarks[marker_id]
            shifts.append(said.position - true.position)
            small = np.degrees(said.rotation @ true.rotation.T - np.eye(3))
            turns.append(small[1, 0])
            about = np.array([small[2, 1], small[0, 2], small[1, 0]])  # the rotation vector, in the map
            tilts.append(true.rotation[:, [0, 2]].T @ about)
    np.testing.assert_allclose(np.std(shifts, axis=0), 0.005, rtol=0.1)
    np.testing.assert_allclose(np.std(turns), 0.5, rtol=0.1)
    np.testing.assert_allclose(np.std(tilts, axis=0), 0.5, rtol=0.1)


def test_an_error_alone_is_the_one_that_is_drawn_among_others() -> None:
    alone = Installation(marker_position_m=0.005)
    landmarks = make_map(SCENARIO.world, 7)
    only, full = survey(alone, 7, landmarks), survey(FULL, 7, landmarks)
    for marker_id, true in landmarks.landmarks.items():
        assert (only.landmarks[marker_id].position == full.landmarks[marker_id].position).all()
        np.testing.assert_allclose(only.landmarks[marker_id].rotation, true.rotation, atol=1e-15)
    installed = drawn(7, SCENARIO.model_copy(update={"installation": alone}))
    assert installed.model_dump() == drawn(7, SCENARIO.model_copy(update={"installation": None})).model_dump()
    later = drawn(7, SCENARIO.model_copy(update={"installation": Installation(camera_time_s=0.020)}))
    assert later.camera is not None
    assert later.camera.time_offset_s == drawn(7).camera.time_offset_s != 0.0


def test_the_robot_has_the_true_wheels_and_believes_the_others() -> None:
    robot = Robot(radius_scale=(1.02, 0.99), track_scale=1.1)
    hall = World(size_m=(20.0, 20.0))
    errors = Installation(wheel_radius_share=0.1, wheel_difference_share=0.02, track_share=0.1)
    spin = Scenario(
        name="test", duration_s=6.0, camera=None, robot=robot, world=hall, installation=errors,
        control=Control(functions=("spin",), segment_s=30.0),
    )  # fmt: skip
    scene = make_scene(spin, 3)
    wheels, model = scene.installed.wheels, scene.model
    assert abs(wheels.track / robot.track_m - 1.0) > 0.01
    assert abs(wheels.left_radius / robot.radius_m / 1.02 - 1.0) > 0.01
    assert model.geom("left_wheel").size[0] == pytest.approx(wheels.left_radius, rel=1e-12)
    assert model.geom("right_wheel").size[0] == pytest.approx(wheels.right_radius, rel=1e-12)
    assert model.body("left_wheel").pos[1] - model.body("right_wheel").pos[1] == pytest.approx(wheels.track)
    log, true = simulate(scene), scene.scenario.robot
    steady = log.stamps_s > 3.0
    turned = base_twist(log)[steady, 2].mean()
    assert abs(turned) > 0.2
    assert not slipping(log, true).any()
    np.testing.assert_allclose(wheel_twist(log, true)[steady, 2].mean(), turned, rtol=0.005)
    said = odometry(log, true, 4)[1][log.stamps_s[::4] > 3.0, 2].mean()
    left, right = log.wheel_rates[steady].mean(axis=0) * robot.radius_m  # by the radius and the track that are believed
    assert said == pytest.approx((right - left) / (robot.track_m * robot.track_scale), rel=0.005)
    assert abs(said / turned - 1.0) > 0.02


def test_stamps_are_shifted_and_receive_times_are_not(tmp_path: Path) -> None:
    perfect = Scenario(name="test", duration_s=1.0, camera=None)
    late = perfect.model_copy(update={"installation": Installation(wheel_time_s=0.005, imu_time_s=0.005)})
    for name, scenario in (("perfect", perfect), ("late", late)):
        record(scenario, 6, tmp_path / name, camera=False)
    before, after = (messages(tmp_path / name / "bag") for name in ("perfect", "late"))
    installed = load_installed(tmp_path / "late" / "installed.yaml")
    offsets = {"/imu": installed.imu.time_offset_s} | dict.fromkeys(
        ("/odom", "/joint_states"), installed.wheels.time_offset_s
    )
    assert all(abs(offset) > 1e-4 for offset in offsets.values())
    for topic, rows in before.items():
        assert [row[1] for row in after[topic]] == [row[1] for row in rows]
        shift = round(1e9 * offsets.get(topic, 0.0))
        assert [row[0] - shift for row in after[topic]] == [row[0] for row in rows]
        assert all(received > stamp for stamp, received, _ in rows)  # rows have the true times


def test_the_intake_accepts_what_is_recorded(tmp_path: Path) -> None:
    record(SCENARIO, 6, tmp_path / "run", camera=False)
    for bag in (tmp_path / "run" / "bag", SAMPLES / "installed_run" / "bag"):
        gate, last = EventValidator(GateConfig()), dict[str, int]()
        with open_recording(bag, Config().recording) as recording:
            for event in recording.events():
                assert gate.check(event) is not None
                if event.topic != "/tf_static":
                    assert last.get(event.topic, 0) < event.stamp_ns < event.received_ns + 20_000_000
                    last[event.topic] = event.stamp_ns
        assert not gate.rejections


def test_files_say_what_is_believed_and_installed_yaml_the_truth(tmp_path: Path) -> None:
    out = tmp_path / "run"
    record(SCENARIO, 5, out, camera=False)
    installed = load_installed(out / "installed.yaml")
    assert installed == drawn(5)
    true, said = installed.map.landmark_map(), load_map(out / "map.yaml")
    for marker_id, landmark in make_map(SCENARIO.world, 5).landmarks.items():
        np.testing.assert_array_equal(true.landmarks[marker_id].position, landmark.position)
        np.testing.assert_allclose(true.landmarks[marker_id].rotation, landmark.rotation, atol=1e-12)
        off = np.linalg.norm(said.landmarks[marker_id].position - landmark.position)
        assert 0.0 < off < 0.025
    wheels, believed = load_config(out / "robot.yaml").wheels, installed.believed.wheels
    assert wheels.left_radius == believed.left_radius == SCENARIO.robot.radius_m != installed.wheels.left_radius
    assert wheels.track == believed.track == SCENARIO.robot.track_m != installed.wheels.track
    assert is_recorded(SCENARIO, 5, out, camera=False)
    assert not is_recorded(SCENARIO.model_copy(update={"installation": None}), 5, out, camera=False)
    (out / "installed.yaml").unlink()
    assert not is_recorded(SCENARIO, 5, out, camera=False)


def test_a_camera_that_looks_down_keeps_its_direction() -> None:
    camera = Camera(rpy_deg=(3.0, 35.0, -80.0))
    installed = drawn(2, SCENARIO.model_copy(update={"camera": camera}))
    assert installed.camera is not None
    assert installed.believed.camera is not None
    true, said = installed.camera, installed.believed.camera
    np.testing.assert_allclose(true.matrix, intrinsics(camera))
    angle = np.linalg.norm(rpy_matrix(*true.rpy) - rpy_matrix(*said.rpy)) / np.sqrt(2.0)
    assert 0.001 < angle < np.radians(1.6)


def test_installations_are_named_or_given_in_yaml(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    for text, expected in (
        ("as_installed", FULL),
        ("perfect", None),
        ("{marker_position_m: 0.005}", Installation(marker_position_m=0.005)),
    ):
        path.write_text(f"name: a\ninstallation: {text}\n", encoding="utf-8")
        assert load_suite(path).entries[0].scenario.installation == expected
    path.write_text("name: a\ninstallation: sloppy\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"'sloppy'.*\bas_installed\b.*\bperfect\b"):
        load_suite(path)


def test_the_suite_is_as_installed_and_can_be_perfect() -> None:
    suite = load_suite(BUNDLED)
    assert all(entry.scenario.installation == FULL for entry in suite.entries if entry.runs)
    assert all(entry.scenario.installation is None for entry in suite.perfect().entries)
    assert [entry.runs for entry in suite.perfect().entries] == [entry.runs for entry in suite.entries]


def test_a_truth_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "installed.yaml"
    with refusal(ConfigError, path, cause=FileNotFoundError):
        load_installed(path)
    write_installed(drawn(1), path)
    assert load_installed(path) == drawn(1)
    path.write_text(path.read_text(encoding="utf-8").replace("gyro_scale", "gyro_gain"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"imu\.gyro_gain"):
        load_installed(path)
