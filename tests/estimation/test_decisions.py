"""Bounds, weights and conditions of the estimator's decisions: a test fails where one of them is without effect."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_lift import DT_NS, alarms, readings
from test_lift import step as still_step
from test_relocalization import MAP, Beacons, Wheels, localizer, step
from test_trust import COV, DT, white

from fgloc import se2
from fgloc.config import Config, WeightsConfig
from fgloc.estimation.faults import GlrTest, InnovationBias, LiftMonitor
from fgloc.estimation.localizer import Localizer
from fgloc.estimation.pose_fit import Fit, PoseConsensus
from fgloc.graph.noise import FusionRules, NoiseBudget
from fgloc.graph.observation import Lines
from fgloc.sensors.equipment import MotionSensors, PoseSensors
from fgloc.types import Mode, MotionMeasurement, MotionReadings, Step

STILL = np.zeros(3)


class Standing(Wheels):
    """Exact wheels of a robot that stands, but for what they do not measure."""

    def __init__(self, variances=(1e-10, 1e-10, 1e-10)) -> None:
        super().__init__()
        self._cov = np.diag(variances)

    def measure(self, step: Step) -> MotionMeasurement:
        return MotionMeasurement("wheels", step.start_ns, step.stamp_ns, STILL, self._cov)


def standing(variances=(1e-10, 1e-10, 1e-10)) -> Localizer:
    settings = Config.model_validate({"estimator": {"initial_pose": (0.0, 0.0, 0.0)}})
    return Localizer(settings, MAP, MotionSensors(Standing(variances)), PoseSensors(Beacons()))


# --- where the robot is ---


def test_two_sightings_that_agree_do_not_confirm_a_given_pose():
    run = standing()
    run.update(step(0, STILL, (4,)))
    run.update(step(1, STILL, (4,)))
    there = np.array([0.8, -0.3, 0.4])  # where all others put the robot
    for k in range(2, 40):
        last = run.update(step(k, there, (k % 4,)))
    assert run.tracking.initial_pose_conflict == pytest.approx(there, abs=0.05)
    assert run.rejections["motion.jump"] == 0
    assert np.hypot(*last.pose[:2]) < 0.05
    kept = {k for k, frame in run.estimator.log.keyframes.items() if frame.rejected}
    assert kept <= {2}  # nor does the batch know of those refused since two contradict it


def test_a_pose_that_each_landmark_contradicts_may_be_anywhere():
    """One of them may have been moved; if it is two, the robot was probably carried away."""
    run = localizer(initial_pose=(0.0, 0.0, 0.0))
    truth = STILL
    for k in range(20):
        truth = se2.compose(truth, (0.02, 0.0, 0.0))
        run.update(step(k, truth, (k % 5,)))
    sigmas = [math.sqrt(run.update(step(k, (2.0, 1.0, 2.0), (k % 5,))).cov[0, 0]) for k in (20, 21)]
    assert 0.2 < sigmas[0] < 1.5 < sigmas[1]


def test_a_robot_whose_yaw_is_unknown_is_lost_wherever_it_stands():
    run = standing((1e-8, 1e-8, 0.04))
    modes = [run.update(step(k, STILL, (4,) if k == 0 else ())).mode for k in range(60)]
    assert modes[5] is not Mode.LOST
    assert modes[-1] is Mode.LOST


def test_landmarks_are_not_named_moved_where_it_is_the_given_pose_that_is_wrong():
    run, off = standing(), np.array([0.0, 0.6, 0.0])
    run.update(step(0, STILL, (3,)))
    for k in range(1, 13):  # two agree, and one does not: it alone seems moved
        run.update(step(2 * k, STILL, ((3, 4)[k % 2],)))
        run.update(step(2 * k + 1, off, (0,)))
    assert run.sightings.modes.excludes(0)
    for k in range(26, 60):
        run.update(step(k, off, (1, 2)))
    assert run.tracking.keeps_initial_pose
    assert not run.sightings.modes.displacements


def consensus(share: float, redundancy: int, sigma: float, outliers=frozenset()) -> PoseConsensus:
    return PoseConsensus(Fit(STILL, np.eye(3) * sigma**2, 0.1, 6), share, 2, redundancy, outliers, 1)


def test_a_place_that_leaves_sightings_unexplained_is_known_better_and_checked():
    assert consensus(0.9, 1, 0.3).certain
    assert not consensus(0.9, 1, 0.3, frozenset({7})).certain  # one landmark is against it, and nothing checks it
    assert consensus(0.9, 3, 0.3, frozenset({7})).certain
    assert not consensus(0.7, 1, 0.05).certain
    assert consensus(0.7, 3, 0.05).certain
    assert not consensus(0.7, 3, 0.3).certain
    assert not consensus(0.5, 3, 0.05).certain


# --- motion that is wrong ---


def test_a_difference_that_the_installation_explains_is_no_fault():
    """A wheel radius that is known to 5 % and wrong by 3 % of 0.1 m a step."""
    differences = white(np.random.default_rng(4), 300) + np.array([0.003, 0.0, 0.0])
    by, known = np.array([[0.1], [0.0], [0.0]]), np.array([[0.05**2]])
    test = GlrTest(WeightsConfig())
    assert not any(test.judge(DT, d, COV, by, known).flagged for d in differences)
    test = GlrTest(WeightsConfig())
    assert any(test.judge(DT, d, COV).flagged for d in differences)


def test_the_bound_of_the_least_likely_window_allows_for_all_of_them():
    test = GlrTest(WeightsConfig())
    bounds = [test.judge(DT, d, COV).bound for d in white(np.random.default_rng(8), 20)]
    assert np.diff(bounds).min() >= 0.0
    assert bounds[-1] > bounds[0] + 2.0  # of a squared sigma


def slow(forward: float, reason: str, seconds: float = 0.2) -> np.ndarray:
    """Sigma of rejected wheels over the root of the step's length: those of 0.2 s, that nothing else replaces."""
    wheels = MotionMeasurement("wheels", 0, round(seconds * 1e9), np.array([forward, 0.0, 0.0]), np.eye(3) * 1e-10)
    rules = FusionRules(stopped_speed=0.7, stopped_turn=1.3)
    (made,) = NoiseBudget({"wheels": reason}).combine(MotionReadings(wheels, None, None), rules)
    return np.sqrt(np.diag(made.cov) / seconds)


def test_wheels_that_slip_may_be_wrong_by_a_slip_and_by_their_speed():
    assert slow(0.002, "slip") == pytest.approx([0.1, 0.1, 0.1], abs=0.001)
    assert slow(0.08, "slip") == pytest.approx([0.4, 0.4, 0.1], abs=0.001)
    assert slow(0.08, "frozen") == pytest.approx([0.7, 0.7, 1.3], abs=0.001)


def test_wheels_that_report_nothing_may_have_stopped():
    assert slow(0.0, "slip") == pytest.approx([0.7, 0.7, 1.3], abs=0.001)


@pytest.mark.parametrize(("turn", "told"), [(0.0024, False), (0.003, True)])
def test_a_floor_that_shakes_turns_no_robot(turn, told):
    """It turns by 0.048 or 0.06 rad, many times what gyro and wheels are wrong by."""
    steps = [still_step(k, 9.78, command=0.0) for k in range(20)]
    found = alarms(LiftMonitor(10.0), [(s, readings(s, turn=turn)) for s in steps])
    assert any("turned_at_rest" in reasons for reasons in found) == told


@pytest.mark.parametrize(("sigma", "biased"), [(1e-3, True), (2.0, False)])
def test_a_bias_that_the_pose_explains_is_none(sigma, biased):
    bias = InnovationBias(0.999, 10.0)
    one = Lines(np.array([1.5, -1.5]), np.eye(2, 3), np.zeros((2, 0)), [2], np.array([False]))
    told = [bias.is_biased("1", k * DT_NS, one, np.eye(3) * sigma**2) for k in range(1, 20)]
    assert any(told) == biased


def test_innovations_of_before_a_silence_are_no_bias():
    """Three of 2.5 sigmas are one together; two are not."""
    bias = InnovationBias(0.999, 10.0)
    one = Lines(np.array([2.5]), np.eye(1, 3), np.zeros((1, 0)), [1], np.array([False]))

    def is_biased(seconds):
        return bias.is_biased("1", round(seconds * 1e9), one, np.eye(3) * 1e-6)

    assert [is_biased(s) for s in (1.0, 2.0, 3.0, 12.9)] == [False, True, True, True]
    assert [is_biased(s) for s in (23.0, 23.0, 24.0)] == [False, False, True]
