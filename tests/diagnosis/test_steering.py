"""Mistakes of steered drives, by gyro and truth: each is one line, which makes the next comparison silent."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from fgloc.config import config_of, with_value
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.types import Severity
from fgloc_datasets.bag import BagWriter

START_NS, WHEELBASE, SECONDS = 1_700_000_000_000_000_000, 2.8, 60.0


def drive(folder, *, speed=1.0, steering=1.0, truth=True, gyro=True):
    """A car's recording: speed and angle of its steering are reported as so many times what they are."""
    t = np.arange(0.0, SECONDS, 0.02)
    v, angle = 1.5 + 0.5 * np.sin(0.5 * t), 0.45 * np.sin(0.31 * t) + 0.1 * np.sin(1.1 * t)
    omega = v * np.tan(angle) / WHEELBASE
    yaw = cumulative_trapezoid(omega, t, initial=0.0)
    x, y = (cumulative_trapezoid(v * part, t, initial=0.0) for part in (np.cos(yaw), np.sin(yaw)))
    rng = np.random.default_rng(3)
    with BagWriter(folder) as bag:
        for k, at in enumerate(t):
            stamp = START_NS + round(at * 1e9)
            told = [float("nan"), steering * angle[k]], [speed * v[k], float("nan")]
            bag.joints("/car", stamp, ["speed", "steering_angle"], *told, received_ns=stamp)
            if gyro:
                bag.imu("/imu", stamp, (0.0, 0.0, omega[k] + rng.normal(0.0, 0.003)), (0.0, 0.0, 9.81))
            if truth:
                bag.planar_truth("/ground_truth", stamp, (x[k], y[k], yaw[k]))
    return folder


def configured(wheelbase=WHEELBASE):
    return config_of({"wheels": {"drive": {"kind": "ackermann", "wheelbase": wheelbase}}})


def said(folder, config):
    """Codes and lines of what is wrong with wheels, gyro and truth."""
    found = inspect_all(folder, None, config).found
    return {f.code: dict(f.lines) for f in found if f.severity is Severity.ERROR or f.lines}


@pytest.mark.parametrize(
    ("recorded", "wheelbase", "code", "line"),
    [
        ({"steering": 180.0 / math.pi}, WHEELBASE, "wheels.steering", ("wheels.drive.steering_ratio", math.pi / 180)),
        ({"steering": 180.0 / math.pi, "truth": False}, WHEELBASE, "wheels.steering", None),
        ({"speed": 3.6}, WHEELBASE, "wheels.unit", ("wheels.drive.radius", 1.0 / 3.6)),
        ({"speed": 3.6, "truth": False}, WHEELBASE, "wheels.unit", ("wheels.drive.radius", 1.0 / 3.6)),
        ({"steering": -1.0}, WHEELBASE, "wheels.sign", ("wheels.drive.steering_ratio", -1.0)),
        ({}, 3.5, "wheels.wheelbase", ("wheels.drive.wheelbase", WHEELBASE)),
        ({"truth": False}, 2.2, "wheels.wheelbase", ("wheels.drive.wheelbase", WHEELBASE)),
    ],
)
def test_a_mistake_is_one_line_which_undoes_it(tmp_path, recorded, wheelbase, code, line):
    folder = drive(tmp_path / "bag", **recorded)
    config = configured(wheelbase)
    found = said(folder, config)
    assert list(found) == [code]
    ((key, value),) = found[code].items()
    if line is not None:
        assert (key, float(value)) == (line[0], pytest.approx(line[1], rel=0.02))
    assert said(folder, with_value(config, key, float(value))) == {}


@pytest.mark.parametrize("recorded", [{}, {"truth": False}, {"gyro": False}])
def test_a_sound_car_has_nothing_to_say(tmp_path, recorded):
    assert said(drive(tmp_path / "bag", **recorded), configured()) == {}


def test_without_another_witness_steering_and_gyro_of_opposite_sign_are_both_in_doubt(tmp_path):
    assert said(drive(tmp_path / "bag", steering=-1.0, truth=False), configured()) == {"yaw.sign": {}}


def test_a_truth_alone_changes_no_setting_of_the_wheels(tmp_path):
    found = inspect_all(drive(tmp_path / "bag", gyro=False), None, configured(3.5)).found
    assert not any(key.startswith("wheels.") for f in found for key in f.lines)
