"""Wheels of a drive that contradict each other or the gyro: the one mistake that explains it is one line."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fgloc import se2
from fgloc.config import config_of, with_value
from fgloc.diagnosis.conventions import conventions
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.diagnosis.signals import read_signals
from fgloc.recording.reader import Recording
from fgloc.types import Severity
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
FL, FR, RL, RR = CORNERS = ["front_left", "front_right", "rear_left", "rear_right"]
STEERING = [f"{name}_steering" for name in CORNERS]
PLACES = [[0.2, 0.2], [0.2, -0.2], [-0.2, 0.2], [-0.2, -0.2]]
DRIVES = {
    "mecanum": {"kind": "mecanum", "wheels": CORNERS, "radius": 0.05, "half_sum": 0.4},
    "omni": {"kind": "omni", "wheels": ["a", "b", "c"], "radius": 0.05, "ring": 0.2, "angles_deg": [60, 180, 300]},
    "skid": {"kind": "skid_steer", "left": [FL, RL], "right": [FR, RR], "radius": 0.1, "track": 0.6},
    "swerve": {"kind": "swerve", "wheels": CORNERS, "steering_joints": STEERING, "radius": 0.05, "places": PLACES},
}
BEACONS = [(4.0, 0.5), (0.5, 4.0), (-4.0, -0.5), (-0.5, -4.0), (3.0, -3.0)]
OF = {name: i for i, name in enumerate(CORNERS)}


def configured(kind, **drive):
    return config_of({"wheels": {"source": "ticks", "drive": DRIVES[kind] | drive}})


def moved(kind, t):
    """Twist, and rates and steering of the joints at a time."""
    if kind == "skid":
        twist = np.array([0.45 + 0.15 * math.sin(0.5 * t), 0.0, 0.5 * math.sin(0.6 * t) + 0.15])
    else:
        twist = np.array([0.4 * math.cos(0.5 * t) + 0.1, 0.35 * math.sin(0.7 * t), 0.4 * math.sin(0.31 * t)])
    drive = configured(kind).wheels.drive
    angles = np.zeros(len(drive.steered))
    if kind == "swerve":
        angles = np.array([math.atan2(twist[1] + twist[2] * x, twist[0] - twist[2] * y) for x, y in PLACES])
    made = drive.equations(np.zeros(len(drive.driven)), angles)
    return twist, (made.A @ twist)[: len(drive.driven)] / drive.radius, angles


def drive(
    folder,
    kind,
    told=lambda t, wheels, steering: (wheels, steering),
    *,
    gyro=True,
    landmarks=False,
    rates=False,
    left=1.0,
):
    """A recording whose joints report what `told` makes of their positions (or rates); bearings count by ``left``."""
    names, rng, pose = [*configured(kind).wheels.drive.driven], np.random.default_rng(3), np.zeros(3)
    names += configured(kind).wheels.drive.steered
    angles = np.zeros(len(moved(kind, 0.0)[1]))
    with BagWriter(folder) as bag:
        for k in range(400):
            t, stamp = 0.05 * k, START_NS + k * 50_000_000
            twist, turning, steered = moved(kind, t)
            wheels, steering = told(t, (turning if rates else angles).copy(), steered.copy())
            positions = [*([math.nan] * len(wheels) if rates else wheels), *steering]
            bag.joints("/joints", stamp, names, positions, [*wheels, *steering] if rates else [], received_ns=stamp)
            if gyro:
                bag.imu("/imu", stamp, (0.0, 0.0, twist[2] + rng.normal(0.0, 0.003)), (0.0, 0.0, 9.81))
            if landmarks and k % 2 == 0:
                seen = ((i, se2.between(pose, (*place, 0.0))) for i, place in enumerate(BEACONS))
                bag.range_bearing(
                    "/tags", stamp, [(i, math.hypot(*p[:2]), math.atan2(left * p[1], p[0])) for i, p in seen]
                )
            angles, pose = angles + 0.05 * turning, se2.compose(pose, se2.exp(0.05 * twist))
    return folder


def said(folder, config, severity=Severity.ERROR):
    """Codes and lines of what is found by pairs of signals, of one severity."""
    with Recording(folder, config.recording) as recording:
        found = conventions(read_signals(recording, config), config).findings
    return {f.code: dict(f.lines) for f in found if f.severity is severity}


def backwards(*of):
    return lambda t, wheels, steering: (wheels * [-1.0 if i in of else 1.0 for i in range(len(wheels))], steering)


def order(*of):
    return lambda t, wheels, steering: (wheels[[*of]], steering)


@pytest.mark.parametrize(
    ("kind", "told", "recorded", "code", "key", "value"),
    [
        ("mecanum", backwards(0), {}, "wheels.reversed", "reversed", [FL]),
        ("mecanum", backwards(3), {"gyro": False}, "wheels.reversed", "reversed", [RR]),
        ("mecanum", backwards(1), {"rates": True}, "wheels.reversed", "reversed", [FR]),
        ("mecanum", backwards(*range(4)), {"landmarks": True}, "wheels.reversed", "reversed", sorted(CORNERS)),
        ("mecanum", order(0, 2, 1, 3), {}, "wheels.order", "wheels", [FL, RL, FR, RR]),
        ("mecanum", order(2, 1, 0, 3), {"landmarks": True}, "wheels.order", "wheels", [RL, FR, FL, RR]),
        ("omni", backwards(1), {}, "wheels.reversed", "reversed", ["b"]),
        ("skid", backwards(2, 3), {}, "wheels.reversed", "reversed", [FR, RR]),
        ("swerve", lambda t, w, s: (w, np.degrees(s)), {}, "wheels.steering", "steering_ratio", math.pi / 180.0),
    ],
)
def test_one_mistake_of_the_joints_is_one_line_which_undoes_it(tmp_path, kind, told, recorded, code, key, value):
    folder = drive(tmp_path / "bag", kind, told, **recorded)
    found = said(folder, configured(kind))
    assert list(found) == [code]
    assert list(found[code]) == [f"wheels.drive.{key}"]
    assert found[code][f"wheels.drive.{key}"] == (
        f"[{', '.join(value)}]" if isinstance(value, list) else pytest.approx(str(round(value, 7)))
    )
    assert said(folder, with_value(configured(kind), f"wheels.drive.{key}", value)) == {}


@pytest.mark.parametrize(("kind", "recorded"), [*((kind, {}) for kind in DRIVES), ("mecanum", {"gyro": False})])
def test_sound_wheels_have_nothing_to_say(tmp_path, kind, recorded):
    assert said(drive(tmp_path / "bag", kind, **recorded), configured(kind)) == {}


@pytest.mark.parametrize(("kind", "from_s"), [("mecanum", 0.0), ("mecanum", 8.0), ("skid", 0.0)])
def test_a_wheel_that_stands_while_the_others_turn_is_named(tmp_path, kind, from_s):
    frozen = []

    def told(t, wheels, steering):
        if t >= from_s:
            frozen.append(wheels[2])
            wheels[2] = frozen[0]
        return wheels, steering

    folder = drive(tmp_path / "bag", kind, told)
    assert said(folder, configured(kind), Severity.WARNING) == {"wheels.still": {}}


def test_wheels_that_contradict_each_other_a_little_still_tell_of_the_sightings(tmp_path):
    """A wheel that stands for the last quarter, and bearings that count to the right."""
    last = []

    def told(t, wheels, steering):
        last[:] = last if t > 15.0 else [wheels[2]]
        return np.array([*wheels[:2], last[0], *wheels[3:]]), steering

    folder = drive(tmp_path / "bag", "mecanum", told, landmarks=True, left=-1.0)
    assert list(said(folder, configured("mecanum"))) == ["sightings.mirrored"]


def test_two_mistakes_that_explain_as_much_are_both_named_without_a_line(tmp_path):
    assert said(drive(tmp_path / "bag", "mecanum", order(2, 1, 0, 3)), configured("mecanum")) == {"wheels.order": {}}


def test_wheels_that_nothing_explains_are_named(tmp_path):
    folder = drive(tmp_path / "bag", "mecanum", lambda t, w, s: (w + np.array([0.0, 15.0 * t, 0.0, 0.0]), s))
    assert said(folder, configured("mecanum"), Severity.WARNING) == {"wheels.contradict": {}}


@pytest.mark.parametrize(
    ("range_", "drive_"),
    [(2.0 * math.pi, {}), (65536.0, {"ticks_per_turn": 100_000}), (4000.0, {"ticks_per_turn": 4000})],
)
def test_positions_of_a_drive_that_roll_over_are_one_line(tmp_path, range_, drive_):
    per = drive_.get("ticks_per_turn", math.tau) / math.tau
    folder = drive(tmp_path / "bag", "mecanum", lambda t, w, s: (np.mod(per * w, range_), s))
    (found,) = (f for f in inspect_all(folder, None, configured("mecanum", **drive_)).found if f.lines)
    assert found.code == "wheels.roll_over"
    assert float(found.lines["wheels.drive.rolls_over"]) == pytest.approx(range_, rel=1e-4)
