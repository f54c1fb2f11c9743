"""A simulated robot on a ramp: estimated in space online and in the batch; a flat configuration is named."""

from __future__ import annotations

import csv
import heapq
import json
from operator import itemgetter
from pathlib import Path

import numpy as np
import pytest

from fgloc import run
from fgloc.cli.terminal import exit_code
from fgloc.config import Config, load_config
from fgloc.datasets.bag import BagWriter
from fgloc.datasets.sim.physics import make_scene, simulate
from fgloc.datasets.sim.record import write_beside
from fgloc.datasets.sim.scenario import Scenario
from fgloc.datasets.sim.sensors import streams
from fgloc.evaluation.metrics import ground_metrics, match_result
from fgloc.frames import quaternion_matrix
from fgloc.types import RunResult

RAMP = Scenario.model_validate(
    {
        "name": "ramp",
        "duration_s": 16.0,
        "start": (-1.9, 0.0, 0.0),
        "world": {
            "size_m": (6.0, 5.0),
            "floor": {"ramp": {"start_x": -1.2, "angle_deg": 12.0, "rise_m": 0.8, "top_m": 0.6}},
            "markers": {"count": 20},
        },
        "camera": {"rate_hz": 5},
        "control": {"waypoints": [(0.9, 0.0), (0.2, 0.3), (-1.9, 0.0)], "speed": 0.45},
        "installation": "as_installed",
    }
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with the corners of markers."""
    out = tmp_path_factory.mktemp("ramp")
    scene = make_scene(RAMP, 5)
    log = simulate(scene)
    with BagWriter(out / "bag", compress=True) as bag:
        for _, write in heapq.merge(*streams(scene, log, bag, "corners"), key=itemgetter(0)):
            write()
    write_beside(out, scene, RAMP, camera=False)
    return out


def estimated(folder: Path, mode: str, **estimator: object) -> tuple[RunResult, Config]:
    config = load_config(folder / "robot.yaml")
    changed = config.estimator.model_copy(update=estimator)
    config = config.model_copy(update={"estimator": changed})
    return run(folder / "bag", folder / "map.yaml", config, mode, check=False), config  # type: ignore[arg-type]


@pytest.mark.parametrize(("mode", "kind"), [("online", "fixed_lag"), ("batch", "fixed_lag"), ("online", "ekf")])
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
    assert any("the floor is not flat: pitch up to" in mistake for mistake in result.mistakes)
    assert any("set estimator.ground: uneven" in note for note in result.notes)
    assert exit_code(result) == 3
    assert result.trajectory.ground is None
