"""Poses of the robot's base by an external positioning system."""

from __future__ import annotations

import math
from array import array

import numpy as np

from fgloc import se2
from fgloc.config import TruthConfig
from fgloc.frames import quaternion_matrix, quaternion_yaw, roll_pitch, rpy_matrix
from fgloc.recording.reader import Recording
from fgloc.types import FloatArray, IntArray, Trajectory, TruthEvent

_LEG_M, _COURSE_RAD = 0.2, 0.5  # of a path that turns; no jitter at rest reaches the first
SLIPPING_TOPIC = "/truth/slipping"
"""Whether a wheel slips, in recordings of the simulator (std_msgs/Bool, stamped by its receipt)."""


def base_pose(event: TruthEvent, config: TruthConfig) -> FloatArray:
    """Planar pose ``(3,)`` of the base, from that of the body which the system tracks; the body's if it has no yaw."""
    T_body_base = se2.inverse((*config.offset_m, config.yaw_offset_rad))
    x, y = config.scale * event.position[0], config.scale * event.position[1]
    yaw = quaternion_yaw(event.orientation)
    if config.axes == "ned":
        x, y, yaw = y, x, se2.wrap(0.5 * math.pi - yaw)
    if not event.has_yaw:
        return np.array([x, y, 0.0])
    return se2.compose((x, y, yaw), T_body_base)


def base_ground(event: TruthEvent, config: TruthConfig) -> FloatArray:
    """Height, roll and pitch ``(3,)`` of the base, from the pose of the body which the system tracks."""
    R = quaternion_matrix(event.orientation) @ rpy_matrix(0.0, 0.0, -config.yaw_offset_rad)
    height = float(event.position[2] - R[2, :2] @ np.asarray(config.offset_m))
    roll, pitch = roll_pitch(R)
    return np.array([height, roll, pitch])


def lacks_yaw(poses: FloatArray) -> bool:
    """Whether poses ``(n, 3)`` are of positions alone: their course turns, and their yaw never changes by a bit."""
    if len(poses) < 3 or np.ptp(poses[:, 2]) > 0.0:
        return False
    corners, anchor = [poses[0, :2]], poses[0, :2]
    for place in poses[:, :2]:
        if math.hypot(*(place - anchor)) > _LEG_M:
            corners.append(place)
            anchor = place
    legs = np.diff(np.array(corners), axis=0)
    return len(legs) > 1 and float(np.ptp(np.unwrap(np.arctan2(legs[:, 1], legs[:, 0])))) > _COURSE_RAD


def true_slips(recording: Recording) -> IntArray:
    """Stamps ``(n, 2)`` between which a wheel truly slipped, as a simulator recorded; none in other recordings."""
    spans: list[list[int]] = []
    slipping = False
    for topic, message_type, received_ns, raw in recording.messages({SLIPPING_TOPIC}):
        if topic != SLIPPING_TOPIC or not message_type.endswith("/Bool"):
            continue
        now = bool(raw[-1])  # however it is serialized, the flag is the last byte
        if now and not slipping:
            spans.append([received_ns, received_ns])
        elif slipping:
            spans[-1][1] = received_ns
        slipping = now
    return np.array(spans, dtype=np.int64).reshape(-1, 2)


class TruthTrack:
    """Collects the base's true poses, compactly. Where the clock was set back the later pass is kept."""

    def __init__(self, config: TruthConfig, clock_back_s: float) -> None:
        """``clock_back_s``: a step back longer than this, twice running, is the clock's and no stray stamp's."""
        self._config = config
        self._back_ns = round(clock_back_s * 1e9)
        self._newest_ns = 0
        self._set_back_ns = 0
        self._stamps = array("q")
        self._poses = array("d")
        self._has_yaw = True

    def add(self, event: TruthEvent) -> None:
        """Add one pose."""
        stamp = event.stamp_ns
        if stamp >= self._newest_ns - self._back_ns:
            self._newest_ns, self._set_back_ns = max(self._newest_ns, stamp), 0
        elif self._set_back_ns:
            self._forget_after(self._set_back_ns)
            self._newest_ns, self._set_back_ns = stamp, 0
        else:
            self._set_back_ns = stamp
        self._stamps.append(stamp)
        self._has_yaw &= event.has_yaw
        self._poses.extend(base_pose(event, self._config).tolist())
        self._poses.extend(base_ground(event, self._config).tolist())

    def trajectory(self) -> Trajectory | None:
        """Poses with increasing stamps, the last one of each stamp; None if there are fewer than two."""
        stamps, poses = self._arrays()
        stamps, last = np.unique(stamps[::-1], return_index=True)
        whole = poses[::-1][last]
        if len(stamps) < 2:
            return None
        planar, ground = whole[:, :3].copy(), whole[:, 3:].copy()
        if self._has_yaw and lacks_yaw(planar):
            T_body_base = se2.inverse((*self._config.offset_m, self._config.yaw_offset_rad))
            planar[:, :2] -= se2.compose((0.0, 0.0, planar[0, 2] - T_body_base[2]), T_body_base)[:2]
            return Trajectory(stamps, planar, has_yaw=False)
        return Trajectory(stamps, planar, ground=ground if self._has_yaw else None, has_yaw=self._has_yaw)

    def _forget_after(self, stamp_ns: int) -> None:
        stamps, poses = self._arrays()
        kept = stamps <= stamp_ns
        self._stamps, self._poses = array("q", stamps[kept].tolist()), array("d", poses[kept].ravel().tolist())

    def _arrays(self) -> tuple[IntArray, FloatArray]:
        return np.array(self._stamps, dtype=np.int64), np.array(self._poses).reshape(-1, 6)
