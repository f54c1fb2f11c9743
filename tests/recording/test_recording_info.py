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


def one(info: RecordingInfo, *words: str) -> str:
    found = [line for line in info.findings if all(word in line for word in words)]
    assert len(found) == 1, info.findings
    return found[0]


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
    line = one(info, "/odom", "go back")
    assert "1 time, by up to 4.95 s at 6.0 s" in line
    assert info.topics[0].jumps_back == 1


def test_fault_16_clock_jumps_ahead_is_reported(tmp_path):
    folder = write_odometry(tmp_path / "run", lambda k: START_NS + k * TICK_NS + (k >= 50) * 3600 * 10**9)
    info = inspect(folder, CONFIG)
    assert "1 time, by up to 3.6e+03 s at 2.5 s" in one(info, "/odom", "jump ahead")
    assert (info.topics[0].jumps_ahead, info.topics[0].jumps_back) == (1, 0)


def test_fault_17_stamp_zero_is_reported_with_its_topic(tmp_path):
    folder = write_odometry(tmp_path / "run", lambda k: 0 if k % 10 == 3 else START_NS + k * TICK_NS)
    info = inspect(folder, CONFIG)
    assert "/odom: 20 of 200 stamps are 0" in one(info, "stamps are 0")
    assert info.topics[0].jumps_back == 0


def test_fault_11_repeated_stamps_are_reported(tmp_path):
    info = inspect(write_odometry(tmp_path / "run", lambda k: START_NS + (k // 2) * 2 * TICK_NS), CONFIG)
    assert "100 stamps repeated" in one(info, "/odom", "repeated")


def test_stamps_of_another_clock_are_reported_with_the_remedy(tmp_path):
    folder = write_odometry(tmp_path / "run", lambda k: START_NS + k * TICK_NS - 1_000_000 * 10**9)
    assert "1e+06 s behind the receive times; recording.received_stamps: [odometry]" in one(
        inspect(folder, CONFIG), "header stamps"
    )
    cured = Config.model_validate({"recording": {"received_stamps": ["odometry"]}})
    assert not [line for line in inspect(folder, cured).findings if "header stamps" in line]


def test_early_and_drifting_clocks_are_reported(tmp_path):
    early = inspect(write_odometry(tmp_path / "early", lambda k: START_NS + k * TICK_NS + 200_000_000), CONFIG)
    assert "199 ms ahead of the receive times" in one(early, "clock")
    drift = inspect(write_odometry(tmp_path / "drift", lambda k: START_NS + int(k * TICK_NS * 0.98)), CONFIG)
    assert "+0.180 s" in one(drift, "drifts")


def test_fault_21_gaps_are_reported_with_their_place(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in [*range(100), *range(1300, 1400)]:
            bag.odometry("/odom", START_NS + k * TICK_NS, (0.05 * k, 0, 0), (1, 0), covs=(np.eye(6), None))
    info = inspect(tmp_path / "run", CONFIG)
    assert "1 gap of more than 1 s, the longest of 60.1 s from 5.0 s on" in one(info, "/odom", "gap")
    assert not [line for line in info.findings if "jumps" in line]  # 60 m in 60 s is a drive
    assert info.topics[0].longest_gap_at_s == pytest.approx(4.95)


def test_fault_10_spikes_are_reported(tmp_path):
    folder = write_odometry(tmp_path / "run", twist=lambda k: (1.0, -125.0 if k in (60, 61) else 0.0))
    assert "2 of 200 have a yaw rate beyond 10 rad/s (up to 125, at 3.0 s)" in one(inspect(folder, CONFIG), "yaw rate")


def test_fault_28_twist_always_zero_is_reported(tmp_path):
    folder = write_odometry(tmp_path / "run", twist=lambda k: (0.0, 0.0))
    line = one(inspect(folder, CONFIG), "twist is always zero")
    assert "moves 9.9 m" in line or "moves 10.0 m" in line


def test_fault_32_degrees_for_radians_are_reported(tmp_path):
    folder = write_odometry(
        tmp_path / "run", twist=lambda k: (0.0, math.degrees(0.15)), pose=lambda k: (0.0, 0.0, 0.15 * k * 0.05)
    )
    assert "degrees for radians?" in one(inspect(folder, CONFIG), "adds up to")


def test_fault_26_odometry_reset_is_reported(tmp_path):
    folder = write_odometry(tmp_path / "run", pose=lambda k: (0.05 * (k if k < 150 else k - 150), 0.0, 0.0))
    assert "jumps once, by up to 7.45 m at 7.5 s" in one(inspect(folder, CONFIG), "jumps")


def test_nan_quaternion_and_covariance_are_reported(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(30):
            x = math.nan if k == 3 else 0.05 * k
            bag.odometry("/odom", START_NS + k * TICK_NS, (x, 0, 0), (1, 0))
            bag.truth("/truth", START_NS + k * TICK_NS, (0, 0, 0), (0, 0, 0, 0 if k == 4 else 1))
    info = inspect(tmp_path / "run", CONFIG)
    assert "1 of 30 hold NaN" in one(info, "/odom", "NaN")
    assert "covariance of pose and twist is all zero" in one(info, "/odom", "covariance")
    assert "/truth: 1 of 30 have a quaternion" in one(info, "quaternion")


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
    assert "camera.file" in one(info, "No sensor_msgs/CameraInfo")
    assert "1 of 10 images are empty" in one(info, "empty")


def test_fault_66_missing_camera_transform_is_reported(tmp_path):
    info = inspect(write_images(tmp_path / "run", info=True, tf=False), CONFIG)
    assert "recording.sightings_pose" in one(info, "No transform from 'base_link' to 'camera_optical'")
    placed = Config.model_validate({"recording": {"sightings_pose": [0, 0, 0, 0, 0, 0]}})
    assert not [line for line in inspect(tmp_path / "run", placed).findings if "No transform" in line]


def test_fault_37_zero_calibration_is_reported(tmp_path):
    info = inspect(write_images(tmp_path / "run", info=True, tf=True, K=0.0), CONFIG)
    assert "K is all zero in 10 of 10" in one(info, "/camera/camera_info")


def test_truth_in_bursts_and_blackouts_are_reported(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(400):
            stamp = START_NS + k * TICK_NS
            bag.odometry("/odom", stamp, (0.05 * k, 0, 0), (1, 0), covs=(np.eye(6), np.eye(6)))
            if k % 20 < 10:
                bag.truth("/truth", stamp, (0.05 * k, 0, 0), (0, 0, 0, 1))
            bag.range_bearing("/seen", stamp, [(7, 2.0, 0.0)] if k < 200 else [])
    info = inspect(tmp_path / "run", CONFIG)
    assert "bursts" in one(info, "/truth")
    assert "once, the longest 10.0 s from 10.0 s on" in one(info, "/seen")


def test_two_receivers_of_a_sensor_are_a_choice_not_unread(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(100):
            bag.odometry("/odom", START_NS + k * TICK_NS, (0.05 * k, 0, 0), (1, 0), covs=(np.eye(6), None))
            for place in ("front", "rear"):
                bag.satellite_fix(f"/{place}", START_NS + k * TICK_NS, (48.0, 11.0, 500.0), (1.0, 1.0, 4.0))
    info = inspect(tmp_path / "run", CONFIG)
    assert not [line for line in info.findings if "/front" in line and "not used" in line]
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
    assert "/odm is not in the recording" in info.problems[0]
    assert "To be settled before a run:" in format_info(info)
    bag = write_ros1(tmp_path / "run.bag")
    bag.write_bytes(bag.read_bytes()[:30_000])
    assert any("salvaged" in note for note in inspect(bag, CONFIG).notes)
    with pytest.raises(RecordingError):
        inspect(tmp_path / "absent", CONFIG)


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (("pioneer_aruco", "duarte.bag"), ("/pioneer/pose", "1.202e+06 s behind")),
        (("pioneer_aruco", "pinto1.bag"), ("truth arrives in bursts",)),
        (("turtlebot3", "rosbag2_2025_11_25-15_11_34"), ("no sighting", "21.0 s")),
        (("turtlebot3", "rosbag2_2025_11_25-14_27_38"), ("yaw rate beyond", "125.6")),
        (("turtlebot3", "rosbag2_2025_11_06-17_25_46"), ("/imu, /joint_states, /odom", "217 ms ahead")),
        (("marker_images", "ubiquity", "aruco_images.bag"), ("nothing measures how the robot moves",)),
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
