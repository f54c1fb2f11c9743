"""benchmarks.compare: what counts as a change between two files of rows."""

from __future__ import annotations

import json

import pytest

from benchmarks.common import Row, main
from benchmarks.compare import main as compare_files
from benchmarks.compare import verdict


def row(value, spread=None, n=1):
    return {"id": "a", "value": value, "spread": spread, "n": n, "unit": ""}


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (row(1.0), row(1.0), ""),
        (row(1.0), row(1.001), "changed"),  # no spread: any difference is one
        (row(1.0, 0.1, 4), row(1.2, 0.1, 4), ""),  # bound: 3 * hypot(0.05, 0.05) = 0.212
        (row(1.0, 0.1, 4), row(1.22, 0.1, 4), "changed"),
        (row(1.0, 0.1, 1), row(1.22, 0.1, 1), ""),  # one run each says less
        (row(1.0), row(float("nan")), "changed"),
        (row(None), row(None), ""),
        (row(None), row(1.0), "run now"),
        (row(1.0), row(None), "not run now"),
        (None, row(1.0), "new"),
        (row(1.0), None, "gone"),
    ],
)
def test_verdict(old, new, expected):
    assert verdict(old, new) == expected


def test_reads_what_benchmarks_write(tmp_path, capsys):
    files = [tmp_path / "old.json", tmp_path / "new.json"]
    for file, value in zip(files, (1.0, 2.0), strict=True):
        rows = [Row("kept", 3.0), Row("moved", value, 0.1, 5, "m")]
        main(lambda _, rows=rows: rows, "rows", ["--json", str(file)])
    capsys.readouterr()
    assert compare_files([str(file) for file in files]) == 1
    assert "moved" in capsys.readouterr().out
    assert compare_files([str(files[0])] * 2) == 0


def test_refuses_what_no_benchmark_wrote(tmp_path):
    file = tmp_path / "other.json"
    file.write_text(json.dumps({"id": 1}), encoding="utf-8")
    with pytest.raises(SystemExit, match=r"other\.json.*--json"):
        compare_files([str(file), str(file)])
