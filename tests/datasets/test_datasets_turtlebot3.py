"""TurtleBot3: a small recording like the real ones, and the real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_files import read_back
from real_data import real_data
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from fgloc.config import load_config
from fgloc.errors import MapError, RecordingError
from fgloc.recording.messages import default_typestore
from fgloc.recording.reader import open_recording
from fgloc.sensors.maps import load_map
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import ControlEvent
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.turtlebot3 import convert

_NAME = "rosbag2_2025_11_25-15_11_34"
_START_NS = 1_764_079_894_000_000_000


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "src" / _NAME
    with BagWriter(path, storage="sqlite3") as bag:
        twist = bag.make(
            "geometry_msgs/msg/Twist",
            linear=bag.make("geometry_msgs/msg/Vector3", x=0.1, y=0.0, z=0.0),
            angular=bag.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=-0.5),
        )
        for k in range(20):
            now = _START_NS + k * 50_000_000
            bag.odometry("/odom", now - 4_000_000, (0.01 * k, 0.0, 0.0), (0.1, -125.4 if k == 9 else 0.0), now)
            if k % 3 == 0:
                seen = [(1, 1.9, -0.48)] if k % 2 else []
                bag.range_bearing("/camera/landmarks", now - 170_000_000, seen, now)
            bag.write("/cmd_vel", "geometry_msgs/msg/Twist", twist, now)
    return path


def _list_landmarks(folder: Path, count: int = 3) -> Path:
    path = folder / "landmarks_2025_real.yaml"
    path.write_text(
        f"landmarks:\n  id: {list(range(count))}\n  x: [1.2, 1.68]\n  y: [1.68, -0.05]\n  z: [0.16, 0.18]\n"
    )
    return path


def test_messages_are_copied_byte_for_byte(source: Path, tmp_path: Path) -> None:
    before, after = read_back(source)[0], read_back(convert(source, tmp_path / "out"))[0]
    assert set(after) == {"/odom", "/cmd_vel", "/landmarks"}
    for topic, found in after.items():
        original = before["/camera/landmarks" if topic == "/landmarks" else topic]
        assert [repr(m) for _, m in found] == [repr(m) for _, m in original]
        assert [when for when, _ in found] == [when for when, _ in original]
    assert after["/odom"][9][1].twist.twist.angular.z == -125.4  # a converter corrects nothing


def test_configuration_reads_the_bag(source: Path, tmp_path: Path) -> None:
    bag = convert(source, tmp_path / "out")
    config = load_config(tmp_path / "out" / "robot.yaml")
    assert config.wheels.source == "pose"
    assert config.gate.max_yaw_rate < 125
    with open_recording(bag, config.recording) as recording:
        events = list(recording.events())
    kinds = [sum(isinstance(e, kind) for e in events) for kind in (OdometryEvent, ControlEvent, RangeBearingEvent)]
    assert kinds == [20, 20, 7]
    first = next(e for e in events if isinstance(e, RangeBearingEvent))
    assert first.stamp_ns == _START_NS - 170_000_000 - 50_000_000


def test_the_map_beside_the_recording_is_used_and_ids_without_place_left_out(source: Path, tmp_path: Path) -> None:
    assert not (convert(source, tmp_path / "without").parent / "map.yaml").exists()
    _list_landmarks(source.parent)
    convert(source, tmp_path / "with")
    landmark_map = load_map(tmp_path / "with" / "map.yaml")
    assert sorted(landmark_map.landmarks) == [0, 1]
    np.testing.assert_array_equal(landmark_map.landmarks[1].position, [1.68, -0.05, 0.18])


def test_another_recording_does_not_take_that_map(source: Path, tmp_path: Path) -> None:
    _list_landmarks(source.parent)
    other = source.rename(source.parent / "rosbag2_2025_11_25-14_27_38")
    convert(other, tmp_path / "out")
    assert not (tmp_path / "out" / "map.yaml").exists()
    convert(other, tmp_path / "out", landmarks=_list_landmarks(tmp_path))
    assert len(load_map(tmp_path / "out" / "map.yaml")) == 2


def test_a_wrong_list_of_landmarks_is_said_before_anything_is_written(source: Path, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("poses: []\n")
    with pytest.raises(MapError, match=r"wrong\.yaml"):
        convert(source, tmp_path / "out", landmarks=wrong)
    assert not (tmp_path / "out").exists()


def test_fault_64_messages_without_definition_are_left_out_and_the_rest_kept(tmp_path: Path) -> None:
    store = default_typestore()
    store.register(get_types_from_msg("int32 x\n", "turtlebot3_msgs/msg/SensorState"))
    path = tmp_path / "strange"
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for topic, kind, fields in (
            ("/sensor_state", "turtlebot3_msgs/msg/SensorState", {"x": 1}),
            ("/name", "std_msgs/msg/String", {"data": "burger"}),
        ):
            connection = writer.add_connection(topic, kind, typestore=store)
            writer.write(connection, _START_NS, store.serialize_cdr(store.types[kind](**fields), kind))
    messages, _ = read_back(convert(path, tmp_path / "out"))
    assert [m.data for _, m in messages["/name"]] == ["burger"]
    assert "/sensor_state" not in messages


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nowhere"):
        convert(tmp_path / "nowhere", tmp_path / "out")


@pytest.mark.real_data
def test_the_real_recording_with_landmarks(tmp_path: Path) -> None:
    messages, received = read_back(convert(real_data("turtlebot3", _NAME), tmp_path))
    assert received == sorted(received)
    assert {topic: len(found) for topic, found in messages.items()} == {
        "/odom": 2299,
        "/cmd_vel": 1220,
        "/landmarks": 689,
    }
    seen = [s.id for _, m in messages["/landmarks"] for s in m.landmarks]
    assert len(seen) == 660
    landmark_map = load_map(tmp_path / "map.yaml")
    assert len(landmark_map) == 8
    assert set(seen) <= set(landmark_map.landmarks)
    assert sum(abs(m.twist.twist.angular.z) > 100 for _, m in messages["/odom"]) == 5


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "topics"),
    [
        ("rosbag2_2025_11_25-14_27_38", {"/odom": 2415, "/cmd_vel": 1259, "/ekf": 2416}),
        (
            "rosbag2_2025_11_06-17_25_46",
            {"/odom": 990, "/imu": 990, "/joint_states": 990, "/tf_static": 1, "/tf": 1587},
        ),
    ],
)
def test_real_recordings_without_landmarks(name: str, topics: dict[str, int], tmp_path: Path) -> None:
    messages, _ = read_back(convert(real_data("turtlebot3", name), tmp_path))
    assert {topic: len(messages[topic]) for topic in topics} == topics
    assert not (tmp_path / "map.yaml").exists()
    config = load_config(tmp_path / "robot.yaml")
    with open_recording(tmp_path / "bag", config.recording) as recording:
        assert sum(isinstance(event, OdometryEvent) for event in recording.events()) == topics["/odom"]
