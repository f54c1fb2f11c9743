"""Measurements: what sensors make of events, as factors are made of them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fgloc import se2
from fgloc.types.arrays import FloatArray
from fgloc.types.maps import Camera

_AT_REST = np.zeros(3)
_LEVEL = np.zeros(2)


@dataclass(frozen=True, slots=True, eq=False)
class InertialReading:
    """What an inertial unit measures of one step on uneven ground, in the axes of the base."""

    turn: FloatArray  # (2,) rad: about x and y over the step, with the bias in it
    turn_variance: float  # rad², of each
    force: FloatArray | None  # (3,) m/s²: specific force at the step's end, without the robot's own acceleration
    force_variance: float  # (m/s²)², of each
    seconds: float  # length of the step


@dataclass(frozen=True, slots=True, eq=False)
class MotionMeasurement:
    """``T_start_end`` of the base from ``source`` (wheels, learned or gyro), with right-perturbation covariance."""

    source: str
    start_ns: int
    stamp_ns: int
    motion: FloatArray  # (3,)
    cov: FloatArray  # (3, 3) of what differs from step to step; what is always the same is in `depends_on`
    # by parameter of the installation: derivative (3,) of the motion (right perturbation), and the value it has in it
    depends_on: Mapping[str, tuple[FloatArray, float]] = field(default_factory=dict)
    inertial: InertialReading | None = None  # of the same step; on uneven ground


@dataclass(frozen=True, slots=True, eq=False)
class MotionReadings:
    """What each motion source measured of one step, as if it were alone; None where it has no data."""

    wheels: MotionMeasurement | None = None
    learned: MotionMeasurement | None = None
    gyro: MotionMeasurement | None = None  # only its yaw means anything
    inertial: InertialReading | None = None  # on uneven ground
    at_rest: bool = False  # wheels report no motion, and the gyro none but its bias


@dataclass(frozen=True, slots=True, eq=False)
class PixelMeasurement:
    """A square landmark in an image: its four corners, rid of what Cal3DS2 cannot model, with isotropic noise."""

    stamp_ns: int
    landmark_id: int
    corners_px: FloatArray  # (4, 2)
    sigma_px: float
    camera: Camera  # plumb_bob, whose D explains corners_px
    twist: FloatArray = field(
        default_factory=lambda: _AT_REST
    )  # (3,) of the base at the exposure: m/s, m/s, rad/s, in the keyframe's axes
    offset_s: float = 0.0  # how late the stamp was taken to be when the sighting was moved to its keyframe
    blur_s: float = 0.0  # by how long the image moves on a blurred corner is off
    jitter_s: float = 0.0  # sigma of what each stamp is off by on its own
    motion_cov: FloatArray | None = None  # (3, 3) of the motion from the exposure to the keyframe
    cauchy_k: float = 3.0  # Cauchy constant, in units of sigma
    tilting: FloatArray = field(default_factory=lambda: _LEVEL)  # (2,) rad/s: roll and pitch rate of the base

    @property
    def dof(self) -> int:
        """Length of the residual."""
        return 8


@dataclass(frozen=True, slots=True, eq=False)
class PointMeasurement:
    """A landmark as a point: direction and distance from the base (the sensor's offset is already taken out)."""

    stamp_ns: int
    landmark_id: int
    range_m: float
    bearing_rad: float
    cov: FloatArray  # (2, 2), order bearing, range (GTSAM's)
    twist: FloatArray = field(default_factory=lambda: _AT_REST)  # as in PixelMeasurement
    offset_s: float = 0.0
    cauchy_k: float = 3.0  # as in PixelMeasurement

    @property
    def point(self) -> FloatArray:
        """Where it is in the base frame ``(2,)`` [m]."""
        return np.array([self.range_m * math.cos(self.bearing_rad), self.range_m * math.sin(self.bearing_rad)])

    @property
    def dof(self) -> int:
        """Length of the residual."""
        return 2


@dataclass(frozen=True, slots=True, eq=False)
class FrameMeasurement:
    """A landmark with its yaw: planar pose ``T_base_marker`` (see Landmark.planar), right-perturbation covariance."""

    stamp_ns: int
    landmark_id: int
    pose: FloatArray  # (3,)
    cov: FloatArray  # (3, 3)
    twist: FloatArray = field(default_factory=lambda: _AT_REST)  # as in PixelMeasurement
    offset_s: float = 0.0
    cauchy_k: float = 3.0  # as in PixelMeasurement

    @property
    def dof(self) -> int:
        """Length of the residual."""
        return 3


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseMeasurement(ABC):
    """What a registered sensor measured, as a function of the robot's pose; each kind of it is a subclass.

    A subclass gives `residual_at`. Validation, motion compensation, the chi-square gate, the factor and the search for
    the first pose are made of that.
    """

    source: str  # in steps.csv and in the counts
    stamp_ns: int
    cov: FloatArray  # (d, d) of the residual
    target: int = -1  # which anchor or beacon was measured, in the sensor's own numbering; -1: none
    observes_yaw: bool = False  # whether one reading determines the yaw, as a compass does
    cauchy_k: float = 3.0  # Cauchy constant of the search for the first pose, in units of sigma
    T_keyframe_then: FloatArray = field(default_factory=lambda: _AT_REST)  # (3,) base at stamp_ns, by the keyframe
    motion_cov: FloatArray | None = None  # (3, 3) of that motion, right perturbation; None: no motion

    @abstractmethod
    def residual_at(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted minus measured ``(d,)`` for ``T_map_base`` ``(3,)`` at the stamp, with its Jacobian.

        Returns:
            The residual, in the units of `cov`, and its derivative ``(d, 3)`` by the right perturbation of the pose.
        """

    def places(self) -> Iterable[FloatArray]:
        """Where in the map ``(2,)`` the robot may be, roughly: where the search for its first pose begins."""
        return ()

    def alternatives(self, predicted: FloatArray) -> Sequence[PoseMeasurement]:
        """What else the reading may mean, most probable first: tried in turn where the chi-square gate refuses it.

        Args:
            predicted: pose ``(3,)`` at the keyframe; see `residual_at_keyframe`.
        """
        return ()

    @property
    def dof(self) -> int:
        """Length of the residual."""
        return len(self.cov)

    @property
    def landmark_id(self) -> int:
        """A number that no landmark of the map has."""
        return -2 - self.target

    def residual_at_keyframe(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `residual_at`, by the pose at the keyframe."""
        residual, J = self.residual_at(se2.compose(pose, self.T_keyframe_then))
        return residual, np.asarray(J @ se2.adjoint(se2.inverse(self.T_keyframe_then)))


LandmarkSighting = PixelMeasurement | PointMeasurement | FrameMeasurement
LandmarkMeasurement = LandmarkSighting | PoseMeasurement
