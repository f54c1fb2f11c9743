"""Pictures of an ablation: error over severity, and the worst track of each failure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgloc.evaluation.style import plain_label

_COLORS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7", "#555555")  # Okabe and Ito
_COLUMNS = 3
_WIDTH = 9.0  # inches


@dataclass(frozen=True, slots=True)
class Point:
    """A mean at one severity, with its interval if there is one."""

    severity: float
    mean: float
    interval: tuple[float, float] | None


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
    """Small plots side by side, all with one meaning of color; bands are the intervals."""
    names = list(dict.fromkeys(name for plot in plots for name in plot.curves))
    columns = 1 if len(plots) == 1 else 2 if len(plots) == 2 else 4  # of the legend: what the plots' width has room for
    figure, axes = _grid(len(plots), 2.4, below=0.2 * math.ceil(len(names) / columns))
    for ax, plot in zip(axes, plots, strict=True):
        for name, points in plot.curves.items():
            color = _COLORS[names.index(name) % len(_COLORS)]
            x = [p.severity for p in points]
            ax.plot(x, [p.mean for p in points], "o-", color=color, lw=1.5, ms=4, label=plain_label(name))
            banded = [p for p in points if p.interval is not None]
            low = [max(0.0, p.interval[0]) for p in banded if p.interval is not None]
            high = [p.interval[1] for p in banded if p.interval is not None]
            ax.fill_between([p.severity for p in banded], low, high, color=color, alpha=0.15, lw=0)
        ax.set_title(plain_label(plot.title), fontsize=9)
        ax.set_xlabel(plain_label(plot.unit), fontsize=8)
        ax.set_ylim(bottom=0.0)
    axes[0].set_ylabel(label, fontsize=8)
    handles = {name: h for ax in axes for h, name in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(
        list(handles.values()), list(handles), loc="outside lower center", ncols=columns, fontsize=8, frameon=False
    )
    return figure


def plot_tracks(plots: Sequence[Tracks]) -> Figure:
    """Small maps side by side: the estimate over the truth, axes equal."""
    figure, axes = _grid(len(plots), 2.8)
    for ax, plot in zip(axes, plots, strict=True):
        ax.plot(*np.array(plot.truth).T, color="#999999", lw=2.2)
        ax.plot(*np.array(plot.estimate).T, color=_COLORS[0], lw=1.2)
        ax.set_title(plain_label(plot.title), fontsize=9)
        ax.set_aspect("equal", adjustable="datalim")
    return figure


def _grid(count: int, height: float, below: float = 0.0) -> tuple[Figure, list[Axes]]:
    columns = min(_COLUMNS, count)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(_WIDTH * columns / _COLUMNS, height * rows + 0.4 + below), dpi=110, layout="constrained")
    axes = [figure.add_subplot(rows, columns, k + 1) for k in range(count)]
    for ax in axes:
        ax.tick_params(labelsize=8)
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(alpha=0.25)
    return figure, axes
