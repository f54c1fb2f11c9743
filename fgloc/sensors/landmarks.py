"""Conversion of sightings, in whatever form a sensor reports them, into measurements that become factors."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from fgloc import se2
from fgloc.config import Config, camera_role
from fgloc.sensors.measurements import FrameMeasurement, PointMeasurement
from fgloc.types import Camera, FloatArray, Landmark, LandmarkMap, Sighting


def planar_yaw(R_base_marker: FloatArray, landmark: Landmark | None) -> float:
    """Yaw by the rule of Landmark.planar; the map, if known, says whether the marker stands or lies."""
    standing = abs((R_base_marker if landmark is None else landmark.rotation)[2, 2]) < 0.7
    axis = R_base_marker[:, 2] if standing else R_base_marker[:, 0]
    return math.atan2(axis[1], axis[0])


_MIN_RANGE_M = 1e-3
_S = TypeVar("_S", bound=Sighting)


@dataclass(frozen=True, slots=True, eq=False)
class SightingContext:
    """Shared state of the sensors that see landmarks in one run.

    Attributes:
        config: all settings.
        landmark_map: the known map; None if landmarks are estimated.
        camera: of sightings in pixels; None if there is none.
        T_base_sensor: ``(4, 4)`` takes coordinates as the sensor reports them (optical axes included) to the base.
        rejections: what was not used, by reason.
    """

    config: Config
    landmark_map: LandmarkMap | None
    camera: Camera | None
    T_base_sensor: FloatArray
    rejections: Counter[str] = field(default_factory=Counter)

    def usable(self, sightings: Sequence[_S]) -> list[_S]:
        """Sightings whose id is in the map, if there is one, and stands once in the message."""
        times = Counter(s.landmark_id for s in sightings)
        usable = []
        for sighting in sightings:
            number = sighting.landmark_id
            if self.landmark_map is not None and number not in self.landmark_map:
                self.reject("unknown_id")
            elif times[number] > 1:
                self.reject("duplicate_id")
            else:
                usable.append(sighting)
        return usable

    def landmark(self, landmark_id: int) -> Landmark | None:
        """Landmark of the known map by its id; None without a map."""
        return None if self.landmark_map is None else self.landmark_map.landmarks[landmark_id]

    def reject(self, reason: str, count: int = 1) -> None:
        """Count sightings that are not used, by the camera that they are of where there are several."""
        name = "" if self.camera is None else self.camera.name
        self.rejections[f"{camera_role(name, 'sightings')}.{reason}"] += count

    def distance(self, range_m: float) -> float | None:
        """Distance [m] of a reported range, as the settings calibrate it; None: it is none, which is counted."""
        section = self.config.landmarks
        distance = section.range_scale * (range_m - section.range_bias_m)
        if distance < _MIN_RANGE_M:
            self.reject("range")
            return None
        return distance

    def range_bearing_cov(self, distance: float) -> FloatArray:
        """Covariance ``(2, 2)`` of range [m] and bearing [rad], in this order, at a distance [m], as configured."""
        section = self.config.landmarks
        sigma = section.range_sigma_m + section.range_sigma_per_m * distance
        return np.diag([sigma**2, section.bearing_sigma_rad**2])

    def polar(self, stamp_ns: int, landmark_id: int, place: FloatArray, cov_xy: FloatArray) -> PointMeasurement | None:
        """Range and bearing from the base of a place ``(2,)`` in the base frame with covariance ``(2, 2)``."""
        if math.hypot(float(place[0]), float(place[1])) < _MIN_RANGE_M:
            self.reject("range")
            return None
        return PointMeasurement.of_point(stamp_ns, landmark_id, place, cov_xy, self.config.landmarks.cauchy_k)

    def planar(
        self, stamp_ns: int, landmark_id: int, place: FloatArray, cov_xy: FloatArray, yaw: float, yaw_var: float
    ) -> FrameMeasurement:
        """``T_base_marker`` in the plane; `cov_xy` is in the base's axes, the measurement's in the marker's."""
        cov = np.zeros((3, 3))
        cov[:2, :2], cov[2, 2] = cov_xy, yaw_var
        cov = se2.rotate_cov(cov, -yaw)
        pose, cov = np.array([*place, se2.wrap(yaw)]), np.asarray(0.5 * (cov + cov.T))
        return FrameMeasurement(stamp_ns, landmark_id, pose, cov, cauchy_k=self.config.landmarks.cauchy_k)
