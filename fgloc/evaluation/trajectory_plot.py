"""The picture of a run's trajectory: the map, the way with its times, and below it how large sigma and error are."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D

from fgloc.evaluation.error_scale import ErrorScale
from fgloc.evaluation.matching import Matched
from fgloc.evaluation.style import (
    BLUE,
    DPI,
    GREEN,
    MODE_LOOKS,
    NORMAL,
    RED,
    SKY,
    SMALL,
    TEXT,
    WIDTH,
    after_gaps,
    broken,
    legend,
    mode_runs,
    seconds,
    shade_modes,
    tidy,
)
from fgloc.evaluation.time_axis import TimeAxis
from fgloc.types import FloatArray, IntArray, Landmark, LandmarkMap, RunResult, Trajectory

_MAX_ELLIPSES = 60
_FILLED = 0.1  # of the picture: larger ellipses are outlines, or they would cover the map ...
_DRAWN = 1.0  # ... and still larger ones lie around it, and are left out
_MAX_OUTLINES = 8
_TIMES = 8  # written along the way, about
_JUMPS = ("jump", "overruled by sightings")


def plot_trajectory(result: RunResult, matched: Matched | None) -> Figure:
    """The estimate with its times and 3σ ellipses, the truth, the landmarks; below, sigma and true error over time."""
    low, high = _bounds(result, matched)
    extent = float(max(high - low))
    ratio = float((high - low)[1] / (high - low)[0])
    below = 1.35 if result.trajectory.covs is not None or matched is not None else 0.0
    map_height = (WIDTH - 0.45) * ratio + 0.4
    figure = Figure(figsize=(WIDTH, map_height + below + 0.45), dpi=DPI, layout="constrained")
    axes, *panel = figure.subplots(
        2 if below else 1, 1, squeeze=False, height_ratios=[map_height, below] if below else None
    )[:, 0].tolist()
    handles = _draw_way(axes, result, matched, extent)
    if result.landmarks is not None and len(result.landmarks):
        handles += _draw_landmarks(axes, result.landmarks)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_xlabel("x [m]", fontsize=NORMAL)
    axes.set_ylabel("y [m]", fontsize=NORMAL)
    tidy(axes)
    if below:
        handles += _draw_distance(panel[0], result, matched)
    legend(figure, handles)
    return figure


def _bounds(result: RunResult, matched: Matched | None) -> tuple[FloatArray, FloatArray]:
    """Lower left and upper right corner ``(2,)`` [m]: everything, no flatter than half, no taller than square."""
    parts = [result.trajectory.poses[:, :2]]
    if matched is not None:
        parts.append(matched.truth[:, :2])
    if result.landmarks is not None and len(result.landmarks):
        parts.append(np.array([lm.position[:2] for lm in result.landmarks.landmarks.values()]))
    low, high = np.min([p.min(axis=0) for p in parts], axis=0), np.max([p.max(axis=0) for p in parts], axis=0)
    extent = float(max(*(high - low), 0.5))
    center, half = 0.5 * (low + high), 0.5 * (high - low) + 0.06 * extent
    ratio = float(np.clip(half[1] / half[0], 0.45, 1.0))
    half = np.maximum(half, [half[1] / ratio, half[0] * ratio])
    return center - half, center + half


def _draw_way(axes: Axes, result: RunResult, matched: Matched | None, extent: float) -> list[Artist]:
    """Estimate, truth, ellipses, modes, directions and times; legend entries of them."""
    estimate = result.trajectory
    handles: list[Artist] = [Line2D([], [], color=BLUE, lw=1.8, label="estimate, with times [s]")]
    if estimate.covs is not None:
        handles += _draw_ellipses(axes, estimate, extent)
    jumps = relocated(result)
    xy = np.insert(estimate.poses[:, :2], np.union1d(after_gaps(estimate.stamps_ns), jumps), np.nan, axis=0)
    if len(jumps):
        parts = [estimate.poses[k - 1 : k + 1, :2] for k in jumps]
        axes.add_collection(LineCollection(parts, colors=RED, linewidths=1.0, linestyles=":", zorder=3))
        handles.append(Line2D([], [], color=RED, lw=1.0, linestyle=":", label="relocated"))
    axes.plot(xy[:, 0], xy[:, 1], color=BLUE, lw=1.8)
    for mode, (color, label, _) in MODE_LOOKS.items():
        if mode in result.modes:
            parts = [estimate.poses[max(first - 1, 0) : last + 1, :2] for first, last in mode_runs(result, mode)]
            axes.add_collection(LineCollection(parts, colors=color, linewidths=2.4, zorder=3))
            handles.append(Line2D([], [], color=color, lw=2.4, label=label))
    if matched is not None:
        true = broken(matched.stamps_ns, matched.truth[:, :2])
        axes.plot(true[:, 0], true[:, 1], color="black", lw=0.8, linestyle=(0, (4, 3)), zorder=3.5)
        handles.insert(1, Line2D([], [], color="black", lw=0.8, linestyle=(0, (4, 3)), label="truth"))
    _draw_times(axes, result, extent)
    for index, shape, label in ((0, "o", "start"), (-1, "s", "end")):
        look: dict[str, Any] = dict(marker=shape, markersize=6, color=GREEN, markeredgecolor="white", linestyle="none")
        axes.plot(*estimate.poses[index, :2], zorder=5, **look)
        handles.append(Line2D([], [], label=label, **look))
    return handles


def travelled(poses: FloatArray) -> FloatArray:
    """Distance travelled ``(n,)`` [m] at each of the poses ``(n, 3)``."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])


def relocated(result: RunResult) -> IntArray:
    """Indices of poses to which no motion leads: the robot was relocated there."""
    stamps = [d.stamp_ns for d in result.decisions if d.kind == "place" and d.reason in _JUMPS and d.weight > 0.0]
    found = np.flatnonzero(np.isin(result.trajectory.stamps_ns, stamps))
    return found[found > 0]


def _draw_times(axes: Axes, result: RunResult, extent: float) -> None:
    """Seconds along the way at even times, and an arrowhead halfway between two of them."""
    poses, times = result.trajectory.poses, seconds(result, result.trajectory.stamps_ns)
    if len(poses) < 3:
        return
    axis = TimeAxis.of(result)
    ticks = [float(t) for t in axis.ticks(_TIMES) if times[0] < t < times[-1]]
    step = ticks[1] - ticks[0] if len(ticks) > 1 else 0.0
    told: list[FloatArray] = [poses[0, :2], poses[-1, :2]]
    for tick in ticks:
        k = int(np.searchsorted(times, tick))
        if min(float(np.hypot(*(poses[k, :2] - p))) for p in told) > 0.04 * extent:
            told.append(poses[k, :2])
            _draw_time(axes, poses, k, f"{tick:g}")
    for tick in [t - 0.5 * step for t in ticks] + [t + 0.5 * step for t in ticks[-1:]]:
        k = int(np.clip(np.searchsorted(times, tick), 1, len(poses) - 1))
        direction = _direction(poses, k, 0.01 * extent)
        if direction is not None:
            turned = MarkerStyle(">", transform=Affine2D().rotate(direction))
            axes.plot(*poses[k, :2], marker=turned, markersize=7, color=BLUE, mec="white", mew=0.5, zorder=4)


def _draw_time(axes: Axes, poses: FloatArray, k: int, text: str) -> None:
    direction = _direction(poses, k, 1e-6) or 0.0
    side = (-9.0 * math.sin(direction), 9.0 * math.cos(direction))  # points, to the left of the way
    axes.plot(*poses[k, :2], marker="o", markersize=3.5, color="white", mec=BLUE, mew=1.0, zorder=4)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.4}
    look: dict[str, Any] = dict(textcoords="offset points", ha="center", va="center", zorder=6, bbox=box)
    axes.annotate(text, tuple(poses[k, :2]), xytext=side, fontsize=SMALL, color=BLUE, **look)


def _direction(poses: FloatArray, k: int, shortest: float) -> float | None:
    """Of the motion at a pose [rad]; None where the robot stands, or jumps."""
    before, after = poses[max(k - 2, 0), :2], poses[min(k + 2, len(poses) - 1), :2]
    way = after - before
    return math.atan2(way[1], way[0]) if float(np.hypot(*way)) > shortest else None


def _draw_ellipses(axes: Axes, estimate: Trajectory, extent: float) -> list[Artist]:
    """3σ ellipses, spread evenly over the distance travelled; large ones as outlines, and only some of them."""
    assert estimate.covs is not None
    way = travelled(estimate.poses)
    spacing = max(0.04 * extent, way[-1] / _MAX_ELLIPSES, 1e-6)
    chosen = np.unique(np.searchsorted(way, np.arange(0.0, way[-1] + spacing, spacing)))
    chosen = chosen[chosen < len(estimate)]
    values, _ = np.linalg.eigh(estimate.covs[chosen, :2, :2])
    sizes = 6.0 * np.sqrt(np.maximum(values[:, 1], 0.0))  # full axes: twice 3σ
    small, large = chosen[sizes <= _FILLED * extent], chosen[(sizes > _FILLED * extent) & (sizes <= _DRAWN * extent)]
    handles: list[Artist] = []
    if len(small):
        look: dict[str, Any] = dict(facecolors=BLUE, edgecolors=BLUE, linewidths=0.5, alpha=0.2)
        add_ellipses(axes, estimate.poses[small, :2], estimate.covs[small, :2, :2], look)
        handles.append(Patch(facecolor=BLUE, alpha=0.2, label="3σ of the position"))
    if len(large):
        large = large[np.unique(np.linspace(0, len(large) - 1, _MAX_OUTLINES).round().astype(int))]
        look = dict(facecolors="none", edgecolors=SKY, linewidths=0.9, linestyles="--", zorder=1)
        add_ellipses(axes, estimate.poses[large, :2], estimate.covs[large, :2, :2], look)
        handles.append(Line2D([], [], color=SKY, lw=0.9, linestyle="--", label="3σ, where it is large"))
    return handles


def add_ellipses(axes: Axes, places: FloatArray, covs: FloatArray, look: dict[str, Any]) -> None:
    """Draw 3σ ellipses of covariances ``(n, 2, 2)`` [m²] at places ``(n, 2)`` [m]."""
    values, vectors = np.linalg.eigh(covs)
    axes_m = 6.0 * np.sqrt(np.maximum(values, 0.0))
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    shape = (axes_m[:, 1], axes_m[:, 0], angles)
    axes.add_collection(EllipseCollection(*shape, units="xy", offsets=places, transOffset=axes.transData, **look))


def _draw_landmarks(axes: Axes, landmarks: LandmarkMap) -> list[Artist]:
    """A standing marker as its edge seen from above, anything else as a diamond; ids beside them, 3σ where known."""
    edge: dict[str, Any] = dict(color=RED, lw=3.0, solid_capstyle="butt")
    point: dict[str, Any] = dict(color=RED, marker="D", markersize=4.5, linestyle="none")
    found: dict[str, Artist] = {}
    for landmark in landmarks.landmarks.values():
        x, y = landmark.position[:2]
        if stands(landmark):
            corners = landmark.corners()[:2, :2]
            axes.plot(corners[:, 0], corners[:, 1], zorder=4, **edge)
            found["edge"] = Line2D([], [], label="marker (id)", **edge)
        else:
            axes.plot(x, y, zorder=4, **point)
            found["point"] = Line2D([], [], label="landmark (id)", **point)
        where: dict[str, Any] = dict(xytext=_label_offset(landmark), textcoords="offset points", zorder=6)
        axes.annotate(str(landmark.landmark_id), (x, y), ha="center", va="center", **where, **TEXT)
    known = [lm for lm in landmarks.landmarks.values() if lm.cov is not None]
    if known:
        covs = np.array([lm.cov[:2, :2] for lm in known if lm.cov is not None])
        look = dict(facecolors=RED, edgecolors=RED, linewidths=0.6, alpha=0.3, zorder=3.8)
        add_ellipses(axes, np.array([lm.position[:2] for lm in known]), covs, look)
        found["cov"] = Patch(facecolor=RED, alpha=0.3, label="3σ of a landmark")
    return list(found.values())


def stands(landmark: Landmark) -> bool:
    """Whether it is a marker on a wall, not one on the floor or a point."""
    return landmark.size_m > 0 and abs(landmark.rotation[2, 2]) < 0.7


def _label_offset(landmark: Landmark) -> tuple[float, float]:
    """Behind a marker's face, where the robot does not drive [points]."""
    if stands(landmark):
        yaw = float(landmark.planar[2])
        return -8.0 * math.cos(yaw), -8.0 * math.sin(yaw)
    return 7.0, 7.0


def _draw_distance(axes: Axes, result: RunResult, matched: Matched | None) -> list[Artist]:
    """Sigma of the position, and distance from the truth, over time: too small to be seen on the map."""
    stamps, covs = result.trajectory.stamps_ns, result.trajectory.covs
    sigma = None if covs is None else np.sqrt(covs[:, 0, 0] + covs[:, 1, 1])
    scale = ErrorScale.of_distance(result, matched)
    handles: list[Artist] = []
    if sigma is not None:
        t, three = broken(stamps, np.column_stack([seconds(result, stamps), 3.0 * scale.unit * sigma])).T
        axes.fill_between(t, 0.0, three, color=SKY, alpha=0.35, lw=0)
    if matched is not None:
        columns = np.column_stack([seconds(result, matched.stamps_ns), scale.unit * matched.distances])
        t, line = broken(matched.stamps_ns, columns).T
        axes.plot(t, line, color="black", lw=1.0)
        handles.append(Line2D([], [], color="black", lw=1.0, label="distance from the truth"))
    tidy(axes)
    scale.apply(axes, symmetric=False)
    axes.set_ylabel(f"{'error, ' if matched is not None else ''}3σ [{scale.name}]", fontsize=NORMAL)
    axes.set_xlabel("time from the first pose [s]", fontsize=NORMAL)
    shade_modes(axes, result)
    axis = TimeAxis.of(result)
    axis.draw_cuts(axes, told=True)
    axis.apply(axes)
    return handles
