"""Recordings that fall silent are several runs; runs hear what the robot's own sensors say."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import fgloc
from refusal import refusal
from synthetic_robot import JOINTS, RADIUS, SECOND, T0, TRACK, drive, sensed, sensing

from fgloc.config import Config, WheelsConfig
from fgloc.errors import RecordingError
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.learned import sensor as learned_sensor
from fgloc.sensors.learned.sensor import load_model
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import Event
from fgloc_datasets.bag import BagWriter
from fgloc_training.config import DataConfig
from fgloc_training.data import SensorRecord, load_runs
from fgloc_training.evaluate import evaluate, worth
from fgloc_training.rollouts import roll_sources

MODEL = Path(learned_sensor.__file__).parent / "models" / "mrclam" / "all.safetensors"
SHORT = DataConfig(smoothing_s=0.2, margin_s=0.0, history_s=0.3, shortest_s=1.5)


def write_windows(
    path: Path, seeds: list[int], seconds: float = 2.5, apart_s: float = 100.0, every: int = 5, late_s: float = 0.0
) -> None:
    """Short drives, each of another seed, far apart, with a truth at 100 Hz by ``every``."""
    with BagWriter(path) as bag:
        for k, seed in enumerate(seeds):
            later = round(k * apart_s * SECOND)
            commands, stamps, poses = drive(np.random.default_rng(seed), seconds)
            for c in commands:
                bag.command("/cmd_vel", c.stamp_ns + later, c.v, c.omega)
            for stamp, pose in zip(stamps[::every].tolist(), poses[::every], strict=True):
                bag.planar_truth("/truth", stamp + later + round(late_s * SECOND), pose)


def test_a_recording_that_falls_silent_is_several_runs(tmp_path: Path) -> None:
    write_windows(tmp_path / "bag", [1, 2, 3])
    runs = load_runs(tmp_path / "bag", "w", 0.1, SHORT)
    assert list(runs) == ["w.0", "w.1", "w.2"]
    for k, (name, run) in enumerate(runs.items()):
        assert run.name == name
        assert run.origin_ns == T0 + k * 100 * SECOND + 300_000_000
        assert len(run.starts(15)) > 0
        assert len(run.commands) == 125
        _, stamps, poses = drive(np.random.default_rng(1 + k), 2.5)
        at = run.times + 0.3
        truth = [np.interp(at, (stamps - T0) * 1e-9, poses[:, i]) for i in (0, 1)]
        np.testing.assert_allclose(run.poses[:, :2], np.transpose(truth), atol=0.004)  # at the ends as well
    whole = DataConfig(smoothing_s=0.2, margin_s=0.0, history_s=0.3, shortest_s=1.5, apart_s=1000.0)
    assert list(load_runs(tmp_path / "bag", "w", 0.1, whole)) == ["w"]


def test_stretches_that_are_too_short_are_left_out(tmp_path: Path) -> None:
    write_windows(tmp_path / "some", [1, 2], seconds=2.5)
    longer = SHORT.model_copy(update={"shortest_s": 3.0})
    with pytest.raises(RecordingError, match=r"\b2 stretches\b.*\b3 s\b"):
        load_runs(tmp_path / "some", "w", 0.1, longer)


def test_windows_of_two_seconds_train_a_model(tmp_path: Path) -> None:
    for part, seeds in (("train", range(12)), ("validation", range(12, 16)), ("test", range(16, 20))):
        write_windows(tmp_path / part / "bag", list(seeds))
    parts = ("train", "validation", "test")
    settings = dict(
        robot="r",
        recordings={part: f"{part}/bag" for part in parts},
        split={part: [part] for part in parts},
        data=SHORT.model_dump(),
        network=dict(hidden=[16], edges_s=[0.0, 0.1, 0.2, 0.3]),
        optimization=dict(
            horizon_s=1.5, validation_s=[1.5], variance_horizon_s=1.5, batch=32, iterations=20, validate_every=10,
            variance_iterations=10,
        ),
        calibration=dict(horizons_s=[1.5], short_s=[0.2], window_s=1.5),
    )  # fmt: skip
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(settings))
    arguments = [str(tmp_path / "c.yaml"), "--data", str(tmp_path), "--out", str(tmp_path / "models")]
    assert fgloc("train", *arguments)[0] == 0
    card = load_model(tmp_path / "models" / "model.safetensors").card
    assert card.split.test == ("test.0", "test.1", "test.2", "test.3")
    assert len(card.split.train) == 12
    assert card.figures["drift_percent_1s"] > 0.0


@pytest.mark.parametrize("sparse", ["a", "b"])
def test_a_recording_without_samples_is_named_before_the_training(tmp_path: Path, sparse: str) -> None:
    for seed, name in enumerate("ab"):
        write_windows(tmp_path / name / "bag", [seed], 20.0, every=20 if name == sparse else 5)
    settings = dict(robot="r", recordings=dict(a="a/bag", b="b/bag"), split=dict(train=["a"], validation=["b"]))
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(settings))
    code, _, err = fgloc("train", tmp_path / "c.yaml", "--out", tmp_path / "models")
    assert code == 1
    assert f"{sparse} (0.0 of " in err
    assert "data.max_truth_gap_s" in err


def test_commands_and_truth_that_never_overlap_are_named(tmp_path: Path) -> None:
    write_windows(tmp_path / "bag", [1], late_s=3600.0)
    with refusal(RecordingError, tmp_path / "bag", "2 stretches", "commands and truth"):
        load_runs(tmp_path / "bag", "w", 0.1, SHORT)


def test_topics_that_training_does_not_read_may_be_missing(tmp_path: Path) -> None:
    write_windows(tmp_path / "bag", [1])
    shared = tmp_path / "robot.yaml"
    shared.write_text("recording: {topics: {sightings: /camera/landmarks}}\n")
    assert load_runs(tmp_path / "bag", "w", 0.1, SHORT)
    shared.write_text("recording: {topics: {sightings: /camera/landmarks, command: /drive}}\n")
    with refusal(RecordingError, "/drive") as caught:
        load_runs(tmp_path / "bag", "w", 0.1, SHORT)
    assert "/camera/landmarks" not in str(caught.value)


def test_one_recording_does_not_train_and_validate(tmp_path: Path) -> None:
    write_windows(tmp_path / "a" / "bag", [1])
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    settings = dict(robot="r", recordings=dict(a="a/bag", b="b/bag"), split=dict(train=["a"], validation=["b"]))
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(settings))
    code, _, err = fgloc("train", tmp_path / "c.yaml", "--out", tmp_path / "models")
    assert code == 1
    assert f"a ({tmp_path / 'a' / 'bag'}) and b ({tmp_path / 'b' / 'bag'})" in err


def test_the_gyros_bias_is_known_after_a_rest() -> None:
    bias, stamps = 0.02, [T0 + k * 10_000_000 for k in range(600)]
    rates = [bias if k < 300 else bias + 0.5 for k in range(600)]
    events: list[Event] = []
    for k, (stamp, rate) in enumerate(zip(stamps, rates, strict=True)):
        events.append(ImuEvent(stamp, stamp, "/imu", "imu", np.array([0.0, 0.0, rate]), np.zeros(3), np.zeros((3, 3))))
        turned = max(0, k - 300) * 0.01 * 0.5 * TRACK / 2 / RADIUS
        angles = np.array([-turned, turned])
        events.append(JointsEvent(stamp, stamp, "/joints", JOINTS, angles, np.zeros(2), np.zeros(2)))
    wheels = WheelsConfig(source="ticks", left_radius=RADIUS, right_radius=RADIUS, track=TRACK)
    record = SensorRecord(events, Config(wheels=wheels))
    assert record.gyro_bias(T0) == 0.0
    assert record.gyro_bias(T0 + 5 * SECOND) == pytest.approx(bias, abs=1e-3)
    gyro = record.signals(("gyro",), T0).named("gyro")
    assert gyro is not None
    np.testing.assert_allclose(gyro.means(np.array([1.5, 2.5, 3.2, 5.5]))[[0, 2], 0], [0.0, 0.5], atol=1e-3)


def test_wheel_odometry_is_rolled_out_as_the_localizer_measures_it() -> None:
    run = sensing(3, 20.0)
    assert run.sensors.has_wheels
    wheels = roll_sources(run, 0.2)
    assert 0.002 < np.hypot(*wheels.errors(5.0)[:, :2].T).mean() < 0.1  # a wheel 2 % larger than nominal
    assert np.linalg.eigvalsh(wheels.covs).min() > 0.0


def test_what_a_model_is_worth_is_told_beside_each_set_of_sensors() -> None:
    run = sensing(3, 30.0)
    drifts = worth(load_model(MODEL), [run])
    of, how = ("commands", "wheels", "wheels and gyro"), ("without it", "with the model")
    assert list(drifts) == [f"{sensors}, {way}" for sensors in of for way in how]
    wheels = evaluate([roll_sources(run, 0.2)], 10.0).drift_percent
    assert drifts["wheels, without it"] == pytest.approx(wheels)
    assert drifts["wheels and gyro, without it"] < wheels  # one wheel is 2 % larger than nominal
    assert drifts["wheels, with the model"] < drifts["commands, with the model"]


def test_the_truth_teaches_the_gyros_bias_until_ten_seconds_before() -> None:
    commands, stamps, poses = drive(np.random.default_rng(3), 40.0)
    wheels = WheelsConfig(source="ticks", left_radius=RADIUS, right_radius=RADIUS, track=TRACK)
    bias = 0.02
    record = SensorRecord([*commands, *sensed(3, 40.0, bias)], Config(wheels=wheels), truth=(stamps, poses))
    assert record.gyro_bias(T0 + 5 * SECOND) == 0.0  # this robot sets out at once
    assert record.gyro_bias(T0 + 35 * SECOND) == pytest.approx(bias, abs=2e-3)
    silent = (stamps > T0 + 1 * SECOND) & (stamps < T0 + 39 * SECOND)
    mute = SensorRecord(
        [*commands, *sensed(3, 40.0, bias)], Config(wheels=wheels), truth=(stamps[~silent], poses[~silent])
    )
    assert mute.gyro_bias(T0 + 35 * SECOND) == 0.0
