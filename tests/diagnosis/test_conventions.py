"""Broken conventions are named by `info` and `init` with the line that undoes them, and none in a sound recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import fgloc
from event_makers import odometry
from robot_world import points

from fgloc.calibration.first_settings import first_settings, with_findings
from fgloc.config import Config, config_of, config_of_file, load_config
from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.conventions import conventions
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.diagnosis.odometry import check_odometry
from fgloc.diagnosis.pairs import Figure
from fgloc.diagnosis.signals import Path as Odometry
from fgloc.diagnosis.signals import Signals
from fgloc.diagnosis.truth import BodyFit, check_body, true_body
from fgloc.runner import run
from fgloc.sensors.maps import write_map
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import Finding, Landmark, LandmarkMap, Severity, ordered
from fgloc_datasets.bag import BagWriter

START_S, SECONDS, STEP_S = 1_700_000_000.0, 50.0, 0.005
TIMES = np.arange(0.0, SECONDS, STEP_S)
SPEED = 0.3 + 0.15 * np.sin(0.9 * TIMES)
RATE = 0.25 + 0.5 * np.sin(0.6 * TIMES) + 0.2 * np.sin(1.7 * TIMES)
YAW = np.concatenate([[0.0], np.cumsum(STEP_S * RATE)[:-1]])
X, Y = (np.concatenate([[0.0], np.cumsum(STEP_S * SPEED * f(YAW))[:-1]]) for f in (np.cos, np.sin))
_AROUND = np.linspace(0.0, math.tau, 9)[:-1]
BEACONS = np.column_stack([X.mean() + 3.0 * np.cos(_AROUND) + 0.3 * _AROUND, Y.mean() + 2.5 * np.sin(_AROUND)])
FOOT = 0.3048
WHEELS, RADIUS, TRACK = ("left_wheel_joint", "right_wheel_joint"), 0.05, 0.3
GEOMETRY = {"left_radius": RADIUS, "right_radius": RADIUS, "track": TRACK}
RPM = 30.0 / math.pi


@dataclass(frozen=True)
class Broken:
    """Mistakes of a recording: factors of its signals, delays [s], and matrices of axes."""

    bearing: float = 1.0
    range: float = 1.0
    depth: bool = False
    sightings_late: float = 0.0
    view: float = 1.2  # rad to each side
    imu_axes: tuple[tuple[float, ...], ...] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    imu_unit: float = 1.0
    imu_late: float = 0.0
    joint_rate: float = 0.0  # of wheels that report rates, in place of an odometry; 0: none do
    joint_angle: float = 0.0  # of a joint over the wheel's
    joint_signs: tuple[float, float] = (1.0, 1.0)
    speed: float = 1.0
    yaw_rate: float = 1.0
    turn: float = 1.0
    world_twist: bool = False
    twist_late: float = 0.0
    truth: str = ""
    truth_late: float = 0.0
    truth_yaw: float = 0.0
    truth_unit: float = 1.0
    map: float = 1.0
    map_mirrored: bool = False
    shift: int = 0


def record(folder: Path, wrong: Broken) -> Path:
    """A bag of odometry, IMU, ranges with bearings and truth, and the map beside it."""
    rng = np.random.default_rng(1)

    def at(rate_hz: float, late: float = 0.0):
        for k in range(0, len(TIMES), round(1.0 / (rate_hz * STEP_S))):
            yield k, round((START_S + TIMES[k] + late) * 1e9), round((START_S + TIMES[k]) * 1e9)

    messages = []
    with BagWriter(folder / "bag") as bag:
        for k, stamp, received in at(20.0):
            v, turned = wrong.speed * SPEED[k], YAW[k] if wrong.world_twist else 0.0
            twist = (v * math.cos(turned), v * math.sin(turned), wrong.yaw_rate * RATE[k])
            pose = (X[k], Y[k], YAW[k])
            if wrong.twist_late:
                twist = (SPEED[k], 0.0, RATE[max(k - round(wrong.twist_late / STEP_S), 0)])
            if wrong.turn != 1.0:
                heading = wrong.turn * YAW
                pose = (*(float(STEP_S * SPEED[:k] @ f(heading[:k])) for f in (np.cos, np.sin)), heading[k])
                twist = (SPEED[k], 0.0, wrong.turn * RATE[k])
            if wrong.joint_angle:
                ways = (STEP_S * SPEED[:k].sum() + side * 0.5 * TRACK * YAW[k] for side in (-1.0, 1.0))
                angles = [c * wrong.joint_angle * way / RADIUS for c, way in zip(wrong.joint_signs, ways, strict=True)]
                messages.append(
                    (received, lambda s=stamp, a=angles, r=received: bag.joints("/joints", s, WHEELS, a, (), (), r))
                )
                continue
            if wrong.joint_rate:
                rates = [wrong.joint_rate * (SPEED[k] + side * 0.5 * TRACK * RATE[k]) / RADIUS for side in (-1.0, 1.0)]
                messages.append(
                    (received, lambda s=stamp, w=rates, r=received: bag.joints("/joints", s, WHEELS, (), w, (), r))
                )
                continue
            messages.append((received, lambda s=stamp, p=pose, t=twist, r=received: bag.odometry("/odom", s, p, t, r)))
        M = np.array(wrong.imu_axes, dtype=float)
        for k, stamp, received in at(50.0, wrong.imu_late):
            omega = wrong.imu_unit * (M @ [0.0, 0.0, RATE[k]] + rng.normal(0.0, 0.005, 3))
            force = M @ [0.0, SPEED[k] * RATE[k], 9.81] + rng.normal(0.0, 0.05, 3)
            messages.append((received, lambda s=stamp, w=omega, f=force, r=received: bag.imu("/imu", s, w, f, r)))
        for k, stamp, received in at(10.0, wrong.sightings_late):
            away = BEACONS - [X[k], Y[k]]
            ranges = np.hypot(*away.T) + rng.normal(0.0, 0.02, len(away))
            bearings = np.arctan2(away[:, 1], away[:, 0]) - YAW[k] + rng.normal(0.0, 0.01, len(away))
            bearings = np.arctan2(np.sin(bearings), np.cos(bearings))
            if wrong.depth:
                ranges = ranges * np.cos(bearings)
            near = [
                (i, wrong.range * r, wrong.bearing * b)
                for i, (r, b) in enumerate(zip(ranges.tolist(), bearings.tolist(), strict=True))
                if abs(b) < wrong.view
            ]
            messages.append((received, lambda s=stamp, n=near, r=received: bag.range_bearing("/landmarks", s, n, r)))
        for k, stamp, received in at(20.0, wrong.truth_late):
            if wrong.truth == "frozen" and TIMES[k] % 5.0 < 2.0:
                k -= round(TIMES[k] % 5.0 / STEP_S)
            place, yaw = [X[k], Y[k]], YAW[k] + wrong.truth_yaw
            if wrong.truth == "ned":
                place, yaw = place[::-1], 0.5 * math.pi - yaw
            height = math.tan(math.radians(3.0)) * X[k] if wrong.truth == "tilted" else 0.0
            place = [*(wrong.truth_unit * np.array(place)).tolist(), height]
            turn = (0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))
            if wrong.truth == "upright":
                place, turn = [place[1], 0.2, place[0]], (0.0, turn[2], 0.0, turn[3])
            if wrong.truth == "jumping" and k % round(2.0 / STEP_S) == 0:
                place, turn = [place[0] + 3.0, *place[1:]], (0.0, 0.0, turn[3], -turn[2])
            if wrong.truth == "still":
                place, turn = [0.0] * 3, (0.0, 0.0, 0.0, 1.0)
            messages.append((received, lambda s=stamp, p=place, q=turn, r=received: bag.truth("/truth", s, p, q, r)))
        for _, write in sorted(messages, key=lambda m: m[0]):
            write()
    side = -1.0 if wrong.map_mirrored else 1.0
    places = dict(enumerate((wrong.map * BEACONS * (1.0, side)).tolist(), wrong.shift))
    write_map(points(places), folder / "map.yaml")
    return folder / "bag"


def conventions_of(bag: Path, config: Config):
    """Findings of `info` that have a figure or a line, but notes."""
    found = inspect_all(bag, bag.parent / "map.yaml", config).found
    for key, value in ((key, value) for f in found for key, value in f.lines.items()):
        line = yaml.safe_load(value)
        for name in reversed(key.split(".")):
            line = {name: line}
        config_of_file(line)  # as a robot.yaml would have it
    return [f for f in found if f.severity is not Severity.NOTE and "." in f.code and not f.code.startswith("setup")]


COMPARED = ("wheels", "sightings", "imu", "truth", "map", "scales", "motion")


def leaning(degrees: float) -> tuple[tuple[float, ...], ...]:
    """Axes of the base in those of an IMU that is turned about its x axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return (1.0, 0.0, 0.0), (0.0, c, s), (0.0, -s, c)


CASES = {
    "sightings mirrored (F4)": (Broken(bearing=-1.0), "sightings.mirrored", None),
    "ranges in feet": (Broken(range=1.0 / FOOT), "sightings.scale", FOOT),
    "ranges in centimetres": (Broken(range=100.0), "sightings.scale", 0.01),
    "ranges are depths": (Broken(depth=True), "sightings.depth", None),
    "sightings late (F5)": (Broken(sightings_late=0.15), "clock.sightings", 0.15),
    "IMU z flipped (G1)": (Broken(imu_axes=((1, 0, 0), (0, 1, 0), (0, 0, -1))), "imu.axes", None),
    "IMU x and z exchanged (G2)": (Broken(imu_axes=((0, 0, 1), (0, 1, 0), (1, 0, 0))), "imu.axes", None),
    "IMU in degrees (G3)": (Broken(imu_unit=180.0 / math.pi), "imu.unit", math.pi / 180.0),
    "IMU negated (G4)": (Broken(imu_axes=((-1, 0, 0), (0, -1, 0), (0, 0, -1))), "imu.axes", None),
    "IMU leans by 45 degrees": (Broken(imu_axes=leaning(45.0)), "imu.gravity", None),
    "IMU leans by 20 degrees": (Broken(imu_axes=leaning(20.0)), "imu.gravity", None),
    "gyro without power": (Broken(imu_unit=0.0), "imu.dead", None),
    "IMU late (F6)": (Broken(imu_late=0.35), "clock.imu", 0.35),
    "speeds in mm/s (G8)": (Broken(speed=1000.0), "odometry.twist_unit", 1e-3),
    "twist in the world (G8)": (Broken(world_twist=True), "odometry.twist_frame", None),
    "yaw rate in degrees": (Broken(yaw_rate=180.0 / math.pi), "odometry.yaw_unit", math.pi / 180.0),
    "yaw rate negated": (Broken(yaw_rate=-1.0), "odometry.yaw_sign", None),
    "truth in NED (G7)": (Broken(truth="ned"), "truth.axes", None),
    "truth late (G7)": (Broken(truth_late=0.5), "clock.truth", 0.5),
    "truth turned (F12)": (Broken(truth_yaw=1.0), "truth.mounting", 1.0),
    "truth in mm": (Broken(truth_unit=1000.0), "truth.scale", 1000.0),
    "map in feet (G5)": (Broken(map=1.0 / FOOT), "map.unit", FOOT),
    "map in feet, seen by a narrow view": (Broken(map=1.0 / FOOT, view=0.4), "map.unit", FOOT),
    "map x 0.3048 (G6)": (Broken(map=FOOT), "map.unit", 1.0 / FOOT),
    "map x 100 (G6)": (Broken(map=100.0), "map.unit", 0.01),
    "ids off by one (G6)": (Broken(shift=1), "map.ids", None),
    "map mirrored": (Broken(map_mirrored=True), "map.mirrored", None),
}


@pytest.mark.parametrize("case", CASES)
def test_a_broken_convention_is_named_first(tmp_path, case):
    wrong, code, value = CASES[case]
    found = conventions_of(record(tmp_path, wrong), Config())
    assert found[0].code == code, [f.text for f in found]
    assert {f.code for f in found} == {code}
    if value is not None:
        assert abs(found[0].value - value) < 0.05 * value + 5.0 * found[0].sigma


@pytest.mark.parametrize(
    ("wrong", "settings", "code", "lines"),
    [
        (Broken(), {"gyro": {"scale": -1.0}}, "imu.sign", {"expert.gyro.scale": "1.0"}),
        (Broken(turn=-1.0), {}, "wheels.sign", {"wheels.scale_omega": "-1.0"}),
        (
            Broken(joint_angle=1.0),
            {"wheels": GEOMETRY | {"left_joint": WHEELS[1], "right_joint": WHEELS[0]}},
            "wheels.sign",
            {"wheels.left_joint": WHEELS[0], "wheels.right_joint": WHEELS[1]},
        ),
        (  # a robot that seems to look back
            Broken(joint_angle=1.0, joint_signs=(-1.0, -1.0)),
            {"wheels": GEOMETRY},
            "wheels.reversed",
            {"wheels.left_radius": "-0.05", "wheels.right_radius": "-0.05"},
        ),
    ],
    ids=["gyro", "odometry", "sides exchanged", "wheels backwards"],
)
def test_of_two_that_turn_in_opposite_directions_the_landmarks_tell_which_is_wrong(
    tmp_path, wrong, settings, code, lines
):
    found = conventions_of(record(tmp_path, wrong), config_of(settings))
    assert [(f.code, f.lines) for f in found] == [(code, lines)]


def test_a_sound_recording_has_none(tmp_path):
    bag = record(tmp_path, Broken())
    assert not conventions_of(bag, Config())
    assert not [f for f in first_settings(bag).found if f.severity is not Severity.NOTE]


@pytest.mark.parametrize("sensor", ["imu", "sightings", "truth"])
@pytest.mark.parametrize("rate", [RPM, 180.0 / math.pi], ids=["rpm", "degrees"])
def test_wheels_whose_rates_are_in_another_unit_are_named_and_nothing_else(tmp_path, sensor, rate):
    bag = record(tmp_path, Broken(joint_rate=rate))
    topics = {other: "none" for other in ("imu", "sightings", "truth") if other != sensor}
    config = config_of({"recording": {"topics": topics}, "wheels": GEOMETRY})
    compared = (f for f in inspect_all(bag, None, config).found if f.severity and f.code.split(".")[0] in COMPARED)
    found, *others = compared
    assert {f.code for f in others} <= ({"wheels.rates"} if sensor == "truth" else set())
    assert (found.code, found.severity) == ("wheels.unit", Severity.ERROR)
    assert 1.0 / found.value == pytest.approx(rate, rel=0.1)
    if sensor == "truth":  # which judges the wheels in sentences only
        assert not found.lines
        return
    lines = {key: float(value) for key, value in found.lines.items()}
    radius = pytest.approx(RADIUS / rate, rel=1e-4)
    assert {key: value for key, value in lines.items() if "radius" in key} == {
        "wheels.left_radius": radius,
        "wheels.right_radius": radius,
    }
    if rate > RPM:  # beyond the bound on rates in radians
        assert lines["expert.gate.max_wheel_rate"] > 500.0
    (tmp_path / "robot.yaml").write_text(with_findings("", [found]))
    load_config(tmp_path / "robot.yaml")  # the lines are settings


def test_wheels_in_another_unit_are_named_before_map_ranges_and_truth(tmp_path):
    bag = record(tmp_path, Broken(joint_rate=RPM))
    config = config_of({"recording": {"topics": {"imu": "none"}}, "wheels": GEOMETRY})
    assert [f.code for f in conventions_of(bag, config)] == ["wheels.unit"]


def test_sound_rates_of_wheels_have_no_unit_to_be_named(tmp_path):
    bag = record(tmp_path, Broken(joint_rate=1.0))
    assert not conventions_of(bag, config_of({"wheels": GEOMETRY}))


@pytest.mark.parametrize("imu", ["auto", "none"])
def test_a_track_that_is_ten_times_too_small_is_no_unit_of_the_wheels(tmp_path, imu):
    bag = record(tmp_path, Broken(joint_rate=1.0))
    topics = {"imu": "none"} if imu == "none" else {}
    config = config_of({"recording": {"topics": topics}, "wheels": GEOMETRY | {"track": 0.1 * TRACK}})
    assert "wheels.unit" not in {f.code for f in conventions_of(bag, config)}


@pytest.mark.parametrize(
    ("gear", "without"),
    [(10.0, ()), (30.0, ("imu",)), (10.0, ("imu", "truth")), (0.5, ("imu", "truth")), (2.0, ("imu", "sightings"))],
)
def test_wheels_before_a_gear_or_of_other_radii_are_named_and_nothing_else(tmp_path, gear, without):
    """A diameter for a radius is one; 10 is no revolution per minute, in which no angle is."""
    bag = record(tmp_path, Broken(joint_angle=gear))
    config = config_of({"recording": {"topics": dict.fromkeys(without, "none")}, "wheels": GEOMETRY})
    found = [f for f in conventions_of(bag, config) if f.code.split(".")[0] in COMPARED]
    assert [f.code for f in found] == ["wheels.gear"]
    if found[0].lines:  # the truth judges the wheels in sentences only
        assert float(found[0].lines["wheels.left_radius"]) == pytest.approx(RADIUS / gear, rel=0.01)


@pytest.mark.parametrize(
    ("signs", "without"),
    [((-1, -1), ()), ((-1, -1), ("imu",)), ((1, -1), ("sightings",)), ((1, -1), ("imu", "truth")), ((-1, 1), ())],
)
def test_wheels_that_count_backwards_are_named_and_nothing_else(tmp_path, signs, without):
    """A motor that is mounted the other way round is one mistake, and not a mirrored sensor that looks backward."""
    bag = record(tmp_path, Broken(joint_angle=1.0, joint_signs=signs))
    config = config_of({"recording": {"topics": dict.fromkeys(without, "none")}, "wheels": GEOMETRY})
    (found,) = (f for f in conventions_of(bag, config) if f.code.split(".")[0] in COMPARED)
    assert found.code == "wheels.reversed"
    sides = {"left": signs[0], "right": signs[1]}
    assert found.lines == {f"wheels.{side}_radius": f"{-RADIUS:g}" for side, sign in sides.items() if sign < 0}


@pytest.mark.parametrize("without", [("truth",), ("imu", "truth")])
def test_a_side_that_counts_backwards_before_a_gear_has_one_line_for_each_radius(tmp_path, without):
    bag = record(tmp_path, Broken(joint_angle=3.0, joint_signs=(-1.0, 1.0)))
    config = config_of({"recording": {"topics": dict.fromkeys(without, "none")}, "wheels": GEOMETRY})
    backwards, gear = (f for f in conventions_of(bag, config) if f.code.split(".")[0] in COMPARED)
    assert [backwards.code, gear.code] == ["wheels.reversed", "wheels.gear"]
    assert not backwards.lines
    radii = [float(gear.lines[f"wheels.{side}_radius"]) for side in ("left", "right")]
    assert radii == pytest.approx([-RADIUS / 3.0, RADIUS / 3.0], rel=0.01)


def test_a_gear_and_a_gyro_in_degrees_are_told_apart_by_the_landmarks(tmp_path):
    bag = record(tmp_path, Broken(joint_angle=3.0, imu_unit=180.0 / math.pi))
    config = config_of({"recording": {"topics": {"truth": "none"}}, "wheels": GEOMETRY})
    found = [f.code for f in conventions_of(bag, config) if f.code.split(".")[0] in COMPARED]
    assert found == ["wheels.gear", "imu.unit"]


def test_a_wrong_track_is_named_by_landmarks_alone(tmp_path):
    bag = record(tmp_path, Broken(joint_angle=1.0))
    topics = {"imu": "none", "truth": "none"}
    config = config_of({"recording": {"topics": topics}, "wheels": GEOMETRY | {"track": 0.5 * TRACK}})
    (found,) = (f for f in conventions_of(bag, config) if f.code.split(".")[0] in COMPARED)
    assert found.code == "wheels.turn"
    assert float(found.lines["wheels.scale_omega"]) == pytest.approx(0.5, rel=0.01)


def test_a_map_surveyed_with_wrong_wheels_is_followed_by_the_reason_and_no_next_step(tmp_path):
    bag = record(tmp_path, Broken(joint_angle=1.0, joint_signs=(-1.0, 1.0)))
    (tmp_path / "map.yaml").unlink()
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump({"wheels": GEOMETRY}))
    code, stdout, err = fgloc("map", bag, "--out", tmp_path / "found.yaml")
    assert code == 3
    assert "left_radius: -0.05" in next(line for line in err.splitlines() if line.startswith("error: "))
    assert "next:" not in stdout


def test_a_truth_that_is_no_unit_is_not_fitted_to_wheels_of_wrong_radii_and_track(tmp_path):
    bag = record(tmp_path, Broken(joint_angle=2.0))
    topics = {"imu": "none", "sightings": "none"}
    found = conventions_of(bag, config_of({"recording": {"topics": topics}, "wheels": GEOMETRY | {"track": 0.15}}))
    assert {f.code for f in found if not f.code.startswith("place")} == {"wheels.turn", "wheels.scale"}


def test_on_a_straight_way_the_unit_of_ranges_or_of_the_wheels_are_both_told():
    """Nothing turns: ranges and wheels alone disagree, by a factor that is a unit of wheels, so that both are told."""
    t = np.arange(0.0, 30.0, 0.1)
    speed = 0.3 + 0.15 * np.sin(0.9 * t)
    x = np.append(0.0, np.cumsum(0.1 * speed)[:-1])
    rates = RPM * speed / RADIUS
    none = np.zeros(0)
    motion = [
        JointsEvent(round(s * 1e9), round(s * 1e9), "/joints", WHEELS, none, np.array([w, w]), none)
        for s, w in zip(t.tolist(), rates.tolist(), strict=True)
    ]
    beacons = [(2.0 + 1.5 * i, 1.5 if i % 2 else -1.2) for i in range(8)]
    rng = np.random.default_rng(3)
    seen = [
        (s, float(i), bx - at + rng.normal(0.0, 0.01), by + rng.normal(0.0, 0.01), 0.0)
        for s, at in zip(t.tolist(), x.tolist(), strict=True)
        for i, (bx, by) in enumerate(beacons)
        if 0.5 < bx - at < 4.0
    ]
    found = {
        f.code: f for f in conventions(Signals(motion=motion, seen=seen), config_of({"wheels": GEOMETRY})).findings
    }
    assert "sightings.scale" not in found
    assert float(found["wheels.unit"].lines["wheels.left_radius"]) == pytest.approx(RADIUS / RPM, rel=1e-4)
    assert "range_scale" in found["wheels.unit"].text


def one_at_a_time(map_of=lambda place: place, seen_as=lambda away: away, turns=1.0, every=1):
    """Sightings of one beacon after the other, for ten seconds each, and settings and map: what `conventions` takes."""
    rng, some = np.random.default_rng(4), slice(None, None, 20)
    t, x, y, yaw = TIMES[some], X[some], Y[some], YAW[some]
    motion = [odometry(s, twist=(v, turns * w)) for s, v, w in zip(t, SPEED[some], RATE[some], strict=True)]
    which = (t / 10.0).astype(int)
    away = (BEACONS[which] - np.column_stack([x, y])) @ [1.0, 1j] * np.exp(-1j * yaw)
    away = seen_as(away + rng.normal(0.0, 0.01, len(t)) + 1j * rng.normal(0.0, 0.01, len(t)))
    seen = [(s, float(i), z.real, z.imag, 0.0) for s, i, z in zip(t, which, away, strict=True)][::every]
    places = {i: map_of(np.array([bx, by, 0.0])) for i, (bx, by) in enumerate(BEACONS.tolist())}
    landmarks = LandmarkMap({i: Landmark(i, place, np.eye(3), 0.0) for i, place in places.items()})
    return Signals(motion=motion, seen=seen), Config(), None, None, landmarks


@pytest.mark.parametrize(
    ("mistake", "code", "yaw"),
    [
        ({"map_of": lambda place: place * [1.0, -1.0, 1.0]}, "map.mirrored", None),
        ({"seen_as": np.conj}, "sightings.mirrored", 0.0),
        ({"seen_as": lambda away: 1j * away}, "sightings.mounting", -0.5 * math.pi),
        ({"seen_as": lambda away: -away}, "sightings.mounting", math.pi),
        ({"turns": -1.0}, "wheels.sign", None),
    ],
)
def test_mirror_images_and_a_turned_sensor_are_named_where_the_wheels_alone_tell_nothing(
    monkeypatch, mistake, code, yaw
):
    monkeypatch.setattr("fgloc.diagnosis.landmarks.fit_sightings", lambda *_, **__: {})
    (found,) = [
        f
        for f in conventions(*one_at_a_time(**mistake)).findings
        if f.code.startswith(("map.", "sightings.", "wheels."))
    ]
    assert (found.code, found.severity) == (code, Severity.ERROR)
    if yaw is not None:
        last = float(found.lines["recording.sightings_pose"].strip("[]").split(",")[-1])
        assert math.cos(last - yaw) == pytest.approx(1.0, abs=1e-3)


def test_a_map_none_of_whose_landmarks_is_seen_from_a_known_way_says_nothing():
    signals, *others = one_at_a_time(every=150)
    assert not [f for f in conventions(signals, *others).findings if f.code.startswith(("map.", "sightings."))]


@pytest.mark.parametrize(
    ("factor", "scale"), [(1.0, None), (1.6, None), (100.0, "0.01"), (1.0 / FOOT, None), (10.0, "0.1")]
)
def test_the_unit_of_a_map_is_named_where_one_landmark_is_in_view_at_a_time(factor, scale):
    found = conventions(*one_at_a_time(map_of=lambda place: factor * place)).findings
    named = [(f.code, f.severity, f.lines) for f in found if f.code.startswith("map.")]
    assert named == ([] if scale is None else [("map.unit", Severity.ERROR, {"map.scale": scale})])


@pytest.mark.parametrize(("yaw", "is_named"), [(0.0, False), (3.0, True), (1.0, True)])
def test_a_first_pose_is_refuted_where_one_landmark_is_in_view_at_a_time(yaw, is_named):
    """The first comes after a while, and what else is found of the truth does not matter."""
    some = (TIMES > 6.0) & (np.arange(len(TIMES)) % 20 == 0)
    motion = [odometry(s, twist=(v, w)) for s, v, w in zip(TIMES[::20], SPEED[::20], RATE[::20], strict=True)]
    t = TIMES[some]
    which = (t / 12.0).astype(int)
    away = (BEACONS[which] - np.column_stack([X[some], Y[some]])) @ [1.0, 1j] * np.exp(-1j * YAW[some])
    seen = [(s, float(i), z.real, z.imag, 0.0) for s, i, z in zip(t, which, away, strict=True)]
    landmarks = {i: Landmark(i, np.array([*place, 0.0]), np.eye(3), 0.0) for i, place in enumerate(BEACONS.tolist())}
    config = config_of({"estimator": {"initial_pose": [0.0, 0.0, yaw]}})
    found = conventions(Signals(motion=motion, seen=seen), config, landmark_map=LandmarkMap(landmarks))
    assert ("frame.first_pose" in found.codes) == is_named
    assert not is_named or found.config.estimator.initial_pose is None  # it is not used


def test_a_map_that_is_a_little_too_large_has_a_constant_and_no_unit(tmp_path):
    assert not [f for f in conventions_of(record(tmp_path, Broken(map=1.08)), Config()) if f.code.startswith("map.")]


@pytest.mark.parametrize(("factor", "scale"), [(926.0, "0.001"), (108.0, "0.01"), (3.0, "0.3048"), (37.0, "0.0254")])
def test_a_map_in_another_unit_keeps_it_where_the_rest_is_off_too(tmp_path, factor, scale):
    (found,) = [f for f in conventions_of(record(tmp_path, Broken(map=factor)), Config()) if f.code == "map.unit"]
    assert found.lines == {"map.scale": scale}


def test_a_range_bias_in_another_unit_than_the_ranges_hides_no_unit(tmp_path):
    config = Config.model_validate({"landmarks": {"range_bias_m": 0.08}})
    found = conventions_of(record(tmp_path, Broken(range=0.001)), config)
    assert found[0].code == "sightings.scale"
    assert found[0].value == pytest.approx(1000.0, rel=0.05)


WRITTEN = replace(Broken(), bearing=-1.0, imu_unit=180.0 / math.pi, truth="ned", map=1.0 / FOOT)


def test_what_init_writes_undoes_what_is_broken(tmp_path):
    bag = record(tmp_path, WRITTEN)
    made = first_settings(bag)
    assert {"sightings.mirrored", "imu.unit", "truth.axes", "map.unit"} <= {f.code for f in made.found}
    assert not conventions_of(bag, config_of_file(yaml.safe_load(made.text)))


@pytest.mark.parametrize(
    ("late", "codes"),
    [(lambda t: 0.3, {"clock.imu"}), (lambda t: 0.005 * t, {"clock.drift"})],
    ids=["late", "drifting"],
)
def test_a_clock_that_drifts_is_not_late(late, codes):
    t, some = TIMES[::10], slice(None, None, 10)
    signals = Signals(
        motion=[odometry(s, twist=(v, w)) for s, v, w in zip(t, SPEED[some], RATE[some], strict=True)],
        imu=[(s + late(s), 0.0, 0.0, w, 0.0, 0.0, 9.81) for s, w in zip(t, RATE[some], strict=True)],
    )
    assert conventions(signals, Config()).codes == codes


@pytest.mark.parametrize(
    ("factor", "late_s", "codes"),
    [
        (1.0, 0.0, set()),
        (-1.0, 0.0, {"odometry.yaw_sign"}),
        (1.0, 0.4, {"odometry.twist_late"}),
        (180.0 / math.pi, 0.0, {"odometry.yaw_unit"}),
    ],
    ids=["sound", "sign", "late", "degrees"],
)
def test_a_yaw_rate_is_compared_with_the_odometrys_own_yaw(factor, late_s, codes):
    rates = factor * RATE[np.maximum(np.arange(len(TIMES)) - round(late_s / STEP_S), 0)]
    rows = list(zip(*(c[::10].tolist() for c in (TIMES, X, Y, YAW, SPEED, 0.0 * SPEED, rates)), strict=True))
    motion = [odometry(t, (x, y, yaw), (v, w)) for t, x, y, yaw, v, _, w in rows]
    found = Conventions(Config(), Signals(motion=motion, odometry=rows))
    check_odometry(found)
    assert found.codes == codes


@pytest.mark.parametrize("unit", [1.0 / 3.6, 0.01, FOOT], ids=["km/h", "cm/s", "feet per second"])
def test_speeds_in_another_unit_than_the_pose_get_the_units_factor(unit):
    rows = list(zip(*(c[::10].tolist() for c in (TIMES, X, Y, YAW, SPEED / unit, 0.0 * SPEED, RATE)), strict=True))
    motion = [odometry(t, (x, y, yaw), (v, w)) for t, x, y, yaw, v, _, w in rows]
    found = Conventions(config_of({"wheels": {"source": "twist"}}), Signals(motion=motion, odometry=rows))
    check_odometry(found)
    (told,) = found.findings
    assert told.code == "odometry.twist_unit"
    assert float(told.lines["wheels.scale_v"]) == pytest.approx(unit, abs=1e-6)


@pytest.mark.slow
def test_ranges_that_are_said_to_be_depths_and_are_not_are_named(tmp_path):
    bag = record(tmp_path, Broken())
    config = config_of({"landmarks": {"range_along_axis": True}})
    assert conventions_of(bag, config)[0].lines == {"expert.landmarks.range_along_axis": "false"}
    depths = record(tmp_path / "depths", Broken(depth=True))
    assert not conventions_of(depths, config)


def test_a_truth_tells_its_tilt_and_a_yaw_that_is_not_its_own(tmp_path):
    found = {f.code: f for f in inspect_all(record(tmp_path, Broken(truth="tilted")), None, Config()).found}
    assert found["truth.tilt"].value == pytest.approx(3.0, abs=0.1)
    assert found["truth.yaw_is_odometry"].severity is Severity.NOTE
    level = {f.code for f in inspect_all(record(tmp_path / "turned", Broken(turn=0.5)), None, Config()).found}
    assert not level & {"truth.tilt", "truth.yaw_is_odometry"}


@pytest.mark.parametrize(
    ("kind", "code"), [("upright", "truth.axes"), ("jumping", "truth.jumps"), ("still", "truth.frozen")]
)
def test_a_truth_that_no_robot_can_have_is_named(tmp_path, kind, code):
    found = inspect_all(record(tmp_path, Broken(truth=kind)), tmp_path / "map.yaml", Config()).found
    assert code in {f.code for f in found}
    sound = inspect_all(record(tmp_path / "sound", Broken()), tmp_path / "sound/map.yaml", Config()).found
    assert not {f.code for f in sound} & {"truth.axes", "truth.jumps", "truth.frozen"}


@pytest.mark.parametrize(("jump_mm", "is_named"), [(0.0, False), (1500.0, True)])
def test_glitches_of_a_truth_in_millimetres_are_no_jumps(jump_mm, is_named):
    t = np.arange(0.0, 30.0, 0.01)
    x, still = 0.2 * t, np.zeros(len(t))
    glitches = 30.0 * (np.random.default_rng(3).random(len(t)) < 0.02)
    places = 1e3 * x + glitches + jump_mm * (t > 15.0)
    signals = Signals(truth=list(zip(t, places, still, still, still, still, still, still + 1.0, strict=True)))
    found = Conventions(Config(), signals)
    true_body(found, Odometry(t, np.column_stack([x, still, still]), np.zeros(len(t), dtype=np.int64), "odometry"))
    assert ("truth.jumps" in found.codes) == is_named


@pytest.mark.parametrize(("rate", "is_named"), [(0.3, True), (0.01, False)])
def test_a_yaw_that_hardly_changes_is_not_said_to_be_the_odometrys(rate, is_named):
    t = np.arange(0.0, 30.0, 0.1)
    x, still, yaw = 0.2 * t, np.zeros(len(t)), rate * t
    quaternion = (still, still, np.sin(0.5 * yaw), np.cos(0.5 * yaw))
    signals = Signals(
        truth=list(zip(t, x, still, still, *quaternion, strict=True)),
        odometry=list(zip(t, x, still, yaw, still + 0.2, still, still + rate, strict=True)),
    )
    found = Conventions(Config(), signals)
    true_body(found, Odometry(t, np.column_stack([x, still, yaw]), np.zeros(len(t), dtype=np.int64), "odometry"))
    assert ("truth.yaw_is_odometry" in found.codes) == is_named


@pytest.mark.parametrize(("degrees", "is_named"), [(0.5, False), (1.5, True)])
def test_a_truth_that_is_tilted_by_less_than_a_degree_is_level(degrees, is_named):
    some = slice(None, None, 10)
    t, x, y, yaw = TIMES[some], X[some], Y[some], YAW[some]
    still = np.zeros(len(t))
    height = math.tan(math.radians(degrees)) * x
    rows = list(zip(t, x, y, height, still, still, np.sin(0.5 * yaw), np.cos(0.5 * yaw), strict=True))
    found = Conventions(Config(), Signals(truth=rows))
    true_body(found, Odometry(t, np.column_stack([x, y, yaw]), np.zeros(len(t), dtype=np.int64), "odometry"))
    assert ("truth.tilt" in found.codes) == is_named


@pytest.mark.parametrize(("share", "late", "is_named"), [(0.9, 0.2, True), (0.4, 0.2, False), (0.9, 0.02, False)])
def test_a_truth_tells_its_clock_only_where_its_yaw_follows_the_wheels(share, late, is_named):
    as_is, none = Figure(1.0, 0.001), Figure(0.0, 0.001)
    found = Conventions(Config(), Signals())
    check_body(found, BodyFit(False, as_is, as_is, none, none, none, Figure(late, 0.001), 0.01, share))
    assert found.codes == ({"clock.truth"} if is_named else set())


@pytest.mark.parametrize(("scale", "severity"), [(1.02, None), (1.06, Severity.WARNING), (1.12, Severity.ERROR)])
def test_a_truth_that_finds_wheels_beyond_what_a_run_estimates_is_an_error(scale, severity):
    as_is, none = Figure(1.0, 0.001), Figure(0.0, 0.001)
    found = Conventions(config_of({"wheels": {"scale_sigma": 0.02}}), Signals())
    check_body(found, BodyFit(False, as_is, Figure(scale, 0.001), none, none, none, none, 0.01, 0.9))
    expected = [] if severity is None else [("wheels.scale", severity)]
    assert [(f.code, f.severity) for f in found.findings] == expected


def test_a_truth_tells_how_much_wheels_turn(tmp_path):
    config = config_of({"recording": {"topics": {"imu": "none", "sightings": "none"}}})
    found = [f for f in conventions_of(record(tmp_path, Broken(turn=0.5)), config) if f.code.startswith("wheels")]
    assert [f.code for f in found] == ["wheels.turn"]
    assert found[0].value == pytest.approx(2.0, abs=0.05)
    assert not found[0].lines  # a truth judges the wheels in sentences only
    assert found[0].severity is Severity.ERROR  # beyond what a run estimates

    wide = config_of(
        {"recording": {"topics": {"imu": "none", "sightings": "none"}}, "wheels": {"turn_scale_sigma": 0.5}}
    )
    assert [f.severity for f in conventions_of(tmp_path / "bag", wide) if f.code == "wheels.turn"] == [Severity.WARNING]


def test_wheels_that_turn_too_much_are_no_mounting_and_no_clock(tmp_path):
    bag = record(tmp_path, Broken(turn=1.15))
    config = config_of({"recording": {"topics": {"imu": "none", "truth": "none"}}})
    for map_path in (bag.parent / "map.yaml", None):
        codes = {f.code for f in inspect_all(bag, map_path, config).found}
        assert not codes & {"sightings.mounting", "clock.sightings", "clock.odometry"}


def test_a_twist_that_follows_its_pose_late_is_named(tmp_path):
    found = {f.code: f for f in inspect_all(record(tmp_path, Broken(twist_late=0.4)), None, Config()).found}
    assert found["odometry.twist_late"].value == pytest.approx(0.4, abs=0.05)
    assert found["odometry.twist_late"].severity is Severity.NOTE  # the pose is used


@pytest.mark.slow
def test_a_map_that_nothing_in_the_recording_sees_is_named_first(tmp_path):
    bag = record(tmp_path, Broken())
    config = config_of({"recording": {"topics": {"imu": "none", "sightings": "none"}}})
    found = run(bag, tmp_path / "map.yaml", config, "online").findings
    assert (found[0].code, found[0].severity) == ("map.unused", Severity.ERROR)
    assert "map.unused" not in {f.code for f in run(bag, None, config, "online").findings}
    assert "map.unused" not in {f.code for f in run(bag, tmp_path / "map.yaml", Config(), "online").findings}


def test_remarks_are_not_named_before_what_was_compared():
    compared = Finding("truth.tilt", "tilted")
    assert ordered([Finding("run", "a default"), compared, Finding("run", "bad", Severity.ERROR)])[1] is compared


def test_a_truth_that_freezes_and_topics_that_nothing_reads_are_named(tmp_path):
    bag = record(tmp_path, Broken(truth="frozen"))
    with BagWriter(tmp_path / "more") as more:
        for k in range(5):
            stamp = round((START_S + k) * 1e9)
            more.odometry("/odom", stamp, (0.1 * k, 0.0, 0.0), (0.1, 0.0))
            more.range_reading("/ranges", stamp, 2.0, "radio")
    frozen = [f for f in inspect_all(bag, tmp_path / "map.yaml", Config()).found if f.code == "truth.frozen"]
    assert frozen[0].value == pytest.approx(0.4, abs=0.1)
    found = inspect_all(tmp_path / "more", None, Config()).found
    unused = [f for f in found if f.code == "recording.unused"]
    assert [f.severity for f in unused] == [Severity.NOTE]
    assert "uwb.anchors" in unused[0].text
    assert "place.unbounded" in [f.code for f in found]  # a sensor that is not built bounds nothing


@pytest.mark.parametrize("optical", [True, False])
def test_an_optical_frame_is_named_also_where_two_markers_are_seen_for_a_few_seconds(tmp_path, optical):
    """So few determine no constant of their sensor; but in the axes of a body they would wander by a metre."""
    rng, beacons = np.random.default_rng(2), np.array([[4.5, 1.0, 0.4], [4.0, -0.8, 0.5]])
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(180):
            t = 0.05 * k
            x, stamp = 0.25 * t, round((START_S + t) * 1e9)
            bag.odometry("/odom", stamp, (x, 0.0, 0.0), (0.25, 0.0, 0.0), stamp)
            if k % 2 == 0:
                points = beacons - [x, 0.0, 0.3] + rng.normal(0.0, 0.01, beacons.shape)
                if optical:
                    points = np.column_stack([-points[:, 1], -points[:, 2], points[:, 0]])
                seen = [(i, point, (0.0, 0.0, 0.0, 1.0), None) for i, point in enumerate(points.tolist())]
                bag.marker_poses("/markers", stamp, seen, stamp, "base_link")
    lines = {k: v for f in first_settings(tmp_path / "bag").found for k, v in f.lines.items()}
    assert lines.get("recording.sightings_axes") == ("optical" if optical else None)
    assert "recording.sightings_pose" not in lines
