"""What a run says of clocks, scales, mountings and maps that do not fit together: each fault named, none invented."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
from real_data import real_data
from robot_world import (
    CAMERA,
    NOISE,
    SIGMA_BEARING,
    SIGMA_RANGE,
    T_BASE_CAM,
    World,
    beacons,
    config,
    polar,
    project,
    room,
)

from fgloc import se2
from fgloc.config import TopicsConfig, load_config
from fgloc.datasets import mrclam, pioneer, turtlebot3
from fgloc.datasets.bag import BagWriter
from fgloc.diagnosis.diagnosis import Diagnosis
from fgloc.diagnosis.pool import Evidence, Pool
from fgloc.frames import yaw_quaternion
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.intake.topic_activity import TopicActivity
from fgloc.recording.files import find_beside
from fgloc.recording.roles import TopicInfo, select_roles
from fgloc.runner import run
from fgloc.sensor_setup import given_pose
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.sensors.maps import write_map
from fgloc.sensors.markers.events import CornersEvent, MarkerCorners
from fgloc.sensors.range_bearing.events import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import ControlEvent, LandmarkMap

SAMPLES = Path(__file__).resolve().parent.parent.parent / "datasets" / "samples"
START = 1_700_000_000_000_000_000
SECONDS = 64.0
GRID = np.arange(0.0, SECONDS + 4.0, 0.01)
DELTA = 0.12


def drive() -> np.ndarray:
    """Poses ``(n, 3)`` on the grid: a robot that speeds up, slows down and turns either way."""
    v = 0.3 + 0.2 * np.sin(0.9 * GRID)
    omega = 0.25 + 0.5 * np.sin(0.6 * GRID) + 0.2 * np.sin(1.7 * GRID)
    yaw = np.concatenate([[0.0], np.cumsum(0.01 * omega)[:-1]])
    steps = 0.01 * v[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    xy = np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)[:-1]])
    return np.column_stack([xy, yaw]), v, omega


POSES, SPEEDS, RATES = drive()


def at(t: float) -> np.ndarray:
    """Pose at a time [s]."""
    return np.array([np.interp(t, GRID, POSES[:, k]) for k in range(3)])


def stamp(t: float, late_s: float = 0.0, drift: float = 0.0) -> int:
    return START + round((t + late_s + drift * t) * 1e9)


def events(landmark_map, corners=False, seed=0, wheels_late=0.0, gyro_late=None, drift=0.0, stretch=1.0, late=0.0):
    """Odometry at 20 Hz, sightings at 10 Hz, gyro at 50 Hz if its lateness is given; ``stretch`` of ranges."""
    rng = np.random.default_rng(seed)
    made = []
    spread = math.sqrt(0.3 / 0.05)
    landmarks = list(landmark_map.landmarks.values())
    for tick in range(100, round((SECONDS - 1.0) * 100)):
        t = 0.01 * tick
        received = stamp(t)
        if tick % 5 == 0:
            v = SPEEDS[tick] + rng.normal(0.0, NOISE["x_per_sqrt_m"] * spread)
            omega = RATES[tick] + rng.normal(0.0, 0.2 * NOISE["yaw_per_sqrt_m"] * spread)
            zero = np.zeros((6, 6))
            twist = np.array([v, 0.0, 0.0]), np.array([0.0, 0.0, omega])
            place = np.append(POSES[tick, :2], 0.0), yaw_quaternion(POSES[tick, 2])
            made.append(
                OdometryEvent(stamp(t, wheels_late), received, "/odom", "odom", "base_link", *place, zero, *twist, zero)
            )
        if gyro_late is not None and tick % 2 == 0:
            rate = np.array([0.0, 0.0, RATES[tick] + 0.01 + rng.normal(0.0, 0.004)])
            made.append(ImuEvent(stamp(t, gyro_late), received, "/imu", "imu", rate, np.zeros(3), np.zeros((3, 3))))
        if tick % 10 == 0:
            when, pose = stamp(t, late, drift), POSES[tick]
            if corners:
                seen = [(lm.landmark_id, c) for lm in landmarks if (c := project(pose, lm)) is not None]
                found = tuple(MarkerCorners(i, c + rng.normal(0.0, 0.3, (4, 2))) for i, c in seen)
                made.append(CornersEvent(when, received, "/tags", "cam", found))
            else:
                found = []
                for i in rng.choice(len(landmarks), 2, replace=False):
                    r, bearing = polar(pose, landmarks[i])
                    r = stretch * r + rng.normal(0.0, SIGMA_RANGE)
                    found.append(RangeBearing(int(i), r, se2.wrap(bearing + rng.normal(0.0, SIGMA_BEARING))))
                made.append(RangeBearingEvent(when, received, "/landmarks", "base_link", tuple(found)))
    return made


def diagnose(made, landmark_map, camera=None, settings=None, place=None) -> tuple[str, ...]:
    """Steps of these events, watched by a diagnosis; what it says."""
    settings = settings or config()
    wheels = WheelMotion(settings.wheels)
    stepper = KeyframeBuilder(settings.keyframes, settings.gate, settings.estimator.lag_s)
    seen_by = "sightings" if camera is None else "image"
    diagnosis = Diagnosis(settings, landmark_map, camera, place, seen_by, np.array([0.0, 0.0, 1.0]))
    for step in [step for event in made for step in stepper.push(event)] + stepper.flush():
        diagnosis.observe(step, wheels.measure(step))
    return diagnosis.notes(wheels.source)


def number(pattern: str, text: str) -> tuple[float, float]:
    """The value and its sigma."""
    found = re.search(pattern + r" ?([\d.]+) ± ([\d.]+)", text)
    assert found, text
    return float(found[1]), float(found[2])


@pytest.mark.parametrize("kind", ["corners", "beacons", "unknown map"])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_sound_robot_is_not_accused(kind, seed):
    world = room() if kind == "corners" else beacons()
    known = None if kind == "unknown map" else world
    made = events(world, kind == "corners", seed, gyro_late=0.0)
    assert diagnose(made, known, CAMERA if kind == "corners" else None) == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_that_drives_one_circle_is_not_accused(seed):
    """Then a late clock, a shifted sensor and a turned one are all the same, and noise may look like any of them."""
    world = World(beacons(), seed=seed, seconds=60.0)
    assert diagnose(world.events(), beacons()) == ()


@pytest.mark.parametrize("late", [DELTA, -DELTA, 0.4])
def test_fault_19_clock_offset_of_the_sightings(late):
    (note,) = diagnose(events(beacons(), late=late, gyro_late=0.0), beacons())
    value, sigma = number("stamps of the sightings are", note)
    assert abs(value - abs(late)) < 4.0 * sigma < 0.06
    assert ("late" if late > 0 else "early") in note
    remedy = float(re.search(r"stamp_offset_s: \{sightings: (-?[\d.]+)\}", note)[1])
    assert remedy == pytest.approx(-late, abs=4.0 * sigma)


def test_fault_19_the_remedy_counts_what_is_configured_already():
    settings = config(recording={"stamp_offset_s": {"sightings": 0.5}})
    (note,) = diagnose(events(beacons(), late=DELTA), beacons(), settings=settings)
    assert float(re.search(r"sightings: (-?[\d.]+)\}", note)[1]) == pytest.approx(0.5 - DELTA, abs=0.03)


def test_fault_19_clock_offset_without_a_map():
    (note,) = diagnose(events(beacons(), late=0.3), None)
    value, sigma = number("stamps of the sightings are", note)
    assert abs(value - 0.3) < 4.0 * sigma < 0.1


def test_fault_19_clock_offset_of_the_gyro():
    (note,) = diagnose(events(beacons(), gyro_late=-DELTA), beacons())
    value, sigma = number("stamps of the gyro are", note)
    assert abs(value - DELTA) < 4.0 * sigma < 0.03
    assert "early against the wheels" in note


def test_fault_19_what_sightings_and_gyro_agree_on_is_the_wheels():
    (note,) = diagnose(events(room(), corners=True, wheels_late=DELTA, gyro_late=0.0), room(), CAMERA)
    value, sigma = number("stamps of the wheels are", note)
    assert abs(value - DELTA) < 4.0 * sigma < 0.03
    assert "{odometry: -0.1" in note


def test_fault_19_commands_are_followed_late_and_that_is_no_clock():
    made = [
        ControlEvent(e.stamp_ns, e.received_ns, "/cmd_vel", float(e.linear[0]), float(e.angular[2]))
        if isinstance(e, OdometryEvent)
        else e
        for e in events(beacons(), late=DELTA)
    ]
    assert diagnose(made, beacons(), settings=config(wheels={"source": "command"})) == ()


def test_fault_20_drifting_clock():
    (note,) = diagnose(events(room(), corners=True, drift=3e-3), room(), CAMERA)
    value, sigma = number(r"drifts against the wheels' by \+", note)
    assert abs(value - 3.0) < 4.0 * sigma < 1.2
    assert "received_stamps" in note


def test_fault_40_wrong_marker_size():
    world = room()
    smaller = {i: dataclasses.replace(lm, size_m=0.92 * lm.size_m) for i, lm in world.landmarks.items()}
    (note,) = diagnose(events(world, corners=True), LandmarkMap(smaller, "DICT_4X4_50"), CAMERA)
    value, sigma = number("Sightings are", note)
    assert abs(value - 0.92) < 4.0 * sigma < 0.06
    assert "markers' size has to be 1.0" in note


def test_fault_40_wrong_focal_length():
    camera = dataclasses.replace(CAMERA, K=CAMERA.K * [[0.92, 1, 1], [1, 0.92, 1], [1, 1, 1]])
    (note,) = diagnose(events(room(), corners=True), room(), camera)
    value, sigma = number("focal length has to be", note)
    assert abs(value - 1 / 0.92) < 4.0 * sigma < 0.06


def test_fault_40_wrong_range_scale():
    (note,) = diagnose(events(beacons(), stretch=1.08), beacons())
    value, sigma = number("Sightings are", note)
    assert abs(value - 1.08) < 4.0 * sigma < 0.06
    assert float(re.search(r"range_scale: (\d\.\d+)", note)[1]) == pytest.approx(1 / 1.08, abs=0.015)


def test_fault_46_camera_upside_down():
    over = np.diag([-1.0, -1.0, 1.0, 1.0])
    camera = dataclasses.replace(CAMERA, T_base_cam=T_BASE_CAM @ over)
    (note,) = diagnose(events(room(), corners=True), room(), camera)
    assert "upside down" in note
    np.testing.assert_allclose(_suggested(note), T_BASE_CAM, atol=0.03)


@pytest.mark.parametrize(
    ("turn", "expected"),
    [
        ((0.0, 0.0, math.pi), "backward"),
        ((0.0, 0.0, -math.pi / 2), "to the left"),  # its transform says: to the right
    ],
)
def test_fault_46_wrong_transform_of_the_camera(turn, expected):
    settings = config(recording={"sightings_pose": (0.1, 0.0, 0.2, *turn)})
    camera = dataclasses.replace(CAMERA, T_base_cam=given_pose(settings, "optical"))
    (note,) = diagnose(events(room(), corners=True), room(), camera, settings)
    assert expected in note
    np.testing.assert_allclose(_suggested(note), T_BASE_CAM, atol=0.05)


def _suggested(note: str) -> np.ndarray:
    """``T_base_cam`` by the configuration line of a note."""
    values = [float(v) for v in re.search(r"sightings_pose: \[(.*?)\]", note)[1].split(",")]
    return given_pose(config(recording={"sightings_pose": values}), "optical")


def test_fault_46_a_few_degrees_of_yaw_are_measured():
    settings = config(recording={"sightings_pose": (0.1, 0.0, 0.2, 0.0, 0.0, math.radians(7.0))})
    camera = dataclasses.replace(CAMERA, T_base_cam=given_pose(settings, "optical"))
    (note,) = diagnose(events(room(), corners=True), room(), camera, settings)
    value, sigma = number("looks", note)
    assert abs(value - 7.0) < 4.0 * sigma < 4.0
    assert "further right" in note


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda p: p * [1.0, -1.0, 1.0], "map is mirrored"),
        (lambda p: p * 3.28, "about 3.3 times"),  # feet for metres
    ],
    ids=["mirrored", "feet"],
)
def test_fault_52_map_and_motion_contradict_each_other(change, expected):
    world = beacons()
    wrong = LandmarkMap({i: dataclasses.replace(lm, position=change(lm.position)) for i, lm in world.landmarks.items()})
    (note,) = diagnose(events(world), wrong)
    assert "contradict each other" in note
    assert expected in note


def test_fault_52_map_of_a_slightly_wrong_scale():
    world = beacons()
    wrong = {i: dataclasses.replace(lm, position=1.08 * lm.position) for i, lm in world.landmarks.items()}
    (note,) = diagnose(events(world), LandmarkMap(wrong))
    value, sigma = number("Distances on the map are", note)
    assert abs(value - 1.08) < 4.0 * sigma < 0.06


def test_fault_52_a_contradiction_that_nothing_explains_is_said_too():
    world = beacons()
    ids = list(world.landmarks)
    mixed = {
        i: dataclasses.replace(world.landmarks[j], landmark_id=i)
        for i, j in zip(ids, np.random.default_rng(5).permutation(ids).tolist(), strict=True)
    }
    (note,) = diagnose(events(world), LandmarkMap(mixed))
    assert "no single mistake of the set-up explains it" in note


def test_fault_52_all_map_poses_shifted_against_the_given_first_pose():
    world = beacons()
    shifted = {
        i: dataclasses.replace(lm, position=lm.position + np.array([0.8, -0.3, 0.0]))
        for i, lm in world.landmarks.items()
    }
    settings = config(estimator={"initial_pose": tuple(at(1.0))})
    assert diagnose(events(world), world, settings=settings) == ()
    (note,) = diagnose(events(world), LandmarkMap(shifted), settings=settings)
    assert "map is shifted by 0.8" in note


def test_fault_19_and_52_are_among_the_notes_of_a_run(tmp_path):
    """From bag to note, through the whole chain."""
    world = beacons()
    made = events(world, late=DELTA)
    with BagWriter(tmp_path / "bag") as bag:
        for e in made:
            if isinstance(e, OdometryEvent):
                twist = (e.linear[0], e.angular[2])
                bag.odometry("/odom", e.stamp_ns, at((e.stamp_ns - START) * 1e-9), twist, e.received_ns)
            else:
                seen = [(s.landmark_id, s.range_m, s.bearing_rad) for s in e.sightings]
                bag.range_bearing("/landmarks", e.stamp_ns, seen, max(e.received_ns, e.stamp_ns))
    write_map(world, tmp_path / "map.yaml")
    result = run(tmp_path / "bag", tmp_path / "map.yaml", config(), "online")
    (late,) = [f for f in result.findings if f.code == "clock.sightings"]
    assert late.value == pytest.approx(DELTA, abs=0.02)


def test_fault_69_topics_that_never_speak_are_named():
    attendance = TopicActivity({"odometry": "/odom", "image": "/camera/image", "truth": "/truth"})
    attendance.record("/odom", START)
    attendance.present("/truth")
    (note,) = attendance.missing()
    assert note.startswith("/camera/image (image): no usable message has arrived")
    assert "quality of service" in note
    attendance.record("/camera/image", START)
    assert attendance.missing() == ()


def test_fault_69_a_topic_recorded_without_messages_is_named():
    image = TopicInfo("/camera/image_raw", "sensor_msgs/msg/Image", 0)
    (note,) = select_roles((image, TopicInfo("/odom", "nav_msgs/msg/Odometry", 10)), TopicsConfig()).notes
    assert note.startswith("No image: /camera/image_raw holds no message")
    assert "quality of service" in note
    assert select_roles((image,), TopicsConfig(image="none")).notes == ()


def test_fault_24_attendance_stays_bounded_and_keeps_count():
    attendance = TopicActivity({})
    for i in range(250_000):
        attendance.record("/imu", START + i * 10_000_000)
    attendance.record("/imu", START + 250_000 * 10_000_000 + 5_000_000_000)
    heard = attendance.spans(START)["/imu"]
    assert len(heard.times) <= 100_000
    assert heard.count == 250_001
    assert heard.longest_gap_s == pytest.approx(5.01)
    assert np.median(np.diff(heard.times)) / heard.every == pytest.approx(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["first_run", "light_drop_run", "patches_run"])
def test_the_sound_samples_are_not_accused(name):
    folder = SAMPLES / name
    result = run(folder / "bag", folder / "map.yaml", load_config(folder / "robot.yaml"), "online")
    assert not [note for note in result.notes if _accuses(note)]


@pytest.mark.slow
def test_sound_real_robots_are_not_accused(tmp_path):
    bags = [mrclam.convert(real_data("mrclam6"), 3, tmp_path / "mrclam")]
    bags += [pioneer.convert(real_data("pioneer_aruco", f"{n}.bag"), tmp_path / n) for n in ("duarte", "pinto1")]
    for bag in bags:
        result = run(bag, find_beside(bag, "map.yaml"), load_config(find_beside(bag, "robot.yaml")), "online")
        assert not [note for note in result.notes if _accuses(note)]


def test_fault_24_evidence_stays_bounded_and_counts_all_windows():
    rng = np.random.default_rng(0)
    pool = Pool(np.array([10.0, 10.0]))
    for i in range(3000):
        information = np.diag(rng.uniform(0.5, 2.0, 2))
        value = np.array([1.0 + 1e-4 * i, -2.0]) + rng.normal(0.0, 1.0, 2) / np.sqrt(np.diag(information))
        pool.add(Evidence(float(i), information, information @ value))
    assert len(pool) <= 512
    drifting = pool.drifting(0)
    assert abs(drifting.values[-1] - 1e-4) < 4.0 * drifting.sigmas[-1] < 2e-4
    assert abs(pool.constant().values[1] + 2.0) < 4.0 * pool.constant().sigmas[1] < 0.2


def test_the_sound_turtlebot3_is_not_accused(tmp_path):
    bag = turtlebot3.convert(real_data("turtlebot3", "rosbag2_2025_11_25-15_11_34"), tmp_path)
    result = run(bag, find_beside(bag, "map.yaml"), load_config(find_beside(bag, "robot.yaml")), "online")
    assert not [note for note in result.notes if _accuses(note)]


def _accuses(note: str) -> bool:
    accusations = ("stamps of the", "drifts", "Sightings are", "on the map", "contradict", "sensor of", "camera")
    return any(words in note for words in accusations)
