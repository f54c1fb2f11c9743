"""The public API: its names, and a program of ten lines that uses it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from run_results import START_NS, figure_eight
from source_roots import PYTHONPATH

import fgloc
from fgloc.config import Config

ROOT = Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "datasets" / "samples" / "first_run"
NAMES = [
    "CameraError",
    "Config",
    "ConfigError",
    "Context",
    "CovarianceError",
    "Decision",
    "Estimate",
    "EstimatorError",
    "FglocError",
    "LandmarkMap",
    "Live",
    "MapError",
    "Mode",
    "ModelError",
    "OutputError",
    "PoseMeasurement",
    "RecordingError",
    "Results",
    "RunResult",
    "Section",
    "Sensor",
    "SensorEvent",
    "Stream",
    "Trajectory",
    "TrajectoryError",
    "WireError",
    "load_config",
    "load_map",
    "read_results",
    "run",
]


def test_public_names_are_these():
    assert sorted(fgloc.__all__) == sorted(NAMES)
    assert set(NAMES) <= set(dir(fgloc))
    for name in NAMES:
        value = getattr(fgloc, name)
        assert value.__name__ == name
        if name.endswith("Error"):
            assert issubclass(value, fgloc.FglocError)
    with pytest.raises(AttributeError, match="no attribute 'walk'"):
        fgloc.walk  # noqa: B018


def test_all_errors_are_public():
    known = {fgloc.FglocError.__name__} | {
        error.__name__ for error in fgloc.FglocError.__subclasses__() if error.__module__.startswith("fgloc.")
    }
    assert known <= set(fgloc.__all__)


def test_a_mode_and_a_role_that_there_are_not_are_refused():
    with pytest.raises(fgloc.ConfigError, match=r"'bach'.*batch, online"):
        fgloc.run(Path("no bag"), None, Config(), "bach")
    with pytest.raises(fgloc.ConfigError, match=r"'rangs'.*odometry"):
        fgloc.Live(Config(), None, roles=("odometry", "rangs"))


def test_interpolate_takes_the_shorter_way_round():
    trajectory = fgloc.Trajectory(np.array([0, 10, 20]), np.array([[0.0, 0.0, 3.0], [1.0, 2.0, -3.0], [1.0, 2.0, 0.0]]))
    pose = trajectory.interpolate(5)
    assert pose.shape == (3,)
    np.testing.assert_allclose(pose[:2], (0.5, 1.0))
    assert abs(abs(pose[2]) - np.pi) < 1e-12
    np.testing.assert_array_equal(trajectory.interpolate(np.array([0, 20])), trajectory.poses[[0, 2]])


@pytest.mark.parametrize("stamp_ns", [-1, 21])
def test_interpolate_refuses_times_outside(stamp_ns):
    trajectory = fgloc.Trajectory(np.array([0, 20]), np.zeros((2, 3)))
    with pytest.raises(fgloc.TrajectoryError, match=rf"stamp {stamp_ns} ns .* expected 0 to 20 ns"):
        trajectory.interpolate(stamp_ns)
    with pytest.raises(fgloc.TrajectoryError, match="empty"):
        fgloc.Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3))).interpolate(0)


def test_write_makes_the_folder_of_a_run(tmp_path):
    result = figure_eight()
    result.write(tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"trajectory.tum", "covariance.csv", "steps.csv", "metrics.json", "report.html"} <= names
    first = (tmp_path / "out" / "trajectory.tum").read_text(encoding="utf-8").splitlines()[1]
    assert first.startswith(f"{START_NS // 10**9}.")
    assert len(fgloc.read_results(str(tmp_path / "out")).trajectory) == len(result.trajectory)


def run_example(*arguments):
    return subprocess.run(
        [sys.executable, str(ROOT / "examples" / "smooth_and_plot.py"), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": PYTHONPATH, "MPLBACKEND": "agg"},
    )


def test_example_without_arguments_says_which():
    done = run_example()
    assert done.returncode == 2
    assert done.stderr.startswith("usage: smooth_and_plot.py [-h] BAG MAP.yaml ROBOT.yaml OUT\n")


@pytest.mark.slow
def test_example_smooths_and_plots(tmp_path):
    done = run_example(*(SAMPLE / name for name in ("bag", "map.yaml", "robot.yaml")), tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "path.png").stat().st_size > 5000
    assert "trajectory.tum" in {path.name for path in (tmp_path / "out").iterdir()}
