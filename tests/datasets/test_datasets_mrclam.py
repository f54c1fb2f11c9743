"""MRCLAM: conversion of small files, constants found again, and the real set."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dataset_files import barcode, header_ns, read_back, write_mrclam
from numpy.typing import NDArray
from real_data import real_data
from refusal import refusal

from fgloc import cli
from fgloc.config import load_config
from fgloc.errors import RecordingError
from fgloc.sensors.maps import load_map
from fgloc_datasets import mrclam
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.mrclam import Run, calibration, convert, fit_sensor, frames, left_out, read, sighting_errors

_START = 1_248_444_175.103
_LANDMARKS = {i: (round(2.0 * math.cos(i) + 1.0, 6), round(3.0 * math.sin(i), 6)) for i in range(6, 21)}


def _tables() -> dict[str, NDArray[np.float64]]:
    t = _START + 0.01 * np.arange(200)
    odometry = np.column_stack([t, np.full(200, 0.086), np.linspace(-0.4, 0.4, 200)])
    odometry[50, 0] = odometry[49, 0]  # as in the set: a stamp that comes twice
    measurement = np.array(
        [
            [_START + 0.100, barcode(6), 3.787, -0.257],
            [_START + 0.101, barcode(9), 6.758, -0.005],
            [_START + 0.101, barcode(2), 1.5, 0.1],  # a robot
            [_START + 0.102, 7.0, 1.5, 0.1],  # nobody's barcode
            [_START + 0.333, barcode(6), 3.787, -0.257],  # repeated exactly: kept
            [_START + 0.334, barcode(6), 3.700, -0.250],  # the same landmark again, 1 ms later: not the same image
        ]
    )
    truth = np.column_stack([t[::2], np.linspace(1, 2, 100), np.linspace(-3, 0, 100), np.linspace(3.0, 3.3, 100)])
    return {"odometry": odometry, "measurement": measurement, "groundtruth": truth}


@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / "MRCLAM_Dataset6"
    write_mrclam(folder, {k: _tables() for k in mrclam.ROBOTS}, _LANDMARKS)
    return folder


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_everything_but_robots_and_unknown_barcodes_is_in_the_bag(source: Path, tmp_path: Path, storage: str) -> None:
    bag = convert(source, 3, tmp_path / "out", storage)
    assert bag == tmp_path / "out" / "bag"
    messages, received = read_back(bag)
    assert received == sorted(received)
    assert {topic: len(found) for topic, found in messages.items()} == {"/cmd_vel": 200, "/landmarks": 3, "/truth": 100}
    seen = [[(s.id, s.range, s.bearing) for s in message.landmarks] for _, message in messages["/landmarks"]]
    np.testing.assert_allclose(seen[0], [(6, 3.787, -0.257), (9, 6.758, -0.005)], rtol=1e-6)
    np.testing.assert_allclose(seen[1] + seen[2], [(6, 3.787, -0.257), (6, 3.7, -0.25)], rtol=1e-6)
    first_ns = 1_248_444_175_103_000_000
    assert [header_ns(m) - first_ns for _, m in messages["/landmarks"]] == [100_000_000, 333_000_000, 334_000_000]
    received_ns, command = messages["/cmd_vel"][0]
    assert (received_ns, header_ns(command)) == (first_ns, first_ns)
    assert (command.twist.linear.x, command.twist.angular.z) == (0.086, -0.4)
    pose = messages["/truth"][-1][1].pose
    assert (pose.position.x, pose.position.y) == (2.0, 0.0)
    assert 2 * math.atan2(pose.orientation.z, pose.orientation.w) == pytest.approx(3.3)


def test_configuration_and_map_load(source: Path, tmp_path: Path) -> None:
    convert(source, 2, tmp_path)
    config = load_config(tmp_path / "robot.yaml")
    assert config.wheels.source == "command"
    assert config.wheels.delay_s == calibration(2).delay_s
    assert config.landmarks.range_along_axis
    assert config.recording.stamp_offset_s == {"sightings": -calibration(2).latency_s}
    landmark_map = load_map(tmp_path / "map.yaml")
    assert {i: tuple(m.position[:2]) for i, m in landmark_map.landmarks.items()} == _LANDMARKS


def test_a_second_conversion_replaces_the_first(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    convert(source, 1, out)
    (source / "Robot1_Odometry.dat").write_text("1248444175.500 0.1 0.2\n")
    assert len(read_back(convert(source, 1, out))[0]["/cmd_vel"]) == 1
    assert sorted(p.name for p in out.iterdir()) == ["bag", "map.yaml", "robot.yaml"]


def test_fault_71_a_failed_conversion_keeps_the_old_bag(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = convert(source, 1, tmp_path / "out")

    def full_disk(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(BagWriter, "truth", full_disk)
    with pytest.raises(OSError, match="No space"):
        convert(source, 1, tmp_path / "out")
    assert len(read_back(bag)[0]["/truth"]) == 100
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["bag", "map.yaml", "robot.yaml"]


def test_a_folder_that_is_no_bag_is_left_alone(source: Path, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "thesis.tex").write_text("thesis")
    with refusal(RecordingError, tmp_path / "bag"):
        convert(source, 1, tmp_path)
    assert (tmp_path / "bag" / "thesis.tex").read_text() == "thesis"


@pytest.mark.parametrize(
    ("name", "content", "fact"),
    [
        ("Robot1_Odometry.dat", None, ""),
        ("Robot1_Odometry.dat", "# nothing\n", " 3 columns"),
        ("Robot1_Measurement.dat", "1.0 5 0.1\n", ": 3 columns, expected 4"),
        ("Robot1_Groundtruth.dat", "1.0 x y 0\n", "'x'"),
        ("Robot1_Groundtruth.dat", "nan 1 1 0\n", "stamp"),
        ("Barcodes.dat", "1 2\n3\n", " row 2"),
    ],
)
def test_a_wrong_file_is_named(source: Path, tmp_path: Path, name: str, content: str | None, fact: str) -> None:
    (source / name).unlink()
    if content is not None:
        (source / name).write_text(content)
    with refusal(RecordingError, source / name, fact, cause=FileNotFoundError if content is None else None):
        convert(source, 1, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_there_are_five_robots(source: Path) -> None:
    with pytest.raises(RecordingError, match="robot 6"):
        read(source, 6)


def test_command_line(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["mrclam.py", *arguments])
        with pytest.raises(SystemExit) as caught:
            cli.main("convert", "mrclam")
        return int(caught.value.code or 0)

    assert run(str(source), "--out", str(tmp_path / "all")) == 0
    assert sorted(p.name for p in (tmp_path / "all").iterdir()) == [f"robot{k}" for k in mrclam.ROBOTS]
    said = capsys.readouterr().out
    assert "4 sightings" in said
    assert f"next: fgloc smooth {tmp_path / 'all' / 'robot5' / 'bag'} --out {tmp_path / 'all' / 'robot5'}" in said
    assert run(str(tmp_path / "nowhere"), "--robot", "1", "--out", str(tmp_path / "x")) == 1
    assert str(tmp_path / "nowhere" / "Robot1_Odometry.dat") in capsys.readouterr().err
    assert run("--out", str(tmp_path / "x")) == 2
    told = capsys.readouterr().err
    assert "SRC" in told
    assert "--download" in told


# --- constants ---


def _simulated(seed: int, delay: float = 0.2, scale: float = 1 / 1.03, latency: float = 0.04) -> Run:
    """A robot that follows its commands late, slowly and veering, and sees depths through a scaled, late camera."""
    rng = np.random.default_rng(seed)
    dt, n = 0.02, 9000
    v = np.repeat(rng.uniform(0.02, 0.15, n // 150), 150)
    omega = np.repeat(rng.uniform(-0.6, 0.6, n // 150), 150)
    late = round(delay / dt)
    true_v = 0.96 * np.concatenate([np.zeros(late), v[:-late]])
    true_omega = 0.94 * np.concatenate([np.zeros(late), omega[:-late]]) - 0.04 * true_v
    yaw = np.concatenate([[0.0], np.cumsum(true_omega * dt)[:-1]])
    x = np.concatenate([[0.0], np.cumsum(true_v * np.cos(yaw) * dt)[:-1]])
    y = np.concatenate([[0.0], np.cumsum(true_v * np.sin(yaw) * dt)[:-1]])
    stamps = 1_248_444_175_000_000_000 + np.arange(n, dtype=np.int64) * round(dt * 1e9)
    landmarks = {i: (5 * math.cos(0.42 * i), 5 * math.sin(0.42 * i)) for i in range(6, 21)}
    behind = round(latency / dt)
    when, ids, seen = [], [], []
    for k in range(behind, n, 12):
        past = k - behind
        for i, (lx, ly) in landmarks.items():
            c, s = math.cos(yaw[past]), math.sin(yaw[past])
            ahead = c * (lx - x[past]) + s * (ly - y[past]) + 0.03
            left = c * (ly - y[past]) - s * (lx - x[past])
            if ahead > 0 and abs(left / ahead) < 0.6:
                when.append(stamps[k])
                ids.append(i)
                seen.append(
                    [ahead / scale + rng.normal(0, 0.01), math.atan2(left, ahead) + 0.002 + rng.normal(0, 0.004)]
                )
    return Run(
        commands_ns=stamps,
        commands=np.column_stack([v, omega]),
        sightings_ns=np.array(when),
        subjects=np.array(ids),
        sightings=np.array(seen),
        truth_ns=stamps,
        truth=np.column_stack([x, y, yaw]),
        landmarks=landmarks,
        robots_left_out=0,
        unknown_left_out=0,
    )


def test_the_fit_finds_the_sensor_again() -> None:
    run = _simulated(seed=1)
    scale, camera_x, bias, latency = sensor = fit_sensor(run)
    assert scale == pytest.approx(1 / 1.03, abs=2e-3)
    assert camera_x == pytest.approx(-0.03, abs=5e-3)
    assert bias == pytest.approx(0.002, abs=5e-4)
    assert latency == pytest.approx(0.04, abs=3e-3)
    errors = sighting_errors(run, sensor)
    assert len(errors) > 0.95 * len(run.subjects)
    assert abs(errors[:, 0]).mean() < 0.02


def test_a_robots_own_truth_never_reaches_its_constants() -> None:
    runs = {k: _simulated(seed=k, delay=0.16 + 0.02 * k) for k in range(1, 5)}
    before = left_out(runs)
    corrupted = {**runs, 2: replace(runs[2], truth=runs[2].truth * [3.0, -2.0, 0.5])}
    after = left_out(corrupted)
    assert after[2] == before[2]
    assert after[1] != before[1]
    assert before[2].delay_s == pytest.approx(0.22, abs=0.015)  # the median of robots 1, 3, 4
    assert before[2].scale_v == pytest.approx(0.96, abs=0.01)
    assert before[2].scale_omega == pytest.approx(0.94, abs=0.01)
    assert before[2].yaw_per_m == pytest.approx(-0.04, abs=0.01)


# --- the real set ---

_COUNTS = {1: (61785, 1534, 407, 1), 2: (65005, 3239, 792, 0), 3: (61158, 4348, 1277, 2), 4: (52916, 2023, 373, 3)}


@pytest.mark.real_data
@pytest.mark.parametrize("robot", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_real_files_lose_nothing(robot: int, tmp_path: Path) -> None:
    source = real_data("mrclam6")
    run = read(source, robot)
    commands, landmarks, robots, unknown = _COUNTS[robot]
    assert len(run.commands) == commands
    assert (len(run.subjects), run.robots_left_out, run.unknown_left_out) == (landmarks, robots, unknown)
    lines = (source / f"Robot{robot}_Measurement.dat").read_text().splitlines()
    rows = sum(not line.startswith("#") for line in lines)
    assert rows == landmarks + robots + unknown
    messages, received = read_back(convert(source, robot, tmp_path))
    assert received == sorted(received)
    assert len(messages["/cmd_vel"]) == commands
    assert len(messages["/truth"]) == len(run.truth)
    assert len(messages["/landmarks"]) == len(list(frames(run)))
    seen = [(s.id, s.range, s.bearing) for _, m in messages["/landmarks"] for s in m.landmarks]
    np.testing.assert_allclose(seen, np.column_stack([run.subjects, run.sightings]), rtol=1e-6)
    assert len(load_map(tmp_path / "map.yaml")) == 15
    assert load_config(tmp_path / "robot.yaml").landmarks.range_along_axis


@pytest.mark.real_data
def test_ranges_are_distances_along_the_axis() -> None:
    """The finding behind ``range_along_axis``: with the cosine the error shrinks to under half."""
    run = read(real_data("mrclam6"), 3)
    corrected = sighting_errors(run, fit_sensor(run))[:, 0].std()
    run_as_range = replace(
        run,
        sightings=run.sightings
        * [[1.0, 1.0]]
        * np.column_stack([np.cos(run.sightings[:, 1]), np.ones(len(run.sightings))]),
    )
    as_range = sighting_errors(run_as_range, fit_sensor(run_as_range))[:, 0].std()
    assert corrected < 0.04
    assert corrected < 0.5 * as_range


@pytest.mark.real_data
@pytest.mark.slow
def test_the_table_is_what_the_fit_gives() -> None:
    fitted = left_out({k: read(real_data("mrclam6"), k) for k in mrclam.ROBOTS})
    for k in mrclam.ROBOTS:
        for name in mrclam.Calibration.__dataclass_fields__:
            got, kept = getattr(fitted[k], name), getattr(calibration(k), name)
            assert got == pytest.approx(kept, rel=0.02, abs=2e-4), f"robot {k}: {name}"
