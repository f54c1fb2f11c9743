"""A model adapts to the robot that it moves; and what dead reckoning was off by while landmarks were seen goes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion_models import make_card, make_tensors
from robot_world import START_NS, Chain, World, config, nees, position_error, room

from fgloc import se2
from fgloc.config import Config, MotionConfig
from fgloc.estimation.motion import ExcessDrift
from fgloc.graph.installation import Installation, InstallationEstimate
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import FusionRules, NoiseBudget
from fgloc.live.state import InstallationState as State
from fgloc.live.state import resumed_installation
from fgloc.sensors.base import InstallationState
from fgloc.sensors.learned.sensor import GAINS, INSTALLATION, LearnedMotion, gains_of, load_model, save_model
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import ControlEvent, InstallationFound, MotionMeasurement, MotionReadings, Step, by_class

PULLED = 0.1  # rad/m to the left of what the model says
COMMANDS = {"wheels": {"source": "command"}}


def model_in(folder):
    card = make_card("naive", kinematics={}, lag=None, joint=None)
    save_model(folder / "m.safetensors", make_tensors(card, np.random.default_rng(0)), card)
    return load_model(folder / "m.safetensors")


def step_of(v: float, omega: float) -> Step:
    events = tuple(ControlEvent(t, t, "/cmd_vel", v, omega) for t in range(0, 10**9, 10**8))
    return Step(0, 0, 7 * 10**8, 9 * 10**8, by_class(events))


def pulled(folder, seed=0, blind=(), **motion):
    """A robot of commands alone that does not go as its model says; the model says what it is told."""
    settings = config(**COMMANDS, motion=motion)
    made = World(room(), seed=seed, seconds=24.0, blind=blind)
    chain = Chain(settings, made.map, learned=LearnedMotion(model_in(folder), settings.motion))
    events = [e for e in made.events() if not isinstance(e, OdometryEvent)]
    told = (replace(e, omega=e.omega - PULLED * e.v) if isinstance(e, ControlEvent) else e for e in events)
    return made, chain.localizer, chain.run(told)


@pytest.mark.parametrize("gain", GAINS)
def test_a_configured_gain_moves_the_motion_along_its_derivative(tmp_path, gain):
    model, step, change = model_in(tmp_path), step_of(0.4, 0.7), 1e-4
    motion, by = LearnedMotion(model, MotionConfig()).measure_adapted(step)
    given = {gain: getattr(MotionConfig(), gain) + change}
    changed, _ = LearnedMotion(model, MotionConfig(**given)).measure_adapted(step)
    moved = (se2.log(changed.motion) - se2.log(motion.motion)) / change
    assert moved == pytest.approx(by[f"learned.{gain}"], abs=1e-6)
    assert np.abs(moved).max() > 0.01


def test_gains_that_a_run_found_are_the_settings_under_which_nothing_is_left_to_find(tmp_path):
    model, step = model_in(tmp_path), step_of(0.4, 0.7)
    given = MotionConfig(scale=1.2, turn_scale=1.5, yaw_per_m=0.2)
    motion, by = LearnedMotion(model, given).measure_adapted(step)
    found = np.array([0.01, 0.02, -0.03])
    cov, settings = np.eye(3), Config(motion=given)
    names = tuple(f"learned.{gain}" for gain in GAINS)
    state = InstallationState(InstallationFound(names, found, cov, cov, (), "", ""))
    next_run = {s.name.removeprefix("motion."): s.found for s in INSTALLATION.settings(state, settings)}
    now, _ = LearnedMotion(model, MotionConfig(**next_run)).measure_adapted(step)
    moved = se2.log(motion.motion) + sum(value * by[name] for name, value in zip(names, found, strict=True))
    assert se2.log(now.motion) == pytest.approx(moved, abs=1e-9)
    between, _ = LearnedMotion(model, given).motion_between(step, step.start_ns, step.stamp_ns)
    assert between == pytest.approx(motion.motion)


def test_noise_of_drift_grows_with_the_time_and_with_nothing_at_rest():
    budget, rules = NoiseBudget(drift=np.array([1.0, 1.0, 2.0])), FusionRules()
    for seconds in (0.001, 0.2):
        end = round(seconds * 1e9)
        driving = MotionMeasurement("wheels", 0, end, np.array([0.5 * seconds, 0.0, 0.0]), 1e-9 * np.eye(3))
        (made,) = budget.combine(MotionReadings(driving), rules)
        assert np.diag(made.cov) == pytest.approx(seconds * np.array([1.0, 1.0, 2.0]), rel=1e-3)
        (still,) = budget.combine(MotionReadings(replace(driving, motion=np.zeros(3))), rules)
        assert np.diag(still.cov).max() < 1e-8


def test_one_stretch_that_ended_elsewhere_is_counted_among_half_a_minute_of_calm():
    estimator, exact = Chain(config(), room()).localizer.estimator, 1e-8 * np.eye(3)
    drift = ExcessDrift(estimator)
    drift.fix(estimator.start(0, PoseWithCovariance(np.zeros(3), exact)))
    for k in range(25):
        step = Step(k, 0, k * 10**8, (k + 1) * 10**8)
        went = MotionMeasurement("wheels", step.start_ns, step.stamp_ns, np.array([0.04, 0.0, 0.0]), exact)
        drift.advance(step, [went])
    assert drift.density is None
    drift.fix(PoseWithCovariance(np.array([1.3, 0.0, 0.0]), exact))
    assert drift.density == pytest.approx(0.3**2 / 32.5 * np.array([0.5, 0.5, 0.0]), rel=0.1, abs=1e-9)


def test_a_fix_aside_that_is_gone_soon_is_no_drift():
    estimator, exact = Chain(config(), room()).localizer.estimator, 1e-8 * np.eye(3)
    drift = ExcessDrift(estimator)
    drift.fix(estimator.start(0, PoseWithCovariance(np.zeros(3), exact)))
    for k in range(1, 26):
        step = Step(k, 0, (k - 1) * 10**8, k * 10**8)
        drift.advance(
            step, [MotionMeasurement("wheels", step.start_ns, step.stamp_ns, np.array([0.04, 0.0, 0.0]), exact)]
        )
        drift.fix(PoseWithCovariance(np.array([0.04 * k, 0.3 if k in (9, 10) else 0.0, 0.0]), exact))
        assert drift.density is None


def test_noise_of_the_models_drift_is_the_models_alone():
    budget, moved = NoiseBudget(learned_drift=np.array([1.0, 1.0, 2.0])), np.array([0.1, 0.0, 0.0])
    wheels, learned = (MotionMeasurement(name, 0, 2 * 10**8, moved, 1e-6 * np.eye(3)) for name in ("wheels", "learned"))
    as_wheels, as_learned = budget.combine(MotionReadings(wheels, learned), FusionRules())
    assert as_wheels.cov == pytest.approx(wheels.cov)
    assert np.diag(as_learned.cov) == pytest.approx([0.2, 0.2, 0.4], rel=1e-3)


def test_a_saved_state_without_the_gains_of_a_model_is_resumed(tmp_path):
    saved = State(names=("wheels.radius", "learned.scale"), mean=(0.01, 0.02), cov=((1e-6, 0.0), (0.0, 1e-6)))
    here = Installation({"wheels.radius": 0.02, "learned.turn_scale": 0.03})
    resumed = resumed_installation(saved, here)
    assert resumed.mean == pytest.approx([0.01, 0.0])
    assert np.diag(resumed.cov) == pytest.approx([1e-6, 9e-4])
    assert resumed_installation(saved, Installation({"wheels.track": 0.02})) is None


def test_turns_of_a_model_that_reads_a_gyro_are_not_adapted():
    joints = {"left": "l", "right": "r", "left_radius": 0.1, "right_radius": 0.1, "track": 0.3}
    assert gains_of(make_card("displacement")) == GAINS
    assert gains_of(make_card("displacement", inputs=("commands", "gyro"))) == ("scale",)
    assert gains_of(make_card("displacement", inputs=("commands", "wheels"), joints=joints)) == ("scale",)


def test_a_robot_that_is_drawn_aside_is_followed_in_the_dark(tmp_path):
    last = {}
    for name, motion in {"adapted": {}, "frozen": {"adaptation_sigma": 0.0}}.items():
        ends = []
        for seed in range(2):
            made, localizer, estimates = pulled(tmp_path, seed, ((14.0, 24.0),), **motion)
            ends.append(position_error(estimates[-1], made.truth(estimates[-1].stamp_ns)))
        last[name] = float(np.mean(ends))
        assert not localizer.estimator.contradicted
    assert last["adapted"] < 0.35 * last["frozen"]


def test_what_a_run_has_learned_is_a_setting_of_the_next(tmp_path):
    made, localizer, _ = pulled(tmp_path)
    index, mean = localizer.factors.installation.index, localizer.factors.estimated.mean
    found = {gain: float(mean[index[f"learned.{gain}"]]) for gain in ("turn_scale", "yaw_per_m")}
    made, localizer, estimates = pulled(
        tmp_path,
        blind=((4.0, 24.0),),
        adaptation_sigma=0.0,
        turn_scale=1.0 + found["turn_scale"],
        yaw_per_m=found["yaw_per_m"],
    )
    _, _, as_it_was = pulled(tmp_path, blind=((4.0, 24.0),), adaptation_sigma=0.0)
    told, untold = (position_error(e[-1], made.truth(e[-1].stamp_ns)) for e in (estimates, as_it_was))
    assert told < 0.35 * untold


def test_a_constant_that_floor_and_load_change_has_a_wider_gate_than_its_prior():
    names = {"wheels.radius": 0.01, "learned.turn_scale": 0.01}
    installation = Installation(names, gates={"learned.turn_scale": 0.05})
    known = InstallationEstimate(np.array([0.2, 0.2]), 1e-8 * np.eye(2))
    assert installation.beyond_gate(known) == ("wheels.radius",)
    known = InstallationEstimate(np.array([0.0, 0.4]), 1e-8 * np.eye(2))
    assert installation.beyond_gate(known) == ("learned.turn_scale",)


SLIPS = tuple((t, t + 0.4) for t in np.arange(1.0, 30.0, 2.0).tolist())


def in_the_dark(slips, seed=0):
    """Mean NEES over 3 of wheels alone in the dark of the last 15 s, and the largest sigma [m]."""
    made = World(room(), seed=seed, seconds=30.0, slips=slips, blind=((15.0, 30.0),))
    estimates = Chain(config(), made.map).run(made.events())
    dark = [e for e in estimates if e.stamp_ns > START_NS + 16 * 10**9]
    sizes = [nees(e, made.truth(e.stamp_ns)) / 3.0 for e in dark]
    return float(np.mean(sizes)), max(float(np.sqrt(e.cov[0, 0])) for e in dark)


def test_wheels_alone_that_slipped_while_seen_are_trusted_less_in_the_dark():
    sound, slipping = ([in_the_dark(slips, seed) for seed in range(2)] for slips in ((), SLIPS))
    assert min(sigma for _, sigma in slipping) > 3.0 * max(sigma for _, sigma in sound)
    assert np.mean([size for size, _ in slipping]) < 6.0  # all slips are forwards; 120 if they are forgotten
