"""What slips say of the floor: how much the motion of a step may miss, during a slip and for a while after."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgloc.graph.measurement_log import Belief, Keyframe, MeasurementLog
from fgloc.graph.slip_noise import Footing
from fgloc.types import MotionMeasurement, Step

DARK = Footing(blind=True)


def going(speed: float, turn: float, dt: float = 0.1) -> MotionMeasurement:
    return MotionMeasurement("learned", 0, round(dt * 1e9), np.array([speed * dt, 0.0, turn * dt]), np.eye(3))


def through(seconds: float, dt: float, slips: bool, footing: Footing, motion=(0.5, 1.0)):
    """Footing and summed room after a while."""
    total = np.zeros((3, 3))
    for _ in range(round(seconds / dt)):
        total += footing.room(going(*motion, dt), slips)
        footing = replace(footing.then(slips, dt), blind=True)
    return footing, total


def test_while_there_are_sightings_they_show_a_slide():
    for footing in (Footing(), Footing(firm_s=1.0)):
        assert not footing.room(going(0.5, 1.0), slips=True).any()
    assert DARK.room(going(0.5, 1.0), slips=True).any()


def test_a_firm_floor_gives_no_room():
    assert not DARK.room(going(0.5, 1.0), slips=False).any()


@pytest.mark.parametrize("slips", [True, False])
def test_room_does_not_depend_on_how_time_is_cut(slips):
    start = DARK if slips else Footing(firm_s=0.0, blind=True)
    _, fine = through(2.0, 0.02, slips, start)
    _, coarse = through(2.0, 0.2, slips, start)
    assert np.diag(fine) == pytest.approx(np.diag(coarse), rel=0.05)


def test_what_a_slip_hides_grows_with_the_square_of_its_length():
    _, one = through(2.0, 0.1, True, DARK)
    _, two = through(4.0, 0.1, True, DARK)
    assert two[0, 0] == pytest.approx(4.0 * one[0, 0])
    assert two[1, 1] > 3.0 * one[1, 1] > 0.0
    assert two[2, 2] == 0.0  # the turn is told by the gyro, slip or not


def test_sideways_a_robot_slides_only_out_of_a_curve():
    for footing, slips in ((DARK, True), (Footing(firm_s=1.0, blind=True), False)):
        straight = footing.room(going(0.5, 0.0), slips)
        curve = footing.room(going(0.5, 1.0), slips)
        assert straight[1, 1] == 0.0
        assert curve[1, 1] > 0.0
        assert curve[0, 0] == straight[0, 0] > 0.0


def test_a_floor_is_slippery_for_a_while_after_a_slip():
    after, _ = through(1.0, 0.1, True, DARK)
    assert after == Footing(pytest.approx(1.0), 0.0, blind=True)
    soon, _ = through(5.0, 0.1, False, after)
    late, _ = through(25.0, 0.1, False, after)
    assert soon.slipping_s == late.slipping_s == 0.0
    assert soon.room(going(0.5, 1.0), slips=False).any()
    assert not late.room(going(0.5, 1.0), slips=False).any()


def test_the_log_knows_the_footing_of_the_next_step():
    log = MeasurementLog(10.0, keep_all=True)
    for k, why in enumerate(["", "slip", "slip", "frozen", ""]):
        frame = Keyframe(k, k * 10**8, 0.1 * k, Belief(np.zeros(3), np.eye(3)), off={"wheels": why} if why else {})
        frame.step, frame.footing = Step(k, 0, (k - 1) * 10**8, k * 10**8), log.footing(k, True)
        log.append(frame)
    assert [log.footing(k, True).slipping_s for k in range(6)] == pytest.approx([0.0, 0.0, 0.1, 0.2, 0.0, 0.0])
    assert log.footing(1, True).firm_s == np.inf  # it never slipped
    assert log.footing(5, True).firm_s == pytest.approx(0.2)
    log.keyframes[1].off = {}  # judged again
    log.keyframes[2].footing = log.footing(2, True)
    assert log.footing(3, True).slipping_s == pytest.approx(0.1)
    assert log.footing(99, True) == DARK  # after a gap nothing is known
