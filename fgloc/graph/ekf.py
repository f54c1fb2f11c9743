"""The extended Kalman filter, to compare with: pose and installation alone, nothing ever revised."""

from __future__ import annotations

from fgloc.config import EstimatorConfig
from fgloc.errors import ConfigError
from fgloc.graph.estimator import Estimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.joint import correct
from fgloc.graph.measurement_log import Keyframe


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
            corrected = correct(frame.belief, known, measurements, self.factors)
            if corrected is not None:
                frame.belief = corrected[0]
        if frame.belief.installation is None:
            frame.belief.installation = known

    def _begin_at(self, newest: Keyframe) -> None:
        """A filter holds nothing else."""
