"""Pioneer: a small ROS 1 bag like the real ones, what the converter finds in it, and the real ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from dataset_files import header_ns, read_back
from real_data import real_data
from rosbags.rosbag1 import Writer

from fgloc.config import load_config
from fgloc.errors import RecordingError
from fgloc.recording.messages import default_typestore
from fgloc.recording.reader import open_recording
from fgloc.sensors.marker_pose import MarkerPosesEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Trajectory, TruthEvent
from fgloc_datasets.pioneer import convert, date_bursts, sensor_mounting

_START_NS = 1_575_641_303_000_000_000
_WRONG_CLOCK_NS = 1_202_150_932_000_000_000
_CAMERA = (0.05, -0.02, 0.03)  # x, y, yaw in the base
_SCALE = 0.8  # true over reported
_TARGET = (-0.15, 0.01, -1.0)  # capture body in the base
_DURATION_S = 40


def _pose(t: float) -> tuple[float, float, float]:
    """A wavy circle."""
    yaw = 0.25 * t + 0.6 * math.sin(0.5 * t)
    n = max(2, int(t / 0.01))
    s = np.linspace(0.0, t, n)
    heading = 0.25 * s + 0.6 * np.sin(0.5 * s)
    return float(np.trapezoid(0.2 * np.cos(heading), s)), float(np.trapezoid(0.2 * np.sin(heading), s)), yaw


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Odometry at 10 Hz with a wrong clock, markers at 5 Hz, capture in bursts of 12 at 10 Hz."""
    path = tmp_path_factory.mktemp("pioneer") / "small.bag"
    store = default_typestore(ros1=True)
    make: Callable[..., object] = lambda kind, **fields: store.types[kind](**fields)  # noqa: E731
    rng = np.random.default_rng(3)
    markers = {i: (2.5 * math.cos(i), 1.0 + 2.5 * math.sin(i)) for i in range(6)}

    def header(ns: int, frame: str) -> object:
        stamp = make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        return make("std_msgs/msg/Header", seq=0, stamp=stamp, frame_id=frame)

    def pose3(x: float, y: float, z: float, yaw: float) -> object:
        turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
        return make("geometry_msgs/msg/Pose", position=make("geometry_msgs/msg/Point", x=x, y=y, z=z), orientation=turn)

    messages = []
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    for k in range(10 * _DURATION_S):
        received = _START_NS + k * 100_000_000
        twist = make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=make("geometry_msgs/msg/Twist", linear=zero, angular=zero),
            covariance=np.zeros(36),
        )
        x, y, yaw = _pose(0.1 * k)
        pose = make("geometry_msgs/msg/PoseWithCovariance", pose=pose3(x, y, 0.0, yaw), covariance=np.zeros(36))
        odometry = make(
            "nav_msgs/msg/Odometry",
            header=header(received - _WRONG_CLOCK_NS, "odom"),
            child_frame_id="base_link",
            pose=pose,
            twist=twist,
        )
        messages.append((received, "/pioneer/pose", "nav_msgs/msg/Odometry", odometry))
        for j in range(12):  # all at once, the last one fresh
            bx, by, byaw = _pose(max(0.0, 0.1 * k - (11 - j) / 120))
            c, s = math.cos(byaw), math.sin(byaw)
            tx, ty, tyaw = _TARGET
            body = make("geometry_msgs/msg/Pose2D", x=bx + c * tx - s * ty, y=by + s * tx + c * ty, theta=byaw + tyaw)
            when = received + 1_000_000 * j // 2
            messages.append((when, "/mocap_node/Robot_1/ground_pose", "geometry_msgs/msg/Pose2D", body))
    for k in range(5 * _DURATION_S):
        exposed = _START_NS + k * 200_000_000 + 7_000_000
        x, y, yaw = _pose((exposed - _START_NS) * 1e-9)
        found = []
        for i, (mx, my) in markers.items():
            c, s = math.cos(yaw), math.sin(yaw)
            ahead, left = c * (mx - x) + s * (my - y) - _CAMERA[0], c * (my - y) - s * (mx - x) - _CAMERA[1]
            c, s = math.cos(_CAMERA[2]), math.sin(_CAMERA[2])
            ahead, left = c * ahead + s * left, c * left - s * ahead
            if ahead > 0.3 and abs(left / ahead) < 0.7:
                z, right = (v / _SCALE + rng.normal(0, 0.003) for v in (ahead, -left))
                place = make(
                    "geometry_msgs/msg/PoseWithCovariance", pose=pose3(right, 0.1, z, 0.0), covariance=np.zeros(36)
                )
                stamped = header(exposed, "base_link")
                found.append(make("aruco_msgs/msg/Marker", header=stamped, id=i, pose=place, confidence=1.0))
        array = make("aruco_msgs/msg/MarkerArray", header=header(exposed, "base_link"), markers=found)
        messages.append((exposed + 9_000_000, "/aruco_marker_publisher/markers", "aruco_msgs/msg/MarkerArray", array))
    with Writer(path) as writer:
        connections = {}
        for received, topic, kind, message in sorted(messages, key=lambda m: m[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], received, store.serialize_ros1(message, kind))
    return path


@pytest.fixture(scope="module")
def out(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("converted")
    convert(source, folder)
    return folder


def test_nothing_is_lost_and_receive_times_stay(source: Path, out: Path) -> None:
    before, after = read_back(source)[0], read_back(out / "bag")[0]
    assert {topic: len(found) for topic, found in before.items()} == {
        topic: len(found) for topic, found in after.items()
    }
    for topic, found in before.items():
        assert sorted(when for when, _ in found) == [when for when, _ in after[topic]]
    seen_before = [
        (m.id, m.pose.pose.position.z) for _, a in before["/aruco_marker_publisher/markers"] for m in a.markers
    ]
    seen_after = [
        (m.id, m.pose.pose.position.z) for _, a in after["/aruco_marker_publisher/markers"] for m in a.markers
    ]
    assert seen_before == seen_after


def test_stamps_are_set_right(out: Path) -> None:
    messages, received = read_back(out / "bag")
    assert received == sorted(received)
    assert all(header_ns(message) == when for when, message in messages["/pioneer/pose"])
    captured = np.array([header_ns(message) for _, message in messages["/mocap_node/Robot_1/ground_pose"]])
    assert (np.diff(captured) > 0).all()
    assert np.median(np.diff(captured)) == pytest.approx(1e9 / 120, rel=0.02)


def test_mounting_scale_and_target_are_found(out: Path) -> None:
    config = load_config(out / "robot.yaml")
    assert config.recording.sightings_pose is not None
    x, y, _, _, _, yaw = config.recording.sightings_pose
    assert (x, y, yaw) == pytest.approx(_CAMERA, abs=0.01)
    assert config.landmarks.range_scale == pytest.approx(_SCALE, abs=0.01)
    assert config.recording.stamp_offset_s["sightings"] == pytest.approx(0.0, abs=0.01)
    assert (*config.truth.offset_m, config.truth.yaw_offset_rad) == pytest.approx(_TARGET, abs=0.01)
    assert config.recording.sightings_axes == "optical"


def test_one_configuration_fits_the_original_and_the_converted_bag(source: Path, out: Path) -> None:
    config = load_config(out / "robot.yaml")
    for path in (source, out / "bag"):
        with open_recording(path, config.recording) as recording:
            events = list(recording.events())
        kinds = [sum(isinstance(e, kind) for e in events) for kind in (OdometryEvent, MarkerPosesEvent, TruthEvent)]
        assert kinds == [400, 200, 4800]
        first = next(e for e in events if isinstance(e, OdometryEvent))
        assert first.stamp_ns == _START_NS


def test_bursts_are_dated_back_and_stay_in_order() -> None:
    ms = 1_000_000
    received = np.array([0, 500, 1_000_000, 100 * ms, 100 * ms + 400_000], dtype=np.int64) + _START_NS
    dated = date_bursts(received) - _START_NS
    period = round(1e9 / 120)
    np.testing.assert_array_equal(dated[3:], [100 * ms + 400_000 - period, 100 * ms + 400_000])
    np.testing.assert_array_equal(dated[:3], 1_000_000 - period * np.array([2, 1, 0]))
    crowded = (
        np.concatenate([[0], np.full(30, 50 * ms)]) + _START_NS
    )  # 30 poses cannot have fitted into 50 ms at 120 Hz
    dated = date_bursts(crowded) - _START_NS
    assert (np.diff(dated) > 0).all()
    assert dated[-1] == 50 * ms


def test_a_bag_of_something_else_is_refused(out: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nothing\.bag"):
        convert(tmp_path / "nothing.bag", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_too_few_sightings_are_no_calibration() -> None:
    stamps = np.arange(100, dtype=np.int64) * 10**8
    still = Trajectory(stamps, np.zeros((100, 3)))
    with pytest.raises(RecordingError, match="expected 50"):
        sensor_mounting(still, stamps[:2], np.array([1, 1]), np.ones((2, 2)))


_REAL = {"duarte": (643, 799, 4580, 858, 0.97), "pinto1": (554, 1029, 3176, 1307, 0.80)}


@pytest.mark.real_data
@pytest.mark.parametrize("name", _REAL)
def test_real_bags_lose_nothing(name: str, tmp_path: Path) -> None:
    source = real_data("pioneer_aruco", f"{name}.bag")
    odometry, arrays, truth, markers, scale = _REAL[name]
    messages, received = read_back(convert(source, tmp_path))
    assert received == sorted(received)
    assert [len(messages[topic]) for topic in ("/pioneer/pose", "/mocap_node/Robot_1/ground_pose")] == [odometry, truth]
    sightings = messages["/aruco_marker_publisher/markers"]
    assert (len(sightings), sum(len(m.markers) for _, m in sightings)) == (arrays, markers)
    config = load_config(tmp_path / "robot.yaml")
    assert config.landmarks.range_scale == pytest.approx(scale, abs=0.01)
    assert config.truth.align == "se2"
