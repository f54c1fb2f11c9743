"""Pictures of a run on uneven ground: its path in space, and height, pitch and roll over the distance travelled."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from fgloc.evaluation.matching import Matched
from fgloc.evaluation.style import BLUE, DPI, NORMAL, RED, SKY, SMALL, WIDTH, tidy
from fgloc.evaluation.trajectory_plot import travelled
from fgloc.types import RunResult

_TALLER = 4.0  # times: heights of a floor are small beside its extent


def plot_space(result: RunResult, matched: Matched | None) -> Figure:
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


def plot_height(result: RunResult, matched: Matched | None) -> Figure:
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
        axes.set_ylabel(name, fontsize=NORMAL)
        tidy(axes)
    figure.align_ylabels(rows)
    rows[0].legend(loc="upper right", frameon=False, fontsize=NORMAL)
    rows[-1].set_xlabel("distance travelled [m]", fontsize=NORMAL)
    return figure
