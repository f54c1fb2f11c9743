"""What a run says of clocks, scales, mountings and maps that do not fit together: each fault named, none invented."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
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
from fgloc.calibration.first_settings import first_settings
from fgloc.config import TopicsConfig, config_of_file, load_config, with_value
from fgloc.diagnosis.mistakes import Diagnosis
from fgloc.frames import yaw_quaternion
from fgloc.recording.reader import TopicInfo, select_roles
from fgloc.recording.storage import find_beside
from fgloc.replay import TopicActivity
from fgloc.runner import run
from fgloc.sensor_setup import given_pose
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.maps import write_map
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import ControlEvent, Finding, LandmarkMap, Severity
from fgloc_datasets import mrclam
from fgloc_datasets.bag import BagWriter

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


def diagnose(made, landmark_map, camera=None, settings=None, place=None) -> dict[str, Finding]:
    """Findings of a diagnosis of these events, by code."""
    cameras = () if camera is None else (camera,)
    diagnosis = Diagnosis(settings or config(), landmark_map, cameras, place, np.array([0.0, 0.0, 1.0]))
    for event in made:
        diagnosis.add(event)
    return {finding.code: finding for finding in diagnosis.findings()}


def alone(found: dict[str, Finding], code: str) -> Finding:
    """The finding of this code; there is no other."""
    assert list(found) == [code], found
    return found[code]


@pytest.mark.parametrize("kind", ["corners", "beacons", "unknown map"])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_sound_robot_is_not_accused(kind, seed):
    world = room() if kind == "corners" else beacons()
    known = None if kind == "unknown map" else world
    made = events(world, kind == "corners", seed, gyro_late=0.0)
    assert not diagnose(made, known, CAMERA if kind == "corners" else None)


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_that_drives_one_circle_is_not_accused(seed):
    """Then a late clock, a shifted sensor and a turned one are all the same, and noise may look like any of them."""
    world = World(beacons(), seed=seed, seconds=60.0)
    assert not diagnose(world.events(), beacons())


@pytest.mark.parametrize("late", [DELTA, -DELTA, 0.4])
def test_fault_19_clock_offset_of_the_sightings(late):
    found = alone(diagnose(events(beacons(), late=late, gyro_late=0.0), beacons()), "clock.sightings")
    assert abs(found.value - late) < 0.015  # the wheels' twists hold over their period: half of it is in doubt
    assert yaml.safe_load(found.lines["recording.stamp_offset_s"])["sightings"] == pytest.approx(-found.value, abs=1e-3)


def test_fault_19_the_remedy_counts_what_is_configured_already():
    settings = config(recording={"stamp_offset_s": {"sightings": 0.5}})
    found = alone(diagnose(events(beacons(), late=DELTA), beacons(), settings=settings), "clock.sightings")
    line = yaml.safe_load(found.lines["recording.stamp_offset_s"])
    assert line["sightings"] == pytest.approx(0.5 - DELTA, abs=0.03)


def test_fault_19_the_remedy_of_one_clock_keeps_those_of_the_others():
    """Set in the place of the line that is there, it does not call for the next remedy."""
    settings = config(recording={"stamp_offset_s": {"imu": 0.2}})
    found = alone(diagnose(events(beacons(), late=DELTA), beacons(), settings=settings), "clock.sightings")
    assert yaml.safe_load(found.lines["recording.stamp_offset_s"]).keys() == {"imu", "sightings"}


def test_fault_19_clock_offset_without_a_map():
    found = alone(diagnose(events(beacons(), late=0.3), None), "clock.sightings")
    assert abs(found.value - 0.3) < 4.0 * found.sigma < 0.1


def test_fault_19_clock_offset_of_the_gyro():
    found = alone(diagnose(events(beacons(), gyro_late=-DELTA), beacons()), "clock.imu")
    assert abs(found.value + DELTA) < 4.0 * found.sigma < 0.03


def test_fault_19_what_sightings_and_gyro_agree_on_is_the_wheels():
    made = events(room(), corners=True, wheels_late=DELTA, gyro_late=0.0)
    found = alone(diagnose(made, room(), CAMERA), "clock.odometry")
    assert abs(found.value - DELTA) < 4.0 * found.sigma < 0.03


def test_fault_19_commands_are_followed_late_and_that_is_no_clock():
    made = [
        ControlEvent(e.stamp_ns, e.received_ns, "/cmd_vel", float(e.linear[0]), float(e.angular[2]))
        if isinstance(e, OdometryEvent)
        else e
        for e in events(beacons(), late=DELTA)
    ]
    found = diagnose(made, beacons(), settings=config(wheels={"source": "command"}))
    assert set(found) == {"commands.delay"}
    assert found["commands.delay"].value == pytest.approx(DELTA, abs=0.03)  # a command holds until the next one


@pytest.mark.parametrize("kind", ["corners", "beacons"])
def test_fault_20_drifting_clock(kind):
    world, camera = (room(), CAMERA) if kind == "corners" else (beacons(), None)
    found = alone(diagnose(events(world, kind == "corners", drift=3e-3), world, camera), "clock.drift")
    assert found.value == pytest.approx(3e-3, abs=1e-3)


@pytest.mark.parametrize("wrong", ["size", "focal length"])
def test_fault_40_wrong_marker_size_and_focal_length(wrong):
    """Both are in every distance; which one it is the fit of the corners tells, see `test_gross_mistakes`."""
    world, camera = room(), CAMERA
    if wrong == "size":
        sized = {i: dataclasses.replace(lm, size_m=0.92 * lm.size_m) for i, lm in world.landmarks.items()}
        found = diagnose(events(world, corners=True), LandmarkMap(sized, "DICT_4X4_50"), camera)
    else:
        camera = dataclasses.replace(camera, K=camera.K * [[0.92, 1, 1], [1, 0.92, 1], [1, 1, 1]])
        found = diagnose(events(world, corners=True), world, camera)
    (scale,) = [f for code, f in found.items() if code in ("sightings.scale", "wheels.scale")]
    assert max(scale.value, 1.0 / scale.value) == pytest.approx(1.0 / 0.92, abs=0.035)
    assert not scale.lines  # the map's sizes are no settings, and neither can be told from the other here


def test_fault_40_wrong_range_scale():
    found = alone(diagnose(events(beacons(), stretch=1.08), beacons()), "sightings.scale")
    assert abs(found.value - 1 / 1.08) < 4.0 * found.sigma < 0.06
    assert float(found.lines["expert.landmarks.range_scale"]) == pytest.approx(1 / 1.08, abs=0.015)


@pytest.mark.parametrize(
    "given",
    [
        T_BASE_CAM @ np.diag([-1.0, -1.0, 1.0, 1.0]),
        given_pose(config(recording={"sightings_pose": (0.1, 0.0, 0.2, 0.0, 0.0, math.pi)}), "optical"),
        given_pose(config(recording={"sightings_pose": (0.1, 0.0, 0.2, 0.0, 0.0, -math.pi / 2)}), "optical"),
    ],
    ids=["upside_down", "backward", "to_the_right"],
)
def test_fault_46_wrong_transform_of_the_camera(given):
    camera = dataclasses.replace(CAMERA, T_base_cam=given)
    found = diagnose(events(room(), corners=True), room(), camera)
    assert set(found) <= {"sightings.axes", "sightings.mounting"}, found
    (line,) = [f.lines["recording.sightings_pose"] for f in found.values()]
    suggested = given_pose(config(recording={"sightings_pose": yaml.safe_load(line)}), "optical")
    np.testing.assert_allclose(suggested[:3, :3], T_BASE_CAM[:3, :3], atol=0.05)


@pytest.mark.parametrize(("turn", "named"), [(np.eye(3), []), (T_BASE_CAM[:3, :3].T, ["sightings.axes"])])
def test_fault_46_without_a_map_places_of_markers_are_in_the_axes_of_their_camera(turn, named):
    given = T_BASE_CAM.copy()
    given[:3, :3] = turn @ given[:3, :3]
    camera = dataclasses.replace(CAMERA, T_base_cam=given)
    sized = with_value(config(), "markers.default_size_m", 0.25)
    found = diagnose(events(room(), corners=True), None, camera, sized)
    assert list(found) == named
    if named:
        assert found["sightings.axes"].lines["recording.sightings_axes"] == "optical"


@pytest.mark.parametrize(
    ("change", "code"),
    [(lambda p: p * [1.0, -1.0, 1.0], "map.mirrored"), (lambda p: p * 3.28, "map.unit")],
    ids=["mirrored", "feet"],
)
def test_fault_52_map_and_motion_contradict_each_other(change, code):
    world = beacons()
    wrong = LandmarkMap({i: dataclasses.replace(lm, position=change(lm.position)) for i, lm in world.landmarks.items()})
    alone(diagnose(events(world), wrong), code)


def test_fault_52_map_of_a_scale_that_is_no_unit():
    world = beacons()
    wrong = {i: dataclasses.replace(lm, position=1.2 * lm.position) for i, lm in world.landmarks.items()}
    found = alone(diagnose(events(world), LandmarkMap(wrong)), "map.unit")
    assert found.value == pytest.approx(1 / 1.2, abs=0.02)


def test_fault_52_a_contradiction_that_nothing_explains_is_said_too():
    world = beacons()
    ids = list(world.landmarks)
    mixed = {
        i: dataclasses.replace(world.landmarks[j], landmark_id=i)
        for i, j in zip(ids, np.random.default_rng(5).permutation(ids).tolist(), strict=True)
    }
    assert alone(diagnose(events(world), LandmarkMap(mixed)), "map.contradiction").severity is Severity.ERROR


@pytest.mark.parametrize(("seconds", "seed"), [(10.0, 0), (10.0, 5), (30.0, 3)])
def test_a_robot_that_circles_steadily_tells_no_distances(seconds, seed):
    """A landmark that circles about it may be at any distance, and its sensor anywhere."""
    driven = World(room(), seed=seed, seconds=seconds, rate=5)
    assert not diagnose(driven.events(), room(), CAMERA)


@pytest.mark.parametrize(("known", "seed"), [(3, 6), (3, 7), (3, 9), (4, 20), (4, 23)])
def test_a_map_of_another_place_is_in_no_unit_though_few_of_its_ids_are_seen(known, seed):
    world, rng = beacons(), np.random.default_rng(seed)
    elsewhere = {
        i: dataclasses.replace(world.landmarks[i], position=np.append(rng.uniform(0.0, 12.0, 2), 0.0))
        for i in rng.choice(list(world.landmarks), known, replace=False).tolist()
    }
    found = diagnose(events(world), LandmarkMap(elsewhere))
    assert not found.keys() & {"map.unit", "wheels.scale", "scales"}


@pytest.mark.parametrize("known", [3, 4])
def test_a_map_of_few_landmarks_in_feet_is_named(known):
    world = beacons()
    few = list(world.landmarks.items())[:known]
    wrong = {i: dataclasses.replace(lm, position=lm.position * 3.28) for i, lm in few}
    assert "map.unit" in diagnose(events(world), LandmarkMap(wrong))


def test_fault_52_all_map_poses_shifted_against_the_given_first_pose():
    world = beacons()
    shifted = {
        i: dataclasses.replace(lm, position=lm.position + np.array([0.8, -0.3, 0.0]))
        for i, lm in world.landmarks.items()
    }
    settings = config(estimator={"initial_pose": tuple(at(1.0))})
    assert not diagnose(events(world), world, settings=settings)
    alone(diagnose(events(world), LandmarkMap(shifted), settings=settings), "frame.first_pose")


def test_a_live_run_is_compared_as_its_signals_grow():
    diagnosis = Diagnosis(config(), beacons())
    made = events(beacons(), late=DELTA)
    found = []
    for event in made:
        diagnosis.add(event)
        found.append([f.code for f in diagnosis.findings(ended=False)])
    first = next(k for k, codes in enumerate(found) if codes)
    assert (made[first].received_ns - made[0].received_ns) * 1e-9 < 21.0
    assert found[-1] == ["clock.sightings"]


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
    assert note.startswith("/camera/image (image): ")
    attendance.record("/camera/image", START)
    assert attendance.missing() == ()


def test_fault_69_a_topic_recorded_without_messages_is_named():
    image = TopicInfo("/camera/image_raw", "sensor_msgs/msg/Image", 0)
    (note,) = select_roles((image, TopicInfo("/odom", "nav_msgs/msg/Odometry", 10)), TopicsConfig()).notes
    assert "/camera/image_raw" in note
    assert "--qos-profile-overrides-path" in note
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
    assert not _accused(result)


@pytest.mark.slow
def test_sound_real_robots_are_not_accused(tmp_path):
    bag = mrclam.convert(real_data("mrclam6"), 3, tmp_path / "mrclam")
    result = run(bag, find_beside(bag, "map.yaml"), load_config(find_beside(bag, "robot.yaml")), "online")
    assert not _accused(result)


@pytest.mark.parametrize(
    ("bag", "places"),
    [
        pytest.param("pioneer_aruco/duarte.bag", None, marks=pytest.mark.slow),
        pytest.param("pioneer_aruco/pinto1.bag", None, marks=pytest.mark.slow),
        ("turtlebot3/rosbag2_2025_11_25-15_11_34", "turtlebot3/landmarks_2025_real.yaml"),
    ],
)
def test_sound_recordings_of_others_are_not_accused_with_what_init_writes(bag, places):
    bag = real_data(*bag.split("/"))
    config = config_of_file(yaml.safe_load(first_settings(bag).text))
    result = run(bag, places and real_data(*places.split("/")), config, "online")
    assert not _accused(result)


def _accused(result) -> list[str]:
    """Codes of what a run says to be wrong with its set-up."""
    subjects = ("clock", "sightings", "map", "imu", "wheels", "odometry", "frame", "installation.contradiction")
    return [f.code for f in result.findings if f.severity and f.code.startswith(subjects)]
