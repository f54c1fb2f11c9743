"""Pictures and the report: drawn for every shape of run, complete, and the same twice."""

import base64
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.colors import to_rgba
from run_results import figure_eight

from fgloc.config import Config
from fgloc.errors import OutputError
from fgloc.evaluation import plots, report, style, timeline
from fgloc.evaluation.metrics import compute_metrics, match_result
from fgloc.evaluation.timeline import plot_timeline
from fgloc.recording.outputs import read_tum
from fgloc.recording.reader import open_recording
from fgloc.recording.truth import true_slips
from fgloc.types import Decision, Mode, Trajectory

FILES = {
    "trajectory.tum",
    "covariance.csv",
    "steps.csv",
    "metrics.json",
    "config.json",
    "trajectory.png",
    "timeline.png",
    "report.html",
}
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
    "real_time_factor",
    "step_ms",
    "factors",
    "rejections",
    "installation",
    "mistakes",
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


def pixels(figure):
    return matplotlib.image.imread(io.BytesIO(plots.png(figure)))


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"truth": None},
        {"landmarks": None},
        {"spans": {}, "decisions": ()},
        {"modes": tuple(all_modes())},
        {"modes": (Mode.LOST,) * 300},
        {"trajectory": Trajectory(np.array([1_700_000_000_000_000_000]), np.zeros((1, 3)), np.eye(3)[None] * 1e-4)},
    ],
)
def test_every_picture_is_drawn(change):
    result = replace(figure_eight(), **change)
    if len(result.trajectory) == 1:
        result = replace(result, modes=(Mode.OK,))
    matched = match_result(result, CONFIG)
    for figure in (
        plots.plot_trajectory(result, matched),
        plots.plot_error(result, matched),
        plot_timeline(result, matched),
    ):
        image = pixels(figure)
        assert image.shape[1] == 990
        assert image.shape[0] > 150
        assert np.ptp(image[..., :3]) > 0.5


def test_trajectory_axes_are_equal_and_show_everything():
    result = figure_eight()
    axes = plots.plot_trajectory(result, match_result(result, CONFIG)).axes[0]
    assert axes.get_aspect() == 1.0
    for x, y in [(4.0, 0.0), (0.0, 2.6), *result.trajectory.poses[:, :2].tolist()]:
        assert axes.get_xlim()[0] < x < axes.get_xlim()[1]
        assert axes.get_ylim()[0] < y < axes.get_ylim()[1]
    assert {text.get_text() for text in axes.texts} == {"0", "7"}


def test_ellipses_are_three_sigma():
    """Turned by 30°, σ 0.2 m along and 0.05 m across: full axes 1.2 m and 0.3 m."""
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    cov = np.eye(3) * 0.01
    cov[:2, :2] = np.array([[c, -s], [s, c]]) @ np.diag([0.04, 0.0025]) @ np.array([[c, s], [-s, c]])
    base = figure_eight()
    result = replace(base, trajectory=replace(base.trajectory, covs=np.repeat(cov[None], 300, axis=0)))
    (ellipses,) = [c for c in plots.plot_trajectory(result, None).axes[0].collections if hasattr(c, "get_widths")]
    np.testing.assert_allclose(ellipses.get_widths(), 1.2)
    np.testing.assert_allclose(ellipses.get_heights(), 0.3)
    np.testing.assert_allclose(np.mod(ellipses.get_angles(), 180), 30)
    assert 20 < len(ellipses.get_offsets()) <= 61


def test_error_is_not_drawn_where_there_is_no_truth():
    result = figure_eight()
    matched = match_result(result, CONFIG)
    x, y = plots.plot_error(result, matched).axes[0].lines[-2].get_data()
    assert np.isnan(y).sum() == 1  # the line breaks once, over the ten silent seconds
    assert len(x) == len(matched.stamps_ns) + 1


def panel(figure, label):
    """The axes of a panel by its label."""
    return next(axes for axes in figure.axes if axes.get_ylabel().replace("\n", " ").startswith(label))


def names(axes):
    return [text.get_text() for text in axes.get_yticklabels()]


def test_timeline_shows_silence_and_every_flag():
    figure = plot_timeline(figure_eight())
    assert names(panel(figure, "received")) == ["/odom (600)", "/camera (200)"]
    assert [len(bars.get_paths()) for bars in panel(figure, "received").collections] == [1, 2]
    assert names(panel(figure, "flags")) == ["corners: gate (30)"]
    assert len(panel(figure, "flags").collections[0].get_paths()) == 30


def test_timeline_draws_each_source_at_its_weight_as_last_judged():
    base = figure_eight()
    stamps = base.trajectory.stamps_ns
    gyro = [Decision(k, int(stamps[k]), "gyro", -1, 0.1, 0.01, 3, 0.25 if k < 100 else 1.0, "") for k in range(300)]
    taken_back = [Decision(k, int(stamps[k]), "wheels", -1, 9.0, 81.0, 3, 0.0, "slip") for k in range(50, 60)]
    figure = plot_timeline(replace(base, decisions=(*base.decisions, *gyro, *taken_back)))
    axes = panel(figure, "weight")
    assert names(axes) == ["wheels (310)", "gyro (300)"]
    wheels, inflated = axes.patches[:300], axes.patches[300:]
    off = [i for i, bar in enumerate(wheels) if bar.get_facecolor() == to_rgba(style.RED)]
    assert off == list(range(50, 60))
    heights = np.array([bar.get_height() for bar in inflated])
    np.testing.assert_allclose(heights[:100] / heights[100:200], 0.25)
    assert "wheels: slip (10)" in names(panel(figure, "flags"))


def test_timeline_shows_the_fit_of_every_sighting_and_who_was_refused():
    base = figure_eight()
    fine = tuple(Decision(k, int(base.trajectory.stamps_ns[k]), "corners", 5, 2.0, 4.0, 8, 1.0, "") for k in range(9))
    figure = plot_timeline(replace(base, decisions=(*base.decisions, *fine)))
    believed, refused = panel(figure, "NIS").lines[:2]
    np.testing.assert_allclose(believed.get_ydata(), 0.5)
    np.testing.assert_allclose(refused.get_ydata(), 81.0 / 8.0)
    assert names(panel(figure, "landmark")) == ["0", "1", "2", "5"]


def test_timeline_shows_the_true_error_within_its_bounds_and_the_true_slip():
    result = figure_eight()
    matched = match_result(result, CONFIG)
    start = int(result.trajectory.stamps_ns[0])
    figure = plot_timeline(result, matched, np.array([[start + 10**9, start + 3 * 10**9]]))
    axes = panel(figure, "position error")
    assert np.nanmax(axes.lines[0].get_ydata()) == pytest.approx(matched.distances.max())
    three, one = (c.get_datalim(axes.transData).y1 for c in axes.collections[:2])
    assert three == pytest.approx(3.0 * one)
    (slip,) = [patch for patch in axes.patches if patch.get_facecolor()[:3] == to_rgba(timeline.SLIP)[:3]]
    assert slip.get_x() == pytest.approx(1.0)
    assert slip.get_width() == pytest.approx(2.0)


def test_the_simulators_slip_is_read_from_the_recording():
    sample = Path(__file__).resolve().parent.parent.parent / "datasets" / "samples"
    counts = {}
    for name in ("first_run", "patches_run"):
        with open_recording(sample / name / "bag", CONFIG.recording) as recording:
            spans = true_slips(recording)
        assert (spans[:, 1] > spans[:, 0]).all()
        assert (spans[1:, 0] > spans[:-1, 1]).all()
        counts[name] = np.sum(spans[:, 1] - spans[:, 0]) * 1e-9
    assert counts["first_run"] < 1.0
    assert counts["patches_run"] > 5.0


def test_all_files_are_written(written):
    _, out = written
    assert {file.name for file in out.iterdir()} == FILES


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
    assert [key for key in KEYS if content[key] is None] == KEYS[3:10]


def test_truth_of_another_time_counts_as_none(tmp_path):
    result = figure_eight()
    result = replace(result, truth=Trajectory(result.truth.stamps_ns + 10**12, result.truth.poses))
    assert compute_metrics(result, CONFIG).ate_mean_m is None
    report.write_results(result, CONFIG, tmp_path, COMMAND)
    assert "nothing to compare with" in (tmp_path / "report.html").read_text()


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
    assert not re.search(r"url\(|@import|<script", text)
    assert len(page.images) == 3
    data = base64.b64decode(page.images[0].removeprefix("data:image/png;base64,"))
    assert data == (out / "trajectory.png").read_bytes()


def test_report_tells_all_and_escapes(written):
    _, out = written
    text = (out / "report.html").read_text()
    for expected in (
        "fgloc smooth &quot;first &lt;run&gt;&quot; --out out",
        "odometry&#x27;s &lt;twist&gt; is zero",
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
    for name in FILES:
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
