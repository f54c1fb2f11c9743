"""What the pictures of a run share: size, colors (those of Okabe and Ito), modes, axes."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from matplotlib import rc_context
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
WIDTH = 7.16  # inches: a page's text in two columns, as IEEE has it
DPI = 150
SMALL = 7.0  # points: of ticks and labels in a plot
NORMAL = 8.0  # points: of axes and legends
_LONGEST_LABEL = 60
GAP_S = 1.0  # a line is not drawn across a longer silence
TEXT: dict[str, Any] = {"fontsize": SMALL, "color": "#222222"}
Format = Literal["png", "svg", "pdf"]
FORMATS: tuple[Format, ...] = get_args(Format)
_UNDATED: dict[Format, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}
# Text stays text in SVG and PDF; the ids of an SVG do not depend on chance.
_FILES: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "fgloc", "pdf.fonttype": 42}


def image_of(figure: Figure, form: Format) -> bytes:
    """A figure as a file, the same bytes for the same figure."""
    buffer = io.BytesIO()
    with rc_context(_FILES):
        figure.savefig(buffer, format=form, metadata=_UNDATED[form])
    return buffer.getvalue()


def png(figure: Figure) -> bytes:
    """A figure as PNG."""
    return image_of(figure, "png")


def plain_label(text: str, longest: int = _LONGEST_LABEL) -> str:
    """A name from a recording or a suite as a label: no formula, no control characters, long ones cut in the middle."""
    shown = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    if len(shown) > longest:
        head = longest // 2
        shown = f"{shown[:head]}…{shown[head + 1 - longest :]}"
    return shown.replace("$", r"\$")


def seconds(result: RunResult, stamps_ns: NDArray[np.int64] | Sequence[int]) -> FloatArray:
    """Seconds from the first pose."""
    return np.asarray((np.asarray(stamps_ns, dtype=np.int64) - result.trajectory.stamps_ns[0]) * 1e-9)


def after_gaps(stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of the stamps ``(n,)`` before which there is a longer silence."""
    return np.flatnonzero(np.diff(stamps_ns) > GAP_S * 1e9) + 1


def broken(stamps_ns: NDArray[np.int64], columns: FloatArray) -> FloatArray:
    """Rows with a NaN row in each silence, so that no line is drawn across it."""
    return np.insert(columns, after_gaps(stamps_ns), np.nan, axis=0)


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
    columns = math.ceil(len(handles) / math.ceil(len(handles) / 4))
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False, fontsize=NORMAL)


def tidy(axes: Axes) -> None:
    """Grid and no frame."""
    axes.grid(color="#e5e5e5", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=SMALL)
