"""Sightings as functions of pose and installation: residuals with both Jacobians, for many sightings in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fgloc.graph.corner_batch import CornerBatch
from fgloc.graph.installation import Installation
from fgloc.graph.linearized import Linearized
from fgloc.graph.planar_batch import PlanarBatch
from fgloc.graph.pose_batch import PoseBatch
from fgloc.types import (
    FloatArray,
    IntArray,
    Landmark,
    LandmarkMeasurement,
    PixelMeasurement,
    PoseMeasurement,
)


class Observations:
    """Sightings prepared for being linearized, once or often."""

    def __init__(
        self, measurements: Sequence[LandmarkMeasurement], landmarks: Mapping[int, Landmark], installation: Installation
    ) -> None:
        """Collect what does not depend on pose and installation.

        Args:
            measurements: of known landmarks.
            landmarks: the map.
            installation: the parameters.
        """
        self._count = len(measurements)
        corners = [i for i, m in enumerate(measurements) if isinstance(m, PixelMeasurement)]
        planar = [i for i, m in enumerate(measurements) if not isinstance(m, PixelMeasurement | PoseMeasurement)]
        by_pose = [i for i, m in enumerate(measurements) if isinstance(m, PoseMeasurement)]
        self.batches: list[tuple[list[int], CornerBatch | PlanarBatch | PoseBatch]] = []
        if corners:
            seen = [m for m in measurements if isinstance(m, PixelMeasurement)]
            self.batches.append((corners, CornerBatch(seen, landmarks, installation)))
        if planar:
            rest = [m for m in measurements if not isinstance(m, PixelMeasurement | PoseMeasurement)]
            self.batches.append((planar, PlanarBatch(rest, landmarks, installation)))
        if by_pose:
            self.batches.append((by_pose, PoseBatch([m for m in measurements if isinstance(m, PoseMeasurement)])))

    def __len__(self) -> int:
        return self._count

    def squares(self, poses: FloatArray, theta: FloatArray) -> tuple[FloatArray, IntArray]:
        """Squared residual ``(m,)`` of each sighting by its own noise, infinite of one behind the camera, and its rows.

        Args:
            poses: ``(m, 3)`` of each; on uneven ground ``(m, 6)``, with height, roll and pitch.
            theta: ``(n,)`` installation.
        """
        found, rows = np.zeros(self._count), np.zeros(self._count, dtype=np.int64)
        for members, batch in self.batches:
            own = poses[members] if isinstance(batch, CornerBatch) else poses[members, :3]
            stack = batch.evaluate(own, theta, by_installation=False)
            found[members] = np.where(stack.behind, np.inf, (stack.residual**2).sum(axis=1))
            rows[members] = batch.rows
        return found, rows

    def linearize(self, poses: FloatArray, theta: FloatArray) -> list[Linearized]:
        """Every sighting at a pose ``(3,)``, or each at its own ``(m, 3)``, and an installation ``(n,)``."""
        each = np.broadcast_to(poses, (self._count, 3))
        found: dict[int, Linearized] = {}
        for rows, batch in self.batches:
            stack = batch.evaluate(each[rows], theta)
            for i, row in enumerate(rows):
                used = stack.columns[i] >= 0
                d = batch.rows[i]
                H, J = stack.H[i, :d], stack.J[i, :d]
                shared = batch.shared(i, J, H)
                found[row] = Linearized(
                    stack.residual[i, :d], J, stack.columns[i][used], H[:, used], shared, bool(stack.behind[i])
                )
        return [found[i] for i in range(self._count)]
