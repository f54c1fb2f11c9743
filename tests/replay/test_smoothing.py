"""Batch smoothing: velocities of a trajectory, and the learned motion measured again at them."""

from __future__ import annotations

import numpy as np
import pytest
from motion_models import make_card, make_tensors
from robot_world import SPEED, START_NS, TURN, World, beacons, config
from world_bags import write_world

from fgloc import se2
from fgloc.assembly import assemble
from fgloc.config import RecordingConfig
from fgloc.recording.reader import open_recording
from fgloc.replay.smoothing import smooth_run, smoothed_velocities
from fgloc.sensors.learned.load import save_model
from fgloc.sensors.learned.source import LearnedMotion

STEP_NS = 100_000_000


def arc(v: float, omega: float, n: int) -> np.ndarray:
    return np.array([se2.exp((v * 0.1 * k, 0.0, omega * 0.1 * k)) for k in range(n)])


@pytest.mark.parametrize(("v", "omega"), [(0.5, 0.0), (0.4, 0.6), (-0.3, -0.8), (0.0, 1.0)])
def test_velocities_on_an_arc_are_its_own(v, omega):
    stamps = np.arange(60, dtype=np.int64) * STEP_NS
    velocities = smoothed_velocities(stamps, arc(v, omega, 60))
    assert velocities.shape == (60, 2)
    inside = velocities[3:-3]  # within 0.3 s of the ends the differences reach less far
    assert np.allclose(inside[:, 1], omega, atol=1e-9)
    assert np.allclose(inside[:, 0], v, atol=2e-3)
    assert np.allclose(velocities, (v, omega), atol=5e-3)


def test_velocity_is_that_at_the_start_of_the_step():
    """Speed rises by 1 m/s²: at the start of the step from t - 0.1 to t it is t - 0.1."""
    t = np.arange(60) * 0.1
    poses = np.column_stack([0.5 * t**2, np.zeros(60), np.zeros(60)])
    velocities = smoothed_velocities((t * 1e9).round().astype(np.int64), poses)
    assert np.allclose(velocities[5:-5, 0], t[5:-5] - 0.1, atol=0.01)


def test_velocity_through_the_turn_of_yaw():
    stamps = np.arange(80, dtype=np.int64) * STEP_NS
    velocities = smoothed_velocities(stamps, arc(0.3, 1.0, 80))  # yaw wraps at 3.14 s
    assert np.allclose(velocities[3:-3, 1], 1.0, atol=1e-9)


class Listening(LearnedMotion):
    """Notes the velocities that it is given."""

    def measure(self, step, velocity, gyro_bias=0.0):
        if velocity is not None:
            self.heard[step.stamp_ns] = velocity
        return super().measure(step, velocity, gyro_bias)


def replayed(bag, settings):
    """Parts of a run after its replay; the learned motion notes what it hears from then on."""
    with open_recording(bag, RecordingConfig()) as recording:
        parts = assemble(recording, bag.parent / "map.yaml", settings, keep_all=True)
        if parts.learned is not None:
            listening = Listening(parts.learned.model, settings.motion)
            listening.heard = {}
            parts.localizer.motion.sources._learned = listening
        for event in recording.events():
            passed = parts.gate.check(event)
            for step in parts.stepper.push(passed) if passed is not None else ():
                parts.localizer.update(step)
    return parts


@pytest.mark.parametrize("kind", ["velocity", "displacement"])
def test_only_a_model_that_reads_velocity_is_asked_again_at_the_smoothed_one(tmp_path, kind):
    card = make_card(kind)
    save_model(tmp_path / "model.safetensors", make_tensors(card, np.random.default_rng(0)), card)
    bag = write_world(tmp_path, World(beacons(), seconds=8.0))
    parts = replayed(bag, config(motion={"model": tmp_path / "model.safetensors", "correlation": "independent"}))
    estimates = smooth_run(parts).estimates
    heard = parts.localizer.motion.sources._learned.heard
    if kind == "displacement":
        assert not heard
        return
    assert len(heard) == len(estimates) - 1
    inside = np.array(list(heard.values()))[5:-5]
    assert np.allclose(inside.mean(axis=0), (SPEED, TURN), atol=0.04)
    assert np.abs(inside - (SPEED, TURN)).mean() < 0.1


def test_no_velocity_leads_across_a_jump(tmp_path):
    """Two drives at one place after another: between them the pose jumps across the room, the velocity does not."""
    card = make_card("velocity")
    save_model(tmp_path / "model.safetensors", make_tensors(card, np.random.default_rng(0)), card)
    second = World(beacons(), seed=1, seconds=5.0, start_ns=START_NS + 200 * 10**9, start_s=9.0)
    bag = write_world(tmp_path, World(beacons(), seconds=5.0), second)
    parts = replayed(bag, config(motion={"model": tmp_path / "model.safetensors", "correlation": "independent"}))
    estimates = smooth_run(parts).estimates
    heard = np.array(list(parts.localizer.motion.sources._learned.heard.values()))
    assert len(heard) == len(estimates) - 2
    assert np.abs(heard[:, 0]).max() < 2 * SPEED
    assert heard[:, 0].min() > 0.0
