"""The rows of `benchmarks.mechanisms`: which cells each one is made of, and how."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.adaptive_recordings import Split
from benchmarks.adaptive_runs import CASES as FAILURES
from benchmarks.common import Row
from benchmarks.installed_recordings import Take
from benchmarks.installed_runs import CASES as INSTALLED_CASES
from benchmarks.installed_scores import Errors
from benchmarks.mechanisms_cells import LIKE, OWN_CASES, Cell, Outcome
from benchmarks.mechanisms_effect import MODES, failed, mean, ratio
from benchmarks.mechanisms_robots import ROBOT_CASES
from benchmarks.mechanisms_switch import Mechanism

Outcomes = Mapping[Cell, Outcome]
CASES = (*INSTALLED_CASES, "lifted", *OWN_CASES)
SLIP_CASES = ("none", "slip", "mu01")
MOVED_CASES, MISREAD_CASES = ("moved_30", "moved_70", "moved_150"), ("ids_10", "ids_30", "ids_50")  # cm; percent
_LEAST_M = 0.03  # of a slip


@dataclass(frozen=True, slots=True)
class Wanted:
    """A row, and the runs that it is made of."""

    id: str
    cells: tuple[Cell, ...]
    row: Callable[[str, Outcomes], Row]


@dataclass(frozen=True, slots=True)
class Scope:
    """Scope of a run.

    Attributes:
        split, seeds: of the recordings.
        robots: of MRCLAM 6; empty without its data.
        cases: failures on recordings of the simulator.
        mechanisms: to be switched off.
    """

    split: Split
    seeds: tuple[int, ...]
    robots: tuple[int, ...]
    cases: tuple[str, ...]
    mechanisms: tuple[Mechanism, ...]

    def cells(self, case: str, off: str = "") -> tuple[Cell, ...]:
        """A failure on the recordings of all seeds; ``robot_none`` and so on are those of MRCLAM 6."""
        if case.startswith("robot_"):
            return tuple(Cell(robot, case.removeprefix("robot_"), off) for robot in self.robots)
        like = LIKE.get(case, case)
        floor = FAILURES[like].floor if like in FAILURES else "unequal_radii"
        return tuple(Cell(Take("installed", floor, self.split, seed), case, off) for seed in self.seeds)

    @property
    def all_cases(self) -> tuple[str, ...]:
        """Failures under which mechanisms are switched off; of robots those without wheels."""
        return (*self.cases, *(f"robot_{case}" for case in ROBOT_CASES)) if self.robots else self.cases


def wanted(scope: Scope) -> Iterator[Wanted]:
    """All rows that are made of runs, but for those of `rules66`."""
    for mechanism in scope.mechanisms:
        for case in scope.all_cases:
            yield from of_one(scope, mechanism, case)
    for case in scope.cases:
        cells = scope.cells(case)
        for mode in MODES:
            yield Wanted(f"{case}.{mode}.nees_over_3", cells, _figure(cells, mode, "nees_over_3", ""))
            yield Wanted(f"{case}.{mode}.ate_mm", cells, _figure(cells, mode, "ate_mm", "mm"))
    slips = tuple(cell for case in SLIP_CASES if case in scope.cases for cell in scope.cells(case))
    yield Wanted("motion.delay_s", slips, lambda name, found: _delay(name, [found[c] for c in slips]))
    yield Wanted("motion.false_per_km", slips, lambda name, found: _false(name, [found[c] for c in slips]))
    yield Wanted("motion.recall_3cm", slips, lambda name, found: _recall(name, [found[c] for c in slips]))
    simulated = [scope.cells(case) for case in (*MOVED_CASES, *MISREAD_CASES)]
    robots = [tuple(Cell(robot, case) for robot in scope.robots) for case in (*MOVED_CASES, *MISREAD_CASES)]
    for prefix, groups in (
        ("landmark.", [*simulated, *robots]),
        ("landmark.markers.", simulated),
        ("landmark.beacons.", robots),
    ):
        of_all = tuple(cell for group in groups for cell in group)
        moved = tuple(cell for cell in of_all if cell.case in MOVED_CASES)
        yield Wanted(f"{prefix}named", moved, _named(moved))
        yield Wanted(f"{prefix}false", of_all, _false_names(of_all))
    if "kidnap" in scope.cases:
        for case in ("kidnap", "lifted"):
            yield Wanted(f"{case}.nees_while_lifted", scope.cells(case), _lifted(scope.cells(case)))


def of_one(scope: Scope, mechanism: Mechanism, case: str, label: str = "") -> Iterator[Wanted]:
    """Rows of one mechanism, or of several at once under a label, under one failure."""
    off, on = scope.cells(case, mechanism.name), scope.cells(case)
    modes = MODES if mechanism.batch and not case.startswith("robot_") else MODES[:1]
    for mode in modes:
        for row_id, figure in (("ate_ratio", "ate_mm"), ("nees_over_3", "nees_over_3")):

            def row(name: str, found: Outcomes, mode: str = mode, figure: str = figure) -> Row:
                return ratio(name, [found[c] for c in off], [found[c] for c in on], mode, figure)

            yield Wanted(f"off.{label or mechanism.name}.{case}.{mode}.{row_id}", (*off, *on), row)


def _figure(cells: Sequence[Cell], mode: str, figure: str, unit: str) -> Callable[[str, Outcomes], Row]:
    def row(name: str, found: Outcomes) -> Row:
        outcomes = [found[c] for c in cells]
        errors: list[Errors | None] = [getattr(o, mode) for o in outcomes]
        values = [getattr(e, figure) for e in errors if e is not None]
        return mean(name, values, unit) if len(values) == len(cells) else failed(name, outcomes)

    return row


def _delay(name: str, outcomes: Sequence[Outcome]) -> Row:
    delays = [d for o in outcomes for d in o.delays_s]
    if not delays:
        return Row(name, None, n=0, reason="no slip was found")
    return Row(name, float(np.median(delays)), float(np.std(delays)), len(delays), "s")


def _false(name: str, outcomes: Sequence[Outcome]) -> Row:
    km = sum(o.path_m for o in outcomes) / 1000.0
    alarms = sum(o.false_alarms for o in outcomes)
    return Row(name, alarms / km, None, len(outcomes), "1/km") if km else Row(name, None, n=0, reason="no way")


def _recall(name: str, outcomes: Sequence[Outcome]) -> Row:
    found = [m for o in outcomes for m in o.found_m if m >= _LEAST_M]
    n = len(found) + sum(m >= _LEAST_M for o in outcomes for m in o.missed_m)
    return Row(name, len(found) / n, None, n) if n else Row(name, None, n=0, reason="no slip of 3 cm")


def _named(cells: Sequence[Cell]) -> Callable[[str, Outcomes], Row]:
    """Share of the moved landmarks that are named."""

    def row(name: str, found: Outcomes) -> Row:
        return mean(name, [float(set(o.moved) <= set(o.named)) for c in cells if (o := found[c]).moved])

    return row


def _false_names(cells: Sequence[Cell]) -> Callable[[str, Outcomes], Row]:
    """Landmarks that are named in a run although they were not moved."""

    def row(name: str, found: Outcomes) -> Row:
        return mean(name, [float(len(set(found[c].named) - set(found[c].moved))) for c in cells])

    return row


def _lifted(cells: Sequence[Cell]) -> Callable[[str, Outcomes], Row]:
    """NEES/3 from the lift to the first marker."""

    def row(name: str, found: Outcomes) -> Row:
        values = [nees for c in cells if (nees := found[c].lifted_nees) is not None]
        return (
            mean(name, values) if values else Row(name, None, n=0, reason="a marker was in view at once in every run")
        )

    return row


def over_before(name: str, row: Row, before: Mapping[str, float | None]) -> Row:
    """A row of ATE over that of an earlier file."""
    earlier = before.get(row.id)
    if row.value is None or earlier is None or not math.isfinite(earlier):
        return Row(name, None, n=0, reason=row.reason or f"the earlier file has no {row.id}")
    return Row(name, row.value / earlier, None if row.spread is None else row.spread / earlier, row.n)


__all__ = ["CASES", "Outcomes", "Scope", "Wanted", "over_before", "wanted"]
