"""Wheels, odometries, ranges and sightings in messages of types that fgloc does not know: what `fgloc init` writes."""

import math
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from recording_bags import OWN, START_NS
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

from fgloc import run
from fgloc.calibration.first_fields import find_joints, find_roles
from fgloc.calibration.first_settings import first_settings
from fgloc.config import GateConfig, RecordingConfig, RoleFields, config_of_file
from fgloc.intake.validation import EventValidator
from fgloc.recording.fields import NumericField, entries_at, events_of_role, numeric_fields, unread_numbers
from fgloc.recording.reader import Recording
from fgloc.recording.storage import Storage
from fgloc.sensors.uwb import check
from fgloc_datasets.bag import BagWriter

WHEN = (START_NS, START_NS, "/topic")


def numbers(*rows):
    return [NumericField(*row) for row in rows]


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (
            [("/m", "leftRpm", "float32", 0, 90), ("/m", "rightRpm", "float32", 0, 95)],
            {"left": (None, "leftRpm", math.tau / 60, None), "right": (None, "rightRpm", math.tau / 60, None)},
        ),
        (  # Kobuki: counters of 16 bits among pulse widths and bumpers
            [
                ("/core", "left_encoder", "uint16", 0, 65535),
                ("/core", "right_encoder", "uint16", 0, 65535),
                ("/core", "left_pwm", "int8", -20, 30),
                ("/core", "right_pwm", "int8", -20, 30),
            ],
            {"left": ("left_encoder", None, 1.0, 65536.0), "right": ("right_encoder", None, 1.0, 65536.0)},
        ),
        (  # Duckietown: one topic a wheel, with the counts of a turn beside
            [
                ("/duckie/left_wheel_encoder_node/tick", "data", "int32", 0, 900),
                ("/duckie/left_wheel_encoder_node/tick", "resolution", "int32", 135, 135),
                ("/duckie/right_wheel_encoder_node/tick", "data", "int32", 0, 950),
                ("/duckie/right_wheel_encoder_node/tick", "resolution", "int32", 135, 135),
            ],
            dict.fromkeys(("left", "right"), ("data", None, math.tau / 135, 2.0**32)),
        ),
        (  # angles before rates
            [
                ("/wheel_vels", "velocity_left", "float32", 0, 9),
                ("/wheel_vels", "velocity_right", "float32", 0, 9),
                ("/wheel_ticks", "ticks_left", "int32", 0, 900),
                ("/wheel_ticks", "ticks_right", "int32", 0, 900),
            ],
            {s: (f"ticks_{s}", None, 1.0, 2.0**32) for s in ("left", "right")},
        ),
        (
            [("/lwheel", "data", "int16", -9, 900), ("/rwheel", "data", "int16", -9, 900)],
            dict.fromkeys(("left", "right"), ("data", None, 1.0, 65536.0)),
        ),
        (  # two drivers without names
            [("/f", f"drivers[{k}].{n}", "float32", 0, 9) for k in (0, 1) for n in ("current", "measured_travel")],
            {s: (f"drivers[{k}].measured_travel", None, 1.0, None) for k, s in enumerate(("left", "right"))},
        ),
        (
            [("/car", "speed", "float64", 0, 4), ("/car", "steering_angle", "float64", -25, 25)],
            {"speed": (None, "speed", 1.0, None), "steering_angle": ("steering_angle", None, math.pi / 180, None)},
        ),
        ([("/bumper", "left_wheel_drop", "uint8", 0, 1), ("/bumper", "right_wheel_drop", "uint8", 0, 1)], {}),
        ([("/w", "left_ticks", "int32", 5, 5), ("/w", "right_ticks", "int32", 5, 5)], {}),  # never moved
        ([("/w", "left_arm", "float32", 0, 1), ("/w", "right_arm", "float32", 0, 1)], {}),
        ([("/battery", "voltage", "float32", 11, 12)], {}),
        ([("/battery", f"cell_rate[{k}]", "float32", 3, 4) for k in (0, 1)], {}),
        ([("/gps", f"position[{k}]", "float64", -1, 4) for k in (0, 1)], {}),
        ([("/motors", f"rpm[{k}]", "float32", 0, 9) for k in range(4)], {}),  # which are left is not known
        (  # parts of other words: imu, led, range
            [("/simulator/controlled_orange", f"{s}_ticks", "int32", 0, 900) for s in ("left", "right")],
            {s: (f"{s}_ticks", None, 1.0, 2.0**32) for s in ("left", "right")},
        ),
    ],
)
def test_names_of_fields_tell_the_wheels(rows, expected):
    found = find_joints(numbers(*rows))
    assert found.keys() == expected.keys()
    for name, (position, velocity, scale, rolls_over) in expected.items():
        joint = found[name]
        assert (joint.position, joint.velocity, joint.rolls_over) == (position, velocity, rolls_over)
        assert joint.scale == pytest.approx(scale, rel=1e-5)


@pytest.mark.parametrize(
    ("topic", "kinds", "role", "expected"),
    [
        ("/scout_status", {"linear_velocity": "float64", "angular_velocity": "float64", "soc": "float64"}, "odometry",
         {"forward": "linear_velocity", "turn": "angular_velocity"}),
        ("/nlink", {"id": "uint8", "local_time": "uint32", "nodes[].role": "uint8", "nodes[].id": "uint8",
                    "nodes[].dis": "float32", "uwb": "uint8"}, "uwb", {"id": "nodes[].id", "range": "nodes[].dis"}),
        ("/gtec/toa/ranging", {"anchorId": "int32", "tagId": "int32", "range": "int32", "seq": "int32"}, "uwb",
         {"id": "anchorId", "range": "range"}),
        ("/uwb", {"anchor_ids[]": "uint16", "distances[]": "float32"}, "uwb",
         {"id": "anchor_ids[]", "range": "distances[]"}),
        ("/landmark", {"max_sensor_distance": "float64", "sensed_data[].range": "float64",
                       "sensed_data[].yaw": "float64", "sensed_data[].id": "int32"}, "sightings",
         {"id": "sensed_data[].id", "range": "sensed_data[].range", "bearing": "sensed_data[].yaw"}),
        ("/stag", {"tags[].id": "uint32", "tags[].pose.position.x": "float64", "tags[].pose.orientation.w": "float64"},
         "sightings", {"id": "tags[].id", "pose": "tags[].pose"}),
    ],
)  # fmt: skip
def test_names_of_fields_tell_other_roles(topic, kinds, role, expected):
    assert find_roles({topic: kinds}, set()) == {role: RoleFields(topic=topic, **expected)}
    busy = {"odometry"} if role == "odometry" else {"sightings", "uwb"}
    assert find_roles({topic: kinds}, busy) == {}


@pytest.mark.parametrize(
    ("topic", "kinds"),
    [
        ("/sonar", {"sonar_id": "uint8", "distance": "float32"}),  # no radio
        ("/people", {"people[].id": "int32", "people[].pose.position.x": "float64"}),  # they walk
        ("/target_speed", {"linear_velocity": "float64", "angular_velocity": "float64"}),
        ("/base_cmd", {"linear_x": "float32", "angular_z": "float32"}),
        ("/controller", {"desired.linear.x": "float64", "desired.angular.z": "float64"}),
        ("/arm/tool", {"linear.x": "float64", "angular.z": "float64"}),
    ],
)
def test_what_only_looks_like_it_is_left_alone(topic, kinds):
    assert find_roles({topic: kinds}, set()) == {}


def test_a_number_that_is_none_at_first_is_found_all_the_same(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag._store.register(get_types_from_msg("float32 left_rpm\nfloat32 right_rpm\n", OWN))
        for k, rpm in enumerate((math.nan, 1.0, 2.0, math.inf)):
            bag.write("/core", OWN, bag.make(OWN, left_rpm=rpm, right_rpm=-rpm), START_NS + k)
    with closing(Storage(tmp_path / "bag")) as storage:
        found = [(n.path, n.low, n.high) for n in unread_numbers(storage, (), ())]
    assert found == [("left_rpm", 1.0, 2.0), ("right_rpm", -2.0, -1.0)]


def _ranges(path):
    with BagWriter(path) as bag:
        bag._store.register(get_types_from_msg("uint32 stamp\nuint8 anchor_id\nfloat32 range\n", OWN))
        for k in range(3):
            bag.write("/uwb", OWN, bag.make(OWN, stamp=k, anchor_id=4, range=2.0), START_NS + k)
    return path


def test_a_field_of_a_role_that_is_not_there_is_named_with_those_that_are(tmp_path):
    fields = {"uwb": {"topic": "/uwb", "id": "anchor", "range": "range"}}
    with Recording(_ranges(tmp_path / "bag"), RecordingConfig.model_validate({"fields": fields})) as recording:
        (problem,) = recording.problems
    assert problem.startswith("recording.fields.uwb.id: /uwb (own_msgs/msg/Wheels) has no number anchor, expected one")
    assert problem.endswith("stamp, anchor_id, range")


def test_a_stamp_that_is_a_number_is_no_time(tmp_path):
    fields = {"uwb": {"topic": "/uwb", "id": "anchor_id", "range": "range"}}
    with Recording(_ranges(tmp_path / "bag"), RecordingConfig.model_validate({"fields": fields})) as recording:
        assert [event.stamp_ns for event in recording.events()] == [START_NS, START_NS + 1, START_NS + 2]


def test_messages_in_messages_in_messages_do_not_take_forever():
    inner = {f"p/msg/T{d}": ([], [(f"f{i}", (Nodetype.NAME, f"p/msg/T{d + 1}")) for i in range(20)]) for d in range(7)}
    for last in ([("x", (Nodetype.BASE, ("float64", 0)))], [("x", (Nodetype.BASE, ("string", 0)))], []):
        assert len([*numeric_fields("p/msg/T0", {**inner, "p/msg/T7": ([], last)})]) < 10_000


def test_a_message_of_ranges_makes_an_event_of_each():
    nodes = [SimpleNamespace(id=i, dis=r) for i, r in ((3, 2.5), (7, 4.0))]
    message = SimpleNamespace(nodes=nodes)
    fields = RoleFields(topic="/nlink", id="nodes[].id", range="nodes[].dis")
    events = events_of_role("uwb", fields, message, WHEN)
    assert [(e.anchor, e.range_m) for e in events] == [(3, 2.5), (7, 4.0)]
    gate = EventValidator(GateConfig())
    assert [gate.check(event) for event in events] == events  # of one stamp, and none a duplicate
    arrays = SimpleNamespace(ids=np.array([3, 7], np.uint16), ranges=np.array([2.5], np.float32))
    with pytest.raises(ValueError, match="shorter"):
        events_of_role("uwb", RoleFields(topic="/a", id="ids[]", range="ranges[]"), arrays, WHEN)
    assert entries_at(arrays, "ids[]") == [3, 7]
    assert entries_at(message, "nodes[1].dis") == [4.0]


def test_a_range_of_zero_is_none():
    silent = events_of_role("uwb", RoleFields(topic="/a", id="i", range="r"), SimpleNamespace(i=1, r=0.0), WHEN)
    assert check(silent[0], GateConfig()) == "range_bound"


def test_bearings_and_transforms_make_sightings():
    header = SimpleNamespace(frame_id="camera")
    seen = SimpleNamespace(header=header, z=[SimpleNamespace(id=4, range=2.0, yaw=0.5)])
    fields = RoleFields(topic="/a", id="z[].id", range="z[].range", bearing="z[].yaw")
    (event,) = events_of_role("sightings", fields, seen, WHEN)
    assert (event.frame_id, event.sightings[0].landmark_id, event.sightings[0].bearing_rad) == ("camera", 4, 0.5)
    moved, turned = SimpleNamespace(x=1.0, y=2.0, z=3.0), SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    tag = SimpleNamespace(tag_id=9, transform=SimpleNamespace(translation=moved, rotation=turned))
    fields = RoleFields(topic="/a", id="tags[].tag_id", pose="tags[].transform")
    (event,) = events_of_role("sightings", fields, SimpleNamespace(header=header, tags=[tag]), WHEN)
    assert event.sightings[0].landmark_id == 9
    assert event.sightings[0].position.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("role", "fields"),
    [
        ("uwb", {"id": "i"}),
        ("odometry", {"forward": "v"}),
        ("sightings", {"id": "i", "range": "r"}),
        ("sightings", {"pose": "p"}),
    ],
)
def test_a_role_that_lacks_a_field_is_refused(role, fields):
    with pytest.raises(ValueError, match="lacks"):
        RecordingConfig.model_validate({"fields": {role: {"topic": "/a", **fields}}})


# --- A recording of a robot that nobody described ---------------------------------------------------------------------

_TICKS, _TRACK, _SECONDS = 11724.0, 0.23, 60.0  # a metre, m, s


def _motion(step_s=0.02):
    """Times, speed, yaw rate and poses of a robot that winds about."""
    t = np.arange(0.0, _SECONDS, step_s)
    v, w = 0.3 * np.minimum(t / 2.0, 1.0), 0.5 * np.sin(0.3 * t) + 0.2
    yaw = np.cumsum(w) * step_s
    return t, v, w, np.cumsum(v * np.cos(yaw)) * step_s, np.cumsum(v * np.sin(yaw)) * step_s, yaw


def _stranger(path, backwards=False, landmarks=True):
    """A bag with counters of 16 bits in a message of an own type, a gyro, and ranges with bearings to ten landmarks."""
    t, v, w, x, y, yaw = _motion()
    left, right = (np.cumsum(v + s * 0.5 * _TRACK * w) * 0.02 * _TICKS for s in (-1, 1))
    right = -right if backwards else right
    rng = np.random.default_rng(1)
    with BagWriter(path) as bag:
        own = "uint16 left_encoder\nuint16 right_encoder\nint8 left_pwm\nint8 right_pwm\n"
        bag._store.register(get_types_from_msg(own, OWN))
        for k, (at, speed, turn) in enumerate(zip(t, v, w, strict=True)):
            at_ns = START_NS + round(at * 1e9)
            values = int(left[k] + 60000) % 65536, int(right[k] + 7) % 65536, int(40 * speed), int(41 * speed)
            names = ("left_encoder", "right_encoder", "left_pwm", "right_pwm")
            bag.write("/core", OWN, bag.make(OWN, **dict(zip(names, values, strict=True))), at_ns)
            bag.imu("/imu", at_ns, (0.0, 0.0, turn + rng.normal(0, 0.003)), (0.0, 0.0, 9.81))
            seen = []
            for i in range(10 if k % 5 == 0 and landmarks else 0):
                ahead, left_of = 3.0 * math.cos(i) - 1.0 - x[k], 3.0 * math.sin(i) - y[k]
                bearing = math.remainder(math.atan2(left_of, ahead) - yaw[k], math.tau)
                if abs(bearing) < 1.2:
                    seen.append((i, math.hypot(ahead, left_of) + rng.normal(0, 0.02), bearing + rng.normal(0, 0.01)))
            if seen:
                bag.range_bearing("/seen", at_ns, seen)
    return path


@pytest.mark.parametrize("backwards", [False, True])
def test_counters_of_an_unknown_robot_are_used_without_a_line_by_hand(tmp_path, backwards):
    bag = _stranger(tmp_path / "bag", backwards)
    made = first_settings(bag)
    config = config_of_file(yaml.safe_load(made.text))
    left, right = config.recording.joints["left"], config.recording.joints["right"]
    assert left.rolls_over == right.rolls_over == 65536
    assert left.scale == pytest.approx(1.0 / _TICKS, rel=0.02)
    assert right.scale == pytest.approx((-1.0 if backwards else 1.0) / _TICKS, rel=0.02)
    assert config.wheels.track == pytest.approx(_TRACK, rel=0.03)
    trajectory = run(bag, None, config, mode="batch").trajectory
    _, _, _, x, y, _ = _motion()
    way = math.hypot(*(trajectory.poses[-1] - trajectory.poses[0])[:2])
    assert way == pytest.approx(math.hypot(x[-1] - x[0], y[-1] - y[0]), abs=0.05)


def test_without_anything_that_shows_the_way_the_geometry_is_asked_for(tmp_path):
    made = first_settings(_stranger(tmp_path / "bag", landmarks=False))
    config = config_of_file(yaml.safe_load(made.text))
    assert {*config.recording.joints} == {"left", "right"}
    assert config.wheels.left_radius is None
    assert any("radii" in sentence or "geometry" in sentence for sentence in made.missing)


def _car(path, truth=True):
    """A bag of a car with a wheelbase of 0.33 m: speeds that are 1.25 times the true ones, steering to the right."""
    t, v, w, x, y, yaw = (values[: round(25.0 / 0.05)] for values in _motion(0.05))
    with BagWriter(path) as bag:
        bag._store.register(get_types_from_msg("float32 speed\nfloat32 steering_angle\n", OWN))
        for k, (at, speed, turn) in enumerate(zip(t, v, w, strict=True)):
            at_ns = START_NS + round(at * 1e9)
            steering = -math.atan2(turn * 0.33, speed) if speed > 0.0 else 0.0
            bag.write("/car", OWN, bag.make(OWN, speed=1.25 * speed, steering_angle=steering), at_ns)
            if truth:
                bag.planar_truth("/ground_truth", at_ns, (x[k], y[k], yaw[k]))
    return path


def test_a_car_whose_steering_counts_to_the_right_is_measured(tmp_path):
    config = config_of_file(yaml.safe_load(first_settings(_car(tmp_path / "bag")).text))
    joints = config.recording.joints
    assert (config.wheels.drive.kind, joints["steering_angle"].scale) == ("ackermann", -1.0)
    assert config.wheels.drive.wheelbase == pytest.approx(0.33, rel=0.05)
    assert joints["speed"].scale == pytest.approx(0.8, rel=0.03)


def test_wheels_that_nothing_can_refute_are_kept(tmp_path):
    found = yaml.safe_load(first_settings(_car(tmp_path / "bag", truth=False)).text)
    assert {*found["recording"]["joints"]} == {"speed", "steering_angle"}


def test_wheels_without_values_for_long_are_none(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag._store.register(get_types_from_msg("float32 speed\nfloat32 steering_angle\n", OWN))
        for k in range(100):
            speed, steering = 1.0 + 0.1 * math.sin(k) if k > 30 else math.nan, 0.3 * math.sin(0.05 * k)
            at_ns = START_NS + k * 50_000_000
            bag.write("/car", OWN, bag.make(OWN, speed=speed, steering_angle=steering), at_ns)
            bag.imu("/imu", at_ns, (0.0, 0.0, steering), (0.0, 0.0, 9.81))
    text = first_settings(tmp_path / "bag").text
    assert "joints" not in (yaml.safe_load(text).get("recording") or {})
    assert "velocity: speed" in text.partition("\n  # joints:")[2]  # for whoever knows better


def test_a_topic_plays_one_role():
    odometry = {"topic": "/a", "forward": "v", "turn": "w"}
    with pytest.raises(ValueError, match="one role for a topic"):
        RecordingConfig.model_validate(
            {"fields": {"odometry": odometry, "uwb": {"topic": "/a", "id": "i", "range": "r"}}}
        )
    with pytest.raises(ValueError, match="one role for a topic"):
        RecordingConfig.model_validate(
            {"joints": {"left": {"topic": "/a", "position": "l"}}, "fields": {"odometry": odometry}}
        )
    both = {"linear_velocity": "float64", "angular_velocity": "float64", "anchor_id": "uint8", "range": "float64"}
    found = find_roles({"/status": both}, set())
    assert len(found) == 1
