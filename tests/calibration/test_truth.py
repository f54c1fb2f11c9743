"""Wheels calibrated by a truth, where no landmark is seen."""

import math

import numpy as np
import pytest
from refusal import refusal
from typer.testing import CliRunner

from fgloc import cli, se2
from fgloc.calibrate import calibrate
from fgloc.calibration.truth import calibrate_by_truth
from fgloc.config import Config, load_config, yaml_of
from fgloc.errors import EstimatorError
from fgloc.runner import run
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
GUESS = {
    "kind": "tricycle",
    "wheel": "traction",
    "steering_joint": "steering",
    "radius": 0.09,
    "wheelbase": 1.0,
    "steering_ratio": 0.2,
    "sigmas": {"radius": 0.05, "wheelbase": 0.5, "steering_ratio": 1.0, "steering_zero": 0.3},
}
TRUE = {"radius": 0.1, "wheelbase": 1.2, "steering_ratio": 0.5, "steering_zero": -0.06}
BODY = (0.8, -0.1, 0.3)  # of what the truth tracks, on the robot
LATE_S = 0.05


def settings(drive):
    return Config.model_validate({"wheels": {"drive": drive}, "truth": {"align": "se2"}})


def write_tricycle(folder, seconds=80.0, truth=True):
    """A tricycle that winds along; a truth of its body at 20 Hz, late, with jitter, frozen now and then."""
    rng = np.random.default_rng(5)
    true = settings({**GUESS, **TRUE}).wheels.drive
    pose, travel, told = np.zeros(3), 0.0, None
    with BagWriter(folder / "bag") as bag:
        for k in range(round(seconds * 100)):
            t, stamp = 0.01 * k, START_NS + k * 10_000_000
            steering = 0.8 * math.sin(0.4 * t) + 0.3 * math.sin(1.1 * t)
            rate = 5.0 + 2.0 * math.sin(0.2 * t)
            if k % 4 == 0:
                bag.joints("/joints", stamp, ["steering", "traction"], [steering, travel])
            if k % 5 == 0 and truth:
                if told is None or t % 10.0 > 1.0:
                    told = se2.compose(pose, BODY) + rng.normal(0.0, 0.002, 3)
                bag.planar_truth("/truth", stamp + round(LATE_S * 1e9), told)
            twist, _, _ = true.moves([rate], [steering])
            noise = rng.normal(0.0, 1.0, 3) * (0.003, 0.003, 0.003) * math.sqrt(0.005)
            pose = se2.compose(pose, se2.exp(twist * 0.01 + noise))
            travel += rate * 0.01
    return folder / "bag"


GAINS = Config.model_validate({"truth": {"align": "se2"}})


def write_odometry(folder, told=lambda k: True, n=409, commands=False):
    """An odometer that reports too short a way, and a truth of the body, late; as a default just enough of it."""
    rng = np.random.default_rng(5)
    pose, reported = np.zeros(3), np.zeros(3)
    with BagWriter(folder / "bag") as bag:
        for k in range(n):
            t, stamp = 0.1 * k, START_NS + k * 100_000_000
            v, omega = 0.5 + 0.2 * math.sin(0.2 * t), 0.6 * math.sin(0.4 * t) + 0.3 * math.sin(1.1 * t)
            bag.odometry("/odom", stamp, reported.tolist(), (v / 1.05, omega))
            if commands:
                bag.command("/cmd_vel", stamp, v, omega)
            body = se2.compose(pose, BODY) + rng.normal(0.0, 0.002, 3)
            if told(k):
                bag.planar_truth("/truth", stamp + round(LATE_S * 1e9), body)
            step = np.array([0.1 * v, 0.0, 0.1 * omega])
            pose = se2.compose(pose, se2.exp(step + rng.normal(0.0, 0.001, 3)))
            reported = se2.compose(reported, se2.exp(step / [1.05, 1.0, 1.0]))
    return folder / "bag"


def test_gains_and_noise_of_an_odometer_are_found_with_the_place_and_clock_of_the_body(tmp_path):
    found, listed = calibrate_by_truth([write_odometry(tmp_path)], GAINS)
    assert found.wheels.scale_v == pytest.approx(1.05, abs=0.005)
    assert found.wheels.scale_omega == pytest.approx(1.0, abs=0.01)
    assert found.truth.offset_m == pytest.approx(BODY[:2], abs=0.01)
    assert found.truth.yaw_offset_rad == pytest.approx(BODY[2], abs=0.01)
    assert found.recording.stamp_offset_s["truth"] == pytest.approx(-LATE_S, abs=0.02)
    assert 0.02 < found.wheels.noise.x_per_sqrt_m / GAINS.wheels.noise.x_per_sqrt_m < 0.3
    by_name = {s.name: s for s in listed}
    assert by_name["truth.x"].found == pytest.approx(BODY[0], abs=5.0 * by_name["truth.x"].sigma)
    assert all(0.0 < s.sigma < 0.5 * s.prior_sigma for s in listed)


def write_bare(folder, truth_m, truth_rad=0.002, seconds=46.0, rate_hz=20, turn=0.2, seed=6):
    """An odometer without noise that reports too short a way, and a truth of the base with noise, a little late."""
    rng, pose, reported, dt = np.random.default_rng(seed), np.zeros(3), np.zeros(3), 1.0 / rate_hz
    with BagWriter(folder / "bag") as bag:
        for k in range(round(seconds * rate_hz)):
            t, stamp = dt * k, START_NS + round(k * dt * 1e9)
            v, omega = 0.5 + 0.2 * math.sin(0.2 * t), turn * math.sin(0.4 * t)
            bag.odometry("/odom", stamp, reported.tolist(), (v / 1.05, omega))
            bag.planar_truth("/truth", stamp + 20_000_000, pose + rng.normal(0.0, [truth_m, truth_m, truth_rad]))
            step = dt * np.array([v, 0.0, omega])
            pose, reported = se2.compose(pose, se2.exp(step)), se2.compose(reported, se2.exp(step / [1.05, 1.0, 1.0]))
    return folder / "bag"


def test_the_noise_of_a_truth_does_not_add_up_from_window_to_window(tmp_path):
    bag = write_bare(tmp_path, 0.03, 0.03, seconds=150.0, rate_hz=10, turn=0.05, seed=4)
    exact = {f"{what}_per_sqrt_{of}": 1e-3 for what, of in (("x", "m"), ("y", "m"), ("yaw", "m"), ("yaw", "rad"))}
    config = Config.model_validate({"truth": {"align": "se2"}, "wheels": {"noise": exact | {"xy_per_sqrt_rad": 1e-3}}})
    found, listed = calibrate_by_truth([bag], config)
    sigmas = {s.name: s.sigma for s in listed}
    assert found.wheels.scale_v == pytest.approx(1.05, abs=1e-4)
    assert found.wheels.yaw_per_m == pytest.approx(0.0, abs=2e-4)
    assert sigmas["wheels.scale_v"] < 0.0015


@pytest.mark.parametrize("truth_m", [0.002, 0.05])
def test_less_than_a_minute_of_truth_tells_the_odometers_scale_and_the_truths_clock(tmp_path, truth_m):
    found, _ = calibrate_by_truth([write_bare(tmp_path, truth_m)], GAINS)
    assert found.wheels.scale_v == pytest.approx(1.05, abs=0.003)
    assert found.recording.stamp_offset_s["truth"] == pytest.approx(-0.02, abs=0.015)


@pytest.mark.parametrize(
    ("told", "n"),
    [(lambda k: k % 16 < 2, 528), (lambda k: not 165 < k < 285, 489)],
    ids=["pairs", "silent for 12 s"],
)
def test_the_truth_ends_no_window_at_a_pose_without_neighbours_and_none_beyond_a_long_silence(tmp_path, told, n):
    with pytest.raises(EstimatorError, match=r"\b4 s\b"):
        calibrate_by_truth([write_odometry(tmp_path, told, n)], GAINS)


@pytest.mark.slow
def test_geometry_that_is_far_off_is_found_with_the_place_of_the_body(tmp_path):
    bag = write_tricycle(tmp_path)
    found, listed = calibrate([bag], None, settings(GUESS))
    by_name = {s.name: s for s in listed}
    for name, value in TRUE.items():
        s = by_name[f"wheels.drive.{name}"]
        assert abs(s.found - value) < 4.0 * s.sigma, s
        assert s.sigma < 0.02
        assert found.wheels.drive.value(name) == pytest.approx(s.found)
        assert found.wheels.drive.states[name] == pytest.approx(s.sigma, rel=1e-3)
    assert found.truth.offset_m == pytest.approx(BODY[:2], abs=0.02)
    assert found.truth.yaw_offset_rad == pytest.approx(BODY[2], abs=0.02)
    assert found.recording.stamp_offset_s["truth"] == pytest.approx(-LATE_S, abs=0.02)
    assert found.wheels.noise.yaw_per_sqrt_m < settings(GUESS).wheels.noise.yaw_per_sqrt_m
    result = run(bag, None, found, "batch", check=False)
    known = result.trajectory.stamps_ns <= result.truth.stamps_ns[-1]
    assert known.sum() > 100
    before = run(bag, None, settings(GUESS), "batch", check=False)
    ends = [np.ptp(r.trajectory.poses[:, 0]) for r in (result, before)]
    true_extent = np.ptp(result.truth.poses[:, 0])
    assert abs(ends[0] - true_extent) < 0.3 * abs(ends[1] - true_extent)


@pytest.mark.slow
def test_a_radius_that_the_truth_corrects_is_no_mistake_any_more(tmp_path):
    bag = write_tricycle(tmp_path, seconds=60.0)
    short = settings({**GUESS, **TRUE, "radius": 0.092})
    (tmp_path / "robot.yaml").write_text(yaml_of(short, tmp_path))
    given = ["calibrate", str(bag), "--config", str(tmp_path / "robot.yaml"), "--out", str(tmp_path / "found.yaml")]
    done = CliRunner().invoke(cli.app, given)
    assert done.exit_code == 0, done.output
    found = load_config(tmp_path / "found.yaml").wheels.drive.radius
    assert found == pytest.approx(0.1, abs=0.001)


@pytest.mark.parametrize(("commanded", "follows"), [((True, True), True), ((True,), False), ((True, False), False)])
def test_training_follows_where_it_accepts_the_recordings(tmp_path, commanded, follows):
    bags = [write_odometry(tmp_path / f"run{i}", n=500 + i, commands=given) for i, given in enumerate(commanded)]
    (tmp_path / "robot.yaml").write_text("truth: {align: se2}\n")
    given = ["calibrate", *map(str, bags), "--config", str(tmp_path / "robot.yaml"), "--out", str(tmp_path / "r.yaml")]
    done = CliRunner().invoke(cli.app, given)
    assert done.exit_code == 0, done.output
    assert ("next: fgloc train --init" in done.output) == follows
    assert "next: fgloc smooth" in done.output
    assert ("note: the noise" in done.output) == (len(bags) == 1)  # one drive does not tell it from drive to drive


def test_wheels_that_do_not_follow_the_truth_are_named(tmp_path):
    exchanged = {"kind": "ackermann", "wheels": ["steering"], "steering_joints": ["traction"], "wheelbase": 1.2}
    bag = write_tricycle(tmp_path)
    with pytest.raises(EstimatorError, match=r"\b4 s\b.*wheels\.drive"):
        calibrate([bag], None, settings(exchanged))


def test_a_truth_of_a_few_seconds_determines_nothing(tmp_path):
    with pytest.raises(EstimatorError, match=r"\b4 s\b"):
        calibrate([write_tricycle(tmp_path, seconds=20.0)], None, settings(GUESS))


def test_without_truth_and_landmarks_the_error_says_so(tmp_path):
    bag = write_tricycle(tmp_path, seconds=20.0, truth=False)
    with refusal(EstimatorError, bag):
        calibrate([bag], None, settings(GUESS))
