"""What ``fgloc info`` reports: rows 15 to 17, 28 and 36 of the fault list among others."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from real_data import real_data
from recording_bags import START_NS, TICK_NS, write_drive, write_ros1

from fgloc.config import Config, config_of
from fgloc.errors import RecordingError
from fgloc.recording.info import RecordingInfo, format_info, inspect
from fgloc.runner import run
from fgloc_datasets.bag import BagWriter

CONFIG = Config()


def one(info: RecordingInfo, *facts: str) -> str:
    """The one finding that has this code, or these names and figures."""
    found = [f for f in info.found if all(fact == f.code or fact in f.text for fact in facts)]
    assert len(found) == 1, info.found
    return found[0].text


def about(info: RecordingInfo, topic: str) -> list[str]:
    """Findings on a topic."""
    return [line for line in info.findings if topic in line.partition(": ")[0].split(", ")]


def write_odometry(
    folder: Path,
    stamp: Callable[[int], int] = lambda k: START_NS + k * TICK_NS,
    twist: Callable[[int], tuple[float, float]] = lambda k: (1.0, 0.0),
    pose: Callable[[int], tuple[float, float, float]] = lambda k: (0.05 * k, 0.0, 0.0),
    n: int = 200,
    **options,
) -> Path:
    with BagWriter(folder) as bag:
        for k in range(n):
            received = START_NS + k * TICK_NS + 1_000_000
            bag.odometry("/odom", stamp(k), pose(k), twist(k), received, (np.eye(6), np.eye(6)), **options)
    return folder


def test_a_sound_recording_has_no_findings(tmp_path):
    info = inspect(write_drive(tmp_path / "run"), CONFIG)
    assert info.findings == ()
    assert info.problems == info.notes == ()
    assert info.marker_ids == {0: 40, 1: 40}
    corrected = config_of({"recording": {"stamp_offset_s": {"odometry": 0.1, "truth": 0.5}}})
    assert inspect(tmp_path / "run", corrected).findings == ()  # header stamps are reported as they are recorded
    odometry = next(t for t in info.topics if t.used_as == "odometry")
    assert odometry.rate_hz == pytest.approx(20.0)
    assert odometry.longest_gap_s == pytest.approx(0.05)
    assert odometry.delay_s == pytest.approx(0.002)
    text = format_info(info)
    assert "rosbag2 (MCAP), 10.0 s from 2023-11-14 22:13:20 UTC" in text
    row = next(line for line in text.splitlines() if line.startswith("/odom"))
    assert re.sub(" +", " ", row) == "/odom nav_msgs/Odometry 200 20 Hz 0.05 s at 0.0 s 2 ms odometry"
    assert "What looks wrong:\n  - nothing" in text
    early = replace(info, topics=(replace(odometry, delay_s=-0.0002),))
    assert re.search(r"^/odom .* 0\.0 s +0 ms +odometry$", format_info(early), re.MULTILINE)


def test_fault_15_clock_jumps_back_is_reported(tmp_path):
    """A simulation that loops: stamps start anew at message 120."""
    folder = write_odometry(tmp_path / "run", lambda k: START_NS + (k if k < 120 else k - 100) * TICK_NS)
    info = inspect(folder, CONFIG)
    one(info, "/odom", "4.95 s", "6.0 s")
    assert info.topics[0].jumps_back == 1


def test_fault_16_clock_jumps_ahead_is_reported(tmp_path):
    folder = write_odometry(tmp_path / "run", lambda k: START_NS + k * TICK_NS + (k >= 50) * 3600 * 10**9)
    info = inspect(folder, CONFIG)
    one(info, "/odom", "3.6e+03 s", "2.5 s")
    assert (info.topics[0].jumps_ahead, info.topics[0].jumps_back) == (1, 0)


def test_fault_17_stamp_zero_is_reported_with_its_topic(tmp_path):
    folder = write_odometry(tmp_path / "run", lambda k: 0 if k % 10 == 3 else START_NS + k * TICK_NS)
    info = inspect(folder, CONFIG)
    one(info, "/odom", "20 of 200", "recording.received_stamps: [odometry]")
    assert (info.topics[0].zero_stamps, info.topics[0].jumps_back) == (20, 0)


def test_fault_11_repeated_stamps_are_reported(tmp_path):
    info = inspect(write_odometry(tmp_path / "run", lambda k: START_NS + (k // 2) * 2 * TICK_NS), CONFIG)
    one(info, "/odom", "100 ")
    assert info.topics[0].repeated_stamps == 100


def test_stamps_of_another_clock_are_reported_with_the_remedy(tmp_path):
    folder = write_odometry(tmp_path / "run", lambda k: START_NS + k * TICK_NS - 1_000_000 * 10**9)
    info = inspect(folder, CONFIG)
    assert about(info, "/odom") == [one(info, "1e+06 s", "recording.received_stamps: [odometry]")]
    assert info.topics[0].delay_s == pytest.approx(1e6, rel=1e-3)  # behind
    cured = Config.model_validate({"recording": {"received_stamps": ["odometry"]}})
    assert not about(inspect(folder, cured), "/odom")


def test_early_and_drifting_clocks_are_reported(tmp_path):
    early = inspect(write_odometry(tmp_path / "early", lambda k: START_NS + k * TICK_NS + 200_000_000), CONFIG)
    one(early, "/odom", "199 ms")
    assert early.topics[0].delay_s == pytest.approx(-0.199)
    drift = inspect(write_odometry(tmp_path / "drift", lambda k: START_NS + int(k * TICK_NS * 0.98)), CONFIG)
    one(drift, "/odom", "+0.180 s")


def test_fault_21_gaps_are_reported_with_their_place(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in [*range(100), *range(1300, 1400)]:
            bag.odometry("/odom", START_NS + k * TICK_NS, (0.05 * k, 0, 0), (1, 0), covs=(np.eye(6), np.eye(6)))
    info = inspect(tmp_path / "run", CONFIG)
    assert about(info, "/odom") == [one(info, "60.1 s", "5.0 s")]  # and no jump: 60 m in 60 s is a drive
    assert info.topics[0].longest_gap_at_s == pytest.approx(4.95)


def test_fault_10_spikes_are_reported(tmp_path):
    folder = write_odometry(tmp_path / "run", twist=lambda k: (1.0, -125.0 if k in (60, 61) else 0.0))
    one(inspect(folder, CONFIG), "/odom", "2 of 200", "10 rad/s", "125", "3.0 s")


def test_fault_28_twist_always_zero_is_reported(tmp_path):
    folder = write_odometry(tmp_path / "run", twist=lambda k: (0.0, 0.0))
    one(inspect(folder, CONFIG), "/odom", "10.0 m", "wheels.source: pose")


def test_fault_32_degrees_for_radians_are_reported(tmp_path):
    folder = write_odometry(
        tmp_path / "run", twist=lambda k: (0.0, math.degrees(0.15)), pose=lambda k: (0.0, 0.0, 0.15 * k * 0.05)
    )
    one(inspect(folder, CONFIG), "/odom", "85.5 rad", "1.5 rad", "degrees")


def test_fault_26_odometry_reset_is_reported(tmp_path):
    folder = write_odometry(tmp_path / "run", pose=lambda k: (0.05 * (k if k < 150 else k - 150), 0.0, 0.0))
    one(inspect(folder, CONFIG), "/odom", "7.45 m", "7.5 s")


def test_nan_quaternion_and_covariance_are_reported(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(30):
            x = math.nan if k == 3 else 0.05 * k
            bag.odometry("/odom", START_NS + k * TICK_NS, (x, 0, 0), (1, 0))
            bag.truth("/truth", START_NS + k * TICK_NS, (0, 0, 0), (0, 0, 0, 0 if k == 4 else 1))
    info = inspect(tmp_path / "run", CONFIG)
    one(info, "/odom", "1 of 30", "NaN")
    one(info, "/odom", "covariance", "pose", "twist")
    one(info, "/truth", "1 of 30", "quaternion")


def write_images(folder: Path, info: bool, tf: bool, K: float = 500.0) -> Path:
    with BagWriter(folder) as bag:
        for k in range(10):
            stamp = START_NS + k * TICK_NS
            bag.odometry("/odom", stamp, (0.05 * k, 0, 0), (1, 0), covs=(np.eye(6), np.eye(6)))
            bag.compressed_image("/camera/image/compressed", stamp, b"" if k == 3 else b"\xff\xd8\xff")
            if info:
                bag.camera_info("/camera/camera_info", stamp, (640, 480), np.diag([K, K, K and 1]), [])
        if tf:
            bag.static_transform(START_NS, "base_link", "camera_optical", (0, 0, 0), (0, 0, 0, 1))
    return folder


def test_fault_36_missing_camera_info_is_reported(tmp_path):
    info = inspect(write_images(tmp_path / "run", info=False, tf=True), CONFIG)
    one(info, "camera.uncalibrated", "sensor_msgs/CameraInfo", "camera.file")
    one(info, "/camera/image/compressed", "1 of 10")


def test_fault_66_missing_camera_transform_is_reported(tmp_path):
    info = inspect(write_images(tmp_path / "run", info=True, tf=False), CONFIG)
    one(info, "frame.unmounted", "'base_link'", "'camera_optical'", "recording.sightings_pose")
    placed = Config.model_validate({"recording": {"sightings_pose": [0, 0, 0, 0, 0, 0]}})
    assert "frame.unmounted" not in [f.code for f in inspect(tmp_path / "run", placed).found]


def test_fault_37_zero_calibration_is_reported(tmp_path):
    info = inspect(write_images(tmp_path / "run", info=True, tf=True, K=0.0), CONFIG)
    one(info, "/camera/camera_info", "K ", "10 of 10", "camera.file")


def test_fault_39_each_of_several_cameras_is_held_against_its_own_calibration(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        stamp, m = bag.make("builtin_interfaces/msg/Time", sec=START_NS // 10**9, nanosec=0), bag.make
        bag.odometry("/odom", START_NS, (0, 0, 0), (1, 0), covs=(np.eye(6), np.eye(6)))
        for name, width, focal in (("front", 64, 50.0), ("rear", 32, 0.0)):
            header, pixels = m("std_msgs/msg/Header", stamp=stamp, frame_id=name), np.zeros(48 * width, np.uint8)
            shape = dict(height=48, width=width, encoding="mono8", is_bigendian=0, step=width)
            image = m("sensor_msgs/msg/Image", header=header, **shape, data=pixels)
            bag.write(f"/{name}/image_raw", "sensor_msgs/msg/Image", image, START_NS)
            K = np.diag([focal, focal, min(focal, 1.0)])
            bag.camera_info(f"/{name}/camera_info", START_NS, (64, 48), K, [0.0] * 5, frame_id=name)
            bag.static_transform(START_NS, "base_link", name, (0, 0, 0), (0, 0, 0, 1))
    cameras = {name: {"image": f"/{name}/image_raw"} for name in ("front", "rear")}
    info = inspect(tmp_path / "run", config_of({"cameras": cameras}))
    for code in ("camera.uncalibrated", "camera.resolution"):
        assert one(info, code).startswith("/rear/camera_info: ")


def test_truth_in_bursts_and_blackouts_are_reported(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(400):
            stamp = START_NS + k * TICK_NS
            bag.odometry("/odom", stamp, (0.05 * k, 0, 0), (1, 0), covs=(np.eye(6), np.eye(6)))
            if k % 20 < 10:
                bag.truth("/truth", stamp, (0.05 * k, 0, 0), (0, 0, 0, 1))
            bag.range_bearing("/seen", stamp, [(7, 2.0, 0.0)] if k < 200 else [])
    info = inspect(tmp_path / "run", CONFIG)
    one(info, "/truth", "0.2 s", "54%")
    one(info, "/seen", "10.0 s from 10.0 s")


def test_two_receivers_of_a_sensor_are_a_choice_not_unread(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(100):
            bag.odometry("/odom", START_NS + k * TICK_NS, (0.05 * k, 0, 0), (1, 0), covs=(np.eye(6), None))
            for place in ("front", "rear"):
                bag.satellite_fix(f"/{place}", START_NS + k * TICK_NS, (48.0, 11.0, 500.0), (1.0, 1.0, 4.0))
    info = inspect(tmp_path / "run", CONFIG)
    assert "recording.unused" not in [f.code for f in info.found]
    assert [note for note in info.notes if "recording.topics.gnss" in note and "/rear" in note]


@pytest.mark.parametrize("sightings", [True, False])
def test_a_laser_scan_is_offered_for_reflectors_only_where_nothing_else_sees_landmarks(tmp_path, sightings):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(20):
            stamp = START_NS + k * TICK_NS
            bag.odometry("/odom", stamp, (0.05 * k, 0, 0), (1, 0), covs=(np.eye(6), np.eye(6)))
            bag.laser_scan("/scan", stamp, np.ones(8), np.ones(8), (-1.0, 1.0))
            if sightings:
                bag.range_bearing("/seen", stamp, [(7, 2.0, 0.0)])
    offered = [line for line in inspect(tmp_path / "run", CONFIG).findings if "reflectors.min_intensity" in line]
    assert bool(offered) != sightings


def test_ambiguity_and_damage_do_not_stop_the_report(tmp_path):
    folder = write_drive(tmp_path / "run", n=50)
    config = Config.model_validate({"recording": {"topics": {"odometry": "/odm"}}})
    info = inspect(folder, config)
    [problem] = info.problems
    assert "/odm" in problem
    assert f"  - {problem}\n" in format_info(info)
    bag = write_ros1(tmp_path / "run.bag")
    bag.write_bytes(bag.read_bytes()[:30_000])
    assert any("salvaged" in note for note in inspect(bag, CONFIG).notes)
    with pytest.raises(RecordingError):
        inspect(tmp_path / "absent", CONFIG)


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (("pioneer_aruco", "duarte.bag"), ("/pioneer/pose", "1.202e+06 s")),
        (("pioneer_aruco", "pinto1.bag"), ("/mocap_node/Robot_1/ground_pose", "35%")),
        (("turtlebot3", "rosbag2_2025_11_25-15_11_34"), ("/camera/landmarks", "21.0 s")),
        (("turtlebot3", "rosbag2_2025_11_25-14_27_38"), ("/odom", "125.6", "72.2 s")),
        (("turtlebot3", "rosbag2_2025_11_06-17_25_46"), ("/imu, /joint_states, /odom", "217 ms")),
        (("marker_images", "ubiquity", "aruco_images.bag"), ("motion.unmeasured",)),
    ],
)
def test_real_recordings(parts, words):
    info = inspect(real_data(*parts), CONFIG)
    one(info, *words)
    assert len(format_info(info).splitlines()) > 8


@pytest.mark.parametrize(("origin", "beside"), [(None, False), ([48.0, 11.0, 500.0], False), (None, True)])
def test_a_run_says_that_positions_are_not_used_where_nothing_else_places_it(tmp_path, origin, beside):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(60):
            stamp = START_NS + k * TICK_NS
            bag.odometry("/odom", stamp, (0.05 * k, 0, 0), (1, 0), covs=(np.eye(6) * 1e-3, np.eye(6) * 1e-3))
            bag.satellite_fix("/fix", stamp, (48.0, 11.0 + 6.7e-7 * k, 500.0), (1.0, 1.0, 4.0))
            if beside:
                bag.range_bearing("/seen", stamp, [(7, 2.0, 0.0)])
    config = config_of({"estimator": {"initial_pose": [0, 0, 0]}} | ({"gnss": {"origin": origin}} if origin else {}))
    codes = [finding.code for finding in run(tmp_path / "run", None, config, "online").findings]
    assert ("positions.unused" in codes) == (origin is None and not beside)


def test_markers_in_a_form_that_is_not_read_are_named(tmp_path):
    quaternion = (0.0, 0.0, 0.0, 1.0)
    with BagWriter(tmp_path / "run") as bag:
        for k in range(50):
            stamp = START_NS + k * TICK_NS
            bag.odometry("/odom", stamp, (0.05 * k, 0.0, 0.0), (1.0, 0.0))
            bag.static_transform(stamp, "camera", "tag36h11:5", (0.0, 0.0, 2.0), quaternion, topic="/tf")
            bag.truth("/aruco_single/pose", stamp, (0.0, 0.0, 2.0), quaternion)
    text = one(inspect(tmp_path / "run", CONFIG), "place.unbounded")
    assert "tag36h11:5" in text
    assert "/aruco_single/pose" in text


def test_a_topic_that_may_be_an_odometry_is_named_where_nothing_else_measures_motion(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(50):
            bag.truth("/odom_pose", START_NS + k * TICK_NS, (0.05 * k, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            bag.range_bearing("/landmarks", START_NS + k * TICK_NS, [(1, 2.0, 0.1)])
    assert "recording.topics.odometry: /odom_pose" in one(inspect(tmp_path / "run", CONFIG), "motion.unmeasured")
