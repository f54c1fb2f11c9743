"""The gyro: exact turns, a bias that is learned, a variance that grows with the time without a fix."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from fgloc.config import GyroConfig
from fgloc.sensors.gyro import Gyro, ImuEvent
from fgloc.types import Step, by_class

START = 10**18
STILL, DRIVING = np.zeros(3), np.array([0.04, 0.0, 0.02])


def imu(t: float, rate: float, axis=(0.0, 0.0, 1.0)) -> ImuEvent:
    stamp = START + round(t * 1e9)
    return ImuEvent(stamp, stamp, "/imu", "imu", rate * np.asarray(axis), np.zeros(3), np.zeros((3, 3)))


def step(start: float, end: float, rate, hz: float = 100.0, axis=(0.0, 0.0, 1.0), phase: float = 0.0) -> Step:
    """A step with the messages inside and one on either side; ``rate`` is a function of time [s]."""
    n = round((end - start) * hz)
    times = start + phase / hz + np.arange(-1, n + 2) / hz
    messages = tuple(imu(t, rate(t), axis) for t in times)
    return Step(0, 0, START + round(start * 1e9), START + round(end * 1e9), by_class(messages))


def known(gyro: Gyro, bias: float = 0.0, sigma: float = 1e-6) -> Gyro:
    gyro.bias, gyro.bias_variance = bias, sigma**2
    return gyro


@pytest.mark.parametrize("phase", [0.0, 0.37, 0.9])
def test_a_varying_rate_is_integrated_to_the_ends_of_the_step(phase):
    """Linear rates exactly, wherever the messages lie against the step."""
    turn = known(Gyro(GyroConfig())).measure(step(2.0, 2.13, lambda t: 0.3 - 0.7 * t, phase=phase), DRIVING)
    assert turn.yaw == pytest.approx(0.3 * 0.13 - 0.35 * (2.13**2 - 2.0**2), abs=1e-9)


def test_rates_are_held_at_the_ends_that_no_message_covers():
    messages = (imu(0.02, 1.0), imu(0.06, 2.0))
    turn = known(Gyro(GyroConfig())).measure(Step(0, 0, START, START + 10**8, by_class(messages)), DRIVING)
    assert turn.yaw == pytest.approx(0.02 * 1.0 + 0.04 * 1.5 + 0.04 * 2.0, abs=1e-9)


def test_steps_add_up_to_the_whole_turn():
    def rate(t):
        return 0.4 * math.sin(3.0 * t)

    gyro = known(Gyro(GyroConfig()))
    cuts = [0.0, 0.05, 0.25, 0.31, 0.8, 1.0]
    parts = [gyro.measure(step(a, b, rate), DRIVING).yaw for a, b in itertools.pairwise(cuts)]
    assert sum(parts) == pytest.approx(0.4 / 3.0 * (1.0 - math.cos(3.0)), abs=1e-4)


def test_only_the_rate_about_the_bases_vertical_counts():
    """An IMU that hangs upside down, and one that leans by 30 degrees."""
    leaning = np.array([0.0, -math.sin(math.pi / 6), math.cos(math.pi / 6)])
    for up in (np.array([0.0, 0.0, -1.0]), leaning):
        gyro = known(Gyro(GyroConfig(), up))
        turn = gyro.measure(step(0.0, 0.2, lambda t: 0.5, axis=up + 3.0 * np.cross(up, (1.0, 0.0, 0.0))), DRIVING)
        assert turn.yaw == pytest.approx(0.1, abs=1e-9)


def test_silence_is_no_turn_and_is_counted_once_the_gyro_has_spoken():
    gyro = Gyro(GyroConfig())
    nothing = Step(0, 0, START, START + 10**8)
    assert gyro.measure(nothing, DRIVING) is None
    assert not gyro.rejections
    assert gyro.measure(step(0.0, 0.1, lambda t: 0.1), DRIVING) is not None
    assert gyro.measure(nothing, DRIVING) is None
    gap = Step(0, 0, START, START + 4 * 10**8, by_class([imu(0.0, 0.1), imu(0.1, 0.1), imu(0.3, 0.1), imu(0.4, 0.1)]))
    assert gyro.measure(gap, DRIVING) is None
    assert gyro.rejections == {"gyro.silence": 2}


# --- bias -------------------------------------------------------------------------------------------------------------


def test_the_bias_is_learned_while_the_wheels_stand():
    rng, config = np.random.default_rng(1), GyroConfig()
    gyro, bias = Gyro(config), 0.012
    noise = config.yaw_per_sqrt_s * math.sqrt(100.0)
    for i in range(40):
        gyro.measure(step(0.1 * i, 0.1 * i + 0.1, lambda t: bias + rng.normal(0.0, noise)), STILL)
    assert abs(gyro.bias - bias) < 4.0 * math.sqrt(gyro.bias_variance)
    assert math.sqrt(gyro.bias_variance) < 0.0015


def test_the_bias_is_not_learned_while_the_robot_is_turned_on_the_spot_or_drives():
    turned, driving = Gyro(GyroConfig()), Gyro(GyroConfig())
    for i in range(40):
        turned.measure(step(0.1 * i, 0.1 * i + 0.1, lambda t: 0.4), STILL)  # by hand: the wheels stand
        driving.measure(step(0.1 * i, 0.1 * i + 0.1, lambda t: 0.02), DRIVING)
    assert turned.bias == 0.0
    assert driving.bias == 0.0


def drive(
    gyro: Gyro, bias: float, seconds: float, fix_every_s: float, seed: int = 0, wrong_at: float = -1.0, by: float = 0.8
) -> float:
    """Turn at 0.3 rad/s with fixes of the yaw now and then; the true yaw at the end."""
    rng, yaw, sigma = np.random.default_rng(seed), 0.0, 0.005
    for i in range(round(10 * seconds)):
        turn = gyro.measure(step(0.1 * i, 0.1 * i + 0.1, lambda t: 0.3 + bias), np.array([0.04, 0.0, 0.03]))
        yaw += 0.03
        gyro.turned(turn.yaw, 0.1)
        t = 0.1 * (i + 1)
        if round(t / 0.1) % round(fix_every_s / 0.1) == 0:
            wrong = by if abs(t - wrong_at) < 0.01 else 0.0
            gyro.fix(math.remainder(yaw + wrong + rng.normal(0.0, sigma), math.tau), sigma**2)
    return yaw


@pytest.mark.parametrize("seed", range(3))
def test_the_bias_is_learned_between_fixes_and_as_well_as_it_says(seed):
    gyro = Gyro(GyroConfig())
    drive(gyro, -0.015, 60.0, 0.5, seed)
    assert abs(gyro.bias + 0.015) < 4.0 * math.sqrt(gyro.bias_variance)
    assert math.sqrt(gyro.bias_variance) < 0.0015


def test_a_bias_that_changed_is_learned_again():
    gyro = Gyro(GyroConfig())
    drive(gyro, 0.01, 60.0, 0.5)
    gyro.forget_fix()
    drive(gyro, 0.06, 6.0, 0.5)
    assert abs(gyro.bias - 0.06) < 4.0 * math.sqrt(gyro.bias_variance)
    assert abs(gyro.bias - 0.06) < 0.01


def test_a_fix_that_is_too_wrong_for_a_bias_is_not_taken_for_a_change_of_it_and_of_others_little_is_left():
    """Every fourth fix is used: the bias is learned over two seconds, here from 0.5 s on."""
    much, little = Gyro(GyroConfig()), Gyro(GyroConfig())
    drive(much, 0.01, 60.0, 0.5, wrong_at=58.5, by=0.8)
    assert 0.01 < abs(much.bias - 0.01) < 0.1  # of 0.4 rad/s that the two fixes tell
    drive(little, 0.01, 60.0, 0.5, wrong_at=50.5, by=0.2)
    assert abs(little.bias - 0.01) < 0.003


@pytest.mark.parametrize("by", [0.1, 0.2])
@pytest.mark.parametrize("seconds", [50.5, 52.5, 54.5])
def test_a_wrong_fix_makes_the_bias_as_uncertain_as_it_makes_it_wrong(by, seconds):
    gyro = Gyro(GyroConfig())
    drive(gyro, 0.01, seconds, 0.5, wrong_at=50.5, by=by)
    assert abs(gyro.bias - 0.01) < 4.0 * math.sqrt(gyro.bias_variance)


def test_a_bias_learned_at_rest_does_not_change_the_turn_since_the_last_fix():
    """The turn was measured with the bias of then: what has been learned since must not be counted twice."""
    gyro, bias = Gyro(GyroConfig()), 0.02
    gyro.fix(0.0, 1e-6)
    for i in range(100):
        wheels = DRIVING if i < 50 else STILL
        gyro.turned(gyro.measure(step(0.1 * i, 0.1 * i + 0.1, lambda t: bias), wheels).yaw, 0.1)
    assert abs(gyro.bias - bias) < 2e-4
    before = gyro.bias_variance
    gyro.fix(0.0, 1e-6)
    assert abs(gyro.bias - bias) < 2e-4
    assert gyro.bias_variance < before  # the fix confirms it


def test_an_uncertain_fix_teaches_less():
    learned = {}
    for sigma in (0.001, 0.1):
        gyro = Gyro(GyroConfig())
        for i in range(100):
            gyro.turned(gyro.measure(step(0.1 * i, 0.1 * i + 0.1, lambda t: 0.01), DRIVING).yaw, 0.1)
            gyro.fix(0.0, sigma**2)
        learned[sigma] = gyro.bias
    assert learned[0.001] == pytest.approx(0.01, rel=0.1)
    assert 0.0 <= learned[0.1] < 0.3 * learned[0.001]


def test_fixes_that_rest_on_the_gyro_teach_its_bias_from_far_apart_only():
    gyro, bias = Gyro(GyroConfig()), 0.01
    gyro.fix(0.0, 1e-6, apart_s=8.0)
    for i in range(100):
        gyro.turned(gyro.measure(step(0.1 * i, 0.1 * i + 0.1, lambda t: bias), DRIVING).yaw, 0.1)
        gyro.fix(0.0, 1e-6, apart_s=8.0)
        if i < 78:
            assert gyro.bias == 0.0
    assert gyro.bias == pytest.approx(bias, abs=1e-3)


def test_a_silence_between_two_fixes_teaches_nothing():
    gyro = known(Gyro(GyroConfig()), sigma=0.02)
    gyro.fix(0.0, 1e-6)
    for i in range(30):
        gyro.turned(gyro.measure(step(0.1 * i, 0.1 * i + 0.1, lambda t: 0.0), DRIVING).yaw, 0.1)
    gyro.forget_fix()  # turned unheard by 0.5 rad
    gyro.fix(0.5, 1e-6)
    assert gyro.bias == 0.0


# --- variance ---------------------------------------------------------------------------------------------------------


def test_the_variance_over_a_blind_time_does_not_depend_on_how_it_is_cut():
    config, sums = GyroConfig(bias_walk=0.0, scale_sigma=0.01), []  # the scale is a state of the graph, no noise
    for dt in (0.05, 0.2, 1.0):
        gyro, variance = known(Gyro(config), 0.001, 0.003), 0.0
        for i in range(round(10.0 / dt)):
            variance += gyro.measure(step(i * dt, (i + 1) * dt, lambda t: 0.2), DRIVING, since_fix_s=i * dt).variance
        sums.append(variance)
    white, bias = config.yaw_per_sqrt_s**2 * 10.0, (0.003 * 10.0) ** 2
    assert sums == pytest.approx([white + bias] * 3, rel=1e-6)


def test_the_variance_covers_what_a_wrong_bias_does():
    """Over runs whose bias is drawn as the gyro believes it to be."""
    rng, sigma, values = np.random.default_rng(4), 0.004, []
    for _ in range(60):
        bias = rng.normal(0.0, sigma)
        gyro, yaw, variance = known(Gyro(GyroConfig(bias_walk=0.0)), 0.0, sigma), 0.0, 0.0
        for i in range(20):
            turn = gyro.measure(
                step(0.5 * i, 0.5 * i + 0.5, lambda t, b=bias: b, hz=20.0), DRIVING, since_fix_s=0.5 * i
            )
            yaw, variance = yaw + turn.yaw, variance + turn.variance
        values.append(yaw**2 / variance)
    assert 0.6 < np.mean(values) < 1.5
