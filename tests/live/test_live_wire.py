"""ROS 2's wire: names, types, messages, and recordings that arrive as they are."""

import dataclasses
import threading
import time

import numpy as np
import pytest
from recording_bags import SIDES, storage_file, two_topics, write_drive, write_ros1
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from wire import DOMAIN, wait_until

from fgloc.config import RecordingConfig, TopicsConfig, role_names
from fgloc.errors import WireError
from fgloc.live.wire import node, play
from fgloc.live.wire.node import Intake
from fgloc.live.wire.outputs import Outputs
from fgloc.live.wire.participant import (
    CLOCK,
    CLOCK_TYPE,
    Participant,
    Publication,
    Sample,
    WireClock,
    dds_topic,
    dds_type,
    ros_topic,
    ros_type,
)
from fgloc.live.wire.participant import Writer as WireWriter
from fgloc.live.wire.play import Player
from fgloc.live.wire.transport import in_order
from fgloc.recording.messages import Messages
from fgloc.recording.reader import converters_of, open_recording


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(node, "SETTLED_S", 0.2)
    monkeypatch.setattr(play, "_QUIET_S", 0.5)


TWIST = "geometry_msgs/msg/Twist"
IMAGE = "sensor_msgs/msg/Image"


def test_names_are_those_of_ros2():
    assert (dds_topic("/odom"), dds_topic("wheels/odom")) == ("rt/odom", "rt/wheels/odom")
    assert dds_type("nav_msgs/msg/Odometry") == "nav_msgs::msg::dds_::Odometry_"
    assert (ros_topic("rt/a/b"), ros_topic("rq/add_two_intsRequest"), ros_topic("ros_discovery_info")) == (
        "/a/b",
        None,
        None,
    )
    assert ros_type("nav_msgs::msg::dds_::Odometry_") == "nav_msgs/msg/Odometry"
    assert ros_type("HelloWorld") is None
    assert (
        ros_type("rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_") == "rmw_dds_common/msg/ParticipantEntitiesInfo"
    )


def test_messages_are_encoded_with_what_is_given_and_zeros():
    messages = Messages()
    values = {"name": ["a", "b"], "position": [1.0, 2.0], "header": {"frame_id": "base", "stamp": {"sec": 3}}}
    back = messages.decode("sensor_msgs/msg/JointState", messages.encode("sensor_msgs/msg/JointState", values))
    assert back.name == ["a", "b"]
    assert back.position.tolist() == [1.0, 2.0]
    assert len(back.effort) == 0
    assert (back.header.frame_id, back.header.stamp.sec, back.header.stamp.nanosec) == ("base", 3, 0)
    odometry = messages.decode("nav_msgs/msg/Odometry", messages.encode("nav_msgs/msg/Odometry", {}))
    assert odometry.pose.covariance.tolist() == [0.0] * 36
    with pytest.raises(KeyError, match="speed"):
        messages.encode(TWIST, {"speed": 1.0})


def test_types_on_the_wire_are_those_of_the_definitions():
    """Every message type that fgloc reads can be announced, with the very fields of its definition."""
    messages = Messages()
    layout = messages.layout("sensor_msgs/msg/CameraInfo")
    assert [field.name for field in layout["sensor_msgs/msg/RegionOfInterest"]][:2] == ["x_offset", "y_offset"]
    assert next(field for field in layout["sensor_msgs/msg/CameraInfo"] if field.name == "k").array == 9
    kinds = {kind for role in role_names() for kind in converters_of(role)}
    with Participant(DOMAIN) as one, Participant(DOMAIN) as other:
        writers = [one.writer(f"/t{k}", kind) for k, kind in enumerate(sorted(kinds))]
        expected = {Publication(f"/t{k}", kind) for k, kind in enumerate(sorted(kinds))}
        assert wait_until(lambda: set(other.publications()) == expected)
        assert one.publications() == ()  # its own are not input
        assert len(writers) == len(kinds)


class Announced:
    """Network that stores how topics are announced."""

    def __init__(self):
        self.latched = {}

    def full_name(self, name):
        return name.replace("~", "/fgloc")

    def writer(self, topic, message_type, latched=False):
        self.latched[topic] = latched


def test_a_late_reader_gets_the_map_and_no_old_pose():
    network = Announced()
    Outputs(network)
    assert {topic for topic, latched in network.latched.items() if latched} == {"/fgloc/map"}
    assert len(network.latched) > 4


def test_what_was_written_before_reaches_late_readers_of_a_latched_topic_only():
    heard = []
    with Participant(DOMAIN) as one, Participant(DOMAIN) as other:
        for topic, latched in (("/tf_static", True), ("/cmd_vel", False)):
            writer = one.writer(topic, TWIST, latched)
            for k in range(3):
                writer.write(one.messages.encode(TWIST, {"linear": {"x": float(k)}}))
            other.read(topic, TWIST, heard.append, latched)
            assert wait_until(lambda w=writer: w.readers == 1)
            writer.write(one.messages.encode(TWIST, {"linear": {"x": 9.0}}), source_ns=123)
            writer.flush(1.0)
        assert wait_until(lambda: len(heard) == 5)
        told = [(s.topic, other.messages.decode(TWIST, s.cdr).linear.x) for s in heard]
        assert sorted(told) == [("/cmd_vel", 9.0), *(("/tf_static", x) for x in (0.0, 1.0, 2.0, 9.0))]
        last = [s for s, (_, x) in zip(heard, told, strict=True) if x == 9.0]  # its time is before that of the others
        assert [s.source_ns for s in last] == [123, 123]


@pytest.mark.parametrize("reliable", [True, False])
def test_fault_69_publishers_of_any_quality_of_service_are_heard(reliable):
    """Best effort or reliable; and static transforms from a publisher that keeps none for late readers."""
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos

    events = []
    names = ("/odom", "nav_msgs/msg/Odometry"), ("/image_raw", IMAGE), ("/tf_static", "tf2_msgs/msg/TFMessage")
    with Participant(DOMAIN) as one, Participant(DOMAIN) as other:
        quality = Policy.Reliability.Reliable(10**9) if reliable else Policy.Reliability.BestEffort
        qos = Qos(quality, Policy.Durability.Volatile, Policy.DataRepresentation(use_cdrv0_representation=True))
        topics = [one._topic(name, kind, one.messages) for name, kind in names]
        writers = [WireWriter(DataWriter(one._participant, topic, qos=qos), topic.data_type) for topic in topics]
        intake_ = Intake(other, WireClock(other), RecordingConfig(), lambda event, publisher: events.append(event))
        assert wait_until(lambda: not intake_.find() and bool(intake_.roles))
        assert wait_until(lambda: bool(intake_.subscribe() or True) and all(w.readers for w in writers))
        turn = {"rotation": {"w": 1.0}}
        frames = {"transforms": [{"header": {"frame_id": "base"}, "child_frame_id": "imu", "transform": turn}]}
        contents = ({"child_frame_id": "base"}, {}, frames)

        def heard():
            for writer, (_, kind), content in zip(writers, names, contents, strict=True):
                writer.write(one.messages.encode(kind, content))
            return intake_.received.keys() >= {name for name, _ in names}

        assert wait_until(heard)


class Offered:
    """Network on which others publish these topics; ``latched`` is what is read of it, and how."""

    def __init__(self, types):
        self._types, self.latched = types, {}

    def full_name(self, name):
        return name.replace("~", "/fgloc")

    def publications(self):
        return tuple(Publication(topic, kind) for topic, kind in self._types.items())

    def has_volatile(self, topic):
        return False

    def read(self, topic, message_type, on_message, latched=False):
        self.latched[topic] = latched


def test_static_transforms_are_read_as_they_were_told_before_and_nothing_else_is():
    frames = dict.fromkeys(("/tf", "/tf_static"), "tf2_msgs/msg/TFMessage")
    network = Offered({"/odom": "nav_msgs/msg/Odometry", "/image_raw": IMAGE} | frames)
    intake = Intake(network, None, RecordingConfig(), None)
    assert wait_until(lambda: not intake.find() and bool(intake.roles))
    intake.subscribe()
    assert network.latched == {"/tf_static": True, "/tf": False, "/odom": False, "/image_raw": False}


def test_a_participant_waits_for_messages_rather_than_look_for_them_all_the_time(monkeypatch):
    looks = []
    monkeypatch.setattr("fgloc.live.wire.participant.in_order", lambda queues: looks.append(queues) or [])
    with Participant(DOMAIN) as one:
        one.read("/cmd_vel", TWIST, lambda sample: None)
        assert wait_until(lambda: looks)
        time.sleep(0.2)
        assert len(looks) < 10


def test_leaving_is_noticed_and_quick():
    one, other = Participant(DOMAIN), Participant(DOMAIN)
    writers = [one.writer("/cmd_vel", TWIST), one.writer("/odom", "nav_msgs/msg/Odometry")]
    other.read("/odom", "nav_msgs/msg/Odometry", lambda sample: None)
    assert wait_until(lambda: len(other.publications()) == 2 and writers[1].readers == 1)
    began = time.monotonic()
    writers.clear()
    one.close()
    assert time.monotonic() - began < 5.0
    assert wait_until(lambda: other.publications() == ())
    other.close()
    other.close()


@pytest.mark.parametrize(
    ("simulated_ns", "source_ns", "received_ns"),
    [
        (10**18, 10**18 + 3 * 10**9, 10**18 + 3 * 10**9),  # of a player with our clock, though /clock came late
        (10**18, None, 10**18),  # of a simulator, which writes by the machine's clock
        (None, 12345, None),  # of a machine with another clock
    ],
)
def test_the_receive_time_is_that_of_writing_where_the_clocks_agree(simulated_ns, source_ns, received_ns):
    with Participant(DOMAIN) as one, Participant(DOMAIN) as other:
        clock = WireClock(other)
        writer = one.writer("/clock", "rosgraph_msgs/msg/Clock")
        assert wait_until(lambda: writer.readers == 1)
        if simulated_ns is not None:
            stamp = {"sec": simulated_ns // 10**9, "nanosec": simulated_ns % 10**9}
            writer.write(one.messages.encode("rosgraph_msgs/msg/Clock", {"clock": stamp}))
            assert wait_until(lambda: clock.simulated)
        sample = Sample("/a", TWIST, b"", time.time_ns() if source_ns is None else source_ns)
        found = clock.received_ns(sample)
    assert abs(found - (time.time_ns() if received_ns is None else received_ns)) < (0.5e9 if received_ns is None else 1)


class _Queue:
    """Messages that wait; others come while they are taken, one each time."""

    def __init__(self, waiting, coming=()):
        self.waiting, self._coming = [*waiting], [*coming]

    def take(self, most):
        taken, self.waiting = self.waiting[:most], self.waiting[most:]
        if self._coming:
            self.waiting.append(self._coming.pop(0))
        return [(stamp, stamp) for stamp in taken]


def test_what_waits_in_several_queues_is_in_the_order_of_writing():
    fast, slow, empty = _Queue(range(1, 1001)), _Queue(range(50, 1001, 100)), _Queue([])
    found = in_order([(2000, one.take) for one in (fast, slow, empty)])
    assert found == sorted([*range(1, 1001), *range(50, 1001, 100)])
    assert in_order([(2000, empty.take)]) == []


def test_a_queue_is_looked_at_again_if_others_have_brought_something_newer():
    early, late = _Queue([1], coming=[2]), _Queue([3])
    assert in_order([(10, early.take), (10, late.take)], [(4, 4)]) == [1, 2, 3, 4]


def test_no_more_is_taken_than_may_wait_however_fast_others_come():
    class Endless:
        taken = 0

        def take(self, most):
            self.taken += most
            return [(k, k) for k in range(most)]

    few, many = Endless(), Endless()
    found = in_order([(20, few.take), (2000, many.take)])
    assert (few.taken, many.taken, len(found)) == (20, 2000, 2020)


def test_messages_without_a_time_of_writing_are_not_held_back():
    assert in_order([(10, lambda most: [(0, "c"), (0, "d")][:most])], [(5, "a"), (0, "b")])[:2] == ["b", "c"]


def test_a_domain_that_is_none_is_refused():
    with pytest.raises(WireError, match="domain 300: expected 0 to 232"):
        Participant(300)


# --- recordings -------------------------------------------------------------------------------------------------------


def told(event):
    """All of an event, to be compared."""
    values = [getattr(event, field.name) for field in dataclasses.fields(event)]
    return (type(event).__name__, *(v.tobytes() if isinstance(v, np.ndarray) else repr(v) for v in values))


def played(path, config, rate, publishers=None):
    """Events that arrive when a recording is played, and the player; ``publishers`` gets the names of theirs."""
    events, names = [], set() if publishers is None else publishers

    def push(event, publisher):
        events.append(event)
        names.add(publisher)

    with Participant(DOMAIN) as one, Participant(DOMAIN) as other, Player(path, one) as player:
        topics = Intake(other, WireClock(other), config, push)

        def follow():
            while not ended.wait(0.05):
                topics.find()
                topics.subscribe()
                if topics.roles:
                    reading.set()

        reading, ended = threading.Event(), threading.Event()
        following = threading.Thread(target=follow)
        following.start()
        try:
            assert reading.wait(60.0)  # a busy machine takes longer between two readers than a player waits
            assert player.wait_for_readers(60.0)
            player.play(rate)
            player.finish()
            with open_recording(path, config) as recording:
                count = sum(1 for _ in recording.events())
            wait_until(lambda: len(events) >= count, 2.0, progress=lambda: len(events))
        finally:
            ended.set()
            following.join()
    assert not topics.undecodable
    return events, player


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_events_of_a_recording_arrive_as_they_are(tmp_path, kind):
    """Every field of every event, receive times and stamps of messages without a header included."""
    if kind == "ros1":
        path = write_ros1(tmp_path / "run.bag")
        config = RecordingConfig(topics=TopicsConfig(image="none", sightings="none"))
    else:
        path, config = storage_file(write_drive(tmp_path / "run", kind, n=100)), RecordingConfig()
    events, player = played(path, config, rate=20.0)
    with open_recording(path, config) as recording:
        expected = [told(event) for event in recording.events()]
        assert player.topics == tuple(sorted(t.name for t in recording.topics))
    assert len(expected) >= 300
    assert sorted(map(told, events)) == sorted(expected)
    assert not player.notes
    assert player.damaged == 0


def test_joints_of_two_topics_arrive_as_they_are(tmp_path):
    topics = {"image": "none", "sightings": "none"}
    config = RecordingConfig.model_validate({"joints": SIDES, "topics": topics})
    path = two_topics(tmp_path / "run", 5.0)
    publishers = set()
    events, _ = played(path, config, 5.0, publishers)
    assert len(publishers) == 1  # of two writers: a run would leave one of two out
    with open_recording(path, config) as recording:
        expected = [told(event) for event in recording.events()]
    assert len(expected) > 190
    assert [*map(told, events)] == expected


def test_joints_of_one_topic_arrive_once(tmp_path):
    joints = {"left": SIDES["left"]}
    config = RecordingConfig.model_validate({"joints": joints, "topics": {"image": "none", "sightings": "none"}})
    path = two_topics(tmp_path / "run", 3.0)
    events, _ = played(path, config, rate=5.0)
    with open_recording(path, config) as recording:
        assert [*map(told, events)] == [told(event) for event in recording.events()]


def test_timing_is_the_recorded_one(tmp_path):
    path = write_drive(tmp_path / "run", n=40)  # 2 s
    with Participant(DOMAIN) as one, Participant(DOMAIN) as other, Player(path, one) as player:
        came, ticks, clock, opened = [], [], WireClock(other), time.monotonic()
        other.read(CLOCK, CLOCK_TYPE, ticks.append)
        other.read(
            "/odom", "nav_msgs/msg/Odometry", lambda s: came.append((time.monotonic(), s.source_ns, clock.now_ns()))
        )
        assert player.wait_for_readers(60.0)
        began = time.monotonic()
        player.play(rate=2.0)
        took = time.monotonic() - began
        length_s = player.duration_s
        assert wait_until(lambda: len(came) == 40)
    assert 10 < len(ticks) <= (time.monotonic() - opened) * 100.0 + 1.0  # of /clock, a hundred a second
    assert length_s / 2.0 - 0.01 < took < length_s  # not faster than asked; slower only on a busy machine
    times, sources, clocks = (np.array(column) for column in zip(*came, strict=True))
    assert (np.diff(sources) == 50_000_000).all()
    late = (times - times[0]) - (sources - sources[0]) * 1e-9 / 2.0
    assert np.abs(np.median(late)) < 0.1
    assert np.median(np.abs(clocks - sources)) < 0.2e9  # /clock goes with it


def test_playing_can_be_stopped_and_needs_no_reader(tmp_path):
    path = write_drive(tmp_path / "run", n=100)  # 5 s
    stop = threading.Event()
    with Participant(DOMAIN) as one, Player(path, one) as player:
        assert not player.wait_for_readers(0.1)
        threading.Timer(0.3, stop.set).start()
        began = time.monotonic()
        player.play(1.0, stop)
        assert time.monotonic() - began < 4.0
        assert 0 < player.published < 400


def test_a_topic_that_cannot_be_sent_is_named_and_left_out(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    wide = "own_msgs/msg/Wide"
    with Writer(tmp_path / "run", version=9) as writer:
        connections = [
            writer.add_connection("/wide", wide, msgdef="wstring text\n", rihs01="RIHS01_" + "0" * 64),
            writer.add_connection("/cmd_vel", TWIST, typestore=store),
        ]
        for k in range(3):
            writer.write(connections[0], k * 10, b"\0\1\0\0" + bytes(8))
            writer.write(connections[1], k * 10, Messages().encode(TWIST, {}))
    with Participant(DOMAIN) as one, Player(tmp_path / "run", one) as player:
        assert player.topics == ("/cmd_vel",)
        (note,) = player.notes
        assert "/wide" in note
        player.play(1000.0)
        assert player.published == 3


def test_types_are_told_by_hash_and_read_as_the_publishers_distribution_has_them():
    """Jazzy's Range has a variance, which Humble's lacks: a reader with Humble's would take it for damaged."""
    range_type = "sensor_msgs/msg/Range"
    jazzy = Messages(get_typestore(Stores.ROS2_JAZZY))
    assert jazzy.type_hash(range_type) != Messages().type_hash(range_type)
    heard = []
    with Participant(DOMAIN, messages=jazzy) as one, Participant(DOMAIN) as other:
        writer = one.writer("/range", range_type)
        assert wait_until(lambda: other.publications() == (Publication("/range", range_type),))
        other.read("/range", range_type, heard.append)
        assert wait_until(lambda: writer.readers == 1)
        writer.publish({"range": 2.5, "variance": 0.25})
        assert wait_until(lambda: heard)
        back = other.decode(heard[0])
        assert (back.range, back.variance) == (2.5, 0.25)
