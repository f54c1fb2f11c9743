"""Free rollouts of motion models against the truth: ``fgloc evaluate-model MODEL BAG...``.

Drift is the summed end error over the summed distance of all windows; ATE and yaw MAE (paper eq. 11, 12) are means
over the windows' poses; NIS/3 and coverage say whether the composed covariance holds: the share of errors inside the
ellipsoids that hold 68.27, 95.45 and 99.73 % of a Gaussian in three dimensions (Mahalanobis distance against χ²).
Windows start every second.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import chi2, norm

from fgloc import se2
from fgloc.files.outputs import write_text
from fgloc.sensors.learned.card import Kinematics, ModelCard
from fgloc.sensors.learned.network import MotionModel
from fgloc.sensors.learned.sensor import load_model
from fgloc.types import FloatArray
from fgloc_training.calibrate import nis
from fgloc_training.config import DataConfig
from fgloc_training.data import Run, load_runs
from fgloc_training.rollouts import Rollout, roll_kinematics, roll_model, roll_sources

# --- Pictures ---------------------------------------------------------------------------------------------------------

_DPI = 110
_WINDOW_S = 60.0
_MAX_PANELS = 6


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
            moved = se2.between_array(rollout.track[[first]], rollout.track[piece])
            px, py = se2.placed(rollout.truth[first], moved[:, :2]).T
            axes.plot(px, py, color="C0", linewidth=0.9, label="predicted" if first == 0 else None)
            axes.plot(px[0], py[0], "o", color="C2", markersize=3, label="start anew" if first == 0 else None)
        axes.set_aspect("equal", "datalim")
        axes.set(title=f"{rollout.run.name}: free for {_WINDOW_S:.0f} s at a time", xlabel="x [m]", ylabel="y [m]")
        axes.legend(fontsize=8)
    save(figure, path)


def draw_growth(path: Path, rows: Sequence[tuple[str, Figures]]) -> None:
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


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=_DPI)


# --- Figures ----------------------------------------------------------------------------------------------------------

HORIZONS_S = (1.0, 5.0, 10.0, 30.0, 60.0)
STEP_S = 0.2
_SHARES = np.linspace(0.0, 0.999, 200)


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of one source at one horizon; those of the covariance are None for a source that gives none."""

    horizon_s: float
    windows: int
    drift_percent: float
    ate_m: float
    yaw_mae_deg: float
    yaw_end_deg: float
    nis_over_3: float | None
    coverage: tuple[float, float, float] | None  # share of errors inside the 1, 2, 3 σ ellipsoids' probability


def evaluate(rollouts: list[Rollout], horizon_s: float) -> Figures:
    """Pool the windows of several rollouts.

    Raises:
        ValueError: no window of this length has truth throughout.
    """
    end_errors, distances, yaw_ends, ates, yaws, all_nis = [], [], [], [], [], []
    for rollout in rollouts:
        k, n = rollout.starts(horizon_s)
        if not len(k):
            continue
        for j in range(1, n + 1):
            predicted, actual = (se2.between_array(poses[k], poses[k + j]) for poses in (rollout.track, rollout.truth))
            error = se2.between_array(predicted, actual)
            ates.append(np.hypot(error[:, 0], error[:, 1]))
            yaws.append(np.abs(error[:, 2]))
        end_errors.append(ates[-1])
        yaw_ends.append(yaws[-1])
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rollout.truth[:, :2], axis=0).T))])
        distances.append(travelled[k + n] - travelled[k])
        if rollout.covs.any():
            all_nis.append(nis(rollout.errors(horizon_s), rollout.end_covs(horizon_s)))
    if not end_errors:
        raise ValueError(f"no window of {horizon_s:.0f} s with truth throughout")
    values = np.concatenate(all_nis) if all_nis else None
    return Figures(
        horizon_s=horizon_s,
        windows=sum(len(e) for e in end_errors),
        drift_percent=100.0 * float(np.concatenate(end_errors).sum() / np.concatenate(distances).sum()),
        ate_m=float(np.concatenate(ates).mean()),
        yaw_mae_deg=float(np.degrees(np.concatenate(yaws).mean())),
        yaw_end_deg=float(np.degrees(np.concatenate(yaw_ends).mean())),
        nis_over_3=None if values is None else float(values.mean() / 3.0),
        coverage=None if values is None else _coverage(values),
    )


def growth(rollouts: list[Rollout]) -> list[Figures]:
    """Figures at every horizon that the rollouts are long enough for."""
    return [evaluate(rollouts, h) for h in HORIZONS_S if any(len(r.starts(h)[0]) for r in rollouts)]


def card_figures(rollouts: list[Rollout]) -> dict[str, float]:
    """Figures of the card by name."""
    out: dict[str, float] = {}
    for figures in growth(rollouts):
        name = f"{figures.horizon_s:.0f}s"
        out |= {f"drift_percent_{name}": figures.drift_percent, f"yaw_end_deg_{name}": figures.yaw_end_deg}
        if figures.nis_over_3 is not None and figures.coverage is not None:
            out[f"nis_over_3_{name}"] = figures.nis_over_3
            out |= {f"coverage_{i}sigma_{name}": c for i, c in enumerate(figures.coverage, 1)}
    return {name: round(value, 4) for name, value in out.items()}


_WORTH_S = 10.0  # without a landmark
_WITH, _WITHOUT = "with the model", "without it"


def worth(model: MotionModel, runs: Sequence[Run]) -> dict[str, float]:
    """Drift over 10 s [%] of what else tells the motion in these runs, with the model and without it, by name.

    Commands alone are calibrated where there is no model. Sets of sensors that lack what the model reads are left out.
    Empty: no run has 10 s with truth throughout.
    """
    reads = {name for name in ("wheels", "gyro") if model.card.reads(name)}
    found: dict[str, list[Rollout]] = {}
    if not reads:
        found[f"commands, {_WITHOUT}"] = [roll_kinematics(model.card.kinematics, run, STEP_S) for run in runs]
        found[f"commands, {_WITH}"] = [roll_model(model, run, STEP_S) for run in runs]
    has_wheels, has_gyro = (all(getattr(run.sensors, name) for run in runs) for name in ("has_wheels", "has_gyro"))
    beside = {"wheels": has_wheels and "gyro" not in reads, "wheels and gyro": has_wheels and has_gyro}
    for name in (name for name, is_there in beside.items() if is_there):
        for label, given in ((_WITHOUT, None), (_WITH, model)):
            found[f"{name}, {label}"] = [roll_sources(run, STEP_S, given, "gyro" in name) for run in runs]
    try:
        return {name: evaluate(rollouts, _WORTH_S).drift_percent for name, rollouts in found.items()}
    except ValueError:
        return {}


def told_worth(drifts: Mapping[str, float]) -> str:
    """Sentence on what `worth` found; empty: nothing was."""
    names = list(dict.fromkeys(name.rpartition(",")[0] for name in drifts))
    parts = []
    for name in names:
        before, after = drifts[f"{name}, {_WITHOUT}"], drifts[f"{name}, {_WITH}"]
        parts.append(f"{name} {before:.3g} % -> {after:.3g} % with the model")
    return f"drift over {_WORTH_S:.0f} s without a landmark: {'; '.join(parts)}" if parts else ""


def sources(models: dict[str, Path], runs: list[Run]) -> dict[str, list[Rollout]]:
    """Rollouts of the models by name, and of the baselines.

    That is: commands as given; scaled and delayed as the first model knows; wheel odometry if every run has it.
    """
    loaded = {name: load_model(path) for name, path in models.items()}
    calibrated = next(iter(loaded.values())).card.kinematics
    kinds = {
        "commands": Kinematics(scale_vy=float(calibrated.scale_vy > 0.0)),
        "calibrated commands": calibrated,
    }
    found = {name: [roll_kinematics(kinematics, run, STEP_S) for run in runs] for name, kinematics in kinds.items()}
    if all(run.sensors.has_wheels for run in runs):
        found["wheel odometry"] = [roll_sources(run, STEP_S) for run in runs]
    return found | {name: [roll_model(model, run, STEP_S) for run in runs] for name, model in loaded.items()}


def calibration_curve(rollouts: list[Rollout], horizon_s: float, shares: FloatArray) -> FloatArray:
    """Share of the errors inside the ellipsoids that should hold the given shares of them."""
    values = np.concatenate([nis(r.errors(horizon_s), r.end_covs(horizon_s)) for r in rollouts])
    return np.asarray((values[:, None] < chi2.ppf(shares, 3)).mean(axis=0))


def _coverage(values: FloatArray) -> tuple[float, float, float]:
    one, two, three = (float((values < chi2.ppf(2 * norm.cdf(s) - 1, 3)).mean()) for s in (1, 2, 3))
    return one, two, three


def table(rows: list[tuple[str, Figures]]) -> str:
    """Table of each source's and horizon's figures, as text."""
    lines = [
        f"{'source':<20}{'s':>4}{'n':>6}{'drift %':>9}{'ATE m':>8}{'yaw MAE':>9}{'yaw end':>9}{'NIS/3':>7}  1/2/3σ"
    ]
    for name, f in rows:
        tail = (
            ""
            if f.nis_over_3 is None or f.coverage is None
            else (f"{f.nis_over_3:>7.2f}  " + "/".join(f"{c:.3f}" for c in f.coverage))
        )
        lines.append(
            f"{name:<20}{f.horizon_s:>4.0f}{f.windows:>6}{f.drift_percent:>9.2f}{f.ate_m:>8.4f}{f.yaw_mae_deg:>8.2f}°"
            f"{f.yaw_end_deg:>8.2f}°{tail}"
        )
    return "\n".join(lines)


def _runs(card: ModelCard, bags: list[Path]) -> list[Run]:
    data = DataConfig(history_s=card.history_s)
    return [run for bag in bags for run in load_runs(bag, bag.name, card.dt_s, data).values()]


def write_json(path: Path, rows: list[tuple[str, Figures]]) -> None:
    """Write the figures of each source and horizon."""
    write_text(path, json.dumps([{"source": name, **asdict(f)} for name, f in rows], indent=1) + "\n")


def draw(folder: Path, found: dict[str, list[Rollout]], rows: list[tuple[str, Figures]]) -> None:
    """Draw tracks, growth of errors and calibration of the first model."""
    draw_tracks(folder / "tracks.png", found["model"])
    draw_growth(folder / "growth.png", rows)
    curves = {
        figures.horizon_s: calibration_curve(found["model"], figures.horizon_s, _SHARES)
        for name, figures in rows
        if name == "model" and figures.coverage is not None
    }
    draw_calibration(folder / "calibration.png", _SHARES, curves)


def compare(
    model: Path, bags: list[Path], against: list[Path]
) -> tuple[dict[str, list[Rollout]], list[tuple[str, Figures]]]:
    """Free rollouts of a model, of models to compare and of the baselines; and their figures by horizon.

    Raises:
        ModelError: a model cannot be read.
        RecordingError: a recording cannot be used.
    """
    models = {"model": model} | {path.stem: path for path in against}
    found = sources(models, _runs(load_model(model).card, bags))
    return found, [(name, figures) for name, rollouts in found.items() for figures in growth(rollouts)]
