"""`fgloc init` on a short recording of odometry and a laser scanner: sections and priors that fit what is there."""

import math

import numpy as np
import pytest
import yaml
from robot_world import points

from fgloc.calibration.first_settings import first_settings
from fgloc.config import Config, config_of_file
from fgloc.recording.info import inspect
from fgloc.sensors.maps import write_map
from fgloc.types import Landmark, LandmarkMap
from fgloc_datasets.bag import BagWriter

START_NS, BEAMS, DARK, BRIGHT = 1_700_000_000_000_000_000, 360, 100.0, 900.0


def settings(folder, has_map=True, sign=1.0, dark_scans=0, sees=False):
    """Recording of a robot that winds along for 6 s among reflectors; sooner or later its scans show them."""
    rng, scans = np.random.default_rng(2), 0
    with BagWriter(folder / "bag") as bag:
        bag.static_transform(START_NS, "base_link", "laser", (0.2, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0))
        for k in range(120):
            stamp, yaw = START_NS + k * 50_000_000, 0.3 * math.sin(0.05 * k)
            bag.odometry("/odom", stamp, (0.02 * k, 0.0, yaw), (0.4, sign * 0.3 * math.cos(0.05 * k)))
            if sees:
                bag.range_bearing("/landmarks", stamp, [(1, 3.0, 0.5)])
            for _ in range(1 + dark_scans // 25 if k % 4 == 0 else 0):
                intensities = rng.uniform(0.5 * DARK, DARK, BEAMS)
                if scans >= dark_scans:
                    intensities[[40, 100, 200, 270]] = BRIGHT
                bag.laser_scan("/scan", stamp + scans, np.full(BEAMS, 4.0), intensities, (-math.pi, math.pi))
                scans += 1
    if has_map:
        write_map(points([(i, 3.0) for i in range(4)]), folder / "map.yaml")
    return config_of_file(yaml.safe_load(first_settings(folder / "bag").text) or {})


def test_scans_that_only_a_setting_asks_for_are_looked_at(tmp_path):
    assert DARK < settings(tmp_path).reflectors.min_intensity < BRIGHT


def test_of_many_scans_that_only_a_setting_asks_for_the_first_are_looked_at(tmp_path):
    assert settings(tmp_path, dark_scans=500).reflectors.min_intensity is None


@pytest.mark.parametrize("has_map", [True, False])
def test_a_sensor_that_nobody_calibrated_has_wider_priors_where_a_map_can_tell_its_constants(tmp_path, has_map):
    made, usual = settings(tmp_path, has_map, sees=True).landmarks, Config().landmarks
    assert made.repeat_s > 0.0
    for name in ("range_scale_sigma", "bearing_bias_sigma_rad", "position_sigma_m", "time_offset_sigma_s"):
        assert (getattr(made, name) > getattr(usual, name)) == has_map


@pytest.mark.parametrize("has_map", [True, False])
def test_an_odometry_that_nobody_calibrated_has_wider_priors_where_a_map_can_tell_its_constants(tmp_path, has_map):
    wheels, usual = settings(tmp_path, has_map).wheels, Config().wheels
    assert (wheels.scale_sigma > usual.scale_sigma) == has_map
    assert (wheels.turn_scale_sigma > usual.turn_scale_sigma) == has_map


@pytest.mark.parametrize(("sign", "source"), [(1.0, Config().wheels.source), (-1.0, "pose")])
def test_a_yaw_rate_with_the_wrong_sign_is_not_used(tmp_path, sign, source):
    assert settings(tmp_path, sign=sign).wheels.source == source


def with_positions(folder, topics, without_fix=5):
    """Odometry beside positions of receivers, whose first messages are all zero."""
    with BagWriter(folder / "bag") as bag:
        for k in range(100):
            stamp = START_NS + k * 50_000_000
            bag.odometry("/odom", stamp, (0.02 * k, 0.0, 0.0), (0.4, 0.0))
            for topic in topics:
                place = (0.0, 0.0, 0.0) if k < without_fix else (45.5 + 2e-7 * k, 9.25, 229.0)
                bag.satellite_fix(topic, stamp, place, (0.04, 0.04, 0.09))
    return folder / "bag"


@pytest.mark.parametrize("topics", [["/gps"], ["/front/gps", "/rear/gps"]])
def test_positions_are_found_with_a_value_of_the_origin_to_be_pasted(tmp_path, topics):
    bag = with_positions(tmp_path, topics)
    text = first_settings(bag).text
    (line,) = [line for line in text.splitlines() if "origin:" in line]
    made = config_of_file(yaml.safe_load(text.replace(line, line.replace("# origin", "origin"))))
    assert made.gnss.origin == pytest.approx((45.5, 9.25, 229.0), abs=1e-4)
    found = inspect(bag, made)
    assert found.roles["gnss"] == topics[0]
    assert not found.problems


def test_positions_without_a_fix_are_named_and_not_used(tmp_path):
    bag = with_positions(tmp_path, ["/fix"], without_fix=7)
    sound, origin = inspect(with_positions(tmp_path / "sound", ["/fix"], 0), Config()), "gnss.origin: [45.5"
    named, usual = ([text for text in info.findings if "/fix" in text] for info in (inspect(bag, Config()), sound))
    assert len(named) == len(usual) + 1
    assert any("7 of 100" in text for text in named)
    assert any(origin in text for text in named)


def test_poses_of_markers_on_two_topics_are_of_two_cameras(tmp_path):
    facing = (0.5, -0.5, -0.5, 0.5)
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(60):
            stamp = START_NS + k * 50_000_000
            bag.odometry("/odom", stamp, (0.02 * k, 0.0, 0.0), (0.4, 0.0))
            for i, side in enumerate(("front", "rear")):
                bag.marker_poses(f"/{side}/markers", stamp + i, [(i, (0.0, 0.0, 3.0), facing, None)], frame_id=side)
    write_map(LandmarkMap({0: Landmark(0, np.array([4.0, 0.0, 0.5]), np.eye(3), 0.2)}), tmp_path / "map.yaml")
    config = config_of_file(yaml.safe_load(first_settings(tmp_path / "bag").text))
    assert {name: camera.sightings for name, camera in config.cameras.items()} == {
        "front": "/front/markers",
        "rear": "/rear/markers",
    }
    assert config.landmarks.repeat_s > 0.0
    assert config.landmarks.position_sigma_m > Config().landmarks.position_sigma_m


def test_commands_with_a_steering_angle_lack_the_wheelbase_alone(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(200):
            bag.ackermann("/ackermann_cmd", 1_000_000_000 + 50_000_000 * k, 1.0, 0.3 * math.sin(0.05 * k))
    settings = first_settings(tmp_path / "bag")
    (lacking,) = [text for text in settings.missing if "wheelbase" in text]
    assert "steering angle" in lacking
    lines = settings.text.splitlines()
    first = lines.index("# wheels:")
    filled = "\n".join(line.removeprefix("# ") for line in lines[first : first + 5]).replace(
        "wheelbase:", "wheelbase: 2.8"
    )
    wheels = Config.model_validate(yaml.safe_load(filled)).wheels
    assert (wheels.source, wheels.drive.wheelbase) == ("command", 2.8)
