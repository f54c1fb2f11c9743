"""Comparison of pairs of signals: what two that share little tell of each other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fgloc.diagnosis.pairs import MOST_LAG_S, best_lag, fit_rate
from fgloc.diagnosis.signals import Path
from fgloc.instrumentation import giving_way
from fgloc.stats import few_samples


@pytest.mark.parametrize("late_s", [MOST_LAG_S, -MOST_LAG_S])
def test_the_longest_lag_is_found_where_two_signals_share_a_few_seconds(late_s):
    t = np.arange(0.0, 10.0, 0.02)

    def yaw(s):
        return 0.9 * np.sin(1.3 * s) + 0.3 * np.sin(3.1 * s + 1.0)

    still = np.zeros(len(t))
    path = Path(t, np.column_stack([still, still, yaw(t)]), np.zeros(len(t), dtype=np.int64), "odometry")
    fit = fit_rate(path, t, 0.5 * yaw(t - late_s))
    assert fit.late_s.value == pytest.approx(late_s, abs=0.002)
    assert fit.share == pytest.approx(1.0, abs=1e-6)
    assert math.isclose(fit.scale.value, 2.0, rel_tol=0.1)


@pytest.mark.parametrize("late_s", [0.123, -0.2768])
def test_a_lag_is_found_more_finely_than_it_is_tried(late_s):
    lag, share = best_lag(lambda lags: 1.0 - (lags - late_s) ** 2, MOST_LAG_S)
    assert lag == pytest.approx(late_s, abs=1e-9)
    assert share == pytest.approx(1.0, abs=1e-4)


def test_a_comparison_in_the_background_lets_others_go_first_and_finds_the_same():
    t, asked = np.arange(0.0, 20.0, 0.02), []
    yaw = 0.9 * np.sin(1.3 * t) + 0.3 * np.sin(3.1 * t)
    still = np.zeros(len(t))
    path = Path(t, np.column_stack([still, still, yaw]), np.zeros(len(t), dtype=np.int64), "odometry")
    with giving_way(lambda: asked.append(True)):
        beside = fit_rate(path, t, yaw)
    assert len(asked) > 10
    assert beside == fit_rate(path, t, yaw)
    before = len(asked)
    fit_rate(path, t, yaw)
    assert len(asked) == before


@pytest.mark.parametrize(("samples", "factor"), [(5, 11.4), (10, 2.48), (30, 1.27), (100_000, 1.0)])
def test_few_samples_make_a_standard_deviation_unsure(samples, factor):
    """By tables of Student's t at the probability of five standard deviations."""
    assert few_samples(samples) == pytest.approx(factor, rel=0.005)
