"""The extended Kalman filter, to compare with: pose and installation alone, nothing ever revised."""

from __future__ import annotations

import numpy as np

from fgloc import se2
from fgloc.config import EstimatorConfig
from fgloc.errors import ConfigError
from fgloc.graph.estimator import Estimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.joint import conditioned, correct, joint_cov, split
from fgloc.graph.measurement_log import Keyframe, PoseWithCovariance


class ExtendedKalmanFilter(Estimator):
    """Predicts by the fused motion and corrects by all accepted sightings at once.

    It is given the measurements of the fixed-lag smoother, after the same χ² gates. What a filter lacks remains: no
    sighting changes an older pose. Its log serves the batch smoother.

    Source: Thrun, Burgard, Fox, Probabilistic Robotics, table 7.2; on SE(2) with a right perturbation, iterated.
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
        known = frame.belief.installation or self.installed
        if frame.sightings:
            measurements = [s.measurement for s in frame.sightings]
            before = self._exact(frame.belief, known)
            corrected = correct(before, before.installation or known, measurements, self.factors)
            while corrected is not None and self._hold_beyond_gate(corrected[0]):
                before = self._exact(frame.belief, known)
                corrected = correct(before, before.installation or known, measurements, self.factors)
            if corrected is not None:
                frame.belief = self._considered(corrected[0])
        if frame.belief.installation is None:
            frame.belief.installation = known

    def _exact(self, belief: PoseWithCovariance, known: InstallationEstimate) -> PoseWithCovariance:
        """The belief with what is held as it was given, and nothing uncertain about it."""
        if not self.contradicted:
            return belief
        rows, P, prior = self._held(), joint_cov(belief, known), self.installation.prior()
        gap = np.array([prior.mean[i - 3] - known.mean[i - 3] for i in rows])
        shift = np.linalg.solve(P[np.ix_(rows, rows)], P[rows]).T @ gap
        moved = InstallationEstimate(known.mean + shift[3:], known.cov)
        pose = se2.compose(belief.pose, se2.exp(shift[:3]))
        return split(PoseWithCovariance(pose, belief.cov, belief.cross, moved), conditioned(P, rows))

    def _begin_at(self, newest: Keyframe) -> None:
        """A filter holds nothing else."""
