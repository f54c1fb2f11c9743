"""The bundled samples are what the suite says, small, and fit for use."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from fgloc.config import load_config
from fgloc.sensors.maps import load_map
from fgloc_datasets.sim.installed import install, load_installed
from fgloc_datasets.sim.record import BUNDLED, describe, load_suite
from fgloc_datasets.sim.scenario import Scenario
from fgloc_datasets.sim.scene import make_map

SAMPLES = Path(__file__).parent.parent.parent / "datasets" / "samples"
SEEDS = {"first_run": 1, "patches_run": 1, "light_drop_run": 1, "installed_run": 3}


@pytest.mark.parametrize("name", SEEDS)
def test_sample_is_complete_and_small(name: str) -> None:
    folder = SAMPLES / name
    size = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    assert size <= (8e6 if name != "installed_run" else 2.5e6)
    assert f"record {name} --seed {SEEDS[name]}" in (folder / "SOURCE.md").read_text(encoding="utf-8")
    scenario = load_suite(BUNDLED).find(name)
    assert len(load_map(folder / "map.yaml")) == scenario.world.markers.count
    assert load_config(folder / "robot.yaml").wheels.track == scenario.robot.track_m


@pytest.mark.parametrize("name", SEEDS)
def test_sample_was_recorded_from_the_scenario_of_its_name(name: str) -> None:
    described = yaml.safe_load((SAMPLES / name / "scenario.yaml").read_text(encoding="utf-8"))
    assert described["seed"] == SEEDS[name]
    assert described["camera"] is True
    now = yaml.safe_load(describe(load_suite(BUNDLED).find(name), SEEDS[name], camera=True))
    assert Scenario.model_validate(described["scenario"]) == Scenario.model_validate(now["scenario"])


@pytest.mark.parametrize("name", SEEDS)
def test_installed_yaml_of_a_sample_is_the_draw_of_its_seed(name: str) -> None:
    scenario, seed = load_suite(BUNDLED).find(name), SEEDS[name]
    installed = load_installed(SAMPLES / name / "installed.yaml")
    drawn = install(scenario, seed, make_map(scenario.world, seed))
    assert installed.camera is not None
    assert drawn.camera is not None
    assert installed.camera.time_offset_s == pytest.approx(drawn.camera.time_offset_s)
    assert installed.wheels.left_radius == pytest.approx(drawn.wheels.left_radius)
    assert installed.wheels.track == pytest.approx(drawn.wheels.track)
