"""The frame tree."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fgloc.config import Config, RecordingConfig, TopicsConfig
from fgloc.errors import RecordingError
from fgloc.frames import transform_matrix, yaw_quaternion
from fgloc.recording.info import inspect
from fgloc.recording.reader import open_recording
from fgloc.recording.transforms import FrameTree
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import TransformEvent, TruthEvent
from fgloc_datasets.bag import BagWriter
from tests.support.recording_bags import START_NS, TICK_NS


def edge(parent: str, child: str, x: float, yaw: float, static: bool = True) -> TransformEvent:
    return TransformEvent(0, 0, "/tf", parent, child, np.array([x, 0.0, 0.0]), yaw_quaternion(yaw), static)


def test_composes_along_and_against_the_edges():
    tree = FrameTree(
        [edge("base", "mast", 1.0, 0.5), edge("mast", "camera", 0.2, -0.3), edge("base", "lidar", 0.4, 0.1)]
    )
    T_base_camera = transform_matrix([1, 0, 0], yaw_quaternion(0.5)) @ transform_matrix(
        [0.2, 0, 0], yaw_quaternion(-0.3)
    )
    np.testing.assert_allclose(tree.lookup("base", "camera"), T_base_camera, atol=1e-12)
    np.testing.assert_allclose(tree.lookup("camera", "base"), np.linalg.inv(T_base_camera), atol=1e-12)
    T_base_lidar = transform_matrix([0.4, 0, 0], yaw_quaternion(0.1))
    np.testing.assert_allclose(tree.lookup("lidar", "camera"), np.linalg.inv(T_base_lidar) @ T_base_camera, atol=1e-12)
    np.testing.assert_array_equal(tree.lookup("base", "base"), np.eye(4))
    assert tree.frames == ("base", "camera", "lidar", "mast")


def test_ros1_slashes_do_not_matter():
    tree = FrameTree([edge("/base", "/camera", 1.0, 0.0)])
    assert tree.lookup("base", "/camera")[0, 3] == 1.0
    assert "/base" in tree


def test_repeated_and_moving_transforms():
    fixed = [edge("base", "camera", 1.0, 0.0, static=False) for _ in range(3)]
    moving = [edge("odom", "base", 0.1 * k, 0.0, static=False) for k in range(3)]
    tree = FrameTree(fixed + moving)
    assert tree.lookup("base", "camera")[0, 3] == 1.0
    with pytest.raises(RecordingError, match="'base' moves against 'odom'"):
        tree.lookup("odom", "camera")
    turning = FrameTree([edge("base", "pan", 0.0, 0.3 * k, static=False) for k in range(2)])
    with pytest.raises(RecordingError, match="'pan' moves against 'base'"):
        turning.lookup("base", "pan")


def test_two_trees_and_nonsense():
    tree = FrameTree(
        [
            edge("a", "b", 1.0, 0.0),
            edge("c", "d", 1.0, 0.0),
            edge("self", "self", 1.0, 0.0),
            TransformEvent(0, 0, "/tf", "a", "zero", np.zeros(3), np.zeros(4), True),
            TransformEvent(0, 0, "/tf", "a", "huge", np.zeros(3), np.full(4, 1e300), True),
            TransformEvent(0, 0, "/tf", "a", "nan", np.full(3, np.nan), yaw_quaternion(0.0), True),
        ]
    )
    assert tree.frames == ("a", "b", "c", "d")
    with pytest.raises(RecordingError, match=r"'a'.*'d'"):
        tree.lookup("a", "d")


# --- Poses in tf as topics


def write_tf(folder, *, topics=(), children=("base_footprint",), parent="odom", n=60, **storage):
    """A robot on a circle whose poses are in tf; ``topics``: of odometries with the same poses."""
    with BagWriter(folder, **storage) as bag:
        bag.static_transform(START_NS, "base_footprint", "base_link", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0))
        for k in range(n):
            stamp, angle = START_NS + k * TICK_NS, 0.02 * k
            pose = (math.sin(angle), 1.0 - math.cos(angle), angle)
            for child in children:
                place = (*pose[:2], 0.0), yaw_quaternion(angle).tolist()
                bag.static_transform(stamp, f"/{parent}", child, *place, stamp + 2_000_000, topic="/tf")
            for topic in topics:
                bag.odometry(topic, stamp, pose, (0.4, 0.4), stamp + 2_000_000)
            bag.command("/cmd_vel", stamp, 0.4, 0.4, stamp + 2_000_000)
    return folder


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_an_odometry_that_is_in_tf_alone_is_read_from_there(tmp_path, storage):
    with open_recording(write_tf(tmp_path / "bag", storage=storage), RecordingConfig()) as recording:
        assert recording.roles["odometry"] == "tf:odom>base_footprint"
        assert any("tf:odom>base_footprint" in note for note in recording.notes)
        found = [e for e in recording.events() if isinstance(e, OdometryEvent)]
        assert recording.frames.lookup("base_link", "base_footprint")[2, 3] == -0.1
        only = list(recording.messages({"tf:odom>base_footprint"}))
    assert [e.stamp_ns for e in found] == [START_NS + k * TICK_NS for k in range(60)]
    assert {(e.topic, e.base_frame_id, e.received_ns - e.stamp_ns) for e in found} == {
        ("tf:odom>base_footprint", "base_footprint", 2_000_000)
    }
    np.testing.assert_allclose([e.position[0] for e in found], np.sin(0.02 * np.arange(60)), atol=1e-12)
    assert {(m[0], m[1]) for m in only} == {("tf:odom>base_footprint", "geometry_msgs/msg/TransformStamped")}


def test_a_topic_of_odometry_is_taken_before_tf_and_none_switches_both_off(tmp_path):
    bag = write_tf(tmp_path / "bag", topics=["/odom"])
    off = RecordingConfig(topics=TopicsConfig(odometry="none"))
    named = RecordingConfig(topics=TopicsConfig(odometry="tf:odom>base_footprint"))
    for config, topic in ((RecordingConfig(), "/odom"), (off, None), (named, "tf:odom>base_footprint")):
        with open_recording(bag, config) as recording:
            assert recording.roles.get("odometry") == topic
            assert ("tf:odom>base_footprint" in {t.name for t in recording.topics}) == (config is named)


def test_poses_in_tf_that_may_be_several_odometries_are_named_and_a_missing_pair_is_refused(tmp_path):
    two = write_tf(tmp_path / "two", children=("one/base_link", "two/base_link"))
    with open_recording(two, RecordingConfig()) as recording:
        assert "odometry" not in recording.roles
        assert any("tf:odom>one/base_link, tf:odom>two/base_link" in note for note in recording.notes)
    config = RecordingConfig(topics=TopicsConfig(odometry="tf:odom>three"))
    with pytest.raises(RecordingError, match="tf:odom>three is not in the recording"):
        open_recording(two, config)
    other = write_tf(tmp_path / "other", parent="wheel_odom", children=("chassis",))
    report = inspect(other, Config())
    assert any("recording.topics.odometry: tf:wheel_odom>chassis" in f.text for f in report.found)
    truth = RecordingConfig(topics=TopicsConfig(truth="tf:wheel_odom>chassis"))
    with open_recording(other, truth) as recording:
        assert sum(isinstance(e, TruthEvent) for e in recording.events()) == 60
