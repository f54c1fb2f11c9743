"""Pictures of a run: trajectory, error, timeline; on uneven ground its path in space and its height."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D
from mpl_toolkits.mplot3d import Axes3D

from fgloc.config import MOTION_SOURCES, is_motion_source
from fgloc.evaluation.metrics import Matched
from fgloc.evaluation.style import (
    BLUE,
    DPI,
    GAP_S,
    GREEN,
    GREY,
    MODE_LOOKS,
    NORMAL,
    ORANGE,
    RED,
    SKY,
    SMALL,
    TEXT,
    WIDTH,
    ErrorScale,
    TimeAxis,
    after_gaps,
    broken,
    legend,
    mode_handles,
    mode_runs,
    over_time,
    plain_label,
    position_sigma,
    seconds,
    shade_modes,
    tidy,
)
from fgloc.results import RunData
from fgloc.types import Decision, FloatArray, IntArray, Landmark, LandmarkMap, Trajectory

# --- Trajectory: the map, the way with its times, and below it how large sigma and error are --------------------------

_TIME = "time from the first pose [s]"
_MAX_ELLIPSES = 60
_SEEN = 0.06  # of the picture: smaller ellipses are enlarged up to it, or the way's line would cover them
_FILLED = 0.1  # of the picture: larger ellipses are outlines, or they would cover the map ...
_DRAWN = 1.0  # ... and still larger ones lie around it, and are left out
_MAX_OUTLINES = 8
_TIMES = 8  # written along the way, about
_JUMPS = ("jump", "overruled by sightings")


def plot_trajectory(result: RunData, matched: Matched | None) -> Figure:
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
    tidy(axes, "x [m]", "y [m]")
    if below:
        handles += _draw_distance(panel[0], result, matched)
    legend(figure, handles)
    return figure


def _bounds(result: RunData, matched: Matched | None) -> tuple[FloatArray, FloatArray]:
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


def _draw_way(axes: Axes, result: RunData, matched: Matched | None, extent: float) -> list[Artist]:
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


def relocated(result: RunData) -> IntArray:
    """Indices of poses to which no motion leads: the robot was relocated there."""
    stamps = [d.stamp_ns for d in result.decisions if d.kind == "place" and d.reason in _JUMPS and d.weight > 0.0]
    found = np.flatnonzero(np.isin(result.trajectory.stamps_ns, stamps))
    return found[found > 0]


def _draw_times(axes: Axes, result: RunData, extent: float) -> None:
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
    """Direction of the motion about pose ``k`` [rad]; None where it is shorter than ``shortest``."""
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
    times = _enlarged(sizes[sizes <= _FILLED * extent], extent)
    told = f", {times:g} times enlarged" if times > 1.0 else ""
    handles: list[Artist] = []
    if len(small):
        look: dict[str, Any] = dict(facecolors=BLUE, edgecolors=BLUE, linewidths=0.5, alpha=0.2)
        add_ellipses(axes, estimate.poses[small, :2], times**2 * estimate.covs[small, :2, :2], look)
        handles.append(Patch(facecolor=BLUE, alpha=0.2, label=f"3σ of the position{told}"))
    if len(large):
        large = large[np.unique(np.linspace(0, len(large) - 1, _MAX_OUTLINES).round().astype(int))]
        look = dict(facecolors="none", edgecolors=SKY, linewidths=0.9, linestyles="--", zorder=1)
        add_ellipses(axes, estimate.poses[large, :2], estimate.covs[large, :2, :2], look)
        handles.append(Line2D([], [], color=SKY, lw=0.9, linestyle="--", label="3σ, where it is large"))
    return handles


def _enlarged(sizes: FloatArray, extent: float) -> float:
    """Times that ellipses of these sizes [m] are enlarged, to be wider than the way's line: 1, 2, 5, 10, ..."""
    usual = float(np.percentile(sizes, 90.0)) if len(sizes) else 0.0
    fitting = [k for k in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0) if k * usual < _SEEN * extent]
    return fitting[-1] if fitting and usual > 0.0 else 1.0


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
    """Whether a landmark is a marker on a wall, not one on the floor or a point."""
    return landmark.size_m > 0 and abs(landmark.rotation[2, 2]) < 0.7


def _label_offset(landmark: Landmark) -> tuple[float, float]:
    """Offset [points] of a marker's label: behind its face, where the robot does not drive."""
    if stands(landmark):
        yaw = float(landmark.planar[2])
        return -8.0 * math.cos(yaw), -8.0 * math.sin(yaw)
    return 7.0, 7.0


def _draw_distance(axes: Axes, result: RunData, matched: Matched | None) -> list[Artist]:
    """Sigma of the position, and distance from the truth, over time: too small to be seen on the map."""
    covs, scale = result.trajectory.covs, ErrorScale.of_distance(result, matched)
    handles: list[Artist] = []
    if covs is not None:
        t, three = over_time(result, result.trajectory.stamps_ns, 3.0 * scale.unit * position_sigma(covs))
        axes.fill_between(t, 0.0, three, color=SKY, alpha=0.35, lw=0)
    if matched is not None:
        axes.plot(*over_time(result, matched.stamps_ns, scale.unit * matched.distances), color="black", lw=1.0)
        handles.append(Line2D([], [], color="black", lw=1.0, label="distance from the truth"))
    tidy(axes, _TIME, f"{'error, ' if matched is not None else ''}3σ [{scale.name}]")
    scale.apply(axes, symmetric=False)
    shade_modes(axes, result)
    axis = TimeAxis.of(result, received=False)
    axis.draw_cuts(axes, told=True)
    axis.apply(axes)
    return handles


# --- Error against its 3σ band ----------------------------------------------------------------------------------------


def plot_error(result: RunData, matched: Matched | None) -> Figure:
    """Error in x, y and yaw against its ±3σ band over time; without a truth the band alone."""
    trajectory = result.trajectory
    bands = None if trajectory.covs is None else 3.0 * np.sqrt(np.diagonal(trajectory.covs, axis1=1, axis2=2))
    figure = Figure(figsize=(WIDTH, 4.4), dpi=DPI, layout="constrained")
    rows: list[Axes] = figure.subplots(3, 1, sharex=True).tolist()
    axis_of_time = TimeAxis.of(result, received=False)
    for axis, (axes, name) in enumerate(zip(rows, ("x", "y", "yaw"), strict=True)):
        compared = matched if matched is not None and (matched.has_yaw or axis < 2) else None
        known = None if compared is None else (compared.stamps_ns, np.abs(compared.errors[:, axis]))
        scale = ErrorScale.of(result, None if bands is None else bands[:, axis], known, angle=axis == 2)
        if bands is not None:
            t, band = over_time(result, trajectory.stamps_ns, scale.unit * bands[:, axis])
            axes.fill_between(t, -band, band, color=SKY, alpha=0.25, lw=0)
            axes.plot(t, band, color=SKY, lw=0.8)
            axes.plot(t, -band, color=SKY, lw=0.8)
        if compared is not None:
            error = scale.unit * compared.errors[:, axis]
            axes.plot(*over_time(result, compared.stamps_ns, error), color=BLUE, lw=1.0)
        axes.axhline(0.0, color=GREY, lw=0.6)
        tidy(axes, _TIME if axes is rows[-1] else "", f"{name} [{scale.name}]")
        scale.apply(axes, symmetric=True)
        shade_modes(axes, result)
        axis_of_time.draw_cuts(axes, told=axis == 0)
    axis_of_time.apply(rows[-1])
    figure.align_ylabels(rows)
    handles: list[Artist] = [] if bands is None else [Patch(facecolor=SKY, alpha=0.4, label="±3σ of the estimate")]
    if matched is not None:
        handles.insert(0, Line2D([], [], color=BLUE, lw=1.2, label="estimate − truth"))
    handles += mode_handles(result)
    if handles:
        legend(figure, handles)
    return figure


def plot_protection(result: RunData, matched: Matched, alert_m: float | None) -> Figure:
    """Stanford diagram: bound on the position of each pose over its distance from the truth.

    Source: Stanford GPS laboratory; Tossaint et al. 2007, "The Stanford-ESA integrity diagram".
    """
    at = np.searchsorted(result.trajectory.stamps_ns, matched.stamps_ns)
    bound = np.array([result.protections[i].position_m for i in at])
    known = np.isfinite(bound)
    error = np.maximum(matched.distances, _LEAST_SHOWN_M)
    figure = Figure(figsize=(WIDTH, 4.4), dpi=DPI, layout="constrained")
    axes: Axes = figure.subplots()
    axes.scatter(error[known], bound[known], s=6.0, color=BLUE, alpha=0.5, lw=0)
    shown = np.concatenate([error, bound[known]])
    low, high = 0.5 * float(shown.min()), 2.0 * float(shown.max())
    axes.fill_between([low, high], [low, low], [low, high], color=RED, alpha=0.12, lw=0)
    axes.plot([low, high], [low, high], color=GREY, lw=1.0)
    if alert_m is not None:
        axes.axhline(alert_m, color=ORANGE, lw=1.0, ls="--")
        axes.annotate("alert limit", (low, alert_m), fontsize=SMALL, color=ORANGE, va="bottom")
    axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    axes.annotate("wrong by more than the bound", (0.97, 0.04), xycoords="axes fraction", ha="right", fontsize=SMALL)
    tidy(axes, "distance from the truth [m]", "bound on it [m]")
    return figure


# --- Timeline: messages received, weights of the sources, fit of the sightings, flags, errors -------------------------

_LEAST_SHOWN_M = 1e-4
_NOT_SEEN = ("unknown", "place", "prior", "mode", "clock", "lift")
_MAX_FLAGS = 12
_MAX_LANDMARKS = 20
_ROW_IN = 0.18  # inches
_HEAD_ROWS = 1.5  # of a panel: its title, and the space below it
_LONGEST_NAME = 36  # characters
_FULL = 0.995  # a weight above this is drawn as 1
SLIP = "#b8a9c9"

_SIGHTING_LOOKS = ((True, BLUE, "."), (False, RED, "x"))
_RECEIVED = "messages received"
_WEIGHTS = "weight of each motion source"
_FLAGS = "reasons"
_FIT = "fit of the sightings: NIS / dof, 1 is expected"
_LANDMARKS = "sightings of each landmark"

Panel = tuple[float, Callable[[Axes], None]]  # height in rows, and what draws it


def plot_timeline(result: RunData, matched: Matched | None = None, slips_ns: IntArray | None = None) -> Figure:
    """Plot the timeline of a run, without empty panels.

    Args:
        result: the run.
        matched: estimate and truth, for the errors.
        slips_ns: ``(n, 2)`` stamps between which a wheel truly slipped, if a simulator recorded them.
    """
    motions = [d for d in result.decisions if _of_motion(d)]
    sightings = [d for d in result.decisions if d.landmark_id >= 0 or not (_of_motion(d) or d.kind in _NOT_SEEN)]
    flags = _flags(result, result.decisions)
    known = [d for d in sightings if math.isfinite(d.nis) and d.dof > 0]
    axis = TimeAxis.of(result)
    span = axis.length
    panels: list[Panel] = []
    if result.spans:
        received = {f"{topic} ({t.count})": t.times for topic, t in result.spans.items()}
        panels.append((len(received), lambda axes: _activity(axes, span, _RECEIVED, received, GREY, bridge=True)))
    if motions:
        panels.append((1.7 * len({d.kind for d in motions}), lambda axes: _weights(axes, result, motions)))
    if flags:
        panels.append((len(flags), lambda axes: _activity(axes, span, _FLAGS, flags, RED, bridge=False)))
    if known:
        panels.append((6.0, lambda axes: _fit(axes, result, known)))
    if sightings:
        rows = min(len({_row_of(d) for d in sightings}), _MAX_LANDMARKS)
        panels.append((0.9 * rows, lambda axes: _landmarks(axes, result, span, sightings)))
    if matched is not None:
        kinds = (False, True) if matched.has_yaw else (False,)
        panels += [(5.0, lambda axes, k=k: _error(axes, result, matched, yaw=k)) for k in kinds]  # type: ignore[misc]
    if not panels:
        poses = {"all": seconds(result, result.trajectory.stamps_ns)}
        panels.append((1.0, lambda axes: _activity(axes, span, "keyframes", poses, BLUE, bridge=True)))
    heights = [height + _HEAD_ROWS for height, _ in panels]
    figure = Figure(figsize=(WIDTH, 0.9 + _ROW_IN * sum(heights)), dpi=DPI, layout="constrained")
    axes_of: list[Axes] = figure.subplots(len(panels), 1, sharex=True, squeeze=False, height_ratios=heights)[
        :, 0
    ].tolist()
    slips = np.empty((0, 2)) if slips_ns is None else seconds(result, slips_ns)
    for axes, (_, draw) in zip(axes_of, panels, strict=True):
        draw(axes)
        shade_modes(axes, result)
        for start, end in slips:
            axes.axvspan(float(start), float(end), facecolor=SLIP, alpha=0.45, lw=0, zorder=-1)
        axis.draw_cuts(axes, told=axes is axes_of[0])
    axis.apply(axes_of[-1])
    axes_of[-1].set_xlabel(_TIME, fontsize=NORMAL)
    if handles := _handles(result, motions, known, matched is not None, len(slips) > 0):
        legend(figure, handles)
    return figure


def _of_motion(d: Decision) -> bool:
    """Whether a row is of a motion source, or of a motion that none measured."""
    return is_motion_source(d.kind) or d.kind == "unknown"


def _handles(
    result: RunData, motions: Sequence[Decision], known: Sequence[Decision], truth: bool, slips: bool
) -> list[Any]:
    """Legend entries of the timeline's colors and symbols."""
    handles: list[Any] = []
    if any(d.weight > _FULL for d in motions):
        handles.append(Patch(color=BLUE, label="used as given"))
    if any(0.0 < d.weight <= _FULL for d in motions):
        handles.append(Patch(color=ORANGE, label="inflated"))
    if any(d.weight == 0.0 for d in result.decisions):
        handles.append(Patch(color=RED, label="left out, rejected"))
    for accepted, color, marker in _SIGHTING_LOOKS:
        if any((d.weight > 0.0) == accepted for d in known):
            label = f"sighting {'accepted' if accepted else 'rejected'}"
            handles.append(Line2D([], [], color=color, marker=marker, markersize=4, linestyle="none", label=label))
    if truth:
        handles.append(Line2D([], [], color=GREEN, lw=1.1, label="true error"))
        if result.trajectory.covs is not None:
            handles += [Patch(color=SKY, alpha=0.55, label="1σ"), Patch(color=SKY, alpha=0.25, label="3σ")]
    if slips:
        handles.append(Patch(color=SLIP, alpha=0.45, label="a wheel slips (simulator)"))
    return handles + mode_handles(result)


def _flags(result: RunData, decisions: Sequence[Decision]) -> dict[str, FloatArray]:
    """Times of each reason, for the most frequent ones, in the order of kinds."""
    found: dict[tuple[str, str], list[int]] = defaultdict(list)
    for d in decisions:
        if d.kind != "mode" and (d.reason or d.weight == 0.0):  # modes are shaded
            found[d.kind, d.reason or "weight 0"].append(d.stamp_ns)
    common = sorted(found, key=lambda key: -len(found[key]))[:_MAX_FLAGS]
    return {
        f"{kind}: {reason.replace('_', ' ')} ({len(found[kind, reason])})": seconds(result, found[kind, reason])
        for kind, reason in sorted(common)
    }


def _activity(axes: Axes, span: float, title: str, rows: Mapping[str, FloatArray], color: str, bridge: bool) -> None:
    """Draw one row for each name: bars where items came at a steady rate (`bridge`), else a tick each."""
    for row, times in enumerate(rows.values()):
        _boxes(axes, *_bars(np.unique(times), span, bridge), row - 0.3, row + 0.3, color)
    _rows(axes, title, list(rows))


def _boxes(
    axes: Axes,
    starts: FloatArray,
    ends: FloatArray,
    low: FloatArray | float,
    high: FloatArray | float,
    colors: Sequence[str] | str,
) -> None:
    """Draw filled boxes as one collection: one patch for each keyframe would take seconds."""
    x0, x1, y0, y1 = np.broadcast_arrays(starts, ends, low, high)
    corners = np.stack([np.stack([x0, x0, x1, x1], axis=1), np.stack([y0, y1, y1, y0], axis=1)], axis=2)
    axes.add_collection(PolyCollection(list(corners), facecolors=colors, linewidths=0))


def _rows(axes: Axes, title: str, names: Sequence[str]) -> None:
    shown = [plain_label(name, _LONGEST_NAME) for name in names]
    axes.set_yticks(range(len(names)), shown, **TEXT)
    axes.set_ylim(len(names) - 0.4, -0.6)
    _title(axes, title)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(left=False, labelsize=SMALL, pad=6)
    axes.grid(axis="x", color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)


def _title(axes: Axes, title: str) -> None:
    """Put a title above a panel, as names of any length stand beside it."""
    axes.set_title(title, loc="left", fontsize=NORMAL, pad=2.5)


def _bars(times: FloatArray, span: float, bridge: bool) -> tuple[FloatArray, FloatArray]:
    """Starts and ends of the stretches without a silence; a lone item is wide enough to be seen."""
    if len(times) == 0:
        return times, times
    steps = np.diff(times)
    silence = min(3.0 * float(np.median(steps)), GAP_S) if bridge and len(steps) else 0.0
    cuts = np.flatnonzero(steps > max(silence, span / 600.0))
    return times[np.append(0, cuts + 1)], times[np.append(cuts, len(times) - 1)] + span / 600.0


def _weights(axes: Axes, result: RunData, decisions: Sequence[Decision]) -> None:
    """A row for each motion source: as high as its weight, and what was taken back at full height in red."""
    there = {d.kind for d in decisions}
    kinds = [
        kind for kind in (*MOTION_SOURCES, *sorted(there - {*MOTION_SOURCES, "unknown"}), "unknown") if kind in there
    ]
    for row, kind in enumerate(kinds):
        last = {d.step: d for d in decisions if d.kind == kind}  # a step that was judged again has several rows
        held = sorted(last.values(), key=lambda d: d.stamp_ns)
        ends = seconds(result, [d.stamp_ns for d in held])
        width = float(np.median(np.diff(ends))) if len(ends) > 1 else 0.1
        starts = np.concatenate([[ends[0] - width], np.maximum(ends[:-1], ends[1:] - GAP_S)])
        weights = np.array([d.weight for d in held])
        heights = np.where(weights > 0.0, np.clip(weights, 0.06, 1.0), 1.0) * 0.7
        colors = [BLUE if w > _FULL else ORANGE if w > 0.0 else RED for w in weights]
        _boxes(axes, starts, ends, row + 0.35 - heights, row + 0.35, colors)
        for level, text in ((-0.35, "1"), (0.0, "½"), (0.35, "0")):
            axes.axhline(row + level, color=GREY, lw=0.4, linestyle=":", zorder=0.5)
            at: dict[str, Any] = dict(xy=(1.0, row + level), xycoords=("axes fraction", "data"), xytext=(2, 0))
            axes.annotate(text, **at, textcoords="offset points", va="center", fontsize=5.5, color=GREY)
    _rows(axes, _WEIGHTS, [f"{kind} ({sum(d.kind == kind for d in decisions)})" for kind in kinds])


def _fit(axes: Axes, result: RunData, decisions: Sequence[Decision]) -> None:
    """Draw the NIS of the sightings over its expected value."""
    for accepted, color, marker in _SIGHTING_LOOKS:
        chosen = [d for d in decisions if (d.weight > 0.0) == accepted]
        ratio = np.clip([d.nis / d.dof for d in chosen], 1e-2, 1e4)
        times = seconds(result, [d.stamp_ns for d in chosen])
        axes.plot(times, ratio, color=color, marker=marker, markersize=4, mew=0.9, linestyle="none")
    axes.axhline(1.0, color=GREY, lw=0.8)
    axes.set_yscale("log")
    _title(axes, _FIT)
    tidy(axes)


def _landmarks(axes: Axes, result: RunData, span: float, decisions: Sequence[Decision]) -> None:
    """A row for each landmark, and for what else a sensor measured: when it was accepted, and when not."""
    seen = Counter(map(_row_of, decisions))
    shown = sorted(row for row, _ in seen.most_common(_MAX_LANDMARKS))
    for row, what in enumerate(shown):
        for accepted, color in ((True, BLUE), (False, RED)):
            stamps = [d.stamp_ns for d in decisions if _row_of(d) == what and (d.weight > 0.0) == accepted]
            bars = _bars(np.unique(seconds(result, stamps)), span, bridge=False)
            _boxes(axes, *bars, row - 0.35, row + 0.35, color)
    _rows(axes, _LANDMARKS, [kind or str(i) for i, kind in shown])


def _row_of(decision: Decision) -> tuple[int, str]:
    """Row of a decision: id of its landmark or, without one, its kind."""
    return decision.landmark_id, "" if decision.landmark_id >= 0 else decision.kind


def _error(axes: Axes, result: RunData, matched: Matched, yaw: bool) -> None:
    """Draw the distance from the truth, or the yaw error, with bands of its standard deviation."""
    covs = result.trajectory.covs
    error = np.abs(matched.errors[:, 2]) if yaw else matched.distances
    sigma = None if covs is None else np.sqrt(covs[:, 2, 2]) if yaw else position_sigma(covs)
    scale = ErrorScale.of(result, None if sigma is None else 3.0 * sigma, (matched.stamps_ns, error), angle=yaw)
    if sigma is not None:
        t, one = over_time(result, result.trajectory.stamps_ns, scale.unit * sigma)
        axes.fill_between(t, 0.0, 3.0 * one, color=SKY, alpha=0.25, lw=0)
        axes.fill_between(t, 0.0, one, color=SKY, alpha=0.4, lw=0)
    axes.plot(*over_time(result, matched.stamps_ns, scale.unit * error), color=GREEN, lw=1.1)
    tidy(axes)
    scale.apply(axes, symmetric=False)
    _title(axes, f"{'yaw' if yaw else 'position'} error and its σ [{scale.name}]")


# --- Uneven ground ----------------------------------------------------------------------------------------------------

_TALLER = 4.0  # times: heights of a floor are small beside its extent


def plot_space(result: RunData, matched: Matched | None) -> Figure:
    """Path of the base in space, over the truth, with the landmarks."""
    assert result.trajectory.ground is not None
    figure = Figure(figsize=(WIDTH, 0.62 * WIDTH), dpi=DPI, layout="constrained")
    axes: Any = figure.add_subplot(projection=Axes3D.name)
    if matched is not None and matched.true_ground is not None:
        true = np.column_stack([matched.truth[:, :2], matched.true_ground[:, 0]])
        axes.plot(*true.T, color="black", lw=3.0, alpha=0.35, label="truth")
    path = np.column_stack([result.trajectory.poses[:, :2], result.trajectory.ground[:, 0]])
    axes.plot(*path.T, color=BLUE, lw=1.4, label="estimate")
    if result.landmarks is not None and len(result.landmarks):
        places = np.array([m.position for m in result.landmarks.landmarks.values()])
        axes.scatter(*places.T, color=RED, marker="D", s=14, label="landmark")
        path = np.vstack([path, places])
    extent = np.maximum(np.ptp(path, axis=0), 0.2)
    axes.set_box_aspect((extent[0], extent[1], min(_TALLER * extent[2], 0.6 * max(extent[:2]))))
    for axis, name in zip((axes.xaxis, axes.yaxis, axes.zaxis), "xyz", strict=True):
        axis.set_label_text(f"{name} [m]", fontsize=NORMAL)
    axes.tick_params(labelsize=SMALL)
    axes.legend(loc="upper right", frameon=False, fontsize=NORMAL)
    return figure


def plot_height(result: RunData, matched: Matched | None) -> Figure:
    """Height, pitch and roll over the distance travelled, with 3σ bands, over the truth."""
    trajectory = result.trajectory
    assert trajectory.ground is not None
    assert trajectory.ground_covs is not None
    way = travelled(trajectory.poses)
    figure = Figure(figsize=(WIDTH, 5.6), dpi=DPI, layout="constrained")
    rows: list[Axes] = figure.subplots(3, 1, sharex=True).tolist()
    sigmas = np.sqrt(np.diagonal(trajectory.ground_covs, axis1=1, axis2=2))
    for axes, column, row, name, unit in (
        (rows[0], 0, 2, "height [m]", 1.0),
        (rows[1], 2, 4, "pitch [°]", np.degrees(1.0)),
        (rows[2], 1, 3, "roll [°]", np.degrees(1.0)),
    ):
        found, band = unit * trajectory.ground[:, column], 3.0 * unit * sigmas[:, row]
        if matched is not None and matched.true_ground is not None:
            at = np.interp(matched.stamps_ns, trajectory.stamps_ns, way)
            axes.plot(at, unit * matched.true_ground[:, column], color="black", lw=3.0, alpha=0.35, label="truth")
        axes.fill_between(way, found - band, found + band, color=SKY, alpha=0.3, lw=0, label="3σ")
        axes.plot(way, found, color=BLUE, lw=1.2, label="estimate")
        tidy(axes, "distance travelled [m]" if axes is rows[-1] else "", name)
    figure.align_ylabels(rows)
    rows[0].legend(loc="upper right", frameon=False, fontsize=NORMAL)
    return figure
