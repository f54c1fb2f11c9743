"""Measurements of registered sensors, which depend on the pose alone: residuals and Jacobians of many in one call."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fgloc import se2
from fgloc.graph.linearized import Stacked
from fgloc.types import FloatArray, PoseMeasurement


class PoseBatch:
    """Measurements of any dimensions; see `PoseMeasurement`."""

    def __init__(self, seen: Sequence[PoseMeasurement]) -> None:
        self._seen = seen
        self.rows = [len(m.cov) for m in seen]
        self._whitening = [np.asarray(np.linalg.inv(np.linalg.cholesky(m.cov))) for m in seen]
        self._columns = np.zeros((len(seen), 0), dtype=np.int64)

    def evaluate(self, poses: FloatArray, theta: FloatArray, by_installation: bool = True) -> Stacked:
        """All measurements, each at its own pose ``(m, 3)``; rows beyond a measurement's own are 0."""
        n, most = len(poses), max(self.rows)
        residual, J = np.zeros((n, most)), np.zeros((n, most, 3))
        for i, (m, W, d) in enumerate(zip(self._seen, self._whitening, self.rows, strict=True)):
            r, by_pose = m.residual_at_keyframe(poses[i])
            residual[i, :d], J[i, :d] = W @ r, W @ by_pose
        return Stacked(residual, J, np.zeros((n, most, 0)), self._columns, np.zeros(n, dtype=np.bool_))

    def shared_all(self, stack: Stacked) -> None:
        """None: these are of different dimensions."""

    def shared(self, i: int, J: FloatArray, H: FloatArray) -> FloatArray:
        """As `Linearized` has it: of the motion by which the measurement was moved to its keyframe."""
        m = self._seen[i]
        if m.motion_cov is None:
            return np.zeros((len(J), 0))
        values, vectors = np.linalg.eigh(m.motion_cov)
        return np.asarray(J @ se2.adjoint(m.T_keyframe_then) @ (vectors * np.sqrt(np.maximum(values, 0.0))))
