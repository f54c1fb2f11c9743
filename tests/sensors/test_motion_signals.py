"""Measured signals that a model may read: what is made of them, where they have holes, and what is said then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion_models import make_card, make_tensors

from fgloc import se2
from fgloc.config import MotionConfig
from fgloc.errors import ConfigError, ModelError
from fgloc.sensors.base import Signal
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.learned.card import SignalReader, Signals
from fgloc.sensors.learned.sensor import LearnedMotion, load_model, save_model
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import ControlEvent, InertialEvent, MotionEvent, Step, by_class

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
NAMES = ("caster", "right_wheel", "left_wheel")
ALL = ("commands", "gyro", "effort", "wheels")


def imu(t: float, rate: float) -> ImuEvent:
    stamp = T0 + round(t * SECOND)
    return ImuEvent(stamp, stamp, "/imu", "imu", np.array([9.0, 9.0, rate]), np.zeros(3), np.zeros((3, 3)))


def joints(t: float, left: float, right: float, effort: tuple[float, float] = (0.1, 0.3)) -> JointsEvent:
    stamp = T0 + round(t * SECOND)
    angles, torques = np.array([7.0, right, left]), np.array([7.0, effort[1], effort[0]])
    return JointsEvent(stamp, stamp, "/joints", NAMES, angles, np.zeros(3), torques)


def drive(start: float, end: float, **changes: object) -> Step:
    """Left wheel at 4 rad/s, right at 6; the gyro says 0.5 rad/s; commands say nothing of it."""
    times = np.arange(start - 0.02, end + 0.03, 0.02)
    step = Step(
        0,
        0,
        T0 + round(start * SECOND),
        T0 + round(end * SECOND),
        by_class(
            (
                ControlEvent(T0 + 5 * SECOND // 2, T0, "/cmd_vel", 0.1, 0.1),
                *(joints(t, 4.0 * t, 6.0 * t) for t in times),
                *(imu(t, 0.5) for t in times),
            )
        ),
    )
    return replace(step, **changes)


def with_events(step: Step, kind: type[MotionEvent], events: tuple[MotionEvent, ...]) -> Step:
    return replace(step, motion={**step.motion, kind: events})


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def source_of(tmp_path: Path, rng: np.random.Generator, inputs: tuple[str, ...], zero: bool = False) -> LearnedMotion:
    card = make_card("displacement", inputs=inputs)
    tensors = make_tensors(card, rng)
    if zero:
        tensors = {name: 0 * tensor for name, tensor in tensors.items()}
    save_model(tmp_path / "m.safetensors", tensors, card)
    return LearnedMotion(load_model(tmp_path / "m.safetensors"), MotionConfig())


def test_a_signal_is_the_integral_of_its_samples() -> None:
    signal = Signal.of_samples(np.array([1.0, 2.0, 4.0]), np.array([[0.0, 2.0, 2.0], [1.0, 1.0, 3.0]]))
    means = signal.means(np.array([1.0, 2.0, 4.0, 9.0]))
    np.testing.assert_allclose(means, [[1.0, 1.0], [2.0, 2.0], [2.0, 2.0]], atol=1e-9)  # what was last holds on
    np.testing.assert_allclose(signal.means(np.array([0.0, 1.0])), [[1.0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(signal.means(np.array([4.0, 1.0]))[0], [5.0 / 3.0, 5.0 / 3.0], atol=1e-9)


def test_signals_of_a_step() -> None:
    reader = SignalReader(make_card("displacement", inputs=ALL))
    signals = reader.read(drive(3.0, 3.2), gyro_bias=0.1)
    assert isinstance(signals, Signals)
    limits = np.array([0.0, 0.13])
    assert signals.named("gyro") is not None
    np.testing.assert_allclose(signals.named("gyro").means(limits), [[0.4]], atol=1e-9)
    assert signals.named("wheels") is not None
    np.testing.assert_allclose(signals.named("wheels").means(limits), [[0.25, 0.1 / 0.26]], atol=1e-6)
    assert signals.named("effort") is not None
    np.testing.assert_allclose(signals.named("effort").means(limits), [[0.4, 0.2]], atol=1e-9)


def test_wheel_rates_stand_in_for_angles() -> None:
    reader = SignalReader(make_card("displacement", inputs=("commands", "wheels")))
    step = drive(3.0, 3.2)
    rates = tuple(replace(e, position=np.zeros(0), velocity=np.array([0.0, 6.0, 4.0])) for e in step.of(JointsEvent))
    signals = reader.read(with_events(step, JointsEvent, rates))
    assert isinstance(signals, Signals)
    assert signals.named("wheels") is not None
    np.testing.assert_allclose(signals.named("wheels").means(np.array([0.0, 0.2])), [[0.25, 0.1 / 0.26]], atol=1e-9)


def test_best_known_kinematics_carry_the_model(tmp_path: Path, rng: np.random.Generator) -> None:
    commands = np.array([0.95 * 0.1, 0.0, 0.9 * 0.1])
    wheels = np.array([0.25, 0.0, 0.1 / 0.26])
    for inputs, twist in (
        (("commands",), commands),
        (("commands", "gyro"), [commands[0], 0.0, 0.45]),
        (("commands", "wheels"), wheels),
        (("commands", "gyro", "effort", "wheels"), [wheels[0], 0.0, 0.45]),
    ):
        measured = source_of(tmp_path, rng, inputs, zero=True).measure(drive(3.0, 3.2), gyro_bias=0.05)
        assert measured is not None
        np.testing.assert_allclose(measured.motion, se2.exp(0.2 * np.array(twist)), atol=1e-6)


@pytest.mark.parametrize("missing", ["gyro", "effort", "wheels"])
def test_a_step_without_a_signal_gives_no_measurement(missing: str, tmp_path: Path, rng: np.random.Generator) -> None:
    source = source_of(tmp_path, rng, ("commands", missing))
    kind = ImuEvent if missing == "gyro" else JointsEvent
    whole = drive(3.0, 4.0)
    events = whole.of(kind)
    hole = tuple(e for e in events if not T0 + 3.3 * SECOND < e.stamp_ns < T0 + 3.7 * SECOND)
    short = tuple(e for e in events if e.stamp_ns < T0 + 3.7 * SECOND)
    late = tuple(e for e in events if e.stamp_ns > T0 + 3.3 * SECOND)
    for left in (hole, short, late, events[:1], ()):
        assert source.measure(with_events(whole, kind, left)) is None
    thin = events[::10]
    assert source.measure(with_events(whole, kind, thin)) is not None  # five a second will do
    assert source.rejections == {f"learned.no_{missing}": 5}
    assert source_of(tmp_path, rng, ("commands",)).measure(with_events(whole, kind, ())) is not None


def test_readings_that_are_not_numbers_are_holes(tmp_path: Path, rng: np.random.Generator) -> None:
    source = source_of(tmp_path, rng, ("commands", "effort"))
    whole = drive(3.0, 4.0)
    lame = tuple(replace(e, effort=np.array([7.0, np.nan, 0.1])) for e in whole.of(JointsEvent))
    mute = tuple(replace(e, effort=np.zeros(0)) for e in whole.of(JointsEvent))
    other = tuple(replace(e, names=("a", "b", "c")) for e in whole.of(JointsEvent))
    for events in (lame, mute, other):
        assert source.measure(with_events(whole, JointsEvent, events)) is None
    assert source.rejections == {"learned.no_effort": 3}
    both = tuple(
        replace(e, names=("front_left_wheel", "rear_left_wheel", "right_wheel")) for e in whole.of(JointsEvent)
    )
    with pytest.raises(ConfigError, match="front_left_wheel, rear_left_wheel"):
        source.measure(with_events(whole, JointsEvent, both))


def test_contiguous_steps_remember_and_others_begin_anew() -> None:
    edges = (0.0, 0.1, 0.4)
    card = make_card(
        "displacement", inputs=("commands", "gyro"), signal_edges_s=edges, input_mean=(0.0,) * 19, input_std=(1.0,) * 19
    )
    rates = [imu(0.02 * k, 0.01 * k) for k in range(200)]

    def step(start: float, end: float, segment: int = 0) -> Step:
        heard = tuple(e for e in rates if T0 + (start - 0.02) * SECOND <= e.stamp_ns <= T0 + (end + 0.02) * SECOND)
        return Step(0, segment, T0 + round(start * SECOND), T0 + round(end * SECOND), by_class(heard))

    def before(reader: SignalReader, at: Step) -> float:
        signals = reader.read(at)
        assert isinstance(signals, Signals)
        assert signals.named("gyro") is not None
        return float(signals.named("gyro").means(np.array([-0.1, -0.4]))[0, 0])

    reader = SignalReader(card)
    for k in range(4):
        reader.read(step(1.0 + 0.2 * k, 1.2 + 0.2 * k))
    assert before(reader, step(1.8, 2.0)) == pytest.approx(0.5 * 1.55, abs=1e-9)
    assert len(reader._events[InertialEvent]) < 50
    fresh = before(SignalReader(card), step(1.8, 2.0))
    assert fresh == pytest.approx(0.9, abs=0.02)  # the first value, held
    for other in (step(2.2, 2.4), step(2.0, 2.2, segment=1)):
        reader = SignalReader(card)
        reader.read(step(1.8, 2.0))
        assert before(reader, other) == pytest.approx(0.5 * (other.start_ns - T0) * 1e-9, abs=0.02)


def test_a_model_is_not_asked_without_its_signals(tmp_path: Path, rng: np.random.Generator) -> None:
    source = source_of(tmp_path, rng, ("commands", "gyro"))
    step = drive(3.0, 3.2)
    with pytest.raises(ModelError, match=r"\bgyro\b"):
        source.model.predict(step.controls, step.start_ns, step.stamp_ns, None)


def test_cards_say_what_a_model_reads() -> None:
    assert make_card("displacement", inputs=ALL).reads("wheels")
    assert not make_card("displacement", inputs=("commands", "gyro", "effort")).reads("wheels")
    for changes, message in (
        ({"inputs": ("commands", "effort"), "joints": None}, "needs the card's joints"),
        ({"inputs": ("commands", "wheels"), "joints": {"left": "l", "right": "r"}}, "needs left_radius"),
        ({"inputs": ("commands", "gyro"), "signal_edges_s": (0.1, 0.2)}, "increase from 0"),
    ):
        with pytest.raises(ValueError, match=message):
            make_card("displacement", **changes)
    with pytest.raises(ValueError, match=r"got .*gyro"):
        make_card("velocity", inputs=("commands", "velocity", "gyro"))


def test_an_imu_may_be_mounted_upside_down() -> None:
    card = make_card("displacement", inputs=("commands", "gyro"))
    signals = SignalReader(card, imu_up=(0.0, 0.0, -1.0)).read(drive(3.0, 3.2), gyro_bias=0.1)
    assert isinstance(signals, Signals)
    assert signals.named("gyro") is not None
    np.testing.assert_allclose(signals.named("gyro").means(np.array([0.0, 0.1])), [[-0.6]], atol=1e-9)
