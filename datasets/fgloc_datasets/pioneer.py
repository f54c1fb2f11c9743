"""Pioneer with ArUco markers: the ROS 1 bags ``duarte.bag`` and ``pinto1.bag``, with odometry and motion capture.

    fgloc convert pioneer duarte.bag --out DIR

writes ``bag/`` and ``robot.yaml``; where the markers are is not known, so there is no map. Topics keep their names, and
``robot.yaml`` fits the original bag as well as the converted one. What the converter sets right in the bag:

- Odometry is stamped with its receive time: the robot's clock is about 10⁶ s off. The receive times jitter by less than
  1 ms, but for one message of duarte's that came 0.15 s late.
- Motion capture comes without stamps, in bursts of about 12 poses every 0.1 s. They were measured 1/120 s apart: the
  way from one to the next, over the odometry's speed, is 8.4 ms within a burst, and between bursts too when none is
  lost. So a burst is dated back from its last pose, which cuts the disagreement with odometry over 1 s from 14.7 to
  10.6 mm (duarte) and from 15.2 to 13.2 mm (pinto1). Receive times in the bag stay as recorded.
- Marker positions are in the camera's optical frame, although their header says base_link.

In ``robot.yaml``, the camera's mounting, the scale of its ranges (in pinto1 the markers' size was configured 24 % too
large) and its latency come from odometry and sightings alone. Where the capture target sits on the robot is found from
its own and the odometry's motion; only evaluation reads it.

The bags are coursework of D. Correia and others, IST Lisbon, without a licence: fetch them, do not pass them on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fgloc.config import RecordingConfig, TopicsConfig
from fgloc.errors import RecordingError
from fgloc.frames import quaternion_yaw
from fgloc.recording.reader import open_recording
from fgloc.sensors.marker_pose import MarkerPosesEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import FloatArray, IntArray, Trajectory, TruthEvent
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import Message, new_bag, write_merged, write_robot
from fgloc_datasets.download import Remote
from fgloc_datasets.mounting import Body, Mounting, body_mounting, sensor_mounting

_TOPICS = {
    "odometry": "/pioneer/pose",
    "sightings": "/aruco_marker_publisher/markers",
    "truth": "/mocap_node/Robot_1/ground_pose",
}
_CAPTURE_RATE_HZ = 120.0
_BURST_GAP_NS = 20_000_000
_SITE = "https://raw.githubusercontent.com/DuarteCorreia96/SistemasAut/"
REMOTES = {
    "duarte": Remote(_SITE + "1b912ca883695b422496bcc36a5a75f7e74b5fbe/bags/duarte.bag", size=1_286_347),
    "pinto1": Remote(_SITE + "1acb2e0a06edc42df13b3da49a28810cc937a067/bags/pinto1.bag", size=1_293_615),
}
# Against motion capture over 10 s (about 1 to 2 m): 0.02 m and 0.03 rad in both bags.
_CORRELATION_S = 2.0  # one marker's errors, seen 12 to 19 times a second, change slowly with the view
_NOISE = {
    "x_per_sqrt_m": 0.015,
    "y_per_sqrt_m": 0.01,
    "yaw_per_sqrt_m": 0.02,
    "xy_per_sqrt_rad": 0.005,
    "yaw_per_sqrt_rad": 0.015,
    "xy_per_sqrt_s": 0.001,
    "yaw_per_sqrt_s": 0.002,
}


def convert(source: Path, out: Path, storage: str = "mcap") -> Path:
    """Convert one of the bags.

    Args:
        source: the ROS 1 bag.
        out: folder that gets ``bag/`` and ``robot.yaml``.
        storage: "mcap" or "sqlite3".

    Returns:
        The bag's folder.

    Raises:
        RecordingError: the bag cannot be read, or lacks odometry or markers.
    """
    settings = RecordingConfig(topics=TopicsConfig(**_TOPICS), received_stamps=("odometry", "truth"))
    with open_recording(source, settings) as recording:
        events = list(recording.events())
    odometry = [event for event in events if isinstance(event, OdometryEvent)]
    sightings = [event for event in events if isinstance(event, MarkerPosesEvent)]
    truth = [event for event in events if isinstance(event, TruthEvent)]
    if not (odometry and sightings and truth):
        raise RecordingError(
            f"{source}: {len(odometry)} odometry messages, {len(sightings)} of markers, {len(truth)} true poses; "
            "expected some of each"
        )
    captured_ns = date_bursts(np.array([event.received_ns for event in truth], dtype=np.int64))
    with new_bag(out, storage) as bag:
        write_merged(
            _odometry(bag, odometry), _markers(bag, sightings), _truth(bag, truth, captured_ns), total=len(events)
        )
    driven = Trajectory(_stamps(odometry), _planar(odometry))
    mounting = _camera_mounting(driven, sightings)
    body = body_mounting(driven, Trajectory(captured_ns, _planar(truth)))
    note = f"Pioneer, {source.name}. Camera: from odometry and sightings. Truth's body: from its motion and odometry's."
    write_robot(out / "robot.yaml", robot_settings(mounting, body), note)
    return out / "bag"


def date_bursts(received_ns: IntArray) -> IntArray:
    """When poses that arrive in bursts were captured ``(n,)``: back from each burst's last, strictly increasing.

    A burst too long for the time since the one before is spread over that time.
    """
    captured = np.empty_like(received_ns)
    breaks = np.flatnonzero(np.diff(received_ns) > _BURST_GAP_NS) + 1
    before = received_ns[0] - int(len(received_ns) * 1e9)
    for burst in np.split(np.arange(len(received_ns)), breaks):
        last = received_ns[burst[-1]]
        period = min(round(1e9 / _CAPTURE_RATE_HZ), int(last - before) // len(burst))
        captured[burst] = last - period * np.arange(len(burst) - 1, -1, -1)
        before = last
    return captured


def robot_settings(mounting: Mounting, body: Body) -> dict[str, Any]:
    """The contents of ``robot.yaml``."""
    return {
        "recording": {
            "topics": _TOPICS,
            "received_stamps": ["odometry"],
            "base_frame": "base_link",
            "stamp_offset_s": {"sightings": _rounded(-mounting.latency_s), "truth": _rounded(-body.latency_s)},
            "sightings_pose": [_rounded(mounting.x), _rounded(mounting.y), 0.0, 0.0, 0.0, _rounded(mounting.yaw)],
            "sightings_axes": "optical",
        },
        "wheels": {"source": "pose", "noise": _NOISE},
        "landmarks": {
            "range_scale": _rounded(mounting.range_scale),
            "range_sigma_m": _rounded(max(mounting.residual_m, 0.01)),
            "range_sigma_per_m": 0.01,
            "bearing_sigma_rad": 0.01,
            "repeat_s": _CORRELATION_S,
        },
        "truth": {
            "align": "se2",
            "yaw_offset_rad": _rounded(body.yaw),
            "offset_m": [_rounded(body.x), _rounded(body.y)],
        },
    }


def _camera_mounting(driven: Trajectory, sightings: Sequence[MarkerPosesEvent]) -> Mounting:
    seen = [(event.stamp_ns, marker) for event in sightings for marker in event.sightings]
    stamps = np.array([stamp for stamp, _ in seen], dtype=np.int64)
    ids = np.array([marker.landmark_id for _, marker in seen], dtype=np.int64)
    optical = np.array([marker.position for _, marker in seen]).reshape(-1, 3)  # z ahead, x to the right
    return sensor_mounting(driven, stamps, ids, np.column_stack([optical[:, 2], -optical[:, 0]]))


def _odometry(bag: BagWriter, events: Sequence[OdometryEvent]) -> Iterator[Message]:
    for e in events:
        pose = (float(e.position[0]), float(e.position[1]), quaternion_yaw(e.orientation))
        twist = (float(e.linear[0]), float(e.angular[2]))
        yield (
            e.received_ns,
            partial(
                bag.odometry,
                e.topic,
                e.received_ns,
                pose,
                twist,
                covs=(e.pose_cov, e.twist_cov),
                frames=(e.frame_id, e.child_frame_id),
            ),
        )


def _markers(bag: BagWriter, events: Sequence[MarkerPosesEvent]) -> Iterator[Message]:
    for e in events:
        seen = [(m.landmark_id, m.position.tolist(), m.orientation.tolist(), m.cov) for m in e.sightings]
        yield e.received_ns, partial(bag.marker_poses, e.topic, e.stamp_ns, seen, e.received_ns)


def _truth(bag: BagWriter, events: Sequence[TruthEvent], captured_ns: IntArray) -> Iterator[Message]:
    for e, stamp in zip(events, captured_ns.tolist(), strict=True):
        pose = (e.position.tolist(), e.orientation.tolist())
        yield e.received_ns, partial(bag.truth, e.topic, stamp, *pose, received_ns=e.received_ns, frame_id="mocap")


def _stamps(events: Sequence[OdometryEvent]) -> IntArray:
    return np.array([event.stamp_ns for event in events], dtype=np.int64)


def _planar(events: Sequence[OdometryEvent] | Sequence[TruthEvent]) -> FloatArray:
    return np.array([[e.position[0], e.position[1], quaternion_yaw(e.orientation)] for e in events])


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
