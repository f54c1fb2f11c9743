"""What the pictures of a run share: colors (those of Okabe and Ito), modes, axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from fgloc.types import FloatArray, Mode, RunResult

BLUE, ORANGE, GREEN, RED, SKY, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#555555"
MODE_LOOKS = {
    Mode.UNCONFIRMED: (SKY, "first pose not confirmed", ".."),
    Mode.DEAD_RECKONING: (ORANGE, "dead reckoning", "//"),
    Mode.LOST: (RED, "lost", "xx"),
}
WIDTH = 9.0  # inches
_LONGEST_LABEL = 60
GAP_S = 1.0  # a line is not drawn across a longer silence
TEXT: dict[str, Any] = {"fontsize": 9, "color": "#222222"}


def plain_label(text: str) -> str:
    """A name from a recording or a suite as a label: no formula, no control characters, not too long."""
    shown = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    shown = shown if len(shown) <= _LONGEST_LABEL else shown[: _LONGEST_LABEL - 1] + "…"
    return shown.replace("$", r"\$")


def seconds(result: RunResult, stamps_ns: NDArray[np.int64] | Sequence[int]) -> FloatArray:
    """Seconds from the first pose."""
    return np.asarray((np.asarray(stamps_ns, dtype=np.int64) - result.trajectory.stamps_ns[0]) * 1e-9)


def broken(stamps_ns: NDArray[np.int64], columns: FloatArray) -> FloatArray:
    """Rows with a NaN row in each silence, so that no line is drawn across it."""
    gaps = np.flatnonzero(np.diff(stamps_ns) > GAP_S * 1e9) + 1
    return np.insert(columns, gaps, np.nan, axis=0)


def mode_runs(result: RunResult, mode: Mode) -> list[tuple[int, int]]:
    """First and last index of each stretch in this mode."""
    inside = np.array([m is mode for m in result.modes], dtype=int)
    edges = np.diff(np.concatenate([[0], inside, [0]]))
    return list(zip(np.flatnonzero(edges == 1).tolist(), (np.flatnonzero(edges == -1) - 1).tolist(), strict=True))


def shade_modes(axes: Axes, result: RunResult) -> None:
    """Shade the stretches that were not OK."""
    times = seconds(result, result.trajectory.stamps_ns)
    for mode, (color, _, hatch) in MODE_LOOKS.items():
        for first, last in mode_runs(result, mode):
            start = float(times[max(first - 1, 0)])
            look: dict[str, Any] = dict(facecolor=color, edgecolor=color, alpha=0.18, lw=0, hatch=hatch, zorder=0)
            axes.axvspan(start, float(times[last]), **look)


def mode_handles(result: RunResult) -> list[Artist]:
    """Legend entries of the modes that occur."""
    return [
        Patch(facecolor=color, edgecolor=color, alpha=0.3, hatch=hatch, label=label)
        for mode, (color, label, hatch) in MODE_LOOKS.items()
        if mode in result.modes
    ]


def legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put a legend above the plots."""
    columns = math.ceil(len(handles) / math.ceil(len(handles) / 6))
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)


def tidy(axes: Axes) -> None:
    """Grid and no frame."""
    axes.grid(color="#e5e5e5", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
