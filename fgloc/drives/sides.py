"""Wheels on two sides: differential drives with any number of wheels a side, and those that skid in turns."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from fgloc.drives.base import LENGTH_SIGMA, Drive, Equations, FloatArray, Metres, Place

_SEEN_TRACK = 0.3  # share by which the track that turns see may be larger than that of skidding wheels
_SEEN_AXLE_M = 0.1  # m: by how much the point that they turn about may lie elsewhere


class _Sides(Drive):
    """Base of drives with wheels on two sides."""

    left: tuple[str, ...] = Field(min_length=1, description="joints of the left side")
    right: tuple[str, ...] = Field(min_length=1, description="joints of the right side")
    track: Metres = Field(description="between the sides")
    axle_x: Place = Field(0.0, description="x of the point that does not move sideways")

    @property
    def driven(self) -> tuple[str, ...]:
        """Joints of both sides, the left ones first."""
        return (*self.left, *self.right)

    def equations(self, rates: FloatArray, angles: FloatArray) -> Equations:
        """Rows of each wheel along x, and one of the axle, which does not move sideways."""
        n = len(rates)
        side = np.array([-1.0] * len(self.left) + [1.0] * len(self.right))
        A, b = np.zeros((n + 1, 3)), np.zeros(n + 1)
        A[:n, 0], A[:n, 2], b[:n] = 1.0, 0.5 * self.track * side, self.radius * rates
        A[n] = 0.0, 1.0, self.axle_x
        by_track, by_axle = np.zeros((n + 1, 3)), np.zeros((n + 1, 3))
        by_track[:n, 2], by_axle[n, 2] = 0.5 * side, 1.0
        return Equations(A, b, {"track": by_track, "axle_x": by_axle}, {"radius": np.append(rates, 0.0)})


class Differential(_Sides):
    """Two sides of wheels that turn alike. Two wheels alone need no `wheels.drive`."""

    kind: Literal["differential"] = "differential"

    def usual_sigmas(self) -> dict[str, float]:
        """Prior sigmas of radius, track and axle_x."""
        return {"radius": LENGTH_SIGMA * self.radius, "track": LENGTH_SIGMA * self.track, "axle_x": 0.0}


class SkidSteer(_Sides):
    """Four or more wheels, or tracks, that skid in turns: the track is the one that turns see, which is larger.

    Source: Mandow et al. 2007, "Experimental kinematics for wheeled skid-steer mobile robots": the instantaneous
    centres of rotation of both sides stay nearly where they are.
    """

    kind: Literal["skid_steer"] = "skid_steer"

    def usual_sigmas(self) -> dict[str, float]:
        """Prior sigmas of radius, track and axle_x: the last two are known by driving only."""
        return {"radius": LENGTH_SIGMA * self.radius, "track": _SEEN_TRACK * self.track, "axle_x": _SEEN_AXLE_M}
