"""Ranges with bearings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fgloc.types import Sighting, SightingsEvent


@dataclass(frozen=True, slots=True, eq=False)
class RangeBearing(Sighting):
    """Distance and direction to one landmark in the sensor's plane (x forward, bearing counter-clockwise)."""

    range_m: float
    bearing_rad: float

    def distance(self) -> float | None:
        """The range."""
        return self.range_m

    def noisy(self, sigmas: Mapping[str, float], rng: np.random.Generator) -> Sighting:
        """On range and bearing."""
        range_m, bearing_rad = sigmas["range_m"], sigmas["bearing_rad"]
        if not (range_m or bearing_rad):
            return self
        return replace(
            self,
            range_m=self.range_m + float(rng.normal(0.0, range_m)),
            bearing_rad=self.bearing_rad + float(rng.normal(0.0, bearing_rad)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class RangeBearingEvent(SightingsEvent):
    """``landmark_msgs/LandmarkArray``."""

    sightings: tuple[RangeBearing, ...]
