"""The table of `benchmarks.mechanisms` for the reader: what gets worse and what gets better without each mechanism."""

from __future__ import annotations

from benchmarks.mechanisms_cells import Outcome
from benchmarks.mechanisms_effect import MODES, Change, changes
from benchmarks.mechanisms_rows import Outcomes, Scope
from benchmarks.mechanisms_switch import Mechanism

_SHOWN = 4  # changes of a mechanism, each way


def effect(chosen: Scope, mechanism: Mechanism, found: Outcomes) -> list[Change]:
    """What taking a mechanism away does, over all failures; those that it makes worse most come first."""
    out: list[Change] = []
    for case in chosen.all_cases:
        offs, ons = (chosen.cells(case, name) for name in (mechanism.name, ""))
        pairs: list[tuple[Outcome, Outcome]] = [(found[a], found[b]) for a, b in zip(offs, ons, strict=True)]
        if pairs:
            out += changes(case, pairs, MODES if mechanism.batch else MODES[:1])
    return sorted(out, key=lambda change: -change.size)


def without_effect(chosen: Scope, found: Outcomes) -> list[str]:
    """Mechanisms whose removal worsens nothing."""
    return [m.name for m in chosen.mechanisms if not any(c.counts and c.size > 0.0 for c in effect(chosen, m, found))]


def report(chosen: Scope, found: Outcomes) -> str:
    """One paragraph for each mechanism."""
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
    acted = {
        case: sum(found[cell].acted.get(mechanism.name, 0) for cell in chosen.cells(case)) for case in chosen.all_cases
    }
    return "acts in " + (", ".join(f"{case} {n}" for case, n in acted.items() if n) or "none")


def _said(change: Change) -> str:
    return f"{change.case}.{change.what}: {change.on:.4g} -> {change.off:.4g}"
