"""Pioneer with ArUco markers: the ROS 1 bags ``duarte.bag`` and ``pinto1.bag``, with odometry and motion capture.

    fgloc convert pioneer duarte.bag --out DIR

writes ``bag/`` and ``robot.yaml``; where the markers are is not known, so there is no map. Topics keep their names,
and ``robot.yaml`` fits the original bag as well as the converted one. What the converter sets right in the bag:

- Odometry is stamped with its receive time: the robot's clock is about 10⁶ s off. The receive times jitter by less than
  1 ms, but for one message of duarte's that came 0.15 s late.
- Motion capture comes without stamps, in bursts of about 12 poses every 0.1 s. They were measured 1/120 s apart: the
  way from one to the next, over the odometry's speed, is 8.4 ms within a burst, and between bursts too when none is
  lost. So a burst is dated back from its last pose, which cuts the disagreement with odometry over 1 s from 14.7 to
  10.6 mm (duarte) and from 15.2 to 13.2 mm (pinto1). Receive times in the bag stay as recorded.
- Marker positions are in the camera's optical frame, although their header says base_link.

In ``robot.yaml``, the camera's mounting, the scale of its ranges (in pinto1 the markers' size was configured 24 %
too large) and its latency come from odometry and sightings alone. Where the capture target sits on the robot is
found from its own and the odometry's motion; only evaluation reads it.

`sensor_mounting` and `body_mounting` find where a sensor and a positioning target sit on a robot from its own
odometry, which is trusted over some seconds only: a fixed landmark seen twice must be in one place, and a rigid
body's motion must be the robot's.

The bags are coursework of D. Correia and others, IST Lisbon, without a licence: fetch them, do not pass them on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from fgloc import se2
from fgloc.config import RecordingConfig, TopicsConfig
from fgloc.errors import RecordingError
from fgloc.frames import quaternion_yaw
from fgloc.recording.reader import open_recording
from fgloc.sensors.marker_pose import MarkerPosesEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import FloatArray, IntArray, Trajectory, TruthEvent
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import Message, Remote, new_bag, write_merged, write_robot

# --- Fit of the mountings ---------------------------------------------------------------------------------------------

_PAIR_S = (0.3, 6.0)  # two sightings of a landmark are compared if they are this far apart
_MOST_PAIRS = 6000
_FEWEST = 50
_POINT_SIGMA_M = 0.03
_TRUTH_GAP_S = 0.15
_WINDOW_S, _STRIDE_S = 3.0, 0.25
_MOTION_SIGMA = np.array([0.01, 0.01, 0.02])  # m, m, rad over a window


@dataclass(frozen=True, slots=True)
class Mounting:
    """Sensor in the base frame, and what its reports need.

    ``residual_m`` is the robust sigma of the disagreement, per axis, of a landmark's place between two sightings.
    """

    x: float  # m
    y: float  # m
    yaw: float  # rad
    range_scale: float  # true over reported distance
    latency_s: float  # sightings are stamped this much late
    residual_m: float


@dataclass(frozen=True, slots=True)
class Body:
    """Rigid body of a positioning system in the base frame."""

    x: float  # m
    y: float  # m
    yaw: float  # rad
    latency_s: float  # its poses are stamped this much late


def sensor_mounting(odometry: Trajectory, stamps_ns: IntArray, ids: IntArray, points: FloatArray) -> Mounting:
    """Find a sensor's place, range scale and latency from odometry and sightings of landmarks at unknown places.

    Args:
        odometry: poses of the base in the odometry frame.
        stamps_ns: ``(n,)`` times of the sightings.
        ids: ``(n,)`` landmarks.
        points: ``(n, 2)`` landmarks as seen, x ahead of the sensor and y to its left [m].

    Raises:
        RecordingError: there are too few sightings of the same landmarks.
    """
    first, second = _pairs(stamps_ns, ids)
    if len(first) < _FEWEST:
        raise RecordingError(f"{len(first)} pairs of sightings of one landmark, expected {_FEWEST} for a calibration")

    def residuals(q: FloatArray) -> FloatArray:
        a = _place(odometry, stamps_ns[first], points[first], q)
        b = _place(odometry, stamps_ns[second], points[second], q)
        return np.asarray((a - b).ravel() / _POINT_SIGMA_M)

    start = np.array([0.0, 0.0, 0.0, 1.0, 0.0])
    fit = least_squares(residuals, start, loss="cauchy", diff_step=1e-4, x_scale=[0.1, 0.1, 0.05, 0.05, 0.05])
    spread = 1.4826 * float(np.median(abs(residuals(fit.x)))) * _POINT_SIGMA_M / np.sqrt(2.0)
    x, y, yaw, scale, latency = (float(v) for v in fit.x)
    return Mounting(x, y, yaw, scale, latency, spread)


def body_mounting(odometry: Trajectory, truth: Trajectory) -> Body:
    """Find where a positioning system's rigid body sits on the robot, from the motions of both.

    Args:
        odometry: poses of the base in the odometry frame.
        truth: poses of the body in the positioning system's frame.

    Raises:
        RecordingError: too little of the truth overlaps the odometry.
    """
    span = int(_WINDOW_S * 1e9)
    begin = np.arange(odometry.stamps_ns[0], odometry.stamps_ns[-1] - span, int(_STRIDE_S * 1e9), dtype=np.int64)
    begin = begin[_covered(truth.stamps_ns, begin) & _covered(truth.stamps_ns, begin + span)]
    if len(begin) < _FEWEST:
        raise RecordingError(f"truth and odometry share {len(begin)} windows of {_WINDOW_S} s, expected {_FEWEST}")
    driven = _motions(_poses(odometry, begin), _poses(odometry, begin + span))

    def residuals(q: FloatArray) -> FloatArray:
        late = int(q[3] * 1e9)
        a = _base(_poses(truth, begin + late), q[:3])
        b = _base(_poses(truth, begin + span + late), q[:3])
        error = _motions(a, b) - driven
        error[:, 2] = se2.wrap_array(error[:, 2])
        return np.asarray((error / _MOTION_SIGMA).ravel())

    fits = [
        least_squares(residuals, [0.0, 0.0, yaw, 0.0], loss="cauchy", diff_step=1e-4, x_scale=[0.1, 0.1, 0.1, 0.05])
        for yaw in (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)
    ]
    x, y, yaw, latency = (float(v) for v in min(fits, key=lambda fit: fit.cost).x)
    return Body(x, y, se2.wrap(yaw), latency)


def _pairs(stamps_ns: IntArray, ids: IntArray) -> tuple[IntArray, IntArray]:
    """Indices of pairs of sightings of one landmark, evenly thinned out."""
    least, most = (int(s * 1e9) for s in _PAIR_S)
    found = []
    for landmark in np.unique(ids):
        own = np.flatnonzero(ids == landmark)
        own = own[np.argsort(stamps_ns[own], kind="stable")]
        at = stamps_ns[own]
        first, last = np.searchsorted(at, at + least), np.searchsorted(at, at + most, side="right")
        counts = np.maximum(last - first, 0)
        left = np.repeat(np.arange(len(own)), counts)
        right = np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)] or [left])
        found.append(np.column_stack([own[left], own[right.astype(np.int64)]]))
    pairs = np.concatenate(found) if found else np.zeros((0, 2), dtype=np.int64)
    keep = pairs[:: max(1, len(pairs) // _MOST_PAIRS)]
    return keep[:, 0], keep[:, 1]


def _place(odometry: Trajectory, at_ns: IntArray, points: FloatArray, q: FloatArray) -> FloatArray:
    """Positions ``(n, 2)`` [m] of sighted landmarks in the odometry frame."""
    x, y, yaw, scale, latency = q
    in_base = _turned(scale * points, yaw) + np.array([x, y])
    pose = _poses(odometry, at_ns - int(latency * 1e9))
    return np.asarray(_turned(in_base, pose[:, 2]) + pose[:, :2])


def _base(body: FloatArray, q: FloatArray) -> FloatArray:
    """Poses ``T_map_base`` ``(n, 3)`` from ``T_map_body`` ``(n, 3)``, for a body at q in the base."""
    x, y, yaw = q
    heading = body[:, 2] - yaw
    return np.column_stack([body[:, :2] - _turned(np.tile([x, y], (len(body), 1)), heading), heading])


def _motions(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.column_stack([_turned(b[:, :2] - a[:, :2], -a[:, 2]), se2.wrap_array(b[:, 2] - a[:, 2])])


def _poses(trajectory: Trajectory, at_ns: IntArray) -> FloatArray:
    return se2.interpolate(trajectory.stamps_ns, trajectory.poses, at_ns)


def _turned(points: FloatArray, yaw: FloatArray | float) -> FloatArray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]])


def _covered(stamps_ns: IntArray, at_ns: IntArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    after = np.clip(np.searchsorted(stamps_ns, at_ns), 1, len(stamps_ns) - 1)
    near = (stamps_ns[after] - stamps_ns[after - 1]) * 1e-9 < _TRUTH_GAP_S
    return np.asarray(near & (at_ns >= stamps_ns[0]) & (at_ns <= stamps_ns[-1]))


# --- Conversion -------------------------------------------------------------------------------------------------------

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
    """Capture times ``(n,)`` [ns] of poses that arrive in bursts: back from each burst's last, strictly increasing.

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
    """Content of ``robot.yaml``."""
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
