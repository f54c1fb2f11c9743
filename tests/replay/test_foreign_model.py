"""A motion model of another robot, as a user may take one that comes with the package."""

from pathlib import Path

import pytest

import fgloc
from fgloc.config import load_config
from fgloc.evaluation.metrics import compute_metrics
from fgloc.runner import run
from fgloc.sensors.base import with_values

MODEL = Path(fgloc.__file__).parent / "sensors" / "learned" / "models" / "mrclam" / "all.safetensors"
SAMPLES = Path(__file__).parent.parent.parent / "datasets" / "samples"
SAMPLE = SAMPLES / "installed_run"


def test_a_model_of_another_robot_is_named_and_left_out():
    folder = SAMPLES / "patches_run"
    foreign = with_values(load_config(folder / "robot.yaml"), "motion", {"model": MODEL})
    result = run(folder / "bag", folder / "map.yaml", foreign, "online")
    assert result.mistakes[0].startswith("The motion model was left out for")
    assert result.notes[0] == result.mistakes[0]
    metrics = compute_metrics(result, result.config)
    assert metrics.ate_mean_m < 0.006  # with it 0.06
    assert metrics.nees_over_3 < 1.4  # with it 358
    reasons = [d.reason for d in result.decisions if d.kind == "learned"]
    assert reasons.count("contradicted") > 0.5 * len(reasons)


@pytest.mark.slow
def test_the_robots_own_model_is_used():
    config = load_config(SAMPLE / "robot.yaml")
    result = run(SAMPLE / "bag", SAMPLE / "map.yaml", config, "online")
    assert not result.mistakes
    assert not any("motion model" in note for note in result.notes)
