"""Effect of each mechanism: ``python -m benchmarks.mechanisms [--quick] [--json FILE] [--split validation]``.

Every adaptive mechanism of fgloc (`benchmarks.mechanisms_off`) is taken away by itself, under failures of
`benchmarks.installed` and others, on simulated recordings as installed, and on robots of MRCLAM 6, whose landmarks are
beacons (``robot_*``, online).

- ``mechanisms.without_effect``: those whose removal worsens nothing, as `benchmarks.mechanisms_effect` defines it. Each
  is taken away under the failure that it is for, and, only if nothing gets worse there, under one after another of
  the rest. ``off.together.*`` is with all of these off at once, or with those that ``--together`` names.
- ``off.*``: mean over the seeds with the mechanism off over that with it on; spreads are of the single ratios. They are
  of the failures that were run for the row before, or of all of them (hours) with ``--rows off.``.
- ``rules66.*``: ATE of the textbook's pipeline with three rules over that of fgloc without learned motion, online.
- ``*.over_before``: ATE over that of an earlier file of `benchmarks.installed`, given by ``--before``.
- ``motion.*``: slips on the floors of ``none``, ``slip`` and ``mu01``; recall is of slips of 3 cm and more.
- ``landmark.named``: share of landmarks moved by 0.3, 0.7 and 1.5 m that are named; ``.false``: others that are named,
  per run, in these runs and with 10, 30 and 50 % of the ids misread.
- ``kidnap.nees_while_lifted``, ``lifted.nees_while_lifted``: NEES/3 from when a robot is carried away until the first
  marker that it sees again; the recording without that time, and with it.

Settings are chosen on the validation split; the rows are of the test split. Finished cells are kept, so that an
interrupted run goes on; ``--jobs`` processes share the work.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.adaptive_recordings import Split
from benchmarks.common import Row, main, not_run
from benchmarks.installed_recordings import SEEDS, Take, prepare
from benchmarks.installed_runs import Cell as InstalledCell
from benchmarks.installed_runs import floor
from benchmarks.mechanisms_off import BY_NAME, MECHANISMS
from benchmarks.mechanisms_report import cells, order, report, without_effect
from benchmarks.mechanisms_robots import SOURCE
from benchmarks.mechanisms_rows import CASES, Outcomes, Scope, Wanted, of_one, over_before, wanted
from benchmarks.mechanisms_runs import run_all, run_plain
from benchmarks.mechanisms_switch import Mechanism, together
from fgloc_datasets import mrclam
from fgloc_datasets.sim.camera import RenderError

RULES = "corners_rules"
RULES_CASES = ("none", "slip", "mu01", "dark30", "ids30", "moved", "frozen", "onewheel")
QUICK_CASES, QUICK_MECHANISMS = ("none", "slip"), ("disagreement_test", "misread_ids")
_SEEDS: dict[Split, tuple[int, ...]] = {"validation": SEEDS["validation"][:3], "test": SEEDS["test"]}


@dataclass(frozen=True, slots=True)
class Options:
    """Options of the command line."""

    split: Split = "test"
    prefixes: tuple[str, ...] = ("",)
    before: Path | None = None
    seeds: int | None = None
    together: tuple[str, ...] = ()
    jobs: int = os.cpu_count() or 1

    @property
    def every_mechanism(self) -> bool:
        """Whether rows of mechanisms were asked for by name."""
        return any(prefix.startswith("off.") for prefix in self.prefixes)

    def wants(self, row_id: str) -> bool:
        """Whether a row was asked for."""
        return row_id.startswith(self.prefixes)


def scope(quick: bool, options: Options) -> Scope:
    """Scope of a run; a quick one has one seed, two cases, two mechanisms and no robot."""
    seeds = _SEEDS[options.split][: 1 if quick else options.seeds]
    robots = mrclam.ROBOTS if options.split == "test" else mrclam.ROBOTS[: len(seeds)]
    return Scope(
        options.split,
        seeds,
        () if quick or not SOURCE.is_dir() else tuple(robots),
        QUICK_CASES if quick else CASES,
        tuple(BY_NAME[name] for name in QUICK_MECHANISMS) if quick else MECHANISMS,
    )


def measure(quick: bool, options: Options) -> Iterator[Row]:
    """The rows whose ids begin with one of the prefixes; of mechanisms to be off together, their rows alone."""
    chosen = scope(quick, options)
    if options.together:
        yield from _together(chosen, [BY_NAME[name] for name in options.together], {}, options)
        return
    if options.wants("mechanisms.kept"):
        yield Row("mechanisms.kept", len(MECHANISMS))
    try:
        yield from _of_runs(chosen, options)
        cases = [case for case in RULES_CASES if case in chosen.cases and options.wants(_rules_id(case))]
        yield from rules66(chosen, cases, options.jobs)
    except RenderError as error:
        yield from not_run([w.id for w in wanted(chosen) if options.wants(w.id)], str(error))


def _of_runs(chosen: Scope, options: Options) -> Iterator[Row]:
    every = [w for w in wanted(chosen) if w.cells]
    before = _earlier(options.before)
    rows = [w for w in every if _wanted(w, options) and (options.every_mechanism or not w.id.startswith("off."))]
    effect = options.wants("mechanisms.without_effect")
    prepare(cell.source for w in (every if effect else rows) for cell in w.cells if isinstance(cell.source, Take))
    found: Outcomes = run_all({cell for w in rows for cell in w.cells}, options.jobs)
    if effect:
        found = taken_away(chosen, found, options.jobs)
        useless = without_effect(chosen, found)
        yield Row("mechanisms.without_effect", len(useless), n=len(chosen.mechanisms))
        print(report(chosen, found))
        yield from _together(chosen, [BY_NAME[name] for name in useless], found, options)
        more = [w for w in every if w.id.startswith("off.") and w not in rows]
        rows += [w for w in more if all(cell in found for cell in w.cells)]
    for w in rows:
        row = w.row(w.id, found)
        if options.wants(w.id) or w.id.startswith("off."):
            yield row
        name = w.id.replace(".ate_mm", ".over_before")
        if w.id.endswith(".ate_mm") and before is not None and options.wants(name):
            yield over_before(name, row, before)


def taken_away(chosen: Scope, found: Outcomes, jobs: int) -> Outcomes:
    """Outcomes without each mechanism, under one failure after another until something gets worse."""
    pending = {m.name: order(chosen, m) for m in chosen.mechanisms}
    while pending:
        tried = {name: cases[0] for name, cases in pending.items()}
        pairs = [pair for name, case in tried.items() for pair in cells(chosen, BY_NAME[name], case)]
        found = {**found, **run_all({cell for pair in pairs for cell in pair if cell not in found}, jobs)}
        useless = without_effect(chosen, found)
        pending = {name: cases[1:] for name, cases in pending.items() if name in useless and cases[1:]}
    return found


def _together(chosen: Scope, useless: Sequence[Mechanism], found: Outcomes, options: Options) -> Iterator[Row]:
    """Several off at once, such as those without effect by themselves: one may do the work of another one."""
    if len(useless) < 2:
        return
    rows = [w for case in chosen.all_cases for w in of_one(chosen, together(useless), case, "together")]
    at_once = {**found, **run_all({cell for w in rows for cell in w.cells}, options.jobs)}
    yield from (w.row(w.id, at_once) for w in rows)


def _wanted(w: Wanted, options: Options) -> bool:
    if w.id.endswith(".ate_mm") and options.before is not None:
        return options.wants(w.id) or options.wants(w.id.replace(".ate_mm", ".over_before"))
    return options.wants(w.id)


def _earlier(path: Path | None) -> Mapping[str, float | None] | None:
    if path is None:
        return None
    return {row["id"]: row["value"] for row in json.loads(path.read_text(encoding="utf-8"))}


def rules66(chosen: Scope, cases: Sequence[str], jobs: int) -> Iterator[Row]:
    """The textbook's pipeline with three rules over fgloc, both without learned motion, online on the same steps."""
    cells = {
        case: [InstalledCell(Take("installed", floor(case), chosen.split, s), case, True) for s in chosen.seeds]
        for case in cases
    }
    found = run_plain([cell for of_case in cells.values() for cell in of_case], jobs)
    for case in cases:
        scores = [found[cell] for cell in cells[case]]
        pairs = [(s.textbook_mm.get(RULES, np.inf), s.online.ate_mm) for s in scores if s.online is not None]
        theirs, ours = np.array(pairs).reshape(-1, 2).T
        if len(pairs) < len(scores) or not np.isfinite(theirs).all():
            yield Row(_rules_id(case), None, n=len(scores), reason="a pose was not found in every run")
        else:
            yield Row(_rules_id(case), float(theirs.mean() / ours.mean()), float(np.std(theirs / ours)), len(scores))


def _rules_id(case: str) -> str:
    return f"rules66.{case}.over_fgloc"


def parsed(argv: Sequence[str] | None = None) -> tuple[Options, list[str]]:
    """Options, and what is left for `benchmarks.common`."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--rows", default="", help="comma-separated beginnings of ids")
    parser.add_argument("--before", type=Path, help="an earlier --json of benchmarks.installed")
    parser.add_argument("--seeds", type=int, help="so many of the split's seeds")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--together", default="", help="names of mechanisms: only the rows with all of them off")
    known, rest = parser.parse_known_args(argv)
    prefixes = tuple(known.rows.split(","))
    at_once = tuple(name for name in known.together.split(",") if name)
    if unknown := sorted(set(at_once) - set(BY_NAME)):
        parser.error(f"no mechanism {', '.join(unknown)}; there are {', '.join(BY_NAME)}")
    return Options(known.split, prefixes, known.before, known.seeds, at_once, known.jobs), rest


if __name__ == "__main__":
    options, rest = parsed()
    main(lambda quick: measure(quick, options), __doc__ or "", rest)

__all__ = ["Options", "Outcomes", "measure", "parsed", "scope"]
