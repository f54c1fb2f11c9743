"""Topics are found by type; ambiguity is named with the key that settles it."""

from __future__ import annotations

import re

import pytest
from recording_bags import write_drive

from fgloc.config import RecordingConfig, TopicsConfig
from fgloc.errors import RecordingError
from fgloc.recording.reader import TopicInfo, open_recording, select_roles

ODOMETRY, TWIST, IMU = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist", "sensor_msgs/msg/Imu"
MEASURED, STAMPED = "geometry_msgs/msg/TwistWithCovarianceStamped", "geometry_msgs/msg/TwistStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
POSE, COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
IMAGE, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
TAGS, LANDMARKS = "apriltag_msgs/msg/AprilTagDetectionArray", "landmark_msgs/msg/LandmarkArray"


def select(*topics: tuple[str, str], empty: tuple[tuple[str, str], ...] = (), **given: str):
    found = [TopicInfo(name, kind, 10) for name, kind in topics] + [TopicInfo(name, kind, 0) for name, kind in empty]
    return select_roles(found, TopicsConfig(**given))


@pytest.mark.parametrize(
    ("topics", "roles"),
    [
        ([("/pioneer/pose", ODOMETRY)], {"odometry": "/pioneer/pose"}),
        (
            [("/odom", ODOMETRY), ("/base_pose_ground_truth", ODOMETRY)],
            dict(odometry="/odom", truth="/base_pose_ground_truth"),
        ),
        ([("/vicon/robot/odom", ODOMETRY)], {"truth": "/vicon/robot/odom"}),
        ([("/groundTruth", ODOMETRY)], {"truth": "/groundTruth"}),
        ([("/cmd_vel", "geometry_msgs/msg/TwistStamped")], {"command": "/cmd_vel"}),
        ([("/odom", ODOMETRY), ("/ekf", ODOMETRY)], {"odometry": "/odom"}),
        ([("/wheel/twist", MEASURED)], {"odometry": "/wheel/twist"}),
        ([("/wheel/twist", MEASURED), ("/pioneer/pose", ODOMETRY)], {"odometry": "/pioneer/pose"}),
        ([("/truth/twist", MEASURED)], {}),
        ([("/robot/odom", ODOMETRY), ("/odometry/filtered", ODOMETRY)], {"odometry": "/robot/odom"}),
        ([("/imu/data", IMU), ("/imu/data_raw", IMU)], {"imu": "/imu/data"}),
        ([("/mocap/pose", POSE), ("/initialpose", COVARIANCE)], {"truth": "/mocap/pose"}),
        ([("/move_base_simple/goal", POSE), ("/goal_pose", POSE), ("/initialpose", COVARIANCE)], {}),
        ([("/amcl_pose", COVARIANCE), ("/aruco_single/pose", POSE)], {}),
        ([("/vintage/pose", POSE)], {"truth": "/vintage/pose"}),
        ([("/vicon/robot/robot", TRANSFORM)], {"truth": "/vicon/robot/robot"}),
        ([("/vicon/robot/robot", TRANSFORM), ("/vicon/robot/pose", POSE)], {"truth": "/vicon/robot/pose"}),
        ([("/gripper/transform", TRANSFORM)], {}),
        ([("/camera/image_raw", IMAGE), ("/camera/image_raw/compressed", COMPRESSED)], {"image": "/camera/image_raw"}),
        (
            [("/camera/depth/image_raw", IMAGE), ("/camera/color/image_raw", IMAGE)],
            {"image": "/camera/color/image_raw"},
        ),
        ([("/zed/left/image_rect_color", IMAGE)], {"image": "/zed/left/image_rect_color"}),
        ([("/camera/image_rect", IMAGE), ("/camera/image_color", IMAGE)], {"image": "/camera/image_color"}),
        ([("/direct/image", IMAGE), ("/tags", TAGS)], {"sightings": "/tags"}),
        (
            [("/left/image_raw/compressed", COMPRESSED), ("/left/camera_info", INFO), ("/right/camera_info", INFO)],
            {"image": "/left/image_raw/compressed", "camera_info": "/left/camera_info"},
        ),
    ],
)
def test_found_by_type_and_name(topics, roles):
    selection = select(*topics)
    assert selection.problems == ()
    assert selection.roles == roles


@pytest.mark.parametrize(("name", "kind"), [("/vehicle/twist", STAMPED), ("/pose", POSE), ("/scan", COVARIANCE)])
def test_poses_and_twists_are_odometry_where_the_configuration_names_them(name, kind):
    selection = select((name, kind), odometry=name)
    assert selection.problems == ()
    assert selection.roles == {"odometry": name}
    assert "odometry" not in select((name, kind)).roles


@pytest.mark.parametrize(
    ("role", "topics"),
    [
        ("odometry", [("/ekf", ODOMETRY), ("/visual", ODOMETRY)]),
        ("odometry", [("/a/odom", ODOMETRY), ("/b/odom", ODOMETRY)]),
        ("command", [("/teleop", TWIST), ("/nav", TWIST)]),
        ("truth", [("/vicon/a", POSE), ("/vicon/b", POSE)]),
        ("truth", [("/pose_a", POSE), ("/pose_b", POSE)]),
        ("sightings", [("/tags", TAGS), ("/landmarks", LANDMARKS)]),
        ("image", [("/left/image_raw", IMAGE), ("/right/image_raw", IMAGE)]),
    ],
)
def test_ambiguity_names_the_candidates_and_the_key(role, topics):
    selection = select(*topics)
    assert role not in selection.roles
    (problem,) = selection.problems
    assert all(name in problem for name, _ in topics)
    assert f"recording.topics.{role}: {topics[0][0]}" in problem
    settled = select(*topics, **{role: topics[1][0]})
    assert settled.problems == ()
    assert settled.roles == {role: topics[1][0]}
    assert select(*topics, **{role: "none"}).roles == {}


def test_choices_by_name_are_told():
    (note,) = select(("/odom", ODOMETRY), ("/ekf", ODOMETRY)).notes
    assert "/odom" in note
    assert "/ekf" in note
    (note,) = select(("/somewhere", POSE)).notes
    assert re.search(r"/somewhere\b.*\btruth\b", note)
    (note,) = select(("/amcl_pose", COVARIANCE)).notes
    assert "recording.topics.truth: /amcl_pose" in note


def test_topics_without_messages_are_no_candidates():
    selection = select(("/odom2", ODOMETRY), empty=(("/odom", ODOMETRY), ("/truth", POSE)))
    assert selection.roles == {"odometry": "/odom2"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"odometry": "/absent"}, r"odometry: /absent\b.*/odom\b.*/ekf\b"),
        ({"odometry": "/cmd"}, r"odometry: /cmd\b.*geometry_msgs/msg/Twist\b.*nav_msgs/msg/Odometry"),
        ({"odometry": "/void"}, r"odometry: /void\b.*/odom\b.*/ekf\b"),
        ({"odometry": "/odom", "truth": "/odom"}, r"truth: /odom\b"),
    ],
)
def test_configured_topics_that_do_not_fit(given, message):
    topics = (("/odom", ODOMETRY), ("/ekf", ODOMETRY), ("/cmd", TWIST))
    selection = select(*topics, empty=(("/void", ODOMETRY),), **given)
    assert len(selection.problems) == 1
    assert re.search(message, selection.problems[0])


def test_own_output_is_neither_odometry_nor_truth_unless_it_is_asked_for():
    own = (("/fgloc/odometry", ODOMETRY), ("/fgloc/pose", COVARIANCE), ("/fgloc/truth", POSE))
    selection = select(*own)
    assert (dict(selection.roles), selection.problems) == ({}, ())
    assert select(("/odom", ODOMETRY), *own).roles == {"odometry": "/odom"}
    assert select(*own, odometry="/fgloc/odometry").roles == {"odometry": "/fgloc/odometry"}


def test_the_configuration_of_another_robot_is_told_as_such():
    given = {"odometry": "/pioneer/pose", "truth": "/mocap/pose"}
    problems = select(("/odom", ODOMETRY), ("/imu/data", IMU), **given).problems
    assert len(problems) == 3
    assert "choose /odom" in problems[0]
    assert "/odom" not in problems[1]  # it is what is held against a truth
    assert "another robot" in problems[2]
    assert len(select(("/odom", ODOMETRY), ("/imu/data", IMU), odometry="/odom", truth="/mocap/pose").problems) == 1


def test_configured_topics_that_may_still_come_are_no_problem():
    assert not select_roles([], TopicsConfig(odometry="/odom", imu="/imu"), growing=True).problems


def test_open_recording_refuses_what_is_ambiguous(tmp_path):
    from fgloc_datasets.bag import BagWriter

    with BagWriter(tmp_path / "run") as bag:
        for topic in ("/a", "/b"):
            bag.odometry(topic, 1, (0, 0, 0), (0, 0))
    with pytest.raises(RecordingError, match=r"/a, /b; choose one .*recording\.topics\.odometry: /a"):
        open_recording(tmp_path / "run", RecordingConfig())
    with open_recording(tmp_path / "run", RecordingConfig(topics=TopicsConfig(odometry="/b"))) as recording:
        assert [e.topic for e in recording.events()] == ["/b"]
        assert {t.name: t.role for t in recording.topics} == {"/a": None, "/b": "odometry"}


def test_truth_may_be_any_odometry_if_given(tmp_path):
    config = RecordingConfig(topics=TopicsConfig(truth="/odom", odometry="none"))
    with open_recording(write_drive(tmp_path / "run", n=3), config) as recording:
        kinds = {type(e).__name__ for e in recording.events() if e.topic == "/odom"}
        assert kinds == {"TruthEvent"}


def test_markers_are_not_taken_twice_from_images_and_from_their_detections():
    topics = ("/camera/image_raw", IMAGE), ("/camera/camera_info", INFO), ("/tags", TAGS)
    found = select(*topics)
    assert found.roles == {"camera_info": "/camera/camera_info", "sightings": "/tags"}
    assert not found.problems
    [note] = found.notes
    assert re.search(r"^/camera/image_raw\b.* /tags\b.*recording\.topics\.sightings: none\b", note)
    assert "sightings" not in select(*topics, image="/camera/image_raw").roles
    assert select(*topics, sightings="none").roles["image"] == "/camera/image_raw"
    assert len(select(*topics, image="/camera/image_raw", sightings="/tags").roles) == 3
