"""Runs of a robot that slips, without a map."""

from pathlib import Path

from fgloc.config import load_config
from fgloc.evaluation.metrics import compute_metrics
from fgloc.runner import run
from fgloc.sensors.base import with_values

SAMPLE = Path(__file__).parent.parent.parent / "datasets" / "samples" / "patches_run"


def test_sources_that_differ_end_no_run_without_a_map():
    markers = {"dictionary": "DICT_4X4_50", "default_size_m": 0.2}
    config = with_values(load_config(SAMPLE / "robot.yaml"), "markers", markers)
    result = run(SAMPLE / "bag", None, with_values(config, "truth", {"align": "se2"}), "batch")
    assert any(d.kind == "wheels" and d.reason == "slip" for d in result.decisions)
    assert compute_metrics(result, result.config).ate_mean_m < 0.01
