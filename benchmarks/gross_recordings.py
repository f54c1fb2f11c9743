"""Recordings of `benchmarks.gross`: a minute of a simulated drive as installed, with one gross mistake made on purpose.

A mistake changes ``robot.yaml``, ``map.yaml`` or the messages of the bag; everything else is as it was recorded. What
has to be reported of it is a pattern of the first sentence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

from fgloc.config import file_content
from fgloc.files.settings import joined
from fgloc.recording.messages import default_typestore
from fgloc.types import FloatArray

LENGTH_S = 60.0
SHIFT = (2.0, -1.0, 0.7)  # m, m, rad: of a frame that is not the map's
Settings = dict[str, Any]
Edit = Callable[[Any], None]
"""Changes a message in place."""


@dataclass(frozen=True, slots=True)
class Mistake:
    """One mistake, and what the first sentence about it has to hold.

    Attributes:
        said: regular expression.
        robot: changes ``robot.yaml``, given the first pose of the truth too.
        map: changes ``map.yaml``.
        messages: by topic.
    """

    said: str
    robot: Callable[[Settings, tuple[float, float, float]], None] = lambda robot, start: None
    map: Callable[[Settings], None] = lambda landmarks: None
    messages: Mapping[str, Edit] = field(default_factory=dict)


def _size(factor: float) -> Mistake:
    def change(landmarks: Settings) -> None:
        for landmark in landmarks["landmarks"]:
            landmark["size"] *= factor

    low, high = 0.2 * 0.98, 0.2 * 1.02
    return Mistake(rf"size.*set size: (?P<value>[\d.]+)(?#{low:.4f} {high:.4f})", map=change)


def _mounted(roll: float, pitch: float, yaw: float, said: str) -> Mistake:
    """The transform of the camera turned by these angles [deg] against the true one."""

    def change(robot: Settings, start: tuple[float, float, float]) -> None:
        angles = [math.radians(a) for a in (roll, pitch, yaw)]
        robot.setdefault("recording", {})["sightings_pose"] = [0.1, 0.0, 0.25, *angles]

    return Mistake(said, robot=change)


def _radius(factor: float) -> Mistake:
    def change(robot: Settings, start: tuple[float, float, float]) -> None:
        for side in ("left_radius", "right_radius"):
            robot["wheels"][side] *= factor

    return Mistake(r"radi.*left_radius: (?P<value>[\d.]+)(?#0.0485 0.0515)", robot=change)


def _swap_joints(robot: Settings, start: tuple[float, float, float]) -> None:
    wheels = robot["wheels"]
    wheels["left_joint"], wheels["right_joint"] = wheels["right_joint"], wheels["left_joint"]


def _mirror(landmarks: Settings) -> None:
    """The sign of y changed; markers look along the mirrored direction, upright as before."""
    for landmark in landmarks["landmarks"]:
        x, y, z = landmark["position"]
        qx, qy, qz, qw = landmark.pop("quaternion")
        normal = 2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx)
        landmark["position"], landmark["facing"] = [x, -y, z], math.atan2(-normal[1], normal[0])


def _swap_ids(landmarks: Settings) -> None:
    """Exchange the ids of two markers on opposite walls, most often seen in validation and test recordings alike."""
    first, second = landmarks["landmarks"][7], landmarks["landmarks"][9]
    first["id"], second["id"] = second["id"], first["id"]


def _shift_map(landmarks: Settings) -> None:
    for landmark in landmarks["landmarks"]:
        landmark["position"][0] += SHIFT[0]
        landmark["position"][1] += SHIFT[1]


def _start_here(robot: Settings, start: tuple[float, float, float]) -> None:
    robot["estimator"] = {"initial_pose": list(start)}


def _dictionary(robot: Settings, start: tuple[float, float, float]) -> None:
    robot["markers"]["dictionary"] = "DICT_6X6_50"


def _by_odometry(robot: Settings, start: tuple[float, float, float]) -> None:
    robot["wheels"] = {"source": "twist", "noise": robot["wheels"]["noise"]}


def _scaled(k: FloatArray, factor: float) -> FloatArray:
    return np.concatenate([factor * k[:6], k[6:]])


def _half(message: Any) -> None:
    message.width, message.height = message.width // 2, message.height // 2
    message.k = _scaled(message.k, 0.5)


def _double_k(message: Any) -> None:
    message.k = _scaled(message.k, 2.0)


def _no_distortion(message: Any) -> None:
    message.d = np.zeros(5)


def _roll_over(message: Any) -> None:
    message.position = np.mod(message.position, 2.0 * math.pi)


def _quarter_turn(message: Any) -> None:
    """The twist in the axes of a frame whose x axis points to the robot's left."""
    twist = message.twist.twist.linear
    twist.x, twist.y = twist.y, -twist.x


def _other_frame(message: Any) -> None:
    p, q = message.pose.position, message.pose.orientation
    yaw = 2.0 * math.atan2(q.z, q.w) + SHIFT[2]
    c, s = math.cos(SHIFT[2]), math.sin(SHIFT[2])
    p.x, p.y = c * p.x - s * p.y + SHIFT[0], s * p.x + c * p.y + SHIFT[1]
    q.x, q.y, q.z, q.w = 0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)


def _late(seconds: float) -> Edit:
    def change(message: Any) -> None:
        stamp = message.header.stamp
        total = stamp.sec * 1_000_000_000 + stamp.nanosec + round(seconds * 1e9)
        stamp.sec, stamp.nanosec = divmod(total, 1_000_000_000)

    return change


_CAMERA = ("/camera/camera_info", "/camera/image/compressed")

MISTAKES: dict[str, Mistake] = {
    "size_0.95": _size(0.95),
    "size_1.05": _size(1.05),
    "size_0.8": _size(0.8),
    "size_1.2": _size(1.2),
    "dictionary": Mistake(r"DICT_4X4_50.*markers\.dictionary", robot=_dictionary),
    "info_resolution": Mistake(r"640x480.*320x240", messages={"/camera/camera_info": _half}),
    "info_scaled": Mistake(
        r"focal_scale: (?P<value>[\d.]+)(?#0.485 0.515)", messages={"/camera/camera_info": _double_k}
    ),
    "info_distortion": Mistake(
        r"camera\.k1: (?P<value>-?[\d.]+)(?#-0.15 -0.09)", messages={_CAMERA[0]: _no_distortion}
    ),
    "camera_upside_down": _mounted(180.0, 0.0, 0.0, r"upside down.*sightings_pose"),
    "camera_quarter_roll": _mounted(90.0, 0.0, 0.0, r"camera.*viewing axis.*sightings_pose"),
    "camera_yaw_90": _mounted(0.0, 0.0, 90.0, r"camera.*right.*sightings_pose"),
    "camera_yaw_10": _mounted(0.0, 0.0, 10.0, r"camera.*right.*sightings_pose"),
    "camera_pitch_15": _mounted(0.0, 15.0, 0.0, r"camera.*sightings_pose"),
    "joints_swapped": Mistake(r"left_joint: left_wheel_joint.*right_joint: right_wheel_joint", robot=_swap_joints),
    "radius_1.1": _radius(1.1),
    "radius_2": _radius(2.0),
    "roll_over": Mistake(r"angle_range: (?P<value>[\d.]+)(?#6.28 6.29)", messages={"/joint_states": _roll_over}),
    "map_mirrored": Mistake(r"map is mirrored", map=_mirror),
    "map_shifted": Mistake(r"map is shifted", robot=_start_here, map=_shift_map),
    "ids_swapped": Mistake(r"ids? 7 and 9.*(exchange|swap)", map=_swap_ids),
    "odometry_frame": Mistake(r"[Oo]dometry.*turned", robot=_by_odometry, messages={"/odom": _quarter_turn}),
    "truth_frame": Mistake(r"truth\.align: se2", messages={"/truth": _other_frame}),
    "camera_late": Mistake(
        r"stamp_offset_s: \{image: (?P<value>-?[\d.]+)(?#-0.34 -0.26)", messages=dict.fromkeys(_CAMERA, _late(0.3))
    ),
    "camera_clock": Mistake(r"image.*received_stamps", messages=dict.fromkeys(_CAMERA, _late(3600.0))),
    "imu_clock": Mistake(r"imu.*received_stamps", messages={"/imu": _late(-1000.0)}),
}


def write(source: Path, folder: Path, mistake: Mistake | None, length_s: float = LENGTH_S) -> Path:
    """A recording with a mistake in ``folder``: bag, ``robot.yaml`` and ``map.yaml``; None: a sound one.

    Args:
        source: folder of a simulated recording.
        folder: to be made.
        mistake: what is wrong.
        length_s: of it; the rest of the source is left out.

    Returns:
        The bag.
    """
    made = mistake or Mistake("")
    folder.mkdir(parents=True)
    start = _copied(source / "bag", folder / "bag", made.messages, length_s)
    robot = joined(yaml.safe_load((source / "robot.yaml").read_text(encoding="utf-8")))
    landmarks = yaml.safe_load((source / "map.yaml").read_text(encoding="utf-8"))
    robot, landmarks = deepcopy(robot), deepcopy(landmarks)
    made.robot(robot, start)
    made.map(landmarks)
    (folder / "robot.yaml").write_text(yaml.safe_dump(file_content(robot)), encoding="utf-8")
    (folder / "map.yaml").write_text(yaml.safe_dump(landmarks), encoding="utf-8")
    return folder / "bag"


def _copied(source: Path, target: Path, edits: Mapping[str, Edit], length_s: float) -> tuple[float, float, float]:
    """The beginning of a bag with these messages changed; the first pose of its truth."""
    store = default_typestore()
    first: tuple[float, float, float] | None = None
    with AnyReader([source]) as reader, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        made = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
        end_ns = reader.start_time + round(length_s * 1e9)
        for connection, received_ns, raw in reader.messages(stop=end_ns):
            content = raw
            if connection.topic in edits or (first is None and connection.topic == "/truth"):
                message: Any = reader.deserialize(raw, connection.msgtype)
                if first is None and connection.topic == "/truth":
                    p, q = message.pose.position, message.pose.orientation
                    first = (float(p.x), float(p.y), 2.0 * math.atan2(q.z, q.w))
                if connection.topic in edits:
                    edits[connection.topic](message)
                    content = store.serialize_cdr(message, connection.msgtype)
            writer.write(made[connection.id], received_ns, content)
    if first is None:
        raise ValueError(f"{source}: no /truth")
    return first
