"""What a linearized sighting is: whitened residuals with their Jacobians by pose and installation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fgloc.graph.installation import Installation
from fgloc.types import (
    FloatArray,
    IntArray,
)


@dataclass(frozen=True, slots=True, eq=False)
class Linearized:
    """Whitened residual and Jacobians of one sighting.

    Attributes:
        residual: ``(d,)`` predicted minus measured, in units of the sighting's own noise.
        J: ``(d, 3)`` by the right perturbation of the pose.
        columns: ``(c,)`` parameters of the installation that it depends on.
        H: ``(d, c)`` by these.
        shared: ``(d, s)`` square root of the covariance that comes on top of the identity: of the stamp's jitter and
            of the motion by which the sighting was moved to its keyframe; the same for all of one image.
        behind: whether a corner is behind the camera; the residual then means nothing.
    """

    residual: FloatArray
    J: FloatArray
    columns: IntArray
    H: FloatArray
    shared: FloatArray
    behind: bool = False

    def noise(self) -> FloatArray:
        """Covariance ``(d, d)`` of the residual without pose and installation."""
        return np.asarray(np.eye(len(self.residual)) + self.shared @ self.shared.T)


@dataclass(frozen=True, slots=True, eq=False)
class Stacked:
    """Residuals and Jacobians of sightings of one kind, whitened by their own noise.

    Attributes:
        residual: ``(m, d)``.
        J: ``(m, d, 3)`` by the pose.
        H: ``(m, d, c)`` by the parameters in `columns` ``(m, c)``; -1: none, then H is 0.
        columns: see above.
        behind: ``(m,)`` whether a corner is behind the camera.
    """

    residual: FloatArray
    J: FloatArray
    H: FloatArray
    columns: IntArray
    behind: NDArray[np.bool_]


def landmark_block(installation: Installation, landmark_id: int, rows: int) -> int:
    """Where the state of a landmark begins, if it has as many rows; else -1."""
    first, count = installation.landmarks.get(landmark_id, (-1, 0))
    return first if count >= rows else -1


def stacked(lines: Sequence[Linearized], n: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residual ``(d,)``, Jacobians ``(d, 3)`` and ``(d, n)``, noise covariance ``(d, d)`` of sightings of one image."""
    r = np.concatenate([one.residual for one in lines])
    J = np.vstack([one.J for one in lines])
    H = np.zeros((len(r), n))
    row, most = 0, max(one.shared.shape[1] for one in lines)
    shared = np.zeros((len(r), most))
    for one in lines:
        d = len(one.residual)
        H[row : row + d, one.columns] = one.H
        shared[row : row + d, : one.shared.shape[1]] = one.shared
        row += d
    return r, J, H, np.eye(len(r)) + shared @ shared.T
