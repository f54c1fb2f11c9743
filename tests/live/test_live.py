"""A live run: the same poses as a replay, poses between keyframes, threads, overload, sensors that join later."""

import dataclasses
import os
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from itertools import takewhile
from multiprocessing.connection import Connection
from pathlib import Path

import cv2
import numpy as np
import pytest
from event_makers import image, joints, odometry
from live_feed import PATIENCE_S, ROLES, errors, feed, live_in
from robot_world import CAMERA, START_NS, World, beacons, config, nees, room, truth_at
from world_bags import write_world

import fgloc
from fgloc.config import Config, TopicsConfig, load_config, yaml_of
from fgloc.errors import ConfigError, EstimatorError, ModelError, RecordingError
from fgloc.instrumentation import give_way
from fgloc.live import Live
from fgloc.live import process as estimation_process
from fgloc.live.engine import DetectionWorker, Keep, LiveStatus, Queued, Settings, State, overload_notes
from fgloc.live.live import begun_at
from fgloc.live.run import OnlineRun
from fgloc.live.state import fingerprint, read_state
from fgloc.recording.reader import open_recording
from fgloc.runner import run
from fgloc.sensors.base import with_values
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.markers.detector import TrackingDetector
from fgloc.sensors.markers.images import ImageEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import Mode, RawEvent, SightingsEvent, TransformEvent, TruthEvent

SAMPLES = Path(__file__).parent.parent.parent / "datasets" / "samples"
WAITED_S = 0.3  # what a slow detector of these tests takes


def until(seconds, events):
    """Events of the first seconds."""
    held = list(events)
    return list(takewhile(lambda e: e.received_ns < held[0].received_ns + seconds * 1e9, held))


def test_live_is_public():
    assert fgloc.Live is Live
    with pytest.raises(AttributeError, match="Alive"):
        _ = fgloc.Alive


def test_poses_are_those_of_a_replay_bit_by_bit(tmp_path):
    bag = write_world(tmp_path, World(room(), seconds=8.0))
    settings = config()
    replayed = run(bag, tmp_path / "map.yaml", settings, "online", check=False).trajectory
    with open_recording(bag, settings.recording) as recording:
        with Live(settings, tmp_path / "map.yaml", roles=recording.roles) as live:
            made = feed(live, recording.events())
        assert len(made) == len(replayed) - 1 or len(made) >= len(replayed) - 3  # the last ones come at the end
        for estimate, stamp, pose, cov in zip(made, replayed.stamps_ns, replayed.poses, replayed.covs, strict=False):
            assert estimate.stamp_ns == stamp
            assert (estimate.pose == pose).all()
            assert (estimate.cov == cov).all()


def test_images_give_the_poses_of_a_replay_bit_by_bit():
    """With images, a gyro and the learned motion; asked for poses meanwhile, which must change nothing."""
    sample = SAMPLES / "installed_run"
    settings = load_config(sample / "robot.yaml")
    replayed = {}
    run(
        sample / "bag",
        sample / "map.yaml",
        settings,
        "online",
        on_step=lambda step, e: replayed.update({} if e is None else {step.stamp_ns: e}),
        events=lambda events: iter(until(6.0, events)),
    )
    made = []
    with open_recording(sample / "bag", settings.recording) as recording:
        events, roles = until(6.0, recording.events()), recording.roles
    with Live(settings, sample / "map.yaml", roles=roles) as live:
        live.subscribe(made.append)
        for k, event in enumerate(events):
            live.push(event)
            if isinstance(event, ImageEvent):
                assert live.wait(PATIENCE_S)
            elif k % 20 == 0:
                live.pose_at()
        assert live.wait(PATIENCE_S)
        assert live.status().dropped == {}
    assert len(made) > 25
    assert all((e.pose == replayed[e.stamp_ns].pose).all() for e in made)


def test_in_a_process_of_its_own_the_run_is_the_same(tmp_path):
    """Estimates, poses between and beyond them, and the saved state; the process ends with the run."""
    world, told, states = World(room(), seconds=5.0, rate=5), [], []
    for process in (False, True):
        path = tmp_path / f"{process}.json"
        with live_in(world, process=process, state=path) as live:
            made = feed(live, world.events())
            newest = made[-1].stamp_ns
            asked = [live.pose_at(newest + round(s * 1e9)) for s in (-2.03, -0.5, 0.0, 0.07, 0.3)]
        assert live.status().keyframes == len(made) > 20
        told.append([(p.stamp_ns, *p.pose, *p.cov.ravel()) for p in (*made, *asked)])
        states.append(read_state(path, fingerprint(world.map)).state)
    assert told[0] == told[1]
    assert (states[0].pose, states[0].cov) == (states[1].pose, states[1].cov)
    assert not [t for t in threading.enumerate() if t.name.startswith("fgloc-")]
    with pytest.raises(EstimatorError, match="closed"):
        live.push(world.events()[0])


@pytest.fixture
def in_a_thread(monkeypatch):
    """A process of the estimation whose child is a thread of this one; and when each event came there, by a queue."""
    came = queue.Queue()

    class Heard:
        """Estimation that notes when events come, and answers."""

        def __init__(self, settings, outlet):
            pass

        def put(self, events):
            for event in events:
                came.put((time.monotonic(), event.stamp_ns))

        def wait(self, timeout_s):
            return timeout_s == 7.0

        def begin_again(self, keep, source):
            raise EstimatorError(keep.name)

        def close(self):
            pass

        def status(self):
            return LiveStatus(keyframes=5)

    class Child:
        def __init__(self, arguments, **options):
            self._end = socket.socket(fileno=os.dup(int(arguments[3])))
            self._thread = threading.Thread(target=self._run)
            self._thread.start()

        def _run(self):
            with Connection(os.dup(self._end.fileno())) as connection, suppress(SystemExit):
                estimation_process._Worker(connection).run()

        def kill(self):
            self._end.shutdown(socket.SHUT_RDWR)

        def wait(self):
            self._thread.join()
            self._end.close()

    monkeypatch.setattr(estimation_process, "Estimation", Heard)
    monkeypatch.setattr(estimation_process.subprocess, "Popen", Child)
    monkeypatch.setattr(estimation_process.os, "_exit", sys.exit)
    monkeypatch.setattr(estimation_process.gc, "freeze", lambda: None)
    estimation = estimation_process.EstimationProcess()
    estimation.begin(Settings(Config(), None, None, None, None), None)
    yield estimation, came
    estimation.close()


def test_motion_reaches_the_process_of_the_estimation_after_a_moment_however_long_there_was_none(in_a_thread):
    estimation, came = in_a_thread
    took_s = []
    for k in range(8):
        time.sleep(0.05)
        began = time.monotonic()
        estimation.put([odometry(1.0 + k)])
        when, stamp_ns = came.get(timeout=10.0)
        assert stamp_ns == (1 + k) * 10**9
        took_s.append(when - began)
    assert min(took_s) < 0.15  # of many, as this machine may be busy


def test_questions_to_the_process_of_the_estimation_are_answered_or_fail_as_there(in_a_thread):
    estimation, came = in_a_thread
    assert estimation.wait(7.0)
    assert not estimation.wait(6.0)
    with pytest.raises(EstimatorError, match=r"^INSTALLATION$"):
        estimation.begin_again(Keep.INSTALLATION)
    estimation.put([odometry(1.0)])
    estimation.close()
    assert came.qsize() == 1  # what was put before is used
    assert estimation.status().keyframes == 5


def test_an_estimation_process_that_ends_or_fails_is_told():
    world = World(beacons(), seconds=2.0)
    with live_in(world, process=True) as live:
        feed(live, world.events())
        os.kill(live._estimation._child.pid, signal.SIGKILL)
        with pytest.raises(EstimatorError, match=r"-9\b"):
            live.wait(PATIENCE_S)
        with pytest.raises(EstimatorError, match=r"-9\b"):
            live.pose_at()
    settings = config(wheels={"source": "ticks", "left_radius": 0.05, "right_radius": 0.05, "track": 0.3})
    names = ("left_wheel", "left_wheel_rear")
    with Live(settings, beacons(), roles=("joints",), process=True) as live:
        with pytest.raises(ConfigError, match=", ".join(names)):
            feed(live, [joints(1.0 + 0.02 * k, 0.0, 0.0, names=names) for k in range(200)])
        with pytest.raises(ConfigError):
            live.pose_at()


def test_fault_24_an_estimation_process_that_hangs_is_told(monkeypatch):
    monkeypatch.setattr("fgloc.live.process._SILENT_S", 0.8)
    world = World(beacons(), seconds=2.0)
    with live_in(world, process=True) as live:
        feed(live, world.events())
        before = live.status()
        child = live._estimation._child.pid
        os.kill(child, signal.SIGSTOP)
        said = [live.status() for _ in range(2)][-1]
        assert not live.wait(0.1)
        os.kill(child, signal.SIGCONT)
        assert live.wait(PATIENCE_S)
        after = live.status()
    [hangs] = set(said.notes) - set(before.notes)
    assert re.search(r"\b1 s\b", hangs)
    assert said.keyframes == before.keyframes
    assert after.notes == before.notes


def test_poses_between_keyframes_are_as_good_as_their_covariance_says():
    world = World(room(), seed=3, seconds=12.0, rate=5)
    told = []
    with live_in(world) as live:
        for event in world.events():
            live.push(event)
            live.wait(PATIENCE_S)
            pose = live.pose_at()
            if pose is not None:
                told.append((pose, world.truth(pose.stamp_ns)))
    beyond = [(p, t) for p, t in told if p.stamp_ns > p.keyframe_ns]
    assert len(beyond) > 100
    assert max(p.stamp_ns - p.keyframe_ns for p, _ in beyond) > 0.1e9
    assert np.mean([np.hypot(*(p.pose - t)[:2]) for p, t in beyond]) < 0.03
    assert 0.2 < np.mean([nees(p, t) for p, t in beyond]) / 3.0 < 2.0


def test_a_slip_that_has_just_begun_does_not_carry_the_pose_away():
    """The wheels spin on a patch from 14.28 s on, by up to 0.2 m/s: the learned motion reads their torque."""
    sample = SAMPLES / "patches_run"
    settings = load_config(sample / "robot.yaml")
    with open_recording(sample / "bag", settings.recording) as recording:
        events, roles = until(15.0, recording.events()), recording.roles
    start = events[0].received_ns
    events = [e for e in events if e.received_ns > start + 12e9 or isinstance(e, TransformEvent)]
    truth = [e for e in events if isinstance(e, TruthEvent)]
    stamps, x, y = (np.array(c) for c in zip(*((e.stamp_ns, *e.position[:2]) for e in truth), strict=True))
    apart = []
    with Live(with_values(settings, "live", {"image_queue": 100}), sample / "map.yaml", roles=roles) as live:
        for event in events:
            live.push(event)
            if event.received_ns > start + 14.2e9 and isinstance(event, JointsEvent):
                assert live.wait(PATIENCE_S)
                pose = live.pose_at()
                at = np.interp(pose.stamp_ns, stamps, x), np.interp(pose.stamp_ns, stamps, y)
                apart.append(np.hypot(*(pose.pose[:2] - at)))
    assert len(apart) > 30
    assert max(apart) < 0.03


def test_the_covariance_grows_with_the_time_beyond_the_last_message():
    world = World(room(), seconds=6.0, rate=5)
    with live_in(world) as live:
        last = feed(live, world.events())[-1]
        newest = live.pose_at().stamp_ns
        ahead = [live.pose_at(newest + round(s * 1e9)) for s in (0.0, 0.3, 0.6, 1.5, 3.0)]
        assert live.pose_at(newest + 60_000_000_000) is None
        assert live.pose_at(last.stamp_ns - 60_000_000_000) is None
        past = live.pose_at(last.stamp_ns - 1_000_000_000)
    traces = [np.trace(p.cov[:2, :2]) for p in ahead]
    assert traces == sorted(traces)
    assert traces[-1] > 10.0 * traces[0]
    assert [p.mode for p in ahead] == [Mode.OK] * 4 + [Mode.DEAD_RECKONING]
    assert past.keyframe_ns <= past.stamp_ns < last.stamp_ns
    assert np.hypot(*(past.pose - world.truth(past.stamp_ns))[:2]) < 0.05


def test_many_threads_may_push_and_ask():
    world = World(room(), seconds=4.0, rate=5)
    events = world.events()
    kinds = [[e for e in events if e.topic == topic] for topic in ("/odom", "/cmd_vel", "/tags")]
    asked, failed = [], []

    def push(live, some):
        try:
            for event in some:
                live.push(event)
                asked.append(live.pose_at())
                live.status()
        except Exception as error:
            failed.append(error)

    with live_in(world) as live:
        threads = [threading.Thread(target=push, args=(live, some)) for some in kinds]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE_S)
        assert live.wait(PATIENCE_S)
        status = live.status()
    assert not failed
    assert {topic: t.count for topic, t in status.topics.items()} == {k[0].topic: len(k) for k in kinds}
    assert status.queued_events == status.queued_images == 0


def test_an_image_that_was_looked_at_waits_no_more():
    sample = SAMPLES / "first_run"
    settings = load_config(sample / "robot.yaml")
    with open_recording(sample / "bag", settings.recording) as recording:
        events, roles = until(1.0, recording.events()), recording.roles
    with Live(settings, sample / "map.yaml", roles=roles) as live:
        made = feed(live, events)
        assert live.status().queued_images == 0
    assert any(isinstance(e, ImageEvent) for e in events)
    assert made


@pytest.mark.parametrize(("topics", "waiting"), [({}, 1), ({"image": "none"}, 0)])
def test_an_image_of_a_topic_that_is_not_used_does_not_wait(topics, waiting):
    """Before the run begins, the others do."""
    with Live(config(recording={"topics": topics}), beacons(), roles=ROLES) as live:
        live.push(image(1.0))
        live.push(dataclasses.replace(image(1.1), topic="/other"))
        assert live.wait(PATIENCE_S)
        status = live.status()
    assert status.queued_events == status.queued_images == waiting
    assert status.dropped["image"] == 2 - waiting


def test_of_images_that_wait_the_oldest_gives_way_to_a_new_one():
    changed = threading.Condition()
    worker = DetectionWorker(changed, 3, TopicsConfig())
    images = [Queued(RawEvent(k, k, "/image", "cam"), State.WAITING, True) for k in range(5)]
    with changed:
        for image in images:
            worker.arrived(image)
    worker.stop()
    assert [image.event is None for image in images] == [image.state is State.GONE for image in images]
    assert [image.state for image in images] == [State.GONE] * 2 + [State.WAITING] * 3
    assert (worker.queued, worker.dropped, worker.early) == (3, 2, 2)
    [told] = overload_notes(worker.dropped - worker.early, 0, worker.early)
    assert "faster" not in told  # no detector was there yet


def test_a_comparison_that_goes_on_does_not_hold_up_the_end(monkeypatch):
    """On a busy machine it took more than ten seconds: the process was killed, its last state not saved."""
    begun, done = threading.Event(), []

    def compare():
        begun.set()
        until_s = time.monotonic() + 15.0
        while time.monotonic() < until_s:
            time.sleep(0.01)
            give_way()
        done.append(True)

    monkeypatch.setattr(OnlineRun, "comparison", lambda run: compare)
    with Live(config(), beacons(), roles=ROLES):
        assert begun.wait(PATIENCE_S)
        closing_s = time.monotonic()
    assert time.monotonic() - closing_s < 10.0
    assert not done


@pytest.mark.parametrize("fails", [False, True])
def test_a_worker_that_has_ended_keeps_no_comparison_waiting(fails):
    changed, entered, going_on = threading.Condition(), threading.Event(), threading.Event()

    class Slow:
        def detect(self, event):
            entered.set()
            assert going_on.wait(PATIENCE_S)
            if fails:
                raise RuntimeError("of the detector")

    worker = DetectionWorker(changed, 3, TopicsConfig())
    worker.detector = Slow()
    with changed:
        for k in range(2):
            worker.submit(Queued(RawEvent(k, k, "/image", "cam"), State.WAITING, True))
    assert entered.wait(PATIENCE_S)
    assert worker.detecting
    going_on.set()
    worker.stop()
    assert not worker.detecting


def test_without_a_map_motion_is_waited_for():
    with Live(config(), None) as live:
        made = feed(live, [e for e in World(beacons(), seconds=20.0).events() if isinstance(e, SightingsEvent)])
        status = live.status()
    assert not made
    assert any("motion source" in what for what in status.waiting_for)


def test_under_overload_the_oldest_waiting_image_is_dropped(monkeypatch):
    sample = SAMPLES / "first_run"
    settings = load_config(sample / "robot.yaml")
    seen = []
    detect = TrackingDetector.detect

    def slowly(self, event):
        time.sleep(WAITED_S)
        seen.append(event.stamp_ns)
        return detect(self, event)

    monkeypatch.setattr(TrackingDetector, "detect", slowly)
    with open_recording(sample / "bag", settings.recording) as recording:
        events = until(4.0, recording.events())
        images = [e.stamp_ns for e in events if isinstance(e, ImageEvent)]
        settings = with_values(settings, "live", {"image_queue": 3})
        with Live(settings, sample / "map.yaml", roles=recording.roles) as live:
            began = time.perf_counter()
            for event in events:
                live.push(event)
                assert live.status().queued_images <= 4  # three wait, one is looked at
            assert time.perf_counter() - began < 0.5 * len(images) * WAITED_S
            assert live.wait(PATIENCE_S)
            status = live.status()
    assert status.dropped["image"] == len(images) - len(seen) > 5
    told = [int(note.split()[0]) for note in status.notes if "image(s) dropped" in note]
    assert sum(told) == status.dropped["image"]  # those dropped before the run had begun are told apart
    assert seen == sorted(seen)
    assert seen[-3:] == images[-3:]


def test_a_subscriber_that_fails_is_named_and_left_out():
    world = World(beacons(), seconds=5.0)
    called = []

    def fails(estimate):
        called.append(estimate)
        raise ZeroDivisionError("of theirs")

    with live_in(world) as live:
        live.subscribe(fails)
        made = feed(live, world.events())
        notes = live.status().notes
    assert len(called) == 1
    assert len(made) > 20
    assert [n for n in notes if "ZeroDivisionError: of theirs" in n]


def test_what_cannot_be_used_is_told_by_the_next_call():
    names = ("left_wheel", "left_wheel_rear")
    settings = config(wheels={"source": "ticks", "left_radius": 0.05, "right_radius": 0.05, "track": 0.3})
    live = Live(settings, beacons(), roles=("joints",))
    events = [joints(1.0 + 0.02 * k, 0.0, 0.0, names=names) for k in range(200)]
    with pytest.raises(ConfigError, match=", ".join(names)):
        feed(live, events)
    with pytest.raises(ConfigError):
        live.pose_at()
    live.close()


def test_a_wrong_file_is_refused_at_once(tmp_path):
    (tmp_path / "no.safetensors").write_bytes(b"nothing")
    settings = Config.model_validate({"motion": {"model": tmp_path / "no.safetensors"}})
    with pytest.raises(ModelError):
        Live(settings, beacons())


def test_after_close_nothing_more_is_taken():
    world = World(beacons(), seconds=3.0)
    events = world.events()
    with live_in(world) as live:
        feed(live, events)
    live.close()
    with pytest.raises(EstimatorError, match="closed"):
        live.push(events[-1])
    assert live.pose_at() is not None
    assert not [t for t in threading.enumerate() if t.name.startswith("fgloc-")]


def test_a_gyro_that_begins_later_joins_without_losing_the_pose():
    world = World(room(), seconds=8.0)
    events = world.events()
    rate = np.array([0.0, 0.0, 0.33])
    for k in range(400, 800):
        stamp = START_NS + k * 10_000_000
        events.append(ImuEvent(stamp, stamp, "/imu", "base_link", rate, np.zeros(3), np.zeros((3, 3))))
    with live_in(world) as live:
        made = feed(live, sorted(events, key=lambda e: e.received_ns))
        status = live.status()
        assert live._estimation.run.parts.localizer.motion.sources.gyro is not None
    after = [e for e in made if e.stamp_ns > START_NS + 4_000_000_000]
    assert {e.mode for e in after} == {Mode.OK}
    assert errors(world, after).max() < 0.06
    assert status.waiting_for == ()


def test_without_roles_the_run_begins_after_a_while_and_a_calibration_may_come_later():
    world = World(room(), seconds=6.0)
    with Live(config(live={"startup_s": 1.0}), world.map) as live:
        feed(live, until(0.5, world.events()))
        early = live.status()
        assert not early.running
        assert any("no CameraInfo yet" in what for what in early.waiting_for)
        feed(live, world.events()[len(until(0.5, world.events())) : len(until(3.0, world.events()))])
        assert live.status().running
        assert live.status().mode is None
        live.camera_info(640, 480, CAMERA.K, np.zeros(4), frame_id="cam")
        live.transform("base_link", "cam", CAMERA.T_base_cam[:3, 3], [-0.5, 0.5, -0.5, 0.5])
        made = feed(live, world.events()[len(until(3.0, world.events())) :])
        assert live.status().waiting_for == ()
    assert made[-1].mode is Mode.OK
    assert errors(world, made[-10:]).max() < 0.06


def test_a_pose_that_is_told_is_taken_and_sightings_win_over_a_wrong_one():
    world = World(room(), seconds=9.0)
    events = world.events()
    dark, light = until(3.0, events), events[len(until(3.0, events)) :]
    with live_in(world, roles=("odometry", "command")) as live:
        feed(live, [e for e in dark if e.topic != "/tags"])
        live.reset_pose(truth_at(3.0), (0.1, 0.1, 0.1))
        made = feed(live, until(1.0, [e for e in light if e.topic != "/tags"]))
        assert errors(world, made[-1:]).max() < 0.2
        live.reset_pose((2.0, 2.0, 3.0), (0.05, 0.05, 0.05))
        made = feed(live, light[len(until(1.0, light)) :])
        assert any("jumped" in note for note in live.status().notes)
    assert errors(world, made[-10:]).max() < 0.06
    assert made[-1].mode is Mode.OK


@pytest.mark.parametrize("miss", [(0.0, 0.0, 0.0), (0.7, -0.4, 0.1), (2.0, 2.0, 3.0)])
def test_sightings_win_over_a_wrong_first_pose_and_the_bound_holds_until_then(miss):
    world = World(room(), seconds=9.0)
    given = begun_at(config(), (truth_at(0.0) + miss).tolist(), "--initial-pose")
    with Live(given, room(), roles=("odometry", "command")) as live:
        live.camera_info(640, 480, CAMERA.K, np.zeros(4), frame_id="cam")
        live.transform("base_link", "cam", CAMERA.T_base_cam[:3, 3], [-0.5, 0.5, -0.5, 0.5])
        made = feed(live, world.events())
    bounds = [estimate.protection.position_m for estimate in made if estimate.protection is not None]
    assert len(bounds) == len(made) > 20
    assert (errors(world, made) < bounds).all()
    assert errors(world, made[-10:]).max() < 0.06
    assert made[-1].mode is Mode.OK


def test_a_pose_that_is_told_is_taken_though_no_message_comes():
    world = World(beacons(), seconds=1.0)
    with live_in(world) as live:
        feed(live, world.events())
        live.reset_pose((1.0, 2.0, 0.5), (0.1, 0.1, 0.1))
        assert live.wait(5.0)


def test_a_pose_that_is_none_is_refused():
    with Live(config(), beacons()) as live:
        for pose, sigmas in (((0.0, 0.0), (1.0, 1.0, 1.0)), ((0.0, 0.0, np.nan), (1, 1, 1)), ((0, 0, 0), (1, 0, 1))):
            with pytest.raises(EstimatorError, match=re.escape(f"{pose} with sigmas {sigmas}")):
                live.reset_pose(pose, sigmas)


def test_events_may_be_told_in_plain_numbers():
    """A loop of one's own: ranges to beacons, odometry and a command; then corners and images."""
    landmarks = beacons()
    with Live(config(), landmarks, roles=("odometry", "sightings")) as live:
        for event in World(landmarks, seconds=4.0).events():
            if event.topic == "/odom":
                x, y, yaw = truth_at((event.stamp_ns - START_NS) * 1e-9)
                live.odometry(event.stamp_ns, (x, y, yaw), (event.linear[0], 0.0, event.angular[2]))
                live.imu(event.stamp_ns, event.angular)
            elif event.topic == "/cmd_vel":
                live.command(event.stamp_ns, event.v, event.omega)
            else:
                live.ranges(event.stamp_ns, [(s.landmark_id, s.range_m, s.bearing_rad) for s in event.sightings])
        assert live.wait(PATIENCE_S)
        pose = live.pose_at()
        assert np.hypot(*(pose.pose - truth_at((pose.stamp_ns - START_NS) * 1e-9))[:2]) < 0.15
        assert set(live.status().topics) == {"odometry", "imu", "command", "sightings"}
        with pytest.raises(RecordingError, match=r"\(4, 4\).*\bfloat64\b"):
            live.image(1, np.zeros((4, 4)))


def test_images_may_be_arrays_or_files():
    sample = SAMPLES / "first_run"
    settings = load_config(sample / "robot.yaml")
    with open_recording(sample / "bag", settings.recording) as recording:
        events, roles = until(3.0, recording.events()), recording.roles
    forms = (
        lambda data: data.tobytes(),
        lambda data: cv2.imdecode(data, cv2.IMREAD_GRAYSCALE),
        lambda data: np.dstack([cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)] * 3),
    )
    poses = []
    for form in forms:
        with Live(settings, sample / "map.yaml", roles=roles) as live:
            for event in events:
                if isinstance(event, ImageEvent):
                    live.image(event.stamp_ns, form(event.data), event.frame_id)
                    assert live.wait(PATIENCE_S)
                else:
                    live.push(event)
            assert live.wait(PATIENCE_S)
            poses.append(live.pose_at())
    assert poses[0].mode is Mode.OK
    assert np.allclose([p.pose for p in poses[1:]], poses[0].pose, atol=2e-3)


def test_the_status_says_how_the_topics_come_in():
    world = World(room(), seconds=6.0, late_s=0.04)
    events = [e for e in world.events() if e.topic != "/cmd_vel" or e.stamp_ns < START_NS + 2_000_000_000]
    began = time.perf_counter()
    with live_in(world) as live:
        feed(live, events)
        status = live.status()
    took_ms = 1e3 * (time.perf_counter() - began)
    assert status.topics["/odom"].rate_hz == pytest.approx(20.0, rel=0.05)
    assert status.topics["/tags"].delay_s == pytest.approx(0.04, abs=0.005)
    assert status.topics["/tags"].role == "sightings"
    assert [n for n in status.notes if re.match(r"/cmd_vel: .*\b4 s$", n)]
    assert status.mode is Mode.OK
    assert status.running
    assert 0.0 < status.step_ms <= status.step_ms_max <= took_ms
    assert 0.0 <= status.reordering_s < 0.2
    assert status.keyframes > 30


def test_no_update_takes_longer_than_all_of_the_run():
    world, began = World(beacons(), seconds=1.0), time.perf_counter()
    with live_in(world) as live:
        feed(live, world.events())
        status = live.status()
    took_ms = 1e3 * (time.perf_counter() - began)
    assert 0.0 < status.step_ms <= status.step_ms_max < took_ms


def test_the_example_runs(tmp_path):
    """On a short drive: the bundled one takes longer."""
    write_world(tmp_path, World(room(), seconds=8.0, rate=5))
    (tmp_path / "robot.yaml").write_text(yaml_of(config(), tmp_path), encoding="utf-8")
    example = Path(__file__).parent.parent.parent / "examples" / "live_loop.py"
    assert len(example.read_text(encoding="utf-8").splitlines()) < 40
    done = subprocess.run([sys.executable, example, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if line.endswith(" OK")]


@pytest.mark.parametrize("roles", [None, ("sightings",)])
def test_sightings_alone_tell_the_pose_until_odometry_comes(roles):
    world = World(beacons(), seconds=40.0)
    late_ns = START_NS + 20_000_000_000
    events = [
        e
        for e in world.events()
        if isinstance(e, SightingsEvent) or (isinstance(e, OdometryEvent) and e.stamp_ns > late_ns)
    ]
    with Live(config(), beacons(), roles=roles) as live:
        made = feed(live, [e for e in events if e.stamp_ns <= late_ns])
        assert len(made) > 150
        assert np.median(errors(world, made)) < 0.1
        assert np.isfinite(live.pose_at().pose).all()
        assert any("speed" in f.text for f in live.status().findings)
        later = feed(live, [e for e in events if e.stamp_ns > late_ns])
        assert "odometry" in {of.role for of in live.status().topics.values()}
        assert np.median(errors(world, later[-50:])) < 0.05
