"""Commands that estimate nothing: ``info`` and ``evaluate``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

from fgloc.cli.options import Bag, ConfigOption, MapOption, configured
from fgloc.cli.terminal import say, say_table


class Align(StrEnum):
    """How an estimate and a truth in different frames are brought together."""

    NONE = "none"
    SE2 = "se2"


def info(bag: Bag, map_file: MapOption = None, config: ConfigOption = None) -> None:
    """Tell what a recording holds. Topics, rates, gaps, what a run would use, what looks wrong (also with the map)."""
    from fgloc.diagnosis.mistakes import inspect_all
    from fgloc.errors import MapError
    from fgloc.recording.info import format_info
    from fgloc.recording.storage import find_beside

    if map_file is not None and not map_file.exists():
        raise MapError(f"{map_file}: there is no such file; give the map, or leave --map out")
    map_path = map_file or find_beside(bag, "map.yaml")
    found = inspect_all(bag, map_path, configured(bag, config, None))
    say(format_info(found), nl=False)
    if found.exit_code:
        raise typer.Exit(found.exit_code)


def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="EST.tum", help="trajectory to be compared")],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH.tum", help="reference trajectory")],
    align: Annotated[
        Align, typer.Option(help="se2: the best rigid motion between the two, without scale")
    ] = Align.NONE,
    max_gap: Annotated[float, typer.Option(metavar="S", help="the truth is not interpolated across longer gaps")] = 0.2,
) -> None:
    """Compare two TUM trajectories."""
    from fgloc.evaluation import metrics
    from fgloc.evaluation.metrics import match
    from fgloc.files.outputs import read_tum

    kind: Literal["none", "se2"] = "se2" if align is Align.SE2 else "none"
    matched = match(read_tum(estimate), read_tum(truth), kind, max_gap)
    drift, relative = metrics.drift_percent(matched), metrics.relative_error(matched, 1.0, "m")
    rows = [
        ("poses matched", f"{len(matched.stamps_ns)}"),
        ("ATE mean", f"{metrics.ate_mean_m(matched):.6f} m"),
        ("ATE rmse", f"{metrics.ate_rmse_m(matched):.6f} m"),
        ("yaw MAE", f"{metrics.yaw_mae_deg(matched):.6f} deg"),
        ("end error", f"{metrics.end_error_m(matched):.6f} m"),
        ("drift", "-" if drift is None else f"{drift:.4f} %"),
        ("RPE per metre, position", "-" if relative is None else f"{relative.translation_m:.6f} m"),
        ("RPE per metre, yaw", "-" if relative is None else f"{relative.rotation_deg:.6f} deg"),
    ]
    say_table(None, rows)
