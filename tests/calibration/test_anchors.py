"""Surveys of radio anchors: places from ranges and motion, what is left out and why, and the commands of a user."""

import math

import numpy as np
import pytest
import yaml
from command_line import fgloc

from fgloc import se2
from fgloc.calibration.anchors import survey_anchors
from fgloc.config import config_of, config_of_file, load_config
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.errors import ConfigError, RecordingError
from fgloc.runner import run
from fgloc.sensors.maps import load_map
from fgloc_datasets.bag import BagWriter

PLACES = {1: (-6.0, -5.0, 0.0), 2: (9.0, -4.0, 0.0), 3: (8.0, 9.0, 0.0), 4: (-5.0, 8.0, 0.0)}
START_NS, STEP_NS = 1_700_000_000_000_000_000, 200_000_000
BEGINS_AT_ORIGIN = {"estimator": {"initial_pose": [0.0, 0.0, 0.0]}}  # nothing is searched for
TRUTH_FRAME = np.array([20.0, -7.0, 2.0])
STEPS, NOISE_M, SPEED = 240, 0.1, 0.5


def eight(seconds):
    """Yaw rate [rad/s] of a drive along a figure of eight."""
    return 0.4 if seconds % 32.0 < 16.0 else -0.4


def straight(seconds):
    """Yaw rate of a straight drive."""
    return 0.0


def write(folder, rate=eight, wrong=0.0, seldom=(), places=PLACES, steps=STEPS, unit_m=1.0):
    """Bag of odometry that begins at the origin, ranges in turn, and a truth in a frame of its own.

    Returns:
        The bag, and the true poses ``(n, 3)``.
    """
    rng = np.random.default_rng(5)
    pose, poses = np.zeros(3), []
    with BagWriter(folder / "bag") as bag:
        for k in range(steps):
            stamp, omega = START_NS + k * STEP_NS, rate(k * STEP_NS * 1e-9)
            bag.odometry("/odom", stamp, tuple(pose), (SPEED, omega))
            number = sorted(places)[k % len(places)]
            if number not in seldom or k < 40:
                length = math.dist((*pose[:2], 0.0), places[number]) + rng.normal(0.0, NOISE_M)
                length += rng.uniform(1.0, 5.0) if rng.random() < wrong else 0.0
                bag.range_reading("/ranges", stamp, length / unit_m, f"anchor_{number}")
            bag.planar_truth("/truth", stamp, se2.compose(TRUTH_FRAME, pose))
            poses.append(pose)
            turn = omega * STEP_NS * 1e-9
            way = SPEED * STEP_NS * 1e-9
            pose = se2.compose(pose, se2.exp(np.array([way, 0.0, turn])))
    return folder / "bag", np.array(poses)


def off(landmarks):
    """Difference ``(n, 2)`` [m] of the anchors from the truth, moved and turned onto it."""
    found = np.array([m.position[:2] for m in landmarks.values()])
    true = np.array([PLACES[i][:2] for i in landmarks])
    motion = se2.rigid(found, true)
    return np.array([se2.compose(motion, np.array([*place, 0.0]))[:2] for place in found]) - true


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_anchors_are_found_though_every_fifth_range_is_too_long_by_metres(tmp_path, wrong):
    bag, _ = write(tmp_path, wrong=wrong)
    found = survey_anchors(bag, config_of({}))
    assert not found.left_out
    landmarks = found.landmarks.landmarks
    for (i, m), miss in zip(landmarks.items(), off(landmarks), strict=True):
        assert math.hypot(*miss) < 0.25
        assert math.dist(m.position[:2], PLACES[i][:2]) < 0.5  # the first pose is the origin
        assert miss @ np.linalg.solve(m.cov[:2, :2], miss) < 12.0
        assert found.ranges[i] < STEPS / 4 * (1.0 - 0.8 * wrong) + 1


def test_a_straight_drive_leaves_anchors_out_as_their_mirror_images_fit_too(tmp_path):
    bag, _ = write(tmp_path, straight)
    with pytest.raises(RecordingError, match=r"anchor 1: two places explain its ranges alike.*mirror.*Drive a curve"):
        survey_anchors(bag, config_of({}))


def test_an_anchor_on_the_line_of_a_straight_drive_may_be_on_either_side_of_it(tmp_path):
    """Its ranges do not change with a small way aside: that sigma is infinite, but for rounding."""
    bag, _ = write(tmp_path, straight, places={1: (-3.0, 0.0, 0.0)}, steps=60)
    with pytest.raises(RecordingError, match=r"anchor 1: known to \d{3,}\.\d m only"):
        survey_anchors(bag, config_of({}))


def test_an_anchor_that_is_heard_too_seldom_is_left_out(tmp_path):
    bag, _ = write(tmp_path, seldom={4})
    found = survey_anchors(bag, config_of({}))
    assert sorted(found.landmarks.landmarks) == [1, 2, 3]
    assert found.left_out == {4: "10 ranges, needed are 20"}


def test_ranges_in_millimetres_are_named_though_two_anchors_share_a_place(tmp_path):
    places = PLACES | {4: PLACES[1]}
    bag, _ = write(tmp_path, places=places, unit_m=0.001)
    (found,) = [
        f for f in inspect_all(bag, None, config_of({"uwb": {"anchors": places}})).found if f.code == "uwb.unit"
    ]
    assert found.lines == {"uwb.unit_m": "0.001"}


def test_anchors_are_above_the_tag(tmp_path):
    """Ranges on a floor tell the difference of heights and not its sign."""
    bag, _ = write(tmp_path, places={i: (x, y, 2.5) for i, (x, y, _) in PLACES.items()})
    found = survey_anchors(bag, config_of({"uwb": {"tag": (0.0, 0.0, 1.0)}})).landmarks.landmarks
    heights = [m.position[2] for m in found.values()]
    assert min(heights) > 0.99  # of those beyond 10 m nothing tells it
    assert max(heights) > 2.5


def test_given_anchors_make_the_frame_and_stay(tmp_path):
    """The map is turned by a quarter, and moved, against the first pose."""
    bag, _ = write(tmp_path)
    given = {i: (3.0 - y, 1.0 + x, z) for i, (x, y, z) in PLACES.items()}
    found = survey_anchors(bag, config_of({"uwb": {"anchors": {i: given[i] for i in (1, 2, 3)}}}))
    assert list(found.ranges) == [4]
    assert math.dist(found.landmarks.landmarks[4].position[:2], given[4][:2]) < 0.15
    np.testing.assert_array_equal(found.landmarks.landmarks[2].position, given[2])
    assert found.landmarks.landmarks[2].cov is None


def test_what_cannot_be_surveyed_is_named(tmp_path):
    bag, _ = write(tmp_path)
    with pytest.raises(RecordingError, match="nothing to survey; heard are 1, 2, 3, 4"):
        survey_anchors(bag, config_of({"uwb": {"anchors": PLACES}} | BEGINS_AT_ORIGIN))
    with pytest.raises(ConfigError, match="at least 3"):
        survey_anchors(bag, config_of({"uwb": {"anchors": {1: PLACES[1]}}}))
    with pytest.raises(ConfigError, match="ground: uneven"):
        survey_anchors(bag, config_of({"estimator": {"ground": "uneven"}}))


@pytest.mark.slow
def test_map_init_and_smooth_as_a_user_runs_them(tmp_path):
    bag, poses = write(tmp_path)
    code, said, _ = fgloc("init", bag)
    assert code == 0
    assert "fgloc map" in said
    code, said, _ = fgloc("map", bag, "--out", tmp_path / "map.yaml")
    assert code == 0
    landmarks = load_map(tmp_path / "map.yaml").landmarks
    shown = config_of_file(yaml.safe_load(said.partition("for robot.yaml:\n")[2].partition("next:")[0])).uwb
    code, _, _ = fgloc("init", bag, "--force")
    assert code == 0
    written = load_config(tmp_path / "robot.yaml").uwb
    assert written.anchors == shown.anchors
    assert written.anchors_sigma_m == shown.anchors_sigma_m
    for i, m in landmarks.items():
        np.testing.assert_allclose(written.anchors[i], m.position, atol=1e-4)
        np.testing.assert_allclose(written.anchors_sigma_m[i], np.sqrt(np.diag(m.cov)), rtol=0.1)
    code, said, warned = fgloc("smooth", bag, "--out", tmp_path / "result")
    assert code == 0
    assert "set truth.align: se2" in said + warned
    end = np.loadtxt(tmp_path / "result" / "trajectory.tum")[-1, 1:3]
    assert math.dist(end, poses[-1, :2]) < 0.3


def test_places_that_are_not_known_exactly_are_estimated(tmp_path):
    bag, _ = write(tmp_path)
    moved = PLACES | {3: (8.4, 8.7, 0.0)}
    section = {"anchors": moved, "anchors_sigma_m": {3: [0.5, 0.5, 0.0]}}
    result = run(bag, None, config_of({"uwb": section} | BEGINS_AT_ORIGIN), "batch", check=False)
    x, y = (result.installation[f"uwb.anchor_3.{axis}"] for axis in "xy")
    assert abs(x[0] - 8.0) < 3.0 * x[1] < 0.5
    assert abs(y[0] - 9.0) < 3.0 * y[1] < 0.5
    assert "uwb.anchor_1.x" not in result.installation
