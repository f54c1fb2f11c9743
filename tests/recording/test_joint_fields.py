"""Wheels whose angles and rates are fields of messages of any type, on one topic or several."""

import math

import numpy as np
import pytest
import yaml
from command_line import fgloc
from recording_bags import COUNTS, OWN, PER_TICK, SIDES, START_NS, ticks, two_topics, write_messages
from refusal import refusal

from fgloc import run
from fgloc.config import Config, RecordingConfig, load_config
from fgloc.errors import ConfigError, RecordingError
from fgloc.recording.reader import open_recording

ARRAY, POINT = "std_msgs/msg/Float32MultiArray", "geometry_msgs/msg/PointStamped"


def sections(joints, **more):
    return {"recording": {"joints": joints}, **more}


WHEELS = {"left_joint": "left", "right_joint": "right", "left_radius": 0.05, "right_radius": 0.05, "track": 0.3}


def test_counters_on_two_topics_are_put_together_at_one_time(tmp_path):
    config = RecordingConfig.model_validate({"joints": SIDES})
    with open_recording(two_topics(tmp_path / "bag"), config) as recording:
        first, again = [*recording.events()], [*recording.events()]
        assert recording.roles["joints"] == "/left"
    assert len(first) > 390
    assert [e.stamp_ns for e in again] == [e.stamp_ns for e in first]
    stamps = np.array([e.stamp_ns for e in first])
    angles = np.array([e.position for e in first])
    assert {e.names for e in first} == {("left", "right")}
    assert (np.diff(stamps) > 0).all()
    t = (stamps - stamps[0]) * 1e-9
    np.testing.assert_allclose(angles[:, 0] - angles[0, 0], 5.0 * t, atol=2 * PER_TICK)  # through the roll-over
    np.testing.assert_allclose(angles[:, 1] - angles[0, 1], 6.0 * t, atol=2 * PER_TICK)
    assert all(e.received_ns >= e.stamp_ns for e in first)


@pytest.mark.parametrize("mode", ["online", "batch"])
def test_a_run_drives_by_them(tmp_path, mode):
    config = Config.model_validate(sections(SIDES, wheels=WHEELS))
    result = run(two_topics(tmp_path / "bag"), None, config, mode=mode)
    turned = (0.05 * 6.0 - 0.05 * 5.0) / 0.3 * 9.9
    radius = 0.5 * 0.05 * 11.0 / (0.05 / 0.3)
    begin, end = result.trajectory.poses[[0, -1]]
    assert math.remainder(end[2] - begin[2] - turned, math.tau) == pytest.approx(0.0, abs=0.03)
    chord = 2.0 * radius * abs(math.sin(0.5 * turned))
    assert math.hypot(*(end - begin)[:2]) == pytest.approx(chord, rel=0.02)


def test_a_silent_side_makes_no_events_and_the_other_is_not_lost(tmp_path):
    path = two_topics(tmp_path / "all")
    config = RecordingConfig.model_validate({"joints": SIDES})
    messages = [
        *(("/left", COUNTS, START_NS + k * 50_000_000, {"data": ticks(0.05 * k, 5.0)}) for k in range(200)),
        *(
            ("/right", COUNTS, START_NS + k * 50_000_000, {"data": ticks(0.05 * k, -6.0)})
            for k in range(200)
            if not 50 < k < 100
        ),
    ]
    with (
        open_recording(path, config) as one,
        open_recording(write_messages(tmp_path / "gap", messages), config) as other,
    ):
        whole, gapped = len([*one.events()]), [*other.events()]
    assert whole > 390
    assert len(gapped) == 151  # equal stamps make one event
    after = gapped[51]
    assert after.position[0] - gapped[50].position[0] == pytest.approx(5.0 * 2.5, abs=3 * PER_TICK)
    assert after.position[1] - gapped[50].position[1] == pytest.approx(6.0 * 2.5, abs=3 * PER_TICK)


def test_entries_of_an_array_and_fields_of_an_own_message(tmp_path):
    messages = [("/wheels", ARRAY, START_NS + k * 50_000_000, {"data": [0.1 * k, 0.2 * k, 7.0]}) for k in range(10)]
    own = "int16 left_rpm\nint16 right_rpm\nstring note\n"
    messages += [
        (
            "/own",
            OWN,
            START_NS + k * 50_000_000,
            b"\0\1\0\0" + np.array([60, -30], np.int16).tobytes() + b"\1\0\0\0\0\0\0\0",
        )
        for k in range(10)
    ]
    path = write_messages(tmp_path / "bag", messages, own)
    of_array = {
        "l": {"topic": "/wheels", "position": "data[0]"},
        "r": {"topic": "/wheels", "position": "data[1]", "offset": 1.0},
    }
    with open_recording(path, RecordingConfig.model_validate({"joints": of_array})) as recording:
        events = [*recording.events()]
    assert [e.position.tolist() for e in events] == [
        pytest.approx([0.1 * k, 0.2 * k + 1.0], abs=1e-6) for k in range(10)
    ]
    assert all(len(e.velocity) == 0 for e in events)
    per_rpm = math.tau / 60.0
    of_own = {
        "l": {"topic": "/own", "velocity": "left_rpm", "scale": per_rpm},
        "r": {"topic": "/own", "velocity": "right_rpm", "scale": per_rpm},
    }
    with open_recording(path, RecordingConfig.model_validate({"joints": of_own})) as recording:
        events = [*recording.events()]
    assert len(events) == 10
    np.testing.assert_allclose(events[0].velocity, [math.tau, -0.5 * math.tau])


def test_speed_and_steering_of_a_car(tmp_path):
    """A drive reads them as it reads joints; stamps are those of the header."""
    messages = []
    for k in range(200):
        at_ns = START_NS + k * 50_000_000
        header = {"stamp": {"sec": at_ns // 10**9, "nanosec": at_ns % 10**9}}
        point = {"x": 10.0, "y": 7.2, "z": 0.0}  # degrees at the steering wheel, km/h
        messages.append(("/speedsteer", POINT, at_ns + 3_000_000, {"header": header, "point": point}))
    joints = {
        "speed": {"topic": "/speedsteer", "velocity": "point.y", "scale": 1 / 3.6},
        "steering_angle": {"topic": "/speedsteer", "position": "point.x", "scale": math.radians(0.5)},
    }
    config = Config.model_validate(sections(joints, wheels={"drive": {"kind": "ackermann", "wheelbase": 2.0}}))
    path = write_messages(tmp_path / "bag", messages)
    with open_recording(path, config.recording) as recording:
        assert next(recording.events()).stamp_ns == START_NS
    trajectory = run(path, None, config, mode="online").trajectory
    turned = np.unwrap(trajectory.poses[:, 2])
    rate = 2.0 * math.tan(math.radians(5.0)) / 2.0
    assert (turned[-1] - turned[0]) / 9.95 == pytest.approx(rate, rel=0.03)


@pytest.mark.parametrize(
    ("joints", "facts"),
    [
        ({"l": {"topic": "/left", "position": "point.x"}}, ("recording.joints.l.position", "/left", COUNTS, "data")),
        ({"l": {"topic": "/lefft", "position": "data"}}, ("recording.joints", "/lefft")),
    ],
)
def test_a_field_or_topic_that_is_not_there_is_named(tmp_path, joints, facts):
    with refusal(RecordingError, *facts):
        open_recording(two_topics(tmp_path / "bag", 1.0), RecordingConfig.model_validate({"joints": joints}))


@pytest.mark.parametrize(
    ("recording", "facts"),
    [
        ({"joints": {"l": {"topic": "/l"}}}, ("recording.joints.l", "position", "velocity")),
        ({"joints": {"l": {"topic": "/l", "position": "data", "scale": 0}}}, ("recording.joints.l", "scale")),
        ({"joints": {"l": {"topic": "/l", "position": "a..b"}}}, ("recording.joints.l.position", "a..b")),
        (
            {"joints": {"l": {"topic": "/l", "position": "data"}}, "topics": {"joints": "/joint_states"}},
            ("topics.joints", "/joint_states"),
        ),
    ],
)
def test_what_cannot_be_is_refused_by_its_key(tmp_path, recording, facts):
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump({"recording": recording}))
    with refusal(ConfigError, *facts):
        load_config(tmp_path / "robot.yaml")


def test_no_topic_has_another_role_too(tmp_path):
    twist = "geometry_msgs/msg/TwistStamped"
    messages = []
    for k in range(100):
        at_ns = START_NS + k * 50_000_000
        header = {"stamp": {"sec": at_ns // 10**9, "nanosec": at_ns % 10**9}}
        for side, rate in (("left", 2.0), ("right", 3.0)):
            values = {"header": header, "twist": {"linear": {"x": rate}}}
            messages.append((f"/{side}_wheel", twist, at_ns + 1_000_000, values))
    joints = {s: {"topic": f"/{s}_wheel", "velocity": "twist.linear.x"} for s in ("left", "right")}
    path = write_messages(tmp_path / "bag", messages)
    late = RecordingConfig.model_validate({"joints": joints, "stamp_offset_s": {"joints": 0.5}})
    with open_recording(path, late) as recording:
        events = [*recording.events()]
        assert dict(recording.roles) == {"joints": "/left_wheel"}
    assert len(events) == 100
    assert events[0].stamp_ns == START_NS + 500_000_000
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(sections(joints, wheels=WHEELS)))
    code, _, _ = fgloc("info", path, "--config", tmp_path / "robot.yaml")
    assert code == 0
    both = {"joints": joints, "topics": {"command": "/right_wheel"}}
    with refusal(RecordingError, "recording.topics.command", "/right_wheel", "recording.joints"):
        open_recording(path, RecordingConfig.model_validate(both))


def test_joints_are_switched_off_as_any_role(tmp_path):
    off = RecordingConfig.model_validate({"joints": SIDES, "topics": {"joints": "none"}})
    with open_recording(two_topics(tmp_path / "bag", 2.0), off) as recording:
        assert not [*recording.events()]
        assert "joints" not in recording.roles


def test_stamps_without_a_common_time_and_an_array_that_is_too_short_are_told(tmp_path):
    header = {"stamp": {"sec": 5, "nanosec": 0}}
    messages = [
        *(("/left", COUNTS, START_NS + k * 50_000_000, {"data": k}) for k in range(50)),
        *(("/right", POINT, START_NS + k * 50_000_000, {"header": header, "point": {"x": 1.0 * k}}) for k in range(50)),
    ]
    sides = {"left": {"topic": "/left", "position": "data"}, "right": {"topic": "/right", "position": "point.x"}}
    path = write_messages(tmp_path / "apart", messages)
    with open_recording(path, RecordingConfig.model_validate({"joints": sides})) as recording:
        assert not [*recording.events()]
        assert any("recording.received_stamps" in note and "/right" in note for note in recording.notes)
    received = RecordingConfig.model_validate({"joints": sides, "received_stamps": ["joints"]})
    with open_recording(path, received) as recording:
        assert len([*recording.events()]) == 50
    short = [("/wheels", ARRAY, START_NS + k * 50_000_000, {"data": [0.1 * k]}) for k in range(30)]
    joints = {"l": {"topic": "/wheels", "position": "data[0]"}, "r": {"topic": "/wheels", "position": "data[1]"}}
    path = write_messages(tmp_path / "short", short)
    with open_recording(path, RecordingConfig.model_validate({"joints": joints})) as recording:
        assert not [*recording.events()]
        assert any("recording.joints.r" in note and "data[1]" in note for note in recording.notes)


def test_init_lists_the_numbers_that_may_be_of_wheels(tmp_path):
    bag = two_topics(tmp_path / "bag")
    code, _, _ = fgloc("init", bag, "--out", tmp_path / "robot.yaml")
    assert code == 1  # nothing is filled in yet
    written = (tmp_path / "robot.yaml").read_text()
    assert "topic: /left, position: data" in written
    assert "topic: /right, position: data" in written
