"""Where wheels and learned motion differ, the one that sightings contradict is left out."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from motion_models import make_card, make_tensors
from robot_world import START_NS, Chain, World, config, position_error, room

from fgloc.config import MotionConfig
from fgloc.sensors.learned.sensor import LearnedMotion, load_model, save_model
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import ControlEvent


def driven(folder, model=1.0, wheels=1.0, during_s=(0.0, 60.0), blind=(), seconds=24.0):
    """A world, the localizer, and the estimates of its drive.

    The model takes commands for motion, as the world's robot follows them; ``model`` and ``wheels`` times the true
    speed is what the two say ``during_s``.
    """
    card = make_card("naive", kinematics={}, lag=None, joint=None)
    save_model(folder / "m.safetensors", make_tensors(card, np.random.default_rng(0)), card)
    learned = LearnedMotion(load_model(folder / "m.safetensors"), MotionConfig())

    def said(e):
        if not during_s[0] <= (e.stamp_ns - START_NS) * 1e-9 < during_s[1]:
            return e
        if isinstance(e, ControlEvent):
            return replace(e, v=model * e.v)
        return replace(e, linear=wheels * e.linear) if isinstance(e, OdometryEvent) else e

    made = World(room(), seconds=seconds, blind=blind)
    chain = Chain(config(), made.map, learned=learned)
    return made, chain.localizer, chain.run(said(e) for e in made.events())


def left_out(estimates, source: str, during_s=(0.0, 60.0)) -> float:
    """Share of the steps in which a source was left out, by its last row."""
    last = {d.stamp_ns: d.weight for e in estimates for d in e.decisions if d.kind == source}
    inside = [w == 0.0 for t, w in last.items() if during_s[0] <= (t - START_NS) * 1e-9 < during_s[1]]
    return float(np.mean(inside))


def errors(made, estimates) -> np.ndarray:
    return np.array([position_error(e, made.truth(e.stamp_ns)) for e in estimates])


@pytest.mark.parametrize("scale", [0.6, 1.6])
def test_a_model_of_another_robot_is_left_out_and_the_wheels_are_not(tmp_path, scale):
    made, localizer, estimates = driven(tmp_path, model=scale)
    assert left_out(estimates, "learned", (1.0, 24.0)) == 1.0
    assert left_out(estimates, "wheels", (1.0, 24.0)) < 0.02
    assert errors(made, estimates).max() < 0.08
    (note,) = localizer.motion.notes
    assert re.search(r"\bmotion model\b.* 2\d\.\d s\b", note)
    assert localizer.motion.mistakes == (note,)


def test_of_wheels_that_slip_and_a_sound_model_the_wheels_are_left_out(tmp_path):
    made, localizer, estimates = driven(tmp_path, wheels=1.5, during_s=(8.0, 12.0))
    assert left_out(estimates, "wheels", (8.5, 11.5)) == 1.0
    assert left_out(estimates, "learned") == 0.0
    assert errors(made, estimates).max() < 0.08
    assert localizer.motion.mistakes == ()


def test_without_sightings_it_is_the_wheels(tmp_path):
    _, _, estimates = driven(tmp_path, wheels=1.5, during_s=(10.0, 14.0), blind=((8.0, 16.0),))
    assert left_out(estimates, "wheels", (10.5, 13.5)) == 1.0
    assert left_out(estimates, "learned", (8.0, 16.0)) == 0.0


def test_wheels_are_left_out_back_to_where_their_slip_began_though_it_shows_later(tmp_path):
    _, localizer, estimates = driven(tmp_path, wheels=1.4, during_s=(3.0, 9.0), blind=((2.5, 9.0),), seconds=4.5)
    began_ns = START_NS + 3_000_000_000
    told_ns = next(e.stamp_ns for e in estimates for d in e.decisions if d.reason == "slip")
    frames = [f for f in localizer.estimator.log.keyframes.values() if f.prior is None]
    before = [[m.source for m in f.motions] for f in frames if f.stamp_ns <= began_ns]
    unnoticed = [[m.source for m in f.motions] for f in frames if began_ns + 100_000_000 < f.stamp_ns < told_ns]
    assert before == [["wheels", "learned"]] * len(before)
    assert unnoticed == [["learned"]] * len(unnoticed)
    assert min(len(before), len(unnoticed)) > 0


def test_a_model_that_agrees_again_is_used_again(tmp_path):
    _, _, estimates = driven(tmp_path, model=1.6, during_s=(0.0, 4.0))
    assert left_out(estimates, "learned", (1.0, 10.0)) == 1.0
    assert left_out(estimates, "learned", (20.0, 24.0)) == 0.0
