"""The extended Kalman filter, to compare with: the pose alone, one linear update a step, nothing ever revised."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from fgloc import se2
from fgloc.config import EstimatorConfig
from fgloc.errors import ConfigError
from fgloc.graph.estimator import Estimator
from fgloc.graph.factors import LandmarkFactors, pose_key, whitened
from fgloc.graph.measurement_log import Belief, Keyframe


class ExtendedKalmanFilter(Estimator):
    """Predicts by the fused motion and corrects by all believed sightings at once, linearized at the prediction.

    It is given the measurements of the fixed-lag smoother, after the same χ² gates. What a filter lacks remains: no
    relinearization, no robust kernels, and no sighting changes an older pose. Its log serves the batch smoother.

    Source: Thrun, Burgard, Fox, Probabilistic Robotics, table 7.2; on SE(2) with a right perturbation.
    """

    def __init__(self, config: EstimatorConfig, factors: LandmarkFactors, keep_all: bool = False) -> None:
        """Begin without a pose.

        Raises:
            ConfigError: the map is unknown.
        """
        if not factors.known:
            raise ConfigError(
                "estimator.kind is ekf, which does not estimate landmarks: give a map with --map, or build one with "
                "`fgloc map`"
            )
        super().__init__(config, factors, keep_all)

    def _solve(self, frame: Keyframe) -> None:
        if not frame.sightings:
            return
        # 1. Linearize
        values = gtsam.Values()
        values.insert(pose_key(frame.k), gtsam.Pose2(*frame.belief.pose))
        rows = [whitened(s.factors, values, s.cauchy_k) for s in frame.sightings]
        residual, H = np.concatenate([r for r, _ in rows]), np.vstack([J for _, J in rows])
        # 2. Correct; residuals are whitened: their noise is the identity
        P = frame.belief.cov
        S = H @ P @ H.T + np.eye(len(residual))
        K = np.linalg.solve(S, H @ P).T
        pose = se2.compose(frame.belief.pose, se2.exp(-K @ residual))
        # 3. Joseph's form stays positive definite
        left = np.eye(3) - K @ H
        frame.belief = Belief(pose, left @ P @ left.T + K @ K.T)

    def _begin_at(self, newest: Keyframe) -> None:
        """A filter holds nothing else."""

    def _build_again(self, changed: Sequence[int]) -> None:
        """Filter anew; the oldest belief in the log, which nothing leads to any more, stands as it was changed."""
        if changed:
            self._solve_again(changed)
