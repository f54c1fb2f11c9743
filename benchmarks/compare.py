"""Changed rows of a benchmark: ``python -m benchmarks.compare OLD.json NEW.json``.

Both files come from ``python -m benchmarks.NAME --json FILE``. A row changed if its values differ by more than what
their spreads explain: three standard errors of the difference, from both spreads and both numbers of runs. Rows without
a spread changed if their values differ at all.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

STANDARD_ERRORS = 3.0  # of a difference that counts as a change: one row in 370 exceeds it by chance

Row = Mapping[str, Any]


def read_rows(path: Path) -> dict[str, Row]:
    """Rows of a benchmark's file, by id.

    Raises:
        SystemExit: the file is missing, is not JSON, or is no list of rows.
    """
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        return {row["id"]: row for row in rows}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise SystemExit(f"{path}: {error!r}; expected a file that a benchmark wrote with --json") from error


def verdict(old: Row | None, new: Row | None) -> str:
    """Change of a row: "" within its spread, "changed", "new", "gone", "not run now" or "run now"."""
    if old is None or new is None:
        return "new" if old is None else "gone"
    before, after = old["value"], new["value"]
    if before is None or after is None:
        return "" if before is after else ("run now" if before is None else "not run now")
    difference = abs(after - before)
    bound = STANDARD_ERRORS * math.hypot(standard_error(old), standard_error(new))
    return "changed" if not difference <= bound and before != after else ""


def standard_error(row: Row) -> float:
    """Standard error of a row's value; 0 without a spread."""
    return (row["spread"] or 0.0) / math.sqrt(max(row["n"], 1))


def compare(old: Mapping[str, Row], new: Mapping[str, Row]) -> list[tuple[str, str]]:
    """``(id, verdict)`` of all rows, the new file's order first."""
    names = [*new, *(name for name in old if name not in new)]
    return [(name, verdict(old.get(name), new.get(name))) for name in names]


def _shown(row: Row | None) -> str:
    if row is None or row["value"] is None:
        return "-"
    return f"{row['value']:.5g}" + ("" if row["spread"] is None else f" ± {row['spread']:.2g}")


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows that changed; returns how many did."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("old", type=Path, metavar="OLD.json")
    parser.add_argument("new", type=Path, metavar="NEW.json")
    arguments = parser.parse_args(argv)
    old, new = read_rows(arguments.old), read_rows(arguments.new)
    rows = compare(old, new)
    changed = [(name, how) for name, how in rows if how]
    for name, how in changed:
        print(f"{name:48} {_shown(old.get(name)):>20} -> {_shown(new.get(name)):20} {how}")
    print(f"{len(rows)} rows, {len(changed)} changed beyond their spread")
    return len(changed)


if __name__ == "__main__":
    raise SystemExit(1 if main() else 0)
