"""Finished runs side by side: one table, and one figure of their ways and of how far they are apart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from fgloc import se2
from fgloc.errors import TrajectoryError
from fgloc.evaluation.metrics import match, matchable
from fgloc.evaluation.results import Results, read_results
from fgloc.evaluation.style import BLUE, GREEN, GREY, ORANGE, RED, SKY, WIDTH, broken, legend, plain_label, tidy
from fgloc.files.outputs import read_tum
from fgloc.recording.truth import lacks_yaw
from fgloc.types import FloatArray, IntArray, Mode, Trajectory

HEAD = (
    "run",
    "keyframes",
    "ATE mean [m]",
    "ATE rmse [m]",
    "yaw MAE [deg]",
    "NEES/3",
    "not OK",
    "findings",
    "apart [m]",
)
_COLORS = (BLUE, RED, GREEN, ORANGE, SKY)
_DASHES = ("-", "--", ":", "-.")  # of the runs beyond as many
_BRIDGED_S = 1.0  # between two poses of the first run
_FRAME_M = 0.2  # distance between two runs above which their frames are asked about
_ALIGNED = 0.2  # share of it that may remain where the frames differ


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A finished run beside the first one.

    Attributes:
        name: of its folder, as short as it tells the runs apart.
        results: as they were read.
        truth: in the run's frame, at stamps ``(m,)`` with poses ``(m, 3)``; None: the folder has none.
        apart: distances ``(k,)`` [m] from the first run at stamps ``(k,)``.
    """

    name: str
    results: Results
    truth: Trajectory | None
    apart_ns: IntArray
    apart: FloatArray

    def row(self) -> tuple[str, ...]:
        """Cells of `HEAD`."""
        m = self.results.metrics
        named = Counter(str(f.get("severity", "")) for f in m.get("findings", ()))
        off = sum(mode is not Mode.OK for mode in self.results.modes) / max(len(self.results.modes), 1)
        rms = "-" if not len(self.apart) else f"{np.sqrt(np.mean(self.apart**2)):.4f}"
        figures = (("ate_mean_m", ".4f"), ("ate_rmse_m", ".4f"), ("yaw_mae_deg", ".3f"), ("nees_over_3", ".2f"))
        cells = ["-" if m.get(key) is None else format(float(m[key]), form) for key, form in figures]
        grave = ", ".join(f"{named[s]} {s}" for s in ("error", "warning") if named[s]) or "-"
        return self.name, str(len(self.results.trajectory)), *cells, f"{100.0 * off:.1f} %", grave, rms


def compare(folders: Sequence[Path]) -> list[Compared]:
    """Read finished runs, and hold each against the first.

    Raises:
        TrajectoryError: a folder is not that of a finished run.
    """
    read = [read_results(folder) for folder in folders]
    return [_held(name, one, read[0]) for name, one in zip(_names(folders), read, strict=True)]


def _held(name: str, one: Results, first: Results) -> Compared:
    stamps, apart = np.array([], dtype=np.int64), np.zeros(0)
    if one is not first:
        stamps, apart = _distances(one.trajectory, first.trajectory)
    return Compared(name, one, _truth(one), stamps, apart)


def _distances(own: Trajectory, other: Trajectory) -> tuple[IntArray, FloatArray]:
    """Stamps ``(k,)`` of a trajectory at which there is another one, and its distances ``(k,)`` [m] from that."""
    k = matchable(own, other, _BRIDGED_S)
    there = se2.interpolate(other.stamps_ns, other.poses, own.stamps_ns[k]) if len(k) else np.zeros((0, 3))
    return own.stamps_ns[k], np.hypot(*(own.poses[k] - there)[:, :2].T)


def remarks(runs: Sequence[Compared]) -> list[str]:
    """Sentences on runs whose distance from the first one is none of their estimates."""
    first, found = runs[0], []
    base = first.results.trajectory
    for run in runs[1:]:
        if not len(run.apart):
            found.append(f"{run.name} and {first.name} share no time: they are of different recordings.")
            continue
        own = run.results.trajectory
        here = own.poses[np.searchsorted(own.stamps_ns, run.apart_ns)]
        there = se2.interpolate(base.stamps_ns, base.poses, run.apart_ns)
        T = se2.rigid_if_spread(here[:, :2], there[:, :2])
        if T is None:
            continue
        moved = se2.compose_array(T, here)
        left, apart = (float(np.sqrt(np.mean(a**2))) for a in (np.hypot(*(moved - there)[:, :2].T), run.apart))
        if apart > _FRAME_M and left < _ALIGNED * apart:
            found.append(
                f"{run.name} and {first.name} are in different frames, as with and without a map: of {apart:.3g} m "
                f"apart {left:.3g} m are left once one is moved rigidly onto the other (fgloc evaluate --align se2)."
            )
    return found


def _truth(one: Results) -> Trajectory | None:
    """Truth beside a run, in the frame in which the run compared it."""
    path = one.folder / "truth.tum"
    if not path.is_file():
        return None
    config: Any = one.provenance.get("config")
    settings = config.get("truth", {}) if isinstance(config, dict) else {}
    align: Literal["none", "se2"] = "se2" if settings.get("align") == "se2" else "none"
    truth = read_tum(path)
    truth = replace(truth, has_yaw=not lacks_yaw(truth.poses))
    x, y = settings.get("offset_m", (0.0, 0.0))
    try:
        matched = match(one.trajectory, truth, align, float(settings.get("max_gap_s", 0.2)), (float(x), float(y)))
    except TrajectoryError:  # they share no time
        return None
    if not matched.has_yaw:
        return Trajectory(matched.stamps_ns, matched.truth)
    return Trajectory(truth.stamps_ns, se2.compose_array(matched.T_map_truth, truth.poses))


def _names(folders: Sequence[Path]) -> list[str]:
    """Ends of paths, with as many parts as tell them apart."""
    parts = [folder.resolve().parts for folder in folders]
    for n in range(1, max(map(len, parts)) + 1):
        names = ["/".join(p[-n:]) for p in parts]
        if len(set(names)) == len(names):
            return names
    return [str(folder) for folder in folders]


def plot_comparison(runs: Sequence[Compared]) -> Figure:
    """Ways of the runs, and below their distances from the truth, or from the first run where there is none."""
    figure = Figure((WIDTH, 1.35 * WIDTH), layout="constrained")
    way, error = figure.subplots(2, 1, height_ratios=(3, 1))
    truth = next((run.truth for run in runs if run.truth is not None), None)
    handles = []
    if truth is not None:
        xy = broken(truth.stamps_ns, truth.poses[:, :2])
        handles += way.plot(*xy.T, color=GREY, lw=3.0, alpha=0.5, label="truth")
    start = min(int(run.results.trajectory.stamps_ns[0]) for run in runs)
    for i, run in enumerate(runs):
        color, dashes = _COLORS[i % len(_COLORS)], _DASHES[i // len(_COLORS) % len(_DASHES)]
        own = run.results.trajectory
        handles += way.plot(
            *broken(own.stamps_ns, own.poses[:, :2]).T, color=color, ls=dashes, lw=1.2, label=plain_label(run.name)
        )
        stamps, off = run.apart_ns, run.apart
        if run.truth is not None and len((to_truth := _distances(own, run.truth))[0]):
            stamps, off = to_truth
        if len(stamps):
            times = broken(stamps, np.column_stack([(stamps - start) * 1e-9, off]))
            error.plot(*times.T, color=color, ls=dashes, lw=1.0)
    way.set_aspect("equal", adjustable="datalim")
    tidy(way, "x [m]", "y [m]")
    tidy(error, "time [s]", f"distance from {'the truth' if truth is not None else 'the first run'} [m]")
    legend(figure, handles)
    return figure
