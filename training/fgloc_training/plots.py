"""Pictures of a training and of what it made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fgloc_training.checkpoint import Curve

_SMOOTH = 25  # batches in the running mean of a loss
_DPI = 110


def draw_losses(path: Path, curves: dict[str, Curve]) -> None:
    """Losses of the batches and scores on the validation recordings, a panel for each stage."""
    figure = Figure(figsize=(5.5 * len(curves), 3.6), layout="constrained")
    for axes, (name, curve) in zip(np.atleast_1d(figure.subplots(1, len(curves))), curves.items(), strict=True):
        losses = np.array(curve.losses)
        axes.plot(np.arange(1, len(losses) + 1), losses, color="0.8", linewidth=0.6, label="batch")
        if len(losses) > _SMOOTH:
            mean = np.convolve(losses, np.full(_SMOOTH, 1.0 / _SMOOTH), "valid")
            axes.plot(np.arange(_SMOOTH, len(losses) + 1), mean, color="C0", label=f"mean of {_SMOOTH} batches")
        axes.set_title(name, pad=20)
        axes.set(xlabel="iteration", ylabel="training loss")
        low, high = np.percentile(losses, [0.5, 99.5]) if len(losses) else (0.0, 1.0)
        axes.set_ylim(low - 0.05 * (high - low) - 1e-9, high + 0.05 * (high - low) + 1e-9)
        lines = list(axes.get_lines())
        if curve.scores:
            other = axes.twinx()
            at, scores = np.array(curve.scores).T
            lines += other.plot(at, scores, "o-", color="C1", markersize=3, label="validation")
            best = int(np.argmin(scores))
            lines += other.plot(at[best], scores[best], "o", color="C3", label="kept")
            other.set_ylabel("drift [%]" if name.startswith("mean") else "negative log-likelihood")
        axes.legend(
            handles=lines, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(lines), frameon=False
        )
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=_DPI)
