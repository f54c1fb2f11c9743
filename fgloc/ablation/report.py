"""The report of an ablation: one page, the matrix failure × variant and every run as CSV, and all of it as JSON."""

from __future__ import annotations

import csv
import io
import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from scipy import stats

from fgloc.ablation.jobs import Job, Record, Track, code_hash
from fgloc.ablation.suite import NOTHING, Cell, Suite
from fgloc.config import files_of
from fgloc.evaluation.report import embedded, page
from fgloc.evaluation.style import BLUE, DPI, GREEN, NORMAL, SMALL, WIDTH, Format, image_of, plain_label, tidy
from fgloc.files.atomic import atomic_folder
from fgloc.files.outputs import sha256_of, write_json, write_text
from fgloc.stats import rounded

# --- From records to the matrix, and what a failure costs -------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Metric:
    """A column of figures."""

    key: str  # of metrics.json; "coverage.3" leads inside
    label: str
    factor: float = 1.0  # from the SI value to what is shown
    form: str = ".3g"
    most: float = math.inf  # largest possible value in shown units; the smallest is 0

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
    Metric("coverage.3", "within 3σ [%]", 100.0, ".1f", 100.0),
)
ATE = METRICS[0]
_NOTHING = 0.005  # a change of the error by a smaller share is none
FEWEST_FOR_INTERVAL = 5  # runs: of fewer each is shown, as an interval would say more about Student's t than about them


@dataclass(frozen=True, slots=True)
class Run:
    """A cell with its record."""

    cell: Cell
    key: str
    record: Record

    @property
    def row(self) -> dict[str, Any]:
        """Its place in the suite, as tables have it."""
        names = ("recording", "failure", "severity", "variant", "seed")
        return {"key": self.key} | {name: getattr(self.cell, name) for name in names}


@dataclass(frozen=True, slots=True)
class Entry:
    """One figure of one failure, severity and variant, over recordings and seeds."""

    failure: str
    severity: float | None
    variant: str
    metric: Metric
    values: tuple[float, ...]
    runs: int  # that were asked for; fewer values: the others gave none
    changed: int | None = None  # runs in which the failure changed a message; None: there is no failure

    @property
    def unchanged(self) -> bool:
        """Whether its values say nothing of the failure, which changed no message."""
        return self.changed == 0 and bool(self.values)

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
        """95 % confidence interval of the mean (Student's t) in the figure's range; None for fewer than five runs."""
        mean, spread, n = self.mean, self.spread, len(self.values)
        if mean is None or spread is None or n < FEWEST_FOR_INTERVAL:
            return None
        half = _half_width(spread, n)
        return max(mean - half, 0.0), min(mean + half, self.metric.most)

    @property
    def text(self) -> str:
        """``mean ± spread (n)``, or how many of the runs failed, or that the failure changed no message."""
        if self.mean is None:
            return f"no result (0 of {self.runs})"
        shown = f"{self.mean:{self.metric.form}}"
        if self.unchanged:
            shown = "no message changed"
        elif self.spread is not None:
            shown = " ± ".join(rounded(self.mean, self.spread))
        count = f"{len(self.values)}" if len(self.values) == self.runs else f"{len(self.values)} of {self.runs}"
        return f"{shown} ({count})"

    @property
    def row(self) -> dict[str, Any]:
        """The figure, as tables have it: empty where the failure changed no message, as that is no cost of 0."""
        mean, spread, interval = (None,) * 3 if self.unchanged else (self.mean, self.spread, self.interval)
        return {
            "failure": self.failure,
            "severity": self.severity,
            "variant": self.variant,
            "figure": self.metric.label,
            "mean": mean,
            "spread": spread,
            "interval_95": interval,
            "n": len(self.values),
            "runs": self.runs,
            "runs_changed": self.changed,
        }


def _half_width(spread: float, n: int) -> float:
    """Half of the 95 % confidence interval of a mean of ``n`` values (Student's t)."""
    return float(stats.t.ppf(0.975, n - 1)) * spread / math.sqrt(n)


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
            changed = None if failure == NOTHING else sum(bool(run.record.affected) for run in here)
            for metric in METRICS:
                values = tuple(v for run in here if (v := metric.of(run.record)) is not None)
                entries.append(Entry(failure, severity, variant.name, metric, values, len(here), changed))
    return entries


def select(runs: Iterable[Run], failure: str, severity: float | None, variant: str) -> list[Run]:
    """Runs of one row and column."""
    wanted = (failure, severity, variant)
    return [run for run in runs if (run.cell.failure, run.cell.severity, run.cell.variant) == wanted]


def _with_unit(suite: Suite, failure: str, severity: float | None) -> str:
    """A severity with its unit; empty where the failure has none."""
    units = {f.name: f.severity.unit for f in suite.failures if f.severity is not None}
    return "" if severity is None else f"{severity:g} {units[failure]}".rstrip()


def sentence(suite: Suite, runs: Sequence[Run], failure: str) -> str:
    """Sentence: error that a failure costs the first variant at its last severity, by pairs of runs."""
    entry = next(f for f in suite.failures if f.name == failure)
    severity = list(entry.severities())[-1][0]
    variant = suite.variants[0].name
    here = select(runs, failure, severity, variant)
    at = "" if severity is None else f" at {_with_unit(suite, failure, severity)}"
    name = failure[0].upper() + failure[1:]
    if not any(run.record.affected for run in here if run.record.outcome == "done") and all(
        run.record.outcome == "done" for run in here
    ):
        heard = dict.fromkeys(sensor for run in here for sensor in run.record.sensors)
        others = f" Sensors with messages there: {', '.join(heard)}." if heard else ""
        return f"{name}{at} changed no message of these recordings: they show nothing about it.{others}"
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
    """Sentence: change of the mean error from the first to the second of each pair, if it is measurable.

    Of fewer than five pairs it has the figures and claims neither a rise nor a fall.
    """
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
    if len(pairs) < FEWEST_FOR_INTERVAL:
        return (
            f"the mean error of '{variant}' is {after:.3g} mm, without failure {before:.3g} mm, {runs}; "
            f"fewer than {FEWEST_FOR_INTERVAL} show neither a rise nor a fall"
        )
    way = "rises" if after > before else "falls"
    return f"the mean error of '{variant}' {way} from {before:.3g} to {after:.3g} mm {runs}"


def _measurable(pairs: Sequence[tuple[float, float]]) -> bool:
    """Whether the mean change exceeds its spread or, for many runs, its 95 % confidence interval; True for one run."""
    if len(pairs) < 2:
        return True
    more, n = np.diff(pairs), len(pairs)
    spread = float(more.std(ddof=1))
    return abs(float(more.mean())) > min(spread, _half_width(spread, n))


def worth(suite: Suite, runs: Sequence[Run], variant: str) -> str | None:
    """Sentence: largest change of error of a variant against the first one, by pairs of runs with the same inputs.

    Returns:
        A sentence; None if no run of both gave a figure.
    """
    first = suite.variants[0].name
    found = []
    for failure, severity in rows(suite):
        if failure != NOTHING and not any(
            run.record.affected for name in (first, variant) for run in select(runs, failure, severity, name)
        ):
            continue
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
    at = "" if severity is None else f" at {_with_unit(suite, failure, severity)}"
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
    """The run of the first variant with the largest error; None if none with a track had a message changed."""
    variant = suite.variants[0].name
    found = [
        (ate, k)
        for k, run in enumerate(runs)
        if (run.cell.failure, run.cell.variant) == (failure, variant)
        and run.record.track is not None
        and (failure == NOTHING or run.record.affected)
        and (ate := ATE.of(run.record)) is not None
    ]
    return runs[max(found)[1]] if found else None


def matrix_csv(entries: Iterable[Entry]) -> str:
    """The matrix, one figure a row, in the units that the labels name."""
    ends = ("low_95", "high_95")
    head = ("failure", "severity", "variant", "figure", "mean", "spread", *ends, "n", "runs", "runs_changed")
    content = (e.row for e in entries)
    return _csv(head, (row | dict(zip(ends, row["interval_95"] or (None, None), strict=True)) for row in content))


def runs_csv(runs: Sequence[Run]) -> str:
    """Every run with its figures, in the units that the labels name."""
    place = ("recording", "failure", "severity", "variant", "seed", "outcome", "messages_changed")
    content = (
        run.row
        | {"outcome": run.record.outcome, "messages_changed": _messages_changed(run)}
        | {m.label: m.of(run.record) for m in METRICS}
        for run in runs
    )
    return _csv((*place, *(m.label for m in METRICS), "key"), content)


def _messages_changed(run: Run) -> int | None:
    """Messages that a failure changed; None: there is no failure, or no result."""
    known = run.cell.failure != NOTHING and run.record.outcome == "done"
    return sum(run.record.affected.values()) if known else None


def _csv(head: Sequence[str], content: Iterable[Mapping[str, object]]) -> str:
    buffer = io.StringIO()
    table = csv.DictWriter(buffer, head, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    table.writerows(content)
    return buffer.getvalue()


# --- Pictures: error of each failure, over its severity, and its worst track ------------------------------------------

_COLORS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7", "#555555")  # Okabe and Ito
_COLUMNS = 3
_SINGLE_WIDTH = 3.5  # inches: one column of a page


@dataclass(frozen=True, slots=True)
class Curves:
    """One small plot: error over the severity of a failure, one curve per variant."""

    title: str
    unit: str
    curves: Mapping[str, Sequence[Entry]]


def plot_failures(suite: Suite, entries: Sequence[Entry]) -> Figure:
    """Error of each failure, one below the other, by variant: mean, and every run as a dot; logarithmic."""
    shown = [(name, severity, f"{name} {_with_unit(suite, name, severity)}".rstrip()) for name, severity in rows(suite)]
    names = [variant.name for variant in suite.variants]
    marked = any(e.unchanged for e in entries)
    height = (0.09 + 0.09 * len(names)) * len(shown) + 0.6 + 0.18 * math.ceil((len(names) + marked) / 3)
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")
    ax = figure.add_subplot()
    tidy(ax)
    for i, name in enumerate(names):
        color, offset = _COLORS[i % len(_COLORS)], (i - 0.5 * (len(names) - 1)) * 0.6 / len(names)
        found = {(e.failure, e.severity): e for e in entries if e.variant == name and e.metric == ATE and e.values}
        at = [(row + offset, found[key[:2]]) for row, key in enumerate(shown) if key[:2] in found]
        single = [(value, y) for y, e in at for value in e.values if not e.unchanged]
        ax.plot(*np.array(single).reshape(-1, 2).T, ".", color=color, ms=3, alpha=0.5)
        for hollow in (False, True):
            means = np.array([(np.mean(e.values), y) for y, e in at if e.unchanged == hollow]).reshape(-1, 2).T
            look: dict[str, Any] = {"mfc": "white"} if hollow else {"label": plain_label(name)}
            ax.plot(*means, "o", color=color, ms=4.5, **look)
    ax.set_yticks(range(len(shown)), [plain_label(label) for *_, label in shown], fontsize=SMALL)
    ax.invert_yaxis()
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel(ATE.label, fontsize=SMALL)
    handles = ax.get_legend_handles_labels()[0]
    if marked:
        handles.append(_hollow())
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=SMALL, frameon=False)
    return figure


def _hollow() -> Line2D:
    """Legend of the points of failures that changed no message."""
    look: dict[str, Any] = dict(marker="o", ms=4.5, mfc="white", linestyle="none")
    return Line2D([], [], color="#555555", label="no message changed", **look)


def plot_severity(plots: Sequence[Curves], label: str) -> Figure:
    """Small plots side by side, all with one meaning of color.

    Bands are the intervals of five runs or more; of fewer runs every one is a dot.
    """
    names = list(dict.fromkeys(name for plot in plots for name in plot.curves))
    marked = any(point.unchanged for plot in plots for points in plot.curves.values() for point in points)
    columns = 1 if len(plots) == 1 else 2 if len(plots) == 2 else 4  # of the legend: what the plots' width has room for
    figure, axes = _grid(len(plots), 1.9, below=0.18 * math.ceil((len(names) + marked) / columns))
    for ax, plot in zip(axes, plots, strict=True):
        for name, points in plot.curves.items():
            _draw_curve(ax, name, points, _COLORS[names.index(name) % len(_COLORS)])
        ax.set_title(plain_label(plot.title), fontsize=NORMAL)
        ax.set_xlabel(plain_label(plot.unit), fontsize=SMALL)
        ax.set_ylim(bottom=0.0)
    axes[0].set_ylabel(label, fontsize=SMALL)
    handles = {name: h for ax in axes for h, name in zip(*ax.get_legend_handles_labels(), strict=True)}
    if marked:
        handles["no message changed"] = _hollow()
    look: dict[str, Any] = dict(ncols=columns, fontsize=SMALL, frameon=False)
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", **look)
    return figure


def _draw_curve(axes: Axes, name: str, points: Sequence[Entry], color: str) -> None:
    means = np.array([(p.severity, p.mean) for p in points], dtype=float).T
    axes.plot(*means, "o-", color=color, lw=1.3, ms=3.5, label=plain_label(name))
    hollow = [(p.severity, p.mean) for p in points if p.unchanged]
    if hollow:
        axes.plot(*np.array(hollow).T, "o", color=color, ms=3.5, mfc="white")
    banded = [(p.severity, *p.interval) for p in points if p.interval and not p.unchanged]
    if banded:
        severity, low, high = np.array(banded).T
        axes.fill_between(severity, low, high, color=color, alpha=0.15, lw=0)
    few = (p for p in points if 1 < len(p.values) < FEWEST_FOR_INTERVAL and not p.unchanged)
    single = [(p.severity, v) for p in few for v in p.values]
    if single:
        axes.plot(*np.array(single).T, ".", color=color, ms=3, alpha=0.6)


def plot_tracks(tracks: Mapping[str, Track]) -> Figure:
    """Small maps side by side, under their titles: the estimate over the truth, axes equal."""
    figure, axes = _grid(len(tracks), 2.2, below=0.2)
    for ax, (title, track) in zip(axes, tracks.items(), strict=True):
        ax.plot(*np.array(track.truth).T, color="#999999", lw=2.4)
        ax.plot(*np.array(track.estimate).T, color=BLUE, lw=1.1)
        ax.plot(*track.truth[0], marker="o", ms=4.5, color=GREEN, mec="white")
        ax.set_title(plain_label(title), fontsize=SMALL)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel("x [m]", fontsize=SMALL)
    axes[0].set_ylabel("y [m]", fontsize=SMALL)
    handles = [
        Line2D([], [], color=BLUE, lw=1.1, label="estimate"),
        Line2D([], [], color="#999999", lw=2.4, label="truth"),
        Line2D([], [], color=GREEN, marker="o", ms=4.5, mec="white", linestyle="none", label="start"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=SMALL, frameon=False)
    return figure


def _grid(count: int, height: float, below: float) -> tuple[Figure, list[Axes]]:
    columns = min(_COLUMNS, count)
    rows = math.ceil(count / columns)
    width = max(WIDTH * columns / _COLUMNS, _SINGLE_WIDTH)
    figure = Figure(figsize=(width, height * rows + 0.4 + below), dpi=DPI, layout="constrained")
    axes = [figure.add_subplot(rows, columns, k + 1) for k in range(count)]
    for ax in axes:
        tidy(ax)
    return figure, axes


# --- The report -------------------------------------------------------------------------------------------------------

_SHOWN = {"outcome", "error", "figures", "modes", "affected"}  # of a record, in ablation.json
_SEVERITY = (
    f"{ATE.label} over severity. Bands are 95 % confidence intervals of the mean, "
    f"of {FEWEST_FOR_INTERVAL} runs or more; of fewer every run is a dot. "
    "Severity 0 is the run without failure."
)


def write_report(
    suite: Suite,
    jobs: Sequence[Job],
    records: Mapping[str, Record],
    out: Path,
    command: str,
    figures: Sequence[Format] = (),
) -> list[str]:
    """Write ``report.html``, ``matrix.csv``, ``runs.csv`` and ``ablation.json``; return a sentence per failure.

    Args:
        suite: what was asked for.
        jobs: its runs.
        records: their results, by key.
        out: folder.
        command: as it was typed.
        figures: formats in which the figures are written too.

    Raises:
        OutputError: the folder cannot be written; an old report is kept.
    """
    runs = join(jobs, records)
    entries = matrix(suite, runs)
    sentences = [sentence(suite, runs, failure.name) for failure in suite.failures]
    told = [worth(suite, runs, variant.name) for variant in suite.variants[1:]]
    worths = [text for text in told if text is not None]
    provenance: dict[str, Any] = {
        "command": command,
        "code_sha256": code_hash(),
        "versions": {name: version(name) for name in ("fgloc", "gtsam", "numpy")}
        | {"python": platform.python_version()},
        "inputs": _inputs(jobs),
        "suite": suite.model_dump(mode="json"),
    }
    with atomic_folder(out, kept=("jobs", "detections")) as stage:
        write_text(stage / "matrix.csv", matrix_csv(entries))
        write_text(stage / "runs.csv", runs_csv(runs))
        results = {
            "sentences": sentences,
            "variants": worths,
            "matrix": [e.row for e in entries],
            "runs": [run.row | run.record.model_dump(mode="json", include=_SHOWN) for run in runs],
        }
        write_json(stage / "ablation.json", provenance | results)
        drawn = _drawn(suite, runs, entries)
        write_text(stage / "report.html", _page(suite, runs, entries, sentences, worths, provenance, drawn))
        for form in figures:
            for name, (_, figure, _) in drawn.items():
                (stage / f"{name}.{form}").write_bytes(image_of(figure, form))
    return sentences


def _drawn(suite: Suite, runs: Sequence[Run], entries: Sequence[Entry]) -> dict[str, tuple[str, Figure, str]]:
    """Heading, figure and caption, by the name of its file."""
    drawn = {}
    if any(e.values for e in entries if e.metric == ATE):
        drawn["failures"] = ("Failures", plot_failures(suite, entries), f"{ATE.label}: means, and every run as a dot.")
    if curves := _curves(suite, entries):
        drawn["severity"] = ("Severity", plot_severity(curves, ATE.label), _SEVERITY)
    if tracks := _tracks(suite, runs):
        caption = f"The run of '{suite.variants[0].name}' with the largest error: estimate over the gray truth [m]."
        drawn["worst"] = ("Worst cases", plot_tracks(tracks), caption)
    return drawn


def _inputs(jobs: Sequence[Job]) -> dict[str, dict[str, str]]:
    """SHA-256 of every file that the runs of a recording read."""
    files: dict[str, dict[Path, None]] = {}
    for cell in (job.cell for job in jobs):
        given = [getattr(getattr(cell.config, section), key) for section, key in files_of(type(cell.config))]
        read = (cell.bag, cell.map, cell.config_file, *given)
        files.setdefault(cell.recording, {}).update(dict.fromkeys(path for path in read if path is not None))
    digests = {path: sha256_of(path) for path in {path for paths in files.values() for path in paths}}
    return {name: {str(path): digests[path] for path in paths} for name, paths in files.items()}


def _page(
    suite: Suite,
    runs: Sequence[Run],
    entries: Sequence[Entry],
    sentences: Sequence[str],
    worths: Sequence[str],
    provenance: Mapping[str, Any],
    drawn: Mapping[str, tuple[str, Figure, str]],
) -> str:
    bad = [run for run in runs if run.record.outcome != "done"]
    count = (
        f"{len(runs)} runs: {len(suite.recordings)} recordings, {len(suite.variants)} variants, "
        f"{len(suite.failures)} failures, {len(suite.seeds)} seeds; {len(bad)} without a result."
    )
    head = ("failure", "severity", *(v.name for v in suite.variants))
    pictures = [(heading, embedded(image_of(figure)), caption) for heading, figure, caption in drawn.values()]
    return page(
        "ablation.html",
        title=suite.title,
        command=str(provenance["command"]),
        counts=count,
        costs=sentences,
        worths=worths,
        matrices=[(metric.label, head, _matrix(suite, entries, metric.key)) for metric in METRICS],
        pictures=pictures,
        bad=[
            (c.recording, c.failure, c.variant, c.seed, r.outcome, (r.error.strip().splitlines() or [""])[-1])
            for c, r in ((run.cell, run.record) for run in bad)
        ],
        provenance=provenance,
    )


def _matrix(suite: Suite, entries: Sequence[Entry], key: str) -> list[tuple[str, ...]]:
    fixed = str.maketrans({" ": "\u00a0"})  # a line breaks before the number of runs only
    texts = {}
    for e in entries:
        if e.metric.key == key:
            figure, _, count = e.text.rpartition(" (")
            texts[e.failure, e.severity, e.variant] = f"{figure.translate(fixed)} ({count.translate(fixed)}"
    return [
        (failure, _with_unit(suite, failure, severity), *(texts[failure, severity, v.name] for v in suite.variants))
        for failure, severity in rows(suite)
    ]


def _curves(suite: Suite, entries: Sequence[Entry]) -> list[Curves]:
    """Error over each severity that is varied; without failure it is 0, where the failure then does nothing."""
    plots = []
    for failure in suite.failures:
        if failure.severity is None or len(failure.severity.values) < 2:
            continue
        points: dict[str, list[Entry]] = {}
        with_none = failure.nothing_at_zero and 0.0 not in failure.severity.values
        for e in entries:
            if e.metric != ATE or not e.values:
                continue
            if e.failure == failure.name:
                points.setdefault(e.variant, []).append(e)
            elif e.failure == NOTHING and with_none:
                points.setdefault(e.variant, []).append(replace(e, severity=0.0))
        if points:
            plots.append(Curves(failure.name, failure.severity.axis, points))
    return plots


def _tracks(suite: Suite, runs: Sequence[Run]) -> dict[str, Track]:
    tracks = {}
    for name in (NOTHING, *(failure.name for failure in suite.failures)):
        run = worst(suite, runs, name)
        if run is not None and run.record.track is not None:
            tracks[f"{name}, {run.cell.recording}: {ATE.of(run.record):.3g} mm"] = run.record.track
    return tracks
