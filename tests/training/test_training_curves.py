"""A training says where its validation got worse."""

import pytest

from fgloc_training.optimize import Curve
from fgloc_training.train import warnings_of


def curve(*scores):
    return Curve([1.0], [(100 * (i + 1), s) for i, s in enumerate(scores)])


@pytest.mark.parametrize(
    ("stage", "scores", "says"),
    [
        ("mean", (8.0, 3.0, 2.5, 2.6), None),
        ("mean", (8.0, 2.0, 3.0), "after iteration 200, from 2 to 3 at iteration 300"),
        ("mean", (2.0, 3.0, 4.0), "from the first validation on, from 2 to 4"),
        ("variance", (16.9, 17.0, 18.0), None),
        ("variance", (16.9, 400.0, 3.6e6), "negative log-likelihood got worse from the first validation on"),
        ("variance, member 2", (5.0, -2.0, 40.0), "the state of iteration 200 is kept"),
        ("variance", (float("nan"), float("inf")), "not finite"),
        ("variance", (), None),
    ],
)
def test_worse_validation_is_told(stage, scores, says):
    found = warnings_of({stage: curve(*scores)})
    assert len(found) == (says is not None)
    if says is not None:
        assert says in found[0]
        assert found[0].startswith(f"{stage}: ")
