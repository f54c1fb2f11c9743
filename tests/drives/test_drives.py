"""Drives: the twist of known motions, derivatives by every parameter, and geometry that cannot be."""

import math
import re

import numpy as np
import pytest
import yaml
from pydantic import TypeAdapter, ValidationError

from fgloc.config import Config, load_config
from fgloc.drives.every import AnyDrive
from fgloc.errors import ConfigError

DRIVE = TypeAdapter(AnyDrive)
DRIVES = {
    "differential": dict(kind="differential", left=["l"], right=["r"], radius=0.1, track=0.5),
    "skid_steer": dict(
        kind="skid_steer", left=["fl", "rl"], right=["fr", "rr"], radius=0.1, track=0.6, axle_x=0.05, ticks_per_turn=64
    ),
    "ackermann": dict(
        kind="ackermann",
        wheels=["rl", "rr"],
        wheel_y=[0.7, -0.7],
        steering_joints=["left", "right"],
        radius=0.3,
        wheelbase=2.5,
        axle_x=-1.2,
    ),
    "bicycle": dict(kind="ackermann", wheelbase=0.33, steering_ratio=0.05, steering_zero=0.03),
    "tricycle": dict(kind="tricycle", wheel="w", steering_joint="s", radius=0.1, wheelbase=1.4, axle_x=0.2),
    "mecanum": dict(kind="mecanum", wheels=["fl", "fr", "rl", "rr"], radius=0.07, half_sum=0.37, lateral=0.95),
    "omni": dict(kind="omni", wheels=["a", "b", "c"], angles_deg=[60, 180, 300], ring=0.2, radius=0.03),
    "swerve": dict(
        kind="swerve",
        wheels=["a", "b", "c", "d"],
        steering_joints=["e", "f", "g", "h"],
        places=[[0.3, 0.2], [0.3, -0.2], [-0.3, 0.2], [-0.3, -0.2]],
        radius=0.05,
        steering_zeros=[0.02, 0.0, -0.01, 0.0],
    ),
}


def drive(name):
    """A drive all of whose parameters are estimated."""
    made = DRIVE.validate_python(DRIVES[name])
    return made.with_values({}, {key: sigma or 0.01 for key, sigma in made.usual_sigmas().items()})


def readings(made, twist):
    """Rates and steering angles of wheels that roll along with this twist of the base, by each wheel's own speed."""
    vx, vy, w = twist

    def at(x, y):
        return vx - w * y, vy + w * x

    match made.kind:
        case "differential" | "skid_steer":
            left, right = (at(made.axle_x, side * made.track / 2)[0] / made.radius for side in (1, -1))
            return [left] * len(made.left) + [right] * len(made.right), []
        case "ackermann":
            rates = [at(made.axle_x, y)[0] / made.radius for y in made.wheel_y or [0.0] * len(made.wheels)]
            sides = [0.0] if len(made.steering_joints) == 1 else [0.7, -0.7]
            angles = []
            for y in sides:
                x_dot, y_dot = at(made.axle_x + made.wheelbase, y)
                angles.append((math.atan(y_dot / x_dot) - made.steering_zero) / made.steering_ratio)
            return rates, angles
        case "tricycle":
            x_dot, y_dot = at(made.axle_x + made.wheelbase, 0.0)
            return [math.hypot(x_dot, y_dot) / made.radius], [math.atan2(y_dot, x_dot)]
        case "mecanum":  # rollers at 45°: only the speed across them drives the wheel
            half = made.half_sum / 2
            places = [(half, half), (half, -half), (-half, half), (-half, -half)]
            rates = []
            for (x, y), roller in zip(places, (-1, 1, 1, -1), strict=True):
                x_dot, y_dot = at(x, y)
                y_dot += vy / made.lateral - vy  # sideways it goes less far than rollers without slip
                rates.append((x_dot + roller * y_dot) / made.radius)
            return rates, []
        case "omni":
            rates = []
            for degrees in made.angles_deg:
                a = math.radians(degrees)
                x_dot, y_dot = at(made.ring * math.cos(a), made.ring * math.sin(a))
                rates.append((-math.sin(a) * x_dot + math.cos(a) * y_dot) / made.radius)
            return rates, []
        case "swerve":
            rates, angles = [], []
            for (x, y), zero in zip(made.places, made.steering_zeros, strict=True):
                x_dot, y_dot = at(x, y)
                rates.append(math.hypot(x_dot, y_dot) / made.radius)
                angles.append(math.atan2(y_dot, x_dot) - zero)
            return rates, angles
    raise AssertionError(made.kind)


@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("seed", range(3))
def test_the_twist_is_that_which_turned_the_wheels(name, seed):
    made, rng = drive(name), np.random.default_rng(seed)
    vx, vy, w = rng.uniform(0.3, 1.0), rng.uniform(-0.4, 0.4), rng.uniform(-0.5, 0.5)
    if not made.slides:
        vy = -made.axle_x * w
        w *= 0.3
        vy *= 0.3
    twist, _, left = made.moves(*readings(made, (vx, vy, w)))
    assert twist == pytest.approx([vx, vy, w], abs=1e-12)
    assert np.abs(left).max() < 1e-12


@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("seed", range(3))
def test_derivatives_by_every_parameter_are_those_of_differences(name, seed):
    """Also of wheels that contradict each other, where the twist is that of least squares."""
    made, rng, h = drive(name), np.random.default_rng(seed), 1e-6
    rates = rng.normal(0.0, 4.0, len(made.driven))
    angles = rng.normal(0.0, 0.3, len(made.steered)) if made.kind == "swerve" else np.full(len(made.steered), 0.25)
    angles = angles + 0.02 * np.arange(len(angles))
    _, by, _ = made.moves(rates, angles)
    assert by.shape == (3, len(made.states))
    for k, key in enumerate(made.states):
        there, back = (made.with_values({key: made.value(key) + s * h}).moves(rates, angles)[0] for s in (1.0, -1.0))
        assert by[:, k] == pytest.approx((there - back) / (2.0 * h), abs=1e-6), key


def test_steering_ticks_count_up_to_half_a_turn():
    made = DRIVE.validate_python({**DRIVES["tricycle"], "steering_ticks": 8192})
    assert made.steering(2048.0) == pytest.approx(math.pi / 2)
    assert made.steering(8192 - 2048.0) == pytest.approx(-math.pi / 2)


@pytest.mark.parametrize(
    ("name", "changes", "named"),
    [
        ("omni", {"angles_deg": [0, 180, 0]}, r"\bomni\b.*docs/drives\.md"),
        ("omni", {"wheels": ["a"], "angles_deg": [0]}, r"wheels\.drive\.wheels\b.*\b3\b"),
        ("omni", {"wheels": ["a", "b", "c", "d"]}, r"wheels\b.*\b4\b.*angles_deg\b.*\b3\b"),
        ("mecanum", {"wheels": ["fl", "fr", "rl", "fl"]}, "fl, fr, rl, fl"),
        ("mecanum", {"radius": 0.0}, "greater than"),
        ("mecanum", {"wheelbase": 0.3}, "unknown key"),
        ("ackermann", {"wheel_y": [0.7]}, r"wheels\b.*\b2\b.*wheel_y\b.*\b1\b"),
        ("swerve", {"places": [[0, 0], [0, 0], [0, 0], [0, 0]]}, r"\bswerve\b.*docs/drives\.md"),
        ("tricycle", {"sigmas": {"track": 0.1}}, r"\btricycle\b.*\btrack\b"),
    ],
)
def test_impossible_geometry_is_named_with_its_line(tmp_path, name, changes, named):
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump({"wheels": {"drive": {**DRIVES[name], **changes}}}, default_flow_style=None))
    with pytest.raises(ConfigError, match=r"robot\.yaml:\d+: wheels\.drive") as error:
        load_config(path)
    assert re.search(named, str(error.value))


def test_a_drive_of_no_kind_is_named_with_the_likeliest_one():
    with pytest.raises(ValidationError, match="mecanum"):
        Config.model_validate({"wheels": {"drive": {"kind": "macanum"}}})
