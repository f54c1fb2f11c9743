"""Whether short runs give the results of the committed file: `make equal`, around a refactoring.

One line a case of `benchmarks.equal_cases`. Results are *equal* bit by bit or, as another processor or another order of
sums gives them, *rounded*: the same modes, counts and choices, and poses and standard deviations within 1e-9 of the
committed ones. Else the line names the aspects that differ. Recordings that others made are not in the repository:
their cases are left out where ``FGLOC_REAL_DATA`` is not there. After a change that is meant to change the results:
``python -m benchmarks.equal --write``.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.equal_cases import CASES, OTHERS, RECORDED, Found, recordings_of, there
from fgloc.types import FloatArray

EXPECTED = Path(__file__).with_suffix(".json")
ROUNDING = 1e-9  # m, rad
_ROWS = 4  # keyframes of a case, of which numbers are kept beside the hashes
_BY_VALUE = {"poses", "covs", "decisions", "installation", "findings", "landmarks", "asked", "rest"}
"""Aspects that hold floating-point numbers: rounding may change their bits, but of the poses and covariances too."""
Outcome = dict[str, Any]
"""Hashes by aspect and sampled rows of a case, as the committed file has them."""


def digest(value: Any) -> str:
    """A hash of nested values, of floats bit by bit."""
    hashed = hashlib.sha256()
    for part in _parts(value):
        hashed.update(struct.pack("<q", len(part)) + part)
    return hashed.hexdigest()[:12]


def _parts(value: Any) -> Iterable[bytes]:
    if isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, float | np.floating):
        yield b"f" + struct.pack("<d", value)
    elif isinstance(value, Mapping):
        yield from _parts(list(value.items()))
    elif isinstance(value, list | tuple):
        yield f"{len(value)}".encode()
        for part in value:
            yield from _parts(part)
    elif value is None or isinstance(value, str | int | np.integer):
        yield f"{'s' if isinstance(value, str) else 'i'}{value}".encode()
    else:
        raise TypeError(f"{type(value).__name__} has no hash here")


def described(found: Found) -> Outcome:
    """A hash of each aspect of what a case found, and pose and sigmas ``(6,)`` of a few keyframes."""
    outcome: Outcome = {name: digest(value) for name, value in found.items() if name != "rows"}
    if "rows" in found:
        rows = found["rows"]
        picked = np.unique(np.linspace(0, len(rows) - 1, _ROWS).round().astype(int))
        outcome["rows"] = np.round(rows[picked], 12).tolist()
    return outcome


def verdict(found: Outcome | None, expected: Outcome | None) -> tuple[str, bool]:
    """Comparison of a case with its committed outcome, in words, and whether it is good."""
    if found is None or expected is None:
        return "DIFFERS: " + ("no result" if found is None else "not in the committed file"), False
    names = [*(found.keys() | expected.keys()) - {"rows"}]
    other = sorted(name for name in names if found.get(name) != expected.get(name))
    if not other:
        return "equal", True
    apart = _apart(found.get("rows"), expected.get("rows"))
    if apart <= ROUNDING and {"poses", "covs"} & set(other) and set(other) <= _BY_VALUE:
        return f"rounded: {apart:.1g}", True
    by = f" ({apart:.2g})" if 0.0 < apart < float("inf") else ""
    return f"DIFFERS: {', '.join(other)}{by}", False


def _apart(found: Any, expected: Any) -> float:
    """The largest difference of sampled rows [m, rad]; infinite if there are none or others."""
    if not found or not expected:
        return float("inf")
    a: FloatArray = np.array(found)
    b: FloatArray = np.array(expected)
    return float(np.abs(a - b).max()) if a.shape == b.shape else float("inf")


def results(names: Sequence[str], workers: int) -> Iterator[tuple[str, Outcome | None, float]]:
    """Yield name, outcome (None: it failed) and seconds of the processor of each of these cases."""
    with (
        tempfile.TemporaryDirectory(prefix="fgloc-equal-") as folder,
        ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool,
    ):
        place = Path(folder)
        needed = sorted(set().union(*(recordings_of(name) for name in names)))
        list(pool.map(partial(_recorded, place), needed))
        for name, (outcome, seconds) in zip(names, pool.map(partial(_outcome, place), names), strict=True):
            yield name, outcome, seconds


def _recorded(place: Path, name: str) -> None:
    RECORDED[name](place / name)


def _outcome(place: Path, name: str) -> tuple[Outcome | None, float]:
    began = time.process_time()
    try:
        outcome = described(CASES[name](place=place))
    except Exception:  # a case that fails is one that differs; the others are still compared
        print(f"{name}: {traceback.format_exc()}", file=sys.stderr)
        return None, time.process_time() - began
    return outcome, time.process_time() - began


def chosen(only: str = "") -> tuple[list[str], list[str]]:
    """Cases to be run whose names hold a text, and those whose recordings are not there."""
    absent = {name for name in OTHERS if not there(name)}
    names = [name for name in CASES if only in name]
    left_out = [name for name in names if recordings_of(name) & absent]
    return [name for name in names if name not in left_out], left_out


def committed() -> dict[str, Outcome]:
    """Outcomes of the committed file."""
    return dict(json.loads(EXPECTED.read_text(encoding="utf-8"))) if EXPECTED.is_file() else {}


def differences(workers: int = 1) -> list[str]:
    """Cases whose results differ by more than rounding."""
    expected = committed()
    found = results(chosen()[0], workers)
    return [name for name, outcome, _ in found if not verdict(outcome, expected.get(name))[1]]


def main(
    write: Annotated[bool, typer.Option("--write", help="Make today's results the expected ones.")] = False,
    only: Annotated[str, typer.Option("--only", metavar="TEXT", help="Run the cases whose names hold this.")] = "",
    workers: Annotated[int, typer.Option("--workers", help="Processes side by side.")] = 2,
) -> None:
    """Compare the cases' results with the committed ones; exit code 1 if any differs."""
    began, expected, good = time.perf_counter(), committed(), True
    names, left_out = chosen(only)
    found: dict[str, Outcome | None] = {}
    used_s = 0.0
    for name, outcome, seconds in results(names, workers):
        words, same = verdict(outcome, expected.get(name))
        good = good and same
        found[name], used_s = outcome, used_s + seconds
        print(f"{name:28} {seconds:5.1f} s  {words}", flush=True)
    for name in left_out:
        print(f"{name:28}    -    not there: set FGLOC_REAL_DATA")
    for name in () if only else sorted(expected.keys() - CASES.keys()):
        print(f"{name:28}    -    DIFFERS: no such case")
        good = False
    print(f"{len(found)} cases in {time.perf_counter() - began:.0f} s, {used_s:.0f} s of the processor")
    if write:
        kept = {name: outcome for name, outcome in expected.items() if name in CASES}
        kept |= {name: outcome for name, outcome in found.items() if outcome is not None}
        rows = [f" {json.dumps(name)}: {json.dumps(kept[name])}" for name in CASES if name in kept]
        EXPECTED.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
        good = None not in found.values()
    if not good:
        sys.exit(1)


if __name__ == "__main__":
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # of the workers
    typer.run(main)
