"""Pictures of an ablation: error over severity, and the worst track of each failure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from fgloc.evaluation.style import BLUE, DPI, GREEN, NORMAL, SMALL, WIDTH, plain_label, tidy

_COLORS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7", "#555555")  # Okabe and Ito
_COLUMNS = 3
_SINGLE_WIDTH = 3.5  # inches: one column of a page
FEWEST_FOR_BAND = 5  # runs: of fewer each is drawn, as an interval would say more about Student's t than about them


@dataclass(frozen=True, slots=True)
class Point:
    """A mean at one severity, with its interval if there is one, and the values of the runs."""

    severity: float
    mean: float
    interval: tuple[float, float] | None
    values: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Curves:
    """One small plot: error over the severity of a failure, one curve per variant."""

    title: str
    unit: str
    curves: Mapping[str, Sequence[Point]]


@dataclass(frozen=True, slots=True)
class Tracks:
    """One small map: positions of estimate and truth [m]."""

    title: str
    estimate: Sequence[tuple[float, float]]
    truth: Sequence[tuple[float, float]]


def plot_severity(plots: Sequence[Curves], label: str) -> Figure:
    """Small plots side by side, all with one meaning of color.

    Bands are the intervals of five runs or more; of fewer runs every one is a dot.
    """
    names = list(dict.fromkeys(name for plot in plots for name in plot.curves))
    columns = 1 if len(plots) == 1 else 2 if len(plots) == 2 else 4  # of the legend: what the plots' width has room for
    figure, axes = _grid(len(plots), 1.9, below=0.18 * math.ceil(len(names) / columns))
    for ax, plot in zip(axes, plots, strict=True):
        for name, points in plot.curves.items():
            _draw_curve(ax, name, points, _COLORS[names.index(name) % len(_COLORS)])
        ax.set_title(plain_label(plot.title), fontsize=NORMAL)
        ax.set_xlabel(plain_label(plot.unit), fontsize=SMALL)
        ax.set_ylim(bottom=0.0)
    axes[0].set_ylabel(label, fontsize=SMALL)
    handles = {name: h for ax in axes for h, name in zip(*ax.get_legend_handles_labels(), strict=True)}
    look: dict[str, Any] = dict(ncols=columns, fontsize=SMALL, frameon=False)
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", **look)
    return figure


def _draw_curve(axes: Axes, name: str, points: Sequence[Point], color: str) -> None:
    axes.plot(
        [p.severity for p in points],
        [p.mean for p in points],
        "o-",
        color=color,
        lw=1.3,
        ms=3.5,
        label=plain_label(name),
    )
    banded = [(p.severity, *p.interval) for p in points if p.interval and len(p.values) >= FEWEST_FOR_BAND]
    if banded:
        severity, low, high = np.array(banded).T
        axes.fill_between(severity, np.maximum(low, 0.0), high, color=color, alpha=0.15, lw=0)
    single = [(p.severity, v) for p in points if 1 < len(p.values) < FEWEST_FOR_BAND for v in p.values]
    if single:
        axes.plot(*np.array(single).T, ".", color=color, ms=3, alpha=0.6)


def plot_tracks(plots: Sequence[Tracks]) -> Figure:
    """Small maps side by side: the estimate over the truth, axes equal."""
    figure, axes = _grid(len(plots), 2.2, below=0.2)
    for ax, plot in zip(axes, plots, strict=True):
        ax.plot(*np.array(plot.truth).T, color="#999999", lw=2.4)
        ax.plot(*np.array(plot.estimate).T, color=BLUE, lw=1.1)
        ax.plot(*plot.truth[0], marker="o", ms=4.5, color=GREEN, mec="white")
        ax.set_title(plain_label(plot.title), fontsize=SMALL)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel("x [m]", fontsize=SMALL)
    axes[0].set_ylabel("y [m]", fontsize=SMALL)
    handles = [
        Line2D([], [], color=BLUE, lw=1.1, label="estimate"),
        Line2D([], [], color="#999999", lw=2.4, label="truth"),
        Line2D([], [], color=GREEN, marker="o", ms=4.5, mec="white", linestyle="none", label="start"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=SMALL, frameon=False)
    return figure


def _grid(count: int, height: float, below: float = 0.0) -> tuple[Figure, list[Axes]]:
    columns = min(_COLUMNS, count)
    rows = math.ceil(count / columns)
    width = max(WIDTH * columns / _COLUMNS, _SINGLE_WIDTH)
    figure = Figure(figsize=(width, height * rows + 0.4 + below), dpi=DPI, layout="constrained")
    axes = [figure.add_subplot(rows, columns, k + 1) for k in range(count)]
    for ax in axes:
        tidy(ax)
    return figure, axes
