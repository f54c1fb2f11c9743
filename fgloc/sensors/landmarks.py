"""From sightings, in whatever form a sensor reports them, to measurements that become factors."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.errors import CameraError, ConfigError
from fgloc.frames import quaternion_matrix
from fgloc.sensors.cameras import pinhole, undistort_points
from fgloc.sensors.pnp import marker_pose_candidates, marker_pose_cov
from fgloc.types import (
    Camera,
    CornerMeasurement,
    CornersEvent,
    FloatArray,
    Landmark,
    LandmarkMap,
    LandmarkSighting,
    MarkerCorners,
    MarkerPose,
    MarkerPoseMeasurement,
    MarkerPosesEvent,
    RangeBearing,
    RangeBearingMeasurement,
    SightingsEvent,
)

_MIN_RANGE_M = 1e-3
_CLEAR_RATIO = 2.0  # a marker's pose is unambiguous if the mirrored one explains its corners this much worse
_MIRRORED_SIGMA = 1.0  # rad, of the yaw of one that is not
_MIN_COS_ALONG_AXIS = math.cos(math.radians(80.0))  # beyond it a distance along the axis says nothing of the range
_S = TypeVar("_S", MarkerCorners, MarkerPose, RangeBearing)


class LandmarkSensor:
    """Turns sightings into measurements.

    - Corners become CornerMeasurements if the map is known, else what a single view says of the marker's place.
    - Ranges and bearings are calibrated and moved from the sensor to the base.
    - Marker poses become planar poses, or range and bearing if ``landmarks.yaw_sigma_rad`` is not set.

    Two sightings of one id in one message: both are dropped, as nothing says which one is false.

    ``rejections`` counts what was not used: "sightings.duplicate_id", ".unknown_id", ".beyond_max" (more markers than
    ``markers.max_sightings``, the smallest go), ".no_size", ".undistortable", ".no_pose", ".range", ".bearing_bound".
    """

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, camera: Camera | None, T_base_sensor: FloatArray | None
    ) -> None:
        """Prepare the conversion.

        Args:
            config: all settings.
            landmark_map: the known map; None if landmarks are estimated.
            camera: of corners; None if there is none.
            T_base_sensor: ``(4, 4)`` takes coordinates as the sensor reports them (optical axes included) to the base;
                None: they are in the base frame.
        """
        self._config = config
        self._map = landmark_map
        self._camera = camera
        self._pinhole = None if camera is None else pinhole(camera)
        self._T_base_sensor = np.eye(4) if T_base_sensor is None else np.asarray(T_base_sensor, dtype=float)
        self.rejections: Counter[str] = Counter()

    @property
    def sees_corners(self) -> bool:
        """Whether sightings are corners in images."""
        return self._camera is not None

    def measure(self, event: SightingsEvent) -> tuple[LandmarkSighting, ...]:
        """What one message says of the landmarks.

        Raises:
            CameraError: marker corners, but no camera.
            ConfigError: marker corners without map, and no marker size.
        """
        if isinstance(event, CornersEvent):
            return tuple(self._corners(event))
        if isinstance(event, MarkerPosesEvent):
            poses = self._usable(event.sightings, lambda s: s.marker_id)
            made = [self._marker_pose(event.stamp_ns, pose) for pose in poses]
        else:
            ranges = self._usable(event.sightings, lambda s: s.landmark_id)
            made = [self._range_bearing(event.stamp_ns, seen) for seen in ranges]
        return tuple(m for m in made if m is not None)

    def _usable(self, sightings: Sequence[_S], identify: Callable[[_S], int]) -> list[_S]:
        """Sightings whose id is in the map, if there is one, and stands once in the message."""
        times = Counter(map(identify, sightings))
        usable = []
        for sighting in sightings:
            number = identify(sighting)
            if self._map is not None and number not in self._map:
                self.rejections["sightings.unknown_id"] += 1
            elif times[number] > 1:
                self.rejections["sightings.duplicate_id"] += 1
            else:
                usable.append(sighting)
        return usable

    # --- corners ---

    def _corners(self, event: CornersEvent) -> Iterator[LandmarkSighting]:
        if self._camera is None or self._pinhole is None:
            raise CameraError(
                f"{event.topic}: marker corners, but no calibration; record sensor_msgs/CameraInfo or set camera.file"
            )
        usable = self._usable(event.sightings, lambda s: s.marker_id)
        usable.sort(key=lambda s: -_area(s.corners_px))
        most = self._config.markers.max_sightings
        if len(usable) > most:
            self.rejections["sightings.beyond_max"] += len(usable) - most
        for seen in usable[:most]:
            landmark = None if self._map is None else self._map.landmarks[seen.marker_id]
            if landmark is None or landmark.size_m == 0.0:
                measured = self._single_view(event, seen, self._camera, landmark)
            else:
                measured = self._corner(event, seen, self._camera, self._pinhole)
            if measured is not None:
                yield measured

    def _corner(
        self, event: CornersEvent, seen: MarkerCorners, camera: Camera, ideal: Camera
    ) -> CornerMeasurement | None:
        corners = undistort_points(camera, seen.corners_px)
        if not np.isfinite(corners).all():
            self._reject("undistortable")
            return None
        section = self._config.markers
        return CornerMeasurement(
            event.stamp_ns, seen.marker_id, corners, section.sigma_px, ideal, blur_s=section.blur_s
        )

    def _single_view(
        self, event: CornersEvent, seen: MarkerCorners, camera: Camera, landmark: Landmark | None
    ) -> LandmarkSighting | None:
        """What one view of a marker with no known place says, with the covariance that its corners give."""
        size = self._config.markers.default_size_m
        if size is None and landmark is None:
            raise ConfigError(
                f"{event.topic}: marker corners without a map need their size: set markers.default_size_m"
            )
        if size is None:
            self._reject("no_size")
            return None
        sigma_px = self._config.markers.sigma_px
        candidates = marker_pose_candidates(camera, seen.corners_px, size)
        if not candidates:
            self._reject("no_pose")
            return None
        T, rms = candidates[0]
        cov = marker_pose_cov(camera, T, size, sigma_px)
        R = camera.T_base_cam[:3, :3]
        in_base = camera.T_base_cam @ T
        cov_xy = (R @ cov[:3, :3] @ R.T)[:2, :2]
        clear = len(candidates) == 1 or candidates[1][1] > _CLEAR_RATIO * max(rms, sigma_px)
        floor = self._config.landmarks.yaw_sigma_rad
        if floor is None or landmark is not None:
            return self._polar(event.stamp_ns, seen.marker_id, in_base[:2, 3], cov_xy)
        # Of a marker that may be mirrored the yaw says little; without it, it would be another kind of variable.
        yaw_var = max(floor if clear else _MIRRORED_SIGMA, math.sqrt((R @ cov[3:, 3:] @ R.T)[2, 2])) ** 2
        yaw = _planar_yaw(in_base[:3, :3], None)
        return _planar(event.stamp_ns, seen.marker_id, in_base[:2, 3], cov_xy, yaw, yaw_var)

    # --- ranges, bearings, poses ---

    def _range_bearing(self, stamp_ns: int, seen: RangeBearing) -> RangeBearingMeasurement | None:
        section = self._config.landmarks
        distance = section.range_scale * (seen.range_m - section.range_bias_m)
        bearing = seen.bearing_rad - section.bearing_bias_rad
        if distance < _MIN_RANGE_M:
            self._reject("range")
            return None
        c, s = math.cos(bearing), math.sin(bearing)
        if section.range_along_axis:
            if c < _MIN_COS_ALONG_AXIS:
                self._reject("bearing_bound")
                return None
            point = np.array([distance, distance * s / c])
            J = np.array([[1.0, 0.0], [s / c, distance / c**2]])
        else:
            point = distance * np.array([c, s])
            J = np.array([[c, -distance * s], [s, distance * c]])
        R, t = self._T_base_sensor[:2, :2], self._T_base_sensor[:2, 3]
        cov = R @ J @ self._range_bearing_cov(distance) @ J.T @ R.T
        return self._polar(stamp_ns, seen.landmark_id, R @ point + t, cov)

    def _marker_pose(self, stamp_ns: int, seen: MarkerPose) -> LandmarkSighting | None:
        section = self._config.landmarks
        arm = self._T_base_sensor[:3, :3] @ seen.position  # from the sensor, in the base's axes
        distance = section.range_scale * (math.hypot(arm[0], arm[1]) - section.range_bias_m)
        if distance < _MIN_RANGE_M:
            self._reject("range")
            return None
        bearing = math.atan2(arm[1], arm[0]) - section.bearing_bias_rad
        c, s = math.cos(bearing), math.sin(bearing)
        J = np.array([[c, -distance * s], [s, distance * c]])
        place = self._T_base_sensor[:2, 3] + distance * np.array([c, s])
        cov = J @ self._range_bearing_cov(distance) @ J.T
        landmark = None if self._map is None else self._map.landmarks[seen.marker_id]
        if section.yaw_sigma_rad is None or (landmark is not None and landmark.size_m == 0.0):
            return self._polar(stamp_ns, seen.marker_id, place, cov)
        rotation = self._T_base_sensor[:3, :3] @ quaternion_matrix(seen.orientation)
        yaw = _planar_yaw(rotation, landmark) - section.bearing_bias_rad
        return _planar(stamp_ns, seen.marker_id, place, cov, yaw, section.yaw_sigma_rad**2)

    def _range_bearing_cov(self, distance: float) -> FloatArray:
        section = self._config.landmarks
        sigma = section.range_sigma_m + section.range_sigma_per_m * distance
        return np.diag([sigma**2, section.bearing_sigma_rad**2])

    def _polar(
        self, stamp_ns: int, landmark_id: int, place: FloatArray, cov_xy: FloatArray
    ) -> RangeBearingMeasurement | None:
        """Range and bearing from the base of a place ``(2,)`` in the base frame with covariance ``(2, 2)``."""
        x, y = (float(v) for v in place)
        distance = math.hypot(x, y)
        if distance < _MIN_RANGE_M:
            self._reject("range")
            return None
        J = np.array([[-y / distance**2, x / distance**2], [x / distance, y / distance]])
        cov = J @ cov_xy @ J.T
        bearing = math.atan2(y, x)
        return RangeBearingMeasurement(stamp_ns, landmark_id, distance, bearing, 0.5 * (cov + cov.T))

    def _reject(self, reason: str) -> None:
        self.rejections[f"sightings.{reason}"] += 1


def _planar(
    stamp_ns: int, landmark_id: int, place: FloatArray, cov_xy: FloatArray, yaw: float, yaw_var: float
) -> MarkerPoseMeasurement:
    """``T_base_marker`` in the plane; `cov_xy` is in the base's axes, the measurement's in the marker's."""
    cov = np.zeros((3, 3))
    cov[:2, :2], cov[2, 2] = cov_xy, yaw_var
    cov = se2.rotate_cov(cov, -yaw)
    return MarkerPoseMeasurement(
        stamp_ns, landmark_id, np.array([*place, se2.wrap(yaw)]), np.asarray(0.5 * (cov + cov.T))
    )


def _planar_yaw(R_base_marker: FloatArray, landmark: Landmark | None) -> float:
    """Yaw by the rule of Landmark.planar; the map, if known, says whether the marker stands or lies."""
    standing = abs((R_base_marker if landmark is None else landmark.rotation)[2, 2]) < 0.7
    axis = R_base_marker[:, 2] if standing else R_base_marker[:, 0]
    return math.atan2(axis[1], axis[0])


def _area(corners: FloatArray) -> float:
    """Of a quadrilateral ``(4, 2)``."""
    (ax, ay), (bx, by) = corners[2] - corners[0], corners[3] - corners[1]
    return 0.5 * abs(float(ax * by - ay * bx))
