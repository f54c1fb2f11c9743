"""The files of a run and its report: complete, escaped, the same twice, and nothing is asked of a network."""

import base64
import csv
import html
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import Browser
from run_results import REPORT_FILES, figure_eight

from fgloc.cli.terminal import EXIT_LOST, exit_code
from fgloc.config import Config
from fgloc.errors import OutputError
from fgloc.evaluation import report
from fgloc.evaluation.metrics import compute_metrics
from fgloc.evaluation.report import plotly
from fgloc.files.outputs import read_tum
from fgloc.types import Mode, Protection, Trajectory

KEYS = [
    "duration_s",
    "keyframes",
    "first_pose_s",
    "ate_mean_m",
    "ate_rmse_m",
    "yaw_mae_deg",
    "end_error_m",
    "drift_percent",
    "nees_over_3",
    "coverage",
    "ground",
    "odometry",
    "protection",
    "real_time_factor",
    "step_ms",
    "factors",
    "rejections",
    "installation",
    "findings",
    "judgements",
]
CONFIG = Config()
COMMAND = 'fgloc smooth "first <run>" --out out'


def all_modes(n=300):
    return [Mode.OK] * 100 + [Mode.DEAD_RECKONING] * 100 + [Mode.LOST] * (n - 200)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    result = figure_eight(modes=all_modes())
    report.write_results(result, CONFIG, out, COMMAND, "c0ffee")
    return result, out


def test_all_files_are_written(written):
    _, out = written
    assert {file.name for file in out.iterdir()} == REPORT_FILES


def test_metrics_json_has_the_keys_of_the_contract(written):
    result, out = written
    content = json.loads((out / "metrics.json").read_text())
    assert list(content) == KEYS
    assert content["keyframes"] == 300
    assert content["duration_s"] == pytest.approx(29.9)
    assert content["real_time_factor"] == pytest.approx(2.99)
    assert 0.5 < content["nees_over_3"] < 1.5
    assert list(content["coverage"]) == ["1", "2", "3"]
    assert list(content["step_ms"]) == ["median", "p95", "p99", "max"]
    assert content["rejections"] == result.rejections
    assert content["factors"] == result.counts


def test_truth_based_metrics_are_null_without_truth(tmp_path):
    report.write_results(figure_eight(truth=False), CONFIG, tmp_path, COMMAND)
    content = json.loads((tmp_path / "metrics.json").read_text())
    assert list(content) == KEYS
    assert [key for key in KEYS if content[key] is None] == KEYS[3:13]


@pytest.mark.parametrize(
    ("factor", "narrow", "codes"),
    [
        (1.0, 1.0, []),
        (1.06, 1.0, ["truth.size", "covariance.optimistic"]),
        (1.06, 1e-4, []),  # of poses that are a hundred times less certain, 6 % are chance
        (1.0, 100.0, ["covariance.optimistic"]),
    ],
)
def test_a_wrong_size_and_a_wrong_covariance_are_named_and_coloured(tmp_path, factor, narrow, codes):
    """A map 6 % too large; a covariance a hundredth of what it should be: a NEES/3 of about 100 is not shown calmly."""
    result = figure_eight()
    t = result.trajectory
    poses = t.poses * [factor, factor, 1.0]
    changed = replace(result, trajectory=Trajectory(t.stamps_ns, poses, t.covs / narrow))
    metrics = report.write_results(changed, CONFIG, tmp_path, COMMAND)
    found = {f.code: f for f in metrics.findings}
    assert [code for code in codes if code in found] == codes
    assert ("truth.size" in found) == ("truth.size" in codes)
    page = (tmp_path / "report.html").read_text()
    banner = page.partition('<ul class="findings">')[2].partition("</ul>")[0]
    assert [code in banner for code in codes] == [True] * len(codes)
    tiles = re.findall(r'<div class="tile( \w+)?"><b>[^<]*</b><span>([^<]*)</span>', page)
    coloured = {label.partition(" /")[0] for severity, label in tiles if severity == " warning"}
    named = {"truth.size": "mean distance from truth", "covariance.optimistic": "NEES"}
    assert coloured == {named[code] for code in codes}
    if "truth.size" in codes:
        assert found["truth.size"].value == pytest.approx(factor, abs=0.005)
        assert f" {found['truth.size'].value:.4g} times " in found["truth.size"].text


def test_no_prior_is_blamed_for_poses_that_are_lost():
    result = figure_eight()
    t = result.trajectory
    narrow = replace(result, trajectory=replace(t, covs=t.covs / 100.0))
    lost = replace(narrow, modes=[Mode.LOST] * len(t.stamps_ns))
    named = [{f.code for f in compute_metrics(one, CONFIG).findings} for one in (narrow, lost)]
    assert ["covariance.optimistic" in codes for codes in named] == [True, False]


@pytest.mark.parametrize("factor", [30.0, 0.02])
def test_a_size_that_is_grossly_wrong_is_an_error_and_blames_no_covariance(factor):
    """Ticks taken for radians, a radius in centimetres: no sigma of an installation explains that."""
    result = figure_eight()
    poses = result.trajectory.poses * [factor, factor, 1.0]
    changed = replace(result, trajectory=replace(result.trajectory, poses=poses))
    metrics = compute_metrics(changed, CONFIG)
    found = {f.code: f.severity for f in metrics.findings}
    assert found["truth.size"] == "error"
    assert "covariance.optimistic" not in found
    assert exit_code(changed, metrics) == EXIT_LOST
    assert exit_code(result, compute_metrics(result, CONFIG)) == 0


def test_bounds_on_the_error_are_written_and_held_against_the_truth(tmp_path):
    """One pose is wrong by more than its bound, another has no bound at all; both are told."""
    result = figure_eight()
    bounds = [Protection(np.array([0.5, 0.5, 0.5]), 0.6, "noise") for _ in range(300)]
    bounds[5] = Protection(np.array([1e-6, 0.5, 0.5]), 0.6, "landmark 7")
    bounds[290] = Protection(np.full(3, np.inf), np.inf, "no fix", alert=True)
    metrics = report.write_results(
        replace(result, protections=tuple(bounds)), CONFIG, tmp_path, COMMAND, figures=("png",)
    )
    assert metrics.protection.exceeded == metrics.protection.dangerous == pytest.approx(1 / 200)
    assert metrics.protection.alert_share == pytest.approx(1 / 300)
    assert metrics.protection.causes["landmark"] == pytest.approx(1 / 300)
    assert metrics.protection.median_m == pytest.approx(0.6)
    rows = (tmp_path / "protection.csv").read_text().splitlines()
    assert len(rows) == 301
    assert rows[6].split(",")[1:] == ["1e-06", "0.5", "0.5", "0.6", "landmark 7", "0"]
    assert rows[291].endswith(",inf,inf,inf,inf,no fix,1")
    assert (tmp_path / "protection.png").stat().st_size > 10_000
    picture = base64.b64encode((tmp_path / "protection.png").read_bytes()).decode()
    assert picture in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("bounded", [0, 40])
def test_a_run_most_of_whose_poses_have_no_bound_is_written(tmp_path, bounded):
    result = figure_eight()
    bounds = [Protection(np.full(3, np.inf), np.inf, "no fix", alert=True) for _ in range(300)]
    bounds[:bounded] = [Protection(np.array([0.5, 0.5, 0.1]), 0.6, "noise")] * bounded
    report.write_results(replace(result, protections=tuple(bounds)), CONFIG, tmp_path, COMMAND, figures=())
    found = json.loads((tmp_path / "metrics.json").read_text())["protection"]
    figures = [found[name] for name in ("median_m", "p95_m", "median_yaw_deg")]
    assert figures == (pytest.approx([0.6, 0.6, np.degrees(0.1)]) if bounded else [None] * 3)
    assert found["causes"]["no fix"] == pytest.approx(1.0 - bounded / 300)


def test_truth_of_another_time_counts_as_none(tmp_path):
    result = figure_eight()
    result = replace(result, truth=Trajectory(result.truth.stamps_ns + 10**12, result.truth.poses))
    assert compute_metrics(result, CONFIG).ate_mean_m is None
    report.write_results(result, CONFIG, tmp_path, COMMAND)
    said = report._truth_line(result, None)
    assert "truth" in said
    assert said in html.unescape((tmp_path / "report.html").read_text())


def test_configured_alignment_is_applied():
    result = figure_eight()
    moved = replace(result, truth=Trajectory(result.truth.stamps_ns, result.truth.poses + np.array([5.0, 0, 0])))
    aligned = Config.model_validate({"truth": {"align": "se2"}})
    assert compute_metrics(moved, CONFIG).ate_mean_m > 4.0
    assert compute_metrics(moved, aligned).ate_mean_m == pytest.approx(compute_metrics(result, aligned).ate_mean_m)


def test_written_trajectory_is_the_runs(written):
    result, out = written
    back = read_tum(out / "trajectory.tum")
    assert back.stamps_ns.tolist() == result.trajectory.stamps_ns.tolist()
    np.testing.assert_allclose(back.poses, result.trajectory.poses, atol=3e-9)


def test_config_json_says_where_the_result_is_from(written):
    _, out = written
    content = json.loads((out / "config.json").read_text())
    assert content["command"] == COMMAND
    assert content["input"] == {"path": "first_run", "sha256": "c0ffee"}
    assert set(content["versions"]) == {"python", "fgloc", "gtsam", "numpy", "opencv-contrib-python-headless"}
    assert Config.model_validate(content["config"]) == CONFIG


class _Page(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open, self.links, self.images = [], [], []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag not in ("meta", "img"):
            self.open.append(tag)
        if tag == "img":
            self.images.append(attributes["src"])
        self.links += [attributes[name] for name in ("href", "src") if name in attributes and tag != "img"]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_report_is_complete_by_itself(written):
    _, out = written
    text = (out / "report.html").read_text()
    page = _Page()
    page.feed(text)
    assert page.open == []
    assert page.links == []
    assert text.count("<script") == 3  # the data, Plotly, and what draws with it
    own = text.replace(str(plotly()), "")
    assert not re.search(r"url\(|@import|https?://", own)
    assert len(page.images) == 3
    data = base64.b64decode(page.images[0].removeprefix("data:image/png;base64,"))
    assert data == (out / "trajectory.png").read_bytes()


def test_without_truth_the_report_has_no_word_of_it(tmp_path):
    report.write_results(figure_eight(truth=False), CONFIG, tmp_path, "fgloc smooth bag --out out")
    text = (tmp_path / "report.html").read_text()
    shown = re.sub(r"<(script|style|pre).*?</\1>|<[^>]+>", " ", text, flags=re.DOTALL)
    assert not re.search(r"\btru(e|th)\b|\berrors?\b", shown.replace("reference", ""))
    assert report._truth_line(figure_eight(truth=False), None) in html.unescape(shown)


def test_rows_of_steps_csv_name_their_judgement(written):
    _, out = written
    judged = json.loads((out / "metrics.json").read_text())["judgements"]
    assert [j["number"] for j in judged] == list(range(1, len(judged) + 1))
    with (out / "steps.csv").open() as file:
        rows = list(csv.DictReader(file))
    for j in judged:
        own = [row for row in rows if row["judgement"] == str(j["number"])]
        assert len(own) == j["rows"] > 0
        assert {int(row["step"]) for row in own} <= set(range(j["from_step"], j["to_step"] + 1))
    assert all(row["judgement"] == "" for row in rows if row["kind"] == "wheels")


def test_figures_are_written_in_the_formats_asked_for(tmp_path):
    result = figure_eight()
    report.write_results(result, CONFIG, tmp_path, COMMAND, figures=("svg",))
    names = {file.name for file in tmp_path.iterdir()}
    assert names == REPORT_FILES | {f"{n}.svg" for n in ("trajectory", "error", "timeline")}
    assert "position" in (tmp_path / "trajectory.svg").read_text()  # text stays text
    report.write_results(result, CONFIG, tmp_path, COMMAND)
    assert {file.name for file in tmp_path.iterdir()} == REPORT_FILES


def colored(picture):
    """Share of pixels that are neither grey nor white."""
    return float((np.ptp(picture.astype(int), axis=2) > 60).mean())


@pytest.mark.parametrize("theme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_the_report_in_a_browser_draws_its_plots_and_asks_for_nothing(written, tmp_path, theme):
    _, out = written
    with Browser(tmp_path, (out / "report.html").as_uri(), height=2600, dark=theme == "dark") as browser:
        picture = browser.screenshot(lambda p: colored(p) > 0.01, 60.0)
        plots = browser.run("document.querySelectorAll('.plot:not([hidden]) .main-svg').length")
        closed = browser.run("document.querySelectorAll('details.static:not([open])').length")
    assert (plots > 0, closed) == (True, 2)
    assert colored(picture) > 0.01
    assert (np.median(picture) > 200) == (theme == "light")
    assert not browser.asked


def test_report_tells_all_and_escapes(written):
    _, out = written
    text = (out / "report.html").read_text()
    for expected in (
        "fgloc smooth &#34;first &lt;run&gt;&#34; --out out",
        "odometry&#39;s &lt;twist&gt; is zero",
        "odometry.duplicate_stamp",
        "LOST 33.3 %",
        "do not use these stretches",
        "matched at 200 of 300 keyframes",
        "c0ffee",
    ):
        assert expected in text


def test_results_are_the_same_twice(written, tmp_path):
    result, out = written
    report.write_results(result, CONFIG, tmp_path, COMMAND, "c0ffee")
    for name in REPORT_FILES:
        assert (tmp_path / name).read_bytes() == (out / name).read_bytes(), name


def test_fault_71_failing_run_keeps_the_old_results(written, tmp_path, monkeypatch):
    result, _ = written
    report.write_results(result, CONFIG, tmp_path, "the old command", "c0ffee")
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def full(path, text):
        raise OutputError(f"{path}: disk full")

    monkeypatch.setattr(report, "write_text", full)  # the report is the last file
    with pytest.raises(OutputError):
        report.write_results(replace(result, wall_s=1.0), CONFIG, tmp_path, "the new command", "beef")
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
