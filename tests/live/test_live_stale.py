"""A live run whose inputs have stopped says so, and since when."""

from unittest.mock import Mock

import pytest
from live_feed import PATIENCE_S, exit_code

from fgloc.cli.terminal import EXIT_LOST
from fgloc.config import Config
from fgloc.live import Live, live
from fgloc.live.engine import LiveStatus, TopicStatus
from fgloc.live.wire.node import Node, described
from fgloc.live.wire.outputs import RecentPoses
from fgloc.types import ControlEvent, Mode


@pytest.fixture
def clock(monkeypatch):
    """A clock of this machine that the test sets."""
    now = [100.0]
    monkeypatch.setattr(live, "_clock_s", lambda: now[0])
    return now


def drive(run, clock, seconds, hz=20.0):
    for _ in range(round(seconds * hz)):
        at_ns = round(clock[0] * 1e9)
        run.push(ControlEvent(at_ns, at_ns, "command", 0.2, 0.0))
        clock[0] += 1.0 / hz


def test_silence_of_all_motion_is_stale_within_a_second(clock):
    with Live(Config(), roles=("command",)) as run:
        drive(run, clock, 2.0)
        assert not run.status().stale
        clock[0] += 0.9
        status = run.status()
        assert status.stale.startswith("STALE")
        assert "command" in status.stale
        assert described(status)[0] == status.stale
        (topic,) = status.topics.values()
        assert topic.missed
        assert exit_code(status) == EXIT_LOST
        assert topic.silent_s == pytest.approx(0.95, abs=0.06)
        drive(run, clock, 0.5)
        run.wait()  # a run that has no pose yet ends with 3
        assert not run.status().stale
        assert exit_code(run.status()) == 0


def test_a_slow_topic_is_not_missed_between_two_messages(clock):
    with Live(Config(), roles=("command",)) as run:
        drive(run, clock, 20.0, hz=2.0)
        clock[0] += 0.9
        assert not run.status().stale


@pytest.mark.parametrize("mode", list(Mode))
def test_a_run_that_ends_without_its_pose_says_so_in_the_exit_code(mode):
    assert exit_code(LiveStatus(mode=mode)) == (EXIT_LOST if mode is Mode.LOST else 0)


@pytest.mark.parametrize(
    ("others", "is_stale"), [({}, True), ({"/odom": TopicStatus("odometry", 99, 20.0, 0.0, 0.01, False)}, False)]
)
def test_where_nothing_tells_motion_silent_sightings_are_stale(others, is_stale):
    topics = {"/landmarks": TopicStatus("sightings", 50, 5.0, 0.0, 2.0, True), **others}
    assert LiveStatus(topics=topics).stale.startswith("STALE: no message of /landmarks") == is_stale


@pytest.mark.parametrize(
    ("topics", "is_stale"),
    [
        ({"/wheels": ("odometry", True), "/vo": ("odometries", False), "/tags": ("sightings", False)}, False),
        ({"/wheels": ("odometry", True), "/vo": ("odometries", True), "/tags": ("sightings", False)}, True),
        ({"/vo": ("odometries", False), "/tags": ("sightings", True)}, True),  # which is not used alone
    ],
)
def test_an_odometry_beside_silent_wheels_tells_motion(topics, is_stale):
    given = {
        topic: TopicStatus(role, 99, 20.0, 0.0, 2.0 if missed else 0.01, missed)
        for topic, (role, missed) in topics.items()
    }
    assert bool(LiveStatus(topics=given).stale) == is_stale


def test_odometry_on_the_wire_never_goes_back_in_time_after_the_messages_have_stopped(clock):
    """For 10 s the pose is propagated; then nothing is known of the present."""
    network = Mock()
    network.clock.return_value.now_ns = lambda: round(clock[0] * 1e9)
    with Live(Config.model_validate({"estimator": {"initial_pose": (0.0, 0.0, 0.0)}}), roles=("command",)) as run:
        drive(run, clock, 3.0)
        assert run.wait(PATIENCE_S)
        node = Node(network, Config(), None, process=Mock())
        node.live, node._recent, node._outputs = run, RecentPoses(run.pose_at), Mock()
        stamps = []
        for _ in range(150):  # 15 s
            node._publish_once()
            stamps = [call.args[0].stamp_ns for call in node._outputs.odometry.call_args_list]
            clock[0] += 0.1
        assert stamps == sorted(stamps)
        assert (stamps[-1] - stamps[0]) * 1e-9 == pytest.approx(10.0, abs=0.2)
        drive(run, clock, 1.0)
        assert run.wait(PATIENCE_S)
        node._publish_once()
        assert node._outputs.odometry.call_args.args[0].stamp_ns > stamps[-1]
