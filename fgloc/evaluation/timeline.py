"""A run over time: messages received, weights of the sources, fit of the sightings, flags, errors."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fgloc.evaluation.error_scale import ErrorScale
from fgloc.evaluation.matching import Matched
from fgloc.evaluation.style import (
    BLUE,
    DPI,
    GAP_S,
    GREEN,
    GREY,
    NORMAL,
    ORANGE,
    RED,
    SKY,
    SMALL,
    TEXT,
    WIDTH,
    broken,
    legend,
    mode_handles,
    plain_label,
    seconds,
    shade_modes,
    tidy,
)
from fgloc.evaluation.time_axis import TimeAxis
from fgloc.sensors import registry
from fgloc.types import Decision, FloatArray, IntArray, RunResult

_SOURCES = (*registry.motion_names(), "unknown")
_NOT_SEEN = (*_SOURCES, "place", "prior", "mode", "clock")
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


def plot_timeline(result: RunResult, matched: Matched | None = None, slips_ns: IntArray | None = None) -> Figure:
    """The timeline of a run; panels of which there is nothing to show are left out.

    Args:
        result: the run.
        matched: estimate and truth, for the errors.
        slips_ns: ``(n, 2)`` stamps between which a wheel truly slipped, if a simulator recorded them.
    """
    motions = [d for d in result.decisions if d.kind in _SOURCES]
    sightings = [d for d in result.decisions if d.landmark_id >= 0 or d.kind not in _NOT_SEEN]
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
        panels += [(5.0, lambda axes, k=k: _error(axes, result, matched, yaw=k)) for k in (False, True)]  # type: ignore[misc]
    if not panels:
        panels.append(
            (1.0, lambda axes: _activity(axes, span, "keyframes", {"all": _poses(result)}, BLUE, bridge=True))
        )
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
    axes_of[-1].set_xlabel("time from the first pose [s]", fontsize=NORMAL)
    if handles := _handles(result, motions, known, matched is not None, len(slips) > 0):
        legend(figure, handles)
    return figure


def _poses(result: RunResult) -> FloatArray:
    return seconds(result, result.trajectory.stamps_ns)


def _handles(
    result: RunResult, motions: Sequence[Decision], known: Sequence[Decision], truth: bool, slips: bool
) -> list[Any]:
    """Legend entries of what is drawn."""
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


def _flags(result: RunResult, decisions: Sequence[Decision]) -> dict[str, FloatArray]:
    """When each reason was given, the most frequent ones, by the order of kinds."""
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
    """One row a name: bars where items came at a steady rate (`bridge`), else a tick each."""
    for row, times in enumerate(rows.values()):
        axes.broken_barh(_bars(np.unique(times), span, bridge), (row - 0.3, 0.6), facecolors=color, linewidth=0)
    _rows(axes, title, list(rows))


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
    """Above a panel: beside it there are names of any length."""
    axes.set_title(title, loc="left", fontsize=NORMAL, pad=2.5)


def _bars(times: FloatArray, span: float, bridge: bool) -> list[tuple[float, float]]:
    """Start and width of the stretches without a silence; a lone item is wide enough to be seen."""
    if len(times) == 0:
        return []
    steps = np.diff(times)
    silence = min(3.0 * float(np.median(steps)), GAP_S) if bridge and len(steps) else 0.0
    cuts = np.flatnonzero(steps > max(silence, span / 600.0)) + 1
    return [(float(part[0]), float(np.ptp(part)) + span / 600.0) for part in np.split(times, cuts)]


def _weights(axes: Axes, result: RunResult, decisions: Sequence[Decision]) -> None:
    """A row for each motion source: as high as its weight, and what was taken back at full height in red."""
    kinds = [source for source in _SOURCES if any(d.kind == source for d in decisions)]
    for row, kind in enumerate(kinds):
        last = {d.step: d for d in decisions if d.kind == kind}  # a step that was judged again has several rows
        held = sorted(last.values(), key=lambda d: d.stamp_ns)
        ends = seconds(result, [d.stamp_ns for d in held])
        width = float(np.median(np.diff(ends))) if len(ends) > 1 else 0.1
        starts = np.concatenate([[ends[0] - width], np.maximum(ends[:-1], ends[1:] - GAP_S)])
        weights = np.array([d.weight for d in held])
        heights = np.where(weights > 0.0, np.clip(weights, 0.06, 1.0), 1.0) * 0.7
        colors = [BLUE if w > _FULL else ORANGE if w > 0.0 else RED for w in weights]
        axes.bar(starts, heights, ends - starts, row + 0.35 - heights, align="edge", color=colors, linewidth=0)
        for level, text in ((-0.35, "1"), (0.0, "½"), (0.35, "0")):
            axes.axhline(row + level, color=GREY, lw=0.4, linestyle=":", zorder=0.5)
            at: dict[str, Any] = dict(xy=(1.0, row + level), xycoords=("axes fraction", "data"), xytext=(2, 0))
            axes.annotate(text, **at, textcoords="offset points", va="center", fontsize=5.5, color=GREY)
    _rows(axes, _WEIGHTS, [f"{kind} ({sum(d.kind == kind for d in decisions)})" for kind in kinds])


def _fit(axes: Axes, result: RunResult, decisions: Sequence[Decision]) -> None:
    """NIS of the sightings over its expected value."""
    for accepted, color, marker in _SIGHTING_LOOKS:
        chosen = [d for d in decisions if (d.weight > 0.0) == accepted]
        ratio = np.clip([d.nis / d.dof for d in chosen], 1e-2, 1e4)
        times = seconds(result, [d.stamp_ns for d in chosen])
        axes.plot(times, ratio, color=color, marker=marker, markersize=4, mew=0.9, linestyle="none")
    axes.axhline(1.0, color=GREY, lw=0.8)
    axes.set_yscale("log")
    _title(axes, _FIT)
    tidy(axes)


def _landmarks(axes: Axes, result: RunResult, span: float, decisions: Sequence[Decision]) -> None:
    """A row for each landmark, and for what else a sensor measured: when it was accepted, and when not."""
    seen = Counter(map(_row_of, decisions))
    shown = sorted(row for row, _ in seen.most_common(_MAX_LANDMARKS))
    for row, what in enumerate(shown):
        for accepted, color in ((True, BLUE), (False, RED)):
            stamps = [d.stamp_ns for d in decisions if _row_of(d) == what and (d.weight > 0.0) == accepted]
            bars = _bars(np.unique(seconds(result, stamps)), span, bridge=False)
            axes.broken_barh(bars, (row - 0.35, 0.7), color=color, lw=0)
    _rows(axes, _LANDMARKS, [kind or str(i) for i, kind in shown])


def _row_of(decision: Decision) -> tuple[int, str]:
    """Id of a landmark; without one, the kind."""
    return decision.landmark_id, "" if decision.landmark_id >= 0 else decision.kind


def _error(axes: Axes, result: RunResult, matched: Matched, yaw: bool) -> None:
    """Distance from the truth, or yaw error, with what the covariance makes of it."""
    covs = result.trajectory.covs
    error = np.abs(matched.errors[:, 2]) if yaw else matched.distances
    sigma = None if covs is None else np.sqrt(covs[:, 2, 2] if yaw else covs[:, 0, 0] + covs[:, 1, 1])
    scale = ErrorScale.of(result, None if sigma is None else 3.0 * sigma, (matched.stamps_ns, error), angle=yaw)
    if sigma is not None:
        stamps = result.trajectory.stamps_ns
        t, one = broken(stamps, np.column_stack([_poses(result), scale.unit * sigma])).T
        axes.fill_between(t, 0.0, 3.0 * one, color=SKY, alpha=0.25, lw=0)
        axes.fill_between(t, 0.0, one, color=SKY, alpha=0.4, lw=0)
    t, line = broken(matched.stamps_ns, np.column_stack([seconds(result, matched.stamps_ns), scale.unit * error])).T
    axes.plot(t, line, color=GREEN, lw=1.1)
    tidy(axes)
    scale.apply(axes, symmetric=False)
    _title(axes, f"{'yaw' if yaw else 'position'} error and its σ [{scale.name}]")
