"""Whether the recordings drove the robot through all that it may be commanded: nothing else is identified."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fgloc.types import FloatArray
from fgloc_training.config import SpeedLimits
from fgloc_training.data import Run
from fgloc_training.plots import save

_BINS_V, _BINS_OMEGA = 4, 7  # odd, so that straight ahead is a range of its own
ENOUGH_S = 5.0  # in a range of one speed or of both


@dataclass(frozen=True, slots=True)
class Controls:
    """Seconds for which speeds were commanded, in ranges between the robot's limits."""

    v_edges: FloatArray  # (a + 1,) m/s
    omega_edges: FloatArray  # (b + 1,) rad/s
    seconds: FloatArray  # (a, b)
    commanded: FloatArray  # (n, 2) v, ω at each sample
    limits: SpeedLimits | None

    def missing(self) -> list[str]:
        """What the recordings say too little of, in words; nothing if no limits are known."""
        if self.limits is None:
            return []
        found = []
        for edges, seconds, name, unit in (
            (self.v_edges, self.seconds.sum(axis=1), "v", "m/s"),
            (self.omega_edges, self.seconds.sum(axis=0), "ω", "rad/s"),
        ):
            for (low, high), spent in zip(pairwise(edges), seconds, strict=True):
                if spent < ENOUGH_S:
                    found.append(f"{name} from {low:.2g} to {high:.2g} {unit}: {spent:.1f} s, want {ENOUGH_S:.0f} s")
        for side, fast in (("left", self.commanded[:, 1]), ("right", -self.commanded[:, 1])):
            both = (self.commanded[:, 0] > 0.5 * self.limits.v_mps) & (fast > 0.5 * self.limits.omega_radps)
            spent = self.seconds.sum() * float(both.mean())
            if spent < ENOUGH_S:
                found.append(
                    f"fast and turning {side} (v over {0.5 * self.limits.v_mps:.2g} m/s, |ω| over "
                    f"{0.5 * self.limits.omega_radps:.2g} rad/s): {spent:.1f} s, want {ENOUGH_S:.0f} s"
                )
        return found


def controls(runs: list[Run], limits: SpeedLimits | None) -> Controls:
    """Count what was commanded while there was a truth.

    Args:
        runs: those that train.
        limits: of the robot; None: the ranges end at the largest commands.
    """
    commanded, seconds = [], []
    for run in runs:
        commanded.append(run.track.means(np.append(run.times, len(run.poses) * run.dt_s))[run.valid])
        seconds.append(np.full(len(commanded[-1]), run.dt_s))
    commands, weights = np.concatenate(commanded), np.concatenate(seconds)
    if limits is None:
        lowest, (v, omega) = min(0.0, float(commands[:, 0].min())), np.maximum(1e-3, np.abs(commands).max(axis=0))
    else:
        lowest, v, omega = -limits.reverse_mps, limits.v_mps, limits.omega_radps
    edges = np.linspace(lowest, v, _BINS_V + 1), np.linspace(-omega, omega, _BINS_OMEGA + 1)
    inside = np.clip(commands, [lowest, -omega], [v, omega])
    counted, _, _ = np.histogram2d(*inside.T, bins=edges, weights=weights)
    return Controls(*edges, counted, commands, limits)


def draw_controls(path: Path, found: Controls) -> None:
    """Commands as points over the seconds in each range; ranges with too few of them are hatched."""
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    axes = figure.subplots()
    image = axes.pcolormesh(
        found.omega_edges, found.v_edges, np.log10(np.maximum(found.seconds, 0.1)), cmap="Blues", vmin=-1.0
    )
    for i, j in np.argwhere(found.seconds < ENOUGH_S):
        (left, right), (low, high) = found.omega_edges[j : j + 2], found.v_edges[i : i + 2]
        axes.fill([left, right, right, left], [low, low, high, high], fill=False, hatch="//", color="C3", alpha=0.4)
    axes.plot(found.commanded[:, 1], found.commanded[:, 0], ".", color="0.2", markersize=1.5)
    for i, row in enumerate(found.seconds):
        for j, spent in enumerate(row):
            middle = 0.5 * (found.omega_edges[j] + found.omega_edges[j + 1]), 0.5 * sum(found.v_edges[i : i + 2])
            box = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.0}
            axes.text(*middle, f"{spent:.0f} s", ha="center", va="center", fontsize=8, bbox=box)
    figure.colorbar(image, label="log10 of seconds")
    limits = "the robot's limits" if found.limits is not None else "the largest commands"
    axes.set(title=f"Commands up to {limits}; hatched: under {ENOUGH_S:.0f} s")
    axes.set(xlabel="ω [rad/s]", ylabel="v [m/s]")
    save(figure, path)
