"""The settings that a finding names are those of the sensor that the run has."""

from dataclasses import replace

import numpy as np
import pytest
from robot_world import CAMERA
from run_results import figure_eight

from fgloc.evaluation.metrics import all_findings
from fgloc.types import InstallationFound


@pytest.mark.parametrize(("cameras", "section"), [((CAMERA,), "markers."), ((), "landmarks.")])
def test_dropped_sightings_name_the_noise_of_corners_or_of_places(cameras, section):
    found = InstallationFound((), np.zeros(0), np.eye(0), np.eye(0), cameras, "sightings", "odometry")
    result = replace(figure_eight(), found=found)
    said = all_findings(result, None, {"sightings.gate": 400}, len(result.trajectory))
    (dropped,) = [finding for finding in said if finding.code == "sightings.dropped"]
    assert section in dropped.text
    assert ({"markers.", "landmarks."} - {section}).pop() not in dropped.text
    assert "map." not in dropped.text  # none was given
