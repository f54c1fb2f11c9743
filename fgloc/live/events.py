"""Events from plain numbers, for those who feed a live run from their own loop."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fgloc.config import RecordingConfig, Role
from fgloc.errors import RecordingError
from fgloc.frames import yaw_quaternion
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.sensors.markers.events import CornersEvent, ImageEvent, MarkerCorners
from fgloc.sensors.range_bearing.events import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import CameraInfoEvent, ControlEvent, Event, FloatArray, TransformEvent

When = tuple[int, int, str]
BASE, SENSOR = "base_link", "sensor"


class EventMaker:
    """Makes events; `_deliver` has them.

    Stamps are of the measurement [ns]. Topics have the names that the configuration gives them, else those of their
    roles.
    """

    _recording: RecordingConfig

    def _deliver(self, event: Event) -> None:
        raise NotImplementedError

    def _when(self, role: Role, stamp_ns: int) -> When:
        """Stamp as the configuration corrects it, receive time and topic."""
        received = time.time_ns()
        stamp = received if role in self._recording.received_stamps else int(stamp_ns)
        given: str | None = getattr(self._recording.topics, role)
        return stamp + round(self._recording.stamp_offset_s.get(role, 0.0) * 1e9), received, given or role

    def odometry(
        self,
        stamp_ns: int,
        pose: Sequence[float] | None = None,
        twist: Sequence[float] | None = None,
        frame_id: str = "odom",
    ) -> None:
        """Wheel odometry.

        Args:
            stamp_ns: when it was measured.
            pose: x, y [m], yaw [rad] in the odometry's own frame; None: it has none.
            twist: forward, left [m/s], yaw rate [rad/s] of the base; None: it has none.
            frame_id: of the pose.
        """
        unknown = np.full(3, np.nan)
        x, y, yaw = unknown if pose is None else np.asarray(pose, dtype=float)
        vx, vy, w = unknown if twist is None else np.asarray(twist, dtype=float)
        position = np.array([x, y, 0.0])
        orientation = np.full(4, np.nan) if np.isnan(yaw) else yaw_quaternion(float(yaw))
        linear, angular = np.array([vx, vy, 0.0]), np.array([0.0, 0.0, w])
        none = np.zeros((6, 6))
        when = self._when("odometry", stamp_ns)
        self._deliver(OdometryEvent(*when, frame_id, BASE, position, orientation, none, linear, angular, none))

    def joints(
        self,
        stamp_ns: int,
        names: Sequence[str],
        position: ArrayLike = (),
        velocity: ArrayLike = (),
        effort: ArrayLike = (),
    ) -> None:
        """Joint states: angles [rad], rates [rad/s] and torques [Nm] by joint; what is not measured is left out."""
        arrays = (np.asarray(a, dtype=float) for a in (position, velocity, effort))
        self._deliver(JointsEvent(*self._when("joints", stamp_ns), tuple(names), *arrays))

    def command(self, stamp_ns: int, v: float, omega: float) -> None:
        """What the robot is told to do: forward speed [m/s] and yaw rate [rad/s]."""
        self._deliver(ControlEvent(*self._when("command", stamp_ns), float(v), float(omega)))

    def imu(
        self,
        stamp_ns: int,
        angular_velocity: ArrayLike,
        linear_acceleration: ArrayLike = (0.0, 0.0, 0.0),
        frame_id: str = BASE,
    ) -> None:
        """Gyro rates ``(3,)`` [rad/s] and accelerations ``(3,)`` [m/s²] in the IMU's axes."""
        rates, accelerations = (np.asarray(a, dtype=float) for a in (angular_velocity, linear_acceleration))
        self._deliver(ImuEvent(*self._when("imu", stamp_ns), frame_id, rates, accelerations, np.zeros((3, 3))))

    def image(self, stamp_ns: int, image: NDArray[np.uint8] | bytes, frame_id: str = SENSOR) -> None:
        """An image: grey ``(h, w)``, colour ``(h, w, 3)`` in OpenCV's order (blue first), or encoded (JPEG, PNG).

        Raises:
            RecordingError: an array of another shape or type.
        """
        when = self._when("image", stamp_ns)
        if isinstance(image, bytes | bytearray | memoryview):
            data = np.frombuffer(image, dtype=np.uint8)
            kind = "png" if bytes(image[:4]) == b"\x89PNG" else "jpeg"
            return self._deliver(ImageEvent(*when, frame_id, kind, True, 0, 0, 0, False, data))
        shape = image.shape
        if image.dtype != np.uint8 or len(shape) not in (2, 3) or shape[2:] not in ((), (3,)):
            raise RecordingError(
                f"image of shape {shape} and type {image.dtype}; expected uint8, (h, w) grey or (h, w, 3) blue first, "
                "or the bytes of a JPEG or PNG"
            )
        encoding = "mono8" if len(shape) == 2 else "bgr8"
        step = shape[1] * (1 if len(shape) == 2 else 3)
        data = np.ascontiguousarray(image).reshape(-1).copy()  # the caller's buffer may be used again
        self._deliver(ImageEvent(*when, frame_id, encoding, False, shape[1], shape[0], step, False, data))

    def corners(self, stamp_ns: int, markers: Mapping[int, ArrayLike], frame_id: str = SENSOR) -> None:
        """Markers that were found in an image: corners ``(4, 2)`` [px] by id, clockwise from its top left."""
        found = tuple(MarkerCorners(int(i), np.asarray(c, dtype=float).reshape(4, 2)) for i, c in markers.items())
        self._deliver(CornersEvent(*self._when("sightings", stamp_ns), frame_id, found))

    def ranges(self, stamp_ns: int, landmarks: Iterable[tuple[int, float, float]], frame_id: str = BASE) -> None:
        """Landmarks by id, range [m] and bearing [rad], counter-clockwise from the sensor's x axis."""
        found = tuple(RangeBearing(int(i), float(r), float(b)) for i, r, b in landmarks)
        self._deliver(RangeBearingEvent(*self._when("sightings", stamp_ns), frame_id, found))

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
