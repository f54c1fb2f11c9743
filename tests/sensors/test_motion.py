"""Inference of learned motion: forms of model, composition, what the source of measurements carries and rejects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from motion_models import make_card, make_tensors

from fgloc import se2
from fgloc.config import MotionConfig, NoiseDensity
from fgloc.errors import ModelError
from fgloc.sensors.learned.card import Kind
from fgloc.sensors.learned.network import (
    CommandHistory,
    DisplacementModel,
    MotionModel,
    NaiveModel,
    VelocityModel,
)
from fgloc.sensors.learned.sensor import LearnedMotion, load_model, save_model
from fgloc.types import ControlEvent, Step, by_class

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
KINDS = get_args(Kind)


def commands(rng: np.random.Generator, seconds: float = 6.0) -> tuple[ControlEvent, ...]:
    """Commands at irregular times, 20 ms apart on average, that change every half second."""
    stamps = T0 + np.cumsum(rng.integers(5_000_000, 35_000_000, int(seconds / 0.02)))
    levels = rng.uniform([-0.1, -0.5], [0.3, 0.5], (int(seconds * 2) + 3, 2))
    return tuple(ControlEvent(int(t), int(t), "/cmd_vel", *map(float, levels[int((t - T0) * 2e-9)])) for t in stamps)


def model_of(kind: str, rng: np.random.Generator, tmp_path: Path, **changes: object) -> MotionModel:
    card = make_card(kind, **changes)
    save_model(tmp_path / "model.safetensors", make_tensors(card, rng), card)
    return load_model(tmp_path / "model.safetensors")


def known(events: tuple[ControlEvent, ...], end_ns: int) -> tuple[ControlEvent, ...]:
    return tuple(e for e in events if e.stamp_ns <= end_ns)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.mark.parametrize("kind", KINDS)
def test_file_round_trip(kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    model = model_of(kind, rng, tmp_path)
    classes = {"naive": NaiveModel, "velocity": VelocityModel, "displacement": DisplacementModel}
    assert isinstance(model, classes[model.card.family])
    assert model.card == make_card(kind)
    assert model.joint is not None
    assert not list(tmp_path.glob("*.part"))


def test_command_track_averages_a_zero_order_hold() -> None:
    events = tuple(
        ControlEvent(T0 + round(t * SECOND), 0, "c", v, 2 * v)
        for t, v in ((1.0, 1.0), (2.0, 3.0), (2.5, 0.0), (4.0, 5.0))
    )
    track = CommandHistory(events, T0)
    means = track.means(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 9.0]))
    np.testing.assert_allclose(means[:, 0], [0.0, 1.0, 1.5, 0.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(means[:, 1], 2 * means[:, 0], atol=1e-12)
    np.testing.assert_allclose(track.means(np.array([3.0, 1.0]))[0], [1.25, 2.5], atol=1e-12)  # backwards alike


def test_displacement_without_residual_is_the_calibrated_kinematics(rng: np.random.Generator, tmp_path: Path) -> None:
    card = make_card("displacement", kinematics=dict(scale_v=0.9, scale_omega=1.1, yaw_per_m=0.5, delay_s=0.1))
    save_model(tmp_path / "m.safetensors", {k: 0 * v for k, v in make_tensors(card, rng).items()}, card)
    event = ControlEvent(T0, T0, "/cmd_vel", 0.5, 0.8)
    prediction = load_model(tmp_path / "m.safetensors").predict((event,), T0 + SECOND, T0 + 2 * SECOND, None)
    assert prediction is not None
    twist = np.array([0.45, 0.0, 0.88 + 0.5 * 0.45])
    np.testing.assert_allclose(prediction.motion, se2.exp(twist), atol=1e-9)
    np.testing.assert_allclose(prediction.velocity, twist[[0, 2]], atol=1e-9)


def test_ensemble_is_the_mean_and_doubts_where_its_members_differ(rng: np.random.Generator, tmp_path: Path) -> None:
    card, events = make_card("displacement"), commands(rng)
    start, path = T0 + 3 * SECOND, tmp_path / "model.safetensors"
    parts, twists, variances = [], [], []
    for _ in range(3):
        parts.append(make_tensors(card, rng))
        save_model(path, parts[-1], card)
        alone = load_model(path).predict(known(events, start), start, start + SECOND // 10, None)
        assert alone is not None
        twists.append(se2.log(alone.motion) / 0.1)
        variances.append(np.diag(alone.cov) / 0.1)
    assert np.std(twists, axis=0).min() > 1e-4
    save_model(path, {n: np.stack([p[n] for p in parts]) for n in parts[0]}, card.model_copy(update={"members": 3}))
    together = load_model(path).predict(known(events, start), start, start + SECOND // 10, None)
    assert together is not None
    np.testing.assert_allclose(se2.log(together.motion) / 0.1, np.mean(twists, axis=0), atol=1e-6)
    extra_cov = 2.0 * np.var(twists, axis=0)
    np.testing.assert_allclose(np.diag(together.cov) / 0.1, np.mean(variances, axis=0) + extra_cov, rtol=1e-4)


def test_velocity_without_network_is_a_first_order_lag(rng: np.random.Generator, tmp_path: Path) -> None:
    card = make_card("velocity", kinematics=dict(scale_v=0.9, scale_omega=1.1))
    save_model(tmp_path / "m.safetensors", {k: 0 * v for k, v in make_tensors(card, rng).items()}, card)
    event = ControlEvent(T0, T0, "/cmd_vel", 0.5, 0.8)
    predictions = [
        load_model(tmp_path / "m.safetensors").predict((event,), T0 + SECOND, T0 + n * SECOND, np.zeros(2))
        for n in (2, 5)
    ]
    aim = np.array([0.45, 0.88])
    for prediction, t in zip(predictions, (1.0, 4.0), strict=True):
        assert prediction is not None
        np.testing.assert_allclose(prediction.velocity, aim * (1 - np.exp(-t / np.array([0.2, 0.3]))), atol=1e-9)
        assert prediction.motion[2] == pytest.approx(se2.wrap(0.88 * (t - 0.3 * (1 - np.exp(-t / 0.3)))), abs=0.004)


@pytest.mark.parametrize("kind", KINDS)
def test_steps_of_whole_sub_steps_compose_exactly(kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    model, events = model_of(kind, rng, tmp_path), commands(rng)
    start, velocity = T0 + 3 * SECOND, np.array([0.1, 0.2])
    whole = model.predict(events, start, start + SECOND, velocity)
    half = model.predict(events, start, start + SECOND // 2, velocity)
    assert whole is not None
    assert half is not None
    carried = half.velocity if model.card.family == "velocity" else None
    rest = model.predict(events, start + SECOND // 2, start + SECOND, carried)
    assert rest is not None
    np.testing.assert_allclose(se2.compose(half.motion, rest.motion), whole.motion, atol=1e-6)
    np.testing.assert_allclose(se2.compose_cov(half.cov, rest.motion, rest.cov), whole.cov, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_covariance_is_composed_as_se2_does(kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    model, events = model_of(kind, rng, tmp_path), commands(rng)
    start, motion, cov, velocity = T0 + 3 * SECOND, np.zeros(3), np.zeros((3, 3)), np.array([0.1, 0.2])
    whole = model.predict(events, start, start + SECOND, velocity)
    for k in range(10):
        part = model.predict(events, start + k * SECOND // 10, start + (k + 1) * SECOND // 10, velocity)
        assert part is not None
        motion, cov = se2.compose(motion, part.motion), se2.compose_cov(cov, part.motion, part.cov)
        velocity = part.velocity
    assert whole is not None
    np.testing.assert_allclose(motion, whole.motion, atol=1e-6)
    np.testing.assert_allclose(cov, whole.cov, rtol=1e-4, atol=1e-12)


def test_a_track_followed_step_by_step_equals_one_made_at_once(rng: np.random.Generator) -> None:
    events = commands(rng)
    track = CommandHistory(events[:100])
    for first in range(10, 180, 7):
        window = events[first : first + 100]
        assert track.following(window) is track
        times = (window[-1].stamp_ns - track.origin_ns) * 1e-9 - np.linspace(1.0, -0.5, 20)
        shifted = times + (track.origin_ns - window[0].stamp_ns) * 1e-9
        np.testing.assert_allclose(track.means(times), CommandHistory(window).means(shifted), atol=1e-9)
    late = (*window[:50], replace(window[50], v=9.0, stamp_ns=window[50].stamp_ns - 1), *window[50:])
    assert track.following(late) is not track  # one came late, in the middle
    assert track.following(events[:50]) is not track  # an earlier part
    long = tuple(ControlEvent(T0 + i * 1000, 0, "c", 1.0, 0.0) for i in range(20_000))
    track = CommandHistory(long[:50])
    for first in range(0, 19_000, 40):
        track = track.following(long[first : first + 50])
    assert len(track._events) < 5000  # memory does not grow


@pytest.mark.parametrize("kind", KINDS)
def test_any_cadence_gives_the_same_motion_and_covariance(kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    model, events = model_of(kind, rng, tmp_path), commands(rng)
    start = T0 + 3 * SECOND

    def over(lengths_s: list[float]) -> tuple[np.ndarray, np.ndarray]:
        motion, cov, at, velocity = np.zeros(3), np.zeros((3, 3)), start, np.array([0.1, 0.2])
        for length in lengths_s:
            part = model.predict(events, at, at + round(length * SECOND), velocity)
            assert part is not None
            motion, cov = se2.compose(motion, part.motion), se2.compose_cov(cov, part.motion, part.cov)
            at, velocity = at + round(length * SECOND), part.velocity
        return motion, cov

    motion, cov = over([1.0, 1.0])
    for lengths in ([0.05] * 40, [0.2] * 10, [0.13, 0.37, 0.5, 0.07, 0.93]):
        other_motion, other_cov = over(lengths)
        np.testing.assert_allclose(other_motion, motion, atol=0.004)
        np.testing.assert_allclose(np.diag(other_cov), np.diag(cov), rtol=0.15)
        assert np.linalg.eigvalsh(other_cov).min() > 0


def test_velocity_model_starts_from_the_history(rng: np.random.Generator, tmp_path: Path) -> None:
    model, events = model_of("velocity", rng, tmp_path), commands(rng)
    start = T0 + 3 * SECOND
    warm = model.predict(events, start - 2 * SECOND, start, np.zeros(2))
    assert warm is not None
    told = model.predict(events, start, start + SECOND // 5, warm.velocity)
    untold = model.predict(events, start, start + SECOND // 5, None)
    assert told is not None
    assert untold is not None
    np.testing.assert_allclose(untold.motion, told.motion, atol=1e-7)


def test_known_velocity_matters_at_first_and_fades(rng: np.random.Generator, tmp_path: Path) -> None:
    reads = model_of("displacement", rng, tmp_path, inputs=("commands", "velocity"), velocity_decay_s=0.1)
    events, start, velocity = commands(rng), T0 + 3 * SECOND, np.array([0.5, 0.5])
    differences = []
    for length in (SECOND // 10, SECOND):
        untold = reads.predict(events, start, start + length, None)
        told = reads.predict(events, start, start + length, velocity)
        assert untold is not None
        assert told is not None
        differences.append(np.abs(told.velocity - untold.velocity).max())
    assert differences[0] > 100 * differences[1]
    deaf = model_of("displacement", rng, tmp_path)
    a, b = (deaf.predict(events, start, start + SECOND, v) for v in (None, velocity))
    assert a is not None
    assert b is not None
    np.testing.assert_array_equal(a.motion, b.motion)


def test_naive_model_does_what_it_is_told(rng: np.random.Generator, tmp_path: Path) -> None:
    model = model_of("naive", rng, tmp_path)
    events = tuple(ControlEvent(T0 + k * SECOND, 0, "c", 0.1 * k, 0.2 * k) for k in range(1, 4))
    prediction = model.predict(events, T0 + 3 * SECOND // 2, T0 + 5 * SECOND // 2, None)
    assert prediction is not None
    halves = [se2.exp((0.05 * k, 0.0, 0.1 * k)) for k in (1, 2)]
    np.testing.assert_allclose(prediction.motion, se2.compose(*halves), atol=1e-9)
    np.testing.assert_allclose(prediction.velocity, [0.2, 0.4], atol=1e-9)


def test_rate_model_without_a_network_keeps_its_velocity(rng: np.random.Generator, tmp_path: Path) -> None:
    card = make_card("rate")
    save_model(tmp_path / "m.safetensors", {k: 0 * v for k, v in make_tensors(card, rng).items()}, card)
    prediction = load_model(tmp_path / "m.safetensors").predict(commands(rng), T0, T0 + SECOND, np.array([0.3, 0.4]))
    assert prediction is not None
    np.testing.assert_allclose(prediction.motion, se2.exp((0.3, 0.0, 0.4)), atol=1e-9)


def test_noise_density_adds_up() -> None:
    noise = NoiseDensity(
        x_per_sqrt_m=1.0, y_per_sqrt_m=2.0, yaw_per_sqrt_m=3.0, xy_per_sqrt_rad=4.0, yaw_per_sqrt_rad=5.0,
        xy_per_sqrt_s=6.0, yaw_per_sqrt_s=7.0,
    )  # fmt: skip
    np.testing.assert_allclose(noise.per_second(-0.5, -0.1), [38.1, 39.6, 56.0])


def test_prediction_needs_a_command_and_a_length(rng: np.random.Generator, tmp_path: Path) -> None:
    model, events = model_of("displacement", rng, tmp_path), commands(rng)
    with pytest.raises(ModelError, match="command"):
        model.predict((), T0, T0 + SECOND, None)
    with pytest.raises(ModelError, match=rf"\b{T0}\b.*\b{T0}\b"):
        model.predict(events, T0, T0, None)


def step(events: tuple[ControlEvent, ...], index: int, segment: int = 0, length: int = SECOND // 5) -> Step:
    start = T0 + 3 * SECOND + index * length
    return Step(index, segment, start, start + length, by_class(events))


@pytest.mark.parametrize("kind", KINDS)
def test_source_carries_the_models_own_velocity(kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    model, events = model_of(kind, rng, tmp_path, history_s=0.1), commands(rng)
    source = LearnedMotion(model, MotionConfig())
    first, second = (source.measure(step(events, i)) for i in (0, 1))
    assert first is not None
    assert second is not None
    assert (first.source, first.start_ns, second.stamp_ns) == (
        "learned",
        step(events, 0).start_ns,
        step(events, 1).stamp_ns,
    )
    whole = model.predict(events, first.start_ns, second.stamp_ns, None)
    assert whole is not None
    np.testing.assert_allclose(se2.compose(first.motion, second.motion), whole.motion, atol=1e-6)
    again = LearnedMotion(model, MotionConfig())
    again.measure(step(events, 0))
    fresh = again.measure(step(events, 1, segment=1))  # a new segment: nothing carried
    lone = model.predict(events, second.start_ns, second.stamp_ns, None)
    assert fresh is not None
    assert lone is not None
    np.testing.assert_array_equal(fresh.motion, lone.motion)
    if model.card.family == "velocity":
        assert np.abs(fresh.motion - second.motion).max() > 1e-6


def test_source_says_why_it_is_silent(rng: np.random.Generator, tmp_path: Path) -> None:
    model, events = model_of("displacement", rng, tmp_path), commands(rng)
    source = LearnedMotion(model, MotionConfig())
    assert source.measure(step((), 0)) is None
    assert source.measure(step(known(events, T0 + 2 * SECOND), 0)) is not None  # 1.2 s old: still believed
    assert source.measure(step(known(events, T0 + SECOND), 0)) is None
    future = tuple(replace(e, stamp_ns=e.stamp_ns + 60 * SECOND) for e in events)
    assert source.measure(step(future, 0)) is None
    assert source.rejections == {"learned.no_commands": 2, "learned.stale_commands": 1}
    off = LearnedMotion(model, MotionConfig(use=False))
    assert off.measure(step(events, 0)) is None
    assert not off.rejections


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("naive", "lag")])  # they have no network
def test_fault_33_network_returns_nan(kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    card = make_card(kind)
    tensors = make_tensors(card, rng)
    for name in tensors:
        tensors[name] = np.full_like(tensors[name], 3e38)  # finite, but their products are not
    save_model(tmp_path / "m.safetensors", tensors, card)
    model, events = load_model(tmp_path / "m.safetensors"), commands(rng)
    assert model.predict(events, T0 + SECOND, T0 + 2 * SECOND, None) is None
    source = LearnedMotion(model, MotionConfig())
    assert source.measure(step(events, 0)) is None
    assert source.measure(step(events, 1)) is None
    assert source.rejections == {"learned.non_finite": 2}
