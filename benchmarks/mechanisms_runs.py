"""Cells of `benchmarks.mechanisms`, their figures kept as JSON in the cache.

The run with all mechanisms on counts where each of them acts; where one does not, its own run would be the same, and is
not made. Files are named as in `benchmarks.installed_runs`, and by what the mechanism's switches do.
"""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import cache
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.installed_recordings import folder
from benchmarks.installed_runs import Cell as InstalledCell
from benchmarks.installed_runs import kept, run_cell
from benchmarks.installed_scores import Scores
from benchmarks.mechanisms_cells import Cell, Outcome, run
from benchmarks.mechanisms_off import BY_NAME, MECHANISMS
from benchmarks.mechanisms_switch import JOIN, Mechanism, probes_signature, together

_ROOT = Path(__file__).resolve().parent
_SCORING = ("adaptive_scores.py", "mechanisms_cells.py")
_ROBOTS = ("adaptive_mrclam.py", "mechanisms_robots.py")


def run_all(cells: Iterable[Cell], jobs: int) -> dict[Cell, Outcome]:
    """Outcomes of all cells, from the cache or run now; a process keeps to one recording at a time."""
    ordered = sorted(set(cells), key=lambda cell: (str(cell.source), cell.case, cell.off))
    groups = [list(group) for _, group in groupby(ordered, key=lambda cell: cell.source)]
    found: dict[Cell, Outcome] = {}
    began = time.monotonic()
    for done in parallel(_run_group, groups, jobs):
        found.update(done)
        print(f"{len(found)} of {len(ordered)} cells, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    return found


def run_plain(cells: Sequence[InstalledCell], jobs: int) -> dict[InstalledCell, Scores]:
    """Scores of cells of `benchmarks.installed`."""
    return dict(parallel(_run_installed, sorted(cells), jobs))


def parallel(work: Callable[[Any], Any], items: Sequence[Any], jobs: int) -> Iterator[Any]:
    """Results of the work for the items, in any order; computed in this process if there is one job."""
    if jobs == 1 or len(items) < 2:
        yield from map(work, items)
        return
    with ProcessPoolExecutor(min(jobs, len(items)), get_context("spawn")) as pool:
        for job in as_completed([pool.submit(work, item) for item in items]):
            yield job.result()


def _run_installed(cell: InstalledCell) -> tuple[InstalledCell, Scores]:
    return cell, Scores.from_json(kept(cell.name, lambda: run_cell(cell).as_json()))


def _run_group(cells: Sequence[Cell]) -> dict[Cell, Outcome]:
    return {cell: outcome(cell) for cell in cells}


def outcome(cell: Cell) -> Outcome:
    """Figures of one cell; of mechanisms that do not act, those of the run with all of them on."""
    if not cell.off:
        return Outcome.from_json(kept(file_name(cell), lambda: asdict(run(cell))))
    alone = [BY_NAME[name] for name in cell.off.split(JOIN)]
    if all(m.probe for m in alone):
        on = outcome(Cell(cell.source, cell.case))
        if not any(on.acted.get(m.name) for m in alone):
            return on
    if len(alone) == 1:
        return Outcome.from_json(kept(file_name(cell), lambda: asdict(run(cell))))
    with named(cell.off).off():
        return Outcome.from_json(kept(file_name(cell), lambda: asdict(run(Cell(cell.source, cell.case)))))


def named(off: str) -> Mechanism:
    """A mechanism, or several whose names are joined."""
    return BY_NAME[off] if JOIN not in off else together([BY_NAME[name] for name in off.split(JOIN)])


@cache
def _scoring(robots: bool) -> str:
    names = _SCORING + _ROBOTS if robots else _SCORING
    return hashlib.sha256(b"".join((_ROOT / name).read_bytes() for name in names)).hexdigest()[:8]


def file_name(cell: Cell) -> str:
    """Name of the file that keeps a cell's outcome."""
    where = f"robot{cell.source}" if isinstance(cell.source, int) else folder(cell.source)
    if cell.off:
        what = f"off_{'together' if JOIN in cell.off else cell.off}_{named(cell.off).signature}"
    else:
        what = f"on_{probes_signature(MECHANISMS)}"
    return f"mechanisms_{what}_{cell.case}_{where}_{_scoring(isinstance(cell.source, int))}"
