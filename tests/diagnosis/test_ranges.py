"""Ranges to known anchors against the wheels: sign and size of the turn, scale and offset of ranges."""

import math

import numpy as np
import pytest
import yaml
from robot_world import points

from fgloc import se2
from fgloc.calibration.first_settings import first_settings
from fgloc.config import config_of, config_of_file
from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.mistakes import find_mistakes
from fgloc.diagnosis.ranges import check_ranges, fit_ranges
from fgloc.diagnosis.signals import Path, Signals
from fgloc.sensors.maps import write_map
from fgloc_datasets.bag import BagWriter

PLACES = {1: (-1.0, -1.0, 0.0), 2: (5.0, -1.2, 0.0), 3: (5.2, 4.0, 0.0), 4: (-1.1, 4.2, 0.0)}
START_NS, STEP_NS, STEPS = 1_700_000_000_000_000_000, 50_000_000, 1200
SPEED, NOISE_M = 0.4, 0.05


def write(folder, turn=1.0, way=1.0, scale=1.0, bias_m=0.0, straight=False, mirrored=False, gyro=False):
    """A minute in a room: bag with an odometry that reports so much turn and way, and ranges; the map beside it."""
    rng = np.random.default_rng(5)
    dt = STEP_NS * 1e-9
    pose, reported = np.array([1.0, 1.0, 0.2]), np.zeros(3)
    with BagWriter(folder / "bag") as bag:
        for k in range(STEPS):
            stamp = START_NS + k * STEP_NS
            omega = 0.0 if straight else 0.9 * math.sin(0.35 * k * dt) + 0.35
            v = 0.05 * SPEED if straight else SPEED
            bag.odometry("/odom", stamp, tuple(reported), (way * v, turn * omega))
            if gyro:
                bag.imu("/imu", stamp, (0.0, 0.0, omega), (0.0, 0.0, 9.81))
            if k % 2 == 0:
                number = 1 + k // 2 % 4
                length = math.dist((*pose[:2], 0.0), PLACES[number])
                bag.range_reading(
                    "/ranges", stamp, scale * length + bias_m + rng.normal(0.0, NOISE_M), f"anchor_{number}"
                )
            pose = se2.compose(pose, se2.exp((v * dt, 0.0, omega * dt)))
            reported = se2.compose(reported, se2.exp((way * v * dt, 0.0, turn * omega * dt)))
    side = -1.0 if mirrored else 1.0
    write_map(points({i: (x, side * y, z) for i, (x, y, z) in PLACES.items()}), folder / "map.yaml")
    return folder / "bag"


def first(bag):
    """Codes of what `init` finds, and the settings that it writes."""
    made = first_settings(bag)
    return {finding.code for finding in made.found}, config_of_file(yaml.safe_load(made.text))


def ranged(turn, seconds, noise_m):
    """Path by wheels that report so much less turn than there is, and rows of ranges to the anchors."""
    t, rng = np.arange(0.0, seconds, 0.05), np.random.default_rng(4)
    omega = 0.9 * np.sin(0.6 * t) + 0.35
    poses, by_wheels = [np.array([1.0, 1.0, 0.2])], [np.zeros(3)]
    for w in omega[:-1]:
        poses.append(se2.compose(poses[-1], se2.exp(0.05 * np.array([SPEED, 0.0, w]))))
        x, y, _ = se2.compose((*by_wheels[-1][:2], se2.wrap(by_wheels[-1][2])), se2.exp((0.02, 0.0, 0.05 * w / turn)))
        by_wheels.append(np.array([x, y, by_wheels[-1][2] + 0.05 * w / turn]))
    rows = [
        (s, 1 + k % 4, math.dist((*p[:2], 0.0), PLACES[1 + k % 4]))
        for k, (s, p) in enumerate(zip(t, poses, strict=True))
    ]
    rows = [(s, i, r + rng.normal(0.0, noise_m)) for s, i, r in rows[::5]]
    return Path(t, np.array(by_wheels), np.zeros(len(t), dtype=np.int64), "odometry"), rows


@pytest.mark.parametrize("turn", [2.0, 1.0])
def test_the_turn_of_a_robot_over_its_wheels_is_found_by_ranges(turn):
    path, rows = ranged(turn, 22.0, NOISE_M)
    anchors = {i: np.array(place) for i, place in PLACES.items()}
    fit = fit_ranges(path, rows, anchors, np.zeros(3), NOISE_M)
    assert fit.turn.value == pytest.approx(turn, rel=0.05)
    assert fit.misfit < 2.0 * NOISE_M


@pytest.mark.parametrize(("turn", "is_named"), [(1.3, False), (1.7, True)])
def test_a_turn_by_the_wheels_that_explains_ranges_nearly_as_well_is_not_refuted(turn, is_named):
    path, rows = ranged(turn, 22.0, NOISE_M)
    found = Conventions(config_of({"uwb": {"anchors": PLACES, "sigma_m": 10.0 * NOISE_M}}), Signals(ranges=rows))
    check_ranges(found, path)
    assert found.codes == ({"wheels.turn"} if is_named else set())


@pytest.mark.parametrize(
    ("wrong", "code", "factor"),
    [
        ({"turn": -1.0}, "wheels.sign", -1.0),
        pytest.param({"turn": -2.0}, "wheels.sign", -0.5, marks=pytest.mark.slow),
        ({"turn": 0.5}, "wheels.turn", 2.0),
    ],
)
def test_wheels_that_turn_otherwise_than_ranges_show_are_named_and_corrected(tmp_path, wrong, code, factor):
    codes, config = first(write(tmp_path, **wrong))
    assert code in codes
    assert config.wheels.scale_omega == pytest.approx(factor, rel=0.05)


def test_a_mirrored_map_of_anchors_is_named_where_a_gyro_tells_left_from_right(tmp_path):
    codes, _ = first(write(tmp_path / "without", mirrored=True))
    assert codes == {"wheels.sign"}
    codes, config = first(write(tmp_path / "with", mirrored=True, gyro=True))
    assert codes == {"uwb.mirrored"}
    assert config.uwb.anchors == PLACES
    assert config.wheels.scale_omega == 1.0


def test_ranges_that_are_too_long_are_named_and_corrected(tmp_path):
    codes, config = first(write(tmp_path, scale=1.07))
    assert codes == {"uwb.scale"}
    assert config.uwb.scale == pytest.approx(1.07, abs=0.02)


def test_an_offset_of_all_ranges_is_named_and_corrected(tmp_path):
    codes, config = first(write(tmp_path, bias_m=0.25))
    assert codes & {"uwb.bias_m", "uwb.scale"}
    middle = 3.0  # m: where the ranges are
    assert (config.uwb.scale - 1.0) * middle + config.uwb.bias_m == pytest.approx(0.25, abs=0.08)


@pytest.mark.parametrize("drive", [{}, {"straight": True}, {"turn": 1.05}, {"way": 1.03}])
def test_nothing_is_said_of_a_sound_recording_or_of_one_that_tells_nothing(tmp_path, drive):
    codes, config = first(write(tmp_path, **drive))
    assert not {code for code in codes if code.startswith(("wheels.", "uwb."))}
    assert (config.wheels.scale_omega, config.uwb.scale, config.uwb.bias_m) == (1.0, 1.0, 0.0)


def test_a_run_without_init_names_it_first_and_is_made_without_it(tmp_path):
    bag = write(tmp_path, turn=-1.0)
    config = config_of({"uwb": {"anchors": PLACES}})
    found = find_mistakes(bag, None, config)
    assert found.findings[0].code == "wheels.sign"
    assert found.grave
    assert found.config.wheels.scale_omega == pytest.approx(-1.0, rel=0.05)
