"""Measurements of where the robot is: one interface for those of built-in sensors and of other packages.

`Measured` is what gate, association, landmark modes, search, estimators and batch know of a `LandmarkMeasurement`.
Sightings of the map's landmarks are of three kinds: corners in an image, range and bearing, pose of a marker. A sensor
of another package yields these too, or a `PoseMeasurement`: any function of the robot's pose. Everything here is numpy;
factors are made in `fgloc.graph`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import ClassVar, Self

import numpy as np

from fgloc import se2
from fgloc.config import camera_role
from fgloc.sensors.cameras import marker_pose_candidates, planar_base_candidates
from fgloc.types import Camera, FloatArray, IntArray, Landmark

MIN_DEPTH_M = 0.05  # a corner nearer to the image plane than this is not projected
UNNAMED = -1  # landmark of a sighting that does not say of which it is
YAWS = 24  # that the search for the first pose tries at a place without one
_LOOKALIKE = 0.1  # tangent of the angle between two directions that may be of one marker, distortion left in
_AT_REST = np.zeros(3)
_LEVEL = np.zeros(2)


# --- What all measurements have in common -----------------------------------------------------------------------------


class Model(Enum):
    """Form of the residual, by which many measurements are computed in one call; see `fgloc.graph.observation`."""

    CORNERS = "corners"  # of markers in an image
    PLANAR = "planar"  # of landmarks in the base's plane: points, or poses of markers
    POSE = "pose"  # `PoseMeasurement.residual_at`, one by one


class Measured:
    """Measurement of where the robot is: of a landmark of the map, or of a place that its sensor knows.

    Attributes:
        model: by which residual and Jacobians are computed.
        stamp_ns: time of the measurement [ns].
        landmark_id: of the map; a negative number of the sensor's own if it is of none.
        cov: covariance ``(d, d)`` of the residual; None: corners, all with the noise of the image.
        cauchy_k: Cauchy constant of the search for the first pose and of unknown landmarks, in units of sigma.
        row_kind: kind of its row in ``steps.csv``.
        row_id: landmark of its row in ``steps.csv``; -1: none.
        counted_as: name under which the measurement is counted if it is rejected.
        of_landmark: whether it is of a landmark of the map; else of a place that only its sensor knows.
        unnamed: whether it is of a landmark of the map without saying of which; see `fgloc.estimation.unnamed`.
        is_point: whether it is range and bearing of a point (`PointMeasurement`): explained by the poses on a ring.
        gives_pose: whether it gives the pose of the base by itself, if the landmark is known.
        in_pixels: whether its noise is that of an image.
        errors_repeat: whether the next sighting of the landmark has much the same error.
        observes_yaw: whether it determines the yaw by itself.
        variable_dof: numbers of its landmark as a variable, where no map is known: 2 of a point, 3 of a pose; 0: never
            one.
        bias_key: measurements of one key are tested for a common bias; None: there is no such test.
        dof: length of the residual.
        information: weight in comparison with others of its kind.
    """

    __slots__ = ()

    is_point: ClassVar[bool] = False
    gives_pose: ClassVar[bool] = False
    in_pixels: ClassVar[bool] = False
    errors_repeat: ClassVar[bool] = False
    variable_dof: ClassVar[int] = 0

    @property
    def unnamed(self) -> bool:
        """Whether the sensor does not say of which landmark it is."""
        return False

    def exposed(self, twist: FloatArray, offset_s: float, jitter_s: float) -> Self:
        """Copy with the motion at the exposure, by which the residual depends on the clock; itself: it is as given.

        Args:
            twist: ``(3,)`` of the base [m/s, m/s, rad/s].
            offset_s: how late the stamp was taken to be.
            jitter_s: sigma of each stamp on its own; used for corners.
        """
        return self

    def compensated(self, motion: FloatArray, cov: FloatArray) -> Self:
        """The measurement, moved to the keyframe.

        Args:
            motion: ``T_keyframe_then`` ``(3,)``: the base at the measurement's time, seen from the keyframe.
            cov: ``(3, 3)`` covariance of that motion (right perturbation); added to what the measurement itself has.
        """
        raise NotImplementedError

    def calibrated(self, range_scale: float, bearing_bias_rad: float) -> Self:
        """Copy with distance and bearing corrected by the settings of `LandmarksConfig` that a run estimates.

        The built-in sensors of landmarks have applied them already. Corners, and functions of the pose, are as given:
        the camera, or their sensor, has a calibration of its own.
        """
        return self

    def scaled(self, factor: float) -> Self:
        """Copy with the covariance of the residual multiplied by a factor."""
        raise NotImplementedError

    def poses(self, landmarks: Mapping[int, Landmark]) -> Iterable[FloatArray]:
        """Poses ``(3,)`` of the base in the map from which the search for its place begins; none of a point.

        Args:
            landmarks: of the map, by id; that of the measurement is among them.
        """
        raise NotImplementedError

    def landmark_from(self, pose: FloatArray) -> FloatArray | None:
        """Landmark as seen from a pose ``(3,)``: point ``(2,)`` or pose ``(3,)``; None: it is never a variable."""
        return None

    def alternatives(self, predicted: FloatArray) -> Sequence[LandmarkMeasurement]:
        """Other interpretations, most probable first, tried where the chi-square gate rejects the measurement.

        Args:
            predicted: pose ``(3,)`` at the keyframe; see `PoseMeasurement.residual_at_keyframe`.
        """
        return ()

    def misread(self, ids: IntArray, places: FloatArray) -> Sequence[LandmarkMeasurement]:
        """The measurement as one of other landmarks, of each that lies about where it was seen; none: it is of its own.

        Args:
            ids: ``(n,)`` of those that it may be.
            places: ``(n, 3)`` theirs in the axes of the base.
        """
        return ()


# --- What sightings of landmarks have in common -----------------------------------------------------------------------


class _OfLandmark(Measured):
    """Properties that are alike for all sightings of landmarks of the map."""

    __slots__ = ()

    of_landmark: ClassVar[bool] = True
    observes_yaw: ClassVar[bool] = True
    bias_key: ClassVar[None] = None

    landmark_id: int

    @property
    def row_id(self) -> int:
        """Id of the landmark."""
        return self.landmark_id

    def tilted(self, T: FloatArray, rates: FloatArray) -> Self:
        """Copy for a base tilted by ``T`` ``(4, 4)``, at roll and pitch rates ``(2,)`` [rad/s]; only corners change."""
        return self

    def relative(self, landmark: Landmark | None, T_base_sensor: FloatArray) -> tuple[FloatArray, float, float] | None:
        """Place ``(3,)`` in the sensor's axes, noise of bearing [rad] and range [m]; None: no place explains it.

        Args:
            landmark: of the map; corners need it.
            T_base_sensor: ``(4, 4)`` of what was measured in the plane; its height is taken to be the sensor's.
        """
        raise NotImplementedError


class _InPlane(_OfLandmark):
    """Properties that are alike for sightings in the plane of the base, whose noise is a covariance of their own."""

    __slots__ = ()

    model: ClassVar[Model] = Model.PLANAR
    counted_as: ClassVar[str] = "sightings"
    errors_repeat: ClassVar[bool] = True

    cov: FloatArray

    @property
    def information(self) -> float:
        """Weight in comparison with others of its kind."""
        return 1.0 / float(np.trace(self.cov[:2, :2]))

    def exposed(self, twist: FloatArray, offset_s: float, jitter_s: float) -> Self:
        """Copy with the motion at the exposure; see `Measured.exposed`."""
        return replace(self, twist=twist, offset_s=offset_s)  # type: ignore[type-var]

    def scaled(self, factor: float) -> Self:
        """Copy with the covariance multiplied by a factor."""
        return replace(self, cov=self.cov * factor)  # type: ignore[type-var]


# --- Corners of a marker ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class PixelMeasurement(_OfLandmark):
    """A square landmark in an image: its four corners, rid of what Cal3DS2 cannot model, with isotropic noise."""

    model: ClassVar[Model] = Model.CORNERS
    cov: ClassVar[None] = None
    gives_pose: ClassVar[bool] = True
    in_pixels: ClassVar[bool] = True
    dof: ClassVar[int] = 8

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
    sway_rad: float = 0.0  # sigma of the base's roll and pitch in each image, where they are no states
    motion_cov: FloatArray | None = None  # (3, 3) of the motion from the exposure to the keyframe
    cauchy_k: float = 3.0  # Cauchy constant, in units of sigma
    tilting: FloatArray = field(default_factory=lambda: _LEVEL)  # (2,) rad/s: roll and pitch rate of the base

    @property
    def row_kind(self) -> str:
        """Kind of its row in ``steps.csv``, with the camera's name if it is one of several."""
        return camera_role(self.camera.name, "corners")

    @property
    def counted_as(self) -> str:
        """Name under which it is counted if it is rejected."""
        return camera_role(self.camera.name, "sightings")

    @property
    def information(self) -> float:
        """Weight in comparison with others of its kind [1/px²]."""
        return 1.0 / self.sigma_px**2

    def exposed(self, twist: FloatArray, offset_s: float, jitter_s: float) -> Self:
        """Copy with the motion at the exposure; see `Measured.exposed`."""
        return replace(self, twist=twist, offset_s=offset_s, jitter_s=jitter_s)

    def tilted(self, T: FloatArray, rates: FloatArray) -> Self:
        """Copy as seen from a tilted base; see `_OfLandmark.tilted`."""
        camera = replace(self.camera, T_base_cam=T @ self.camera.T_base_cam)
        return replace(self, camera=camera, tilting=rates)

    def compensated(self, motion: FloatArray, cov: FloatArray) -> Self:
        """The sighting, moved to the keyframe; see `Measured.compensated`."""
        ad = se2.adjoint(motion)
        x, y, yaw = motion
        T = np.eye(4)
        T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        T[:2, 3] = x, y
        camera = replace(self.camera, T_base_cam=T @ self.camera.T_base_cam)
        spread = cov if self.motion_cov is None else cov + self.motion_cov
        return replace(self, camera=camera, motion_cov=ad @ spread @ ad.T, twist=ad @ self.twist)

    def scaled(self, factor: float) -> Self:
        """Copy with the variance of the corners multiplied by a factor."""
        return replace(self, sigma_px=math.sqrt(factor) * self.sigma_px)

    def poses(self, landmarks: Mapping[int, Landmark]) -> Iterable[FloatArray]:
        """Poses of the base on the floor that explain the corners, the better one first."""
        landmark = landmarks[self.landmark_id]
        return (pose for pose, _ in planar_base_candidates(self.camera, self.corners_px, landmark))

    def misread(self, ids: IntArray, places: FloatArray) -> list[PixelMeasurement]:
        """The same corners with other ids, of markers whose middle lies in about the same direction."""
        T, K = self.camera.T_base_cam, self.camera.K
        u, v = self.corners_px.mean(axis=0)
        right, down, depth = ((places - T[:3, 3]) @ T[:3, :3]).T
        ahead = depth >= MIN_DEPTH_M
        right, down = right[ahead] / depth[ahead], down[ahead] / depth[ahead]
        across = np.hypot(right - (u - K[0, 2]) / K[0, 0], down - (v - K[1, 2]) / K[1, 1])
        return [replace(self, landmark_id=i) for i in ids[ahead][across < _LOOKALIKE].tolist()]

    def relative(self, landmark: Landmark | None, T_base_sensor: FloatArray) -> tuple[FloatArray, float, float] | None:
        """Place of the marker in the camera, by the better of its two poses; see `_OfLandmark.relative`."""
        assert landmark is not None
        found = marker_pose_candidates(self.camera, self.corners_px, landmark.size_m)
        if not found:
            return None
        T = found[0][0]
        point = T[:3, 3]
        sigma_rad = self.sigma_px / float(self.camera.K[0, 0])
        side_px = float(np.linalg.norm(self.corners_px - self.corners_px[[3, 0, 1, 2]], axis=1).max())
        return point, sigma_rad, float(np.linalg.norm(point)) * self.sigma_px / side_px


# --- Range and bearing ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class PointMeasurement(_InPlane):
    """A landmark as a point: direction and distance from the base (the sensor's offset is already taken out).

    Its covariance is of bearing and range, in this order (GTSAM's); `SightingContext.range_bearing_cov` has the other.
    With the id `UNNAMED` it is of any point of the map: which one the predicted pose tells.
    """

    row_kind: ClassVar[str] = "range_bearing"
    is_point: ClassVar[bool] = True
    variable_dof: ClassVar[int] = 2
    dof: ClassVar[int] = 2

    stamp_ns: int
    landmark_id: int
    range_m: float
    bearing_rad: float
    cov: FloatArray  # (2, 2), order bearing, range
    twist: FloatArray = field(default_factory=lambda: _AT_REST)  # as in PixelMeasurement
    offset_s: float = 0.0
    cauchy_k: float = 3.0  # as in PixelMeasurement
    scan_ns: int = 0  # stamp of the scan that it is of, where hits of one scan have stamps of their own; if unnamed

    @classmethod
    def of_point(
        cls, stamp_ns: int, landmark_id: int, point: FloatArray, cov: FloatArray, cauchy_k: float = 3.0
    ) -> Self:
        """Range and bearing of a point ``(2,)`` in the base frame, not its origin, with covariance ``(2, 2)``."""
        x, y = (float(v) for v in point)
        distance = math.hypot(x, y)
        J = np.array([[-y / distance**2, x / distance**2], [x / distance, y / distance]])
        polar = J @ cov @ J.T
        return cls(stamp_ns, landmark_id, distance, math.atan2(y, x), 0.5 * (polar + polar.T), cauchy_k=cauchy_k)

    @property
    def unnamed(self) -> bool:
        """Whether the sensor does not say of which landmark it is."""
        return self.landmark_id == UNNAMED

    def calibrated(self, range_scale: float, bearing_bias_rad: float) -> Self:
        """Copy with range and bearing corrected; see `Measured.calibrated`."""
        bearing, scale = self.bearing_rad - bearing_bias_rad, np.array([1.0, range_scale])
        cov = self.cov * np.outer(scale, scale)
        return replace(self, range_m=range_scale * self.range_m, bearing_rad=bearing, cov=cov)

    @property
    def point(self) -> FloatArray:
        """Position in the base frame ``(2,)`` [m]."""
        return np.array([self.range_m * math.cos(self.bearing_rad), self.range_m * math.sin(self.bearing_rad)])

    def compensated(self, motion: FloatArray, cov: FloatArray) -> Self:
        """The sighting, moved to the keyframe; see `Measured.compensated`."""
        ad = se2.adjoint(motion)
        x, y = self.point
        px, py, _ = se2.compose(motion, (x, y, 0.0))
        r, bearing = math.hypot(px, py), math.atan2(py, px)
        added = _bearing_range_cov(cov, motion, np.array([x, y]), r, bearing)
        return replace(self, range_m=r, bearing_rad=bearing, cov=self.cov + added, twist=ad @ self.twist)

    def poses(self, landmarks: Mapping[int, Landmark]) -> Iterable[FloatArray]:
        """No poses: those on a ring are searched among hypotheses, see `fgloc.estimation.beacons`."""
        return ()

    def landmark_from(self, pose: FloatArray) -> FloatArray:
        """Point ``(2,)`` as seen from a pose."""
        local = [self.range_m * np.cos(self.bearing_rad), self.range_m * np.sin(self.bearing_rad), 0.0]
        return se2.compose(pose, local)[:2]

    def in_base(self) -> tuple[FloatArray, FloatArray]:
        """Point ``(2,)`` in the base frame, and the matrix ``(2, 2)`` that makes its error white."""
        point, cov = self.cartesian()
        return point, np.linalg.inv(np.linalg.cholesky(cov))

    def cartesian(self) -> tuple[FloatArray, FloatArray]:
        """The sighting as a point ``(2,)`` in the base frame with covariance ``(2, 2)``.

        The frame turned by the bearing has range along its first axis and range times bearing across; first order in
        the bearing's sigma, which is exact enough below 0.2 rad. The true range, which may be off by its sigma, makes
        the sigma across: it does not vanish right at a landmark.
        """
        c, s = np.cos(self.bearing_rad), np.sin(self.bearing_rad)
        r, lever = self.range_m, np.sqrt(self.range_m**2 + self.cov[1, 1])
        J = np.array([[-lever * s, c], [lever * c, s]])  # columns: bearing, range
        cov = J @ self.cov @ J.T
        return np.array([r * c, r * s]), 0.5 * (cov + cov.T)

    def relative(self, landmark: Landmark | None, T_base_sensor: FloatArray) -> tuple[FloatArray, float, float] | None:
        """Place in the sensor's axes with the noise of bearing and range; see `_OfLandmark.relative`."""
        x, y = self.range_m * math.cos(self.bearing_rad), self.range_m * math.sin(self.bearing_rad)
        sigma_rad, sigma_m = np.sqrt(np.diag(self.cov)).tolist()
        return _in_sensor(x, y, T_base_sensor), sigma_rad, sigma_m


def _bearing_range_cov(cov: FloatArray, motion: FloatArray, point: FloatArray, r: float, bearing: float) -> FloatArray:
    """Covariance ``(2, 2)`` (bearing, range) that an uncertain motion adds to a sighted point."""
    c, s = math.cos(motion[2]), math.sin(motion[2])
    R = np.array([[c, -s], [s, c]])
    J_point = np.column_stack([R, R @ np.array([-point[1], point[0]])])  # of motion ∘ point, by right perturbation
    cb, sb = math.cos(bearing), math.sin(bearing)
    J_polar = np.array([[-sb / r, cb / r], [cb, sb]])
    J = J_polar @ J_point
    return np.asarray(J @ cov @ J.T)


def _in_sensor(x: float, y: float, T_base_sensor: FloatArray) -> FloatArray:
    """A place given in the base's plane in the sensor's axes ``(3,)``, taken to be at the sensor's own height."""
    arm = np.array([x - T_base_sensor[0, 3], y - T_base_sensor[1, 3], 0.0])
    return np.asarray(T_base_sensor[:3, :3].T @ arm)


# --- Pose of a marker -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class FrameMeasurement(_InPlane):
    """A landmark with its yaw: planar pose ``T_base_marker`` (see Landmark.planar), right-perturbation covariance."""

    row_kind: ClassVar[str] = "marker_pose"
    gives_pose: ClassVar[bool] = True
    variable_dof: ClassVar[int] = 3
    dof: ClassVar[int] = 3

    stamp_ns: int
    landmark_id: int
    pose: FloatArray  # (3,)
    cov: FloatArray  # (3, 3)
    twist: FloatArray = field(default_factory=lambda: _AT_REST)  # as in PixelMeasurement
    offset_s: float = 0.0
    cauchy_k: float = 3.0  # as in PixelMeasurement

    def calibrated(self, range_scale: float, bearing_bias_rad: float) -> Self:
        """Copy with distance, bearing and yaw corrected; see `Measured.calibrated`."""
        scale = np.array([range_scale, range_scale, 1.0])
        pose = se2.compose(np.array([0.0, 0.0, -bearing_bias_rad]), scale * self.pose)
        return replace(self, pose=pose, cov=self.cov * np.outer(scale, scale))

    def compensated(self, motion: FloatArray, cov: FloatArray) -> Self:
        """The sighting, moved to the keyframe; see `Measured.compensated`."""
        pose = se2.compose(motion, self.pose)
        moved = se2.compose_cov(cov, self.pose, self.cov)
        return replace(self, pose=pose, cov=moved, twist=se2.adjoint(motion) @ self.twist)

    def poses(self, landmarks: Mapping[int, Landmark]) -> Iterable[FloatArray]:
        """The pose of the base that explains it."""
        return (se2.compose(landmarks[self.landmark_id].planar, se2.inverse(self.pose)),)

    def landmark_from(self, pose: FloatArray) -> FloatArray:
        """Pose ``(3,)`` of the marker as seen from a pose of the base."""
        return se2.compose(pose, self.pose)

    def in_base(self) -> tuple[FloatArray, FloatArray]:
        """Pose ``(3,)``, and the matrix ``(3, 3)`` that makes its error in the base's axes white."""
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return self.pose, np.linalg.inv(np.linalg.cholesky(self.cov)) @ turn

    def relative(self, landmark: Landmark | None, T_base_sensor: FloatArray) -> tuple[FloatArray, float, float] | None:
        """Place in the sensor's axes, with the larger sigma of the position; see `_OfLandmark.relative`."""
        x, y = self.pose[:2]
        sigma_m = math.sqrt(max(self.cov[0, 0], self.cov[1, 1]))
        return _in_sensor(x, y, T_base_sensor), sigma_m / max(math.hypot(x, y), 0.1), sigma_m


# --- Any function of the pose -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseMeasurement(Measured, ABC):
    """Measurement of a registered sensor, as a function of the robot's pose; each kind is a subclass.

    A subclass gives `residual_at`. Validation, motion compensation, the chi-square gate, the factor and the search for
    the first pose are made of that.
    """

    model: ClassVar[Model] = Model.POSE
    of_landmark: ClassVar[bool] = False

    source: str  # in steps.csv and in the counts
    stamp_ns: int
    cov: FloatArray  # (d, d) of the residual
    target: int = -1  # which anchor or beacon was measured, in the sensor's own numbering; -1: none
    observes_yaw: bool = False  # whether one reading determines the yaw, as a compass does
    cauchy_k: float = 3.0  # Cauchy constant of the search for the first pose, in units of sigma
    T_keyframe_then: FloatArray = field(default_factory=lambda: _AT_REST)  # (3,) base at stamp_ns, by the keyframe
    motion_cov: FloatArray | None = None  # (3, 3) of that motion, right perturbation; None: no motion
    constants: tuple[str, ...] = ()  # parameters of the installation that `by_constants` takes, as the sensor has them

    @abstractmethod
    def residual_at(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted minus measured ``(d,)`` for ``T_map_base`` ``(3,)`` at the stamp, with its Jacobian.

        Returns:
            The residual, in the units of `cov`, and its derivative ``(d, 3)`` by the right perturbation of the pose.
        """

    def by_constants(self, pose: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residual ``(d,)`` and Jacobians ``(d, 3)`` by the pose and ``(d, c)`` by the `constants`, at values ``(c,)``.

        The default is for a measurement that depends on no constants. One of 0 changes nothing.
        """
        residual, J = self.residual_at(pose)
        return residual, J, np.zeros((len(residual), 0))

    def places(self) -> Iterable[FloatArray]:
        """Rough positions ``(2,)`` [m] of the robot in the map, from which the search for its first pose begins."""
        return ()

    @property
    def dof(self) -> int:
        """Length of the residual."""
        return len(self.cov)

    @property
    def landmark_id(self) -> int:
        """A number that no landmark of the map has."""
        return -2 - self.target

    @property
    def row_kind(self) -> str:
        """Kind of its row in ``steps.csv``: the source, with the number of what was measured."""
        return self.source if self.target < 0 else f"{self.source}.{self.target}"

    @property
    def row_id(self) -> int:
        """Landmark of its row in ``steps.csv``: none."""
        return -1

    @property
    def counted_as(self) -> str:
        """Source under which it is counted where it is rejected."""
        return self.source

    @property
    def bias_key(self) -> Hashable | None:
        """Source and target, of which measurements are tested for a common bias."""
        return self.source, self.target

    @property
    def information(self) -> float:
        """Weight in comparison with others of its kind."""
        return 1.0 / float(np.trace(self.cov[:2, :2]))

    def compensated(self, motion: FloatArray, cov: FloatArray) -> Self:
        """The measurement, moved to the keyframe; see `Measured.compensated`."""
        known = np.zeros((3, 3)) if self.motion_cov is None else self.motion_cov
        moved = se2.compose_cov(cov, self.T_keyframe_then, known)
        return replace(self, T_keyframe_then=se2.compose(motion, self.T_keyframe_then), motion_cov=moved)

    def scaled(self, factor: float) -> Self:
        """Copy with the covariance multiplied by a factor."""
        return replace(self, cov=self.cov * factor)

    def poses(self, landmarks: Mapping[int, Landmark]) -> Iterable[FloatArray]:
        """Each of `places` with `YAWS` yaws."""
        yaws = np.linspace(-np.pi, np.pi, YAWS, endpoint=False)
        return (np.array([*place, yaw]) for place in self.places() for yaw in yaws)

    def residual_at_keyframe(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residual and Jacobian of `residual_at`, by the pose at the keyframe."""
        residual, J = self.residual_at(se2.compose(pose, self.T_keyframe_then))
        return residual, np.asarray(J @ se2.adjoint(se2.inverse(self.T_keyframe_then)))

    def by_constants_at_keyframe(
        self, pose: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residual and Jacobians of `by_constants`, by the pose at the keyframe and the constants."""
        residual, J, H = self.by_constants(se2.compose(pose, self.T_keyframe_then), values)
        return residual, np.asarray(J @ se2.adjoint(se2.inverse(self.T_keyframe_then))), H


LandmarkSighting = PixelMeasurement | PointMeasurement | FrameMeasurement
"""Measurement of a landmark of the map."""
LandmarkMeasurement = LandmarkSighting | PoseMeasurement
"""Any measurement of where the robot is."""


# --- Those of one kind ------------------------------------------------------------------------------------------------


def sensor_name(kind: str) -> str:
    """Name for the user of the sensor that makes sightings of this kind: ``camera front`` of ``front/corners``."""
    camera, _, made = kind.rpartition("/")
    return f"camera {camera}".strip() if made == "corners" else f"sensor of {kind}"


def seen_since_knocked(m: LandmarkMeasurement, kind: str, name: str) -> LandmarkMeasurement:
    """The measurement as one of a camera of another name ("front#1"), if it is of the kind of that camera."""
    if not isinstance(m, PixelMeasurement) or camera_role(m.camera.name.partition("#")[0], "corners") != kind:
        return m
    return replace(m, camera=replace(m.camera, name=name))


def corners_of(measurements: Iterable[LandmarkMeasurement]) -> list[PixelMeasurement]:
    """Measurements that are corners, for surveys of markers and checks of the floor."""
    return [m for m in measurements if isinstance(m, PixelMeasurement)]


def points_of(measurements: Iterable[LandmarkMeasurement]) -> list[PointMeasurement]:
    """Measurements that are range and bearing, for hypotheses on rings."""
    return [m for m in measurements if isinstance(m, PointMeasurement)]
