"""The command line's contract: files, exit codes, one line for an error, silence on a pipe."""

import json
import math
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from circle_bag import BEACONS, write_circle
from command_line import fgloc
from robot_world import START_NS
from run_results import REPORT_FILES

import fgloc_datasets
from fgloc.files.outputs import write_tum
from fgloc.sensors.maps import load_map
from fgloc.types import Trajectory

FILES = REPORT_FILES | {"installation.yaml", "map.yaml"}
FILES_OF = {"batch": FILES, "smooth": FILES, "online": FILES | {"protection.csv"}}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_circle(tmp_path_factory.mktemp("circle"))


def refused(*arguments):
    """The one error line of a command that must fail with bad input."""
    code, _, stderr = fgloc(*arguments)
    assert code == 1
    assert stderr.startswith("error: ")
    return stderr


@pytest.mark.parametrize("command", ["smooth", "online"])
def test_run_writes_all_results(bag, tmp_path, command):
    code, stdout, stderr = fgloc(command, bag, "--out", tmp_path / "out")
    assert (code, stderr) == (0, "")
    assert {file.name for file in (tmp_path / "out").iterdir()} == FILES_OF[command]
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["ate_mean_m"] < 0.04
    assert 0.1 < metrics["nees_over_3"] < 3.0
    assert metrics["coverage"]["3"] > 0.95
    assert metrics["duration_s"] == pytest.approx(9.9, abs=0.3)
    assert metrics["factors"]["range_bearing"] > 100
    assert f"{metrics['ate_mean_m']:.4f} m" in stdout
    assert str(tmp_path / "out" / "report.html") in stdout


def test_batch_is_better_than_online(bag, tmp_path):
    for command in ("smooth", "online"):
        fgloc(command, bag, "--out", tmp_path / command)
    batch, online = (json.loads((tmp_path / c / "metrics.json").read_text()) for c in ("smooth", "online"))
    assert batch["ate_mean_m"] < online["ate_mean_m"]


@pytest.mark.parametrize("command", ["smooth", "online"])
def test_same_bag_twice_gives_the_same_bytes(bag, tmp_path, command):
    for name in ("a", "b"):
        fgloc(command, bag, "--out", tmp_path / name)
    for file in ("trajectory.tum", "covariance.csv", "steps.csv"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_without_truth_the_run_is_still_done(tmp_path):
    seen = write_circle(tmp_path, seconds=4.0, truth=False)
    code, stdout, _ = fgloc("smooth", seen, "--out", tmp_path / "out", "--mcap", tmp_path / "run.mcap")
    assert code == 0
    assert "ATE" not in stdout
    written, layout = stdout.splitlines()[-2:]
    assert written.split() == ["MCAP", str(tmp_path / "run.mcap")]
    assert Path(layout.split()[-1]).is_file()
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["ate_mean_m"] is None


def test_lost_robot_exits_with_3_after_writing(tmp_path):
    bag = write_circle(tmp_path, sees=False)
    code, _, stderr = fgloc("online", bag, "--out", tmp_path / "out")
    assert code == 3
    assert "LOST for" in stderr
    assert {file.name for file in (tmp_path / "out").iterdir()} == FILES_OF["online"]
    assert "LOST" in (tmp_path / "out" / "report.html").read_text()


def test_files_beside_the_bag_are_the_defaults(tmp_path):
    bag = write_circle(tmp_path, seconds=4.0)
    (tmp_path / "robot.yaml").write_text("landmarks: {range_sigma_m: 0.07}\n")
    fgloc("smooth", bag, "--out", tmp_path / "out")
    resolved = json.loads((tmp_path / "out" / "config.json").read_text())
    assert resolved["config"]["landmarks"]["range_sigma_m"] == 0.07
    assert len(resolved["input"]["sha256"]) == 64
    (tmp_path / "other.yaml").write_text("landmarks: {range_sigma_m: 0.09}\n")
    fgloc("smooth", bag, "--config", tmp_path / "other.yaml", "--out", tmp_path / "out")
    resolved = json.loads((tmp_path / "out" / "config.json").read_text())
    assert resolved["config"]["landmarks"]["range_sigma_m"] == 0.09


def test_bad_input_is_one_line_and_code_1(bag, tmp_path):
    out = ("--out", tmp_path / "out")
    assert "absent.bag" in refused("smooth", tmp_path / "absent.bag", *out)
    assert "absent.yaml" in refused("smooth", bag, "--map", tmp_path / "absent.yaml", *out)
    assert "absent.yaml" in refused("online", bag, "--config", tmp_path / "absent.yaml", *out)
    assert "absent.safetensors" in refused("smooth", bag, "--model", tmp_path / "absent.safetensors", *out)
    (tmp_path / "typo.yaml").write_text("wheels: {scale: 2}\n")
    assert "wheels.scale" in refused("smooth", bag, "--config", tmp_path / "typo.yaml", *out)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ("smooth",),
        ("smooth", "bag"),
        ("online", "bag", "--out", "x", "--speed", "2"),
        ("evaluate", "a.tum", "b.tum", "--align", "sim3"),
        ("nonsense",),
        ("smooth", "bag", "--out", "x", "--nonsense"),
    ],
)
def test_usage_is_code_2(arguments):
    assert fgloc(*arguments)[0] == 2


def test_a_place_that_cannot_be_written_is_refused_before_the_run(bag, tmp_path):
    (tmp_path / "file").write_text("")
    code, _, said = fgloc("smooth", bag, "--out", tmp_path / "file")
    assert code == 2
    assert "'--out'" in said
    code, _, said = fgloc("calibrate", bag, "--out", tmp_path)
    assert code == 2
    assert "'--out'" in said


def test_real_time_replay_takes_the_recordings_time(tmp_path):
    bag = write_circle(tmp_path, seconds=2.0)
    began = time.perf_counter()
    assert fgloc("online", bag, "--speed", "1", "--out", tmp_path / "live")[0] == 0
    assert time.perf_counter() - began > 1.9
    fgloc("online", bag, "--out", tmp_path / "fast")
    assert (tmp_path / "live" / "trajectory.tum").read_bytes() == (tmp_path / "fast" / "trajectory.tum").read_bytes()
    factor = json.loads((tmp_path / "live" / "metrics.json").read_text())["real_time_factor"]
    assert 0.5 < factor <= 1.0


def test_map_surveys_the_beacons(bag, tmp_path):
    code, stdout, _ = fgloc("map", bag, "--out", tmp_path / "map.yaml")
    assert code == 0
    told, following = stdout.splitlines()
    assert told == f"4 landmarks in {tmp_path / 'map.yaml'}"
    assert following.startswith(f"next: fgloc calibrate {bag} --map {tmp_path / 'map.yaml'} --out calibrated.yaml")
    landmarks = load_map(tmp_path / "map.yaml").landmarks
    for i in BEACONS:
        for j in BEACONS:
            surveyed = np.linalg.norm(landmarks[i].position - landmarks[j].position)
            assert surveyed == pytest.approx(math.dist(BEACONS[i], BEACONS[j]), abs=0.15)


def test_info_with_a_map_that_is_not_there_is_an_error(bag, tmp_path):
    assert str(tmp_path / "map.yaml") in refused("info", bag, "--map", tmp_path / "map.yaml")


def test_info_names_what_would_be_used(bag):
    code, stdout, _ = fgloc("info", bag)
    assert code == 0
    for name in ("/odom", "/landmarks", "/truth", "nav_msgs/Odometry", "20 Hz"):
        assert name in stdout


def test_evaluate_prints_the_errors(tmp_path):
    stamps = START_NS + 100_000_000 * np.arange(101)
    poses = np.column_stack([np.linspace(0, 10, 101), np.zeros((101, 2))])
    write_tum(tmp_path / "truth.tum", Trajectory(stamps, poses))
    write_tum(tmp_path / "estimate.tum", Trajectory(stamps, poses + np.array([0.0, 0.5, 0.1])))
    code, stdout, _ = fgloc("evaluate", tmp_path / "estimate.tum", tmp_path / "truth.tum")
    table = dict(line.split("  ", 1) for line in stdout.splitlines())
    assert code == 0
    assert table["ATE mean"].strip() == "0.500000 m"
    assert table["yaw MAE"].strip() == f"{math.degrees(0.1):.6f} deg"
    assert table["drift"].strip() == "5.0000 %"
    _, aligned, _ = fgloc("evaluate", tmp_path / "estimate.tum", tmp_path / "truth.tum", "--align", "se2")
    assert "0.000000 m" in aligned


def test_evaluate_tells_how_much_it_compared_and_a_truth_of_other_axes(tmp_path):
    stamps = START_NS + 100_000_000 * np.arange(101)
    poses = np.column_stack([3.0 * np.sin(0.1 * np.arange(101)), 0.1 * np.arange(101), np.zeros(101)])
    write_tum(tmp_path / "estimate.tum", Trajectory(stamps, poses))
    said = {}
    for name, truth in (("same", poses[:51]), ("moved", poses + 5.0), ("mirrored", poses * (1.0, -1.0, 1.0))):
        write_tum(tmp_path / f"{name}.tum", Trajectory(stamps[: len(truth)], truth))
        code, stdout, stderr = fgloc("evaluate", tmp_path / "estimate.tum", tmp_path / f"{name}.tum")
        assert code == 0
        said[name] = stdout, "--align se2" in stderr, "mirror" in stderr
    assert "51 of 101" in said["same"][0]
    assert {name: told for name, (_, *told) in said.items()} == {
        "same": [False, False],
        "moved": [True, False],
        "mirrored": [False, True],
    }
    for gap in ("nan", "-1"):
        refused("evaluate", tmp_path / "estimate.tum", tmp_path / "same.tum", "--max-gap", gap)
    assert fgloc("evaluate", tmp_path / "estimate.tum", tmp_path / "same.tum", "--max-gap", "inf")[0] == 0


def test_evaluate_refuses_what_cannot_be_compared(bag, tmp_path):
    (tmp_path / "a.tum").write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    (tmp_path / "b.tum").write_text("5.0 0 0 0 0 0 0 1\n6.0 0 0 0 0 0 0 1\n")
    assert "0 of 2 poses" in refused("evaluate", tmp_path / "a.tum", tmp_path / "b.tum")
    (tmp_path / "b.tum").write_text("1.0 0 nan 0 0 0 0 1\n")
    assert "line 1: 'nan'" in refused("evaluate", tmp_path / "a.tum", tmp_path / "b.tum")


def test_pipe_gets_no_progress_bar_and_no_traceback(bag, tmp_path):
    def shell(*arguments):
        return subprocess.run(
            [sys.executable, "-m", "fgloc.cli", *map(str, arguments)], capture_output=True, text=True, check=False
        )

    done = shell("smooth", bag, "--out", tmp_path / "out")
    remarks = [line for line in done.stderr.split("\n") if not re.match(r"\w+: \d", line)]  # of runs over 10 s
    assert (done.returncode, remarks) == (0, [""])
    assert f"fgloc smooth {bag} --out {tmp_path / 'out'}" in (tmp_path / "out" / "report.html").read_text()
    done = shell("smooth", tmp_path / "absent.bag", "--out", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


def test_demo_runs_both_ways(bag, tmp_path, monkeypatch):
    monkeypatch.setattr(fgloc_datasets, "SAMPLE", bag)
    code, stdout, _ = fgloc("demo", "--out", tmp_path / "out")
    assert code == 0
    for mode in ("batch", "online"):
        assert {file.name for file in (tmp_path / "out" / mode).iterdir()} == FILES_OF[mode]
        assert str(tmp_path / "out" / mode / "report.html") in stdout
    assert stdout.count("NEES/3: 1 is expected") == 1


@pytest.mark.slow
def test_bundled_sample_is_localised(tmp_path):
    code, stdout, _ = fgloc("demo", "--out", tmp_path)
    assert code == 0
    assert "60 s of installed_run" in stdout
    for mode in ("batch", "online"):
        metrics = json.loads((tmp_path / mode / "metrics.json").read_text())
        assert metrics["ate_mean_m"] < 0.02
        assert metrics["factors"]["corners"] > 500


def test_notes_are_sentences(bag, tmp_path):
    _, stdout, _ = fgloc("smooth", bag, "--out", tmp_path / "out")
    notes = [line.removeprefix("note: ") for line in stdout.splitlines() if line.startswith("note: ")]
    assert len(notes) > 1
    assert all(note.endswith(".") and (note.startswith("/") or note[0].isupper()) for note in notes), notes


def test_help_loads_no_library_but_the_command_lines():
    script = "import sys; from fgloc import cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert "typer" in loaded
    assert {"numpy", "pydantic", "gtsam", "cv2", "scipy", "rosbags", "matplotlib", "yaml"}.isdisjoint(loaded)
