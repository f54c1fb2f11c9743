"""Robots of the simulated fleet: sound ones are where they are estimated to be, and the bounds hold."""

import numpy as np
import pytest

from benchmarks.fleet import CASES, Drive


@pytest.mark.parametrize("case", ["none", "mixed"])
def test_a_drive_is_localized_within_its_bounds(case):
    errors, within = [], []
    for estimate, error in Drive(case, seed=1, factor=1.0, seconds=40.0).run():
        errors.append(np.hypot(error[0], error[1]))
        within.append((np.abs(error) <= estimate.protection.bound).all())
    assert len(errors) > 70
    assert np.median(errors) < 0.05
    assert all(within)


def test_failures_change_what_is_seen_or_measured():
    sound = list(Drive("none", seed=1, factor=1.0, seconds=40.0).events())
    for case in set(CASES) - {"none", "dark30", "frozen", "onewheel", "blurred"}:  # those begin later
        told = Drive(case, seed=1, factor=1.0, seconds=40.0).events()
        assert any(repr(a) != repr(b) for a, b in zip(told, sound, strict=False)), case
