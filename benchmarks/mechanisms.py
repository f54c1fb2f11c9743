"""Effect of each mechanism: ``python -m benchmarks.mechanisms [--quick] [--json FILE] [--seeds N] [--rows ID,...]``.

Every adaptive mechanism of fgloc (`benchmarks.mechanisms_off`) is taken away by itself, under failures of
`benchmarks.installed` and others, on simulated recordings as installed, and on robots of MRCLAM 6, whose landmarks are
beacons (``robot_*``, online).

- ``mechanisms.without_effect``: those whose removal worsens nothing. Each is taken away under the failure that it is
  for, on the first two seeds and all robots, and, only if nothing gets worse there, under one after another of the
  rest. So the row is an upper bound: a mechanism that helps in few runs counts as one without effect, and one that
  worsens two seeds by chance as one with. ``--seeds 10`` judges by all seeds.
- ``off.*``: mean with the mechanism off over that with it on; spreads are of the single ratios. They are of the
  failures that were run for the row before: two runs show that a mechanism is needed, not by how much. With
  ``--rows off.`` all failures are run. ``off.together.*`` is with all mechanisms without effect off at once: one may do
  the work of another one.
- ``rules66.*``: ATE of the textbook's pipeline with three rules over that of fgloc without learned motion, online.
- ``motion.*``: slips on the floors of ``none``, ``slip`` and ``mu01``; recall is of slips of 3 cm and more.
- ``landmark.named``: share of landmarks moved by 0.3, 0.7 and 1.5 m that are named; ``.false``: others that are named,
  per run, in these runs and with 10, 30 and 50 % of the ids misread.
- ``kidnap.nees_while_lifted``, ``lifted.nees_while_lifted``: NEES/3 from when a robot is carried away until the first
  marker that it sees again; the recording without that time, and with it.

Rows with everything on are of all seeds of the split. Taking a mechanism away *worsens* a failure if the mean ATE over
the seeds grows by 5 % or more, if ln(NEES/3), of the run or while a robot is lifted, gets farther from the band of 0.7
to 1.4 by 0.05 or more, if more names are wrong or missed, if a run fails, or if one pose in a hundred is missing; it
*improves* it if the ATE falls, the NEES gets nearer or the names get better by as much.

Settings are chosen on the validation split; the rows are of the test split. A whole run takes some 3 h of one core;
finished cells are kept, so that an interrupted run goes on; ``--jobs`` processes share the work.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from benchmarks.common import ROOT, Row, main, mean_row, not_run, ratio_row
from benchmarks.installed import CASES as INSTALLED_CASES
from benchmarks.installed import Cell as InstalledCell
from benchmarks.installed import scores_of
from benchmarks.mechanisms_off import BY_NAME, JOIN, MECHANISMS, Mechanism, together, watched
from benchmarks.recordings import MRCLAM, SEEDS, Floor, Recorded, Split, Take, changed, folder, load, prepare, robot
from benchmarks.replays import FAILURES, Replayed, by_recording, failure, floor, parallel, replayed
from benchmarks.scores import (
    Errors,
    Figure,
    Scores,
    Slips,
    kept_scores,
    mean_of,
    named,
    of_errors,
    ratio_of,
    slips,
    trajectory_scores,
)
from fgloc.ablation.failures import MovedMarker
from fgloc.config import Config
from fgloc.errors import FglocError
from fgloc.evaluation.metrics import match_result, nees
from fgloc.runner import RunResult
from fgloc_datasets import mrclam
from fgloc_datasets.sim.camera import RenderError

MODES = ("online", "batch")
FOREIGN = "foreign"  # a case: the motion model is of another robot, one whose landmarks are beacons
PUSHED = "pushed"  # a case: for 0.6 s nothing is recorded, twice, so that the robot is 15 to 20 cm farther on at once
WHEELS = "wheels"  # a case: ``dark60`` of a robot that has wheels and a camera alone
GIVEN = "given"  # a case: the first pose is given and right, while the map is shifted as a whole
CARRIED30 = "carried30"  # a case: carried away, with 30 % of the ids misread
OWN_CASES = (FOREIGN, PUSHED, WHEELS, GIVEN, CARRIED30)
LIKE = {FOREIGN: "slip", WHEELS: "dark60", CARRIED30: "kidnap"}  # the case whose recording they are
CASES = (*INSTALLED_CASES, "lifted", *OWN_CASES)
ROBOT_CASES = ("none", "dropout", "ids30", "moved")  # without wheels nothing slips
SLIP_CASES = ("none", "slip", "mu01")
MOVED_CASES, MISREAD_CASES = ("moved_30", "moved_70", "moved_150"), ("ids_10", "ids_30", "ids_50")  # cm; percent
RULES = "corners_rules"
RULES_CASES = ("none", "slip", "mu01", "dark30", "ids30", "moved", "frozen", "onewheel")
QUICK_CASES, QUICK_MECHANISMS = ("none", "slip"), ("disagreement_test", "misread_ids")
_SEEDS: dict[Split, tuple[int, ...]] = {"validation": SEEDS["validation"][:3], "test": SEEDS["test"]}
_OFF_SEEDS = 2
_PUSHED_S = [[20.0, 20.6], [40.0, 40.6]]
_SHIFTED_M = 0.5
_ROBOTS_DARK_S = (60.0, 120.0)
_WHEELS_ALONE = {"motion": {"use": False}, "gyro": {"use": False}}
_FOREIGN_MODEL = {"motion": {"model": "shipped:mrclam/all"}}
_KINDS = {"frozen": "frozen", "onewheel": "left_wheel_dead"}  # the fault of the wheels in a case
_NAMED_KINDS = {"frozen", "left_wheel_dead", "right_wheel_dead"}
_LEAST_M = 0.03  # of a slip
_ATE, _NEES, _POSES = 1.05, 0.05, 0.99
_BAND = (math.log(0.7), math.log(1.4))
_SCORING = tuple(ROOT / "benchmarks" / f"{name}.py" for name in ("mechanisms", "mechanisms_off"))
_SHOWN = 4  # changes of a mechanism, each way


# --- One cell ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """A case on a recording.

    Attributes:
        source: what is replayed: a recording of the simulator, or the number of a robot of MRCLAM 6.
        case: the failure.
        off: name of the mechanism that is switched off; "" for none.
    """

    source: Take | int
    case: str
    off: str = ""


def run(cell: Cell) -> Scores:
    """Replay and score a case; a failed run has its reason, and the run with everything on is smoothed too."""
    mechanism = BY_NAME.get(cell.off)
    recorded = robot(cell.source) if isinstance(cell.source, int) else load(cell.source)
    seed = cell.source if isinstance(cell.source, int) else cell.source.seed
    try:
        failures = [failure(described) for described in chain(cell.case, recorded)]
    except ValueError as error:  # a drive too short for the failure
        return Scores(failed=str(error))
    smooth = (
        not isinstance(cell.source, int)
        and (cell.case in OWN_CASES or cell.case in FAILURES)
        and (mechanism is None or mechanism.batch)
    )
    watching = watched(MECHANISMS) if mechanism is None else nullcontext({})
    with watching as acted, nullcontext() if mechanism is None else mechanism.off():
        try:
            config = changed(recorded.config, settings(cell.case, recorded))
            made = replayed(recorded, config, failures, seed, smooth)
        except (FglocError, RuntimeError, ValueError, ArithmeticError) as error:
            return Scores(failed=f"{type(error).__name__}: {str(error).splitlines()[0][:200]}")
    if made is None:
        return Scores(failed="no pose was ever found")
    return _scored(cell, recorded, made, dict(acted))


def floor_of(case: str) -> Floor:
    """Floor on which a case is driven."""
    like = LIKE.get(case, case)
    return floor(like) if like in FAILURES else "unequal_radii"


def chain(case: str, recorded: Recorded) -> list[dict[str, Any]]:
    """Failures of a case, as a suite of ablations describes them."""
    kind, _, amount = case.partition("_")
    if case == FOREIGN:
        return []
    if case == CARRIED30:
        return [*FAILURES["kidnap"].chain(recorded), *FAILURES["ids30"].chain(recorded)]
    if case == GIVEN:
        ids = sorted(recorded.landmarks.landmarks)
        return [{"kind": "moved_marker", "ids": ids, "distance_m": _SHIFTED_M, "together": True}]
    if case == PUSHED:
        return [{"kind": "kidnap", "when": {"intervals": _PUSHED_S}}]
    if case == "dropout":
        return [{"kind": "dropout", "sensor": "camera", "when": {"intervals": [_ROBOTS_DARK_S]}}]
    if kind == "ids" and amount:
        return [{"kind": "wrong_ids", "probability": 0.01 * int(amount)}]
    if kind == "moved" and amount:
        return [d | {"distance_m": 0.01 * int(amount)} for d in FAILURES["moved"].chain(recorded)]
    return FAILURES[LIKE.get(case, case)].chain(recorded)


def settings(case: str, recorded: Recorded) -> dict[str, Any]:
    """Changes of the configuration in a case."""
    if case == GIVEN:
        return {"estimator": {"initial_pose": recorded.truth[0, 1:].tolist()}}
    return {FOREIGN: _FOREIGN_MODEL, WHEELS: _WHEELS_ALONE}.get(case, {})


def _scored(cell: Cell, recorded: Recorded, made: Replayed, acted: dict[str, int]) -> Scores:
    online, unknown = made.online, None if cell.case == PUSHED else made.unknown_ns(recorded.start_ns)
    told = named(online)
    moved = frozenset(i for f in made.chain if isinstance(f, MovedMarker) for i in f.ids)
    moved = frozenset() if cell.case == GIVEN else moved
    reasons = {d.reason for d in online.decisions if d.kind == "wheels"} & _NAMED_KINDS
    right = {_KINDS[cell.case]} if cell.case in _KINDS else set()
    return replace(
        trajectory_scores(made, recorded.config, unknown),
        named=tuple(sorted(told)),
        moved=tuple(sorted(moved)),
        wrong_names=len(told - moved) + len(reasons - right),
        missed_names=len(moved - told) + len(right - reasons),
        slips=Slips() if isinstance(cell.source, int) else slips(recorded, online),
        lifted_nees=None if unknown is None else nees_between(online, recorded.config, unknown),
        acted=acted,
    )


def nees_between(result: RunResult, config: Config, span_ns: tuple[int, int]) -> float | None:
    """NEES/3 of the poses in a time; None if there are none."""
    matched = match_result(result, config)
    if matched is None or matched.covs is None:
        return None
    inside = (matched.stamps_ns >= span_ns[0]) & (matched.stamps_ns < span_ns[1])
    return float(nees(matched.errors[inside], matched.covs[inside]).mean()) / 3.0 if inside.any() else None


# --- Many cells -------------------------------------------------------------------------------------------------------


def run_all(cells: Iterable[Cell], jobs: int) -> dict[Cell, Scores]:
    """Outcomes of all cells, from the cache or run now; a process keeps to one recording at a time."""
    ordered = sorted(set(cells), key=lambda cell: (str(cell.source), cell.case, cell.off))
    return by_recording(outcome, ordered, attrgetter("source"), jobs)


def outcome(cell: Cell) -> Scores:
    """Figures of one cell; of mechanisms that do not act, those of the run with all of them on."""
    if not cell.off:
        return kept_scores(file_name(cell), lambda: run(cell), *_SCORING)
    alone = [BY_NAME[name] for name in cell.off.split(JOIN)]
    if all(m.probe for m in alone):
        on = outcome(Cell(cell.source, cell.case))
        if not any(on.acted.get(m.name) for m in alone):
            return on
    if len(alone) == 1:
        return kept_scores(file_name(cell), lambda: run(cell), *_SCORING)
    with mechanism_of(cell.off).off():
        return kept_scores(file_name(cell), lambda: run(Cell(cell.source, cell.case)), *_SCORING)


def mechanism_of(off: str) -> Mechanism:
    """A mechanism, or several whose names are joined."""
    return BY_NAME[off] if JOIN not in off else together([BY_NAME[name] for name in off.split(JOIN)])


def file_name(cell: Cell) -> str:
    """Name of the file that keeps a cell's outcome, by what is measured."""
    where = f"robot{cell.source}" if isinstance(cell.source, int) else folder(cell.source)
    off = hashlib.sha256(cell.off.encode()).hexdigest()[:8] if JOIN in cell.off else cell.off
    return f"mechanisms_{off or 'on'}_{cell.case}_{where}"


# --- Effects ----------------------------------------------------------------------------------------------------------


Pairs = Sequence[tuple[Scores, Scores]]
"""Outcomes with the mechanism off and on, of each seed."""


@dataclass(frozen=True, slots=True)
class Change:
    """Effect of taking a mechanism away on one figure of a failure.

    Attributes:
        case: the failure.
        what: the figure, such as ``online.ate``.
        off, on: its means over the seeds.
        size: positive where it gets worse: ln of the ratio of the ATE, change of the distance to the band of the NEES,
            change of the number of wrong and missed names, of runs that fail, of the share of poses that are missing.
        counts: whether it is large enough to count.
    """

    case: str
    what: str
    off: float
    on: float
    size: float
    counts: bool


def changes(case: str, pairs: Pairs, modes: Iterable[str] = MODES) -> list[Change]:
    """Changes of all figures of one failure."""
    fails = [sum(bool(o.failed) for o in of_all) for of_all in zip(*pairs, strict=True)]
    out = [Change(case, "failed", fails[0], fails[1], fails[0] - fails[1], fails[0] != fails[1])]
    good = [(off, on) for off, on in pairs if not off.failed and not on.failed]
    if not good:
        return out
    for mode in modes:
        if any(getattr(o, mode) is None for pair in good for o in pair):
            continue
        off, on = (_means([o[i] for o in good], mode) for i in (0, 1))
        size = math.log(off.ate_mm / on.ate_mm)
        out.append(Change(case, f"{mode}.ate", off.ate_mm, on.ate_mm, size, abs(size) > math.log(_ATE)))
        size = outside(off.nees_over_3) - outside(on.nees_over_3)
        out.append(Change(case, f"{mode}.nees", off.nees_over_3, on.nees_over_3, size, abs(size) > _NEES))
    lifted = [[o[i].lifted_nees for o in good] for i in (0, 1)]
    if None not in (*lifted[0], *lifted[1]):
        off_nees, on_nees = (float(np.mean(values)) for values in lifted)
        size = outside(off_nees) - outside(on_nees)
        out.append(Change(case, "nees_while_lifted", off_nees, on_nees, size, abs(size) > _NEES))
    names = [float(sum(o[i].wrong_names + o[i].missed_names for o in good)) for i in (0, 1)]
    out.append(Change(case, "names", names[0], names[1], names[0] - names[1], names[0] != names[1]))
    poses = [float(sum(o[i].poses for o in good)) for i in (0, 1)]
    out.append(Change(case, "poses", poses[0], poses[1], 1.0 - poses[0] / poses[1], poses[0] < _POSES * poses[1]))
    return out


def outside(nees_over_3: float) -> float:
    """Distance of ln(NEES/3) from the band."""
    value = math.log(max(nees_over_3, 1e-12))
    return max(_BAND[0] - value, value - _BAND[1], 0.0)


def _means(outcomes: Sequence[Scores], mode: str) -> Errors:
    errors: list[Errors] = [getattr(o, mode) for o in outcomes]
    of_all = {name: float(np.mean([getattr(e, name) for e in errors])) for name in ("ate_mm", "yaw_deg", "nees_over_3")}
    return Errors(**of_all)


# --- Rows -------------------------------------------------------------------------------------------------------------

Outcomes = Mapping[Cell, Scores]


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
        off_seeds: those of them on which mechanisms are switched off.
        robots: of MRCLAM 6; empty without its data.
        cases: failures on recordings of the simulator.
        mechanisms: to be switched off.
    """

    split: Split
    seeds: tuple[int, ...]
    off_seeds: tuple[int, ...]
    robots: tuple[int, ...]
    cases: tuple[str, ...]
    mechanisms: tuple[Mechanism, ...]

    def cells(self, case: str) -> tuple[Cell, ...]:
        """A failure on the recordings of all seeds, with everything on."""
        return self._cells(case, "", self.seeds)

    def pairs(self, case: str, off: str) -> list[tuple[Cell, Cell]]:
        """The runs of a failure with a mechanism off, and with it on."""
        return list(zip(*(self._cells(case, name, self.off_seeds) for name in (off, "")), strict=True))

    def _cells(self, case: str, off: str, seeds: Sequence[int]) -> tuple[Cell, ...]:
        """Cells of a failure; ``robot_none`` and so on are those of MRCLAM 6."""
        if case.startswith("robot_"):
            return tuple(Cell(robot, case.removeprefix("robot_"), off) for robot in self.robots)
        return tuple(Cell(Take("installed", floor_of(case), self.split, seed), case, off) for seed in seeds)

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
            for figure, unit in (("nees_over_3", ""), ("ate_mm", "mm")):
                yield Wanted(f"{case}.{mode}.{figure}", cells, _figure(cells, of_errors(mode, figure), unit))
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
    pairs = scope.pairs(case, mechanism.name)
    off, on = ([pair[k] for pair in pairs] for k in (0, 1))
    modes = MODES if mechanism.batch and not case.startswith("robot_") else MODES[:1]
    for mode in modes:
        for row_id, figure in (("ate_ratio", "ate_mm"), ("nees_over_3", "nees_over_3")):

            def row(name: str, found: Outcomes, mode: str = mode, figure: str = figure) -> Row:
                return ratio_of(name, [found[c] for c in off], [found[c] for c in on], of_errors(mode, figure))

            yield Wanted(f"off.{label or mechanism.name}.{case}.{mode}.{row_id}", (*off, *on), row)


def _figure(cells: Sequence[Cell], figure: Figure, unit: str) -> Callable[[str, Outcomes], Row]:
    return lambda name, found: mean_of(name, [found[c] for c in cells], figure, unit)


def _delay(name: str, outcomes: Sequence[Scores]) -> Row:
    delays = [d for o in outcomes for d in o.slips.delays_s]
    if not delays:
        return Row(name, None, n=0, reason="no slip was found")
    return Row(name, float(np.median(delays)), float(np.std(delays)), len(delays), "s")


def _false(name: str, outcomes: Sequence[Scores]) -> Row:
    km = sum(o.slips.path_m for o in outcomes) / 1000.0
    alarms = sum(o.slips.false_alarms for o in outcomes)
    return Row(name, alarms / km, None, len(outcomes), "1/km") if km else Row(name, None, n=0, reason="no way")


def _recall(name: str, outcomes: Sequence[Scores]) -> Row:
    found = [m for o in outcomes for m in o.slips.found_m if m >= _LEAST_M]
    n = len(found) + sum(m >= _LEAST_M for o in outcomes for m in o.slips.missed_m)
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


def mean(row_id: str, values: Sequence[float], unit: str = "") -> Row:
    """Mean and standard deviation over the runs."""
    if not values:
        return Row(row_id, None, n=0, reason="nothing was run")
    return mean_row(row_id, values, unit)


# --- The table for the reader -----------------------------------------------------------------------------------------


def effect(chosen: Scope, mechanism: Mechanism, found: Outcomes) -> list[Change]:
    """Effects of taking a mechanism away, over the failures that were run; the largest worsening comes first."""
    out: list[Change] = []
    for case in chosen.all_cases:
        runs = chosen.pairs(case, mechanism.name)
        if runs and all(cell in found for pair in runs for cell in pair):
            out += changes(case, [(found[a], found[b]) for a, b in runs], MODES if mechanism.batch else MODES[:1])
    return sorted(out, key=lambda change: -change.size)


def without_effect(chosen: Scope, found: Outcomes) -> list[str]:
    """Mechanisms whose removal worsens nothing that was run."""
    return [m.name for m in chosen.mechanisms if not any(c.counts and c.size > 0.0 for c in effect(chosen, m, found))]


def report(chosen: Scope, found: Outcomes) -> str:
    """One paragraph for each mechanism, of the failures that were run."""
    out = []
    for mechanism in chosen.mechanisms:
        every = effect(chosen, mechanism, found)
        worse = [c for c in every if c.counts and c.size > 0.0]
        better = [c for c in reversed(every) if c.counts and c.size < 0.0]
        verdict = "" if worse else "  WITHOUT EFFECT" if not better else "  ONLY BETTER WITHOUT"
        out.append(f"{mechanism.name}{verdict}: {_acts(chosen, mechanism, found)}")
        out += [f"    worse   {_said(c)}" for c in worse[:_SHOWN]]
        out += [f"    better  {_said(c)}" for c in better[:_SHOWN]]
    return "\n".join(out)


def _acts(chosen: Scope, mechanism: Mechanism, found: Outcomes) -> str:
    if mechanism.probe is None:
        return "no probe"
    ran = [case for case in chosen.all_cases if all(cell in found for cell in chosen.cells(case))]
    acted = {case: sum(found[cell].acted.get(mechanism.name, 0) for cell in chosen.cells(case)) for case in ran}
    return "acts in " + (", ".join(f"{case} {n}" for case, n in acted.items() if n) or "none")


def _said(change: Change) -> str:
    return f"{change.case}.{change.what}: {change.on:.4g} -> {change.off:.4g}"


# --- The command ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Options:
    """Options of the command line."""

    split: Split = "test"
    prefixes: tuple[str, ...] = ("",)
    seeds: int = _OFF_SEEDS
    jobs: int = os.cpu_count() or 1

    def wants(self, row_id: str) -> bool:
        """Whether a row was asked for."""
        return row_id.startswith(self.prefixes)


def scope(quick: bool, options: Options) -> Scope:
    """Scope of a run; a quick one has one seed, two cases, two mechanisms and no robot."""
    seeds = _SEEDS[options.split][: 1 if quick else None]
    robots = mrclam.ROBOTS if options.split == "test" else mrclam.ROBOTS[: len(seeds)]
    return Scope(
        options.split,
        seeds,
        seeds[: options.seeds],
        () if quick or not MRCLAM.is_dir() else tuple(robots),
        QUICK_CASES if quick else CASES,
        tuple(BY_NAME[name] for name in QUICK_MECHANISMS) if quick else MECHANISMS,
    )


def measure(quick: bool, options: Options) -> Iterator[Row]:
    """The rows whose ids begin with one of the prefixes."""
    chosen = scope(quick, options)
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
    by_name = any(prefix.startswith("off.") for prefix in options.prefixes)  # else those that the effects need
    rows = [w for w in every if options.wants(w.id) and (by_name or not w.id.startswith("off."))]
    effect = options.wants("mechanisms.without_effect")
    prepare(cell.source for w in (every if effect else rows) for cell in w.cells if isinstance(cell.source, Take))
    found: Outcomes = run_all({cell for w in rows for cell in w.cells}, options.jobs)
    if effect:
        found = taken_away(chosen, found, options.jobs)
        useless = without_effect(chosen, found)
        yield Row("mechanisms.without_effect", len(useless), n=len(chosen.mechanisms))
        print(report(chosen, found))
        yield from _together(chosen, [BY_NAME[name] for name in useless], found, options.jobs)
        more = [w for w in every if w.id.startswith("off.") and w not in rows]
        rows += [w for w in more if all(cell in found for cell in w.cells)]
    yield from (w.row(w.id, found) for w in rows)


def taken_away(chosen: Scope, found: Outcomes, jobs: int) -> Outcomes:
    """Outcomes without each mechanism, under one failure after another until something gets worse."""
    pending = {m.name: sorted(chosen.all_cases, key=lambda case: case != m.case) for m in chosen.mechanisms}
    while pending:
        tried = {name: cases[0] for name, cases in pending.items()}
        pairs = [pair for name, case in tried.items() for pair in chosen.pairs(case, name)]
        found = {**found, **run_all({cell for pair in pairs for cell in pair if cell not in found}, jobs)}
        useless = without_effect(chosen, found)
        pending = {name: cases[1:] for name, cases in pending.items() if name in useless and cases[1:]}
    return found


def _together(chosen: Scope, useless: Sequence[Mechanism], found: Outcomes, jobs: int) -> Iterator[Row]:
    """Rows with all of those off at once that have no effect by themselves."""
    if len(useless) < 2:
        return
    rows = [w for case in chosen.all_cases for w in of_one(chosen, together(useless), case, "together")]
    at_once = {**found, **run_all({cell for w in rows for cell in w.cells}, jobs)}
    yield from (w.row(w.id, at_once) for w in rows)


def rules66(chosen: Scope, cases: Sequence[str], jobs: int) -> Iterator[Row]:
    """The textbook's pipeline with three rules over fgloc, both without learned motion, online on the same steps."""
    cells = {
        case: [InstalledCell(Take("installed", floor(case), chosen.split, s), case, True) for s in chosen.seeds]
        for case in cases
    }
    found = dict(parallel(_plain, [cell for of_case in cells.values() for cell in of_case], jobs))
    for case in cases:
        scores = [found[cell] for cell in cells[case]]
        pairs = [(s.textbook_mm.get(RULES, np.inf), s.online.ate_mm) for s in scores if s.online is not None]
        theirs, ours = np.array(pairs).reshape(-1, 2).T
        if len(pairs) < len(scores) or not np.isfinite(theirs).all():
            yield Row(_rules_id(case), None, n=len(scores), reason="a pose was not found in every run")
        else:
            yield ratio_row(_rules_id(case), theirs, ours)


def _plain(cell: InstalledCell) -> tuple[InstalledCell, Scores]:
    return cell, scores_of(cell)


def _rules_id(case: str) -> str:
    return f"rules66.{case}.over_fgloc"


def parsed(argv: Sequence[str] | None = None) -> tuple[Options, list[str]]:
    """Options, and what is left for `benchmarks.common`."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--rows", default="", help="comma-separated beginnings of ids")
    parser.add_argument("--seeds", type=int, default=_OFF_SEEDS, help="on which mechanisms are taken away")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    known, rest = parser.parse_known_args(argv)
    return Options(known.split, tuple(known.rows.split(",")), known.seeds, known.jobs), rest


if __name__ == "__main__":
    _options, _rest = parsed()
    main(lambda quick: measure(quick, _options), __doc__ or "", _rest)
