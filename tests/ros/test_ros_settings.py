"""Parameters of the ROS 2 node as settings of fgloc: namespaces, remapping, refusals. Without ROS."""

import sys
from pathlib import Path

import pytest

import fgloc
from fgloc.config import role_names
from fgloc.errors import ConfigError, MapError

ROOT = Path(fgloc.__file__).parent.parent
SAMPLE = ROOT / "datasets" / "samples" / "first_run"
sys.path.append(str(ROOT / "ros" / "fgloc_ros"))
from fgloc_ros.settings import PARAMETERS, settings  # noqa: E402


def read(namespace="", remapped=None, **given):
    """Settings of a node in a namespace, with some parameters given and some roles remapped."""
    defaults = {name: default for name, (default, _) in PARAMETERS.items()}
    values = defaults | {f"topics.{role}": "" for role in role_names()} | given

    def resolve(topic):
        return topic if topic.startswith("/") else f"{namespace}/{topic}"

    return settings(values, resolve, (remapped or {}).get, f"{namespace}/fgloc")


def test_defaults_are_those_of_fgloc():
    found = read()
    assert (found.landmarks, found.state, found.config.estimator.initial_pose) == (None, None, None)
    assert (found.publishing.rate_hz, found.publishing.map_frame, found.publishing.tf) == (50.0, "map", True)
    assert found.publishing.name == "fgloc"


def test_files_and_frames():
    found = read(
        "/two",
        config=str(SAMPLE / "robot.yaml"),
        map=str(SAMPLE / "map.yaml"),
        state="/var/lib/fgloc/state.json",
        initial_pose=[1, 2.0, 0.5],
        map_frame="two/map",
        base_frame="two/base_link",
        odom_frame="two/odom",
        publish_tf=False,
        rate=20.0,
        transform_tolerance=0.2,
    )
    assert found.landmarks is not None
    assert len(found.landmarks.landmarks) > 3
    assert found.map_file == SAMPLE / "map.yaml"
    assert found.config.recording.base_frame == "two/base_link"
    assert found.config.estimator.initial_pose == (1.0, 2.0, 0.5)
    p = found.publishing
    assert (p.rate_hz, p.map_frame, p.odom_frame, p.tf, p.tf_ahead_s) == (20.0, "two/map", "two/odom", False, 0.2)
    assert p.name == "two/fgloc"


def test_topics_by_parameter_remapping_and_file_in_this_order(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text("recording:\n  topics: {odometry: /odom, imu: /imu, joints: /joints, image: none}\n")
    found = read(
        "/one",
        {"imu": "/shared/imu", "joints": "/one/wheels"},
        config=str(file),
        **{"topics.joints": "encoders", "topics.command": "none", "topics.truth": "/mocap/pose"},
    )
    topics = found.config.recording.topics
    assert topics.odometry == "/one/odom"  # a recording's names are the robot's own
    assert topics.imu == "/shared/imu"
    assert topics.joints == "/one/encoders"
    assert (topics.image, topics.command) == ("none", "none")
    assert topics.truth == "/mocap/pose"
    assert topics.sightings is None


def test_a_pose_in_tf_stands_for_a_topic_in_recordings_only(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text("recording:\n  topics: {odometry: 'tf:odom>base_link', truth: 'tf:mocap>robot'}\n")
    with pytest.raises(ConfigError, match=r"recording\.topics\.odometry: tf:odom>base_link"):
        read("/one", config=str(file))
    topics = read("/one", config=str(file), **{"topics.odometry": "/odom"}).config.recording.topics
    assert (topics.odometry, topics.truth) == ("/odom", "none")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rate", 0.0),
        ("rate", float("nan")),
        ("rate", 1e6),
        ("transform_tolerance", -0.1),
        ("transform_tolerance", float("nan")),
        ("initial_pose", [1.0, 2.0]),
        ("initial_pose", ["1", "2", "3"]),
        ("initial_pose", "abc"),
        ("initial_pose", 1.0),
        ("initial_pose", [1.0, float("inf"), 0.0]),
        ("map_frame", ""),
        ("config", "/nowhere/robot.yaml"),
    ],
)
def test_what_cannot_be_is_refused(name, value):
    with pytest.raises(ConfigError):
        read(**{name: value})


def test_a_map_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(MapError):
        read(map=str(tmp_path / "map.yaml"))
