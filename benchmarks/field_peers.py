"""Baselines of `benchmarks.field`, on the same messages: odometry alone, and a textbook's iSAM2.

Messages are read naively, as their headers have them: stamps of the header (receive times where a topic's header clock
is minutes off), sightings in the axes of their frame (optical if the frame's name says so), sensor at the base. The
odometry is the pose of ``nav_msgs/Odometry``, else the integrated commands. The textbook joins it at 10 Hz with ranges
and bearings, under Huber kernels, with constants that nobody tuned; landmarks are the map's, else they are variables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import gtsam
import numpy as np
from rosbags.highlevel import AnyReader

from benchmarks.common import stamp_of
from fgloc import se2
from fgloc.frames import quaternion_yaw
from fgloc.recording.messages import default_typestore
from fgloc.types import FloatArray, IntArray, Trajectory

_FOREIGN_CLOCK_NS = 60 * 10**9
_BURST_NS = 3_000_000  # stampless poses that arrive closer together were held up: the last one is the newest
_STEP_NS = 100_000_000
_HELD_S = 1.1  # a command holds no longer
_EARTH_M_PER_DEG = 111_320.0
_GLITCH_M = 0.1  # from the median of five neighbours, besides six times the usual
_PRIOR = np.array([0.1, 0.1, 0.1])
_HELD_M = 1e-3  # a landmark of the map
_LANDMARKS = 1_000_000_000  # keys of landmarks are above those of poses
_ERRORS = (RuntimeError, IndexError, ValueError)  # GTSAM's


@dataclass(frozen=True, slots=True)
class Constants:
    """Sigmas of motion, growing with the root of time, and of a sighting; constant of a robust kernel [sigma].

    Those of `textbook`'s default are what an engineer writes down before the first run: nobody tuned them.
    """

    motion_m: float = 0.02  # per root second
    motion_rad: float = 0.05
    bearing_rad: float = 0.03
    range_m: float = 0.1
    kernel: Literal["huber", "cauchy"] = "huber"
    k: float = 1.345

    def motion(self, seconds: float) -> Any:
        """Noise of a motion over a time [s]."""
        return gtsam.noiseModel.Diagonal.Sigmas(
            np.array([self.motion_m, self.motion_m, self.motion_rad]) * np.sqrt(max(seconds, 1e-9))
        )

    def sighting(self) -> Any:
        """Noise of bearing and range under the kernel."""
        kernels = {"huber": gtsam.noiseModel.mEstimator.Huber, "cauchy": gtsam.noiseModel.mEstimator.Cauchy}
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([self.bearing_rad, self.range_m]))
        return gtsam.noiseModel.Robust.Create(kernels[self.kernel].Create(self.k), sigmas)


UNTUNED = Constants()


@dataclass(slots=True)
class Heard:
    """Planar content of a bag.

    Attributes:
        odometry: poses in a frame of its own; None: there is none.
        sightings: stamp [ns], id, range [m], bearing [rad].
        truth: cleaned; yaw is NaN where it is not known; None: there is none.
    """

    odometry: Trajectory | None = None
    sightings: list[tuple[int, int, float, float]] = field(default_factory=list)
    truth: Trajectory | None = None


def hear(bag: Path, truth_topic: str) -> Heard:
    """Read a bag."""
    odometry: dict[str, list[Any]] = {}
    commands: list[Any] = []
    truth: list[Any] = []
    heard, degrees = Heard(), False
    with AnyReader([bag], default_typestore=default_typestore()) as reader:
        for connection, received, raw in reader.messages():
            name, kind = connection.topic, connection.msgtype.split("/")[-1]
            if name != truth_topic and kind not in _READ:
                continue
            m: Any = reader.deserialize(raw, connection.msgtype)
            stamp = stamp_of(m.header) if hasattr(m, "header") else received
            if name == truth_topic:
                degrees = kind == "NavSatFix"
                truth.append((stamp, received, *_place(m, kind)))
            elif kind == "Odometry":
                p, q = m.pose.pose.position, m.pose.pose.orientation
                odometry.setdefault(name, []).append((stamp, received, p.x, p.y, _yaw(q)))
            elif kind in ("Twist", "TwistStamped"):
                t = m.twist if kind == "TwistStamped" else m
                commands.append((stamp, received, t.linear.x, t.angular.z))
            elif kind == "LandmarkArray":
                heard.sightings += [(stamp, int(k.id), float(k.range), float(k.bearing)) for k in m.landmarks]
            elif kind == "MarkerArray" and hasattr(m.markers[0] if m.markers else None, "id"):
                optical = "optical" in m.header.frame_id
                for k in m.markers:
                    p = k.pose.pose.position
                    x, y = (p.z, -p.x) if optical else (p.x, p.y)
                    heard.sightings.append((stamp, int(k.id), float(np.hypot(x, y)), float(np.arctan2(y, x))))
    if odometry:
        rows = np.array(max(odometry.values(), key=len))
        heard.odometry = _trajectory(_clock(rows), rows[:, 2:])
    elif commands:
        rows = np.array(commands)
        heard.odometry = _driven(_clock(rows), rows[:, 2:])
    if truth:
        heard.truth = clean(*_true(np.array(truth), degrees))
    return heard


_READ = ("Odometry", "Twist", "TwistStamped", "LandmarkArray", "MarkerArray")


def clean(stamps: IntArray, poses: FloatArray) -> Trajectory:
    """A truth without repeated stamps, frozen poses and glitches; ``poses (n, 3)``."""
    order = np.argsort(stamps, kind="stable")
    stamps, poses = stamps[order], poses[order]
    fresh = np.r_[True, (np.diff(stamps) > 0) & (np.abs(np.diff(poses[:, :2], axis=0)).sum(axis=1) > 0.0)]
    stamps, poses = stamps[fresh], poses[fresh]
    if len(stamps) >= 5:
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(poses[:, :2], ((2, 2), (0, 0)), mode="edge"), 5, 0)
        away = np.hypot(*(poses[:, :2] - np.median(windows, axis=-1)).T)
        sound = away < _GLITCH_M + 6.0 * float(np.quantile(away, 0.9))
        stamps, poses = stamps[sound], poses[sound]
    return Trajectory(stamps, poses)


def textbook(
    heard: Heard,
    landmarks: Mapping[int, FloatArray],
    begun: tuple[int, FloatArray] | None = None,
    constants: Constants = UNTUNED,
) -> tuple[Trajectory, Trajectory] | None:
    """Online and smoothed poses of iSAM2 at odometry stamps; None without odometry or sightings.

    Args:
        heard: content of the bag.
        landmarks: places ``(2,)`` of the map in the truth's frame; empty: they are variables from the origin on.
        begun: stamp [ns] and pose ``(3,)`` that it starts from on a map; None: the first of the truth.
        constants: noise of odometry and sightings.
    """
    if heard.odometry is None or not heard.sightings:
        return None
    stamps, poses = _thinned(heard.odometry)
    seen = [[one for one in row if not landmarks or one[0] in landmarks] for row in _by_step(stamps, heard.sightings)]
    pose = np.zeros(3)
    if landmarks and heard.truth is not None:
        first_ns, pose = begun or (int(heard.truth.stamps_ns[0]), pose)
        first = int(np.searchsorted(stamps, first_ns))
        stamps, poses, seen = stamps[first:], poses[first:], seen[first:]
        if not len(stamps):
            return None
        pose = pose if begun else heard.truth.interpolate(int(stamps[0]))
    noise = constants.sighting()
    isam, known, online = gtsam.ISAM2(gtsam.ISAM2Params()), set[int](), []
    for k, stamp in enumerate(stamps.tolist()):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k == 0:
            graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*pose), gtsam.noiseModel.Diagonal.Sigmas(_PRIOR)))
        else:
            step = se2.between(poses[k - 1], poses[k])
            motion = constants.motion(max(stamp - int(stamps[k - 1]), 1) * 1e-9)
            graph.add(gtsam.BetweenFactorPose2(k - 1, k, gtsam.Pose2(*step), motion))
            pose = se2.compose(pose, step)
        values.insert(k, gtsam.Pose2(*pose))
        for i, distance, bearing in seen[k]:
            key = _LANDMARKS + i
            if i not in known:
                known.add(i)
                ahead = se2.compose(pose, (distance * np.cos(bearing), distance * np.sin(bearing), 0.0))[:2]
                if landmarks:
                    graph.add(gtsam.PriorFactorPoint2(key, landmarks[i], gtsam.noiseModel.Isotropic.Sigma(2, _HELD_M)))
                values.insert(key, landmarks[i] if landmarks else ahead)
            graph.add(gtsam.BearingRangeFactor2D(k, key, gtsam.Rot2(bearing), distance, noise))
        try:
            isam.update(graph, values)
            now = isam.calculateEstimatePose2(k)
        except _ERRORS:  # the graph is of no more use: what was given is given
            break
        pose = np.array([now.x(), now.y(), now.theta()])
        online.append(pose)
    if len(online) < 2:
        return None
    try:
        found = isam.calculateEstimate()
        smooth = np.array([(p.x(), p.y(), p.theta()) for p in map(found.atPose2, range(len(online)))])
    except _ERRORS:
        smooth = np.array(online)
    stamps = stamps[: len(online)]
    return Trajectory(stamps, np.array(online)), Trajectory(stamps, smooth)


def _by_step(
    stamps: IntArray, sightings: Sequence[tuple[int, int, float, float]]
) -> list[list[tuple[int, float, float]]]:
    """Sightings of the nearest pose each."""
    out: list[list[tuple[int, float, float]]] = [[] for _ in stamps]
    for stamp, *one in sightings:
        k = int(np.clip(np.searchsorted(stamps, stamp), 1, len(stamps) - 1))
        k -= int(stamp - stamps[k - 1] < stamps[k] - stamp)
        if abs(int(stamps[k]) - stamp) < 2 * _STEP_NS and one[1] > 0.0:
            out[k].append((one[0], one[1], one[2]))
    return out


def _thinned(odometry: Trajectory) -> tuple[IntArray, FloatArray]:
    kept, last = [], -(1 << 62)
    for k, stamp in enumerate(odometry.stamps_ns.tolist()):
        if stamp - last >= 0.95 * _STEP_NS:
            kept.append(k)
            last = stamp
    return odometry.stamps_ns[kept], odometry.poses[kept]


def _trajectory(stamps: IntArray, poses: FloatArray) -> Trajectory:
    order = np.argsort(stamps, kind="stable")
    order = order[np.r_[True, np.diff(stamps[order]) > 0]]
    return Trajectory(stamps[order], poses[order])


def _driven(stamps: IntArray, twists: FloatArray) -> Trajectory:
    """Integrated commands; each holds until the next."""
    order = np.argsort(stamps, kind="stable")
    order = order[np.r_[True, np.diff(stamps[order]) > 0]]
    stamps, twists = stamps[order], twists[order]
    poses = [np.zeros(3)]
    for dt, (v, omega) in zip(np.minimum(np.diff(stamps) * 1e-9, _HELD_S).tolist(), twists[:-1].tolist(), strict=True):
        poses.append(se2.compose(poses[-1], se2.exp((v * dt, 0.0, omega * dt))))
    return Trajectory(stamps, np.array(poses))


def _clock(rows: FloatArray) -> IntArray:
    """Header stamps, or receive times if the headers are of another clock."""
    foreign = abs(float(np.median(rows[:, 1] - rows[:, 0]))) > _FOREIGN_CLOCK_NS
    return np.asarray(rows[:, 1 if foreign else 0], dtype=np.int64)


def _true(rows: FloatArray, degrees: bool) -> tuple[IntArray, FloatArray]:
    rows = rows[np.isfinite(rows[:, 2])]
    if degrees:
        lon, lat = rows[:, 2] - rows[0, 2], rows[:, 3] - rows[0, 3]
        rows[:, 2:4] = _EARTH_M_PER_DEG * np.column_stack([lon * np.cos(np.radians(rows[0, 3])), lat])
    if (rows[:, 0] == rows[:, 1]).all():  # no stamps
        rows = rows[np.r_[np.diff(rows[:, 1]) > _BURST_NS, True]]
    return _clock(rows), rows[:, 2:]


def _place(m: Any, kind: str) -> tuple[float, float, float]:
    if kind == "Pose2D":
        return m.x, m.y, m.theta
    if kind == "NavSatFix":
        if m.status.status < 0 or abs(m.latitude) < 1e-6:
            return np.nan, np.nan, np.nan
        return m.longitude, m.latitude, np.nan  # degrees; metres follow
    if kind == "PointStamped":
        return m.point.x, m.point.y, np.nan
    return m.pose.position.x, m.pose.position.y, _yaw(m.pose.orientation)


def _yaw(q: Any) -> float:
    return quaternion_yaw(np.array([q.x, q.y, q.z, q.w]))
