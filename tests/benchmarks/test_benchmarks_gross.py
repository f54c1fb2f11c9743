"""What counts as named in `benchmarks.gross`."""

from __future__ import annotations

import re

import pytest

from benchmarks.gross import MISTAKES, names
from fgloc.types import Finding, Severity


@pytest.mark.parametrize(
    ("name", "code", "value", "lines", "named"),
    [
        ("size_0.95", "map.size", 1.05, {}, True),
        ("size_0.95", "map.size", 1.2, {}, False),  # not the true one
        ("size_0.95", "map.size", None, {}, False),
        ("size_0.95", "map.unit", 1.05, {}, False),
        ("camera_yaw_90", "sightings.mounting", None, {"recording.sightings_pose": "[0.1, 0.0, -1e-05]"}, True),
        ("camera_yaw_90", "sightings.mounting", None, {"recording.sightings_pose": "[0.1, 0.0, 1.57]"}, False),
    ],
)
def test_only_the_code_with_the_right_figure_counts(name, code, value, lines, named):
    assert names(MISTAKES[name].said, Finding(code, "Text.", Severity.ERROR, lines, value)) is named


def test_every_pattern_is_one_and_no_usual_note_matches():
    usual = Finding("run", "/odom: pose covariance is zero; the configured default is used.")
    for mistake in MISTAKES.values():
        re.compile(mistake.said)
        assert not names(mistake.said, usual)
