"""The frame of all benchmarks: table, JSON, rows that were not run."""

import json

from benchmarks.common import Row, main, not_run, table


def test_rows_are_printed_and_written(tmp_path, capsys):
    def measure(quick):
        yield Row("a.ate_mean_m", 0.0123456 if quick else 0.02, 0.001, 5, "m")
        yield from not_run(["b.ate_mean_m"], "no recordings")

    rows = main(measure, "a benchmark", ["--quick", "--json", str(tmp_path / "rows.json")])
    assert json.loads((tmp_path / "rows.json").read_text()) == [
        {"id": "a.ate_mean_m", "value": 0.0123456, "spread": 0.001, "n": 5, "unit": "m"},
        {"id": "b.ate_mean_m", "value": None, "spread": None, "n": 0, "unit": ""},
    ]
    printed = capsys.readouterr().out
    assert printed.startswith(table(rows))
    assert "quick" in printed.removeprefix(table(rows))
    head, first, second = table(rows).splitlines()
    assert head.split() == ["id", "value", "spread", "n", "unit"]
    assert first.split() == ["a.ate_mean_m", "0.01235", "0.001", "5", "m"]
    assert second.split() == ["b.ate_mean_m", "not", "run", "no", "recordings"]


def test_full_run_says_nothing_of_quick(capsys):
    main(lambda quick: [Row("x", 1.0 if quick else 2.0)], "a benchmark", [])
    out = capsys.readouterr().out
    assert "quick" not in out
    assert out.splitlines()[1].split() == ["x", "2", "1"]
