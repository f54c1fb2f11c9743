"""Motion sources held against each other, and maps against the places of markers in images."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from fgloc.calibration.first_settings import first_settings
from fgloc.config import config_of_file, with_value
from fgloc.diagnosis.conventions import conventions
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.diagnosis.signals import SignalCollector
from fgloc.recording.reader import open_recording
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, InertialEvent, Severity
from fgloc_datasets.bag import BagWriter

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "installed_run"


@pytest.fixture(scope="module")
def config():
    return config_of_file(yaml.safe_load(first_settings(SAMPLE / "bag").text))


@pytest.fixture(scope="module")
def recorded(config):
    with open_recording(SAMPLE / "bag", config.recording) as recording:
        role_of = {topic: r for r, topic in recording.roles.items() if r not in ("image", "camera_info", "truth")}
        events = [e for m in recording.messages(role_of.keys()) for e in recording.decode(m, role_of[m[0]])]
        return events, dict(recording.roles)


@pytest.fixture
def found(recorded, config):
    events, roles = recorded

    def compare(kind, change):
        collector = SignalCollector(config, roles)
        for event in events:
            collector.add(change(event) if isinstance(event, kind) else event)
        return conventions(collector.found, config).findings

    return compare


def late(seconds):
    return lambda e: dataclasses.replace(e, stamp_ns=e.stamp_ns + round(seconds * 1e9))


def turned(factor):
    return lambda e: dataclasses.replace(e, position=factor * e.position, velocity=factor * e.velocity)


def test_sound_sources_agree(found):
    assert not found(JointsEvent, lambda e: e)


def test_angles_in_degrees(found, config):
    (finding,) = found(JointsEvent, turned(180.0 / math.pi))
    assert finding.code == "wheels.unit"
    assert float(finding.lines["wheels.left_radius"]) == pytest.approx(
        config.wheels.left_radius * math.pi / 180.0, rel=1e-4
    )


@pytest.mark.parametrize("signs", [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0)])
def test_angles_that_count_backward(found, config, signs):
    (finding,) = found(JointsEvent, turned(np.array(signs)))
    radii = config.wheels.left_radius, config.wheels.right_radius
    sides = zip(("left", "right"), radii, signs, strict=True)
    assert finding.code == "wheels.reversed"
    assert finding.lines == {f"wheels.{side}_radius": f"{-radius:g}" for side, radius, c in sides if c < 0.0}


def test_exchanged_wheels_by_the_odometry(found, config):
    def exchanged(e):
        return dataclasses.replace(e, position=e.position[::-1], velocity=e.velocity[::-1])

    found_first = found(JointsEvent, exchanged)[0]
    assert found_first.code == "wheels.sign"
    assert found_first.lines["wheels.left_joint"] == config.wheels.right_joint


@pytest.mark.parametrize(("kind", "code"), [(OdometryEvent, "clock.odometry"), (JointsEvent, "clock.joints")])
def test_who_is_late_by_two_against_one(found, kind, code):
    (finding,) = found(kind, late(0.3))
    assert finding.code == code
    assert finding.value == pytest.approx(0.3, abs=0.02)


def test_gyro_that_is_late_beside_two_sources(found):
    (finding,) = found(InertialEvent, late(0.2))
    assert finding.code == "clock.imu"


@pytest.mark.parametrize("factor", [1000.0, 1.0 / 0.3048])
def test_commands_in_another_unit(found, factor):
    (finding,) = found(ControlEvent, lambda e: dataclasses.replace(e, v=factor * e.v))
    assert (finding.code, finding.severity) == ("commands.unit", Severity.WARNING)
    assert finding.value * factor == pytest.approx(0.95, abs=0.1)


def in_feet(landmark):
    landmark["position"] = [v / 0.3048 for v in landmark["position"]]


def all_in_feet(landmark):
    in_feet(landmark)
    landmark["size"] /= 0.3048


def in_centimetres(landmark):
    landmark["position"] = [100.0 * v for v in landmark["position"]]


def w_first(landmark):
    x, y, z, w = landmark["quaternion"]
    landmark["quaternion"] = [w, x, y, z]


def shifted(landmark):
    landmark["id"] += 1


def half_the_size(landmark):
    landmark["size"] *= 0.5


@pytest.mark.parametrize(
    ("change", "code", "value"),
    [
        pytest.param(in_feet, "map.unit", 0.3048, marks=pytest.mark.slow),
        (all_in_feet, "map.unit", 0.3048),
        pytest.param(in_centimetres, "map.unit", 0.01, marks=pytest.mark.slow),
        pytest.param(w_first, "map.quaternions", None, marks=pytest.mark.slow),
        pytest.param(shifted, "map.ids", 1.0, marks=pytest.mark.slow),
        pytest.param(half_the_size, "map.size", 2.0, marks=pytest.mark.slow),
    ],
)
def test_a_map_that_images_contradict_is_named_with_its_mistake(tmp_path, config, change, code, value):
    content = yaml.safe_load((SAMPLE / "map.yaml").read_text())
    for landmark in content["landmarks"]:
        change(landmark)
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(content))
    found = inspect_all(SAMPLE / "bag", tmp_path / "map.yaml", config)
    assert found.exit_code == 3
    first = found.found[0]
    assert first.code == code
    assert value is None or first.value == pytest.approx(value, rel=0.02)
    for key, shown in first.lines.items():
        names = key.removeprefix("expert.")
        assert np.isfinite(getattr(with_value(config, names, float(shown)).map, names.split(".")[1]))


# --- Joints alone -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("per_turn", "drive", "code"),
    [
        (2 * math.pi, {}, "wheels.geometry"),
        (8400.0, {"kind": "skid_steer", "radius": 0.07, "track": 0.34}, "wheels.ticks"),
        (8400.0, {"kind": "skid_steer", "radius": 0.07, "track": 0.34, "ticks_per_turn": 8400.0}, None),
        (2 * math.pi, {"kind": "skid_steer", "radius": 0.07, "track": 0.34}, None),
    ],
)
def test_joints_that_tell_no_way_are_named_before_a_run(tmp_path, per_turn, drive, code):
    names = ["front_left", "front_right", "rear_left", "rear_right"]
    sides = {"left": [names[0], names[2]], "right": [names[1], names[3]]}
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(600):
            turned = per_turn * (2.0 + 0.3 * math.sin(0.01 * k)) * 0.02 * k  # two turns a second
            bag.joints("/joints", round((1.0 + 0.02 * k) * 1e9), names, position=[turned] * 4)
    given = config_of_file({"wheels": {"drive": drive | sides} if drive else {}})
    info = inspect_all(tmp_path / "bag", None, given)
    codes = [f.code for f in info.found if f.severity is Severity.ERROR]
    assert codes == ([] if code is None else [code])


CORNERS = ["front_left", "front_right", "rear_left", "rear_right"]
MECANUM = {"kind": "mecanum", "wheels": CORNERS, "radius": 0.014, "half_sum": 0.369}
TWO = {"left_joint": "front_left", "right_joint": "front_right", "left_radius": 0.07, "right_radius": 0.07}


def joints_of(folder, angle, rate=None, odometry=False):
    """Four wheels for 12 s whose driver reports angles, and rates, in a unit of its own."""
    with BagWriter(folder / "bag") as bag:
        for k in range(600):
            stamp, t = round((1.0 + 0.02 * k) * 1e9), 0.02 * k
            values = {"position": [] if angle is None else [angle(t)] * 4}
            values |= {} if rate is None else {"velocity": [rate(t)] * 4}
            bag.joints("/joints", stamp, CORNERS, **values)
            if odometry:
                bag.odometry("/odom", stamp, (0.1 * t, 0.0, 0.0), (0.1, 0.0))
    return folder / "bag"


def whole_ticks(t):
    return float(round(42.0 * (3.0 * t + math.sin(t))))


@pytest.mark.parametrize(
    ("angle", "rate", "wheels", "code", "severity"),
    [
        (whole_ticks, lambda t: 900.0, {"drive": MECANUM}, "wheels.ticks", Severity.ERROR),
        (whole_ticks, lambda t: 900.0, {"drive": MECANUM | {"ticks_per_turn": 42.0}}, None, None),
        (whole_ticks, None, TWO | {"track": 0.3}, "wheels.ticks", Severity.ERROR),
        (
            whole_ticks,
            None,
            TWO | {"track": 0.3, "left_radius": 1e-4, "right_radius": 1e-4},
            None,
            None,
        ),  # way per tick
        (lambda t: 3.3 * t, lambda t: 900.0, {"drive": MECANUM}, "wheels.rates", Severity.WARNING),
        (lambda t: 3.3 * t, lambda t: 900.0 if t > 11.9 else 3.3, {"drive": MECANUM}, None, None),  # a spike
        (lambda t: 3.3 * t, None, TWO | {"track": 0.3, "left_joint": "l"}, "wheels.joints", Severity.ERROR),
    ],
    ids=["ticks", "known ticks", "two wheels", "way per tick", "rates", "spike", "absent"],
)
def test_joints_in_a_unit_of_their_own_or_of_another_name_are_named_before_a_run(
    tmp_path, angle, rate, wheels, code, severity
):
    found = inspect_all(joints_of(tmp_path, angle, rate), None, config_of_file({"wheels": wheels})).found
    named = {f.code: f.severity for f in found if f.code.startswith("wheels.")}
    assert named == ({} if code is None else {code: severity})


def test_joints_without_angles_whose_rates_cannot_be_used_tell_no_motion(tmp_path):
    bag = joints_of(tmp_path, None, lambda t: 900.0)
    found = inspect_all(bag, None, config_of_file({"wheels": {"drive": MECANUM}})).found
    assert found[0].code == "wheels.rates"
    assert found[0].severity is Severity.ERROR


def test_absent_joints_beside_an_odometry_are_a_warning_that_names_those_there(tmp_path):
    bag = joints_of(tmp_path, lambda t: 3.3 * t, odometry=True)
    info = inspect_all(bag, None, config_of_file({"wheels": {"right_joint": "wheel_r"}}))
    (named,) = [f for f in info.found if f.code == "wheels.joints"]
    assert named.severity is Severity.WARNING
    assert "wheel_r" in named.text
    assert all(name in named.text for name in CORNERS)


def test_the_drive_that_joints_show_is_asked_for_not_another_one(tmp_path):
    found = inspect_all(joints_of(tmp_path, whole_ticks), None, config_of_file({})).found
    assert found[0].code == "wheels.geometry"
    assert "skid_steer" in found[0].text
    assert "ticks_per_turn" in found[0].text
    assert "left_radius" not in found[0].text
