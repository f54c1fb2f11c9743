"""Outputs of ``fgloc live``: Odometry, PoseWithCovarianceStamped, /tf, diagnostics and the map as markers."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from fgloc import se2
from fgloc.config import RecordingConfig
from fgloc.frames import BASE_NAMES, quaternion_yaw
from fgloc.live import LivePose
from fgloc.live.wire.transport import Transport
from fgloc.recording import standard_messages as standard
from fgloc.types import Estimate, Event, FloatArray, LandmarkMap, Mode, MotionEvent, TransformEvent

# --- The robot's own odometry frame, which ``map → odom`` leads to (REP 105) ------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class OdomPose:
    """Pose of the base in the odometry frame."""

    stamp_ns: int
    frame: str
    T_odom_base: FloatArray  # (3,)


_MOST_FRAMES = 1000  # names that are kept: a robot has tens
_MOST_NEW = 100  # poses that wait for being published: 0.5 s of a fast odometry


class OdomFrame:
    """Collects the robot's frames and its odometry from messages."""

    def __init__(self, config: RecordingConfig, farthest_m: float = 1e6, only: str = "") -> None:
        """Start without messages.

        Args:
            config: name of the base frame, if it is given.
            farthest_m: a pose further off than this, or none at all, is not taken.
            only: name of the odometry frame; empty: as messages say.
        """
        self._config, self._farthest_m, self._only = config, farthest_m, only
        self._new: deque[OdomPose] = deque(maxlen=_MOST_NEW)
        self._lock = threading.Lock()
        self._frames: set[str] = set()
        self._child = ""  # of the odometry
        self._by_topic: OdomPose | None = None
        self._by_tf: OdomPose | None = None

    def add(self, event: Event) -> None:
        """Add an event of any kind."""
        if isinstance(event, MotionEvent):
            if (told := event.odometer) is None or not self._plausible(told.pose):
                return
            with self._lock:
                self._child = event.base_frame_id.lstrip("/")
                frame = told.frame_id.lstrip("/") or "odom"
                if self._only in ("", frame):
                    self._by_topic = OdomPose(event.stamp_ns, frame, told.pose)
                    if self._by_tf is None:
                        self._new.append(self._by_topic)
        elif isinstance(event, TransformEvent):
            parent, child = event.parent.lstrip("/"), event.child.lstrip("/")
            with self._lock:
                if len(self._frames) < _MOST_FRAMES:
                    self._frames.update((parent, child))
                if not event.static and child == self._base() and self._only in ("", parent):
                    pose = _planar(event.translation, event.rotation)
                    if self._plausible(pose):
                        self._by_tf = OdomPose(event.stamp_ns, parent, pose)
                        self._new.append(self._by_tf)

    def _plausible(self, pose: FloatArray) -> bool:
        return bool(np.isfinite(pose).all() and np.abs(pose[:2]).max() <= self._farthest_m)

    @property
    def base(self) -> str:
        """Name of the base frame: as configured, or a usual one, or the odometry's child."""
        with self._lock:
            return self._base()

    def latest(self) -> OdomPose | None:
        """The newest pose: of the transform that leads to the base, where there is one, else of the odometry."""
        with self._lock:
            return self._by_tf or self._by_topic

    def take(self, until_ns: int) -> list[OdomPose]:
        """Poses up to a time that were not taken before."""
        with self._lock:
            taken = []
            while self._new and self._new[0].stamp_ns <= until_ns:
                taken.append(self._new.popleft())
            return taken

    def _base(self) -> str:
        if self._config.base_frame is not None:
            return self._config.base_frame
        usual = next((name for name in BASE_NAMES if name in self._frames), None)
        return usual or self._child or BASE_NAMES[0]


def _planar(position: FloatArray, orientation: FloatArray) -> FloatArray:
    return np.array([position[0], position[1], quaternion_yaw(orientation)])


# --- The last moments of the published odometry, corrected when a keyframe corrects it --------------------------------

SPAN_S = 0.125  # the twist is the mean over this long: three poses
_AHEAD_NS = 50_000_000  # over which the last speed is held; 1 m/s² moves the pose by 2.5 mm from that in this time
_LEAST_S = 0.03  # between two poses whose covariances tell how fast the covariance grows
_LEAST_VARIANCE = 1e-8  # (m/s)², (rad/s)²: no motion is known better


class RecentPoses:
    """Poses of the base over `SPAN_S`, all as the newest keyframe has them.

    Asking `Live` for an earlier pose costs as much as for the newest one, but for that of a keyframe.
    """

    def __init__(self, pose_at: Callable[[int], LivePose | None]) -> None:
        """Take the function that gives a pose of the live run at a time."""
        self._pose_at = pose_at
        self._poses: deque[LivePose] = deque()
        self._growth = np.zeros((3, 3))  # of the covariance, in the base's axes, by the motion: m²/s, rad²/s

    def add(self, now: LivePose) -> None:
        """Add the newest pose."""
        if self._poses and now.keyframe_ns != self._poses[-1].keyframe_ns:
            self._correct(now.keyframe_ns)
        if self._poses and now.stamp_ns <= self._poses[-1].stamp_ns:  # the clock was set back
            self._poses.clear()
        self._poses.append(now)
        while self._poses[0].stamp_ns < now.stamp_ns - round(SPAN_S * 1e9) and len(self._poses) > 2:
            self._poses.popleft()
        first = next(p for p in self._poses if p.keyframe_ns == now.keyframe_ns)
        if (seconds := _seconds(first, now)) >= _LEAST_S:
            ad = se2.adjoint(se2.inverse(se2.between(first.pose, now.pose)))
            self._growth = (_body_cov(now) - ad @ _body_cov(first) @ ad.T) / seconds

    def twist(self) -> tuple[FloatArray, FloatArray]:
        """Twist ``(3,)`` of the base in its own axes [m/s, m/s, rad/s], and its covariance ``(3, 3)``.

        The covariance is that of the motion over the span, by which the pose's has grown: errors of the motion sources
        are taken to be independent from moment to moment, as the estimator takes them.
        """
        first, last = self._poses[0], self._poses[-1]
        seconds = _seconds(first, last)
        if seconds == 0.0:
            return np.zeros(3), np.zeros((3, 3))
        twist = _motion(first, last) / seconds
        variances, axes = np.linalg.eigh(self._growth / seconds)
        return twist, axes @ np.diag(np.maximum(variances, _LEAST_VARIANCE)) @ axes.T

    def ahead(self, stamp_ns: int) -> LivePose | None:
        """Newest pose, propagated to a time soon after by the twist between the last two; None if it cannot be."""
        if len(self._poses) < 2 or not 0 < stamp_ns - self._poses[-1].stamp_ns <= _AHEAD_NS:
            return None
        before, last = self._poses[-2], self._poses[-1]
        seconds = (stamp_ns - last.stamp_ns) * 1e-9
        motion = se2.exp(_motion(before, last) * seconds / _seconds(before, last))
        ad, pose = se2.adjoint(se2.inverse(motion)), se2.compose(last.pose, motion)
        cov = ad @ _body_cov(last) @ ad.T + self._growth * seconds
        return replace(last, stamp_ns=stamp_ns, pose=pose, cov=se2.rotate_cov(cov, float(pose[2])))

    def at(self, stamp_ns: int) -> FloatArray | None:
        """Pose ``(3,)`` at a time; None if it is outside of the poses that are kept."""
        if not self._poses[0].stamp_ns <= stamp_ns <= self._poses[-1].stamp_ns:
            return None
        stamps = np.array([p.stamp_ns for p in self._poses], dtype=np.int64)
        poses = np.array([p.pose for p in self._poses])
        return np.asarray(se2.interpolate(stamps, poses, np.array([stamp_ns], dtype=np.int64))[0])

    def is_before(self, stamp_ns: int) -> bool:
        """Whether a time is before that of all poses that are kept."""
        return bool(self._poses) and stamp_ns < self._poses[0].stamp_ns

    def _correct(self, keyframe_ns: int) -> None:
        """Move all poses so that the one at the new keyframe's time is that of the keyframe."""
        stamp_ns = max(keyframe_ns, self._poses[0].stamp_ns)
        propagated = self.ahead(stamp_ns)
        before = self.at(stamp_ns) if propagated is None else propagated.pose
        again = self._pose_at(stamp_ns)
        if before is None or again is None:
            self._poses.clear()
            return
        correction = se2.compose(again.pose, se2.inverse(before))
        self._poses = deque(replace(p, pose=se2.compose(correction, p.pose)) for p in self._poses)


def _seconds(first: LivePose, last: LivePose) -> float:
    return (last.stamp_ns - first.stamp_ns) * 1e-9


def _motion(first: LivePose, last: LivePose) -> FloatArray:
    return se2.log(se2.between(first.pose, last.pose))


def _body_cov(pose: LivePose) -> FloatArray:
    return se2.rotate_cov(pose.cov, -float(pose.pose[2]))


# --- Messages ---------------------------------------------------------------------------------------------------------


class Outputs:
    """Writers of everything that a live run publishes."""

    TYPES: ClassVar = {
        "~/odometry": "nav_msgs/msg/Odometry",
        "~/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "~/protection": "geometry_msgs/msg/Vector3Stamped",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
        "~/map": "visualization_msgs/msg/MarkerArray",
    }
    LATCHED: ClassVar = frozenset({"~/map"})

    def __init__(self, transport: Transport, map_frame: str = standard.MAP_FRAME, name: str = "fgloc") -> None:
        """Announce the topics.

        Args:
            transport: network.
            map_frame: name of the frame of all poses.
            name: of the node, in the diagnostics.
        """
        self._frame, self._name = map_frame, name
        self._writers = {
            topic: transport.writer(transport.full_name(topic), kind, latched=topic in self.LATCHED)
            for topic, kind in self.TYPES.items()
        }

    def readers(self, topic: str) -> int:
        """Number of readers of one of the `TYPES`."""
        return self._writers[topic].readers

    def odometry(self, now: LivePose, twist: FloatArray, twist_cov: FloatArray, base_frame: str) -> None:
        """Publish nav_msgs/Odometry of the base in the map, with the twist as `RecentPoses.twist` has it."""
        values = standard.odometry(
            now.stamp_ns, now.pose, now.cov, twist, base_frame, twist_cov, now.ground, frame=self._frame
        )
        self._writers["~/odometry"].publish(values)

    def pose(self, estimate: Estimate) -> None:
        """Publish one keyframe's estimate."""
        e = estimate
        values = standard.pose_with_covariance_stamped(e.stamp_ns, e.pose, e.cov, e.ground, frame=self._frame)
        self._writers["~/pose"].publish(values)

    def protection(self, estimate: Estimate) -> None:
        """Publish the bound on a keyframe's error: x along and y across the base [m], z of its yaw [rad]."""
        if estimate.protection is not None:
            values = standard.vector_stamped(estimate.stamp_ns, estimate.protection.bound, self._frame)
            self._writers["~/protection"].publish(values)

    def transform(self, stamp_ns: int, T_map_child: FloatArray, child_frame: str) -> None:
        """Publish ``T_map_child (3,)`` on /tf."""
        self._writers["/tf"].publish(standard.transform(stamp_ns, T_map_child, child_frame, frame=self._frame))

    def diagnostics(
        self, stamp_ns: int, mode: Mode | None, message: str, values: Mapping[str, str], wrong: bool
    ) -> None:
        """Publish the state; arguments as `standard_messages.diagnostics` has them."""
        content = standard.diagnostics(stamp_ns, mode, message, values, wrong, self._name)
        self._writers["/diagnostics"].publish(content)

    def map(self, landmarks: LandmarkMap) -> None:
        """Publish the map: late subscribers get it too."""
        self._writers["~/map"].publish(standard.map_markers(landmarks, frame=self._frame))


def odom_in_map(T_map_base: FloatArray, T_odom_base: FloatArray) -> FloatArray:
    """``T_map_odom (3,)`` from the base's pose in both frames at one time (REP 105)."""
    return se2.compose(T_map_base, se2.inverse(T_odom_base))
