"""``fgloc live`` and ``fgloc play``: poses on the wire are those of an online run; frames, map, commands."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from live_feed import PATIENCE_S
from recording_bags import write_drive
from typer.testing import CliRunner
from wire import DOMAIN, wait_until

import fgloc
from fgloc import se2
from fgloc.cli import app
from fgloc.cli import live as commands
from fgloc.cli.options import configured
from fgloc.cli.terminal import EXIT_LOST
from fgloc.config import Config, load_config
from fgloc.errors import WireError
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.live import LivePose, LiveStatus
from fgloc.live.wire import node, play
from fgloc.live.wire.node import Node, Teller
from fgloc.live.wire.outputs import SPAN_S, OdomFrame, Outputs, RecentPoses
from fgloc.live.wire.participant import Participant, Sample
from fgloc.live.wire.play import Player
from fgloc.recording.storage import Storage
from fgloc.runner import run
from fgloc.sensors.base import with_values
from fgloc.sensors.maps import load_map
from fgloc.types import Mode, TransformEvent
from fgloc_datasets.bag import BagWriter

SAMPLE = Path(fgloc.__file__).parent.parent / "datasets" / "samples" / "first_run"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
OUTPUTS = {
    "/fgloc/odometry": "nav_msgs/msg/Odometry",
    "/fgloc/pose": POSE,
    "/tf": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/fgloc/protection": "geometry_msgs/msg/Vector3Stamped",
}


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(node, "SETTLED_S", 0.2)
    monkeypatch.setattr(play, "_QUIET_S", 0.5)


class Session:
    """A node and someone who listens to it, both in this process."""

    def __init__(self, config, landmarks=None):
        self.heard = {topic: [] for topic in OUTPUTS}
        self.told = []
        self.stop = threading.Event()
        self.other = Participant(DOMAIN)
        for topic, kind in OUTPUTS.items():
            self.other.read(topic, kind, self._hear)
        self.participant = Participant(DOMAIN)
        self.node = Node(self.participant, config, landmarks)
        self._thread = threading.Thread(target=self.node.run, args=(self.stop, self.told.append))

    def _hear(self, sample):
        self.heard[sample.topic].append((sample.source_ns, self.other.messages.decode(sample.message_type, sample.cdr)))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self.stop.set()
        self._thread.join()
        self.node.close()
        self.participant.close()
        self.other.close()

    def planar(self, topic):
        """Stamps and poses of what was published."""
        messages = [message for _, message in self.heard[topic]]
        return np.array([ns(m) for m in messages]), np.array([pose_of(m.pose.pose) for m in messages])


def ns(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def pose_of(pose):
    q = pose.orientation
    return (pose.position.x, pose.position.y, quaternion_yaw((q.x, q.y, q.z, q.w)))


def excerpt(folder, seconds):
    """The beginning of the sample."""
    storage = Storage(SAMPLE / "bag")
    end_ns = storage.span_ns[0] + round(seconds * 1e9)
    with BagWriter(folder) as bag:
        for topic, kind, received_ns, raw in storage.messages():
            if received_ns <= end_ns and bag.knows(kind):
                bag.copy(topic, kind, raw, received_ns)
    storage.close()
    return folder


def test_poses_on_the_wire_are_those_of_an_online_run(tmp_path, monkeypatch):
    bag = excerpt(tmp_path / "bag", 8.0)
    config, landmarks = load_config(SAMPLE / "robot.yaml"), load_map(SAMPLE / "map.yaml")
    config = with_values(config, "live", {"image_queue": 1000})  # however busy this machine is
    with Session(config, landmarks) as session, Participant(DOMAIN) as one, Player(bag, one) as player:
        assert player.wait_for_readers(PATIENCE_S)
        player.play(2.5)
        player.finish()
        drawn = []
        session.other.read("/fgloc/map", "visualization_msgs/msg/MarkerArray", drawn.append, latched=True)
        assert session.node.live.wait(PATIENCE_S)
        assert wait_until(lambda: len(session.heard["/diagnostics"]) >= 4 and drawn)
    online = run(bag, SAMPLE / "map.yaml", config, "online").trajectory
    stamps, poses = session.planar("/fgloc/pose")
    order = np.argsort(stamps)
    assert set(stamps) == set(online.stamps_ns)
    assert np.abs(poses[order] - online.poses).max() < 1e-6
    covariance = np.array(
        [m.pose.covariance.reshape(6, 6)[np.ix_((0, 1, 5), (0, 1, 5))] for _, m in session.heard["/fgloc/pose"]]
    )
    np.testing.assert_allclose(covariance[order], online.covs, atol=1e-9)

    stamps, poses = session.planar("/fgloc/odometry")
    assert len(stamps) > 20
    assert (np.diff(stamps) > 0).all()
    inside = (stamps > online.stamps_ns[0]) & (stamps < online.stamps_ns[-1])
    apart = poses[inside] - se2.interpolate(online.stamps_ns, online.poses, stamps[inside])
    assert np.median(np.abs(apart[:, :2])) < 0.03  # carried on beyond a keyframe; further on a busy machine
    odometry = [message for _, message in session.heard["/fgloc/odometry"]]
    assert odometry[0].child_frame_id == "base_link"
    variances = np.array([m.twist.covariance.reshape(6, 6).diagonal() for m in odometry[20:]])
    assert (variances[:, [2, 3, 4]] == 0.0).all()
    assert (np.sqrt(np.median(variances[:, [0, 1, 5]], axis=0)) < 0.2).all()  # m/s, m/s, rad/s
    assert (variances[:, [0, 1, 5]] > 0.0).all()
    (transform,) = session.heard["/tf"][-1][1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    markers = session.other.messages.decode("visualization_msgs/msg/MarkerArray", drawn[0].cdr).markers
    assert {m.text for m in markers if m.ns == "ids"} == {str(i) for i in landmarks.landmarks}
    told = [message.status[0] for _, message in session.heard["/diagnostics"]]
    status = [one for one in told if one.level != 3][-1]  # stale: the recording has ended
    assert (status.message, status.level) == ("OK", 0)
    values = {pair.key: pair.value for pair in status.values}
    assert values["image topic"] == "/camera/image/compressed"
    assert float(values["joints rate [Hz]"]) == pytest.approx(50.0, rel=0.2)
    assert any("/odom (odometry)" in sentence for sentence in session.told)


def test_a_pose_told_on_the_wire_moves_the_robot_and_its_odometry_frame(tmp_path):
    """Dead reckoning on a circle from a pose that is given before there is anything else; then somebody corrects it."""
    bag = write_drive(tmp_path / "run")  # 10 s
    topics = {"image": "none", "sightings": "none", "command": "none", "joints": "none"}
    config = Config.model_validate({"recording": {"topics": topics}, "estimator": {"initial_pose": (9.0, 9.0, 0.0)}})
    stop = threading.Event()
    with Session(config) as session, Participant(DOMAIN) as one:
        writer = one.writer("/initialpose", POSE)

        def give(frame, x, y, yaw):
            variances = np.zeros((6, 6))
            variances[[0, 1, 5], [0, 1, 5]] = 1e-4
            pose = {"position": {"x": x, "y": y}, "orientation": dict(zip("xyzw", yaw_quaternion(yaw), strict=True))}
            message = {"header": {"frame_id": frame}, "pose": {"pose": pose, "covariance": variances.ravel()}}
            writer.write(one.messages.encode(POSE, message))

        assert wait_until(lambda: writer.readers)
        give("map", 1.0, 2.0, 0.0)
        player = Player(bag, one)
        assert player.wait_for_readers(PATIENCE_S)
        playing = threading.Thread(target=player.play, args=(3.0, stop))
        playing.start()
        assert wait_until(lambda: len(session.heard["/tf"]) > 20)
        (before,) = session.heard["/tf"][-1][1].transforms
        give("somewhere", 90.0, -7.0, 1.0)
        give("map", 50.0, -7.0, 1.0)
        assert wait_until(lambda: session.heard["/fgloc/odometry"][-1][1].pose.pose.position.x > 40.0)
        assert wait_until(lambda: any("frame 'somewhere'" in sentence for sentence in session.told))
        stop.set()
        playing.join()
        player.close()
    t = before.transform.translation
    assert (t.x, t.y) == pytest.approx((1.0, 2.0), abs=0.05)
    _, poses = session.planar("/fgloc/odometry")
    assert np.hypot(poses[-1, 0] - 50.0, poses[-1, 1] + 7.0) < 3.0


def test_two_publishers_of_one_topic_are_told_apart():
    """A second node publishes an odometry that stands still, under the same name; when the first ends, it is used."""
    topics = {"image": "none", "sightings": "none"}
    config = Config.model_validate({"recording": {"topics": topics}, "estimator": {"initial_pose": (0.0, 0.0, 0.0)}})
    odometry = "nav_msgs/msg/Odometry"
    sent = 0
    with Session(config) as session, Participant(DOMAIN) as base, Participant(DOMAIN) as ghost:
        writers = [one.writer("/odom", odometry) for one in (base, ghost)]
        assert wait_until(lambda: all(writer.readers for writer in writers))

        def send(count, first):
            """At 50 Hz: 1 m/s by the first, and 0 by the second, a millisecond later."""
            nonlocal sent
            for _ in range(count):
                now, sent = time.time_ns(), sent + 1
                for k, writer in enumerate(writers[0 if first else 1 :], 0 if first else 1):
                    stamp = now + k * 1_000_000
                    header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": f"odom_{k}"}
                    place = {"pose": {"position": {"x": 0.02 * sent}, "orientation": {"w": 1.0}}} if k == 0 else {}
                    speed = {"twist": {"linear": {"x": 1.0 - k}}}
                    message = {"header": header, "child_frame_id": "base_link", "pose": place, "twist": speed}
                    writer.write(base.messages.encode(odometry, message))
                time.sleep(0.02)

        send(200, first=True)
        assert session.node.live.wait(PATIENCE_S)
        status = session.node.live.status()
        moved = session.node.live.pose_at()
        assert wait_until(lambda: any("/odom: two publishers" in sentence for sentence in session.told))
        send(75, first=False)  # 1.5 s
        assert session.node.live.wait(PATIENCE_S)
        dropped = session.node.live.status().dropped["odometry"] - status.dropped["odometry"]
    count = status.topics["/odom"].count
    assert count == status.dropped["odometry"] == pytest.approx(200, abs=2)
    assert moved.pose[0] > 3.0
    frames = {message.transforms[0].child_frame_id for _, message in session.heard["/tf"]}
    assert frames == {"odom_0", "odom_1"}
    assert 30 < dropped < 60  # as long as the first might still come


def test_an_odometry_that_is_late_has_its_frame_on_tf_and_bounds_and_state_beside_it():
    """Its stamps are 0.4 s behind the clock; the poses that are kept reach back 0.125 s."""
    topics = {"image": "none", "sightings": "none"}
    config = Config.model_validate({"recording": {"topics": topics}, "estimator": {"initial_pose": (5.0, 2.0, 0.0)}})
    session, made = Session(config), []
    session.node.subscribe(made.append)
    with session, Participant(DOMAIN) as base:
        writer = base.writer("/odom", "nav_msgs/msg/Odometry")
        assert wait_until(lambda: writer.readers)
        for k in range(150):  # 3 s
            stamp = time.time_ns() - 400_000_000
            message = {
                "header": {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "odom"},
                "child_frame_id": "base_link",
                "pose": {"pose": {"position": {"x": 0.02 * k}, "orientation": {"w": 1.0}}},
                "twist": {"twist": {"linear": {"x": 1.0}}},
            }
            writer.publish(message)
            time.sleep(0.02)
    assert {ns(message) for _, message in session.heard["/fgloc/pose"]} <= {estimate.stamp_ns for estimate in made}
    assert len(session.heard["/tf"]) > 50
    (last,) = session.heard["/tf"][-1][1].transforms
    t = last.transform.translation
    assert (last.header.frame_id, last.child_frame_id) == ("map", "odom")
    assert (t.x, t.y) == pytest.approx((5.0, 2.0), abs=0.1)
    bound = session.heard["/fgloc/protection"][-1][1].vector
    assert 0.0 < bound.x < 10.0
    assert {status.level for _, message in session.heard["/diagnostics"] for status in message.status}


def test_ambiguous_topics_are_an_error_and_missing_ones_are_waited_for():
    told = []
    with Participant(DOMAIN) as one, Participant(DOMAIN) as other:
        node = Node(other, Config(), None)
        writers = [one.writer("/left/odometry", "nav_msgs/msg/Odometry")]

        def tell(said):
            told.append(said)
            if len(writers) == 1:
                writers.append(one.writer("/right/odometry", "nav_msgs/msg/Odometry"))

        with pytest.raises(WireError, match="/left/odometry, /right/odometry"):
            node.run(threading.Event(), tell)
        node.close()
    [waiting] = told
    assert "/left/odometry (nav_msgs/msg/Odometry)" in waiting


def test_another_fgloc_in_the_domain_is_named():
    """Its poses and transforms were mixed with this one's, and nothing said so."""
    told, stop = [], threading.Event()
    with Participant(DOMAIN) as one, Participant(DOMAIN) as other:
        rival, node_ = Outputs(one, "map", "fgloc"), Node(other, Config(), None)
        threading.Timer(1.5, stop.set).start()
        node_.run(stop, told.append)
        node_.close()
    assert rival
    [said] = [sentence for sentence in told if "publishes /fgloc/" in sentence]
    assert "domain" in said


def test_a_run_that_has_begun_says_what_it_still_waits_for(monkeypatch):
    monkeypatch.setattr(node, "_PATIENCE_S", 0.3)
    lacking = "image (/camera): no transform from base_link to 'lens' yet"
    told, stop = [], threading.Event()
    with Participant(DOMAIN) as participant:
        waiting = Node(participant, Config(), None)
        monkeypatch.setattr(waiting.intake, "find", lambda: "")
        waiting.live = SimpleNamespace(status=lambda: LiveStatus(waiting_for=(lacking,)), close=lambda: None)
        threading.Timer(1.2, stop.set).start()
        waiting.run(stop, told.append)
        waiting.close()
    assert told == [f"Waiting for {lacking}."]


@pytest.mark.parametrize("late", [5, 0, 2.5])
def test_a_keyframe_that_moves_the_robot_is_no_motion(late):
    """A circle at 0.4 m/s and 0.5 rad/s; a keyframe, some turns late, moves it by some centimetres."""

    def pose_at(stamp_ns):
        corrected = keyframes[-1]
        on_circle = se2.exp((0.4e-9 * stamp_ns, 0.0, 0.5e-9 * stamp_ns))
        moved = se2.compose((0.03 * len(keyframes), -0.02, 0.01 * len(keyframes)), on_circle)
        cov = np.diag([1e-4, 4e-4, 9e-4])  # at the keyframe, in the base's axes; then growing with time
        motion = se2.exp(1e-9 * (stamp_ns - corrected) * np.array([0.4, 0.0, 0.5]))
        ad = se2.adjoint(se2.inverse(motion))
        cov = ad @ cov @ ad.T + 1e-9 * (stamp_ns - corrected) * growth
        return LivePose(stamp_ns, moved, se2.rotate_cov(cov, moved[2]), Mode.OK, corrected)

    growth = np.array([[2e-3, 1e-4, 0.0], [1e-4, 1e-3, 2e-4], [0.0, 2e-4, 4e-3]])  # m²/s, rad²/s
    keyframes = [0]
    recent = RecentPoses(pose_at)
    for k in range(1, 60):
        if k % 10 == 0:
            keyframes.append(round((k - late) * 20_000_000))
        recent.add(pose_at(k * 20_000_000))
        if k > 1:
            assert recent.twist()[0] == pytest.approx([0.4, 0.0, 0.5], abs=1e-6 if late != 2.5 else 2e-3)
        if k > 6:
            assert recent.twist()[1].diagonal() == pytest.approx(growth.diagonal() / SPAN_S, rel=0.1)
    later = pose_at(59 * 20_000_000 + 20_000_000)
    ahead = recent.ahead(later.stamp_ns)
    assert ahead.pose == pytest.approx(later.pose, abs=1e-9)
    assert ahead.cov.diagonal() == pytest.approx(later.cov.diagonal(), rel=0.02)
    assert recent.ahead(later.stamp_ns + 1_000_000_000) is None
    between = 59 * 20_000_000 - 30_000_000
    assert recent.at(between) == pytest.approx(pose_at(between).pose, abs=1e-4)  # linear between two poses
    assert recent.at(0) is None
    recent.add(pose_at(20_000_000))  # the clock was set back
    assert recent.twist()[0].tolist() == [0.0, 0.0, 0.0]


def transform(parent, child, x, static=False):
    return TransformEvent(1, 1, "/tf", parent, child, np.array([x, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]), static)


def test_the_map_is_told_to_those_that_come_later():
    landmarks, drawn = load_map(SAMPLE / "map.yaml"), []
    with Participant(DOMAIN) as one, Participant(DOMAIN) as other:
        outputs = Outputs(one)
        outputs.map(landmarks)
        other.read("/fgloc/map", "visualization_msgs/msg/MarkerArray", drawn.append, latched=True)
        assert wait_until(lambda: drawn)


def test_the_transform_to_the_base_is_the_odometry_frame():
    odom = OdomFrame(Config().recording)
    assert odom.base == "base_link"
    assert odom.latest() is None
    odom.add(transform("base_footprint", "camera", 0.1, static=True))
    odom.add(transform("/wheel_odom", "/base_footprint", 3.0))
    odom.add(transform("map", "wheel_odom", 9.0))
    assert odom.base == "base_footprint"
    assert (odom.latest().frame, odom.latest().T_odom_base.tolist()) == ("wheel_odom", [3.0, 0.0, 0.0])


def test_a_sentence_is_told_once_whatever_its_figures():
    told = []
    teller = Teller(told.append)
    teller.tell("12 images dropped", "wheels slip")
    teller.tell("13 images dropped", "wheels slip")
    teller.waiting("Waiting for odometry.")
    assert told == ["12 images dropped", "wheels slip"]


# --- commands ---------------------------------------------------------------------------------------------------------


def command(*arguments):
    return [sys.executable, "-m", "fgloc.cli", *map(str, arguments)]


def test_two_commands_as_two_processes(tmp_path):
    """Ctrl-C ends with a summary; how soon, `benchmarks.live_wire` tells."""
    bag = excerpt(tmp_path / "bag", 4.0)
    files = ["--map", SAMPLE / "map.yaml", "--config", SAMPLE / "robot.yaml", "--state", tmp_path / "state.json"]
    live = subprocess.Popen(
        command("live", "--domain", DOMAIN, *files), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    poses = []
    try:
        with Participant(DOMAIN) as other:
            other.read("/fgloc/pose", POSE, poses.append)
            done = subprocess.run(
                command("play", bag, "--domain", DOMAIN, "--rate", 4, "--wait", PATIENCE_S),
                capture_output=True,
                text=True,
                timeout=3 * PATIENCE_S,
                check=False,
            )
            assert wait_until(lambda: len(poses) >= 14), done.stdout
        time.sleep(2.0)  # the inputs have stopped
        live.send_signal(signal.SIGINT)
        said, _ = live.communicate(timeout=PATIENCE_S)
    finally:
        live.kill()
    assert done.returncode == 0, done.stderr
    assert "messages published" in done.stdout
    assert live.returncode == EXIT_LOST, said
    assert re.search("^last mode +STALE", said, re.MULTILINE), said
    summary = dict(line.split(maxsplit=1) for line in said.splitlines() if line.startswith(("keyframes", "duration")))
    assert int(summary["keyframes"]) == pytest.approx(20, abs=6), said
    assert "Subscribed: /odom (odometry)." in said
    assert "last mode" in said
    assert re.search(r"^\w.*  x -?\d\.\d+ m  y", said, re.MULTILINE)  # no terminal is needed to see where it is
    assert (tmp_path / "state.json").stat().st_size > 100


def test_ctrl_c_while_live_starts_ends_it_as_later_and_a_run_without_a_pose_is_not_to_be_trusted(monkeypatch):
    def interrupted(*arguments):
        signal.raise_signal(signal.SIGINT)
        return configured(*arguments)

    monkeypatch.setattr(commands, "configured", interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        done = CliRunner().invoke(app, ["live", "--domain", str(DOMAIN)])
    finally:
        signal.signal(signal.SIGINT, before)
    assert done.exit_code == EXIT_LOST, done.output
    assert "duration" in done.stdout


@pytest.mark.parametrize("arguments", [["live"], ["play", str(SAMPLE / "bag")]])
def test_without_cyclonedds_the_remedy_is_named(monkeypatch, arguments):
    for name in [name for name in sys.modules if name.partition(".")[0] == "cyclonedds"]:
        monkeypatch.setitem(sys.modules, name, None)
    done = CliRunner().invoke(app, arguments)
    assert (done.exit_code, "pip install 'fgloc[live]'" in done.stderr) == (1, True), done.stderr


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["live", "--initial-pose", "1,2"], "--initial-pose 1,2"),
        (["live", "--domain", "900"], "900"),
        (["live", "--map", "nowhere.yaml"], "nowhere.yaml"),
        (["play", "nowhere.bag"], "nowhere.bag"),
        (["play", str(SAMPLE / "bag"), "--rate", "0"], "--rate 0"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_line(arguments, why):
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 1
    assert done.stderr.startswith("error: ")
    assert why in done.stderr
    assert os.linesep not in done.stderr.strip()


@pytest.mark.parametrize(
    ("x", "variance", "norm", "cut"),
    [
        (1e300, 1e-4, 1.0, 0),
        (float("nan"), 1e-4, 1.0, 0),
        (1.0, 1e300, 1.0, 0),
        (1.0, 1e-4, 0.0, 0),
        (1.0, 1e-4, 1.0, 9),
    ],
)
def test_a_given_pose_of_any_content_is_refused_and_counted(x, variance, norm, cut):
    with Session(Config()) as session, Participant(DOMAIN) as one:
        variances = np.zeros((6, 6))
        variances[[0, 1, 5], [0, 1, 5]] = variance
        pose = {"position": {"x": x}, "orientation": {"w": norm}}
        message = {"header": {"frame_id": "map"}, "pose": {"pose": pose, "covariance": variances.ravel()}}
        cdr = one.messages.encode(POSE, message)
        session.node._on_initial_pose(Sample("/initialpose", POSE, cdr[: len(cdr) - cut], 0))
        assert session.node.refused["/initialpose"] == 1


def test_a_given_pose_without_one_coordinate_is_refused():
    with Session(Config()) as session, Participant(DOMAIN) as one:
        pose = {"position": {"x": 1.0, "y": float("nan")}, "orientation": {"w": 1.0}}
        cdr = one.messages.encode(POSE, {"header": {"frame_id": "map"}, "pose": {"pose": pose}})
        session.node._on_initial_pose(Sample("/initialpose", POSE, cdr, 0))
        assert session.node.refused["/initialpose"] == 1


def test_text_that_is_no_text_in_a_given_pose_is_refused():
    with Session(Config()) as session, Participant(DOMAIN) as one:
        message = {"header": {"frame_id": "map"}, "pose": {"pose": {"orientation": {"w": 1.0}}}}
        damaged = one.messages.encode(POSE, message).replace(b"map", b"\xff\xfe\xfd")
        session.node._on_initial_pose(Sample("/initialpose", POSE, damaged, 0))
        assert session.node.refused["/initialpose"] == 1


def test_an_impossible_odometry_moves_no_frame():
    frame = OdomFrame(Config().recording)
    for position in ([1.0, 2.0, 0.0], [1e300, 0.0, 0.0], [np.nan, 0.0, 0.0]):
        frame.add(TransformEvent(1, 1, "/tf", "odom", "base_link", np.array(position), np.array([0.0, 0, 0, 1]), False))
    assert frame.latest().T_odom_base == pytest.approx([1.0, 2.0, 0.0])
