"""Bounds on the error against the truth: ``python -m benchmarks.integrity [--seeds N] [--hours H] [--jobs N]``.

Runs online of the recordings of `benchmarks.installed` (test split), with the failures of `benchmarks.mechanisms`, and
of those recordings of others whose truth is in the frame of their map, with what ``fgloc init`` writes. A pose exceeds
its bound if its error along the robot, across it or in yaw does. Of a robot that was carried away the time until it
sees a marker is left out.

- ``integrity.exceeded``: share of samples 10 s apart that exceed, over all simulated runs; ``.bound95``: the upper end
  of its 95 % interval (Clopper and Pearson); ``.all``: share of all poses; ``integrity.exceeded.CASE``: of one failure.
- ``integrity.dangerous``: poses that exceed while the bound is below the alert limit (0.1 m, 2°), and are beyond it.
- ``integrity.tightness``: median bound over the 99.9 % quantile of the error, without failure.
- ``integrity.available.CASE``: share of the time with a bound below 0.1 m.
- ``integrity.alert_s``: from the first error beyond the limit to the first alert, the longest of all runs.
- ``integrity.step_over_none``: time of the updates of the runs without failure, over the same without the bounds.
- ``integrity.real.NAME``: share of the poses of a recording by others that exceed.
- ``integrity.fleet.*``: the same figures of so many hours of `benchmarks.fleet`, ten minutes a drive, failures in turn,
  every second drive with an installation drawn from twice the prior sigmas (``.twice``). ``--hours 0``: none.

Constants were chosen with seeds 61 to 63, and with seeds 1 to 62 of the fleet, whose figures begin with seed 1000.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import yaml
from scipy.special import betaincinv

from benchmarks import fleet
from benchmarks.common import DATA, Row, main, mean_row, not_run
from benchmarks.field_recordings import RECORDINGS
from benchmarks.mechanisms import CASES, PUSHED, chain, floor_of, settings
from benchmarks.recordings import SEEDS, Split, Take, changed, load, prepare
from benchmarks.replays import failure, replayed
from fgloc.calibration.first_settings import first_settings
from fgloc.config import Config, config_of_file
from fgloc.errors import FglocError
from fgloc.estimation.integrity import ProtectionLevels
from fgloc.evaluation.metrics import beyond_bounds, match_result
from fgloc.runner import RunResult, run
from fgloc.types import FloatArray, IntArray, Protection
from fgloc_datasets.sim.camera import RenderError

_APART_NS = 10_000_000_000
_DRIVE_S = 600.0  # of the fleet
_LIMIT_M, _LIMIT_RAD = 0.1, math.radians(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Errors of a run's poses and the bounds on them."""

    stamps_ns: IntArray  # (n,)
    beyond: FloatArray  # (n,) whether the error exceeds the bound
    distance: FloatArray  # (n,) from the truth [m]
    yaw: FloatArray  # (n,) absolute error [rad]
    bound: FloatArray  # (n,) on the position [m]
    bound_yaw: FloatArray  # (n,) [rad]
    step_over_none: float = 1.0  # time of the updates over that without the bounds; 1: not measured

    @property
    def samples(self) -> FloatArray:
        """``beyond`` at times that lie 10 s apart or more."""
        kept, last = [], -(2**62)
        for i, stamp in enumerate(self.stamps_ns.tolist()):
            if stamp - last >= _APART_NS:
                kept.append(i)
                last = stamp
        return self.beyond[kept]

    @property
    def alert(self) -> FloatArray:
        """Whether the bound is above the alert limit."""
        return np.asarray((self.bound > _LIMIT_M) | (self.bound_yaw > _LIMIT_RAD))

    @property
    def wrong(self) -> FloatArray:
        """Whether the error is beyond the alert limit."""
        return np.asarray((self.distance > _LIMIT_M) | (self.yaw > _LIMIT_RAD))

    @property
    def alert_s(self) -> float:
        """Time from the first error beyond the limit to an alert; 0 if it was there before, infinite if none came."""
        if not self.wrong.any():
            return 0.0
        first = int(np.argmax(self.wrong))
        later = np.flatnonzero(self.alert[first:])
        return math.inf if not len(later) else float(self.stamps_ns[first + later[0]] - self.stamps_ns[first]) * 1e-9


def held(result: RunResult, config: Config, unknown_ns: tuple[int, int] | None = None) -> Held:
    """Errors and bounds of a run, without the time in which the pose cannot be known.

    Raises:
        ValueError: the run has no truth at its times.
    """
    matched = match_result(result, config)
    if matched is None:
        raise ValueError("the run and its truth have no time in common")
    beyond, _ = beyond_bounds(result, matched)
    at = np.searchsorted(result.trajectory.stamps_ns, matched.stamps_ns)
    kept = np.ones(len(at), dtype=bool)
    if unknown_ns is not None:
        kept = (matched.stamps_ns < unknown_ns[0]) | (matched.stamps_ns >= unknown_ns[1])
    position = np.array([result.protections[i].position_m for i in at])
    yaw = np.array([float(result.protections[i].bound[2]) for i in at])
    off = np.abs(matched.errors[:, 2])
    return Held(matched.stamps_ns[kept], beyond[kept], matched.distances[kept], off[kept], position[kept], yaw[kept])


def simulated(case: str, seed: int, split: Split = "test") -> Held | None:
    """A case on a recording; None if no pose was ever found."""
    recorded = load(Take("installed", floor_of(case), split, seed))
    config = changed(recorded.config, settings(case, recorded))
    bounds, spent = ProtectionLevels.of, [0.0]

    def timed(*given: Any) -> Protection:
        began = time.perf_counter()
        made = bounds(*given)
        spent[0] += time.perf_counter() - began
        return made

    with mock.patch.object(ProtectionLevels, "of", timed):
        made = replayed(recorded, config, [failure(d) for d in chain(case, recorded)], seed, batch=False)
    if made is None:
        return None
    whole = 1e-3 * float(made.online.step_ms.sum())
    unknown = None if case == PUSHED else made.unknown_ns(recorded.start_ns)
    return replace(held(made.online, config, unknown), step_over_none=whole / (whole - spent[0]))


def driven(drive: fleet.Drive) -> Held:
    """A drive of the fleet."""
    found = [(e.stamp_ns, error, e.protection) for e, error in drive.run() if e.protection is not None]
    errors = np.abs(np.array([error for _, error, _ in found]))
    bounds = np.array([protection.bound for *_, protection in found])
    position = np.array([protection.position_m for *_, protection in found])
    distance = np.hypot(errors[:, 0], errors[:, 1])
    beyond = (errors > bounds).any(axis=1) | (distance > position)
    stamps = np.array([stamp for stamp, *_ in found], dtype=np.int64)
    return Held(stamps, beyond, distance, errors[:, 2], position, bounds[:, 2])


def measure(quick: bool, seeds: int, hours: float, jobs: int) -> Iterator[Row]:
    """The simulated rows, then those of recordings by others, then those of the fleet."""
    chosen = SEEDS["test"][:1] if quick else SEEDS["test"][-seeds:] if seeds else ()
    cases = ("none", "slip") if quick else CASES
    runs: dict[str, list[Held]] = {}
    try:
        prepare(Take("installed", floor_of(case), "test", seed) for case in cases for seed in chosen)
        for case in cases if chosen else ():
            runs[case] = [run for seed in chosen if (run := simulated(case, seed)) is not None]
            print(f"{case}: {[int(run.beyond.sum()) for run in runs[case]]} poses exceed", flush=True)
    except RenderError as error:
        yield from not_run(["integrity.exceeded"], str(error))
    else:
        yield from _rows("integrity", runs) if runs else ()
    if not quick and seeds:
        yield from _real()
    if hours > 0.0:
        yield from _fleet(0.1 if quick else hours, jobs)


def _fleet(hours: float, jobs: int) -> Iterator[Row]:
    count = max(1, round(hours * 3600.0 / _DRIVE_S))
    drives = [
        fleet.Drive(fleet.CASES[i % len(fleet.CASES)], 1000 + i, 1.0 + (i // len(fleet.CASES)) % 2, _DRIVE_S)
        for i in range(count)
    ]
    runs: dict[str, list[Held]] = {case: [] for case in fleet.CASES}
    twice: list[Held] = []
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for drive, run in zip(drives, pool.map(driven, drives), strict=True):
            runs[drive.case].append(run)
            twice += [run] if drive.factor > 1.0 else []
            if run.beyond.any():
                dangerous = int((run.beyond & ~run.alert & run.wrong).sum())
                print(f"{drive}: {int(run.beyond.sum())} poses exceed, {dangerous} dangerous", flush=True)
    yield from _rows("integrity.fleet", {case: of_case for case, of_case in runs.items() if of_case})
    if twice:
        shares = [float(run.beyond.mean()) for run in twice]
        yield mean_row("integrity.fleet.exceeded.twice", shares)


def _rows(prefix: str, runs: dict[str, list[Held]]) -> Iterator[Row]:
    every = [run for of_case in runs.values() for run in of_case]
    samples = np.concatenate([run.samples for run in every])
    exceeded, n = int(samples.sum()), len(samples)
    hours = sum(float(run.stamps_ns[-1] - run.stamps_ns[0]) for run in every) * 1e-9 / 3600.0
    yield Row(f"{prefix}.hours", hours, n=len(every), unit="h")
    yield Row(f"{prefix}.exceeded", exceeded / n, n=n, unit="share")
    most = 1.0 if exceeded == n else float(betaincinv(exceeded + 1, n - exceeded, 0.975))
    yield Row(f"{prefix}.exceeded.bound95", most, n=n, unit="share")
    yield Row(f"{prefix}.exceeded.all", float(np.concatenate([r.beyond for r in every]).mean()), n=len(every))
    for case, of_case in runs.items():
        shares = [float(run.beyond.mean()) for run in of_case]
        yield mean_row(f"{prefix}.exceeded.{case}", shares, "share")
    dangerous = sum(int((run.beyond & ~run.alert & run.wrong).sum()) for run in every)
    yield Row(f"{prefix}.dangerous", dangerous, n=len(every), unit="poses")
    sound = runs["none"]
    bound, error = (np.concatenate(parts) for parts in ([r.bound for r in sound], [r.distance for r in sound]))
    yield Row(f"{prefix}.tightness", float(np.median(bound) / np.quantile(error, 0.999)), n=len(sound))
    for case in ("none", "slip", "dark30"):
        if of_case := runs.get(case, []):
            shares = [float((run.bound < _LIMIT_M).mean()) for run in of_case]
            yield mean_row(f"{prefix}.available.{case}", shares)
    if ratios := [run.step_over_none for run in sound if run.step_over_none > 1.0]:
        yield mean_row(f"{prefix}.step_over_none", ratios)
    yield Row(f"{prefix}.alert_s", max(run.alert_s for run in every), n=len(every), unit="s")


def _real() -> Iterator[Row]:
    for one in RECORDINGS:
        if one.frame != "map" or not one.landmarks or not (DATA / one.source).exists():
            continue
        with tempfile.TemporaryDirectory() as folder:
            bag = one.bag(Path(folder))
            config = config_of_file(yaml.safe_load(first_settings(bag).text) or {})
            try:
                found = held(run(bag, one.map_path(Path(folder)), config, "online"), config)
            except (FglocError, ValueError) as error:
                yield Row(f"integrity.real.{one.name}", None, n=0, reason=str(error))
                continue
            yield Row(f"integrity.real.{one.name}", float(found.beyond.mean()), n=len(found.beyond), unit="share")


def parsed(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, list[str]]:
    """Own options, and what is left for `benchmarks.common.main`."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--seeds", type=int, default=7, help="of the test split, the last ones; 0: none")
    parser.add_argument("--hours", type=float, default=50.0, help="of the fleet")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes, of the fleet")
    return parser.parse_known_args(argv)


if __name__ == "__main__":
    _own, _rest = parsed()
    main(lambda quick: measure(quick, _own.seeds, _own.hours, _own.jobs), __doc__ or "", _rest)
