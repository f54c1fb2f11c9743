"""Drives named by their joints, and motion to the side that the configured one cannot make."""

import math

import numpy as np
import pytest

from fgloc.calibration.first_settings import first_settings
from fgloc.config import Config
from fgloc.diagnosis.conventions import conventions
from fgloc.diagnosis.signals import read_signals
from fgloc.recording.reader import Recording
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
CORNERS = ["front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"]


def write(folder, names, angles, twist=None):
    """Joints at 50 Hz for 20 s and, if given, an odometry of this twist."""
    with BagWriter(folder / "bag") as bag:
        for k in range(1000):
            t, stamp = 0.02 * k, START_NS + k * 20_000_000
            bag.joints("/joint_states", stamp, names, angles(t))
            if twist is not None:
                bag.odometry("/odom", stamp, (0.0, 0.0, 0.0), twist(t))
    return folder / "bag"


def sliding(t):
    return 4.0 * math.sin(0.5 * t), 5.0 * math.sin(0.3 * t), 2.0 * math.sin(0.8 * t)


def mecanum(t):
    x, y, turn = sliding(t)
    return [x - y - turn, x + y + turn, x + y - turn, x - y + turn]


def skid(t):
    x, _, turn = sliding(t)
    return [x - turn, x + turn, x - turn, x + turn]


@pytest.mark.parametrize(
    ("names", "angles", "lines"),
    [
        (CORNERS, mecanum, ["kind: mecanum", f"wheels: [{', '.join(CORNERS)}]", "half_sum:"]),
        (CORNERS, skid, ["kind: skid_steer", "left: [front_left_wheel, rear_left_wheel]", "track:"]),
        (
            ["rear_left_wheel", "rear_right_wheel", "right_steering", "left_steering"],
            lambda t: [t, t, 0.1, 0.1],
            ["kind: ackermann", "steering_joints: [left_steering, right_steering]", "wheelbase:"],
        ),
        (["steering", "traction_wheel"], lambda t: [0.3, t], ["kind: tricycle", "wheel: traction_wheel"]),
        (
            ["w1_wheel", "w2_wheel", "w3_wheel", "w1_steer", "w2_steer", "w3_steer"],
            lambda t: [t, t, t, 0.0, 0.0, 0.0],
            ["kind: swerve", "places:"],
        ),
    ],
)
def test_init_names_the_drive_and_asks_for_its_geometry(tmp_path, names, angles, lines):
    found = first_settings(write(tmp_path, names, angles))
    for line in lines:
        assert f"#     {line}" in found.text
    assert any("wheels.drive" in sentence for sentence in found.missing)


@pytest.mark.parametrize(
    ("names", "angles", "ticks"),
    [
        (CORNERS, mecanum, []),
        (CORNERS, lambda t: np.rint(np.multiply(mecanum(t), 100.0)), ["ticks_per_turn"]),
        (["left_wheel", "right_wheel"], lambda t: [round(300 * t), round(280 * t)], ["ticks_per_turn"]),
        (["steering", "traction_wheel"], lambda t: [round(90 * math.sin(t)), 3.3 * t], ["steering_ticks"]),
        (CORNERS, lambda t: [0.0] * 4, []),  # it stands
    ],
    ids=["radians", "ticks", "two wheels", "steering", "standing"],
)
def test_positions_that_are_ticks_are_asked_for_the_ticks_of_a_turn(tmp_path, names, angles, ticks):
    text = first_settings(write(tmp_path, names, angles)).text
    assert [key for key in ("ticks_per_turn", "steering_ticks") if f"#     {key}:" in text] == ticks


def test_wheels_in_no_known_places_are_asked_for(tmp_path):
    found = first_settings(write(tmp_path, ["wheel_1", "wheel_2", "wheel_3"], lambda t: [t, t, t]))
    assert "kind:" not in found.text
    assert any("wheels.drive" in sentence for sentence in found.missing)


def test_three_wheels_of_a_robot_that_goes_sideways_are_omnidirectional(tmp_path):
    bag = write(
        tmp_path,
        ["wheel_1", "wheel_2", "wheel_3"],
        lambda t: [t, -t, 0.5 * t],
        lambda t: (0.5 * math.cos(0.4 * t), 0.5 * math.sin(0.4 * t), 0.0),
    )
    assert "#     kind: omni" in first_settings(bag).text


def codes(bag, drive):
    wheels = {"drive": drive} if drive else {"left_radius": 0.1, "right_radius": 0.1, "track": 0.4}
    config = Config.model_validate({"wheels": {"source": "ticks", **wheels}})
    with Recording(bag, config.recording) as recording:
        return {finding.code: finding for finding in conventions(read_signals(recording, config), config).findings}


def test_motion_to_the_side_that_the_drive_cannot_make_is_named(tmp_path):
    names = ["left_wheel", "right_wheel", "a", "b"]

    def twist(t):
        x, y, turn = (np.array(sliding(t + 0.01)) - np.array(sliding(t))) / 0.01 * 0.1
        return (float(x), float(y), float(turn))

    bag = write(tmp_path, names, mecanum, twist)
    found = codes(bag, None)
    assert 0.1 < found["wheels.sideways"].value < 0.9
    rolling = {"kind": "mecanum", "wheels": names, "radius": 0.1, "half_sum": 0.4}
    assert "wheels.sideways" not in codes(bag, rolling)


def test_a_robot_that_only_goes_ahead_is_not_said_to_go_sideways(tmp_path):
    bag = write(
        tmp_path, ["left_wheel", "right_wheel"], lambda t: [3.0 * t, 3.2 * t], lambda t: (0.3, 0.01 * math.sin(t), 0.05)
    )
    assert "wheels.sideways" not in codes(bag, None)
