"""The report of an ablation: one page, the matrix and every run as CSV, and all of it as JSON."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fgloc.ablation.jobs import Job, code_hash
from fgloc.ablation.records import Record
from fgloc.ablation.suite import NOTHING, Suite
from fgloc.ablation.tables import (
    ATE,
    METRICS,
    Entry,
    Run,
    join,
    matrix,
    matrix_csv,
    rows,
    runs_csv,
    sentence,
    worst,
    worth,
)
from fgloc.config import files_of
from fgloc.evaluation.ablation_plots import FEWEST_FOR_BAND, Curves, Point, Tracks, plot_severity, plot_tracks
from fgloc.evaluation.html import embedded, page
from fgloc.evaluation.style import png
from fgloc.files.atomic import atomic_folder
from fgloc.files.outputs import sha256_of, write_json, write_text

_SEVERITY = (
    f"{ATE.label} over severity. Bands are 95 % confidence intervals of the mean, of {FEWEST_FOR_BAND} runs or more; "
    "of fewer every run is a dot."
)


def write_report(
    suite: Suite, jobs: Sequence[Job], records: Mapping[str, Record], out: Path, command: str
) -> list[str]:
    """Write ``report.html``, ``matrix.csv``, ``runs.csv`` and ``ablation.json``; return a sentence per failure.

    Raises:
        OutputError: the folder cannot be written; an old report is kept.
    """
    runs = join(jobs, records)
    entries = matrix(suite, runs)
    sentences = [sentence(suite, runs, failure.name) for failure in suite.failures]
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
        write_json(stage / "ablation.json", _as_json(runs, entries, sentences, _worths(suite, runs), provenance))
        write_text(stage / "report.html", _page(suite, runs, entries, sentences, provenance))
    return sentences


def failed(jobs: Sequence[Job], records: Mapping[str, Record]) -> list[Run]:
    """Runs that gave no result: refused for their input, or crashed and quarantined."""
    return [run for run in join(jobs, records) if run.record.outcome != "done"]


def _inputs(jobs: Sequence[Job]) -> dict[str, dict[str, str]]:
    """SHA-256 of every file that the runs of a recording read."""
    files: dict[str, dict[Path, None]] = {}
    for cell in (job.cell for job in jobs):
        given = [getattr(getattr(cell.config, section), key) for section, key in files_of(type(cell.config))]
        read = (cell.bag, cell.map, cell.config_file, *given)
        files.setdefault(cell.recording, {}).update(dict.fromkeys(path for path in read if path is not None))
    digests = {path: sha256_of(path) for path in {path for paths in files.values() for path in paths}}
    return {name: {str(path): digests[path] for path in paths} for name, paths in files.items()}


def _as_json(
    runs: Sequence[Run],
    entries: Sequence[Entry],
    sentences: Sequence[str],
    worths: Sequence[str],
    provenance: Mapping[str, Any],
) -> dict[str, Any]:
    return {
        **provenance,
        "sentences": list(sentences),
        "variants": list(worths),
        "matrix": [
            {
                "failure": e.failure,
                "severity": e.severity,
                "variant": e.variant,
                "figure": e.metric.label,
                "mean": e.mean,
                "spread": e.spread,
                "interval_95": e.interval,
                "n": len(e.values),
                "runs": e.runs,
            }
            for e in entries
        ],
        "runs": [
            {
                "key": run.key,
                "recording": run.cell.recording,
                "failure": run.cell.failure,
                "severity": run.cell.severity,
                "variant": run.cell.variant,
                "seed": run.cell.seed,
                **run.record.model_dump(mode="json", include={"outcome", "error", "figures", "modes", "affected"}),
            }
            for run in runs
        ],
    }


def _page(
    suite: Suite, runs: Sequence[Run], entries: Sequence[Entry], sentences: Sequence[str], provenance: Mapping[str, Any]
) -> str:
    bad = [run for run in runs if run.record.outcome != "done"]
    count = (
        f"{len(runs)} runs: {len(suite.recordings)} recordings, {len(suite.variants)} variants, "
        f"{len(suite.failures)} failures, {len(suite.seeds)} seeds; {len(bad)} without a result."
    )
    head = ("failure", "severity", *(v.name for v in suite.variants))
    pictures = []
    if curves := _curves(suite, entries):
        pictures.append(("Severity", embedded(png(plot_severity(curves, ATE.label))), _SEVERITY))
    if tracks := _tracks(suite, runs):
        caption = f"The run of '{suite.variants[0].name}' with the largest error: estimate over the gray truth [m]."
        pictures.append(("Worst cases", embedded(png(plot_tracks(tracks))), caption))
    return page(
        "ablation.html",
        title=suite.title,
        command=str(provenance["command"]),
        counts=count,
        costs=sentences,
        worths=_worths(suite, runs),
        matrices=[(metric.label, head, _matrix(suite, entries, metric.key)) for metric in METRICS],
        pictures=pictures,
        bad=[(*_named(r), r.record.outcome, _last_line(r.record.error)) for r in bad],
        provenance=provenance,
    )


def _named(run: Run) -> tuple[str, str, str, int]:
    return run.cell.recording, run.cell.failure, run.cell.variant, run.cell.seed


def _worths(suite: Suite, runs: Sequence[Run]) -> list[str]:
    """A sentence for each variant but the first."""
    told = [worth(suite, runs, variant.name) for variant in suite.variants[1:]]
    return [text for text in told if text is not None]


def _matrix(suite: Suite, entries: Sequence[Entry], key: str) -> list[tuple[str, ...]]:
    units = {f.name: f.severity.unit if f.severity is not None else "" for f in suite.failures}
    fixed = str.maketrans({" ": "\u00a0"})  # a line breaks before the number of runs only
    texts = {}
    for e in entries:
        if e.metric.key == key:
            figure, _, count = e.text.rpartition(" (")
            texts[e.failure, e.severity, e.variant] = f"{figure.translate(fixed)} ({count.translate(fixed)}"
    return [
        (
            failure,
            "" if severity is None else f"{severity:g} {units[failure]}".rstrip(),
            *(texts[failure, severity, variant.name] for variant in suite.variants),
        )
        for failure, severity in rows(suite)
    ]


def _curves(suite: Suite, entries: Sequence[Entry]) -> list[Curves]:
    plots = []
    for failure in suite.failures:
        if failure.severity is None or len(failure.severity.values) < 2:
            continue
        points: dict[str, list[Point]] = {}
        for e in entries:
            mean = e.mean
            if (e.failure, e.metric) == (failure.name, ATE) and mean is not None and e.severity is not None:
                points.setdefault(e.variant, []).append(Point(e.severity, mean, e.interval, e.values))
        if points:
            plots.append(Curves(failure.name, failure.severity.axis, points))
    return plots


def _tracks(suite: Suite, runs: Sequence[Run]) -> list[Tracks]:
    plots = []
    for name in (NOTHING, *(failure.name for failure in suite.failures)):
        run = worst(suite, runs, name)
        if run is not None and run.record.track is not None:
            title = f"{name}, {run.cell.recording}: {ATE.of(run.record):.3g} mm"
            plots.append(Tracks(title, run.record.track.estimate, run.record.track.truth))
    return plots


def _last_line(error: str) -> str:
    lines = error.strip().splitlines()
    return lines[-1] if lines else ""
