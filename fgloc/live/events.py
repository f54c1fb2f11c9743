"""Events from plain numbers, for those who feed a live run from their own loop."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fgloc.config import RecordingConfig, Role
from fgloc.sensors import registry
from fgloc.sensors.base import SENSOR, When
from fgloc.types import CameraInfoEvent, FloatArray, TransformEvent


class EventMaker(registry.SensorInput):
    """Makes the events of the sensors, of calibration and of transforms.

    Stamps are of the measurement [ns]. Topics have the names that the configuration gives them, else those of their
    roles.
    """

    _recording: RecordingConfig

    def _when(self, role: Role, stamp_ns: int) -> When:
        """Stamp as the configuration corrects it, receive time and topic."""
        received = time.time_ns()
        stamp = received if role in self._recording.received_stamps else int(stamp_ns)
        given: str | None = getattr(self._recording.topics, role)
        return stamp + round(self._recording.stamp_offset_s.get(role, 0.0) * 1e9), received, given or role

    def camera_info(
        self,
        width: int,
        height: int,
        K: ArrayLike,
        D: ArrayLike = (),
        model: str = "plumb_bob",
        frame_id: str = SENSOR,
    ) -> None:
        """The camera's calibration ``(3, 3)``, ``(n,)``; see `fgloc.types.Camera` for the models. Told once."""
        now = time.time_ns()
        arrays: tuple[Any, Any] = np.asarray(K, dtype=float).reshape(3, 3), np.asarray(D, dtype=float).ravel()
        topic = self._recording.topics.camera_info or "camera_info"
        self._deliver(CameraInfoEvent(now, now, topic, frame_id, width, height, model, *arrays))

    def transform(self, parent: str, child: str, translation: ArrayLike, rotation: ArrayLike) -> None:
        """A fixed transform ``T_parent_child``: translation ``(3,)`` [m] and quaternion ``(4,)`` x, y, z, w."""
        now = time.time_ns()
        t: FloatArray = np.asarray(translation, dtype=float)
        q: FloatArray = np.asarray(rotation, dtype=float)
        self._deliver(TransformEvent(now, now, "/tf_static", parent, child, t, q, True))
