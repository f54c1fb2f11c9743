"""A simulated robot on a ramp: estimated in space online and in the batch; a flat configuration is named."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from sim_ramp import estimated, record_ramp

from fgloc.cli.terminal import exit_code
from fgloc.evaluation.metrics import ground_metrics, match_result
from fgloc.frames import quaternion_matrix
from fgloc.runner import RunResult
from fgloc.types import Severity


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with the corners of markers."""
    return record_ramp(tmp_path_factory.mktemp("ramp"))


@pytest.mark.parametrize(
    ("mode", "kind"),
    [("online", "fixed_lag"), pytest.param("batch", "fixed_lag", marks=pytest.mark.slow), ("online", "ekf")],
)
def test_the_robot_is_found_in_space(folder: Path, mode: str, kind: str, tmp_path: Path) -> None:
    result, config = estimated(folder, mode, kind=kind)
    matched = match_result(result, config)
    assert matched is not None
    assert matched.true_ground is not None
    assert np.ptp(matched.true_ground[:, 0]) > 0.1  # it was on top
    found = ground_metrics(matched)
    assert found is not None
    assert found.ate_rmse_m < 0.03
    assert found.pitch_rmse_deg < 0.8
    assert 0.1 < found.nees_over_6 < 3.0
    assert not result.mistakes
    if kind == "fixed_lag":
        check_files(result, tmp_path)


def check_files(result: RunResult, out: Path) -> None:
    result.write(out)
    rows = np.loadtxt(out / "trajectory.tum")
    assert result.trajectory.ground is not None
    np.testing.assert_allclose(rows[:, 3], result.trajectory.ground[:, 0], atol=1e-8)
    up = np.array([quaternion_matrix(q)[2, 0] for q in rows[:, 4:]])
    np.testing.assert_allclose(up, -np.sin(result.trajectory.ground[:, 2]), atol=1e-7)
    with (out / "covariance.csv").open(encoding="utf-8") as file:
        table = list(csv.reader(file))
    assert table[0][:4] == ["stamp", "x x", "x y", "x z"]
    assert {len(row) for row in table} == {22}
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["ground"]["height_rmse_m"] < 0.03
    assert "Height profile" in (out / "report.html").read_text(encoding="utf-8")


def test_a_flat_configuration_is_named(folder: Path) -> None:
    result, _ = estimated(folder, "online", ground="flat")
    codes = {f.code: f.severity for f in result.findings}
    assert codes.get("floor.uneven") is Severity.ERROR, result.findings
    assert exit_code(result) == 3
    assert result.trajectory.ground is None
