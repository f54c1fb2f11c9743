"""From records to the matrix failure × variant: figures with spread and number of runs, and what a failure costs."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from fgloc.ablation.jobs import Job
from fgloc.ablation.records import Record
from fgloc.ablation.suite import NOTHING, Cell, Suite
from fgloc.stats import rounded


@dataclass(frozen=True, slots=True)
class Metric:
    """A column of figures."""

    key: str  # of metrics.json; "coverage.3" leads inside
    label: str
    factor: float = 1.0  # from the SI value to what is shown
    form: str = ".3g"

    def of(self, record: Record) -> float | None:
        """The record's value in shown units; None if it has none."""
        name, _, inner = self.key.partition(".")
        value = record.figures.get(name)
        if inner and isinstance(value, Mapping):
            value = value.get(inner)
        return value * self.factor if isinstance(value, int | float) else None


METRICS = (
    Metric("ate_mean_m", "ATE mean [mm]", 1000.0, ".3g"),
    Metric("yaw_mae_deg", "yaw MAE [°]", 1.0, ".3g"),
    Metric("drift_percent", "drift [%]", 1.0, ".3g"),
    Metric("nees_over_3", "NEES / 3", 1.0, ".2f"),
    Metric("coverage.3", "within 3σ [%]", 100.0, ".1f"),
)
ATE = METRICS[0]
_NOTHING = 0.005  # a change of the error by a smaller share is none


@dataclass(frozen=True, slots=True)
class Run:
    """A cell with its record."""

    cell: Cell
    key: str
    record: Record


@dataclass(frozen=True, slots=True)
class Entry:
    """One figure of one failure, severity and variant, over recordings and seeds."""

    failure: str
    severity: float | None
    variant: str
    metric: Metric
    values: tuple[float, ...]
    runs: int  # that were asked for; fewer values: the others gave none

    @property
    def mean(self) -> float | None:
        """Mean over the runs that gave a value."""
        return float(np.mean(self.values)) if self.values else None

    @property
    def spread(self) -> float | None:
        """Standard deviation over the runs; None for fewer than two."""
        return float(np.std(self.values, ddof=1)) if len(self.values) > 1 else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """95 % confidence interval of the mean (Student's t); None for fewer than two runs."""
        mean, spread, n = self.mean, self.spread, len(self.values)
        if mean is None or spread is None:
            return None
        half = float(stats.t.ppf(0.975, n - 1)) * spread / math.sqrt(n)
        return mean - half, mean + half

    @property
    def text(self) -> str:
        """``mean ± spread (n)``, or how many of the runs failed."""
        if self.mean is None:
            return f"no result (0 of {self.runs})"
        shown = f"{self.mean:{self.metric.form}}"
        if self.spread is not None:
            shown = " ± ".join(rounded(self.mean, self.spread))
        count = f"{len(self.values)}" if len(self.values) == self.runs else f"{len(self.values)} of {self.runs}"
        return f"{shown} ({count})"


def join(jobs: Iterable[Job], records: Mapping[str, Record]) -> list[Run]:
    """All runs in the suite's order."""
    return [Run(job.cell, job.key, records[job.key]) for job in jobs]


def rows(suite: Suite) -> list[tuple[str, float | None]]:
    """Failures with their severities, none first."""
    listed = [(f.name, severity) for f in suite.failures for severity, _ in f.severities()]
    return [(NOTHING, None), *listed]


def matrix(suite: Suite, runs: Sequence[Run]) -> list[Entry]:
    """Every figure of every failure, severity and variant."""
    entries = []
    for failure, severity in rows(suite):
        for variant in suite.variants:
            here = select(runs, failure, severity, variant.name)
            for metric in METRICS:
                values = tuple(v for run in here if (v := metric.of(run.record)) is not None)
                entries.append(Entry(failure, severity, variant.name, metric, values, len(here)))
    return entries


def select(runs: Iterable[Run], failure: str, severity: float | None, variant: str) -> list[Run]:
    """Runs of one row and column."""
    wanted = (failure, severity, variant)
    return [run for run in runs if (run.cell.failure, run.cell.severity, run.cell.variant) == wanted]


def sentence(suite: Suite, runs: Sequence[Run], failure: str) -> str:
    """What a failure costs the first variant at its last severity, run by run against the same without failure."""
    entry = next(f for f in suite.failures if f.name == failure)
    severity = list(entry.severities())[-1][0]
    variant = suite.variants[0].name
    here = select(runs, failure, severity, variant)
    at = "" if entry.severity is None else f" at {severity:g} {entry.severity.unit}".rstrip()
    name = failure[0].upper() + failure[1:]
    if not any(run.record.affected for run in here if run.record.outcome == "done") and all(
        run.record.outcome == "done" for run in here
    ):
        return f"{name}{at} changed no message of these recordings: they show nothing about it."
    without = {run.cell.recording: ATE.of(run.record) for run in select(runs, NOTHING, None, variant)}
    pairs = [
        (before, after)
        for run in here
        if (after := ATE.of(run.record)) is not None and (before := without[run.cell.recording]) is not None
    ]
    lost = f"; {len(here) - len(pairs)} of {len(here)} runs gave no figure" if len(pairs) < len(here) else ""
    if not pairs:
        return f"{name}{at} left no run of '{variant}' with a figure ({len(here)} asked for)."
    return f"{name}{at}: {_change(pairs, variant)}{lost}."


def _change(pairs: Sequence[tuple[float, float]], variant: str) -> str:
    """How the mean error changes from the first of each pair to the second, if it measurably does."""
    before, after = np.mean(pairs, axis=0)
    runs = f"over {len(pairs)} run{'s' if len(pairs) > 1 else ''}"
    if len(pairs) > 1:
        more = np.diff(pairs)
        within = "" if _measurable(pairs) else ", within its spread"
        runs += f" (change {' ± '.join(rounded(float(more.mean()), float(more.std(ddof=1)), '+'))} mm{within})"
        if within:
            return f"no measurable change of the mean error of '{variant}', {before:.3g} mm, {runs}"
    if abs(after - before) < _NOTHING * before:
        return f"the mean error of '{variant}' stays at {after:.3g} mm {runs}"
    way = "rises" if after > before else "falls"
    return f"the mean error of '{variant}' {way} from {before:.3g} to {after:.3g} mm {runs}"


def _measurable(pairs: Sequence[tuple[float, float]]) -> bool:
    """Whether the mean change exceeds its spread, or of many runs what chance makes of it; one run has no spread."""
    if len(pairs) < 2:
        return True
    more, n = np.diff(pairs), len(pairs)
    spread = float(more.std(ddof=1))
    by_chance = float(stats.t.ppf(0.975, n - 1)) * spread / math.sqrt(n)
    return abs(float(more.mean())) > min(spread, by_chance)


def worth(suite: Suite, runs: Sequence[Run], variant: str) -> str | None:
    """What a variant changes against the first one, where that is most: the same recordings, failures and seeds.

    Returns:
        A sentence; None if no run of both gave a figure.
    """
    first = suite.variants[0].name
    found = []
    for failure, severity in rows(suite):
        theirs = {(r.cell.recording, r.cell.seed): ATE.of(r.record) for r in select(runs, failure, severity, variant)}
        pairs = [
            (ours, other)
            for r in select(runs, failure, severity, first)
            if (ours := ATE.of(r.record)) is not None
            and (other := theirs.get((r.cell.recording, r.cell.seed))) is not None
        ]
        if pairs:
            ours, other = np.mean(pairs, axis=0).tolist()
            ratio = other / max(ours, 1e-9)
            found.append((_measurable(pairs), ratio, failure, severity, ours, other, len(pairs)))
    if not found:
        return None
    plain = next((f for f in found if f[2] == NOTHING), None)
    measurable, ratio, failure, severity, ours, other, n = max(found, key=lambda f: f[:2])
    units = {f.name: f.severity.unit for f in suite.failures if f.severity is not None}
    at = "" if severity is None else f" at {severity:g} {units.get(failure, '')}".rstrip()
    under = "without failure" if failure == NOTHING else f"under '{failure}'{at}"
    count = f"{n} run{'s' if n > 1 else ''}"
    if not measurable:
        most = f"{other:.3g} mm instead of {ours:.3g} mm {under}"
        return (
            f"'{variant}': no measurable change against '{first}'; the largest, {most}, is within its spread ({count})."
        )
    text = f"'{variant}': mean error {other:.3g} mm instead of {ours:.3g} mm of '{first}' {under} "
    text += f"({ratio:.1f} times, {count})"
    if plain is not None and failure != NOTHING:
        text += f"; without failure {plain[5]:.3g} instead of {plain[4]:.3g} mm"
        text += "" if plain[0] else ", within its spread"
    return f"{text}."


def worst(suite: Suite, runs: Sequence[Run], failure: str) -> Run | None:
    """The run of the first variant with the largest error; None if none has a track."""
    variant = suite.variants[0].name
    found = [
        (ate, k)
        for k, run in enumerate(runs)
        if (run.cell.failure, run.cell.variant) == (failure, variant)
        and run.record.track is not None
        and (ate := ATE.of(run.record)) is not None
    ]
    return runs[max(found)[1]] if found else None


def matrix_csv(entries: Iterable[Entry]) -> str:
    """The matrix, one figure a row, in the units that the labels name."""
    head = ("failure", "severity", "variant", "figure", "mean", "spread", "low_95", "high_95", "n", "runs")
    out = [
        (
            e.failure,
            e.severity,
            e.variant,
            e.metric.label,
            e.mean,
            e.spread,
            *(e.interval or (None, None)),
            len(e.values),
            e.runs,
        )
        for e in entries
    ]
    return _csv(head, out)


def runs_csv(runs: Iterable[Run]) -> str:
    """Every run with its figures, in the units that the labels name."""
    head = ("recording", "failure", "severity", "variant", "seed", "outcome", *(m.label for m in METRICS), "key")
    out = [
        (
            run.cell.recording,
            run.cell.failure,
            run.cell.severity,
            run.cell.variant,
            run.cell.seed,
            run.record.outcome,
            *(metric.of(run.record) for metric in METRICS),
            run.key,
        )
        for run in runs
    ]
    return _csv(head, out)


def _csv(head: Sequence[str], content: Iterable[Sequence[object]]) -> str:
    buffer = io.StringIO()
    table = csv.writer(buffer, lineterminator="\n")
    table.writerow(head)
    table.writerows(content)
    return buffer.getvalue()
