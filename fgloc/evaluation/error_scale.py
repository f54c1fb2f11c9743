"""The scale of an error's axis: linear for what is usual in a run, logarithmic beyond, so that nothing is flattened."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from fgloc.evaluation.matching import Matched
from fgloc.evaluation.style import TEXT
from fgloc.types import FloatArray, IntArray, Mode, RunResult

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
        cls, result: RunResult, band: FloatArray | None, error: tuple[IntArray, FloatArray] | None, angle: bool = False
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
    def of_distance(cls, result: RunResult, matched: Matched | None) -> ErrorScale:
        """The scale for 3σ of the position and the distance from the truth."""
        covs = result.trajectory.covs
        band = None if covs is None else 3.0 * np.sqrt(covs[:, 0, 0] + covs[:, 1, 1])
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


def _calm(result: RunResult) -> NDArray[np.bool_]:
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
