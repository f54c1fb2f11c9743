"""Pictures: drawn for every shape of run; large sigmas, LOST stretches and jumps of the clock hide nothing."""

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgba
from run_results import figure_eight

from fgloc.config import Config
from fgloc.evaluation import plots as timeline
from fgloc.evaluation import style
from fgloc.evaluation.interactive import interactive
from fgloc.evaluation.metrics import match_result
from fgloc.evaluation.plots import plot_error, plot_timeline, plot_trajectory
from fgloc.evaluation.report import script_data
from fgloc.evaluation.style import TimeAxis
from fgloc.recording.reader import open_recording
from fgloc.recording.truth import true_slips
from fgloc.types import Decision, Landmark, LandmarkMap, Mode, TopicTimes, Trajectory

CONFIG = Config()


def all_modes(n=300):
    return [Mode.OK] * 100 + [Mode.DEAD_RECKONING] * 100 + [Mode.LOST] * (n - 200)


def pixels(figure):
    return matplotlib.image.imread(io.BytesIO(style.image_of(figure)))


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
    zoomed = json.loads(script_data(interactive(result, matched)))
    assert len(zoomed["poses"]["x"]) == len(result.trajectory)
    assert (zoomed["truth"] is None) == (matched is None)
    for figure in (
        plot_trajectory(result, matched),
        plot_error(result, matched),
        plot_timeline(result, matched),
    ):
        image = pixels(figure)
        assert image.shape[1] == 1074
        assert image.shape[0] > 150
        assert np.ptp(image[..., :3]) > 0.5


def test_no_line_leads_across_a_silence_of_the_truth_in_the_plots_to_zoom():
    result = figure_eight()  # the truth is silent in the middle third
    zoomed = json.loads(script_data(interactive(result, match_result(result, CONFIG))))
    for series in (*zoomed["errors"].values(), *zoomed["truth"].values()):
        assert [k for k, value in enumerate(series) if value is None] == [100]


def test_trajectory_axes_are_equal_and_show_everything():
    result = figure_eight()
    axes = plot_trajectory(result, match_result(result, CONFIG)).axes[0]
    assert axes.get_aspect() == 1.0
    for x, y in [(4.0, 0.0), (0.0, 2.6), *result.trajectory.poses[:, :2].tolist()]:
        assert axes.get_xlim()[0] < x < axes.get_xlim()[1]
        assert axes.get_ylim()[0] < y < axes.get_ylim()[1]
    told = [text.get_text() for text in axes.texts]
    assert told[-2:] == ["0", "7"]
    assert all(0.0 < float(text) < 30.0 for text in told[:-2])  # times along the way
    assert len(told) > 5


def ellipses(covariance):
    """The collections of 3σ ellipses of a run whose position has this covariance everywhere."""
    cov = np.eye(3) * 0.01
    cov[:2, :2] = covariance
    base = figure_eight()
    result = replace(base, trajectory=replace(base.trajectory, covs=np.repeat(cov[None], 300, axis=0)))
    return [c for c in plot_trajectory(result, None).axes[0].collections if hasattr(c, "get_widths")]


def test_ellipses_are_three_sigma():
    """Turned by 30°, σ 0.06 m along and 0.02 m across: full axes 0.36 m and 0.12 m."""
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    turn = np.array([[c, -s], [s, c]])
    (small,) = ellipses(turn @ np.diag([0.0036, 0.0004]) @ turn.T)
    np.testing.assert_allclose(small.get_widths(), 0.36)
    np.testing.assert_allclose(small.get_heights(), 0.12)
    np.testing.assert_allclose(np.mod(small.get_angles(), 180), 30)
    assert 20 < len(small.get_offsets()) <= 61


def test_large_ellipses_cover_nothing():
    (large,) = ellipses(np.eye(2))  # 6 m across, in a picture of 7 m
    assert len(large.get_facecolor()) == 0
    assert len(large.get_offsets()) <= 8
    assert ellipses(np.eye(2) * 25.0) == []


def test_the_landmarks_of_an_estimated_map_have_their_sigmas():
    cov = np.diag([0.04, 0.01])
    landmarks = LandmarkMap({3: Landmark(3, np.array([1.0, 2.0, 0.0]), np.eye(3), 0.0, cov)})
    figure = plot_trajectory(replace(figure_eight(), landmarks=landmarks), None)
    *_, around = [c for c in figure.axes[0].collections if hasattr(c, "get_widths")]
    assert around.get_offsets().tolist() == [[1.0, 2.0]]
    assert sorted((around.get_widths()[0], around.get_heights()[0])) == pytest.approx([0.6, 1.2])
    assert {"landmark (id)", "3σ of a landmark"} <= legend_of(figure)


def legend_of(figure):
    return {text.get_text() for legend in figure.legends for text in legend.get_texts()}


def test_legends_name_what_is_drawn_and_nothing_else():
    result = figure_eight()
    matched = match_result(result, CONFIG)
    assert {"marker (id)", "landmark (id)", "truth", "distance from the truth"} <= legend_of(
        plot_trajectory(result, matched)
    )
    assert {"true error", "sighting rejected", "left out, rejected", "1σ"} <= legend_of(plot_timeline(result, matched))
    plain = replace(result, truth=None, decisions=())
    told = legend_of(plot_trajectory(plain, None)) | legend_of(plot_error(plain, None))
    told |= legend_of(plot_timeline(plain, None))
    assert not [text for text in told if re.search("tru|error|reject", text)]


def test_a_relocated_robot_is_not_joined_by_a_line():
    base = figure_eight()
    there = Decision(150, int(base.trajectory.stamps_ns[150]), "place", -1, 9.0, 81.0, 3, 1.0, "jump")
    axes = plot_trajectory(replace(base, decisions=(*base.decisions, there)), None).axes[0]
    assert np.flatnonzero(np.isnan(axes.lines[0].get_xdata())).tolist() == [150]


def test_lost_stretches_flatten_no_axis():
    base = figure_eight(modes=all_modes())
    covs = base.trajectory.covs.copy()
    covs[200:] = np.eye(3) * 400.0
    result = replace(base, trajectory=replace(base.trajectory, covs=covs))
    axes = plot_error(result, None).axes[0]
    to_axes = axes.transData + axes.transAxes.inverted()
    usual, lost = (to_axes.transform((0.0, y))[1] - 0.5 for y in (0.3, 60.0))  # m above the middle
    assert usual > 0.1
    assert lost < 0.5
    assert [text.get_text() for text in axes.texts] == ["logarithmic beyond 0.2 m"]


def test_a_jump_of_the_clock_leaves_no_empty_panels():
    base = figure_eight()
    stamps = base.trajectory.stamps_ns.copy()
    stamps[150:] += 3600 * 10**9
    spans = {"/odom": TopicTimes(np.r_[np.arange(-2.0, 15.0, 0.05), np.arange(3615.0, 3630.0, 0.05)], 640, 1, 3600.0)}
    result = replace(base, trajectory=replace(base.trajectory, stamps_ns=stamps), spans=spans, truth=None)
    axis = TimeAxis.of(result)
    ((start, end),) = axis.cuts
    assert (start, end) == pytest.approx((14.9, 3615.0))
    assert 30.0 < axis.length < 36.0
    for figure in (plot_error(result, None), plot_timeline(result), plot_trajectory(result, None)):
        axes = figure.axes[-1]
        figure.canvas.draw()
        places = axes.transAxes.inverted().transform(axes.transData.transform([(14.9, 1.0), (3615.0, 1.0)]))[:, 0]
        assert 0.4 < places[0] < places[1] < 0.6
        ticks = [t for t in axes.get_xticks() if axes.get_xlim()[0] <= t <= axes.get_xlim()[1]]
        assert min(ticks) <= 0.0
        assert max(ticks) > 3615.0
    np.testing.assert_allclose(axis.place(np.array([-2.0, 0.0, 14.9])), [-2.0, 0.0, 14.9], atol=1e-9)


def test_messages_before_the_first_pose_are_in_the_picture():
    base = figure_eight()
    late = {"/odom": TopicTimes(np.arange(-9.0, 29.9, 0.05), 780, 1, 0.05)}
    axes = panel(plot_timeline(replace(base, spans=late)), "messages received")
    assert axes.get_xlim()[0] < -9.0
    (bars,) = axes.collections[0].get_paths()
    assert bars.vertices[:, 0].min() == pytest.approx(-9.0)


@pytest.mark.parametrize("form", style.FORMATS)
def test_figures_are_the_same_twice_in_every_format(form):
    result = figure_eight()
    once, again = (style.image_of(plot_error(result, None), form) for _ in range(2))
    assert once == again
    assert once[:5] == {"png": b"\x89PNG\r", "svg": b"<?xml", "pdf": b"%PDF-"}[form]


def test_error_is_not_drawn_where_there_is_no_truth():
    result = figure_eight()
    matched = match_result(result, CONFIG)
    x, y = plot_error(result, matched).axes[0].lines[-2].get_data()
    assert np.isnan(y).sum() == 1  # the line breaks once, over the ten silent seconds
    assert len(x) == len(matched.stamps_ns) + 1


def panel(figure, label):
    """The axes of a panel by its title."""
    return next(axes for axes in figure.axes if axes.get_title(loc="left").startswith(label))


def names(axes):
    return [text.get_text() for text in axes.get_yticklabels()]


def test_timeline_shows_silence_and_every_flag():
    figure = plot_timeline(figure_eight())
    assert names(panel(figure, "messages received")) == ["/odom (600)", "/camera (200)"]
    assert [len(bars.get_paths()) for bars in panel(figure, "messages received").collections] == [1, 2]
    assert names(panel(figure, "reasons")) == ["corners: gate (30)"]
    assert len(panel(figure, "reasons").collections[0].get_paths()) == 30


def test_timeline_draws_each_source_at_its_weight_as_last_judged():
    base = figure_eight()
    stamps = base.trajectory.stamps_ns
    gyro = [Decision(k, int(stamps[k]), "gyro", -1, 0.1, 0.01, 3, 0.25 if k < 100 else 1.0, "") for k in range(300)]
    taken_back = [Decision(k, int(stamps[k]), "wheels", -1, 9.0, 81.0, 3, 0.0, "slip") for k in range(50, 60)]
    figure = plot_timeline(replace(base, decisions=(*base.decisions, *gyro, *taken_back)))
    axes = panel(figure, "weight")
    assert names(axes) == ["wheels (310)", "gyro (300)"]
    wheels, inflated = axes.collections[:2]
    assert np.flatnonzero((wheels.get_facecolor() == to_rgba(style.RED)).all(axis=1)).tolist() == list(range(50, 60))
    heights = np.array([np.ptp(box.vertices[:, 1]) for box in inflated.get_paths()])
    np.testing.assert_allclose(heights[:100] / heights[100:200], 0.25)
    assert "wheels: slip (10)" in names(panel(figure, "reasons"))


def test_timeline_shows_the_fit_of_every_sighting_and_who_was_refused():
    base = figure_eight()
    fine = tuple(Decision(k, int(base.trajectory.stamps_ns[k]), "corners", 5, 2.0, 4.0, 8, 1.0, "") for k in range(9))
    figure = plot_timeline(replace(base, decisions=(*base.decisions, *fine)))
    believed, refused = panel(figure, "fit of").lines[:2]
    np.testing.assert_allclose(believed.get_ydata(), 0.5)
    np.testing.assert_allclose(refused.get_ydata(), 81.0 / 8.0)
    assert names(panel(figure, "sightings of")) == ["0", "1", "2", "5"]


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


def test_the_axis_of_time_begins_where_messages_lead_to_the_first_pose():
    """A stray old message, or a topic of another clock, does not move its beginning; without messages it is at 0."""
    old = {
        "/tf_static": TopicTimes(np.array([-35.0]), 1, 1, 0.0),
        "/odom": TopicTimes(np.arange(-2.0, 29.9, 0.05), 638, 1, 0.05),
    }
    result = replace(figure_eight(), spans=old)
    assert TimeAxis.of(result).knots[0] == pytest.approx(-2.0)
    for figure in (plot_trajectory(result, None), plot_error(result, None)):
        assert -1.0 < figure.axes[-1].get_xlim()[0] <= 0.0


@pytest.mark.parametrize(("sigma", "enlarged"), [(1e-3, True), (0.1, False)])
def test_ellipses_are_enlarged_where_they_would_not_be_seen_and_it_is_said(sigma, enlarged):
    base = figure_eight()
    covs = np.repeat(np.diag([sigma, sigma, sigma])[None] ** 2, len(base.trajectory), axis=0)
    figure = plot_trajectory(replace(base, trajectory=replace(base.trajectory, covs=covs)), None)
    (drawn,) = [c for c in figure.axes[0].collections if isinstance(c, EllipseCollection)]
    told = [text.get_text() for text in figure.legends[0].get_texts() if text.get_text().startswith("3σ")]
    assert max(drawn.get_widths()) > 0.1
    assert any(any(c.isdigit() for c in text.removeprefix("3σ")) for text in told) == enlarged
