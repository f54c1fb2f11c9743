"""The last moments of the odometry that was published, corrected when a keyframe corrects it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fgloc import se2
from fgloc.live import LivePose
from fgloc.types import FloatArray

SPAN_S = 0.125  # the twist is the mean over this long: three poses
_AHEAD_NS = 50_000_000  # over which the last speed is held; 1 m/s² moves the pose by 2.5 mm from that in this time
_LEAST_S = 0.03  # between two poses whose covariances tell how fast the covariance grows
_LEAST_VARIANCE = 1e-8  # (m/s)², (rad/s)²: no motion is known better


class RecentPoses:
    """Poses of the base over `SPAN_S`, all as the newest keyframe has them.

    Asking `Live` for an earlier pose costs as much as for the newest one, but for that of a keyframe.
    """

    def __init__(self, pose_at: Callable[[int], LivePose | None]) -> None:
        """``pose_at``: of the live run."""
        self._pose_at = pose_at
        self._poses: deque[LivePose] = deque()
        self._growth = np.zeros((3, 3))  # of the covariance, in the base's axes, by the motion: m²/s, rad²/s

    def add(self, now: LivePose) -> None:
        """Take in the newest pose."""
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
        """``(3,)`` of the base in its own axes [m/s, m/s, rad/s], and its covariance ``(3, 3)``.

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
        """The newest pose, propagated by the speed of the last two to a time soon after; None if there is none."""
        if len(self._poses) < 2 or not 0 < stamp_ns - self._poses[-1].stamp_ns <= _AHEAD_NS:
            return None
        before, last = self._poses[-2], self._poses[-1]
        seconds = (stamp_ns - last.stamp_ns) * 1e-9
        motion = se2.exp(_motion(before, last) * seconds / _seconds(before, last))
        ad, pose = se2.adjoint(se2.inverse(motion)), se2.compose(last.pose, motion)
        cov = ad @ _body_cov(last) @ ad.T + self._growth * seconds
        return replace(last, stamp_ns=stamp_ns, pose=pose, cov=se2.rotate_cov(cov, float(pose[2])))

    def at(self, stamp_ns: int) -> FloatArray | None:
        """Pose ``(3,)`` at a time, if it is among these."""
        if not self._poses[0].stamp_ns <= stamp_ns <= self._poses[-1].stamp_ns:
            return None
        stamps = np.array([p.stamp_ns for p in self._poses], dtype=np.int64)
        poses = np.array([p.pose for p in self._poses])
        return np.asarray(se2.interpolate(stamps, poses, np.array([stamp_ns], dtype=np.int64))[0])

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
