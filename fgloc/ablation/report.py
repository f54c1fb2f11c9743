"""The report of an ablation: one page, the matrix and every run as CSV, and all of it as JSON."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml

from fgloc.ablation.jobs import Job, code_hash
from fgloc.ablation.records import Record
from fgloc.ablation.suite import NOTHING, Suite
from fgloc.ablation.tables import ATE, METRICS, Entry, Run, join, matrix, matrix_csv, rows, runs_csv, sentence, worst
from fgloc.config import files_of
from fgloc.evaluation.ablation_plots import Curves, Point, Tracks, plot_severity, plot_tracks
from fgloc.evaluation.html import page, picture, table
from fgloc.evaluation.plots import png
from fgloc.files.atomic import atomic_folder
from fgloc.recording.outputs import sha256_of, write_json, write_text


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
        write_json(stage / "ablation.json", _as_json(runs, entries, sentences, provenance))
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
    runs: Sequence[Run], entries: Sequence[Entry], sentences: Sequence[str], provenance: Mapping[str, Any]
) -> dict[str, Any]:
    return {
        **provenance,
        "sentences": list(sentences),
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
    body = [
        f"<h1>{escape(suite.title)}</h1>",
        f'<p class="sub"><code>{escape(str(provenance["command"]))}</code></p>',
        f"<p>{len(runs)} runs: {len(suite.recordings)} recordings, {len(suite.variants)} variants, "
        f"{len(suite.failures)} failures, {len(suite.seeds)} seeds; {len(bad)} without a result.</p>",
        "<h2>What each failure costs</h2>",
        f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in sentences)}</ul>" if sentences else "<p>None.</p>",
    ]
    for metric in METRICS:
        body += [f"<h2>{escape(metric.label)}</h2>", _matrix(suite, entries, metric.key)]
    body.append("<p class=sub>Mean ± standard deviation over recordings and seeds (number of runs).</p>")
    curves = _curves(suite, entries)
    if curves:
        caption = f"{ATE.label} over severity; bands are 95 % confidence intervals of the mean over runs."
        body += ["<h2>Severity</h2>", picture(png(plot_severity(curves, ATE.label)), "Severity", escape(caption))]
    tracks = _tracks(suite, runs)
    if tracks:
        caption = f"The run of '{suite.variants[0].name}' with the largest error: estimate over the gray truth [m]."
        body += ["<h2>Worst cases</h2>", picture(png(plot_tracks(tracks)), "Worst cases", escape(caption))]
    if bad:
        content = [
            (
                r.cell.recording,
                r.cell.failure,
                r.cell.variant,
                r.cell.seed,
                r.record.outcome,
                _last_line(r.record.error),
            )
            for r in bad
        ]
        head = ("recording", "failure", "variant", "seed", "outcome", "reason")
        body += ["<h2>Without a result</h2>", table(head, content, numbers=0)]
    text = yaml.safe_dump(dict(provenance), sort_keys=False, allow_unicode=True)
    body += ["<h2>Provenance</h2>", f"<pre>{escape(text)}</pre>"]
    return page(escape(suite.title), body)


def _matrix(suite: Suite, entries: Sequence[Entry], key: str) -> str:
    units = {f.name: f.severity.unit if f.severity is not None else "" for f in suite.failures}
    texts = {(e.failure, e.severity, e.variant): e.text for e in entries if e.metric.key == key}
    content = [
        (
            failure,
            "" if severity is None else f"{severity:g} {units[failure]}".rstrip(),
            *(texts[failure, severity, variant.name] for variant in suite.variants),
        )
        for failure, severity in rows(suite)
    ]
    return table(("failure", "severity", *(v.name for v in suite.variants)), content, numbers=len(suite.variants))


def _curves(suite: Suite, entries: Sequence[Entry]) -> list[Curves]:
    plots = []
    for failure in suite.failures:
        if failure.severity is None or len(failure.severity.values) < 2:
            continue
        points: dict[str, list[Point]] = {}
        for e in entries:
            mean = e.mean
            if (e.failure, e.metric) == (failure.name, ATE) and mean is not None and e.severity is not None:
                points.setdefault(e.variant, []).append(Point(e.severity, mean, e.interval))
        if points:
            unit = (
                f"{failure.severity.field} [{failure.severity.unit}]"
                if failure.severity.unit
                else failure.severity.field
            )
            plots.append(Curves(failure.name, unit, points))
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
