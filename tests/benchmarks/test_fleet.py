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


def causes_and_errors(drive):
    """Causes of the bounds of a drive; no error is beyond its bound."""
    causes = set()
    for estimate, error in drive.run():
        assert (np.abs(error) <= estimate.protection.bound).all()
        causes.add(estimate.protection.cause)
    return causes


def test_the_bound_says_that_a_camera_may_have_been_knocked():
    assert "mounting of camera" in causes_and_errors(Drive("knocked", seed=26, factor=1.0, seconds=60.0))


def test_the_bound_says_which_constant_sightings_contradict():
    """The camera looks 2.7° aside, 6.6 prior sigmas: what is configured holds, and the pose is off by that."""
    causes = causes_and_errors(Drive("dark30", seed=12, factor=2.0, seconds=90.0))
    assert any(cause.startswith("camera.") for cause in causes)


def test_failures_change_what_is_seen_or_measured():
    sound = list(Drive("none", seed=1, factor=1.0, seconds=40.0).events())
    for case in set(CASES) - {"none", "dark30", "frozen", "onewheel", "blurred"}:  # those begin later
        told = Drive(case, seed=1, factor=1.0, seconds=40.0).events()
        assert any(repr(a) != repr(b) for a, b in zip(told, sound, strict=False)), case
