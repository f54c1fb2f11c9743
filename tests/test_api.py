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


def test_interpolated_covariances_hold_the_errors_between_keyframes():
    """Errors that keyframes share or do not, and a path that bends between them: NEES/3 stays about 1 or below."""
    rng, t = np.random.default_rng(5), 0.2 * np.arange(400)
    way = lambda t: np.column_stack([3.0 * np.sin(0.4 * t), 2.0 * np.sin(0.8 * t), np.sin(0.5 * t)])  # noqa: E731
    covs = np.repeat(np.diag([0.003, 0.003, 0.002])[None] ** 2, len(t), axis=0)
    independent = rng.normal(size=(len(t), 3))
    shared = np.zeros_like(independent)
    for k in range(1, len(t)):
        shared[k] = 0.95 * shared[k - 1] + 0.31 * independent[k]
    for noise in (independent, shared):
        poses = way(t) + noise * np.sqrt(covs[:, range(3), range(3)])
        trajectory = fgloc.Trajectory((t * 1e9).astype(np.int64), poses, covs)
        at = trajectory.stamps_ns[:-1] + rng.integers(0, 200_000_000, len(t) - 1)
        errors = trajectory.interpolate(at) - way(at * 1e-9)
        found = trajectory.interpolate_covs(at)
        linear = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covs[:-1]), errors).mean() / 3.0
        assert np.einsum("ni,nij,nj->n", errors, np.linalg.inv(found), errors).mean() / 3.0 < min(1.4, linear)


def test_interpolated_covariances_at_keyframes_and_without_any():
    stamps, covs = np.array([0, 10, 20]), np.stack([np.eye(3) * k for k in (1.0, 2.0, 3.0)])
    trajectory = fgloc.Trajectory(stamps, np.zeros((3, 3)), covs)
    np.testing.assert_array_equal(trajectory.interpolate_covs(stamps), covs)
    np.testing.assert_allclose(trajectory.interpolate_covs(5), 1.5 * np.eye(3))
    rested = fgloc.Trajectory(np.array([0, 10**9]), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), covs[:2])
    assert rested.interpolate_covs(5 * 10**8)[0, 0] == pytest.approx(1.5 + 0.25**2)  # it started from rest
    with pytest.raises(fgloc.TrajectoryError):
        fgloc.Trajectory(stamps, np.zeros((3, 3))).interpolate_covs(5)


@pytest.mark.parametrize("stamp", [0.5, np.array([1.0, 2.5]), None, "1"])
def test_interpolate_refuses_times_that_are_no_whole_nanoseconds(stamp):
    with pytest.raises(fgloc.TrajectoryError):
        fgloc.Trajectory(np.array([0, 20]), np.zeros((2, 3))).interpolate(stamp)
