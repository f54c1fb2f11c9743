"""A motion model of another robot, as a user may take one that comes with the package."""

from pathlib import Path

import numpy as np

import fgloc
from fgloc.config import load_config
from fgloc.evaluation.metrics import compute_metrics
from fgloc.runner import run
from fgloc.sensors.roles import with_values

MODEL = Path(fgloc.__file__).parent / "sensors" / "learned" / "models" / "mrclam" / "all.safetensors"
SAMPLE = Path(__file__).parent.parent.parent / "datasets" / "samples" / "installed_run"


def test_a_model_of_another_robot_is_named_and_not_used():
    config = load_config(SAMPLE / "robot.yaml")
    foreign = with_values(config, "motion", {"model": MODEL})
    result = run(SAMPLE / "bag", SAMPLE / "map.yaml", foreign, "online")
    assert result.mistakes[0].startswith("The motion model is not of this robot: motion.scale would be 1.9")
    assert result.notes[0] == result.mistakes[0]
    assert not result.config.motion.use
    metrics = compute_metrics(result, result.config)
    assert metrics.ate_mean_m < 0.006  # with it 0.09
    assert np.isfinite(metrics.nees_over_3)


def test_the_robots_own_model_is_used():
    config = load_config(SAMPLE / "robot.yaml")
    result = run(SAMPLE / "bag", SAMPLE / "map.yaml", config, "online")
    assert not result.mistakes
    assert result.config.motion.use
