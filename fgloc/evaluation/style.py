"""Style of the plots of a run: size, colors (those of Okabe and Ito), modes, the axes of time and of errors."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from fgloc.evaluation.metrics import Matched
from fgloc.results import RunData
from fgloc.types import FloatArray, IntArray, Mode

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


def image_of(figure: Figure, form: Format = "png") -> bytes:
    """A figure as a file, the same bytes for the same figure."""
    buffer = io.BytesIO()
    if (layout := figure.get_layout_engine()) is not None:  # once: `savefig` would draw all of it once more for that
        layout.execute(figure)
        figure.set_layout_engine("none")
    with rc_context(_FILES):
        figure.savefig(buffer, format=form, metadata=_UNDATED[form])
    return buffer.getvalue()


def plain_label(text: str, longest: int = _LONGEST_LABEL) -> str:
    """A name from a recording or a suite as a label: no formula, no control characters, long ones cut in the middle."""
    shown = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    if len(shown) > longest:
        head = longest // 2
        shown = f"{shown[:head]}…{shown[head + 1 - longest :]}"
    return shown.replace("$", r"\$")


def seconds(result: RunData, stamps_ns: NDArray[np.int64] | Sequence[int]) -> FloatArray:
    """Seconds from the first pose."""
    return np.asarray((np.asarray(stamps_ns, dtype=np.int64) - result.trajectory.stamps_ns[0]) * 1e-9)


def after_gaps(stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of the stamps ``(n,)`` before which there is a longer silence."""
    return np.flatnonzero(np.diff(stamps_ns) > GAP_S * 1e9) + 1


def broken(stamps_ns: NDArray[np.int64], columns: FloatArray) -> FloatArray:
    """Rows with a NaN row in each silence, so that no line is drawn across it."""
    return np.insert(columns, after_gaps(stamps_ns), np.nan, axis=0)


def over_time(result: RunData, stamps_ns: NDArray[np.int64], values: FloatArray) -> FloatArray:
    """Seconds from the first pose and values ``(2, m)``, with NaN in each silence."""
    return broken(stamps_ns, np.column_stack([seconds(result, stamps_ns), values])).T


def position_sigma(covs: FloatArray) -> FloatArray:
    """Standard deviation ``(n,)`` [m] of the distance from the true position, by covariances ``(n, 3, 3)``."""
    return np.asarray(np.sqrt(covs[:, 0, 0] + covs[:, 1, 1]))


def mode_runs(result: RunData, mode: Mode) -> list[tuple[int, int]]:
    """First and last index of each stretch in this mode."""
    inside = np.array([m is mode for m in result.modes], dtype=int)
    edges = np.diff(np.concatenate([[0], inside, [0]]))
    return list(zip(np.flatnonzero(edges == 1).tolist(), (np.flatnonzero(edges == -1) - 1).tolist(), strict=True))


def shade_modes(axes: Axes, result: RunData) -> None:
    """Shade the stretches that were not OK."""
    times = seconds(result, result.trajectory.stamps_ns)
    for mode, (color, _, hatch) in MODE_LOOKS.items():
        for first, last in mode_runs(result, mode):
            start = float(times[max(first - 1, 0)])
            look: dict[str, Any] = dict(facecolor=color, edgecolor=color, alpha=0.18, lw=0, hatch=hatch, zorder=0)
            axes.axvspan(start, float(times[last]), **look)


def mode_handles(result: RunData) -> list[Artist]:
    """Legend entries of the modes that occur."""
    return [
        Patch(facecolor=color, edgecolor=color, alpha=0.3, hatch=hatch, label=label)
        for mode, (color, label, hatch) in MODE_LOOKS.items()
        if mode in result.modes
    ]


_HANDLE, _LINE = 6, 110  # characters: of a legend's symbol and space, and of its line


def legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put a legend above the plots."""
    widths = [len(str(handle.get_label())) + _HANDLE for handle in handles]
    rows = max(1, math.ceil(len(widths) / 4))
    while sum(max(widths[k : k + rows]) for k in range(0, len(widths), rows)) > _LINE and rows < len(widths):
        rows += 1
    columns = max(1, math.ceil(len(widths) / rows))
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False, fontsize=NORMAL)


def tidy(axes: Axes, x: str = "", y: str = "") -> None:
    """Draw a grid, remove the frame of the plot, and name its axes; "": the axis has no name, or another one."""
    axes.grid(color="#e5e5e5", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=SMALL)
    if x:
        axes.set_xlabel(x, fontsize=NORMAL)
    if y:
        axes.set_ylabel(y, fontsize=NORMAL)


# --- Time: a long silence of all poses, as after a jump of the clock, is drawn short ----------------------------------

_SHORTEST_S = 10.0  # of a silence that is cut ...
_SHORTEST_SHARE = 0.15  # ... and as a share of the time with poses
_DRAWN_SHARE = 0.03  # of the time with poses: how wide a cut is drawn
_TICKS = 9


@dataclass(frozen=True, slots=True, eq=False)
class TimeAxis:
    """Seconds from the first pose to places on the axis.

    Attributes:
        knots: ``(m,)`` seconds: the first and the last time, and the two ends of each cut.
        places: ``(m,)`` where these are drawn, in seconds outside the cuts.
    """

    knots: FloatArray
    places: FloatArray

    @classmethod
    def of(cls, result: RunData, received: bool = True) -> TimeAxis:
        """Axis from the first pose to the last one of a run; ``received``: from the messages that lead to the first."""
        poses = seconds(result, result.trajectory.stamps_ns)
        first = float(poses[0])
        before = np.concatenate([np.zeros(0), *(t.times for t in result.spans.values())]) if received else np.zeros(0)
        for time in sorted(before[before < first].tolist(), reverse=True):
            if first - time > _SHORTEST_S:  # a stray old message, or a topic of another clock: nothing leads from it
                break
            first = time
        first = max(first, float(poses[0]) - max(np.ptp(poses), 1.0))
        times = np.concatenate([[first], poses, [max(float(poses[-1]), first + 1e-3)]])
        steps = np.diff(times)
        held = float(steps[steps <= _SHORTEST_S].sum())
        cuts = np.flatnonzero(steps > max(_SHORTEST_S, _SHORTEST_SHARE * held))
        if first < poses[0]:
            cuts = cuts[cuts > 0]  # messages without poses at the beginning are to be seen
        kept = steps.copy()
        kept[cuts] = _DRAWN_SHARE * max(float(np.delete(steps, cuts).sum()), 1.0)
        drawn = np.concatenate([[first], first + np.cumsum(kept)])
        ends = np.unique(np.concatenate([[0, len(times) - 1], cuts, cuts + 1]))
        knots, at = np.unique(times[ends], return_index=True)
        return cls(knots, drawn[ends][at])

    @property
    def cuts(self) -> list[tuple[float, float]]:
        """First and last second of each silence that is drawn short."""
        short = np.diff(self.places) < 0.99 * np.diff(self.knots)
        return [(float(self.knots[i]), float(self.knots[i + 1])) for i in np.flatnonzero(short)]

    @property
    def length(self) -> float:
        """Drawn length of the axis [s]."""
        return float(self.places[-1] - self.places[0])

    def apply(self, axes: Axes) -> None:
        """Make it the x axis of this plot and of those that share it."""
        if self.cuts:
            axes.set_xscale("function", functions=(self.place, self._time))
            axes.xaxis.set_major_locator(FixedLocator(self.ticks()))
            axes.xaxis.set_minor_locator(FixedLocator([]))
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        margin = 0.01 * self.length
        axes.set_xlim(float(self._time(self.places[0] - margin)), float(self._time(self.places[-1] + margin)))

    def draw_cuts(self, axes: Axes, told: bool) -> None:
        """Mark the cuts of the axis; `told`: with their lengths."""
        for start, end in self.cuts:
            axes.axvspan(start, end, facecolor="white", edgecolor=GREY, hatch="\\\\\\", alpha=0.5, lw=0, zorder=0.4)
            if told:
                at = {"xy": (0.5 * (start + end), 0.5), "xycoords": ("data", "axes fraction")}
                look = {"rotation": 90, "ha": "center", "va": "center", "fontsize": SMALL, "zorder": 8}
                box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
                axes.annotate(f"{end - start:.0f} s cut", **at, **look, bbox=box)  # type: ignore[arg-type]

    def place(self, time: FloatArray | float) -> FloatArray:
        """Places ``(n,)`` of times ``(n,)`` [s] on the axis, in seconds outside the cuts."""
        return _piecewise(time, self.knots, self.places)

    def _time(self, place: FloatArray | float) -> FloatArray:
        return _piecewise(place, self.places, self.knots)

    def ticks(self, about: int = _TICKS) -> list[float]:
        """Round times outside the cuts, about so many [s]."""
        edges = [self.knots[0], *(t for cut in self.cuts for t in cut), self.knots[-1]]
        ticks: list[float] = []
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            count = max(1, round(about * (end - start) / self.length))
            inside = MaxNLocator(count).tick_values(start, end)
            ticks += [float(t) for t in inside if start <= t <= end] or [float(round(start))]
        return ticks


def _piecewise(values: FloatArray | float, knots: FloatArray, places: FloatArray) -> FloatArray:
    """Linear between the knots, with slope 1 beyond them."""
    values = np.asarray(values, dtype=float)
    inside = np.interp(values, knots, places)
    return np.asarray(inside + np.minimum(values - knots[0], 0.0) + np.maximum(values - knots[-1], 0.0))


# --- Errors: linear for what is usual in a run, logarithmic beyond, so that nothing is flattened ----------------------

_SMALL_M = 0.1  # smaller errors are drawn in millimetres
_USUAL_PERCENT = 95.0  # of the poses that are OK lie in the linear part, if not all do
_MUCH = 3.0  # times what is usual: what is larger makes the axis logarithmic
_LINEAR_SHARE = 2.0  # decades that the linear part is as high as


@dataclass(frozen=True, slots=True)
class ErrorScale:
    """How an axis of errors is drawn.

    Attributes:
        usual: what is usual, in SI units: the linear part ends there.
        largest: value, in SI units.
        unit: shown units in an SI unit.
        name: of the shown unit.
    """

    usual: float
    largest: float
    unit: float
    name: str

    @classmethod
    def of(
        cls, result: RunData, band: FloatArray | None, error: tuple[IntArray, FloatArray] | None, angle: bool = False
    ) -> ErrorScale:
        """The scale for a band and an error.

        Args:
            result: the run.
            band: half width at each pose, if there is one.
            error: stamps and absolute values, if there is a truth.
            angle: in radians, not metres.
        """
        calm = _calm(result)
        usual, largest = 1e-9, 1e-9
        if band is not None:
            usual = max(usual, float(np.percentile(band[calm], _USUAL_PERCENT)))
            largest = max(largest, float(band.max()))
        if error is not None:
            known = calm[np.searchsorted(result.trajectory.stamps_ns, error[0])]
            usual = max(usual, float(np.percentile(error[1][known], _USUAL_PERCENT)) if known.any() else 0.0)
            largest = max(largest, float(error[1].max(initial=0.0)))
        if angle:
            return cls(usual, largest, math.degrees(1.0), "°")
        return cls(usual, largest, 1e3, "mm") if usual < _SMALL_M else cls(usual, largest, 1.0, "m")

    @classmethod
    def of_distance(cls, result: RunData, matched: Matched | None) -> ErrorScale:
        """The scale for 3σ of the position and the distance from the truth."""
        covs = result.trajectory.covs
        band = None if covs is None else 3.0 * position_sigma(covs)
        return cls.of(result, band, None if matched is None else (matched.stamps_ns, matched.distances))

    @property
    def is_logarithmic(self) -> bool:
        """Whether a linear axis would flatten what is usual."""
        return self.largest > _MUCH * self.usual

    def apply(self, axes: Axes, symmetric: bool) -> None:
        """Set limits, scale and ticks.

        Args:
            axes: of the errors, in shown units.
            symmetric: about zero; else from zero.
        """
        usual, largest = self.usual * self.unit, self.largest * self.unit
        if not self.is_logarithmic:
            top = 1.1 * largest
            axes.set_ylim(-top if symmetric else 0.0, top)
            axes.yaxis.set_major_locator(MaxNLocator(4))
            return
        usual = _round_up(usual)
        axes.set_yscale("symlog", linthresh=usual, linscale=_LINEAR_SHARE)
        axes.set_ylim(-1.5 * largest if symmetric else 0.0, 1.5 * largest)
        first = math.ceil(math.log10(2.5 * usual))
        ticks = [0.5 * usual, usual, *(10.0**k for k in range(first, math.floor(math.log10(1.5 * largest)) + 1))]
        axes.yaxis.set_major_locator(FixedLocator([*(-t for t in ticks if symmetric), 0.0, *ticks]))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        told = f"logarithmic beyond {usual:g} {self.name}".replace(" °", "°")
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.6}
        axes.text(0.005, 0.96, told, transform=axes.transAxes, ha="left", va="top", zorder=7, bbox=box, **TEXT)


def _calm(result: RunData) -> NDArray[np.bool_]:
    """Which poses set the scale: those that are OK; all that are not LOST, or all, if there are no others."""
    for kept in ((Mode.OK,), (Mode.OK, Mode.UNCONFIRMED, Mode.DEAD_RECKONING), tuple(Mode)):
        chosen = np.array([mode in kept for mode in result.modes])
        if chosen.any():
            return chosen
    return np.ones(len(result.modes), dtype=bool)


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, 20, ..."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * next(step for step in (1.0, 2.0, 5.0, 10.0) if step * power >= 0.999 * value)
