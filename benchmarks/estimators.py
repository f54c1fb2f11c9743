"""Smoother against filter: ``python -m benchmarks.estimators [--quick] [--json FILE] [--split test]``.

The fixed-lag smoother and the Kalman filter of pose and installation (`estimator.kind: ekf`), online, in the failures
of `benchmarks.installed`, on the same recordings. Rows: ``CASE.{fixed_lag,ekf}.{ate_mm,nees_over_3}``, means over the
seeds; ``CASE.update_ratio``: median processor time of an update of the smoother over that of the filter, in one run.
The choice is made on the validation split (docs/decisions/0004-fixed-lag-and-qr.md).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.adaptive_recordings import Split
from benchmarks.adaptive_runs import CASES as FAILURES
from benchmarks.adaptive_runs import changed, failure, replayed
from benchmarks.common import Row, main, not_run
from benchmarks.installed_recordings import SEEDS, Take, folder, load, prepare
from benchmarks.installed_runs import CASES, floor, kept, processor_times
from benchmarks.installed_scores import Scores, carried, errors, lost_share
from fgloc.ablation.failures import Kidnap, Lift

KINDS = ("fixed_lag", "ekf")
_QUICK = ("none", "frozen")


def measure(quick: bool, split: Split = "validation") -> Iterator[Row]:
    """Rows of the benchmark."""
    for case in CASES:
        if quick and case not in _QUICK:
            yield from not_run([f"{case}.update_ratio"], "left out of a quick run")
            continue
        takes = [Take("installed", floor(case), split, seed) for seed in SEEDS[split][: 1 if quick else None]]
        prepare(takes)
        scores = {kind: [_scores(take, case, kind) for take in takes] for kind in KINDS}
        yield from _rows(case, scores)


def _rows(case: str, scores: dict[str, list[Scores]]) -> Iterator[Row]:
    for kind in KINDS:
        for name, at in (("ate_mm", 0), ("nees_over_3", 1)):
            values = [_figure(s, at) for s in scores[kind]]
            unit = "mm" if name == "ate_mm" else ""
            yield Row(f"{case}.{kind}.{name}", float(np.mean(values)), float(np.std(values)), len(values), unit)
    smoother, filter_ = (np.median([ms for s in scores[kind] for ms in s.update_ms]) for kind in KINDS)
    yield Row(f"{case}.update_ratio", float(smoother / filter_), n=len(scores["ekf"]))


def _figure(scores: Scores, at: int) -> float:
    """ATE [mm] or NEES/3; infinite of a run that failed."""
    if scores.online is None:
        return np.inf
    return (scores.online.ate_mm, scores.online.nees_over_3)[at]


def _scores(take: Take, case: str, kind: str) -> Scores:
    name = f"estimator_{kind}_{case}_{folder(take)}"
    return Scores.from_json(kept(name, lambda: _run(take, case, kind).as_json()))


def _run(take: Take, case: str, kind: str) -> Scores:
    recorded = load(take)
    chain = [failure(described) for described in FAILURES[case].chain(recorded)]
    config = changed(recorded.config, {"estimator": {"kind": kind}})
    with processor_times() as times:
        made = replayed(recorded, config, chain, take.seed, False)
    if made is None:
        return Scores(failed="no pose was ever found")
    lifted = [f.when.intervals[0][0] for f in made.chain if isinstance(f, Kidnap | Lift)]
    unknown = carried(made.given, recorded.start_ns + round(lifted[0] * 1e9)) if lifted else None
    online = made.online
    scores = Scores(online=errors(online, config, unknown), update_ms=tuple(round(ms, 4) for ms in times))
    return replace(scores, lost_share=lost_share(online.modes, online.trajectory.stamps_ns, unknown))


def _options(arguments: Sequence[str] | None = None) -> tuple[argparse.Namespace, list[str]]:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="validation")
    return parser.parse_known_args(arguments)


if __name__ == "__main__":
    import sys

    options, rest = _options()
    sys.argv[1:] = rest
    main(lambda quick: measure(quick, options.split), __doc__)
