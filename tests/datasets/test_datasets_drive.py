"""DRIVE: a small table of windows, and the real one."""

from __future__ import annotations

import csv
import errno
import math
import os
from pathlib import Path

import numpy as np
import pytest
from dataset_files import header_ns, read_back
from real_data import real_data
from refusal import refusal

from fgloc.config import load_config
from fgloc.errors import RecordingError
from fgloc.recording.reader import open_recording
from fgloc.sensors.wheels.events import JointsEvent
from fgloc_datasets.drive import _COLUMNS, TRACK_M, WHEEL_RADIUS_M, convert, span

_ROWS = 40


def _table(path: Path, windows: int = 4, columns: tuple[str, ...] = _COLUMNS) -> Path:
    """Windows of constant wheel speeds, ICP poses renewed every second row; columns in another order and one extra."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["extra", *reversed(columns)], extrasaction="ignore", restval=9.0)
        writer.writeheader()
        for window in range(windows):
            for i in range(_ROWS):
                held = i // 2 * 2
                values = dict.fromkeys(_COLUMNS, 0.0) | {
                    "window": window,
                    "calib_step": window // 3,
                    "steady": int(window % 3 > 0),
                    "i": i,
                    "cmd_left": 2.0,
                    "cmd_right": 4.0,
                    "left_wheel_vel": 1.5,
                    "right_wheel_vel": 1.5 + 0.1 * i,
                    "icp_x": 0.01 * held,
                    "icp_y": 0.02 * held,
                    "icp_yaw": 0.03 * held,
                    "icp_pitch": 0.1,
                    "imu_yaw": 0.5,
                    "imu_acceleration_z": 9.81,
                }
                writer.writerow(values)
    return path


def test_windows_become_segments(tmp_path: Path) -> None:
    messages, received = read_back(convert(_table(tmp_path / "w.csv"), tmp_path / "out"))
    assert received == sorted(received)
    assert {topic: len(found) for topic, found in messages.items()} == {
        "/cmd_vel": 4 * _ROWS,
        "/joint_states": 4 * _ROWS,
        "/imu": 4 * _ROWS,
        "/truth": 4 * _ROWS // 2,  # a held ICP pose is no new one
    }
    stamps = np.array([header_ns(m) for _, m in messages["/cmd_vel"]])
    gaps = np.diff(stamps) * 1e-9
    assert np.count_nonzero(gaps > 60.0) == 3
    assert np.median(gaps) == pytest.approx(0.05)
    config = load_config(tmp_path / "out" / "robot.yaml")
    assert config.gate.clock_jump_s < gaps.max()


def test_quantities(tmp_path: Path) -> None:
    messages, _ = read_back(convert(_table(tmp_path / "w.csv"), tmp_path / "out"))
    command = messages["/cmd_vel"][0][1].twist
    assert command.linear.x == pytest.approx(3.0 * WHEEL_RADIUS_M)
    assert command.angular.z == pytest.approx(2.0 * WHEEL_RADIUS_M / TRACK_M)
    joints = messages["/joint_states"]
    assert joints[0][1].name == ["left_wheel", "right_wheel"]
    end = joints[_ROWS - 1][1]
    duration = 0.05 * (_ROWS - 1)
    np.testing.assert_allclose(end.position, [1.5 * duration, 1.5 * duration + 0.5 * 2.0 * duration**2], rtol=1e-9)
    np.testing.assert_allclose(end.velocity, [1.5, 1.5 + 0.1 * (_ROWS - 1)])
    np.testing.assert_array_equal(joints[_ROWS][1].position, [0.0, 0.0])  # the next window starts anew
    imu = messages["/imu"][5][1]
    assert (imu.angular_velocity.z, imu.linear_acceleration.z) == (0.5, 9.81)
    when, truth = messages["/truth"][3]
    assert when - messages["/cmd_vel"][0][0] == 6 * 50_000_000
    q = truth.pose.orientation
    assert math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2)) == pytest.approx(0.18)
    assert math.asin(2 * (q.w * q.y - q.z * q.x)) == pytest.approx(0.1)
    assert (truth.pose.position.x, truth.pose.position.y) == pytest.approx((0.06, 0.12))


def test_selection_keeps_each_windows_time(tmp_path: Path) -> None:
    table = _table(tmp_path / "w.csv", windows=7)
    whole, _ = read_back(convert(table, tmp_path / "whole"))
    part, _ = read_back(convert(table, tmp_path / "part", windows=range(2, 7), calibration=range(2)))
    times = [when for when, _ in part["/cmd_vel"]]
    assert times == [when for when, _ in whole["/cmd_vel"]][2 * _ROWS : 6 * _ROWS]
    with (tmp_path / "part" / "windows.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["window"], r["calib_step"], r["steady"]) for r in rows] == [
        ("2", "0", "1"),
        ("3", "1", "0"),
        ("4", "1", "1"),
        ("5", "1", "1"),
    ]
    assert int(rows[0]["start_ns"]) == times[0]


def testspans() -> None:
    assert span("3-5", "--windows") == range(3, 6)
    assert span("7", "--windows") == range(7, 8)
    assert span(None, "--windows") is None


@pytest.mark.parametrize(
    ("content", "fact"),
    [
        (None, os.strerror(errno.ENOENT)),
        ("a,b\n1,2\n", ", ".join(_COLUMNS)),
        (",".join(_COLUMNS) + "\n", f" {len(_COLUMNS)} columns"),
        (",".join(_COLUMNS) + "\n" + ",".join(["x"] * len(_COLUMNS)) + "\n", "'x'"),
        (",".join(_COLUMNS) + "\n" + ",".join(["-1"] * len(_COLUMNS)) + "\n", "column window"),
    ],
)
def test_a_wrong_file_is_named(tmp_path: Path, content: str | None, fact: str) -> None:
    if content is not None:
        (tmp_path / "w.csv").write_text(content)
    with refusal(RecordingError, tmp_path / "w.csv", fact):
        convert(tmp_path / "w.csv", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_empty_selection_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"\b0\b.*\b3\b"):
        convert(_table(tmp_path / "w.csv"), tmp_path / "out", windows=range(90, 99))


@pytest.mark.real_data
def test_the_real_windows(tmp_path: Path) -> None:
    source = real_data("drive_husky", "test_husky_windows.csv")
    bag = convert(source, tmp_path, windows=range(100))
    messages, received = read_back(bag)
    assert received == sorted(received)
    assert [len(messages[topic]) for topic in ("/cmd_vel", "/joint_states", "/imu")] == [4000] * 3
    assert 1800 < len(messages["/truth"]) < 2200
    config = load_config(tmp_path / "robot.yaml")
    with open_recording(bag, config.recording) as recording:
        assert sum(isinstance(event, JointsEvent) for event in recording.events()) == 4000
    speeds = np.array([m.velocity for _, m in messages["/joint_states"]])
    assert abs(speeds).max() * WHEEL_RADIUS_M == pytest.approx(1.1, abs=0.1)  # the Husky's top speed: rad/s it is
    assert len((tmp_path / "windows.csv").read_text().splitlines()) == 101


def test_a_pipe_or_a_sparse_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(8 << 30)
    for source in (tmp_path / "pipe", tmp_path / "sparse", Path("/dev/zero")):
        with pytest.raises(RecordingError):
            convert(source, tmp_path / "out")
