"""The bundled samples are what the suite says, small, and fit for use."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from datasets.sim.scenario import Scenario
from datasets.sim.suite import BUNDLED, load_suite
from fgloc.config import load_config
from fgloc.sensors.maps import load_map

SAMPLES = Path(__file__).parent.parent / "datasets" / "samples"
NAMES = ("first_run", "patches_run", "light_drop_run")


@pytest.mark.parametrize("name", NAMES)
def test_sample_is_complete_and_small(name: str) -> None:
    folder = SAMPLES / name
    size = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    assert size <= 8e6
    assert f"record {name} --seed 1" in (folder / "SOURCE.md").read_text(encoding="utf-8")
    scenario = load_suite(BUNDLED).find(name)
    assert len(load_map(folder / "map.yaml")) == scenario.world.markers.count
    assert load_config(folder / "robot.yaml").wheels.track == scenario.robot.track_m


@pytest.mark.parametrize("name", NAMES)
def test_sample_was_recorded_from_the_scenario_of_its_name(name: str) -> None:
    described = yaml.safe_load((SAMPLES / name / "scenario.yaml").read_text(encoding="utf-8"))
    assert described["seed"] == 1
    assert described["camera"] is True
    assert Scenario.model_validate(described["scenario"]) == load_suite(BUNDLED).find(name)
