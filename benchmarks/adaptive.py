"""Benefit of adaptive weights: ``python -m benchmarks.adaptive [--quick] [--split validation]``.

Simulated recordings of the suite's scenarios (see `benchmarks.adaptive_recordings`), failures of the ablations, and
MRCLAM 6 with failures injected. Of one case are run, on the same events: ours; *fixed*, the same graph with constant
covariances, tuned on training recordings (`benchmarks.adaptive_fixed`); *nominal*, the same with the covariances of
``robot.yaml``; the *oracle*, which is fixed but given the times when the wheels are wrong; and the peers: kernels on
the wheels' factors and an extended Kalman filter online, GNC on every factor in batch. Values are ratios of means over
the seeds, spreads the standard deviation of the ratios of single runs. ATE is the mean distance from the truth, online
where not stated otherwise. Settings are chosen on the training and validation splits; the rows are of the test split.

The detector's delay is that of the slips it found; a slip lasts 0.1 s or more in the simulator.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks import adaptive_mrclam
from benchmarks.adaptive_fixed import constant
from benchmarks.adaptive_recordings import SEEDS, Split, prepare
from benchmarks.adaptive_runs import CASES, cell
from benchmarks.adaptive_scores import Figures
from benchmarks.common import Row, main, not_run
from fgloc.instrumentation import counted
from fgloc.types import FloatArray
from fgloc_datasets.sim.camera import RenderError


@dataclass(frozen=True, slots=True)
class Variant:
    """Way of weighing: changes of the configuration, and how it is run."""

    changes: dict[str, Any]
    oracle: bool = False
    batch: bool = False


NOMINAL = constant(1.0, 1.0)
FIXED = constant()
VARIANTS: dict[str, Variant] = {
    "ours": Variant({}, batch=True),
    "fixed": Variant(FIXED, batch=True),
    "nominal": Variant(NOMINAL),
    "oracle": Variant(FIXED, oracle=True),
    "huber": Variant(NOMINAL | {"estimator": {"motion_kernel": "huber"}}),
    "cauchy": Variant(NOMINAL | {"estimator": {"motion_kernel": "cauchy"}}),
    "dcs": Variant(NOMINAL | {"estimator": {"motion_kernel": "dcs"}}),
    "ekf": Variant(FIXED | {"estimator": {"kind": "ekf"}}),
}
PEERS = ("huber", "cauchy", "dcs", "ekf")
QUICK_CASES, QUICK_VARIANTS = ("slip", "dark30"), ("ours", "fixed", "oracle")
_LEFT_OUT = "left out of a quick run"
Key = tuple[str, str]
Found = dict[Key, list[Figures]]
"""Figures of each seed, by case and variant."""


def measure(quick: bool, split: Split = "test") -> Iterator[Row]:
    """Rows of the benchmark; a quick run has one seed and two cases."""
    cases, variants = (QUICK_CASES, QUICK_VARIANTS) if quick else (tuple(CASES), tuple(VARIANTS))
    seeds = SEEDS[split][:1] if quick else SEEDS[split]
    try:
        prepare(sorted({CASES[name].floor for name in cases}), split, seeds)
        found = run_all(cases, variants, seeds, split)
    except RenderError as error:
        yield from not_run([f"{name}.nees_over_3" for name in CASES], str(error))
    else:
        yield from rows(found)
    yield from adaptive_mrclam.measure(quick)


def run_all(cases: Sequence[str], variants: Sequence[str], seeds: Sequence[int], split: Split) -> Found:
    """Every case with every variant, one process per core; a process keeps to one floor and seed at a time."""
    floors = sorted({CASES[name].floor for name in cases})
    groups = list(product(seeds, floors))
    with ProcessPoolExecutor(min(os.cpu_count() or 1, len(groups)), get_context("spawn")) as pool:
        jobs = [
            pool.submit(_run_group, seed, [n for n in cases if CASES[n].floor == floor], variants, split)
            for seed, floor in groups
        ]
        found: Found = {}
        for job in counted(jobs, "recordings", len(jobs)):
            for key, figures in job.result().items():
                found.setdefault(key, []).append(figures)
    return found


def _run_group(seed: int, cases: Sequence[str], variants: Sequence[str], split: Split) -> dict[Key, Figures]:
    out = {}
    for name, label in product(cases, variants):
        variant = VARIANTS[label]
        if variant.oracle and CASES[name].wheels_wrong is None:
            continue
        figures = cell(name, [seed], variant.changes, oracle=variant.oracle, batch=variant.batch, split=split)
        out[name, label] = figures[0]
    return out


def rows(found: Found) -> Iterator[Row]:
    """Rows of the table."""
    yield _over(found, "none.over_fixed", "none", "fixed")
    for name in ("slip", "mu01"):
        for peer in ("oracle", "fixed", "nominal"):
            yield _over(found, f"{name}.over_{peer}", name, peer)
    for name, peer in product(("dark30", "dark60"), ("oracle", "fixed")):
        yield _over(found, f"{name}.over_{peer}", name, peer)
    for name in ("ids10", "ids30", "ids50", "moved"):
        yield _ratio(f"{name}.over_none", found.get((name, "ours")), found.get(("none", "ours")))
    yield _row("moved.named", found.get(("moved", "ours")), lambda f: float(f.named == f.moved))
    for name in ("frozen", "onewheel"):
        yield _over(found, f"{name}.over_oracle", name, "oracle")
    yield _row("kidnap.seconds", found.get(("kidnap", "ours")), lambda f: f.found_again_s or 0.0, "s")
    yield from _detector([f for name in ("none", "slip", "mu01") for f in found.get((name, "ours"), [])])
    for name in CASES:
        ours = found.get((name, "ours"))
        yield _row(f"{name}.ate_m", ours, _online, "m")
        yield _row(f"{name}.nees_over_3", ours, lambda f: f.nees_over_3)
        yield _row(f"{name}.batch_nees_over_3", ours, lambda f: f.batch_nees_over_3)
        yield _ratio(f"batch.{name}.over_online", ours, ours, _batch)
        yield _ratio(f"batch.{name}.over_fixed", ours, found.get((name, "fixed")), _batch, _batch)
    yield _cost(found)
    yield from _peers(found)


def _detector(figures: Sequence[Figures]) -> Iterator[Row]:
    slips = [f.slips for f in figures if f.slips is not None]
    delays = [d for s in slips for d in s.delays_s]
    found = [m for s in slips for m in s.found_m]
    missed = [m for s in slips for m in s.missed_m]
    n = len(found) + len(missed)
    if not delays:
        yield from not_run([f"detector.{name}" for name in ("delay_s", "found", "smallest_m")], "no slip was found")
    else:
        yield Row("detector.delay_s", float(np.median(delays)), float(np.std(delays)), len(delays), "s")
        yield Row("detector.found", len(found) / n, None, n)
        yield Row("detector.smallest_m", smallest_found(found, missed), None, n, "m", "most are missed at any size")
    km = sum(s.path_m for s in slips) / 1000.0
    if km:
        yield Row("detector.false_per_km", sum(s.false_alarms for s in slips) / km, None, len(slips), "1/km")


def smallest_found(found: Sequence[float], missed: Sequence[float], share: float = 0.9) -> float | None:
    """Least size from which on at least ``share`` of all larger slips were found; None if there is none."""
    order = sorted([(m, True) for m in found] + [(m, False) for m in missed], reverse=True)
    best, hits = None, 0
    for n, (size, hit) in enumerate(order, 1):
        hits += hit
        if hits >= share * n:
            best = size
    return best


def _cost(found: Found) -> Row:
    """Ratio of the 99th percentiles of a step; both runs of a recording come one after the other in one process."""
    pairs = []
    for name in ("none", "slip", "mu01"):
        pairs += list(zip(found.get((name, "ours"), []), found.get((name, "fixed"), []), strict=True))
    ratios = [float(np.percentile(ours.step_ms, 99) / np.percentile(fixed.step_ms, 99)) for ours, fixed in pairs]
    return Row("cost.step_ratio", float(np.median(ratios)), float(np.std(ratios)), len(ratios))


def _peers(found: Found) -> Iterator[Row]:
    """Ratios of fgloc over each peer, and over the best of them in the case where that is worst for fgloc."""
    worst: list[float] = []
    for name in CASES:
        compared = [_over(found, f"peers.{name}.over_{peer}", name, peer) for peer in PEERS]
        yield from compared
        worst += [row.value for row in compared if row.value is not None]
    if worst:
        yield Row("peers.best_ratio", max(worst), None, len(worst))
    else:
        yield from not_run(["peers.best_ratio"], _LEFT_OUT)


def _batch(figures: Figures) -> float:
    return figures.batch_ate_m


def _online(figures: Figures) -> float:
    return figures.ate_m


def _over(found: Found, row_id: str, name: str, peer: str) -> Row:
    """Ratio of fgloc over a peer in the same case, online."""
    return _ratio(row_id, found.get((name, "ours")), found.get((name, peer)))


def _ratio(
    row_id: str,
    ours: Sequence[Figures] | None,
    theirs: Sequence[Figures] | None,
    our_figure: Callable[[Figures], float] = _online,
    their_figure: Callable[[Figures], float] = _online,
) -> Row:
    """Ratio of the means over the seeds; the spread is that of the single ratios."""
    if ours is None or theirs is None:
        return Row(row_id, None, n=0, reason=_LEFT_OUT)
    a, b = np.array([our_figure(f) for f in ours]), np.array([their_figure(f) for f in theirs])
    if not np.isfinite(a).all():
        return Row(row_id, None, n=len(a), reason=_never_found(a))
    with np.errstate(invalid="ignore"):
        return Row(row_id, float(a.mean() / b.mean()), float(np.std(a / b)), len(a))


def _row(row_id: str, figures: Sequence[Figures] | None, figure: Callable[[Figures], float], unit: str = "") -> Row:
    if figures is None:
        return Row(row_id, None, n=0, reason=_LEFT_OUT)
    values = [figure(f) for f in figures]
    if not np.isfinite(values).all():
        return Row(row_id, None, n=len(values), reason=_never_found(values))
    return Row(row_id, float(np.mean(values)), float(np.std(values)), len(values), unit)


def _never_found(values: Sequence[float] | FloatArray) -> str:
    return f"in {int(np.sum(~np.isfinite(values)))} of {len(values)} runs no pose was ever found"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    known, rest = parser.parse_known_args()
    main(lambda quick: measure(quick, known.split), __doc__ or "", rest)
