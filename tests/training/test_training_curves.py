"""A training says where its validation got worse."""

import re

import pytest

from fgloc_training.optimize import Curve
from fgloc_training.train import warnings_of


def curve(*scores):
    return Curve([1.0], [(100 * (i + 1), s) for i, s in enumerate(scores)])


@pytest.mark.parametrize(
    ("stage", "scores", "figures"),
    [
        ("mean", (8.0, 3.0, 2.5, 2.6), None),
        ("mean", (8.0, 2.0, 3.0), ["200", "2", "3", "300"]),
        ("mean", (2.0, 3.0, 4.0), ["2", "4", "300"]),
        ("variance", (16.9, 17.0, 18.0), None),
        ("variance", (16.9, 400.0, 3.6e6), ["16.9", "3.6e+06", "300"]),
        ("variance, member 2", (5.0, -2.0, 40.0), ["200", "-2", "40", "300"]),
        ("variance", (float("nan"), float("inf")), []),
        ("variance", (), None),
    ],
)
def test_worse_validation_is_told(stage, scores, figures):
    """From where on it got worse, from what to what, and where; of infinite ones no figure."""
    found = warnings_of({stage: curve(*scores)})
    assert len(found) == (figures is not None)
    if figures is not None:
        head, _, told = found[0].partition(": ")
        assert head == stage
        told_figures = re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e\+\d+)?", told)
        assert told_figures[: len(figures)] == figures
        assert bool(told_figures) == bool(figures)
