"""From marker poses to planar poses or, where their yaw is not to be used, to points in the base frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from fgloc.frames import quaternion_matrix
from fgloc.sensors.marker_pose.events import MarkerPose, MarkerPosesEvent
from fgloc.sensors.planar import planar_yaw
from fgloc.types import LandmarkSighting

if TYPE_CHECKING:
    from fgloc.sensors.landmarks import SightingContext

_MIN_RANGE_M = 1e-3


class MarkerPoseMeasurer:
    """Planar poses of markers; range and bearing only if ``landmarks.yaw_sigma_rad`` is not set."""

    def __init__(self, context: SightingContext) -> None:
        self._context = context

    def __call__(self, event: MarkerPosesEvent) -> Iterator[LandmarkSighting]:
        """Those of one message."""
        made = (self._marker_pose(event.stamp_ns, seen) for seen in self._context.usable(event.sightings))
        return (m for m in made if m is not None)

    def _marker_pose(self, stamp_ns: int, seen: MarkerPose) -> LandmarkSighting | None:
        section = self._context.config.landmarks
        arm = self._context.T_base_sensor[:3, :3] @ seen.position  # from the sensor, in the base's axes
        distance = section.range_scale * (math.hypot(arm[0], arm[1]) - section.range_bias_m)
        if distance < _MIN_RANGE_M:
            self._context.reject("range")
            return None
        bearing = math.atan2(arm[1], arm[0]) - section.bearing_bias_rad
        c, s = math.cos(bearing), math.sin(bearing)
        J = np.array([[c, -distance * s], [s, distance * c]])
        place = self._context.T_base_sensor[:2, 3] + distance * np.array([c, s])
        cov = J @ self._context.range_bearing_cov(distance) @ J.T
        landmark = self._context.landmark(seen.landmark_id)
        if section.yaw_sigma_rad is None or (landmark is not None and landmark.size_m == 0.0):
            return self._context.polar(stamp_ns, seen.landmark_id, place, cov)
        rotation = self._context.T_base_sensor[:3, :3] @ quaternion_matrix(seen.orientation)
        yaw = planar_yaw(rotation, landmark) - section.bearing_bias_rad
        return self._context.planar(stamp_ns, seen.landmark_id, place, cov, yaw, section.yaw_sigma_rad**2)
