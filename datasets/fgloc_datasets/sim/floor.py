"""The ground of a scenario: friction, patches, ramps, humps, tilt and roughness."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from fgloc.types import FloatArray
from fgloc_datasets.sim.section import Positive, Section, Vector2


class Patch(Section):
    """A piece of floor with its own friction. ``points`` only for a polygon, relative to the center."""

    shape: Literal["ellipse", "rectangle", "polygon"] = "ellipse"
    center: Vector2
    size: Vector2 = (1.0, 1.0)  # full length and width
    yaw_deg: float = 0.0
    points: tuple[Vector2, ...] = ()
    mu: Positive


class RandomPatches(Section):
    """Patches of all shapes, drawn by the seed."""

    count: int = Field(ge=0)
    mu: Vector2 = (0.04, 0.15)
    size_m: Vector2 = (0.6, 1.6)


class Ramp(Section):
    """Up, level, down along x."""

    start_x: float
    angle_deg: Positive = 7.0
    rise_m: Positive = 1.0  # horizontal length of each slope
    top_m: Positive = 1.0
    center_y: float = 0.0
    width_m: Positive = 2.0


class Humps(Section):
    """Smooth humps drawn by the seed."""

    count: int = Field(ge=0)
    height_m: Vector2 = (0.01, 0.03)
    sigma_m: Vector2 = (0.12, 0.25)


class Tilt(Section):
    """The whole floor leans; it keeps its height in the middle of the room."""

    slope_deg: float = Field(gt=0, le=15)
    direction_deg: float = 0.0  # in which it rises

    def height(self, x: float | FloatArray, y: float | FloatArray) -> float | FloatArray:
        """Height [m] at a place [m]."""
        c, s = math.cos(math.radians(self.direction_deg)), math.sin(math.radians(self.direction_deg))
        return math.tan(math.radians(self.slope_deg)) * (c * x + s * y)


class Rough(Section):
    """A random field of heights, drawn by the seed: from ``height_m`` below the floor to ``height_m`` above it."""

    height_m: Positive = 0.03
    length_m: float = Field(0.3, ge=0.1)  # standard deviation of the Gaussian that smooths white noise


class Floor(Section):
    """Friction and height of the ground."""

    mu: Positive = 0.8
    patches: tuple[Patch, ...] = ()
    random_patches: RandomPatches | None = None
    ramp: Ramp | None = None
    humps: Humps | None = None
    ramps: tuple[Ramp, ...] = ()  # further ones
    tilt: Tilt | None = None
    rough: Rough | None = None

    @property
    def uneven(self) -> bool:
        """Whether there is any height at all."""
        return bool(self.ramp or self.humps or self.ramps or self.tilt or self.rough)
