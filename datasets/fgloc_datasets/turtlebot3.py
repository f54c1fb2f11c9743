"""TurtleBot3 Burger with AprilTag ranges and bearings: rosbag2 recordings of November 2025.

    fgloc convert turtlebot3 rosbag2_2025_11_25-15_11_34 --out DIR

copies every message whose type is known, byte for byte, into ``bag/`` (``/camera/landmarks`` becomes ``/landmarks``),
and writes ``robot.yaml``; with a list of landmarks, ``map.yaml`` too. Messages of packages without a definition are
counted and left out.

What was measured on ``...15_11_34`` with its map, and is in ``robot.yaml``:

- The body twist of ``/odom`` has spikes of ±125 rad/s (a turn of 2π within 0.05 s); the pose has none, so motion comes
  from pose differences and the bounds are a Burger's.
- Sightings are true ranges in the base's axes (a distance along the camera's axis fits twice as badly), stamped about
  0.05 s late, the camera turned by 0.02 rad; no offset from the base can be told from zero.
- ``landmarks_2025_real.yaml`` lists nine ids and eight coordinates, so id 8 has no place; the recording never shows it
  (nor 3 and 5). Landmarks agree with the map to 0.01 to 0.03 m (median, after alignment over 8 s).

Licence of the two recordings of 25 November: Apache-2.0. Their owner's address is not known to us: give ``--url``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from fgloc.config import RecordingConfig
from fgloc.errors import RecordingError
from fgloc.recording.reader import Recording
from fgloc.sensors.maps import load_map, write_map
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import Message, new_bag, write_merged, write_robot

_RENAMED = {"/camera/landmarks": "/landmarks"}
_ROLES = {
    "odometry": "/odom",
    "command": "/cmd_vel",
    "joints": "/joint_states",
    "imu": "/imu",
    "sightings": "/landmarks",
}
_SIGHTINGS_LATE_S = 0.05
_CAMERA_YAW_RAD = 0.02
_MAPPED_BAG = "rosbag2_2025_11_25-15_11_34"  # the recording that landmarks_2025_real.yaml belongs to
_MAP_FILE = "landmarks_2025_real.yaml"


def convert(source: Path, out: Path, storage: str = "mcap", landmarks: Path | None = None) -> Path:
    """Convert one of the recordings.

    Args:
        source: a rosbag2 folder or file.
        out: folder that gets ``bag/``, ``robot.yaml`` and, if landmarks are known, ``map.yaml``.
        storage: "mcap" or "sqlite3".
        landmarks: list of landmarks; None: the one beside the recording, if it is this recording's.

    Returns:
        The bag's folder.

    Raises:
        RecordingError: the recording cannot be read.
        MapError: the list of landmarks cannot be used.
    """
    return convert_and_tell(source, out, storage, landmarks)[0]


def robot_settings(topics: set[str]) -> dict[str, Any]:
    """Content of ``robot.yaml`` for a recording with these topics."""
    roles = {role: topic for role, topic in _ROLES.items() if topic in topics}
    recording: dict[str, Any] = {"topics": {**roles, "truth": "none"}, "base_frame": "base_footprint"}
    if "sightings" in roles:
        recording["stamp_offset_s"] = {"sightings": -_SIGHTINGS_LATE_S}
        recording["sightings_pose"] = [0.0, 0.0, 0.0, 0.0, 0.0, _CAMERA_YAW_RAD]
        recording["sightings_axes"] = "body"
    return {
        "recording": recording,
        "gate": {"max_speed": 1.0, "max_yaw_rate": 4.0},
        "wheels": {
            "source": "pose",
            "noise": {
                "x_per_sqrt_m": 0.03,
                "y_per_sqrt_m": 0.015,
                "yaw_per_sqrt_m": 0.03,
                "xy_per_sqrt_rad": 0.005,
                "yaw_per_sqrt_rad": 0.05,
                "xy_per_sqrt_s": 0.001,
                "yaw_per_sqrt_s": 0.002,
            },
        },
        "landmarks": {"range_sigma_m": 0.04, "range_sigma_per_m": 0.01, "bearing_sigma_rad": 0.02},
    }


def convert_and_tell(
    source: Path, out: Path, storage: str, landmarks: Path | None
) -> tuple[Path, Counter[str], list[str]]:
    """Convert a recording, see `convert`; return also what was left out, by topic and type, and notes on the map."""
    beside = source.parent / _MAP_FILE
    if landmarks is None and source.name == _MAPPED_BAG and beside.is_file():
        landmarks = beside
    known = None if landmarks is None else load_map(landmarks)
    dropped: Counter[str] = Counter()
    topics: set[str] = set()
    with Recording(source, RecordingConfig()) as recording, new_bag(out, storage) as bag:
        if recording.kind == "ros1":
            raise RecordingError(f"{source}: a ROS 1 bag; expected one of the TurtleBot3's rosbag2 recordings")
        total = sum(topic.count for topic in recording.topics)
        write_merged(_copies(bag, recording, topics, dropped), total=total)
    write_robot(out / "robot.yaml", robot_settings(topics), f"TurtleBot3 Burger, {source.name}")
    if known is not None:
        write_map(known, out / "map.yaml")
    return out / "bag", dropped, [] if known is None else list(known.notes)


def _copies(bag: BagWriter, recording: Recording, topics: set[str], dropped: Counter[str]) -> Iterator[Message]:
    for topic, message_type, received_ns, raw in recording.messages():
        if not bag.knows(message_type):
            dropped[f"{topic} ({message_type})"] += 1
            continue
        name = _RENAMED.get(topic, topic)
        topics.add(name)
        yield received_ns, partial(bag.copy, name, message_type, raw, received_ns)
