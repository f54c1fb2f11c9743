"""The report says what the records say: means, spreads, counts, costs, and what gave no result."""

import csv
import hashlib
import io
import json
import re
import typing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import fgloc
from fgloc import cli
from fgloc.ablation.failures import AnyFailure
from fgloc.ablation.jobs import Cost, Job, Record, Track, execute, make_jobs
from fgloc.ablation.report import (
    ATE,
    METRICS,
    Curves,
    Entry,
    _curves,
    _measurable,
    join,
    matrix,
    matrix_csv,
    plot_failures,
    plot_severity,
    plot_tracks,
    rows,
    runs_csv,
    sentence,
    worst,
    worth,
    write_report,
)
from fgloc.ablation.suite import Cell, FailureEntry, Suite, expand, load_suite
from fgloc.config import Config

ROOT = Path(fgloc.__file__).resolve().parent.parent
SUITE = Suite.model_validate(
    {
        "title": "Blind & dead",
        "seeds": [0, 1, 2],
        "recordings": [{"name": "a", "bag": "a"}],
        "variants": [{"name": "full"}, {"name": "bare"}],
        "failures": [
            {
                "name": "blind",
                "chain": [{"kind": "dropout", "sensor": "camera", "when": {"bursts": 1}}],
                "severity": {"field": "when.burst_s", "values": [1, 2], "unit": "s"},
            },
            {"name": "dark", "chain": [{"kind": "darkness"}]},
        ],
    }
)
ERRORS = {1.0: [0.02, 0.03, 0.04], 2.0: [0.1, 0.2, None]}  # m by severity, of `full`


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"stands for a recording")
    return path


def made(bag):
    """Jobs of the suite with records as a run would leave them."""
    jobs, records = [], {}
    for failure, severity in rows(SUITE):
        for variant in ("full", "bare"):
            for seed in (0,) if failure == "none" else SUITE.seeds:
                key = f"{failure}-{severity}-{variant}-{seed}"
                chain = () if failure == "none" else SUITE.failures[0].chain
                cell = Cell(
                    recording="a",
                    variant=variant,
                    failure=failure,
                    severity=severity,
                    seed=seed,
                    bag=bag,
                    map=None,
                    config_file=None,
                    config=Config(),
                    mode="online",
                    start="configured",
                    chain=chain,
                )
                jobs.append(Job(key=key, cell=cell))
                error = ERRORS[severity][seed] if failure == "blind" else 0.01
                if variant == "full" and error is None:
                    record = Record(key=key, outcome="refused", error="EstimatorError: <no> pose", cost=COST)
                else:
                    affected = {"dropout": 5} if failure == "blind" else {}
                    track = {"estimate": [(0, 0), (1, error or 0)], "truth": [(0, 0), (1, 0)]}
                    figures = {"ate_mean_m": error if variant == "full" else 0.5, "coverage": {"3": 0.99}}
                    record = Record(key=key, outcome="done", figures=figures, affected=affected, track=track, **ALWAYS)
                records[key] = record
    return jobs, records


COST = Cost(seconds=1.0, cpu_s=1.0, peak_mb=100.0)
ALWAYS = {"cost": COST, "sensors": ("wheels", "command")}


def test_matrix_holds_mean_spread_and_counts(bag):
    entries = {(e.failure, e.severity, e.variant): e for e in matrix(SUITE, join(*made(bag))) if e.metric is ATE}
    mild, harsh = entries["blind", 1.0, "full"], entries["blind", 2.0, "full"]
    assert mild.mean == pytest.approx(30.0)
    assert mild.spread == pytest.approx(10.0)
    assert (len(harsh.values), harsh.runs, harsh.text) == (2, 3, "150 ± 71 (2 of 3)")
    assert entries["none", None, "full"].text == "10 (1)"
    assert entries["blind", 2.0, "bare"].values == (500.0,) * 3


def test_intervals_are_of_five_runs_and_stay_in_range(bag):
    jobs, records = made(bag)
    assert "" not in [row["spread"] for row in table_of(jobs, records, "blind", "full")]
    assert {row["low_95"] + row["high_95"] for row in table_of(jobs, records, "blind", "full")} == {""}
    five = Entry("x", None, "full", ATE, (20.0, 25.0, 30.0, 35.0, 40.0), 5)
    assert five.interval == pytest.approx(
        (30.0 - 2.7764 * 62.5**0.5 / 5**0.5, 30.0 + 2.7764 * 62.5**0.5 / 5**0.5), 1e-4
    )
    assert replace(five, values=(0.0, 0.0, 0.0, 0.0, 100.0)).interval[0] == 0.0
    within = next(metric for metric in METRICS if metric.key == "coverage.3")
    assert replace(five, metric=within, values=(90.0, 100.0, 100.0, 100.0, 100.0)).interval[1] == 100.0


def test_a_failure_that_changed_no_message_has_no_figure(bag):
    jobs, records = made(bag)
    for row in table_of(jobs, records, "dark", "full"):
        assert (row["mean"], row["spread"], row["n"], row["runs_changed"]) == ("", "", "3", "0")
    assert [row["runs_changed"] for row in table_of(jobs, records, "blind", "full")] == ["3", "2"]
    assert [(row["mean"], row["runs_changed"]) for row in table_of(jobs, records, "none", "full")] == [("10.0", "")]
    runs = join(jobs, records)
    changed = {(row["failure"], row["messages_changed"]) for row in csv.DictReader(io.StringIO(runs_csv(runs)))}
    assert changed == {("none", ""), ("blind", "5"), ("blind", ""), ("dark", "0")}  # "": a run without a result
    assert worst(SUITE, runs, "dark") is None
    dark = [run for run in runs if run.cell.failure == "dark"]
    assert worth(SUITE, dark, "bare") is None


def test_points_of_a_failure_that_changed_no_message_are_hollow(bag):
    jobs, records = made(bag)
    still = {key: record.model_copy(update={"affected": {}}) for key, record in records.items()}
    entries, none_hit = matrix(SUITE, join(jobs, records)), matrix(SUITE, join(jobs, still))

    def hollow(figure):
        return sum(len(line.get_xdata()) for line in figure.axes[0].lines if line.get_markerfacecolor() == "white")

    assert hollow(plot_failures(SUITE, entries)) == 2  # dark, of both variants
    assert hollow(plot_failures(SUITE, none_hit)) == 6
    assert hollow(plot_severity(_curves(SUITE, entries), ATE.label)) == 0
    assert hollow(plot_severity(_curves(SUITE, none_hit), ATE.label)) == 4  # none at 0 is a result


def table_of(jobs, records, failure, variant):
    """Rows of matrix.csv with the error of one failure and variant."""
    table = csv.DictReader(io.StringIO(matrix_csv(matrix(SUITE, join(jobs, records)))))
    return [r for r in table if (r["failure"], r["variant"], r["figure"]) == (failure, variant, ATE.label)]


def figures(text):
    """Numbers of a sentence, as they are written."""
    return re.findall(r"(?<![\w.])[+-]?\d+(?:\.\d+)?", text)


def test_sentences_say_the_cost_and_its_limits(bag):
    runs = join(*made(bag))
    blind = sentence(SUITE, runs, "blind")
    assert blind.startswith("Blind at 2 s: ")
    assert "'full'" in blind
    assert figures(blind)[:4] == ["2", "150", "10", "2"]  # s, mm with and without it, runs
    assert "1 of 3 runs" in blind
    dark = sentence(SUITE, runs, "dark")
    assert (dark.split()[0], figures(dark)) == ("Dark", [])
    assert dark.endswith(": wheels, command.")  # what could be failed instead


def changed(runs, errors):
    """The runs with these errors [m] of `full` by severity of blind; 'none' has 10 mm."""
    out = []
    for run in runs:
        values = errors.get(run.cell.severity) if run.cell.variant == "full" else None
        if values is not None:
            figures = {"ate_mean_m": values[run.cell.seed]}
            run = replace(run, record=run.record.model_copy(update={"figures": figures, "outcome": "done"}))
        out.append(run)
    return out


@pytest.mark.parametrize(
    ("errors", "said"),
    [
        ((0.0100, 0.0105, 0.0102), ["10", "3", "+0.23", "0.25"]),  # mm, runs, change and its spread
        ((0.0103, 0.0105, 0.0107), ["10.5", "10", "3", "+0.50", "0.20", "5"]),  # mm with and without it
        ((0.0080, 0.0085, 0.0080), ["8.17", "10", "3", "-1.83", "0.29", "5"]),
    ],
)
def test_a_change_within_its_spread_is_no_change(bag, errors, said):
    told = sentence(SUITE, changed(join(*made(bag)), {2.0: errors}), "blind")
    assert told.startswith("Blind at 2 s: ")
    assert figures(told) == ["2", *said]


def test_a_rise_or_fall_is_claimed_of_five_runs_or_more(bag):
    runs = changed(join(*made(bag)), {2.0: (0.0080, 0.0085, 0.0080)})
    assert "falls" not in sentence(SUITE, runs, "blind")
    more = [run for run in runs if (run.cell.severity, run.cell.variant) == (2.0, "full")]
    assert "falls from 10 to 8.17 mm" in sentence(SUITE, [*runs, *more], "blind")


def test_of_many_runs_a_change_smaller_than_its_spread_is_one():
    pairs = [(10.0, 10.0 + (3.0 if k % 2 else -1.0)) for k in range(40)]  # +1 ± 2, 0.3 for the mean
    assert _measurable(pairs)
    assert not _measurable(pairs[:4])


def test_a_variant_that_changes_nothing_is_said_to(bag):
    same = {1.0: (0.5, 0.49, 0.51), 2.0: (0.52, 0.49, 0.5)}
    runs = [run for run in changed(join(*made(bag)), same) if run.cell.failure == "blind"]
    told = worth(SUITE, runs, "bare")
    assert re.findall(r"'(\w+)'", told) == ["bare", "full", "blind"]
    assert figures(told) == ["500", "500", "1", "3"]  # mm, mm, s, runs; no factor


def test_a_variant_is_compared_where_it_matters_most(bag):
    runs = join(*made(bag))
    told = worth(SUITE, runs, "bare")
    assert re.findall(r"'(\w+)'", told) == ["bare", "full"]
    assert figures(told) == ["500", "10", "50.0", "1"]  # mm, mm, times, runs
    told = worth(SUITE, [run for run in runs if run.cell.failure == "blind" or run.cell.variant == "bare"], "bare")
    assert re.findall(r"'(\w+)'", told)[:3] == ["bare", "full", "blind"]
    assert figures(told)[:5] == ["500", "30", "1", "16.7", "3"]


def test_few_runs_are_drawn_one_by_one_and_axes_speak(bag):
    entries = matrix(SUITE, join(*made(bag)))
    (curves,) = _curves(SUITE, entries)
    assert curves.unit == "duration [s]"
    axes = plot_severity([curves], ATE.label).axes[0]
    assert not axes.collections  # of three runs no band
    means = [line.get_xydata().tolist() for line in axes.lines if line.get_marker() == "o"]
    assert means == [[[0, 10], [1, 30], [2, 150]], [[0, 500], [1, 500], [2, 500]]]
    assert sum(len(line.get_xdata()) for line in axes.lines if line.get_marker() == ".") == 3 + 2 + 3 + 3
    many = Entry("x", 1.0, "full", ATE, (2.0, 2.5, 3.0, 3.5, 4.0), 5)
    axes = plot_severity([Curves("x", "y", {"full": [many, many]})], ATE.label).axes[0]
    assert len(axes.collections) == 1
    figure = plot_tracks({"x": Track(estimate=[(0, 0), (1, 1)], truth=[(0, 0), (1, 0)])})
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["estimate", "truth", "start"]


@pytest.mark.parametrize(
    ("chain", "field", "nothing"),
    [
        ([{"kind": "dropout", "sensor": "camera"}], "when.share", True),
        ([{"kind": "sighting_noise"}], "range_m", True),
        ([{"kind": "sighting_noise", "corner_px": 1.0}], "range_m", False),  # noise of corners is left
        ([{"kind": "moved_marker"}], "yaw_rad", False),  # they are 0.3 m away
        ([{"kind": "truncated"}], "keep", False),
        ([{"kind": "latency", "sensor": "camera"}, {"kind": "darkness"}], "delay_s", False),
    ],
)
def test_severity_0_is_the_run_without_failure_where_it_does_nothing(bag, chain, field, nothing):
    blind = {"name": "blind", "chain": chain, "severity": {"field": field, "values": [1, 0.5]}}
    suite = SUITE.model_copy(update={"failures": (FailureEntry.model_validate(blind),)})
    (curves,) = _curves(suite, matrix(SUITE, join(*made(bag))))
    assert [p.severity for p in curves.curves["full"]] == [0.0, 1.0, 2.0][not nothing :]


def test_worst_case_is_the_largest_error(bag):
    assert worst(SUITE, join(*made(bag)), "blind").key == "blind-2.0-full-1"


def test_report_files_agree(bag, tmp_path):
    out = tmp_path / "out"
    jobs, records = made(bag)
    sentences = write_report(SUITE, jobs, records, out, "fgloc ablate x.yaml", ("pdf", "svg"))
    assert {"failures.pdf", "failures.svg", "worst.pdf"} <= {file.name for file in out.iterdir()}
    page = (out / "report.html").read_text()
    assert "Blind &amp; dead" in page
    assert "<no> pose" not in page
    assert page.count("data:image/png") == 3
    assert page.count("EstimatorError: &lt;no&gt; pose") == 1
    assert "http" not in page.replace("http-equiv", "")
    content = json.loads((out / "ablation.json").read_text())
    assert content["sentences"] == sentences
    assert content["inputs"] == {"a": {str(bag): hashlib.sha256(b"stands for a recording").hexdigest()}}
    with (out / "matrix.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(content["matrix"]) == 4 * 2 * 5
    for row, entry in zip(table, content["matrix"], strict=True):
        assert (row["mean"] or None) == (None if entry["mean"] is None else str(entry["mean"]))
    with (out / "runs.csv").open() as file:
        runs = list(csv.DictReader(file))
    assert len(runs) == len(jobs)
    full = [float(r[ATE.label]) for r in runs if r["failure"] == "blind" and r["variant"] == "full" and r[ATE.label]]
    assert np.allclose(full, [20, 30, 40, 100, 200])


def test_command_writes_the_report_and_repeats_it(tmp_path):
    """Bundled recording, cut short: its records are made here, so that the command starts no processes."""
    suite = tmp_path / "suite.yaml"
    bag = ROOT / "datasets" / "samples" / "first_run" / "bag"
    suite.write_text(
        f"title: short\nrecordings: [{{name: first, bag: {bag}}}]\nvariants:\n"
        "  - {name: full, config: {recording: {topics: {image: none}}}, start: truth}\n"
        "failures: [{name: short, chain: [{kind: truncated, keep: 0.2}]}]\n"
    )
    out = tmp_path / "out"
    for job in make_jobs(expand(load_suite(suite), tmp_path)):
        execute(job, out)

    def ablate():
        done = CliRunner().invoke(cli.app, ["ablate", str(suite), "--out", str(out)])
        assert done.exit_code == 0, done.output
        return done.stdout

    said = ablate()
    assert said.splitlines()[0].startswith("Short: ")
    assert said.splitlines()[-1] == f"report: {out / 'report.html'}"
    before = (out / "matrix.csv").read_bytes()
    assert ablate() == said
    assert (out / "matrix.csv").read_bytes() == before
    broken = CliRunner().invoke(cli.app, ["ablate", str(tmp_path / "nowhere.yaml"), "--out", str(out)])
    assert broken.exit_code == 1
    assert broken.stderr.startswith("error: ")


def test_document_names_every_failure_and_its_suite_loads(tmp_path):
    text = (ROOT / "docs" / "ablation.md").read_text(encoding="utf-8")
    (tmp_path / "suite.yaml").write_text(text.split("```yaml\n")[1].split("```")[0])
    assert len(load_suite(tmp_path / "suite.yaml").variants) == 3
    kinds = [c.model_fields["kind"].default for c in typing.get_args(typing.get_args(AnyFailure)[0])]
    assert len(kinds) > 20
    assert not [kind for kind in kinds if f"`{kind}`" not in text]


@pytest.mark.parametrize("path", sorted((ROOT / "ablations").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_suites_load(path):
    assert load_suite(path).failures


def test_every_kind_of_failure_is_in_the_suite_of_all():
    named = {
        failure.kind for entry in load_suite(ROOT / "ablations" / "every.yaml").failures for failure in entry.chain
    }
    assert named == {c.model_fields["kind"].default for c in typing.get_args(typing.get_args(AnyFailure)[0])}
