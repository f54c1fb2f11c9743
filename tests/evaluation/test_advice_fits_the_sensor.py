"""The settings that a finding names are those of the sensor that the run has."""

from dataclasses import replace

import numpy as np
import pytest
from robot_world import CAMERA
from run_results import figure_eight

from fgloc.config import config_of
from fgloc.evaluation.metrics import all_findings
from fgloc.types import Finding, InstallationFound, Setting, Severity


def test_the_prior_of_a_drive_is_that_of_its_section_and_dead_reckoning_has_noise():
    settings = (Setting("wheels.drive.half_sum", 0.35, 0.35, 0.01, 0.01),)
    found = InstallationFound((), np.zeros(0), np.eye(0), np.eye(0), (), "", "joints", settings)
    config = config_of(
        {"wheels": {"drive": {"kind": "mecanum", "wheels": list("abcd"), "half_sum": 0.35, "radius": 0.05}}}
    )
    result = replace(figure_eight(), found=found, config=config, landmarks=None)
    (said,) = [f.text for f in all_findings(result, 9.0, {}, 50) if f.code == "covariance.optimistic"]
    assert "wheels.drive.sigmas" in said
    assert "expert.wheels.noise" in said
    assert "wheels.scale_sigma" not in said


def test_a_doubtful_truth_is_mended_before_any_sigma():
    doubted = replace(figure_eight(), findings=(Finding("truth.jumps", "It jumps.", Severity.WARNING),))
    said = [f.text for f in all_findings(doubted, 9.0, {}, 50) if f.code == "covariance.optimistic"]
    assert len(said) == 1
    assert "truth.jumps" in said[0]
    assert "sigma" not in said[0]


def test_a_motion_model_that_reads_no_command_is_named():
    result = figure_eight()
    n = len(result.trajectory)
    codes = [{f.code for f in all_findings(result, None, {"learned.no_commands": k}, n)} for k in (n, n // 2)]
    assert ["learned.unused" in each for each in codes] == [True, False]


@pytest.mark.parametrize(("cameras", "section"), [((CAMERA,), "markers."), ((), "landmarks.")])
def test_dropped_sightings_name_the_noise_of_corners_or_of_places(cameras, section):
    found = InstallationFound((), np.zeros(0), np.eye(0), np.eye(0), cameras, "sightings", "odometry")
    result = replace(figure_eight(), found=found)
    said = all_findings(result, None, {"sightings.gate": 400}, len(result.trajectory))
    (dropped,) = [finding for finding in said if finding.code == "sightings.dropped"]
    assert section in dropped.text
    assert ({"markers.", "landmarks."} - {section}).pop() not in dropped.text
    assert "map." not in dropped.text  # none was given


@pytest.mark.parametrize(
    ("reason", "remedy"),
    [("duplicate_stamp", "recording.received_stamps: [sightings]"), ("unknown_id", "fgloc map")],
)
def test_what_was_dropped_by_no_noise_is_not_put_down_to_it(reason, remedy):
    result = figure_eight()
    counts = {f"sightings.{reason}": 400, "sightings.gate": 20}
    said = all_findings(result, None, counts, len(result.trajectory))
    (dropped,) = [finding for finding in said if finding.code == "sightings.dropped"]
    assert remedy in dropped.text
    assert "sigma" not in dropped.text
