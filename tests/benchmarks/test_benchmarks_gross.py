"""What counts as named in `benchmarks.gross`."""

from __future__ import annotations

import re

import pytest

from benchmarks.gross import MISTAKES, names


@pytest.mark.parametrize(
    ("sentence", "named"),
    [
        ("The markers' size is 0.19 m by the map: set size: 0.1995 in the map.", True),
        ("The markers' size is 0.19 m by the map: set size: 0.22 in the map.", False),  # not the true one
        ("The markers' size is wrong.", False),
        ("Something else is wrong. The markers' size: set size: 0.2.", False),  # not in the first sentence
    ],
)
def test_only_the_first_sentence_with_the_right_value_counts(sentence, named):
    assert names(MISTAKES["size_0.95"].said, sentence) is named


def test_every_pattern_is_one_and_no_usual_note_matches():
    usual = "/odom: pose covariance is zero; the configured default is used."
    for mistake in MISTAKES.values():
        re.compile(mistake.said)
        assert not names(mistake.said, usual)
