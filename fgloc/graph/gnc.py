"""Graduated non-convexity: which measurements of a whole run to believe, found without a good guess.

Source: Yang, Antonante, Tzoumas, Carlone 2020, "Graduated non-convexity for robust spatial perception: from non-minimal
solvers to global outlier rejection", truncated least squares (GNC-TLS).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from fgloc.types import FloatArray

_GROWTH = 2.0  # of the surrogate's control parameter; the paper has 1.4, which takes twice the solutions
_MOST_SOLUTIONS = 40
LEAST_WEIGHT = 1e-4  # an outlier keeps so much of its information, or a pose might be left undetermined
_HOPELESS = 1e3  # so far beyond the bound at the start: out at once, or they would bend the convex solution
_BINARY = 1e-2  # weights nearer than this to 0 or 1 are decided


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Factors that are believed or not together, such as the four corners of a marker.

    Attributes:
        factors: Gaussian.
        bound: squared whitened residual above which they are outliers: a χ² quantile of their dimensions.
        made: the factors of a weight; None: they are nonlinear, so that GTSAM can give them another noise.
    """

    factors: tuple[gtsam.NonlinearFactor, ...]
    bound: float
    made: Callable[[float], Iterable[gtsam.NonlinearFactor]] | None = None

    def ratio(self, values: gtsam.Values) -> float:
        """Squared whitened residual over the bound."""
        return 2.0 * sum(factor.error(values) for factor in self.factors) / self.bound

    def weighted(self, weight: float) -> list[gtsam.NonlinearFactor]:
        """The factors with their information times the weight."""
        if weight == 1.0:
            return list(self.factors)
        weight = max(weight, LEAST_WEIGHT)
        return list(self.made(weight)) if self.made else [_weighted(f, weight) for f in self.factors]


def _weighted(factor: gtsam.NonlinearFactor, weight: float) -> gtsam.NonlinearFactor:
    R = factor.noiseModel().R()  # type: ignore[attr-defined]
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(R * np.sqrt(weight))
    return factor.cloneWithNewNoiseModel(noise)  # type: ignore[attr-defined, no-any-return]


Solve = Callable[[gtsam.NonlinearFactorGraph, gtsam.Values], gtsam.Values]


def graduate(
    inliers: gtsam.NonlinearFactorGraph, candidates: Sequence[Candidate], values: gtsam.Values, solve: Solve
) -> tuple[FloatArray, gtsam.Values]:
    """Weights of the candidates, from a convex surrogate of the truncated squares step by step to these themselves.

    Args:
        inliers: factors that are believed in any case.
        candidates: those that are not.
        values: to start from.
        solve: least squares, from a start.

    Returns:
        Weights ``(n,)`` between 0 and 1, at the end nearly all of them 0 or 1; and the solution.
    """
    weights = np.ones(len(candidates))
    ratios = np.array([c.ratio(values) for c in candidates])
    if not len(ratios) or ratios.max() <= 1.0:
        return weights, values
    mu = 1.0 / (2.0 * min(ratios.max(), _HOPELESS) - 1.0)
    for _ in range(_MOST_SOLUTIONS):
        weights = surrogate_weights(ratios, mu)
        graph = gtsam.NonlinearFactorGraph(inliers)
        for candidate, weight in zip(candidates, weights.tolist(), strict=True):
            for factor in candidate.weighted(weight):
                graph.add(factor)
        values = solve(graph, values)
        ratios = np.array([c.ratio(values) for c in candidates])
        if (np.minimum(weights, 1.0 - weights) < _BINARY).all() and mu > 1.0:
            break
        mu *= _GROWTH
    return weights, values


def surrogate_weights(ratios: FloatArray, mu: float) -> FloatArray:
    """The paper's equation 14: of squared residuals over the bound, for a control parameter (∞: truncated squares)."""
    between = np.sqrt(mu * (mu + 1.0) / np.maximum(ratios, 1e-12)) - mu
    return np.where(ratios >= (mu + 1.0) / mu, 0.0, np.where(ratios <= mu / (mu + 1.0), 1.0, between))
