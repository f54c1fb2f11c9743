"""Sightings of any kind as places in the sensor's own axes, with their noise."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fgloc.config import Config
from fgloc.sensors import registry
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.pnp import marker_pose_candidates
from fgloc.types import FloatArray, FrameMeasurement, LandmarkMap, PixelMeasurement, SightingsEvent

_FLOOR_RAD, _FLOOR_M, _FLOOR_SHARE = 0.01, 0.02, 0.01  # what wheels err over a window, whatever the sensor's noise


@dataclass(frozen=True, slots=True, eq=False)
class RelativeSighting:
    """One sighting: time [s], landmark, place in the sensor's axes ``(3,)``, noise of bearing [rad] and range [m]."""

    at_s: float
    landmark_id: int
    point: FloatArray
    sigma_rad: float
    sigma_m: float


class SightingCollector:
    """Turns sightings events into places in the sensor's own axes."""

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, sensor: LandmarkSensor, T_base_sensor: FloatArray
    ) -> None:
        """Set up; ``sensor`` is this object's own, as it counts what it rejects."""
        self._config = config
        self._map = landmark_map
        self._sensor = sensor
        self._place = T_base_sensor

    def sightings(self, event: SightingsEvent, at_s: float) -> Iterator[RelativeSighting]:
        """What was seen where."""
        if event.in_pixels and self._map is None and registry.raw_landmarks().size(self._config) is None:
            return
        for m in self._sensor.measure(event):
            if isinstance(m, PixelMeasurement):
                assert self._map is not None
                landmark = self._map.landmarks[m.landmark_id]
                found = marker_pose_candidates(m.camera, m.corners_px, landmark.size_m)
                if not found:
                    continue
                T = found[0][0]
                point = T[:3, 3]
                sigma_rad = m.sigma_px / float(m.camera.K[0, 0])
                side_px = float(np.linalg.norm(m.corners_px - np.roll(m.corners_px, 1, axis=0), axis=1).max())
                sigma_m = float(np.linalg.norm(point)) * m.sigma_px / side_px
            elif isinstance(m, FrameMeasurement):
                x, y = m.pose[:2]
                point = self._in_sensor(x, y)
                sigma_m = math.sqrt(max(m.cov[0, 0], m.cov[1, 1]))
                sigma_rad = sigma_m / max(math.hypot(x, y), 0.1)
            else:
                point = self._in_sensor(m.range_m * math.cos(m.bearing_rad), m.range_m * math.sin(m.bearing_rad))
                sigma_rad, sigma_m = np.sqrt(np.diag(m.cov)).tolist()
            distance = float(np.linalg.norm(point))
            floor_m = _FLOOR_M + _FLOOR_SHARE * distance
            yield RelativeSighting(
                at_s, m.landmark_id, point, math.hypot(sigma_rad, _FLOOR_RAD), math.hypot(sigma_m, floor_m)
            )

    def _in_sensor(self, x: float, y: float) -> FloatArray:
        """A place given in the base's plane, taken to be at the sensor's own height."""
        arm = np.array([x - self._place[0, 3], y - self._place[1, 3], 0.0])
        return np.asarray(self._place[:3, :3].T @ arm)
