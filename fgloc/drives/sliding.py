"""Drives that go sideways: mecanum, omnidirectional wheels on a ring, and swerve modules."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from fgloc.drives.base import (
    LENGTH_SIGMA,
    ZERO_SIGMA,
    Drive,
    Equations,
    FloatArray,
    Metres,
    Place,
    Steered,
    as_many_as_wheels,
)

_LATERAL_SIGMA = 0.03  # rollers creep


class Mecanum(Drive):
    """Four wheels with rollers at 45°, which form an X as seen from above, as they nearly always do.

    Source: Taheri, Qiao, Ghaeminezhad 2015, "Kinematic model of a four mecanum wheeled mobile robot", equation 24.
    """

    slides: ClassVar[bool] = True
    kind: Literal["mecanum"] = "mecanum"
    wheels: tuple[str, str, str, str] = Field(description="joints: front left, front right, rear left, rear right")
    half_sum: Metres = Field(description="half the wheelbase and half the track, added")
    lateral: float = Field(1.0, ge=0.1, le=10, description="true over ideal way sideways")

    @property
    def driven(self) -> tuple[str, ...]:
        """Joints of the wheels."""
        return self.wheels

    def usual_sigmas(self) -> dict[str, float]:
        """Prior sigmas of radius, half_sum and lateral."""
        return {
            "radius": LENGTH_SIGMA * self.radius,
            "half_sum": LENGTH_SIGMA * self.half_sum,
            "lateral": _LATERAL_SIGMA * self.lateral,
        }

    def equations(self, rates: FloatArray, angles: FloatArray) -> Equations:
        """One row for each wheel."""
        sideways, turning = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, 1.0, -1.0, 1.0])
        A = np.column_stack([np.ones(4), sideways / self.lateral, self.half_sum * turning])
        none = np.zeros(4)
        A_by = {
            "half_sum": np.column_stack([none, none, turning]),
            "lateral": np.column_stack([none, -sideways / self.lateral**2, none]),
        }
        return Equations(A, self.radius * rates, A_by, {"radius": rates})


class Omni(Drive):
    """Three or more omnidirectional wheels on a ring, which roll along it. Positive rates turn it to the left."""

    slides: ClassVar[bool] = True
    kind: Literal["omni"] = "omni"
    wheels: tuple[str, ...] = Field(min_length=3, description="joints of the wheels")
    angles_deg: tuple[float, ...] = Field(
        min_length=3, description="place of each on the ring, from straight ahead to the left"
    )
    ring: Metres = Field(description="its radius")

    @property
    def driven(self) -> tuple[str, ...]:
        """Joints of the wheels."""
        return self.wheels

    def usual_sigmas(self) -> dict[str, float]:
        """Prior sigmas of radius and ring."""
        return {"radius": LENGTH_SIGMA * self.radius, "ring": LENGTH_SIGMA * self.ring}

    def equations(self, rates: FloatArray, angles: FloatArray) -> Equations:
        """One row for each wheel."""
        at, none = np.radians(self.angles_deg), np.zeros(len(rates))
        A = np.column_stack([-np.sin(at), np.cos(at), none + self.ring])
        A_by = {"ring": np.column_stack([none, none, none + 1.0])}
        return Equations(A, self.radius * rates, A_by, {"radius": rates})

    @model_validator(mode="before")
    @classmethod
    def _alike(cls, content: object) -> object:
        return as_many_as_wheels(content, "angles_deg")


class Swerve(Steered):
    """Two or more modules, each of which steers and drives."""

    slides: ClassVar[bool] = True
    kind: Literal["swerve"] = "swerve"
    wheels: tuple[str, ...] = Field(min_length=2, description="joints of the wheels")
    steering_joints: tuple[str, ...] = Field(min_length=2, description="joints of the steering, in the same order")
    places: tuple[tuple[Place, Place], ...] = Field(min_length=2, description="x y of the modules")
    steering_zeros: tuple[float, ...] = Field((), description="added to the angles")
    size: float = Field(1.0, ge=0.1, le=10, description="true places over those given")

    @property
    def driven(self) -> tuple[str, ...]:
        """Joints of the wheels."""
        return self.wheels

    @property
    def steered(self) -> tuple[str, ...]:
        """Joints of the steering."""
        return self.steering_joints

    def usual_sigmas(self) -> dict[str, float]:
        """Prior sigmas of radius, size, and the zero of each module."""
        zeros = {f"steering_zeros_{i}": ZERO_SIGMA for i in range(len(self.wheels))}
        return {"radius": LENGTH_SIGMA * self.radius, "size": LENGTH_SIGMA, **zeros}

    def equations(self, rates: FloatArray, angles: FloatArray) -> Equations:
        """Two rows for each module: along and across the way it points."""
        n, (x, y) = len(rates), np.array(self.places).T
        alpha = self.steering_ratio * angles + np.array(self.steering_zeros)
        c, s = np.cos(alpha), np.sin(alpha)
        along, across = x * s - y * c, x * c + y * s  # by the turn, at size one
        A = np.vstack([np.column_stack([c, s, self.size * along]), np.column_stack([-s, c, self.size * across])])
        none = np.zeros(2 * n)
        A_by = {"size": np.column_stack([none, none, np.append(along, across)])}
        for i in range(n):
            turned = np.zeros((2 * n, 3))
            turned[i] = -s[i], c[i], self.size * across[i]
            turned[n + i] = -c[i], -s[i], -self.size * along[i]
            A_by[f"steering_zeros_{i}"] = turned
        travel = np.append(rates, np.zeros(n))
        return Equations(A, self.radius * travel, A_by, {"radius": travel})

    @model_validator(mode="before")
    @classmethod
    def _alike(cls, content: object) -> object:
        for key in ("steering_joints", "places"):
            as_many_as_wheels(content, key)
        if isinstance(content, dict) and not content.get("steering_zeros"):
            content = content | {"steering_zeros": (0.0,) * len(content.get("wheels", ()))}
        return as_many_as_wheels(content, "steering_zeros")
