"""The three pictures of a run: trajectory, error against its 3σ band, timeline. Colors are those of Okabe and Ito."""

from __future__ import annotations

import io
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from fgloc.evaluation.metrics import Matched
from fgloc.types import Decision, Landmark, LandmarkMap, Mode, RunResult, Trajectory

FloatArray = NDArray[np.float64]

_BLUE, _ORANGE, _GREEN, _RED, _SKY, _GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#555555"
_MODE_LOOKS = {Mode.DEAD_RECKONING: (_ORANGE, "dead reckoning", "//"), Mode.LOST: (_RED, "lost", "xx")}
_WIDTH = 9.0  # inches
_MAX_ELLIPSES = 60
_MAX_REASONS = 10
_SMALL_M = 0.1  # smaller errors are drawn in millimetres
_GAP_S = 1.0  # a line is not drawn across a longer silence
_TEXT: dict[str, Any] = {"fontsize": 9, "color": "#222222"}


def png(figure: Figure) -> bytes:
    """A figure as PNG, the same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def plot_trajectory(result: RunResult, matched: Matched | None) -> Figure:
    """The estimate with 3σ ellipses, over the truth and the map's landmarks with their ids, axes equal."""
    estimate = result.trajectory
    parts = [estimate.poses[:, :2]]
    if matched is not None:
        parts.append(matched.truth[:, :2])
    if result.landmarks is not None and len(result.landmarks):
        parts.append(np.array([lm.position[:2] for lm in result.landmarks.landmarks.values()]))
    low, high = np.min([p.min(axis=0) for p in parts], axis=0), np.max([p.max(axis=0) for p in parts], axis=0)
    extent = float(max(*(high - low), 0.5))
    center, half = 0.5 * (low + high), 0.5 * (high - low) + 0.06 * extent
    ratio = float(np.clip(half[1] / half[0], 0.45, 1.0))
    half = np.maximum(half, [half[1] / ratio, half[0] * ratio])
    low, high = center - half, center + half
    figure = Figure(figsize=(_WIDTH, (_WIDTH - 0.55) * ratio + 0.85), dpi=110, layout="constrained")  # room for labels
    axes = figure.add_subplot()
    handles: list[Artist] = [Line2D([], [], color=_BLUE, lw=1.8, label="estimate")]
    if matched is not None:
        xy = _broken(matched.stamps_ns, matched.truth[:, :2])
        axes.plot(xy[:, 0], xy[:, 1], color="black", lw=3.2, alpha=0.35, solid_capstyle="round")
        handles.append(Line2D([], [], color="black", lw=3.2, alpha=0.35, label="truth"))
    if estimate.covs is not None:
        _draw_ellipses(axes, estimate, extent)
        handles.append(Patch(facecolor=_BLUE, alpha=0.2, label="3σ of the position"))
    axes.plot(estimate.poses[:, 0], estimate.poses[:, 1], color=_BLUE, lw=1.5)
    for mode, (color, label, _) in _MODE_LOOKS.items():
        if mode in result.modes:
            axes.add_collection(LineCollection(_mode_segments(result, mode), colors=color, linewidths=2.4, zorder=3))
            handles.append(Line2D([], [], color=color, lw=2.4, label=label))
    for index, shape, label in ((0, "o", "start"), (-1, "s", "end")):
        look: dict[str, Any] = dict(marker=shape, markersize=7, color=_GREEN, markeredgecolor="white", linestyle="none")
        axes.plot(*estimate.poses[index, :2], zorder=5, **look)
        handles.append(Line2D([], [], label=label, **look))
    if result.landmarks is not None and len(result.landmarks):
        _draw_landmarks(axes, result.landmarks, extent)
        handles.append(Line2D([], [], color=_RED, marker="D", markersize=6, linestyle="none", label="landmark (id)"))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    _tidy(axes)
    _legend(figure, handles)
    return figure


def plot_error(result: RunResult, matched: Matched | None) -> Figure:
    """Error in x, y and yaw against its ±3σ band over time; without a truth the band alone."""
    trajectory = result.trajectory
    bands = None if trajectory.covs is None else 3.0 * np.sqrt(np.diagonal(trajectory.covs, axis1=1, axis2=2))
    heights = np.full(3, 1e-9)
    if bands is not None:
        heights = np.maximum(heights, 1.15 * np.percentile(bands, 98, axis=0))  # a short excursion may leave the frame
    if matched is not None:
        heights = np.maximum(heights, 1.1 * np.max(np.abs(matched.errors), axis=0))
    length, symbol = (1e3, "mm") if max(heights[:2]) < _SMALL_M else (1.0, "m")
    figure = Figure(figsize=(_WIDTH, 5.6), dpi=110, layout="constrained")
    rows: list[Axes] = figure.subplots(3, 1, sharex=True).tolist()
    for axis, (axes, name, unit) in enumerate(
        zip(rows, ("x", "y", "yaw"), (length, length, math.degrees(1.0)), strict=True)
    ):
        if bands is not None:
            times = _seconds(result, trajectory.stamps_ns)
            t, band = _broken(trajectory.stamps_ns, np.column_stack([times, unit * bands[:, axis]])).T
            axes.fill_between(t, -band, band, color=_SKY, alpha=0.25, lw=0)
            axes.plot(t, band, color=_SKY, lw=0.8)
            axes.plot(t, -band, color=_SKY, lw=0.8)
        if matched is not None:
            times = _seconds(result, matched.stamps_ns)
            t, error = _broken(matched.stamps_ns, np.column_stack([times, unit * matched.errors[:, axis]])).T
            axes.plot(t, error, color=_BLUE, lw=1.0)
        axes.axhline(0.0, color=_GREY, lw=0.6)
        axes.set_ylabel(f"{name} [{'°' if axis == 2 else symbol}]")
        axes.set(ylim=(-unit * heights[axis], unit * heights[axis]))
        _shade_modes(axes, result)
        _tidy(axes)
    figure.align_ylabels(rows)
    rows[-1].set_xlabel("time [s]")
    handles: list[Artist] = [Patch(facecolor=_SKY, alpha=0.4, label="±3σ of the estimate")]
    if matched is not None:
        handles.insert(0, Line2D([], [], color=_BLUE, lw=1.2, label="estimate − truth"))
    handles += _mode_handles(result)
    _legend(figure, handles)
    return figure


def plot_timeline(result: RunResult) -> Figure:
    """When each sensor was heard, what was fused and what was rejected and why, with modes shaded."""
    keyframes = {"keyframes": _seconds(result, result.trajectory.stamps_ns)}
    fused: dict[str, list[int]] = defaultdict(list)
    rejected: dict[str, list[int]] = defaultdict(list)
    for decision in result.decisions:
        (rejected[_rejection(decision)] if decision.weight == 0 else fused[decision.kind]).append(decision.stamp_ns)
    common = sorted(rejected, key=lambda reason: -len(rejected[reason]))[:_MAX_REASONS]
    groups = [
        ("heard", _GREY, {topic: heard.times for topic, heard in result.spans.items()}),
        ("fused", _BLUE, {kind: _seconds(result, stamps) for kind, stamps in sorted(fused.items())} | keyframes),
        ("rejected", _RED, {reason: _seconds(result, rejected[reason]) for reason in common}),
    ]
    groups = [group for group in groups if group[2]]
    count = sum(len(rows) for _, _, rows in groups)
    figure = Figure(figsize=(_WIDTH, 0.9 + 0.3 * (count + len(groups))), dpi=110, layout="constrained")
    heights = [len(rows) + 0.6 for _, _, rows in groups]
    panels: list[Axes] = figure.subplots(len(groups), 1, sharex=True, squeeze=False, height_ratios=heights)[
        :, 0
    ].tolist()
    for axes, (title, color, rows) in zip(panels, groups, strict=True):
        _draw_activity(axes, rows, color, bridge=title != "rejected")
        axes.set_ylabel(title, fontsize=9)
        _shade_modes(axes, result)
    panels[-1].set_xlabel("time [s]")
    figure.align_ylabels(panels)
    if handles := _mode_handles(result):
        _legend(figure, handles)
    return figure


def _draw_ellipses(axes: Axes, estimate: Trajectory, extent: float) -> None:
    """3σ ellipses, spread evenly over the distance travelled."""
    assert estimate.covs is not None
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(estimate.poses[:, :2], axis=0).T))])
    spacing = max(0.04 * extent, travelled[-1] / _MAX_ELLIPSES, 1e-6)
    chosen = np.unique(np.searchsorted(travelled, np.arange(0.0, travelled[-1] + spacing, spacing)))
    chosen = chosen[chosen < len(estimate)]
    values, vectors = np.linalg.eigh(estimate.covs[chosen, :2, :2])
    axes_m = 6.0 * np.sqrt(np.maximum(values, 0.0))  # full axes: twice 3σ
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    axes.add_collection(
        EllipseCollection(
            axes_m[:, 1],
            axes_m[:, 0],
            angles,
            units="xy",
            offsets=estimate.poses[chosen, :2],
            transOffset=axes.transData,
            facecolors=_BLUE,
            edgecolors=_BLUE,
            linewidths=0.5,
            alpha=0.2,
        )
    )


def _draw_landmarks(axes: Axes, landmarks: LandmarkMap, extent: float) -> None:
    """A standing marker as its edge seen from above, anything else as a diamond; ids beside them."""
    for landmark in landmarks.landmarks.values():
        x, y = landmark.position[:2]
        if landmark.size_m > 0 and abs(landmark.rotation[2, 2]) < 0.7:
            edge = landmark.corners()[:2, :2]
            axes.plot(edge[:, 0], edge[:, 1], color=_RED, lw=3.5, solid_capstyle="butt", zorder=4)
        else:
            axes.plot(x, y, marker="D", markersize=5, color=_RED, zorder=4)
        away = _label_offset(landmark, extent)
        axes.annotate(
            str(landmark.landmark_id),
            (x, y),
            xytext=away,
            textcoords="offset points",
            ha="center",
            va="center",
            zorder=6,
            **_TEXT,
        )


def _label_offset(landmark: Landmark, extent: float) -> tuple[float, float]:
    """Behind a marker's face, where the robot does not drive."""
    if landmark.size_m > 0 and abs(landmark.rotation[2, 2]) < 0.7:
        yaw = float(landmark.planar[2])
        return -11.0 * math.cos(yaw), -11.0 * math.sin(yaw)
    return 8.0, 8.0


def _draw_activity(axes: Axes, rows: Mapping[str, FloatArray], color: str, bridge: bool) -> None:
    """One row a name, with the number of items: bars where items came at a steady rate (`bridge`), else a tick each."""
    everything = np.concatenate(list(rows.values()))
    span = max(float(np.ptp(everything)), 1.0)
    for row, times in enumerate(rows.values()):
        axes.broken_barh(_bars(np.unique(times), span, bridge), (row - 0.3, 0.6), facecolors=color, linewidth=0)
    axes.set_yticks(range(len(rows)), [f"{name} ({len(times)})" for name, times in rows.items()], **_TEXT)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(left=False, labelsize=8)
    axes.grid(axis="x", color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)


def _bars(times: FloatArray, span: float, bridge: bool) -> list[tuple[float, float]]:
    """Start and width of the stretches without a silence; a lone item is wide enough to be seen."""
    if len(times) == 0:
        return []
    steps = np.diff(times)
    silence = min(3.0 * float(np.median(steps)), _GAP_S) if bridge and len(steps) else 0.0
    cuts = np.flatnonzero(steps > max(silence, span / 600.0)) + 1
    return [(float(part[0]), float(np.ptp(part)) + span / 600.0) for part in np.split(times, cuts)]


def _rejection(decision: Decision) -> str:
    return f"{decision.kind}: {decision.reason or 'weight 0'}"


def _seconds(result: RunResult, stamps_ns: NDArray[np.int64] | Sequence[int]) -> FloatArray:
    """Seconds from the first pose."""
    return np.asarray((np.asarray(stamps_ns, dtype=np.int64) - result.trajectory.stamps_ns[0]) * 1e-9)


def _broken(stamps_ns: NDArray[np.int64], columns: FloatArray) -> FloatArray:
    """Rows with a NaN row in each silence, so that no line is drawn across it."""
    gaps = np.flatnonzero(np.diff(stamps_ns) > _GAP_S * 1e9) + 1
    return np.insert(columns, gaps, np.nan, axis=0)


def _mode_segments(result: RunResult, mode: Mode) -> list[FloatArray]:
    xy = result.trajectory.poses[:, :2]
    return [xy[max(first - 1, 0) : last + 1] for first, last in _mode_runs(result, mode)]


def _mode_runs(result: RunResult, mode: Mode) -> list[tuple[int, int]]:
    """First and last index of each stretch in this mode."""
    inside = np.array([m is mode for m in result.modes], dtype=int)
    edges = np.diff(np.concatenate([[0], inside, [0]]))
    return list(zip(np.flatnonzero(edges == 1).tolist(), (np.flatnonzero(edges == -1) - 1).tolist(), strict=True))


def _shade_modes(axes: Axes, result: RunResult) -> None:
    seconds = _seconds(result, result.trajectory.stamps_ns)
    for mode, (color, _, hatch) in _MODE_LOOKS.items():
        for first, last in _mode_runs(result, mode):
            start = float(seconds[max(first - 1, 0)])
            look: dict[str, Any] = dict(facecolor=color, edgecolor=color, alpha=0.18, lw=0, hatch=hatch, zorder=0)
            axes.axvspan(start, float(seconds[last]), **look)


def _mode_handles(result: RunResult) -> list[Artist]:
    return [
        Patch(facecolor=color, edgecolor=color, alpha=0.3, hatch=hatch, label=label)
        for mode, (color, label, hatch) in _MODE_LOOKS.items()
        if mode in result.modes
    ]


def _legend(figure: Figure, handles: Sequence[Artist]) -> None:
    columns = math.ceil(len(handles) / math.ceil(len(handles) / 6))
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)


def _tidy(axes: Axes) -> None:
    axes.grid(color="#e5e5e5", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
