"""After dead reckoning: how much more than its covariance said the pose was off, as the returning sightings have it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.gating import REDUNDANT
from fgloc.graph.measurement_log import Belief
from fgloc.graph.pose_fit import chi2_bound, joint_fit
from fgloc.types import LandmarkMeasurement

_LIKELY = 0.9  # a NIS that is exceeded less often than the rest of this scales the interval
_MOST_BY_ONE, _MOST = 16.0, 400.0  # on the word of one landmark, and of several that agree


def interval_scale(
    predicted: Belief, sightings: Sequence[LandmarkMeasurement], factors: LandmarkFactors, config: Config
) -> tuple[float, float]:
    """Factor on the covariance of a dead-reckoned interval with which its NIS is what is expected, three.

    Args:
        predicted: the dead-reckoned pose.
        sightings: the first ones since.
        factors: of the known map.
        config: noise and kernels of the sightings.

    Returns:
        The factor, 1 where nothing has to be scaled or where the sightings do not agree on a place that is still
        credible, and the interval's NIS (NaN if the sightings leave the place open).

    Source: design.md §6.4.
    """
    fit = joint_fit(predicted.pose, sightings, factors, config)
    if fit is None or fit.cost > fit.bound(config.estimator.gate_probability):
        return 1.0, float("nan")
    miss = se2.log(se2.between(predicted.pose, fit.pose))

    def nis(scale: float) -> float:
        return float(miss @ np.linalg.solve(scale * predicted.cov + fit.cov, miss))

    found = nis(1.0)
    several = len({m.landmark_id for m in sightings}) > 1 and fit.redundancy >= REDUNDANT
    most = _MOST if several else _MOST_BY_ONE
    if found <= chi2_bound(_LIKELY, 3) or nis(most) > 3.0:
        return 1.0, found
    return float(brentq(lambda scale: nis(scale) - 3.0, 1.0, most, rtol=1e-3)), found
