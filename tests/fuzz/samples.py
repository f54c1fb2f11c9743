"""Small sound recordings of every format, with a map: what is mutated."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys.store import Typestore

from fgloc import se2
from fgloc.recording.messages import default_typestore

START_NS = 1_700_000_000_000_000_000
BEACONS = {0: (3.0, 0.0), 1: (0.0, 3.0), 2: (-3.0, 0.0), 4: (0.0, -3.0)}
SAMPLES = ("ros1.bag", "ros1_bz2.bag", "ros1_lz4.bag", "mcap", "mcap_zstd", "sqlite3", "messages_zstd", "file_zstd")
"""By name; those without a suffix are rosbag2 folders."""


def _messages(store: Typestore, ros1: bool, seconds: float) -> list[tuple[str, str, int, object]]:
    """Topic, type, time and message of a robot on a circle that sees four beacons, with truth."""
    t = store.types
    rng = np.random.default_rng(3)
    pose, odometry = np.array([1.0, 0.0, math.pi / 2]), np.zeros(3)
    out: list[tuple[str, str, int, object]] = []

    def header(stamp: int, frame: str) -> object:
        time = t["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        extra = {"seq": 0} if ros1 else {}
        return t["std_msgs/msg/Header"](stamp=time, frame_id=frame, **extra)

    def place(p: np.ndarray) -> object:
        return t["geometry_msgs/msg/Pose"](
            position=t["geometry_msgs/msg/Point"](x=float(p[0]), y=float(p[1]), z=0.0),
            orientation=t["geometry_msgs/msg/Quaternion"](
                x=0.0, y=0.0, z=math.sin(0.5 * float(p[2])), w=math.cos(0.5 * float(p[2]))
            ),
        )

    for k in range(round(seconds * 20)):
        stamp = START_NS + k * 50_000_000
        twist = t["geometry_msgs/msg/Twist"](
            linear=t["geometry_msgs/msg/Vector3"](x=0.4, y=0.0, z=0.0),
            angular=t["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.4),
        )
        message = t["nav_msgs/msg/Odometry"](
            header=header(stamp, "odom"),
            child_frame_id="base_link",
            pose=t["geometry_msgs/msg/PoseWithCovariance"](pose=place(odometry), covariance=np.zeros(36)),
            twist=t["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
        )
        out.append(("/odom", "nav_msgs/msg/Odometry", stamp, message))
        truth = t["geometry_msgs/msg/PoseStamped"](header=header(stamp, "map"), pose=place(pose))
        out.append(("/truth", "geometry_msgs/msg/PoseStamped", stamp, truth))
        if k % 5 == 0:
            seen = [_sight(t, rng, pose, i) for i in BEACONS]
            array = t["landmark_msgs/msg/LandmarkArray"](header=header(stamp, "base_link"), landmarks=seen)
            out.append(("/landmarks", "landmark_msgs/msg/LandmarkArray", stamp, array))
        pose = se2.compose(pose, se2.exp((0.02, 0.0, 0.02)))
        wobble = rng.normal(0.0, 0.001, 2)
        odometry = se2.compose(odometry, se2.exp((0.02 + wobble[0], 0.0, 0.02 + wobble[1])))
    return out


def _sight(t: dict[str, type], rng: np.random.Generator, pose: np.ndarray, i: int) -> object:
    dx, dy = BEACONS[i][0] - pose[0], BEACONS[i][1] - pose[1]
    return t["landmark_msgs/msg/Landmark"](
        id=i,
        hamming=0,
        goodness=0.0,
        decision_margin=0.0,
        range=math.hypot(dx, dy) + rng.normal(0.0, 0.05),
        bearing=se2.wrap(math.atan2(dy, dx) - pose[2] + rng.normal(0.0, 0.02)),
    )


def make_samples(folder: Path, seconds: float = 6.0) -> None:
    """Write all samples into a folder, each with ``map.yaml`` beside it or in it."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = "".join(f"  - {{id: {i}, position: [{x}, {y}]}}\n" for i, (x, y) in BEACONS.items())
    (folder / "map.yaml").write_text(f"landmarks:\n{rows}")
    for name in SAMPLES:
        path = folder / name
        if path.suffix == ".bag":
            _write_ros1(path, seconds, name.removesuffix(".bag").partition("_")[2])
        else:
            _write_ros2(path, seconds, name)
            (path / "map.yaml").write_text((folder / "map.yaml").read_text())


def _write_ros1(path: Path, seconds: float, compression: str) -> None:
    store = default_typestore(ros1=True)
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression.upper()])
    with writer:
        writer.chunk_threshold = 16_384
        connections = {}
        for topic, kind, stamp, message in _messages(store, True, seconds):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], stamp, bytes(store.serialize_ros1(message, kind)))


def _write_ros2(path: Path, seconds: float, name: str) -> None:
    store = default_typestore()
    plugin = StoragePlugin.MCAP if name.startswith("mcap") else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    modes = {"mcap_zstd": "STORAGE", "messages_zstd": "MESSAGE", "file_zstd": "FILE"}
    if name in modes:
        writer.set_compression(CompressionMode[modes[name]], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, stamp, message in _messages(store, False, seconds):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], stamp, bytes(store.serialize_cdr(message, kind)))
