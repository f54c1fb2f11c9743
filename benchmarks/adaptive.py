"""What adaptive weights are worth: ``python -m benchmarks.adaptive [--quick] [--split validation]``.

Simulated recordings of the suite's scenarios (see `benchmarks.adaptive_recordings`), failures of the ablations, and
MRCLAM 6 with failures injected. Of one case are run, on the same events: ours; *fixed*, the same graph with constant
covariances, tuned on training recordings (`benchmarks.adaptive_fixed`); *nominal*, the same with the covariances of
``robot.yaml``; the *oracle*, which is fixed but told when the wheels are wrong; and the peers: kernels on the wheels'
factors and an extended Kalman filter online, GNC on every factor in batch. Values are ratios of means over the seeds, spreads
the standard deviation of the ratios of single runs. ATE is the mean distance from the truth, online where not said
otherwise. Settings are chosen on the training and validation splits; the rows are of the test split.

The detector's delay is that of the slips it found; a slip is what the simulator says to slip for 0.1 s or more.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks.adaptive_fixed import constant
from benchmarks.adaptive_recordings import SEEDS, Split, prepare
from benchmarks.adaptive_runs import CASES, cell
from benchmarks.adaptive_scores import Figures, Slips
from benchmarks.common import Row, main, not_run
from datasets.sim.camera import RenderError


@dataclass(frozen=True, slots=True)
class Variant:
    """A way of weighing."""

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
    "gnc": Variant(NOMINAL | {"batch": {"robust": "gnc_all"}}, batch=True),
}
PEERS = ("huber", "cauchy", "dcs", "ekf")
Found = dict[tuple[str, str], list[Figures]]
"""Figures of each seed, by case and variant."""


def measure(quick: bool, split: Split = "test") -> Iterator[Row]:
    """All rows."""
    seeds = SEEDS[split][:1] if quick else SEEDS[split]
    try:
        prepare(sorted({case.floor for case in CASES.values()}), split, seeds)
    except RenderError as error:
        yield from not_run([f"{name}.nees_over_3" for name in CASES], str(error))
        return
    found = run_all(CASES, VARIANTS, seeds, split)
    yield from rows(found)


def run_all(cases: Iterable[str], variants: Iterable[str], seeds: Sequence[int], split: Split) -> Found:
    """Every case with every variant, one process per core; a process keeps to one floor and seed at a time."""
    floors = {CASES[name].floor for name in cases}
    groups = [
        (seed, [n for n in cases if CASES[n].floor == floor], list(variants), split)
        for seed, floor in product(seeds, floors)
    ]
    workers = min(os.cpu_count() or 1, len(groups))
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        found: Found = {}
        for part in pool.map(_run_group, *zip(*groups, strict=True)):
            for key, figures in part.items():
                found.setdefault(key, []).append(figures)
    return found


def _run_group(seed: int, cases: list[str], variants: list[str], split: Split) -> dict[tuple[str, str], Figures]:
    out = {}
    for name, label in product(cases, variants):
        variant = VARIANTS[label]
        figures = cell(name, [seed], variant.changes, oracle=variant.oracle, batch=variant.batch, split=split)
        out[name, label] = figures[0]
    return out


def rows(found: Found) -> Iterator[Row]:
    """The table."""
    yield _ratio("none.over_fixed", found["none", "ours"], found["none", "fixed"])
    for name in ("slip", "mu01"):
        yield _ratio(f"{name}.over_oracle", found[name, "ours"], found[name, "oracle"])
        yield _ratio(f"{name}.over_fixed", found[name, "ours"], found[name, "fixed"])
        yield _ratio(f"{name}.over_nominal", found[name, "ours"], found[name, "nominal"])
    for name in ("dark30", "dark60"):
        yield _ratio(f"{name}.over_oracle", found[name, "ours"], found[name, "oracle"])
        yield _ratio(f"{name}.over_fixed", found[name, "ours"], found[name, "fixed"])
    for name in ("ids10", "ids30", "ids50", "moved"):
        yield _ratio(f"{name}.over_none", found[name, "ours"], found["none", "ours"])
    named = [f.named == f.moved for f in found["moved", "ours"]]
    yield Row("moved.named", float(np.mean(named)), n=len(named))
    for name in ("frozen", "onewheel"):
        yield _ratio(f"{name}.over_oracle", found[name, "ours"], found[name, "oracle"])
    yield _row("kidnap.seconds", [f.found_again_s or 0.0 for f in found["kidnap", "ours"]], "s")
    yield from _detector([f.slips for name in ("none", "slip", "mu01") for f in found[name, "ours"] if f.slips])
    for name in CASES:
        yield _row(f"{name}.ate_m", [f.ate_m for f in found[name, "ours"]], "m")
        yield _row(f"{name}.nees_over_3", [f.nees_over_3 for f in found[name, "ours"]])
        yield _row(f"{name}.batch_nees_over_3", [f.batch_nees_over_3 for f in found[name, "ours"]])
        yield _ratio(f"batch.{name}.over_online", found[name, "ours"], found[name, "ours"], _batch)
        yield _ratio(f"batch.{name}.over_fixed", found[name, "ours"], found[name, "fixed"], _batch, _batch)
    yield _cost(found)
    yield from _peers(found)


def _detector(slips: Sequence[Slips]) -> Iterator[Row]:
    delays = [d for s in slips for d in s.delays_s]
    sizes = [m for s in slips for m in s.found_m]
    missed = [m for s in slips for m in s.missed_m]
    yield Row(
        "detector.delay_s", float(np.median(delays)) if delays else None, None, len(delays), "s", "no slip was found"
    )
    km = sum(s.path_m for s in slips) / 1000.0
    yield Row("detector.false_per_km", sum(s.false_alarms for s in slips) / km, None, len(slips), "1/km")
    yield Row("detector.found", len(sizes) / max(len(sizes) + len(missed), 1), None, len(sizes) + len(missed))
    yield Row("detector.smallest_m", smallest_found(sizes, missed), None, len(sizes) + len(missed), "m")


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
    """99th percentiles of a step; both variants of a run come one after the other in one process."""
    ratios = []
    for name in ("none", "slip", "mu01"):
        for ours, fixed in zip(found[name, "ours"], found[name, "fixed"], strict=True):
            ratios.append(float(np.percentile(ours.step_ms, 99) / np.percentile(fixed.step_ms, 99)))
    return _row("cost.step_ratio", ratios)


def _peers(found: Found) -> Iterator[Row]:
    """Ours over each peer, and over the best of them in the case where that is worst for us."""
    worst = 0.0
    for name in CASES:
        ratios = {}
        for peer in PEERS:
            row = _ratio(f"peers.{name}.over_{peer}", found[name, "ours"], found[name, peer])
            ratios[peer] = row.value or 0.0
            yield row
        row = _ratio(f"peers.{name}.batch_over_gnc", found[name, "ours"], found[name, "gnc"], _batch, _batch)
        yield row
        worst = max(worst, *ratios.values(), row.value or 0.0)
    yield Row("peers.best_ratio", worst, None, len(CASES))


def _batch(figures: Figures) -> float:
    return figures.batch_ate_m


def _online(figures: Figures) -> float:
    return figures.ate_m


def _ratio(
    row_id: str,
    ours: Sequence[Figures],
    theirs: Sequence[Figures],
    our_figure: Callable[[Figures], float] = _online,
    their_figure: Callable[[Figures], float] = _online,
) -> Row:
    """Ratio of the means over the seeds; the spread is that of the single ratios."""
    a, b = np.array([our_figure(f) for f in ours]), np.array([their_figure(f) for f in theirs])
    lost = int(np.sum(~np.isfinite(a)))
    if lost:
        return Row(row_id, None, n=len(a), reason=f"in {lost} of {len(a)} runs no pose was ever found")
    return Row(row_id, float(a.mean() / b.mean()), float(np.std(a / b)), len(a))


def _row(row_id: str, values: Sequence[float], unit: str = "") -> Row:
    lost = int(np.sum(~np.isfinite(values)))
    if lost:
        return Row(row_id, None, n=len(values), reason=f"in {lost} of {len(values)} runs no pose was ever found")
    return Row(row_id, float(np.mean(values)), float(np.std(values)), len(values), unit)


if __name__ == "__main__":
    chosen: list[Split] = ["validation" if "validation" in sys.argv else "test"]
    main(lambda quick: measure(quick, chosen[0]), __doc__ or "")
