"""Learned motion of robots that are commanded to the side, or by a steering angle."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from motion_models import make_card, make_tensors
from pydantic import ValidationError

from fgloc import se2
from fgloc.config import MotionConfig, config_of
from fgloc.sensors.learned.network import CommandHistory, MotionModel
from fgloc.sensors.learned.sensor import LearnedMotion, load_model, save_model
from fgloc.types import ControlEvent, Step, by_class

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
SCALES = dict(scale_v=0.9, scale_omega=1.1, scale_vy=0.8, delay_s=0.1)


def command(t: float, v: float, omega: float, vy: float = 0.0, steering: float | None = None) -> ControlEvent:
    stamp = T0 + round(t * SECOND)
    return ControlEvent(stamp, stamp, "/cmd_vel", v, omega, vy, steering)


def step_of(events: list[ControlEvent], start_s: float, end_s: float, index: int = 0) -> Step:
    return Step(index, 0, T0 + round(start_s * SECOND), T0 + round(end_s * SECOND), by_class(events))


def sideways_model(path: Path, rng: np.random.Generator, kind: str, weights: float) -> MotionModel:
    card = make_card(kind, inputs=("commands", "sideways"), kinematics=SCALES)
    tensors = {name: np.asarray(weights * w, dtype=np.float32) for name, w in make_tensors(card, rng).items()}
    save_model(path, tensors, card)
    return load_model(path)


def test_a_history_of_commands_averages_what_goes_to_the_side() -> None:
    events = tuple(command(t, 0.0, 0.0, vy) for t, vy in ((1.0, 1.0), (2.0, 3.0), (2.5, 0.0), (4.0, -5.0)))
    first = CommandHistory(events[:2], T0)
    for track in (CommandHistory(events, T0), first.following(events)):
        offset = (T0 - track.origin_ns) * 1e-9
        means = track.means(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 9.0]) + offset, sideways=True)
        np.testing.assert_allclose(means[:, 2], [0.0, 1.0, 1.5, 0.0, -5.0], atol=1e-12)
        assert not means[:, :2].any()


@pytest.mark.parametrize("kind", ["displacement", "gru"])
def test_without_a_residual_a_robot_goes_to_the_side_as_commanded(tmp_path: Path, kind: str) -> None:
    model = sideways_model(tmp_path / "m.safetensors", np.random.default_rng(1), kind, 0.0)
    events = [command(0.0, 0.3, 0.4, -0.2)]
    moved = LearnedMotion(model, MotionConfig(use=True)).measure(step_of(events, 1.0, 1.25))
    assert moved is not None
    expected = se2.exp(0.25 * np.array([0.9 * 0.3, -0.8 * 0.2, 1.1 * 0.4]))
    np.testing.assert_allclose(moved.motion, expected, atol=1e-9)


@pytest.mark.parametrize("kind", ["displacement", "gru"])
def test_the_network_reads_the_commands_to_the_side(tmp_path: Path, kind: str) -> None:
    """The residual on what the kinematics say depends on them, also on those of a while ago."""
    model = sideways_model(tmp_path / "m.safetensors", np.random.default_rng(2), kind, 1.0)
    residuals = []
    for before in (0.0, 0.5):
        events = [command(0.0, 0.3, 0.4, before), command(0.6, 0.3, 0.4, 0.2)]
        moved = LearnedMotion(model, MotionConfig(use=True)).measure(step_of(events, 1.0, 1.1))
        assert moved is not None
        residuals.append(se2.log(moved.motion)[0] - 0.9 * 0.3 * 0.1)
    assert abs(residuals[1] - residuals[0]) > 1e-6


def test_a_robot_that_is_commanded_to_the_side_is_predicted_at_any_time(tmp_path: Path) -> None:
    """Sightings between two poses are moved by it, as by any model that reads commands alone."""
    model = sideways_model(tmp_path / "m.safetensors", np.random.default_rng(3), "displacement", 0.0)
    step = step_of([command(0.0, 0.0, 0.0, 0.5)], 1.0, 1.2)
    found = LearnedMotion(model, MotionConfig(use=True)).motion_between(step, T0 + SECOND, T0 + round(1.1 * SECOND))
    assert found is not None
    np.testing.assert_allclose(found[0], [0.0, 0.8 * 0.5 * 0.1, 0.0], atol=1e-9)


def test_a_command_to_the_side_that_is_no_number_is_passed_over(tmp_path: Path) -> None:
    """The command is passed over, and the next ones are read again."""
    model = sideways_model(tmp_path / "m.safetensors", np.random.default_rng(1), "displacement", 0.0)
    learned = LearnedMotion(model, MotionConfig(use=True))
    events = [command(0.0, 0.3, 0.0, -0.2), command(0.5, 0.3, 0.0, math.nan), command(1.0, 0.3, 0.0, -0.2)]
    for k in range(2):
        moved = learned.measure(step_of(events, 1.5 + 0.1 * k, 1.6 + 0.1 * k, k))
        assert moved is not None
        np.testing.assert_allclose(moved.motion, [0.9 * 0.03, -0.8 * 0.02, 0.0], atol=1e-9)
    assert learned.measure(step_of([command(0.0, 0.3, 0.0, math.nan)], 1.0, 1.1)) is None
    assert learned.rejections == {"learned.no_commands": 1}


def test_a_steering_angle_is_the_yaw_rate_that_the_drive_makes_of_it(tmp_path: Path) -> None:
    drive = config_of({"wheels": {"drive": {"kind": "ackermann", "wheelbase": 0.5}}}).wheels.drive
    card = make_card("displacement")
    save_model(tmp_path / "m.safetensors", make_tensors(card, np.random.default_rng(4)), card)
    angles, speeds = np.array([0.3, -0.2, 0.1, 0.4]), np.array([0.5, 0.6, 0.2, 0.4])
    moved = {}
    for name, told in (
        ("steered", [command(0.1 * k, v, 0.0, 0.0, a) for k, (v, a) in enumerate(zip(speeds, angles, strict=True))]),
        (
            "turned",
            [command(0.1 * k, v, v * np.tan(a) / 0.5) for k, (v, a) in enumerate(zip(speeds, angles, strict=True))],
        ),
    ):
        learned = LearnedMotion(load_model(tmp_path / "m.safetensors"), MotionConfig(use=True), drive=drive)
        steps = [step_of(told[: 3 + k], 0.2 + 0.1 * k, 0.3 + 0.1 * k, k) for k in range(2)]
        moved[name] = [m.motion for step in steps if (m := learned.measure(step)) is not None]
    assert len(moved["steered"]) == 2
    np.testing.assert_array_equal(moved["steered"], moved["turned"])


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        ("displacement", {"inputs": ("commands", "sideways")}),
        ("displacement", {"kinematics": SCALES}),
        ("velocity", {"inputs": ("commands", "velocity", "sideways")}),
        ("displacement", {"wheel_kinematics": SCALES}),
    ],
)
def test_cards_that_do_not_fit_a_sideways_drive_are_refused(kind: str, changes: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        make_card(kind, **changes)
