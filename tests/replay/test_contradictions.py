"""A constant beyond the gate of its prior is held, and what explains the recording is named by its cost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mistaken_robot import write_mistaken
from real_data import real_data
from robot_world import config

from fgloc.config import Config
from fgloc.runner import RunResult, run
from fgloc.stats import PRIOR_GATE
from fgloc.types import Finding, Severity

SECONDS = 40.0
CODE = "installation.contradiction"


def smoothed(bag: Path, mode="batch", mapped=True, settings: Config | None = None) -> RunResult:
    """Without the checks before a run, which find what is wrong here by themselves."""
    return run(bag, bag.parent / "map.yaml" if mapped else None, settings or config(), mode, check=False)


def contradictions(result: RunResult) -> list[Finding]:
    return [f for f in result.findings if f.code == CODE]


def beyond(result: RunResult) -> list[str]:
    assert result.found is not None
    off = np.abs(result.found.mean) / np.sqrt(np.diag(result.found.prior_cov))
    names = [name for name in result.found.names if not name.startswith("map.")]
    return [name for name, sigmas in zip(result.found.names, off, strict=True) if name in names and sigmas > PRIOR_GATE]


@pytest.fixture(scope="module")
def long_wheels(tmp_path_factory) -> Path:
    return write_mistaken(tmp_path_factory.mktemp("wheels"), wheels=1.2, seconds=SECONDS)


@pytest.mark.parametrize("mode", ["batch", "online"])
def test_a_sound_robot_contradicts_nothing(tmp_path, mode):
    result = smoothed(write_mistaken(tmp_path, seconds=20.0), mode)
    assert not contradictions(result)


def test_wheels_that_report_too_much_are_named_and_keep_what_was_given(long_wheels):
    result = smoothed(long_wheels)
    (finding,) = contradictions(result)
    assert finding.severity is Severity.ERROR
    assert float(finding.lines["wheels.scale_v"]) == pytest.approx(1.0 / 1.2, rel=0.02)
    assert not beyond(result)
    given = {s.name: s for s in result.found.settings}["wheels.scale_v"]
    assert given.found == pytest.approx(given.given)
    assert given.sigma == pytest.approx(given.prior_sigma, rel=0.1)  # the prior's, and not that of a guess


@pytest.mark.parametrize("kind", ["fixed_lag", "isam2", "ekf"])
def test_online_the_prior_holds_and_the_run_says_so(long_wheels, kind):
    settings = config(estimator={"kind": kind})
    result = smoothed(long_wheels, "online", settings=settings)
    (finding,) = contradictions(result)
    assert finding.severity is Severity.ERROR
    assert not finding.lines
    assert not beyond(result)


@pytest.mark.slow
def test_a_range_scale_is_found_with_the_sightings_that_were_refused_online(tmp_path):
    (finding,) = contradictions(smoothed(write_mistaken(tmp_path, range_scale=0.92, seconds=SECONDS)))
    assert finding.lines.keys() == {"expert.landmarks.range_scale"}
    assert finding.value == pytest.approx(1.0 / 0.92, rel=0.01)


def test_a_late_clock_is_no_bias_of_the_bearing(tmp_path):
    result = smoothed(write_mistaken(tmp_path, late_s=0.15, gyro=True, seconds=SECONDS))
    (finding,) = contradictions(result)
    assert finding.lines.keys() == {"recording.stamp_offset_s"}
    assert not beyond(result)


@pytest.mark.parametrize("mode", ["batch", "online"])
def test_wheels_and_gyro_that_disagree_move_no_constant_without_sightings(tmp_path, mode):
    bag = write_mistaken(tmp_path, wheel_turn=7.0, gyro=True, sightings=False, seconds=20.0)
    assert not beyond(smoothed(bag, mode, mapped=False))


@pytest.mark.slow
def test_without_a_map_ranges_or_wheels_are_named_together(tmp_path):
    bag = write_mistaken(tmp_path, range_scale=0.75, seconds=SECONDS)
    (finding,) = contradictions(smoothed(bag, mapped=False))
    assert not finding.lines
    assert "wheels.scale_v" in finding.text
    assert "landmarks.range_scale" in finding.text


@pytest.mark.real_data
def test_a_batch_without_a_map_never_runs_away():
    """Marker positions in optical axes, read as if they were the base's."""
    settings = Config.model_validate({"truth": {"align": "se2"}, "recording": {"received_stamps": ["odometry"]}})
    result = run(real_data("pioneer_aruco", "duarte.bag"), None, settings, "batch", check=False)
    assert np.hypot(*result.trajectory.poses[:, :2].T).max() < 30.0
    assert not beyond(result)
    assert not any(finding.lines for finding in contradictions(result))
