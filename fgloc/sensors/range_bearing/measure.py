"""From ranges with bearings to points in the base frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from fgloc.sensors.range_bearing.events import RangeBearing, RangeBearingEvent
from fgloc.types import PointMeasurement

if TYPE_CHECKING:
    from fgloc.sensors.landmarks import SightingContext

_MIN_RANGE_M = 1e-3
_MIN_COS_ALONG_AXIS = math.cos(math.radians(80.0))  # beyond it a distance along the axis says nothing of the range


class RangeBearingMeasurer:
    """Calibrates ranges and bearings and moves them from the sensor to the base."""

    def __init__(self, context: SightingContext) -> None:
        self._context = context

    def __call__(self, event: RangeBearingEvent) -> Iterator[PointMeasurement]:
        """Those of one message."""
        made = (self._range_bearing(event.stamp_ns, seen) for seen in self._context.usable(event.sightings))
        return (m for m in made if m is not None)

    def _range_bearing(self, stamp_ns: int, seen: RangeBearing) -> PointMeasurement | None:
        section = self._context.config.landmarks
        distance = section.range_scale * (seen.range_m - section.range_bias_m)
        bearing = seen.bearing_rad - section.bearing_bias_rad
        if distance < _MIN_RANGE_M:
            self._context.reject("range")
            return None
        c, s = math.cos(bearing), math.sin(bearing)
        if section.range_along_axis:
            if c < _MIN_COS_ALONG_AXIS:
                self._context.reject("bearing_bound")
                return None
            point = np.array([distance, distance * s / c])
            J = np.array([[1.0, 0.0], [s / c, distance / c**2]])
        else:
            point = distance * np.array([c, s])
            J = np.array([[c, -distance * s], [s, distance * c]])
        R, t = self._context.T_base_sensor[:2, :2], self._context.T_base_sensor[:2, 3]
        cov = R @ J @ self._context.range_bearing_cov(distance) @ J.T @ R.T
        return self._context.polar(stamp_ns, seen.landmark_id, R @ point + t, cov)
