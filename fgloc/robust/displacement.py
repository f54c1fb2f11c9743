"""How a displacement of a landmark explains a sighting, and how likely that is."""

from __future__ import annotations

import math

import numpy as np

from fgloc.graph.observation import Linearized
from fgloc.types import FloatArray

MOVED = 0.5  # m, rad: prior sigma of a displacement, on each axis, and of a marker's rotation with it

Explained = tuple[FloatArray, FloatArray, FloatArray]
"""Of each hypothesis: minus twice the log-likelihood ``(L,)``, mean ``(L, 2)`` and covariance ``(L, 2, 2)`` of δ."""


def explain(w: FloatArray, G: FloatArray, mean: FloatArray, cov: FloatArray) -> Explained:
    """A white innovation ``(d,)`` whose mean is ``G δ`` under each hypothesis, and δ after it."""
    gap = w - np.einsum("ldi,li->ld", G, mean)
    information, pull = G.transpose(0, 2, 1) @ G, np.einsum("ldi,ld->li", G, gap)
    after = np.linalg.inv(np.linalg.inv(cov) + information)
    after = 0.5 * (after + after.transpose(0, 2, 1))
    step = np.einsum("lij,lj->li", after, pull)
    cost = (gap**2).sum(1) - (pull * step).sum(1) + np.linalg.slogdet(np.eye(2) + cov @ information)[1]
    return cost, mean + step, after


def by_displacement(one: Linearized, pose: FloatArray) -> FloatArray:
    """Derivative ``(d, 2)`` of a sighting's residual by its landmark's displacement in the map."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.asarray(-one.J[:, :2] @ np.array([[c, s], [-s, c]]))


def rotation_cov(one: Linearized, rows: tuple[int, int]) -> FloatArray:
    """Covariance ``(d, d)`` of a marker's residual if whoever moved it also turned it, and hung it higher or lower.

    Args:
        one: the sighting.
        rows: first and number of the rows of its landmark in the installation.
    """
    of_it = (one.columns >= rows[0] + 2) & (one.columns < rows[0] + rows[1])
    H = one.H[:, of_it] * MOVED
    return np.asarray(H @ H.T)
