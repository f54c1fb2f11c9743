"""The net around refactorings: what its hashes tell apart, its verdicts, and its committed file."""

import numpy as np
import pytest

from benchmarks.equal import EXPECTED, committed, described, digest, verdict
from benchmarks.equal_cases import CASES, RECORDED, Drive, recordings_of

ROWS = np.arange(60.0).reshape(10, 6)


def outcome(**changes):
    return described({"poses": ROWS, "modes": ["OK"], "findings": [("clock.back", 1, None)], "rows": ROWS} | changes)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1.0, np.nextafter(1.0, 2.0)),
        (0.0, -0.0),
        (1, 1.0),
        ("1", 1),
        (None, "None"),
        (["a", "bc"], ["ab", "c"]),
        ([[1], 2], [[1, 2]]),
        (np.zeros((2, 3)), np.zeros((3, 2))),
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
    ],
)
def test_other_values_have_other_hashes(one, other):
    assert digest(one) == digest(one)
    assert digest(one) != digest(other)


def test_a_value_without_a_hash_is_refused():
    with pytest.raises(TypeError, match=r"\bset\b"):
        digest({1})


def test_verdicts_name_the_aspects_that_differ():
    assert verdict(outcome(), outcome()) == ("equal", True)
    nearly = outcome(poses=ROWS + 1e-11, rows=ROWS + 1e-11)
    assert verdict(nearly, outcome()) == ("rounded: 1e-11", True)
    assert verdict(outcome(modes=["LOST"]), outcome()) == ("DIFFERS: modes", False)
    assert verdict(outcome(poses=ROWS + 1e-3, rows=ROWS + 1e-3), outcome()) == ("DIFFERS: poses (0.001)", False)
    other = [("clock.back", 1, 0.5)]
    assert verdict(outcome(findings=other), outcome()) == ("DIFFERS: findings", False)
    assert verdict(nearly | {"modes": ""}, outcome())[0].startswith("DIFFERS: modes, poses")
    assert verdict(None, outcome()) == ("DIFFERS: no result", False)
    assert verdict(outcome(), None) == ("DIFFERS: not in the committed file", False)


def test_texts_are_never_rounded():
    said, other = (described({"said": text}) for text in ("0.1234", "0.1235"))
    assert verdict(said, other) == ("DIFFERS: said", False)


def test_the_committed_file_has_all_cases_and_is_small():
    assert committed().keys() == CASES.keys()
    assert EXPECTED.stat().st_size < 60_000
    assert set().union(*map(recordings_of, CASES)) == RECORDED.keys()


def test_a_drive_is_the_same_each_time(tmp_path):
    for name in ("one", "other"):
        Drive("poses", seconds=3.0).write(tmp_path / name)
    one, other = ((tmp_path / name / "bag" / "bag.mcap").read_bytes() for name in ("one", "other"))
    assert one == other
