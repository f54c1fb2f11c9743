"""The tests of each fault, for the last column of docs/faults.md: ``python tests/fault_rows.py`` rewrites it."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

TESTS = Path(__file__).resolve().parent
PAGE = TESTS.parent / "docs" / "faults.md"
_TEST = re.compile(r"^\s*def test((?:_(?:and|fault)_\d\d(?=_))+)_\w+\(", re.MULTILINE)
_ROW = re.compile(r"^\| (\d+) \|(.*)\|([^|]*)\|$", re.MULTILINE)


def faults_tested() -> dict[int, list[str]]:
    """Number of a fault -> the files that test it, with how many tests each has."""
    found: dict[int, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for path in sorted(TESTS.rglob("test_*.py"), key=lambda path: path.stem):
        for names in _TEST.findall(path.read_text(encoding="utf-8")):
            for number in re.findall(r"\d\d", names):
                found[int(number)][path.stem.removeprefix("test_")] += 1
    return {
        number: [name if n == 1 else f"{name} ({n})" for name, n in files.items()] for number, files in found.items()
    }


def numbers(page: str) -> list[int]:
    """The numbers of the page's rows."""
    return [int(number) for number, _, _ in _ROW.findall(page)]


def with_tests(page: str) -> str:
    """The page with the last column as the tests are now."""
    tests = faults_tested()
    return _ROW.sub(lambda row: f"| {row[1]} |{row[2]}| {', '.join(tests.get(int(row[1]), []))} |", page)


if __name__ == "__main__":
    PAGE.write_text(with_tests(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
