"""Two pictures of a run: its trajectory, and its error against the 3σ band. The third is in `timeline`."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from fgloc.evaluation.matching import Matched
from fgloc.evaluation.style import (
    BLUE,
    GREEN,
    GREY,
    MODE_LOOKS,
    RED,
    SKY,
    TEXT,
    WIDTH,
    broken,
    legend,
    mode_handles,
    mode_runs,
    seconds,
    shade_modes,
    tidy,
)
from fgloc.types import Landmark, LandmarkMap, Mode, RunResult, Trajectory

FloatArray = NDArray[np.float64]

_MAX_ELLIPSES = 60
_SMALL_M = 0.1  # smaller errors are drawn in millimetres


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
    figure = Figure(figsize=(WIDTH, (WIDTH - 0.55) * ratio + 0.85), dpi=110, layout="constrained")  # room for labels
    axes = figure.add_subplot()
    handles: list[Artist] = [Line2D([], [], color=BLUE, lw=1.8, label="estimate")]
    if matched is not None:
        xy = broken(matched.stamps_ns, matched.truth[:, :2])
        axes.plot(xy[:, 0], xy[:, 1], color="black", lw=3.2, alpha=0.35, solid_capstyle="round")
        handles.append(Line2D([], [], color="black", lw=3.2, alpha=0.35, label="truth"))
    if estimate.covs is not None:
        _draw_ellipses(axes, estimate, extent)
        handles.append(Patch(facecolor=BLUE, alpha=0.2, label="3σ of the position"))
    axes.plot(estimate.poses[:, 0], estimate.poses[:, 1], color=BLUE, lw=1.5)
    for mode, (color, label, _) in MODE_LOOKS.items():
        if mode in result.modes:
            axes.add_collection(LineCollection(_mode_segments(result, mode), colors=color, linewidths=2.4, zorder=3))
            handles.append(Line2D([], [], color=color, lw=2.4, label=label))
    for index, shape, label in ((0, "o", "start"), (-1, "s", "end")):
        look: dict[str, Any] = dict(marker=shape, markersize=7, color=GREEN, markeredgecolor="white", linestyle="none")
        axes.plot(*estimate.poses[index, :2], zorder=5, **look)
        handles.append(Line2D([], [], label=label, **look))
    if result.landmarks is not None and len(result.landmarks):
        _draw_landmarks(axes, result.landmarks, extent)
        handles.append(Line2D([], [], color=RED, marker="D", markersize=6, linestyle="none", label="landmark (id)"))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    tidy(axes)
    legend(figure, handles)
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
    figure = Figure(figsize=(WIDTH, 5.6), dpi=110, layout="constrained")
    rows: list[Axes] = figure.subplots(3, 1, sharex=True).tolist()
    for axis, (axes, name, unit) in enumerate(
        zip(rows, ("x", "y", "yaw"), (length, length, math.degrees(1.0)), strict=True)
    ):
        if bands is not None:
            times = seconds(result, trajectory.stamps_ns)
            t, band = broken(trajectory.stamps_ns, np.column_stack([times, unit * bands[:, axis]])).T
            axes.fill_between(t, -band, band, color=SKY, alpha=0.25, lw=0)
            axes.plot(t, band, color=SKY, lw=0.8)
            axes.plot(t, -band, color=SKY, lw=0.8)
        if matched is not None:
            times = seconds(result, matched.stamps_ns)
            t, error = broken(matched.stamps_ns, np.column_stack([times, unit * matched.errors[:, axis]])).T
            axes.plot(t, error, color=BLUE, lw=1.0)
        axes.axhline(0.0, color=GREY, lw=0.6)
        axes.set_ylabel(f"{name} [{'°' if axis == 2 else symbol}]")
        axes.set(ylim=(-unit * heights[axis], unit * heights[axis]))
        shade_modes(axes, result)
        tidy(axes)
    figure.align_ylabels(rows)
    rows[-1].set_xlabel("time [s]")
    handles: list[Artist] = [Patch(facecolor=SKY, alpha=0.4, label="±3σ of the estimate")]
    if matched is not None:
        handles.insert(0, Line2D([], [], color=BLUE, lw=1.2, label="estimate − truth"))
    handles += mode_handles(result)
    legend(figure, handles)
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
            facecolors=BLUE,
            edgecolors=BLUE,
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
            axes.plot(edge[:, 0], edge[:, 1], color=RED, lw=3.5, solid_capstyle="butt", zorder=4)
        else:
            axes.plot(x, y, marker="D", markersize=5, color=RED, zorder=4)
        away = _label_offset(landmark, extent)
        axes.annotate(
            str(landmark.landmark_id),
            (x, y),
            xytext=away,
            textcoords="offset points",
            ha="center",
            va="center",
            zorder=6,
            **TEXT,
        )


def _label_offset(landmark: Landmark, extent: float) -> tuple[float, float]:
    """Behind a marker's face, where the robot does not drive."""
    if landmark.size_m > 0 and abs(landmark.rotation[2, 2]) < 0.7:
        yaw = float(landmark.planar[2])
        return -11.0 * math.cos(yaw), -11.0 * math.sin(yaw)
    return 8.0, 8.0


def _mode_segments(result: RunResult, mode: Mode) -> list[FloatArray]:
    xy = result.trajectory.poses[:, :2]
    return [xy[max(first - 1, 0) : last + 1] for first, last in mode_runs(result, mode)]
