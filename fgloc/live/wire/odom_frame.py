"""The robot's own odometry frame, which ``map → odom`` leads to (REP 105)."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from fgloc.config import RecordingConfig
from fgloc.frames import BASE_NAMES, quaternion_yaw
from fgloc.types import Event, FloatArray, MotionEvent, TransformEvent


@dataclass(frozen=True, slots=True, eq=False)
class OdomPose:
    """Where the base is in the odometry frame."""

    stamp_ns: int
    frame: str
    T_odom_base: FloatArray  # (3,)


class OdomFrame:
    """Follows the robot's frames as its messages tell them."""

    def __init__(self, config: RecordingConfig) -> None:
        """Nothing has come yet."""
        self._config = config
        self._lock = threading.Lock()
        self._frames: set[str] = set()
        self._child = ""  # of the odometry
        self._by_topic: OdomPose | None = None
        self._by_tf: OdomPose | None = None

    def add(self, event: Event) -> None:
        """Take in any event."""
        if isinstance(event, MotionEvent):
            if (told := event.odometer) is None:
                return
            with self._lock:
                self._child = event.base_frame_id.lstrip("/")
                self._by_topic = OdomPose(event.stamp_ns, told.frame_id.lstrip("/") or "odom", told.pose)
        elif isinstance(event, TransformEvent):
            parent, child = event.parent.lstrip("/"), event.child.lstrip("/")
            with self._lock:
                self._frames.update((parent, child))
                if not event.static and child == self._base():
                    self._by_tf = OdomPose(event.stamp_ns, parent, _planar(event.translation, event.rotation))

    @property
    def base(self) -> str:
        """Name of the base frame: as configured, or a usual one, or the odometry's child."""
        with self._lock:
            return self._base()

    def latest(self) -> OdomPose | None:
        """The newest pose: of the transform that leads to the base, where there is one, else of the odometry."""
        with self._lock:
            return self._by_tf or self._by_topic

    def _base(self) -> str:
        if self._config.base_frame is not None:
            return self._config.base_frame
        usual = next((name for name in BASE_NAMES if name in self._frames), None)
        return usual or self._child or BASE_NAMES[0]


def _planar(position: FloatArray, orientation: FloatArray) -> FloatArray:
    return np.array([position[0], position[1], quaternion_yaw(orientation)])
