"""The batch's order of elimination, and the covariances that are read in it."""

import math

import gtsam
import numpy as np
import pytest

from benchmarks.steps import Chain, World
from fgloc.config import BatchConfig
from fgloc.graph import batch
from fgloc.graph.batch import BatchSmoother, elimination_order
from fgloc.graph.factors import INSTALLATION, pose_key
from fgloc.graph.measurement_log import Keyframe, PoseWithCovariance


def depths(place: list[int]) -> list[int]:
    """Of each pose of a chain in the tree of its elimination, from the place it has in the order."""
    n, found = len(place), {}
    for i in sorted(range(n), key=place.__getitem__, reverse=True):
        left = next((j for j in range(i - 1, -1, -1) if place[j] > place[i]), None)
        right = next((j for j in range(i + 1, n) if place[j] > place[i]), None)
        found[i] = 1 + max((found[j] for j in (left, right) if j is not None), default=0)
    return [found[i] for i in range(n)]


@pytest.mark.parametrize("count", [1, 2, 3, 100, 1000])
def test_the_tree_is_as_deep_as_the_logarithm_of_the_length(count):
    belief = PoseWithCovariance(np.zeros(3), np.eye(3))
    order = elimination_order([Keyframe(k, 0, 0.0, belief) for k in range(count)], 7)
    keys = [order.at(i) for i in range(order.size())]
    assert sorted(keys[:-1]) == [pose_key(k) for k in range(count)]
    assert keys[-1] == INSTALLATION
    place = {key: i for i, key in enumerate(keys)}
    assert max(depths([place[pose_key(k)] for k in range(count)])) == math.floor(math.log2(count)) + 1


def test_covariances_are_those_in_the_order_of_gtsam(monkeypatch):
    monkeypatch.setattr(batch, "_KEYFRAMES_KEPT", 7)
    chain = Chain(World(), keep_all=True, with_model=False)
    for _ in chain.updates(World().events(4.0)):
        pass
    solver = BatchSmoother(chain.localizer.estimator.log, chain.localizer.factors, BatchConfig(), 0.9999)
    marginals = gtsam.Marginals(solver._graph, solver._values)
    expected = np.array([marginals.marginalCovariance(pose_key(frame.k)) for frame in solver.frames])
    assert len(expected) > 50
    assert np.allclose(solver.result().covs, expected, rtol=1e-7, atol=1e-14)
    assert np.allclose(solver.installed().cov, marginals.marginalCovariance(INSTALLATION), rtol=1e-7, atol=1e-12)
