"""Commands of one robot: ``demo``, ``smooth``, ``online`` and ``calibrate``."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fgloc.cli.exports import write_for_viewers
from fgloc.cli.options import (
    Bag,
    Bags,
    ConfigOption,
    FigureFormat,
    FiguresOption,
    MapOption,
    McapOption,
    ModelOption,
    Out,
    RrdOption,
    SchedulerOption,
    WorkersOption,
    configured,
    figure_formats,
)
from fgloc.cli.progress import run_bar
from fgloc.cli.sweeps import smooth_many
from fgloc.cli.terminal import (
    exit_code,
    exit_unless_trusted,
    next_step,
    number,
    say,
    say_remark,
    say_table,
    shown_path,
    typed,
)
from fgloc.errors import ConfigError
from fgloc.files.atomic import check_out

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.evaluation.metrics import Metrics
    from fgloc.types import RunResult

_TOLD = 3  # judgements in the short form


class Speed(StrEnum):
    """How fast a recording is replayed."""

    REAL_TIME = "1"
    MAX = "max"


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", file_okay=False, help="folder for the results")] = Path(
        "demo-out"
    ),
) -> None:
    """Run the bundled recording, batch and online. Says where the reports are."""
    from fgloc_datasets import SAMPLE

    runs: list[tuple[str, Metrics]] = []
    code = 0
    for mode, command in (("batch", "smooth"), ("online", "online")):
        folder = out / mode
        text = shlex.join(["fgloc", command, str(SAMPLE), "--out", str(folder)])
        result = _localize(
            SAMPLE, None, configured(SAMPLE, None, None), folder, "batch" if mode == "batch" else "online"
        )
        runs.append((mode, _write(result, SAMPLE, folder, text)))
        code = code or exit_code(result)
    say(f"{runs[0][1].duration_s:.0f} s of {SAMPLE.parent.name}, {runs[0][1].keyframes} keyframes\n")
    say_table(("", "ATE mean", "ATE rmse", "yaw MAE", "NEES/3", "real time"), [_demo_row(*r) for r in runs])
    say("")
    for mode, _ in runs:
        say(f"{mode:<8}{out / mode / 'report.html'}")
    if code:
        raise typer.Exit(code)


def smooth(
    bags: Bags,
    out: Out,
    map_file: MapOption = None,
    model: ModelOption = None,
    config: ConfigOption = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    rrd: RrdOption = None,
    mcap: McapOption = None,
    figures: FiguresOption = None,
) -> None:
    """Estimate the trajectory of a whole recording. Several bags get a folder each in DIR."""
    if len(bags) > 1:
        if rrd is not None or mcap is not None or figures:
            raise ConfigError("--rrd, --mcap, --figures: expected one bag; give each its own command")
        smooth_many(bags, out, map_file, model, config, workers, scheduler)
        return
    (bag,) = bags
    forms = figure_formats(figures)
    result = _localize(bag, map_file, configured(bag, config, model), out, "batch")
    _finish(result, _write(result, bag, out, typed(), forms), out, rrd, mcap)


def online(
    bag: Bag,
    out: Out,
    map_file: MapOption = None,
    model: ModelOption = None,
    config: ConfigOption = None,
    speed: Annotated[Speed, typer.Option(help="1: in real time; max: as fast as possible")] = Speed.MAX,
    rrd: RrdOption = None,
    mcap: McapOption = None,
    figures: FiguresOption = None,
) -> None:
    """Replay a recording as on a live robot. Each pose depends only on what came before."""
    forms = figure_formats(figures)
    pace = 1.0 if speed is Speed.REAL_TIME else None
    result = _localize(bag, map_file, configured(bag, config, model), out, "online", pace)
    _finish(result, _write(result, bag, out, typed(), forms), out, rrd, mcap)


def calibrate(
    bags: Bags,
    out: Annotated[
        Path, typer.Option("--out", metavar="ROBOT.yaml", dir_okay=False, help="configuration file to be written")
    ],
    map_file: MapOption = None,
    config: ConfigOption = None,
) -> None:
    """Calibrate wheels, camera and clocks. From recordings on a known map, or in which landmarks are seen again."""
    from fgloc.calibration.installation import found_text, given_text, setting_unit
    from fgloc.calibration.multi_run import calibrate as calibrated
    from fgloc.config import yaml_of
    from fgloc.files.outputs import write_text

    check_out(out, folder=False)
    before = configured(bags[0], config, None)
    with run_bar("calibrate") as progress:
        after, settings = calibrated(bags, map_file, before, progress)
    write_text(out, f"# {typed()}\n{yaml_of(after, out.parent)}")
    rows = [(s.name, setting_unit(s.name), given_text(s), found_text(s)) for s in settings]
    say_table(("setting", "unit", "given", "found"), rows)
    say(f"configuration: {out}")
    paths = " ".join(shown_path(bag) for bag in bags)
    next_step(f"fgloc train --init {paths} --out train.yaml", "learn how this robot moves; or smooth with it:")
    next_step(f"fgloc smooth {shown_path(bags[-1])} --config {shown_path(out)} --out result", "the best estimate")


def _localize(
    bag: Path,
    map_file: Path | None,
    config: Config,
    out: Path,
    mode: Literal["batch", "online"],
    pace: float | None = None,
) -> RunResult:
    """Run a recording, once it is certain that the results can be written."""
    # Imported here: gtsam, OpenCV and matplotlib take a second to load, which `fgloc --help` need not wait for.
    from fgloc.recording.storage import find_beside
    from fgloc.runner import run

    check_out(out)
    map_path = map_file or find_beside(bag, "map.yaml")
    with run_bar(mode) as progress:
        return run(bag, map_path, config, mode, progress, pace=pace)


def _write(result: RunResult, bag: Path, out: Path, command: str, figures: Sequence[FigureFormat] = ()) -> Metrics:
    """Write the results of a run."""
    from fgloc.config import Config
    from fgloc.evaluation.report import write_results
    from fgloc.files.outputs import sha256_of

    return write_results(result, result.config or Config(), out, command, sha256_of(bag), figures)


def _finish(result: RunResult, metrics: Metrics, out: Path, rrd: Path | None, mcap: Path | None) -> None:
    """Say what came out, and write it for the viewers that were asked for."""
    from fgloc.evaluation.judgements import gravest

    write_for_viewers(result, rrd, mcap)
    rows = [("duration", f"{metrics.duration_s:.1f} s"), ("keyframes", str(metrics.keyframes))]
    if metrics.ate_mean_m is not None and metrics.yaw_mae_deg is not None:
        rows += [("ATE mean", f"{metrics.ate_mean_m:.4f} m"), ("yaw MAE", f"{metrics.yaw_mae_deg:.3f} deg")]
    if metrics.nees_over_3 is not None:
        rows.append(("NEES/3", f"{metrics.nees_over_3:.2f}"))
    rows += [("rejected", str(sum(metrics.rejections.values()))), ("report", str(out / "report.html"))]
    rows += [(name, str(path)) for name, path in (("MCAP", mcap), ("rerun", rrd)) if path is not None]
    for finding in metrics.findings:
        if finding.severity != "note":
            say_remark(finding.severity, finding.text)
    for judgement in gravest(metrics.judgements, _TOLD):
        say(f"judged: {judgement.when}: {judgement.what} ({judgement.evidence}); {judgement.effect}")
    for finding in metrics.findings:
        if finding.severity == "note":
            say_remark(finding.severity, finding.text)
    say_table(None, rows)
    exit_unless_trusted(result)


def _demo_row(mode: str, metrics: Metrics) -> tuple[str, ...]:
    return (
        mode,
        number(metrics.ate_mean_m, "{:.4f} m"),
        number(metrics.ate_rmse_m, "{:.4f} m"),
        number(metrics.yaw_mae_deg, "{:.3f} deg"),
        number(metrics.nees_over_3, "{:.2f}"),
        number(metrics.real_time_factor, "{:.1f} x"),
    )
