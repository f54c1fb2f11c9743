"""The time axis of a run's pictures: a long silence of all poses, as after a jump of the clock, is drawn short."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, MaxNLocator

from fgloc.evaluation.style import GREY, SMALL, seconds
from fgloc.types import FloatArray, RunResult

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
    def of(cls, result: RunResult) -> TimeAxis:
        """From the first message or pose to the last pose."""
        poses = seconds(result, result.trajectory.stamps_ns)
        first = min([float(poses[0]), *(float(t.times.min()) for t in result.spans.values() if len(t.times))])
        first = max(first, float(poses[0]) - max(np.ptp(poses), 1.0))  # a stray old message is no reason to show years
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
        """How long it is drawn [s]."""
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
        """Mark the cuts; `told`: say how long they are."""
        for start, end in self.cuts:
            axes.axvspan(start, end, facecolor="white", edgecolor=GREY, hatch="\\\\\\", alpha=0.5, lw=0, zorder=0.4)
            if told:
                at = {"xy": (0.5 * (start + end), 0.5), "xycoords": ("data", "axes fraction")}
                look = {"rotation": 90, "ha": "center", "va": "center", "fontsize": SMALL, "zorder": 8}
                box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
                axes.annotate(f"{end - start:.0f} s cut", **at, **look, bbox=box)  # type: ignore[arg-type]

    def place(self, time: FloatArray | float) -> FloatArray:
        """Where times ``(n,)`` [s] are drawn, in seconds outside the cuts."""
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
