"""Pictures of a model's evaluation: where it went, how its error grows, whether its covariance holds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from fgloc.types import FloatArray
from fgloc_training.plots import save
from fgloc_training.rollouts import Rollout, relative

_WINDOW_S = 60.0
_MAX_PANELS = 6


class Growth(Protocol):
    """What is drawn of one source at one horizon."""

    @property
    def horizon_s(self) -> float:
        """Length of the rollout."""

    @property
    def drift_percent(self) -> float:
        """Summed end error over summed distance."""

    @property
    def yaw_end_deg(self) -> float:
        """Mean yaw error at the end."""


def draw_tracks(path: Path, rollouts: list[Rollout]) -> None:
    """Predicted over actual, a panel for each recording; every minute the prediction starts at the truth again."""
    shown = rollouts[:_MAX_PANELS]
    columns = min(3, len(shown))
    figure = Figure(figsize=(5.2 * columns, 4.8 * -(-len(shown) // columns)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(-(-len(shown) // columns), columns)).ravel()
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    for axes, rollout in zip(panels, shown, strict=False):
        x, y = np.where(rollout.valid[:, None], rollout.truth[:, :2], np.nan).T
        axes.plot(x, y, color="0.6", linewidth=2.0, label="actual")
        steps = round(_WINDOW_S / rollout.step_s)
        for first in range(0, len(rollout.motions), steps):
            piece = slice(first, first + steps + 1)
            moved = relative(np.broadcast_to(rollout.track[first], rollout.track[piece].shape), rollout.track[piece])
            start = rollout.truth[first]
            c, s = np.cos(start[2]), np.sin(start[2])
            px, py = start[0] + c * moved[:, 0] - s * moved[:, 1], start[1] + s * moved[:, 0] + c * moved[:, 1]
            axes.plot(px, py, color="C0", linewidth=0.9, label="predicted" if first == 0 else None)
            axes.plot(px[0], py[0], "o", color="C2", markersize=3, label="start anew" if first == 0 else None)
        axes.set_aspect("equal", "datalim")
        axes.set(title=f"{rollout.run.name}: free for {_WINDOW_S:.0f} s at a time", xlabel="x [m]", ylabel="y [m]")
        axes.legend(fontsize=8)
    save(figure, path)


def draw_growth(path: Path, rows: Sequence[tuple[str, Growth]]) -> None:
    """Drift and yaw error against the length of the free rollout, a line for each source."""
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    drift, yaw = figure.subplots(1, 2)
    for name in dict.fromkeys(name for name, _ in rows):
        mine = [growth for other, growth in rows if other == name]
        horizons = [growth.horizon_s for growth in mine]
        drift.plot(horizons, [growth.drift_percent for growth in mine], "o-", markersize=4, label=name)
        yaw.plot(horizons, [growth.yaw_end_deg for growth in mine], "o-", markersize=4, label=name)
    for axes, label in ((drift, "end error over distance [%]"), (yaw, "mean yaw error at the end [°]")):
        axes.set(xlabel="free rollout [s]", ylabel=label, xscale="log")
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3, which="both")
        ticks = sorted({growth.horizon_s for _, growth in rows})
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.legend(fontsize=8)
    save(figure, path)


def draw_calibration(path: Path, shares: FloatArray, inside: dict[float, FloatArray]) -> None:
    """Share of errors inside ellipsoids against the share that should be, a line for each horizon.

    Args:
        path: PNG to write.
        shares: ``(n,)`` that should be inside.
        inside: by horizon [s], ``(n,)`` that are.
    """
    figure = Figure(figsize=(4.8, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.5", linestyle="--", linewidth=1.0)
    for horizon, found in inside.items():
        axes.plot(shares, found, label=f"{horizon:g} s")
    for share, name in ((0.6827, "1σ"), (0.9545, "2σ")):
        axes.axvline(share, color="0.85", linewidth=0.8, zorder=0)
        axes.text(share, 0.02, name, ha="right", fontsize=8, color="0.4")
    axes.text(0.04, 0.93, "too cautious", fontsize=8, color="0.4")
    axes.text(0.98, 0.10, "too sure", ha="right", fontsize=8, color="0.4")
    axes.set(xlabel="share that should be inside", ylabel="share inside", xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes.legend(fontsize=8, loc="lower center")
    save(figure, path)
