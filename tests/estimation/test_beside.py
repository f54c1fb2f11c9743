"""An odometry beside the wheels: used once it was compared, left out while it repeats its pose or differs."""

from __future__ import annotations

import numpy as np
import pytest

from fgloc import se2
from fgloc.config import GateConfig, OdometryTopic, WeightsConfig
from fgloc.estimation.beside import OdometriesBeside
from fgloc.frames import yaw_quaternion
from fgloc.graph.factors import LandmarkFactors
from fgloc.sensors.odometry import BesideEvent, BesideOdometry
from fgloc.types import MotionMeasurement, Step, by_class

NAME = "odometry.visual"
START, STEP_NS = 1_600_000_000_000_000_000, 200_000_000
TWIST, SIGMA = np.array([0.4, 0.0, 0.3]), 0.002
NONE = np.zeros((6, 6))


def held_against_wheels(visual, seconds=14.0, moving=True):
    """Whether an odometry is used in each step of 0.2 s, and why not; ``visual`` gives its report by time and pose."""
    rng, pose, events = np.random.default_rng(1), np.array([3.0, 1.0, 0.5]), []
    twist = TWIST * moving
    for k in range(round(20 * seconds) + 1):
        x, y, yaw = visual(0.05 * k, pose)
        where = np.array([x, y, 0.0]), yaw_quaternion(yaw), NONE
        stamp = START + k * STEP_NS // 4
        events.append(BesideEvent(stamp, stamp, "/vo", "vo", "", *where, np.zeros(3), np.zeros(3), NONE))
        pose = se2.compose(pose, se2.exp(0.05 * twist + SIGMA * moving * rng.standard_normal(3)))
    source = BesideOdometry(OdometryTopic(name="visual", topic="/vo", pose=(0, 0, 0)), GateConfig(), lambda name: None)
    beside, used, reasons = OdometriesBeside(WeightsConfig(), [source], LandmarkFactors(None), None), [], []
    for k in range(round(5 * seconds)):
        start = START + k * STEP_NS
        step = Step(k, 0, start, start + STEP_NS, by_class(events[max(4 * k - 1, 0) : 4 * k + 6]))
        wheels = se2.exp(0.2 * twist + 2.0 * SIGMA * moving * rng.standard_normal(3))
        cov = (2.0 * SIGMA) ** 2 * np.eye(3)
        used.append(bool(beside.read(step)))
        verdict = beside.judge(step, [MotionMeasurement("wheels", start, start + STEP_NS, wheels, cov)])
        reasons.append(verdict.rejected.get(NAME, ""))
    return used, reasons


def test_a_sound_one_enters_after_five_seconds_of_driving():
    used, reasons = held_against_wheels(lambda t, pose: pose)
    assert used == [k > 24 for k in range(len(used))]
    assert set(reasons) == {""}


def test_one_of_a_robot_that_stands_is_not_frozen_and_not_compared():
    used, reasons = held_against_wheels(lambda t, pose: pose, moving=False)
    assert not any(used)
    assert set(reasons) == {""}


@pytest.mark.parametrize("kind", ["frozen", "jumped", "deviates"])
def test_a_wrong_one_is_left_out_while_it_is_wrong(kind):
    held = {}
    wrong = {
        "frozen": lambda t, pose: held.setdefault("pose", pose) if 9.0 < t < 11.0 else pose,
        "jumped": lambda t, pose: se2.compose((1.0, 0.5, 0.6), pose) if t > 9.0 else pose,
        "deviates": lambda t, pose: se2.compose(pose, (0.12 * max(t - 9.0, 0.0), 0.0, 0.0)),
    }
    _, reasons = held_against_wheels(wrong[kind])
    first = next(k for k, reason in enumerate(reasons) if reason)
    assert 8.9 < 0.2 * first < 10.5
    assert reasons[first] == kind
    assert (reasons[-1] == "") == (kind != "deviates")
