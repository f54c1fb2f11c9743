"""Poses of markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fgloc.types import FloatArray, Sighting, SightingsEvent


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPose(Sighting):
    """One marker's pose in the sensor frame."""

    position: FloatArray  # (3,)
    orientation: FloatArray  # (4,) quaternion x, y, z, w
    cov: FloatArray  # (6, 6) ROS order; zeros if the message gives none

    def place(self) -> FloatArray | None:
        """Its position."""
        return self.position

    def distance(self) -> float | None:
        """Of that position."""
        return float(np.linalg.norm(self.position))

    def noisy(self, sigmas: Mapping[str, float], rng: np.random.Generator) -> Sighting:
        """On each coordinate of its position."""
        if not (sigma := sigmas["position_m"]):
            return self
        return replace(self, position=self.position + rng.normal(0.0, sigma, 3))


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPosesEvent(SightingsEvent):
    """``aruco_msgs/MarkerArray`` or ``vision_msgs/Detection3DArray``."""

    sightings: tuple[MarkerPose, ...]
