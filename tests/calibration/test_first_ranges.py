"""`fgloc init` on recordings of ranges: anchors by the map beside the bag, noise and bound of the ranges."""

import math

import numpy as np
import pytest
import yaml
from robot_world import points

from fgloc.calibration.first_settings import first_settings
from fgloc.config import Config, config_of_file
from fgloc.recording.info import inspect
from fgloc.runner import run
from fgloc.sensors.maps import write_map
from fgloc_datasets.bag import BagWriter

PLACES = {1: (-40.0, -30.0, 0.0), 2: (45.0, -35.0, 0.0), 3: (40.0, 50.0, 0.0), 4: (-35.0, 40.0, 0.0)}
RADIUS_M, RATE = 8.0, 0.125  # of the circle, and its yaw rate [rad/s]
START_NS, STEP_NS = 1_700_000_000_000_000_000, 50_000_000
NOISE_M = 0.4


def at(seconds):
    """True pose on a circle about (RADIUS_M, 0)."""
    yaw = RATE * seconds
    return RADIUS_M * math.sin(yaw), RADIUS_M * (1.0 - math.cos(yaw)), yaw


def write(folder, places=PLACES, sightings=False):
    """Bag of odometry in its own frame and ranges with noise; the map beside it."""
    rng = np.random.default_rng(3)
    with BagWriter(folder / "bag") as bag:
        for k in range(1200):
            stamp = START_NS + k * STEP_NS
            pose = at(k * STEP_NS * 1e-9)
            bag.odometry("/odom", stamp, pose, (RADIUS_M * RATE, RATE))
            if k % 4 == 0:
                number = sorted(PLACES)[k // 4 % 4]
                length = math.dist((*pose[:2], 0.0), PLACES[number]) + rng.normal(0.0, NOISE_M)
                bag.range_reading("/ranges", stamp, length, f"anchor_{number}")
            if sightings and k % 10 == 0:
                bag.range_bearing("/seen", stamp, [(1, 5.0, 0.1)])
    write_map(points(places), folder / "map.yaml")
    return folder / "bag"


def unbounded(folder):
    """Without settings `fgloc info` says that nothing places the robot."""
    [text] = [f.text for f in inspect(folder / "bag", Config()).found if f.code == "place.unbounded"]
    return text


def test_landmarks_of_a_map_that_only_ranges_can_see_are_their_anchors(tmp_path):
    made = first_settings(write(tmp_path))
    config = config_of_file(yaml.safe_load(made.text))
    assert config.uwb.anchors == PLACES
    assert config.uwb.sigma_m == pytest.approx(NOISE_M, rel=0.2)
    assert config.gate.max_range > 70.0
    assert unbounded(tmp_path) not in made.missing


def test_a_map_with_too_few_of_the_anchors_is_not_of_anchors(tmp_path):
    made = first_settings(write(tmp_path, {1: PLACES[1], 2: PLACES[2], 77: PLACES[3]}))
    assert config_of_file(yaml.safe_load(made.text)).uwb.anchors == {}
    assert [text for text in made.missing if "uwb.anchors" in text and "1, 2, 3, 4" in text]
    assert unbounded(tmp_path) in made.missing


def test_a_map_that_something_else_sees_is_not_of_anchors(tmp_path):
    made = first_settings(write(tmp_path, sightings=True))
    assert config_of_file(yaml.safe_load(made.text)).uwb.anchors == {}


@pytest.mark.slow
def test_the_first_pose_is_found_beside_the_map_that_only_ranges_can_see(tmp_path):
    bag = write(tmp_path)
    config = config_of_file(yaml.safe_load(first_settings(bag).text))
    result = run(bag, tmp_path / "map.yaml", config, "batch")
    end = np.array(at((result.trajectory.stamps_ns[-1] - START_NS) * 1e-9)[:2])
    assert np.linalg.norm(result.trajectory.poses[-1, :2] - end) < 0.5
