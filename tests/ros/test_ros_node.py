"""The ROS 2 node in a real ROS 2, by each middleware: poses, outputs, namespaces, lifecycle, services, commands."""

import json

import pytest

from benchmarks import ros, ros_peer
from benchmarks.common import SAMPLES

SAMPLE = SAMPLES / "first_run"

pytestmark = [
    pytest.mark.ros2,
    pytest.mark.slow,
    pytest.mark.skipif(bool(ros_peer.why_not()), reason=ros_peer.why_not()),
]


@pytest.fixture(params=[] if ros_peer.why_not() else ros_peer.middlewares())
def middleware(request):
    return request.param


def asked(job, middleware, **arguments):
    return ros_peer.ask(
        job, middleware, 1200.0, bag=str(SAMPLE / "bag"), parameters=ros.parameters(SAMPLE), **arguments
    )


def test_poses_are_those_of_an_online_run_and_map_frames_and_diagnostics_are_published(middleware):
    drive = asked("drive", middleware, needed=list(ros_peer.INPUTS), rate=2.0)
    off, share = ros.apart_mm(drive["poses"], SAMPLE)
    assert max(off) < 1e-6
    assert share == 1.0
    assert drive["code"] == 0
    assert drive["markers"] > 3
    assert (drive["frames"], drive["state"]) == (["odom"], "active")
    assert drive["diagnostics"][0] == "fgloc: localization"
    assert not [line for line in drive["log"] if "WARN" in line or "ERROR" in line]


def test_a_topic_whose_message_type_is_not_installed_is_named_and_another_has_its_role(middleware):
    """Sightings would have been used rather than images; the images are, and the node goes on."""
    kind = "apriltag_msgs/msg/AprilTagDetectionArray"
    drive = asked("drive", middleware, needed=list(ros_peer.INPUTS), rate=2.0, beside={"/detections": kind})
    named = [line for line in drive["log"] if f"/detections ({kind}) cannot be read" in line]
    assert len(named) == 1, drive["log"]
    assert (drive["code"], drive["state"]) == (0, "active")
    assert [line for line in drive["log"] if f"Subscribed: {ros_peer.IMAGES} (image)" in line]
    assert drive["poses"]


def test_transitions_that_fail_say_why_and_succeed_once_the_parameters_are_right(middleware):
    """One that rclpy raises, for a name that no topic has, and one that fgloc expects, a missing file."""
    wrong = {"topics.odometry": "no topic", "map": "/nowhere/map.yaml"}
    found = ros_peer.ask("failed", middleware, 300.0, parameters=ros.parameters(SAMPLE), wrong=wrong)
    assert found["steps"] == [
        ["activate", False, "unconfigured"],
        ["configure", False, "unconfigured"],
        ["configure", False, "unconfigured"],
        ["configure", True, "inactive"],
        ["activate", True, "active"],
        ["deactivate", True, "inactive"],
        ["clean up", True, "unconfigured"],
    ], found["log"]
    assert found["code"] == 0
    said = [line for line in found["log"] if "ERROR" in line]
    assert [line for line in said if "/nowhere/map.yaml" in line]
    assert [line for line in said if "on_configure: " in line and "topic name must not contain" in line]
    assert not [line for line in said if "initialpose" in line]


def test_robots_in_namespaces_hear_only_themselves(middleware):
    sample = SAMPLES / "installed_run"
    bags = [str(s / "bag") for s in (SAMPLE, sample)]
    found = ros_peer.ask("two", middleware, bags=bags, parameters=[ros.parameters(s) for s in (SAMPLE, sample)])
    for name, other, own in (("one", "two", SAMPLE), ("two", "one", sample)):
        off, share = ros.apart_mm(found[name]["poses"], own)
        assert max(off) < 1.0
        assert share > 0.99
        assert not [topic for topic in found[name]["reads"] if topic.startswith(f"/{other}/")]
        assert (found[name]["shared_tf"], found[name]["code"]) == (0, 0)
        assert found[name]["tf"] > 1000


def test_transitions_and_kills_in_any_order(middleware):
    found = asked("lifecycle", middleware, count=30, seed=7)
    assert found["crashes"] == []
    assert (found["orphans"], found["code"]) == (0, 0)
    assert found["refused"]


def test_messages_that_wait_are_handed_on_in_the_order_in_which_they_were_published(middleware):
    """Also those of different topics; the executor takes one of each topic in turn."""
    assert ros_peer.ask("waiting", middleware, 300.0, count=300) == list(range(300))


def test_damaged_messages_are_counted_and_the_node_goes_on(middleware):
    found = asked("damaged", middleware, count=3000, seed=1)
    assert found["sent"] == 3000, found["log"]
    assert found["code"] is None
    assert found["heard"] > 50  # of 100 in 2 s
    assert found["memory_mb"] < 50.0


@pytest.mark.parametrize("participant", [False, True], ids=["node", "fgloc live"])
def test_commands_of_ros_answer_without_a_warning(middleware, participant):
    answers = asked("commands", middleware, participant=participant)
    wrong = [answer for answer in answers if answer["wrong"]]
    assert not wrong, json.dumps(wrong, indent=1)
