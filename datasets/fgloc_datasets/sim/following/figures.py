"""Pictures and a table of drives.

Source: the paper's Figure 4: waypoints in green, the true path in red; the pose that guided the robot in blue.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from fgloc_datasets.sim.figures import STYLE
from fgloc_datasets.sim.following.loop import Drive
from fgloc_datasets.sim.following.results import Followed
from fgloc_datasets.sim.ground import make_ground, outline
from fgloc_datasets.sim.room import make_map

_COLUMNS = 3
_AROUND_M = 0.35
_HEAD = ("drive", "pose", "track", "worst", "reached", "pose error", "time")


def draw_drives(drives: Mapping[str, tuple[Drive, Followed]], out: Path, close: bool = True) -> None:
    """One panel for each drive.

    Args:
        drives: by title.
        out: the PNG file.
        close: show the path alone, not the whole room.
    """
    columns = min(_COLUMNS, len(drives))
    rows = -(-len(drives) // columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.9 * columns, 3.1 * rows + 0.4), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
        for ax in axes.flat[len(drives) :]:
            ax.axis("off")
        for ax, (title, (drive, followed)) in zip(axes.flat, drives.items(), strict=False):
            _panel(ax, drive, followed, close)
            ax.set_title(f"{title}\npose: {drive.pose}, {followed.score.track_mm:.0f} mm from the path", fontsize=9)
        figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
        figure.savefig(out, dpi=110)


def _panel(ax: Axes, drive: Drive, followed: Followed, close: bool) -> None:
    world, seed = drive.scenario.world, drive.seed
    for patch in make_ground(world, seed).patches:
        ax.add_patch(Polygon(outline(patch) + patch.center, color="tab:cyan", alpha=0.25, lw=0))
    waypoints = np.array(drive.path.waypoints)
    ax.plot(*waypoints.T, "o", color="tab:green", ms=4, label="waypoints")
    ax.plot(*followed.poses[:, :2].T, color="tab:blue", lw=1.0, label="estimated path")
    ax.plot(*followed.true_path[:, :2].T, color="tab:red", lw=1.2, label="true path")
    ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    if close:
        shown = np.concatenate([waypoints, followed.true_path[:, :2]])
        low, high = shown.min(axis=0) - _AROUND_M, shown.max(axis=0) + _AROUND_M
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        return
    for landmark in make_map(world, seed).landmarks.values():
        corners = landmark.corners()
        ax.plot(corners[:2, 0], corners[:2, 1], color="k", lw=3, solid_capstyle="butt")


def table(drives: Mapping[str, tuple[Drive, Followed]]) -> str:
    """Scores as text."""
    lines: list[Sequence[str]] = [_HEAD]
    for title, (drive, followed) in drives.items():
        s = followed.score
        error = "" if s.pose_mm is None else f"{s.pose_mm:.1f} mm"
        time = f"{s.seconds:.0f} s" if s.arrived else "not arrived"
        shares = f"{100 * s.reached:.0f} %"
        lines.append((title, drive.pose, f"{s.track_mm:.1f} mm", f"{s.worst_mm:.0f} mm", shares, error, time))
    widths = [max(len(line[i]) for line in lines) for i in range(len(_HEAD))]
    return "\n".join(
        "  ".join(
            c.ljust(w) if i < 2 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
