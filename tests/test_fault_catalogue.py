"""docs/decisions/faults.md and the tests named after its rows agree."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

TESTS = Path(__file__).resolve().parent
PAGE = TESTS.parent / "docs" / "decisions" / "faults.md"
_TEST = re.compile(r"^\s*def test((?:_(?:and|fault)_\d\d(?=_))+)_\w+\(", re.MULTILINE)
_ROW = re.compile(r"^\| (\d+) \| [^|]+ \| [^|]+ \|$", re.MULTILINE)


def faults_tested() -> dict[int, list[str]]:
    """Number of a fault -> the files that test it."""
    found: dict[int, list[str]] = defaultdict(list)
    for path in sorted(TESTS.rglob("test_*.py")):
        for names in _TEST.findall(path.read_text(encoding="utf-8")):
            for number in re.findall(r"\d\d", names):
                found[int(number)].append(path.stem)
    return found


def test_each_fault_has_tests_and_each_test_a_fault():
    rows = [int(number) for number in _ROW.findall(PAGE.read_text(encoding="utf-8"))]
    assert sorted(rows) == list(range(1, len(rows) + 1))
    assert len(rows) > 70
    assert sorted(faults_tested()) == sorted(rows)


def test_a_test_may_cover_two_faults():
    assert "test_faults_diagnosis" in faults_tested()[52]
    assert "test_localizer" in faults_tested()[68]
