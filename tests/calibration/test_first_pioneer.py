"""A ROS 1 bag of a Pioneer whose conventions nobody states: what `fgloc init` finds in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import fgloc
from rosbags.rosbag1 import Writer

from fgloc.calibration.first_settings import RobotFile, first_settings
from fgloc.config import Config, config_of_file, load_config
from fgloc.evaluation.metrics import compute_metrics
from fgloc.recording.messages import default_typestore
from fgloc.recording.reader import open_recording
from fgloc.runner import run
from fgloc.sensors.wheels.events import OdometryEvent

_START_NS = 1_575_641_303_000_000_000
_WRONG_CLOCK_NS = 1_202_150_932_000_000_000
_CAMERA = (0.05, -0.02, 0.03)  # x, y, yaw in the base
_SCALE = 0.8  # true over reported
_TARGET = (-0.15, 0.01, -1.0)  # capture body in the base
_TRUTH_LATE_S = -0.046  # bursts of 12 at 120 Hz, stamped at their receipt: half a burst
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
def found(source: Path) -> RobotFile:
    return first_settings(source)


@pytest.fixture(scope="module")
def config(found: RobotFile) -> Config:
    return config_of_file(yaml.safe_load(found.text))


def test_init_finds_axes_mounting_scale_and_what_the_truth_tracks(found: RobotFile, config: Config) -> None:
    codes = {finding.code for finding in found.found}
    assert {"sightings.axes", "sightings.scale", "clock.truth", "truth.mounting"} <= codes
    assert config.recording.sightings_axes == "optical"
    assert config.recording.sightings_pose is not None
    _, y, *_, yaw = config.recording.sightings_pose  # the way ahead (0.05 m) is left at 0
    assert (y, yaw) == pytest.approx(_CAMERA[1:], abs=0.01)
    assert config.landmarks.range_scale == pytest.approx(_SCALE, abs=0.01)
    assert "sightings" not in config.recording.stamp_offset_s
    assert config.recording.stamp_offset_s["truth"] == pytest.approx(_TRUTH_LATE_S, abs=0.01)
    assert config.truth.yaw_offset_rad == pytest.approx(_TARGET[2], abs=0.01)
    assert config.truth.offset_m == pytest.approx(_TARGET[:2], abs=0.02)


def test_the_odometry_of_another_clock_is_read_at_its_receipt(source: Path, config: Config) -> None:
    assert config.recording.received_stamps == ("odometry",)
    with open_recording(source, config.recording) as recording:
        first = next(e for e in recording.events() if isinstance(e, OdometryEvent))
    assert first.stamp_ns == _START_NS


def test_the_robot_is_where_it_drove(source: Path, config: Config) -> None:
    metrics = compute_metrics(run(source, None, config, "batch"), config)
    assert metrics.ate_rmse_m is not None
    assert metrics.ate_rmse_m < 0.02


def test_calibrate_tells_what_bends_the_wheels(source: Path, found: RobotFile, tmp_path: Path) -> None:
    """Ranges that are too long: without a map the wheels take them up, and are wrong by as much."""
    content = yaml.safe_load(found.text)
    for name, scaled, code in (("sound", True, 0), ("wrong", False, 3)):
        if not scaled:
            del content["expert"]["landmarks"]["range_scale"]
        robot = tmp_path / f"{name}.yaml"
        robot.write_text(yaml.safe_dump(content))
        assert fgloc("calibrate", source, "--config", robot, "--out", tmp_path / f"{name}-found.yaml")[0] == code
    off = load_config(tmp_path / "wrong-found.yaml").wheels.scale_v
    assert off == pytest.approx(1.0 / _SCALE, rel=0.1)  # what is told
