"""Effect of a mechanism: its runs with it off compared with those with it on, for `benchmarks.mechanisms`.

Taking a mechanism away *worsens* a failure if the mean ATE over the seeds grows by 5 % or more, if ln(NEES/3), of the
run or while a robot is lifted, gets farther from the band of 0.7 to 1.4 by 0.05 or more, if more names are wrong or
missed, if a run fails, or if one pose in a hundred is missing; it *improves* it if the ATE falls, the NEES gets nearer
or the names get better by as much.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.common import Row
from benchmarks.installed_scores import Errors
from benchmarks.mechanisms_cells import Outcome

MODES = ("online", "batch")
_ATE, _NEES, _POSES = 1.05, 0.05, 0.99
_BAND = (math.log(0.7), math.log(1.4))
Pairs = Sequence[tuple[Outcome, Outcome]]
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


def _means(outcomes: Sequence[Outcome], mode: str) -> Errors:
    errors: list[Errors] = [getattr(o, mode) for o in outcomes]
    of_all = {name: float(np.mean([getattr(e, name) for e in errors])) for name in ("ate_mm", "yaw_deg", "nees_over_3")}
    return Errors(**of_all)


# --- Rows -------------------------------------------------------------------------------------------------------------


def mean(row_id: str, values: Sequence[float], unit: str = "") -> Row:
    """Mean and standard deviation over the runs."""
    if not values:
        return Row(row_id, None, n=0, reason="nothing was run")
    return Row(row_id, float(np.mean(values)), float(np.std(values)), len(values), unit)


def failed(row_id: str, outcomes: Sequence[Outcome]) -> Row:
    """A row without a value, with the reason."""
    why = [o.failed for o in outcomes if o.failed]
    return Row(row_id, None, n=len(outcomes), reason=f"in {len(why)} of {len(outcomes)} runs: {why[0] if why else '-'}")


def ratio(row_id: str, off: Sequence[Outcome], on: Sequence[Outcome], mode: str, figure: str) -> Row:
    """Mean with the mechanism off over that with it on; the spread is that of the ratios of single runs."""
    missing = [o for o in (*off, *on) if o.failed or getattr(o, mode) is None]
    if missing:
        return failed(row_id, [*off, *on])
    a, b = (np.array([getattr(getattr(o, mode), figure) for o in of_all]) for of_all in (off, on))
    return Row(row_id, float(a.mean() / b.mean()), float(np.std(a / b)), len(a))
