"""Parts that all benchmarks share: folders, rows, the printed table, ``--quick`` and ``--json``."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SAMPLES = ROOT / "datasets" / "samples"
MODELS = ROOT / "fgloc" / "sensors" / "learned" / "models" / "mrclam"
DATA = Path(os.environ.get("FGLOC_REAL_DATA", ROOT / "real-data"))
"""Folder of recordings that others made."""


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. ``value`` is None, and ``reason`` is why, if it was not run."""

    id: str
    value: float | None
    spread: float | None = None  # standard deviation over the n runs
    n: int = 1
    unit: str = ""
    reason: str = ""


def mean_row(row_id: str, values: Iterable[float], unit: str = "") -> Row:
    """Mean of several runs, with their standard deviation."""
    held = np.array(list(values), dtype=float)
    return Row(row_id, float(held.mean()), float(held.std()), len(held), unit)


def ratio_row(row_id: str, values: Iterable[float], over: Iterable[float], unit: str = "") -> Row:
    """Mean of several runs over that of others; the spread is that of the single ratios."""
    first, second = (np.array(list(of_all), dtype=float) for of_all in (values, over))
    return Row(row_id, float(first.mean() / second.mean()), float(np.std(first / second)), len(first), unit)


def stamp_of(header: Any) -> int:
    """Stamp of a message's header [ns]."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def not_run(ids: Iterable[str], reason: str) -> list[Row]:
    """Rows without a value, with the reason."""
    return [Row(name, None, n=0, reason=reason) for name in ids]


def main(measure: Callable[[bool], Iterable[Row]], description: str, argv: Sequence[str] | None = None) -> list[Row]:
    """Run a benchmark from the command line: print its table, write its JSON.

    Args:
        measure: given whether this is a quick run, yields the rows.
        description: for ``--help``.
        argv: instead of the command line's.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="a smoke run; its figures are not to be quoted")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows as JSON")
    arguments = parser.parse_args(argv)
    rows = []
    for row in measure(arguments.quick):
        rows.append(row)
        print(*_cells(row)[:2], file=sys.stderr, flush=True)  # of a run that is interrupted these are there
    print(table(rows))
    if arguments.quick:
        print("quick run: not to be quoted")
    if arguments.json is not None:
        content = [{key: value for key, value in asdict(row).items() if key != "reason"} for row in rows]
        arguments.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return rows


def table(rows: Sequence[Row]) -> str:
    """Rows as text, those not run with their reason."""
    head = ("id", "value", "spread", "n", "unit")
    cells = [head, *(_cells(row) for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(head))]
    justify = (str.ljust, str.rjust, str.rjust, str.rjust, str.ljust)
    return "\n".join(
        "  ".join(just(cell, width) for just, cell, width in zip(justify, line, widths, strict=True)).rstrip()
        for line in cells
    )


def _cells(row: Row) -> tuple[str, ...]:
    if row.value is None:
        return (row.id, "not run", "", "", row.reason)
    return (row.id, f"{row.value:.4g}", "" if row.spread is None else f"{row.spread:.2g}", str(row.n), row.unit)
