"""The last moments of the odometry that was published, corrected when a keyframe corrects it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from fgloc import se2
from fgloc.live import LivePose
from fgloc.types import FloatArray

SPAN_S = 0.1  # the twist is the mean over this long: five messages


class RecentPoses:
    """Poses of the base over `SPAN_S`, all as the newest keyframe has them.

    Asking `Live` for an earlier pose costs as much as for the newest one; here it is asked for one only after a
    keyframe.
    """

    def __init__(self, pose_at: Callable[[int], LivePose | None]) -> None:
        """``pose_at``: of the live run."""
        self._pose_at = pose_at
        self._keyframe_ns = 0
        self._poses: deque[tuple[int, FloatArray]] = deque()

    def add(self, now: LivePose) -> None:
        """Take in the newest pose."""
        if self._poses and now.keyframe_ns != self._keyframe_ns:
            self._correct()
        self._keyframe_ns = now.keyframe_ns
        if self._poses and now.stamp_ns <= self._poses[-1][0]:  # the clock was set back
            self._poses.clear()
        self._poses.append((now.stamp_ns, now.pose))
        while self._poses[0][0] < now.stamp_ns - round(SPAN_S * 1e9) and len(self._poses) > 2:
            self._poses.popleft()

    def twist(self) -> FloatArray:
        """``(3,)`` of the base in its own axes: m/s, m/s, rad/s."""
        (first_ns, first), (last_ns, last) = self._poses[0], self._poses[-1]
        return np.zeros(3) if last_ns == first_ns else se2.log(se2.between(first, last)) / ((last_ns - first_ns) * 1e-9)

    def at(self, stamp_ns: int) -> FloatArray | None:
        """Pose ``(3,)`` at a time, if it is among these."""
        if not self._poses[0][0] <= stamp_ns <= self._poses[-1][0]:
            return None
        stamps = np.array([stamp for stamp, _ in self._poses], dtype=np.int64)
        poses = np.array([pose for _, pose in self._poses])
        return np.asarray(se2.interpolate(stamps, poses, np.array([stamp_ns], dtype=np.int64))[0])

    def _correct(self) -> None:
        """Move all poses with the last one, which is where the new keyframe has it."""
        last_ns, last = self._poses[-1]
        again = self._pose_at(last_ns)
        if again is None:
            self._poses.clear()
            return
        correction = se2.compose(again.pose, se2.inverse(last))
        self._poses = deque((stamp, se2.compose(correction, pose)) for stamp, pose in self._poses)
