"""The table of `benchmarks.mechanisms` for the reader: what gets worse and what gets better without each mechanism."""

from __future__ import annotations

from benchmarks.mechanisms_cells import Cell
from benchmarks.mechanisms_effect import MODES, Change, changes
from benchmarks.mechanisms_rows import Outcomes, Scope
from benchmarks.mechanisms_switch import Mechanism

_SHOWN = 4  # changes of a mechanism, each way


def order(chosen: Scope, mechanism: Mechanism) -> list[str]:
    """The failures, the one that the mechanism is for first."""
    return sorted(chosen.all_cases, key=lambda case: case != mechanism.case)


def cells(chosen: Scope, mechanism: Mechanism, case: str) -> list[tuple[Cell, Cell]]:
    """The runs of a failure with the mechanism off, and with it on."""
    return list(zip(*(chosen.cells(case, name) for name in (mechanism.name, "")), strict=True))


def effect(chosen: Scope, mechanism: Mechanism, found: Outcomes) -> list[Change]:
    """Effects of taking a mechanism away, over the failures that were run; the largest worsening comes first."""
    out: list[Change] = []
    for case in chosen.all_cases:
        runs = cells(chosen, mechanism, case)
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
