"""Who is wrong when wheels and learned motion disagree: sightings decide."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from fgloc import se2
from fgloc.faults.fault_isolation import Arbiter
from fgloc.graph.measurement_log import Belief
from fgloc.types import FloatArray, MotionMeasurement, Readings

STEP_NS = 100_000_000
TRUE = np.array([0.05, 0.0, 0.02])
WRONG = np.array([0.02, 0.0, 0.06])
COV = np.diag([1e-6, 1e-6, 1e-6])
FIX = np.diag([1e-5, 1e-5, 1e-5])


def readings(k: int, wheels: FloatArray, learned: FloatArray, rng: np.random.Generator) -> Readings:
    def said(source: str, motion: FloatArray) -> MotionMeasurement:
        noisy = motion + rng.normal(0.0, 1e-3, 3)
        return MotionMeasurement(source, k * STEP_NS, (k + 1) * STEP_NS, noisy, COV)

    return Readings(said("wheels", wheels), said("learned", learned))


def disagree(arbiter: Arbiter, wheels: FloatArray, learned: FloatArray, steps: int, blind: Sequence[int] = ()) -> None:
    """A robot that moves by TRUE each step, with a fix at all but the blind ones."""
    rng = np.random.default_rng(0)
    pose = np.zeros(3)
    for k in range(steps):
        pose = se2.compose(pose, TRUE)
        seen = Belief(se2.compose(pose, rng.normal(0.0, 2e-3, 3)), FIX)
        arbiter.hear(readings(k, wheels, learned, rng), None if k in blind else seen)


def test_without_evidence_the_witness_is_believed():
    arbiter = Arbiter()
    assert not arbiter.sides_with_wheels
    disagree(arbiter, TRUE, WRONG, 5)  # less than one stretch
    assert arbiter.credit == 0


@pytest.mark.parametrize(("wheels", "learned", "sided"), [(TRUE, WRONG, True), (WRONG, TRUE, False)])
def test_sightings_side_with_the_source_that_is_right(wheels, learned, sided):
    arbiter = Arbiter()
    disagree(arbiter, wheels, learned, 20)
    assert arbiter.sides_with_wheels is sided
    assert (arbiter.credit > 0) is sided
    assert arbiter.credit != 0


@pytest.mark.parametrize("both", [TRUE, WRONG])
def test_where_both_are_right_or_both_wrong_nobody_is_accused(both):
    arbiter = Arbiter()
    disagree(arbiter, both, both, 100)
    assert arbiter.credit == 0


def test_without_fixes_there_is_no_evidence():
    arbiter = Arbiter()
    disagree(arbiter, TRUE, WRONG, 40, blind=range(40))
    assert arbiter.credit == 0


def test_a_stretch_may_span_steps_without_a_fix():
    arbiter = Arbiter()
    disagree(arbiter, TRUE, WRONG, 40, blind=[k for k in range(40) if k % 8])
    assert arbiter.sides_with_wheels


def test_what_was_found_out_outlasts_the_disagreement_but_can_be_overturned():
    arbiter = Arbiter()
    disagree(arbiter, TRUE, WRONG, 200)
    arbiter.reset()
    assert arbiter.sides_with_wheels
    disagree(arbiter, WRONG, TRUE, 60)
    assert not arbiter.sides_with_wheels


def test_a_source_that_falls_silent_breaks_the_stretch():
    arbiter, rng = Arbiter(), np.random.default_rng(1)
    pose = np.zeros(3)
    for k in range(60):
        pose = se2.compose(pose, TRUE)
        heard = Readings() if k % 3 == 2 else readings(k, TRUE, WRONG, rng)
        arbiter.hear(heard, Belief(pose, FIX))
    assert arbiter.credit == 0
