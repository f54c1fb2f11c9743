"""What counts as named in `benchmarks.gross`."""

from __future__ import annotations

import re

import pytest

from benchmarks.gross import MISTAKES, names
from fgloc.types import Finding, Severity


@pytest.mark.parametrize(
    ("code", "value", "named"),
    [("map.size", 1.05, True), ("map.size", 1.2, False), ("map.size", None, False), ("map.unit", 1.05, False)],
)
def test_only_the_code_with_the_right_figure_counts(code, value, named):
    assert names(MISTAKES["size_0.95"].said, Finding(code, "Text.", Severity.ERROR, value=value)) is named


def test_every_pattern_is_one_and_no_usual_note_matches():
    usual = Finding("run", "/odom: pose covariance is zero; the configured default is used.")
    for mistake in MISTAKES.values():
        re.compile(mistake.said)
        assert not names(mistake.said, usual)
