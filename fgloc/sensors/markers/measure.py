"""From marker corners to measurements: corners if the marker's place is known, else what a single view gives."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from fgloc.errors import CameraError, ConfigError
from fgloc.sensors.cameras import pinhole, undistort_points
from fgloc.sensors.markers.events import CornersEvent, MarkerCorners
from fgloc.sensors.planar import planar_yaw
from fgloc.sensors.pnp import marker_pose_candidates, marker_pose_cov
from fgloc.types import Camera, FloatArray, Landmark, LandmarkSighting, PixelMeasurement

if TYPE_CHECKING:
    from fgloc.sensors.landmarks import SightingContext

_CLEAR_RATIO = 2.0  # a marker's pose is unambiguous if the mirrored one explains its corners this much worse
_MIRRORED_SIGMA = 1.0  # rad, of the yaw of one that is not


class CornerMeasurer:
    """Corners of markers; see `fgloc.sensors.landmarks.LandmarkSensor` for what it rejects."""

    def __init__(self, context: SightingContext) -> None:
        self._context = context
        self._pinhole = None if context.camera is None else pinhole(context.camera)

    def __call__(self, event: CornersEvent) -> Iterator[LandmarkSighting]:
        """Those of one message."""
        if self._context.camera is None or self._pinhole is None:
            raise CameraError(
                f"{event.topic}: marker corners, but no calibration; record sensor_msgs/CameraInfo or set camera.file"
            )
        usable = self._context.usable(event.sightings)
        usable.sort(key=lambda s: -_area(s.corners_px))
        most = self._context.config.markers.max_sightings
        if len(usable) > most:
            self._context.rejections["sightings.beyond_max"] += len(usable) - most
        for seen in usable[:most]:
            landmark = self._context.landmark(seen.landmark_id)
            if landmark is None or landmark.size_m == 0.0:
                measured = self._single_view(event, seen, self._context.camera, landmark)
            else:
                measured = self._corner(event, seen, self._context.camera, self._pinhole)
            if measured is not None:
                yield measured

    def _corner(
        self, event: CornersEvent, seen: MarkerCorners, camera: Camera, ideal: Camera
    ) -> PixelMeasurement | None:
        corners = undistort_points(camera, seen.corners_px)
        if not np.isfinite(corners).all():
            self._context.reject("undistortable")
            return None
        section = self._context.config.markers
        return PixelMeasurement(
            event.stamp_ns,
            seen.landmark_id,
            corners,
            section.sigma_px,
            ideal,
            blur_s=section.blur_s,
            cauchy_k=section.cauchy_k,
        )

    def _single_view(
        self, event: CornersEvent, seen: MarkerCorners, camera: Camera, landmark: Landmark | None
    ) -> LandmarkSighting | None:
        """What one view of a marker with no known place gives, with the covariance that its corners give."""
        size = self._context.config.markers.default_size_m
        if size is None and landmark is None:
            raise ConfigError(
                f"{event.topic}: marker corners without a map need their size: set markers.default_size_m"
            )
        if size is None:
            self._context.reject("no_size")
            return None
        sigma_px = self._context.config.markers.sigma_px
        candidates = marker_pose_candidates(camera, seen.corners_px, size)
        if not candidates:
            self._context.reject("no_pose")
            return None
        T, rms = candidates[0]
        cov = marker_pose_cov(camera, T, size, sigma_px)
        R = camera.T_base_cam[:3, :3]
        in_base = camera.T_base_cam @ T
        cov_xy = (R @ cov[:3, :3] @ R.T)[:2, :2]
        clear = len(candidates) == 1 or candidates[1][1] > _CLEAR_RATIO * max(rms, sigma_px)
        floor = self._context.config.landmarks.yaw_sigma_rad
        if floor is None or landmark is not None:
            return self._context.polar(event.stamp_ns, seen.landmark_id, in_base[:2, 3], cov_xy)
        # Of a marker that may be mirrored the yaw is worth little; without it, it would be another kind of variable.
        yaw_var = max(floor if clear else _MIRRORED_SIGMA, math.sqrt((R @ cov[3:, 3:] @ R.T)[2, 2])) ** 2
        yaw = planar_yaw(in_base[:3, :3], None)
        return self._context.planar(event.stamp_ns, seen.landmark_id, in_base[:2, 3], cov_xy, yaw, yaw_var)


def _area(corners: FloatArray) -> float:
    """Of a quadrilateral ``(4, 2)``."""
    (ax, ay), (bx, by) = corners[2] - corners[0], corners[3] - corners[1]
    return 0.5 * abs(float(ax * by - ay * bx))
