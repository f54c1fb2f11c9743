"""Noise of the wheels, found from sightings of a map and written by `init`."""

import math

import numpy as np
import pytest
import yaml
from robot_world import points

from fgloc import se2
from fgloc.calibration.first_settings import first_settings
from fgloc.config import Config, config_of_file
from fgloc.evaluation.metrics import compute_metrics
from fgloc.motion_noise import identify_motion_noise, with_motion_noise
from fgloc.runner import run
from fgloc.sensors.maps import write_map
from fgloc_datasets.bag import BagWriter

START_NS, STEPS, STEP_S = 1_700_000_000 * 10**9, 900, 0.1
_AROUND = np.linspace(0.0, math.tau, 9)[:-1]
BEACONS = np.column_stack([4.0 * np.cos(_AROUND) + 0.3 * _AROUND, 3.5 * np.sin(_AROUND)])


def record(folder, of_way: float, of_yaw: float, seed: int = 3, long: float = 1.0):
    """A bag of an odometry whose noise is so many times the default, sightings and truth; and the map beside it.

    Ranges are ``long`` times the true ones.
    """
    rng, noise = np.random.default_rng(seed), Config().wheels.noise
    true, said = np.array([1.5, 0.0, 0.5 * math.pi]), np.zeros(3)
    with BagWriter(folder / "bag") as bag:
        for k in range(STEPS):
            stamp = START_NS + k * int(STEP_S * 1e9)
            bag.odometry("/odom", stamp, tuple(said), (0.0, 0.0, 0.0), stamp)
            away = BEACONS - true[:2]
            bearings = np.arctan2(away[:, 1], away[:, 0]) - true[2] + rng.normal(0.0, 0.02, len(away))
            ranges = long * np.hypot(*away.T) + rng.normal(0.0, 0.1, len(away))
            seen = enumerate(zip(ranges.tolist(), se2.wrap_array(bearings).tolist(), strict=True))
            near = [(i, r, b) for i, (r, b) in seen if abs(b) < 1.0]
            if k % 5 == 0:
                bag.range_bearing("/landmarks", stamp, near, stamp)
            bag.planar_truth("/truth", stamp, true)
            step = (
                np.array([0.3 + 0.1 * math.sin(0.5 * STEP_S * k), 0.0, 0.2 + 0.2 * math.sin(0.3 * STEP_S * k)]) * STEP_S
            )
            way, turn = float(step[0]), abs(float(step[2]))
            sigma_x = of_way * math.sqrt(noise.x_per_sqrt_m**2 * way + noise.xy_per_sqrt_rad**2 * turn)
            sigma_y = of_way * math.sqrt(noise.y_per_sqrt_m**2 * way + noise.xy_per_sqrt_rad**2 * turn)
            sigma_yaw = of_yaw * math.sqrt(noise.yaw_per_sqrt_m**2 * way + noise.yaw_per_sqrt_rad**2 * turn)
            true = se2.compose(true, se2.exp(step))
            said = se2.compose(said, se2.exp(step + rng.normal(0.0, [sigma_x, sigma_y, sigma_yaw])))
    write_map(points(BEACONS), folder / "map.yaml")
    return folder / "bag"


def factors(bag, with_map: bool):
    found = identify_motion_noise(bag, bag.parent / "map.yaml" if with_map else None, Config())
    if found is None:
        return 1.0, 1.0
    written, default = yaml.safe_load(found.lines["expert.wheels.noise"]), Config().wheels.noise
    return written["x_per_sqrt_m"] / default.x_per_sqrt_m, written["yaw_per_sqrt_rad"] / default.yaw_per_sqrt_rad


@pytest.mark.parametrize("with_map", [pytest.param(True, marks=pytest.mark.slow), False])
@pytest.mark.parametrize("made", [(1.0, 1.0), (3.0, 2.0)])
def test_the_noise_is_found(tmp_path, made, with_map):
    found = factors(record(tmp_path, *made), with_map)
    assert found == pytest.approx(made, rel=0.4)


@pytest.mark.parametrize("long", [0.92, 1.08])
def test_ranges_that_are_all_too_long_are_no_noise_of_the_wheels_without_a_map(tmp_path, long):
    """The wheels alone say how large everything is then."""
    of_way, of_yaw = factors(record(tmp_path, 1.0, 1.0, long=long), with_map=False)
    assert of_way < 1.3
    assert of_yaw < 1.3


def test_noise_that_is_smaller_is_written_in_part(tmp_path):
    of_way, of_yaw = factors(record(tmp_path, 0.2, 0.2), with_map=True)
    assert 0.4 < of_way < 1.0
    assert 0.4 < of_yaw < 0.8


@pytest.mark.slow
def test_init_writes_it_and_the_covariance_is_right_with_it(tmp_path):
    bag = record(tmp_path, 3.0, 2.0, seed=1)
    first = first_settings(bag)
    made = with_motion_noise(first, bag)
    assert [f.code for f in made.found if f not in first.found] == ["wheels.noise"]

    def nees(text: str) -> float:
        result = run(bag, bag.parent / "map.yaml", config_of_file(yaml.safe_load(text)), "batch")
        return compute_metrics(result, result.config).nees_over_3

    assert nees(made.text) < 1.6 < nees(first.text)


@pytest.mark.parametrize(("made", "seed"), [(1.0, 2), (3.0, 0), (3.0, 4)])
def test_noise_of_the_wheels_is_no_lag_and_no_mounting(tmp_path, made, seed):
    bag = record(tmp_path, made, made, seed)
    assert not [f.code for f in first_settings(bag).found]


def test_wheels_whose_geometry_is_unknown_have_no_noise(tmp_path):
    places = [(3.0, 3.0), (3.0, -2.0), (-2.0, 3.0), (-2.0, -2.0)]
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(400):
            stamp, yaw = 1_700_000_000_000_000_000 + k * 50_000_000, 0.02 * k
            x, y = math.sin(yaw), 1.0 - math.cos(yaw)
            bag.joints("/joint_states", stamp, ["left_wheel", "right_wheel"], [0.3 * k, 0.5 * k])
            seen = [(i, math.hypot(a - x, b - y), math.atan2(b - y, a - x) - yaw) for i, (a, b) in enumerate(places)]
            bag.range_bearing("/landmarks", stamp, [(i, d, math.remainder(b, math.tau)) for i, d, b in seen])
    write_map(points(places), tmp_path / "map.yaml")
    assert identify_motion_noise(tmp_path / "bag", tmp_path / "map.yaml", Config()) is None
