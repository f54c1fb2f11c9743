"""Small recordings for the tests of fgloc.recording."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from fgloc.recording.messages import Messages
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
TICK_NS = 50_000_000


def write_drive(folder: Path, storage: str = "mcap", n: int = 200, start_ns: int = START_NS) -> Path:
    """A rosbag2 folder: a robot on a circle with odometry, commands, wheel angles, tags seen, truth and static tf."""
    K = [[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]
    with BagWriter(folder, storage=storage) as bag:
        bag.static_transform(start_ns, "base_link", "camera_optical", (0.1, 0.0, 0.3), (-0.5, 0.5, -0.5, 0.5))
        bag.camera_info("/camera/camera_info", start_ns, (640, 480), K, [0.1, -0.2, 0.0, 0.0, 0.0])
        for k in range(n):
            stamp = start_ns + k * TICK_NS
            received = stamp + 2_000_000
            angle = 0.02 * k
            pose = (math.sin(angle), 1.0 - math.cos(angle), angle)
            bag.odometry("/odom", stamp, pose, (0.4, 0.4), received, (np.eye(6) * 1e-3, np.eye(6) * 1e-3))
            bag.command("/cmd_vel", stamp, 0.4, 0.4, received)
            bag.joints("/joint_states", stamp, ["left", "right"], [0.1 * k, 0.12 * k], received_ns=received)
            bag.planar_truth("/ground_truth/pose", stamp, pose, received)
            if k % 5 == 0:
                bag.range_bearing("/landmarks", stamp, [(1, 2.0, 0.1), (0, 3.0, -0.2)], received)
    return folder


def storage_file(folder: Path) -> Path:
    """The only .mcap or .db3 of a bag folder."""
    (file,) = [file for file in folder.iterdir() if file.suffix in (".mcap", ".db3")]
    return file


def write_ros1(path: Path, n: int = 100, chunk_bytes: int = 4096) -> Path:
    """A ROS 1 bag of Odometry, Pose2D truth and Twist commands, in several chunks."""
    store = get_typestore(Stores.ROS1_NOETIC)
    t = store.types

    def vector(x: float = 0.0, z: float = 0.0):
        return t["geometry_msgs/msg/Vector3"](x=x, y=0.0, z=z)

    def twist():
        return t["geometry_msgs/msg/Twist"](linear=vector(x=0.4), angular=vector(z=0.1))

    with Ros1Writer(path) as writer:
        writer.chunk_threshold = chunk_bytes
        connections = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in (
                ("/odom", "nav_msgs/msg/Odometry"),
                ("/cmd_vel", "geometry_msgs/msg/Twist"),
                ("/mocap/pose", "geometry_msgs/msg/Pose2D"),
            )
        }
        for k in range(n):
            received = START_NS + k * TICK_NS
            sec, nanosec = divmod(received - 1_000_000, 10**9)
            header = t["std_msgs/msg/Header"](
                seq=k, stamp=t["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec), frame_id="odom"
            )
            pose = t["geometry_msgs/msg/Pose"](
                position=t["geometry_msgs/msg/Point"](x=0.02 * k, y=0.0, z=0.0),
                orientation=t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            )
            odometry = t["nav_msgs/msg/Odometry"](
                header=header,
                child_frame_id="base_link",
                pose=t["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
                twist=t["geometry_msgs/msg/TwistWithCovariance"](twist=twist(), covariance=np.zeros(36)),
            )
            for topic, message in (
                ("/odom", odometry),
                ("/cmd_vel", twist()),
                ("/mocap/pose", t["geometry_msgs/msg/Pose2D"](x=0.02 * k, y=1.0, theta=0.5)),
            ):
                raw = store.serialize_ros1(message, connections[topic].msgtype)
                writer.write(connections[topic], received, raw)
    return path


COUNTS = "std_msgs/msg/Int32"
OWN = "own_msgs/msg/Wheels"
ROLL = 65536
PER_TICK = 0.001  # rad


def write_messages(path, messages, own=""):
    """A rosbag2 of ``(topic, type, received_ns, content)``; ``own``: the definition of `OWN`."""
    store, encoding = get_typestore(Stores.ROS2_HUMBLE), Messages()
    with Writer(path, version=9) as writer:
        connections = {}
        for topic, kind, at_ns, content in sorted(messages, key=lambda m: m[2]):
            if (topic, kind) not in connections:
                more = {"msgdef": own, "rihs01": "RIHS01_" + "0" * 64} if kind == OWN else {"typestore": store}
                connections[topic, kind] = writer.add_connection(topic, kind, **more)
            cdr = content if kind == OWN else encoding.encode(kind, content)
            writer.write(connections[topic, kind], at_ns, cdr)
    return path


def ticks(t, speed):
    """Counter of a wheel that turns with this rate [rad/s], as an unsigned number of 16 bits."""
    return round(60000 + speed * t / PER_TICK) % ROLL


def two_topics(path, seconds=10.0):
    """The left wheel's ticks at 20 Hz and the right one's 20 ms later."""
    left = [("/left", COUNTS, START_NS + k * 50_000_000, {"data": ticks(0.05 * k, 5.0)}) for k in range(200)]
    right = [
        ("/right", COUNTS, START_NS + k * 50_000_000 + 20_000_000, {"data": ticks(0.05 * k + 0.02, -6.0)})
        for k in range(200)
    ]
    return write_messages(path, [m for m in left + right if m[2] <= START_NS + seconds * 1e9])


SIDES = {
    "left": {"topic": "/left", "position": "data", "scale": PER_TICK, "rolls_over": ROLL},
    "right": {"topic": "/right", "position": "data", "scale": -PER_TICK, "rolls_over": ROLL},
}
