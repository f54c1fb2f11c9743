"""Cuts the steps of a run into windows, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.diagnosis.window import RelativeSightings, Window
from fgloc.sensors import registry
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.pnp import marker_pose_candidates
from fgloc.types import FloatArray, FrameMeasurement, LandmarkMap, PixelMeasurement, SightingsEvent, Step

SPAN_S = 8.0  # sightings of a window
MARGIN_S = 1.2  # wheel motion before and after them, for clocks that differ
_MOST_SIGHTINGS = 150
_SPARSE_S = 0.09  # events closer than this to the one before add little information
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


class WindowCutter:
    """Collects motion and sightings; gives a window whenever one is complete."""

    def __init__(self) -> None:
        self._segment = -1
        self._times: list[float] = []
        self._motions: list[FloatArray] = []
        self._sightings: list[RelativeSighting] = []
        self._last_sighting_s = -math.inf
        self._origin_ns: int | None = None
        self.travelled: FloatArray = np.zeros(3)  # from the segment's first step to the oldest pose kept

    def seconds(self, stamp_ns: int) -> float:
        """Time since the first step [s]."""
        return (stamp_ns - (self._origin_ns or 0)) * 1e-9

    def begin(self, step: Step) -> None:
        """Take the step's time; a new segment forgets what was kept."""
        if self._origin_ns is None:
            self._origin_ns = step.start_ns
        if step.segment != self._segment:
            self._segment = step.segment
            self._forget(self.seconds(step.stamp_ns))

    def wants(self, at_s: float) -> bool:
        """Whether a sightings event at this time would add something."""
        return abs(at_s - self._last_sighting_s) >= _SPARSE_S and len(self._sightings) < 2 * _MOST_SIGHTINGS

    def add_sighting(self, sighting: RelativeSighting) -> None:
        """Keep a sighting."""
        self._sightings.append(sighting)
        self._last_sighting_s = sighting.at_s

    def move(self, step: Step, motion: FloatArray | None) -> Window | None:
        """Take in the step's motion; None: it is not known, and what was kept is of no use any more."""
        if step.dt <= 0.0:
            return None
        end = self.seconds(step.stamp_ns)
        if motion is None or not self._times:
            self._forget(end)
            return None
        self._times.append(end)
        self._motions.append(motion)
        if end - self._times[0] < SPAN_S + 2.0 * MARGIN_S:
            return None
        window = self._window()
        keep = next(i for i, t in enumerate(self._times) if t >= end - 2.0 * MARGIN_S)
        for passed in self._motions[:keep]:
            self.travelled = se2.compose(self.travelled, passed)
        del self._times[:keep], self._motions[:keep]
        self._sightings = [s for s in self._sightings if s.at_s >= end - MARGIN_S]
        return window

    def _window(self) -> Window:
        start = self._times[0]
        inside = [s for s in self._sightings if start + MARGIN_S <= s.at_s < self._times[-1] - MARGIN_S]
        inside = inside[:: max(1, -(-len(inside) // _MOST_SIGHTINGS))]
        sightings = RelativeSightings(
            np.array([s.at_s - start for s in inside]),
            np.array([s.landmark_id for s in inside], dtype=np.int64),
            np.array([s.point for s in inside]).reshape(-1, 3),
            np.array([(s.sigma_rad, s.sigma_m) for s in inside]).reshape(-1, 2),
        )
        return Window(start, np.array(self._times) - start, np.array(self._motions), sightings)

    def _forget(self, at_s: float) -> None:
        self._times, self._motions, self._sightings = [at_s], [], []
        self.travelled = np.zeros(3)
