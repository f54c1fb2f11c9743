"""The error of a run against its 3σ band. The other pictures are in `trajectory_plot` and `timeline`."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fgloc.evaluation.error_scale import ErrorScale
from fgloc.evaluation.matching import Matched
from fgloc.evaluation.style import (
    BLUE,
    DPI,
    GREY,
    NORMAL,
    SKY,
    WIDTH,
    broken,
    legend,
    mode_handles,
    seconds,
    shade_modes,
    tidy,
)
from fgloc.evaluation.time_axis import TimeAxis
from fgloc.types import RunResult


def plot_error(result: RunResult, matched: Matched | None) -> Figure:
    """Error in x, y and yaw against its ±3σ band over time; without a truth the band alone."""
    trajectory = result.trajectory
    bands = None if trajectory.covs is None else 3.0 * np.sqrt(np.diagonal(trajectory.covs, axis1=1, axis2=2))
    figure = Figure(figsize=(WIDTH, 4.4), dpi=DPI, layout="constrained")
    rows: list[Axes] = figure.subplots(3, 1, sharex=True).tolist()
    axis_of_time = TimeAxis.of(result)
    for axis, (axes, name) in enumerate(zip(rows, ("x", "y", "yaw"), strict=True)):
        known = None if matched is None else (matched.stamps_ns, np.abs(matched.errors[:, axis]))
        scale = ErrorScale.of(result, None if bands is None else bands[:, axis], known, angle=axis == 2)
        if bands is not None:
            times = seconds(result, trajectory.stamps_ns)
            t, band = broken(trajectory.stamps_ns, np.column_stack([times, scale.unit * bands[:, axis]])).T
            axes.fill_between(t, -band, band, color=SKY, alpha=0.25, lw=0)
            axes.plot(t, band, color=SKY, lw=0.8)
            axes.plot(t, -band, color=SKY, lw=0.8)
        if matched is not None:
            times = seconds(result, matched.stamps_ns)
            t, error = broken(matched.stamps_ns, np.column_stack([times, scale.unit * matched.errors[:, axis]])).T
            axes.plot(t, error, color=BLUE, lw=1.0)
        axes.axhline(0.0, color=GREY, lw=0.6)
        tidy(axes)
        scale.apply(axes, symmetric=True)
        axes.set_ylabel(f"{name} [{scale.name}]", fontsize=NORMAL)
        shade_modes(axes, result)
        axis_of_time.draw_cuts(axes, told=axis == 0)
    axis_of_time.apply(rows[-1])
    figure.align_ylabels(rows)
    rows[-1].set_xlabel("time from the first pose [s]", fontsize=NORMAL)
    handles: list[Artist] = [] if bands is None else [Patch(facecolor=SKY, alpha=0.4, label="±3σ of the estimate")]
    if matched is not None:
        handles.insert(0, Line2D([], [], color=BLUE, lw=1.2, label="estimate − truth"))
    handles += mode_handles(result)
    if handles:
        legend(figure, handles)
    return figure
