"""Events: one message (or one transform of one) as recorded, before validation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fgloc.types.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """One message of a recording or a live stream."""

    stamp_ns: int
    received_ns: int
    topic: str


@dataclass(frozen=True, slots=True, eq=False)
class MotionEvent(Event):
    """Of a source of motion: it holds over time and is integrated over steps, at its own stamps."""

    @property
    def publisher(self) -> tuple[str, ...]:
        """What tells apart those who share the topic, each with a clock of its own."""
        return ()

    @property
    def base_frame_id(self) -> str:
        """The robot's base frame, if the message names it."""
        return ""

    @property
    def odometer(self) -> OdometerPose | None:
        """The pose that the source has integrated itself; None: it gives none."""
        return None


@dataclass(frozen=True, slots=True, eq=False)
class OdometerPose:
    """Pose of the base in a frame of the source's own, and the twist there."""

    frame_id: str
    pose: FloatArray  # (3,); NaN where it is not known
    twist: FloatArray  # (3,) in the body frame: m/s, m/s, rad/s; NaN where it is not known


@dataclass(frozen=True, slots=True, eq=False)
class ControlEvent(MotionEvent):
    """Control input: the commanded velocity. It holds until the next."""

    v: float  # m/s, forward
    omega: float  # rad/s, counter-clockwise


@dataclass(frozen=True, slots=True, eq=False)
class InertialEvent(MotionEvent):
    """Rates and specific forces in the axes of an inertial unit."""

    frame_id: str
    angular_velocity: FloatArray  # (3,) rad/s
    linear_acceleration: FloatArray  # (3,) m/s²


@dataclass(frozen=True, slots=True, eq=False)
class RawEvent(Event):
    """Data in which a detector still has to find the landmarks."""

    frame_id: str

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height, if the message names them."""
        return None

    @property
    def empty(self) -> bool:
        """Whether there is no data."""
        return False

    def decoded_size(self) -> tuple[int, int] | None:
        """Width and height of the decoded data; None if it cannot be decoded."""
        return self.size


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One landmark in one message; subclasses say how it was seen."""

    landmark_id: int

    def place(self) -> FloatArray | None:
        """Position ``(3,)`` in the sensor's axes, if the message gives it."""
        return None

    def distance(self) -> float | None:
        """Distance from the sensor [m], if the message gives it."""
        return None

    def noisy(self, sigmas: Mapping[str, float], rng: np.random.Generator) -> Sighting:
        """With white noise on its numbers, as ``fgloc ablate`` adds it.

        Args:
            sigmas: by kind of number: ``corner_px``, ``range_m``, ``bearing_rad``, ``position_m``; 0: none.
            rng: of the noise.
        """
        return self


@dataclass(frozen=True, slots=True, eq=False)
class SightingsEvent(Event):
    """Landmarks that were seen at one time. Made anew as a keyframe, or moved to one."""

    in_pixels: ClassVar[bool] = False  # whether it takes a calibrated camera to make measurements of them

    frame_id: str
    sightings: tuple[Sighting, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SensorEvent(Event):
    """One message of a registered sensor (`fgloc.sensors.base`); a subclass says what is in it."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfoEvent(Event):
    """``sensor_msgs/CameraInfo``."""

    frame_id: str
    width: int
    height: int
    distortion_model: str
    K: FloatArray  # (3, 3)
    D: FloatArray  # (n,)


@dataclass(frozen=True, slots=True, eq=False)
class TransformEvent(Event):
    """One transform of ``/tf`` or ``/tf_static``: ``T_parent_child``."""

    parent: str
    child: str
    translation: FloatArray  # (3,)
    rotation: FloatArray  # (4,) quaternion x, y, z, w
    static: bool


@dataclass(frozen=True, slots=True, eq=False)
class TruthEvent(Event):
    """Pose from an external positioning system. Never reaches the estimator."""

    frame_id: str
    position: FloatArray  # (3,)
    orientation: FloatArray  # (4,) quaternion x, y, z, w
