"""Result files: exact, whole or not at all, and clear about what is wrong."""

import csv
import errno
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from refusal import refusal
from run_results import START_NS, figure_eight

from fgloc.errors import OutputError, TrajectoryError
from fgloc.files import outputs
from fgloc.files.atomic import atomic_folder
from fgloc.types import Trajectory

LINE = "1.0 0 0 0 0 0 0 1\n"


def test_tum_round_trip_is_exact_in_time(tmp_path):
    stamps = np.array([0, 1, 999_999_999, START_NS + 123_456_789, 2**62])
    poses = np.array([[0, 0, 0], [1.5, -2, 3.1], [0, 1e-9, -3.1], [1e3, 0, 1.0], [-1, -1, -1]], dtype=float)
    outputs.write_tum(tmp_path / "a.tum", Trajectory(stamps, poses))
    back = outputs.read_tum(tmp_path / "a.tum")
    assert back.stamps_ns.tolist() == stamps.tolist()
    np.testing.assert_allclose(back.poses, poses, atol=3e-9)


def test_tum_has_eight_columns_and_nine_decimals(tmp_path):
    outputs.write_tum(tmp_path / "a.tum", Trajectory(np.array([1_500_000_000]), np.array([[1.0, 2.0, np.pi / 2]])))
    assert (tmp_path / "a.tum").read_text().splitlines()[1] == (
        "1.500000000 1.000000000 2.000000000 0.000000000 0.000000000 0.000000000 0.707106781 0.707106781"
    )


def test_tum_of_others_is_read(tmp_path):
    (tmp_path / "a.tum").write_text(
        "# comment\n\n1.3e9 1e0 2 9 0 0 2e-1 9.7979590e-1\n1300000000.25 1 2 0 0 0 -0.0 -1\n"
    )
    back = outputs.read_tum(tmp_path / "a.tum")
    assert back.stamps_ns.tolist() == [1_300_000_000_000_000_000, 1_300_000_000_250_000_000]
    np.testing.assert_allclose(back.poses, [[1, 2, 2 * np.arcsin(0.2)], [1, 2, 0]], atol=1e-7)


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        (LINE + "2.0 nan 0 0 0 0 0 1\n", "line 2: 'nan' "),
        (LINE + "\n3.0 0 0 0 0 0 0 inf\n", "line 3: 'inf' "),
        (LINE + "2.0 0 0 0 0 0 x 1\n", "line 2: 'x' "),
        ("1.0 2.0 3.0\n", "line 1: 3 "),
        (LINE + LINE, "line 2: stamp 1.0 "),
        (LINE + "0.5 0 0 0 0 0 0 1\n", "line 2: stamp 0.5 "),
        ("1.0 0 0 0 0 0 0 0\n", "line 1: quaternion 0 0 0 0 "),
        ("1e12 0 0 0 0 0 0 1\n", "line 1: stamp 1e12 "),
        ("# nothing\n", "t x y z qx qy qz qw"),
    ],
)
def test_wrong_tum_is_refused_with_its_line(tmp_path, text, fact):
    path = tmp_path / "a.tum"
    path.write_text(text)
    with refusal(TrajectoryError, path, fact):
        outputs.read_tum(path)


def test_missing_or_binary_tum_is_refused(tmp_path):
    with refusal(TrajectoryError, tmp_path / "absent.tum", cause=FileNotFoundError):
        outputs.read_tum(tmp_path / "absent.tum")
    (tmp_path / "b.tum").write_bytes(b"\xff\xfe\x00\x80")
    with refusal(TrajectoryError, tmp_path / "b.tum", cause=UnicodeDecodeError):
        outputs.read_tum(tmp_path / "b.tum")


def test_nan_pose_is_not_written(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("old")
    with pytest.raises(TrajectoryError, match=r"\b1\b.*\[nan, 0.0, 0.0\]"):
        outputs.write_tum(path, Trajectory(np.array([1, 2]), np.array([[0.0, 0, 0], [np.nan, 0, 0]])))
    assert path.read_text() == "old"


def test_covariance_csv(tmp_path):
    result = figure_eight(n=5)
    outputs.write_covariance_csv(tmp_path / "c.csv", result.trajectory)
    with (tmp_path / "c.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["stamp", "xx", "xy", "xθ", "yy", "yθ", "θθ"]
    assert rows[3]["stamp"] == "1700000000.300000000"
    cov = result.trajectory.covs[3]
    written = [float(rows[3][name]) for name in ("xx", "xy", "xθ", "yy", "yθ", "θθ")]
    np.testing.assert_allclose(written, cov[np.triu_indices(3)], rtol=1e-9, atol=1e-15)
    with refusal(TrajectoryError, tmp_path / "d.csv"):
        outputs.write_covariance_csv(tmp_path / "d.csv", Trajectory(np.array([1]), np.zeros((1, 3))))


def test_steps_csv_has_a_row_per_decision(tmp_path):
    result = figure_eight(n=20)
    outputs.write_steps_csv(tmp_path / "s.csv", result.decisions)
    with (tmp_path / "s.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(result.decisions) == 22
    rejected = [row for row in rows if row["reason"]]
    assert {(row["kind"], row["landmark_id"], row["weight"], row["reason"]) for row in rejected} == {
        ("corners", "0", "0", "gate"),
        ("corners", "1", "0", "gate"),
    }


def test_json_refuses_nan(tmp_path):
    path = tmp_path / "m.json"
    outputs.write_json(path, {"a": None, "b": 1.5})
    with refusal(OutputError, path, cause=ValueError):
        outputs.write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": None, "b": 1.5}


def test_fault_71_disk_full_keeps_the_old_result(tmp_path, monkeypatch):
    path = tmp_path / "trajectory.tum"
    old = Trajectory(np.array([1]), np.zeros((1, 3)))
    outputs.write_tum(path, old)
    before = path.read_bytes()

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with refusal(OutputError, path, os.strerror(errno.ENOSPC)):
        outputs.write_tum(path, figure_eight().trajectory)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["trajectory.tum"]


def test_fault_71_kill_9_during_a_write_keeps_the_old_result(tmp_path):
    path = tmp_path / "steps.csv"
    path.write_text("old")
    code = (
        "import sys, time; from pathlib import Path; from fgloc.files.atomic import atomic_file\n"
        "with atomic_file(Path(sys.argv[1])) as file:\n"
        "    file.write('half of the new'); file.flush(); print('writing', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"writing\n"
        assert path.read_text() == "old"
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert path.read_text() == "old"
    outputs.write_text(path, "new")
    assert path.read_text() == "new"


def test_fault_71_an_error_in_the_last_file_keeps_the_whole_old_folder(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).write_text("old")

    def half():
        with atomic_folder(tmp_path) as stage:
            outputs.write_text(stage / "a", "new")
            outputs.write_json(stage / "b", {"bad": float("inf")})

    with pytest.raises(OutputError):
        half()
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"a": "old", "b": "old"}


def test_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with refusal(OutputError, tmp_path / "file" / "out.txt", cause=OSError):
        outputs.write_text(tmp_path / "file" / "out.txt", "x")


def test_names_that_are_no_text_are_hashed_and_written(tmp_path):
    name = os.fsdecode(b"lauf_\xe4")  # of a disk whose names are Latin-1
    (tmp_path / name).mkdir()
    (tmp_path / name / name).write_bytes(b"123")
    assert len(outputs.sha256_of(tmp_path / name)) == 64
    outputs.write_json(tmp_path / "a.json", {"bag": name})
    assert json.loads((tmp_path / "a.json").read_text()) == {"bag": name}
    outputs.write_text(tmp_path / "a.html", name)
    assert (tmp_path / "a.html").read_text().startswith("lauf_")


def test_hash_tells_contents_and_names_apart(tmp_path):
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "a.mcap").write_bytes(b"123")
    first = outputs.sha256_of(bag)
    os.utime(bag / "a.mcap", (time.time() - 100, time.time() - 100))
    assert outputs.sha256_of(bag) == first
    (bag / "a.mcap").rename(bag / "b.mcap")
    assert outputs.sha256_of(bag) != first
    assert outputs.sha256_of(bag / "b.mcap") == "a665a45920422f9d417e4867efdc4fb8a04a1f3fff1fa07e998e86f7f7a27ae3"
