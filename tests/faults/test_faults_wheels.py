"""Wheels that slip, stop or stick, in whole runs: the motion goes on by its witness, and the failure is told."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from motion_models import make_card, make_tensors
from robot_world import SPEED, START_NS, TURN, Chain, World, config, nees, position_error, room

from fgloc.config import BatchConfig, GyroConfig, MotionConfig
from fgloc.estimation.log import _REASONS
from fgloc.graph.batch import BatchSmoother
from fgloc.sensors.gyro import Gyro, ImuEvent
from fgloc.sensors.learned.card import Kinematics
from fgloc.sensors.learned.sensor import LearnedMotion, load_model, save_model
from fgloc.sensors.wheels.events import OdometryEvent

TRACK = 0.3
FAILS = (6.0, 11.0)  # s, in the dark
DARK = ((5.8, 11.2),)
LEFT, RIGHT = SPEED - 0.5 * TRACK * TURN, SPEED + 0.5 * TRACK * TURN


def seconds(stamped) -> float:
    return (stamped.stamp_ns - START_NS) * 1e-9


def failing(world: World, tell, witness: str):
    """Events of a world whose odometry tells other speeds of its two wheels; a gyro, or else commands."""
    rng, made = np.random.default_rng(9), []
    for event in world.events():
        if isinstance(event, OdometryEvent) and FAILS[0] <= seconds(event) < FAILS[1]:
            v, omega = float(event.linear[0]), float(event.angular[2])
            left, right = tell(v - 0.5 * TRACK * omega, v + 0.5 * TRACK * omega)
            linear, angular = np.array([0.5 * (left + right), 0, 0]), np.array([0, 0, (right - left) / TRACK])
            event = replace(event, linear=linear, angular=angular)
        made.append(event)
    if witness == "gyro":
        for tick in range(round(world.seconds * 50)):
            stamp = START_NS + tick * 20_000_000
            rate = np.array([0.0, 0.0, TURN + rng.normal(0.0, 0.002 * math.sqrt(50.0))])
            made.append(ImuEvent(stamp, stamp, "/imu", "imu", rate, np.zeros(3), np.zeros((3, 3))))
    return sorted(made, key=lambda e: e.received_ns)


def chain(tmp_path, witness: str, keep_all: bool = False, kinematics: Kinematics | None = None, **weights) -> Chain:
    settings = config(weights=weights)
    settings = settings.model_copy(update={"wheels": settings.wheels.model_copy(update={"track": TRACK})})
    learned = None
    if witness == "learned":  # the robot does what it is told to
        card = make_card("naive").model_copy(update={"kinematics": kinematics or Kinematics()})
        save_model(tmp_path / "m.safetensors", make_tensors(card, np.random.default_rng(0)), card)
        learned = LearnedMotion(load_model(tmp_path / "m.safetensors"), MotionConfig())
    gyro = Gyro(GyroConfig()) if witness == "gyro" else None
    return Chain(settings, room(), keep_all, learned=learned, gyro=gyro)


def in_the_dark(world, estimates) -> list[float]:
    return [position_error(e, world.truth(e.stamp_ns)) for e in estimates if FAILS[0] < seconds(e) < FAILS[1]]


@pytest.mark.parametrize(
    ("tell", "reason"),
    [
        (lambda left, right: (0.0, 0.0), "frozen"),
        (lambda left, right: (0.0, right), "left_wheel_dead"),
        (lambda left, right: (left, 0.0), "right_wheel_dead"),
        (lambda left, right: (1.6 * left, 1.7 * right), "slip"),
    ],
)
def test_fault_31_a_stuck_or_slipping_wheel_in_the_dark(tmp_path, tell, reason):
    world = World(room(), seconds=14.0, blind=DARK)
    events = failing(world, tell, "learned")
    adaptive, fixed = chain(tmp_path, "learned"), chain(tmp_path, "learned", adaptive=False)
    ours, theirs = adaptive.run(events), fixed.run(events)
    assert max(in_the_dark(world, ours)) < 0.1
    assert max(in_the_dark(world, ours)) < 0.4 * max(in_the_dark(world, theirs))
    wheels = [d for e in ours for d in e.decisions if d.kind == "wheels" and d.reason]
    assert wheels[-1].reason == reason
    stamps = [(d.stamp_ns - START_NS) * 1e-9 for d in wheels]
    assert FAILS[0] - 0.3 < min(stamps) < FAILS[0] + 0.3  # taken back to where it began
    assert FAILS[1] - 0.3 < max(stamps) < FAILS[1] + 1.5  # and it ended
    assert all(d.weight == 0.0 for d in wheels)
    last = ours[-1]
    assert nees(last, world.truth(last.stamp_ns)) < 20.0
    (note,) = adaptive.localizer.notes
    assert _REASONS[reason] in note
    assert "1 time(s)" in note


def test_fault_31_the_gyro_witnesses_a_wheel_that_stands_still(tmp_path):
    world = World(room(), seconds=14.0, blind=DARK)
    events = failing(world, lambda left, right: (0.0, right), "gyro")
    adaptive, fixed = chain(tmp_path, "gyro"), chain(tmp_path, "gyro", adaptive=False)
    ours, theirs = adaptive.run(events), fixed.run(events)
    assert max(in_the_dark(world, ours)) < max(in_the_dark(world, theirs))
    at_end = [e for e in ours if seconds(e) < FAILS[1]][-1]
    assert nees(at_end, world.truth(at_end.stamp_ns)) < 20.0  # where nobody knows the way, it says so
    assert any(re.search(r"\bwheels\b.*\d time", note) for note in adaptive.localizer.notes)


def test_fault_31_sound_wheels_are_not_accused(tmp_path):
    for witness in ("learned", "gyro"):
        world = World(room(), seed=3, seconds=20.0, blind=((8.0, 14.0),))
        made = chain(tmp_path, witness)
        estimates = made.run(failing(world, lambda left, right: (left, right), witness))
        assert made.localizer.notes == ()
        assert {d.reason for e in estimates for d in e.decisions if d.landmark_id < 0} <= {"", "dead_reckoning"}


def test_fault_31_the_batch_keeps_what_the_run_has_found_out(tmp_path):
    world = World(room(), seconds=14.0, blind=DARK)
    made = chain(tmp_path, "learned", keep_all=True)
    made.run(failing(world, lambda left, right: (0.0, 0.0), "learned"))
    localizer = made.localizer
    result = BatchSmoother(localizer.estimator.log, localizer.factors, BatchConfig(), 0.9999).result()
    stamps = [frame.stamp_ns for frame in localizer.estimator.log.keyframes.values()]
    errors = [np.hypot(*(pose - world.truth(t))[:2]) for t, pose in zip(stamps, result.poses, strict=True)]
    assert max(errors) < 0.05


@pytest.mark.parametrize("witness", ["learned", "none"])
def test_a_known_failure_is_left_out_from_the_start(tmp_path, witness):
    world = World(room(), seconds=14.0, blind=DARK)
    told = [{"source": "wheels", "start_s": FAILS[0], "end_s": FAILS[1]}]
    made = chain(tmp_path, witness, distrust=told)
    estimates = made.run(failing(world, lambda left, right: (0.0, 0.0), witness))
    reasons = {d.reason for e in estimates for d in e.decisions if d.kind == "wheels"}
    assert reasons == {"", "distrusted"}
    at_end = [e for e in estimates if seconds(e) < FAILS[1]][-1]
    error, sigma = position_error(at_end, world.truth(at_end.stamp_ns)), math.sqrt(np.trace(at_end.cov[:2, :2]))
    assert error < 3.0 * sigma
    assert (error < 0.1) == (witness == "learned")  # without a witness nobody knows the way, and it says so
    assert (sigma < 0.25) == (witness == "learned")
    assert not any("disagreed" in note for note in made.localizer.notes)  # nothing that was not known


def test_a_known_failure_is_dated_from_the_first_step_however_late_the_first_pose(tmp_path):
    world = World(room(), seconds=14.0, blind=((0.0, 8.0),))
    made = chain(tmp_path, "learned", distrust=[{"source": "wheels", "start_s": 10.0, "end_s": 12.0}])
    estimates = made.run(world.events())
    stamps = [seconds(d) for e in estimates for d in e.decisions if d.reason == "distrusted"]
    assert 10.0 < min(stamps) <= 10.1 + 1e-6
    assert 12.0 - 1e-6 <= max(stamps) <= 12.1 + 1e-6
