"""Commands that run the localizer on recordings (``demo``, ``smooth``, ``online``, ``ablate``), and on results."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fgloc.cli.options import (
    Bag,
    Bags,
    ConfigOption,
    FigureFormat,
    FiguresOption,
    ForceOption,
    MapOption,
    McapOption,
    ModelOption,
    Out,
    RrdOption,
    SchedulerOption,
    WorkersOption,
    configured,
    figure_formats,
    need,
    spare_inputs,
)
from fgloc.cli.terminal import (
    EXIT_BAD_INPUT,
    EXIT_LOST,
    exit_code,
    exit_unless_trusted,
    kept_on_interrupt,
    number,
    run_bar,
    say,
    say_inputs,
    say_remark,
    say_table,
    typed,
    warn,
)
from fgloc.errors import ConfigError
from fgloc.files.atomic import check_out

if TYPE_CHECKING:
    from fgloc.ablation.jobs import Record
    from fgloc.config import Config
    from fgloc.evaluation.metrics import Metrics
    from fgloc.runner import RunResult


# --- One run: demo, smooth, online ------------------------------------------------------------------------------------

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
    say("\nNEES/3: 1 is expected on average over many runs; errors last for seconds, and one minute scatters widely.\n")
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
    force: ForceOption = False,
) -> None:
    """Estimate the trajectory of a whole recording. Several bags get a folder each in DIR."""
    if len(bags) > 1:
        if rrd is not None or mcap is not None or figures:
            raise ConfigError("--rrd, --mcap, --figures: expected one bag; give each its own command")
        _say_inputs_of_many(map_file, config)
        smooth_many(bags, out, map_file, model, config, workers, scheduler)
        return
    (bag,) = bags
    forms = figure_formats(figures)
    spare_inputs(out, bag, map_file, config, force)
    say_inputs(bag, map_file, config)
    result = _localize(bag, map_file, configured(bag, config, model), out, "batch")
    metrics = _write(result, bag, out, typed(), forms)
    with kept_on_interrupt(f"the result in {out} is whole"):
        _finish(result, metrics, out, rrd, mcap)


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
    force: ForceOption = False,
) -> None:
    """Replay a recording as on a live robot. Each pose depends only on what came before."""
    forms = figure_formats(figures)
    pace = 1.0 if speed is Speed.REAL_TIME else None
    spare_inputs(out, bag, map_file, config, force)
    say_inputs(bag, map_file, config)
    result = _localize(bag, map_file, configured(bag, config, model), out, "online", pace)
    metrics = _write(result, bag, out, typed(), forms)
    with kept_on_interrupt(f"the result in {out} is whole"):
        _finish(result, metrics, out, rrd, mcap)


def _say_inputs_of_many(map_file: Path | None, config_file: Path | None) -> None:
    for given, name in ((map_file, "map"), (config_file, "configuration")):
        say(f"{name}: {given or 'of each recording that which lies beside it, if any'}")


def _localize(
    bag: Path,
    map_file: Path | None,
    config: Config,
    out: Path,
    mode: Literal["batch", "online"],
    pace: float | None = None,
) -> RunResult:
    """Run a recording, once it is certain that the results can be written."""
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
    """Print the figures of a run, and write it for the viewers that were asked for."""
    from fgloc.evaluation.judgements import gravest

    write_for_viewers(result, rrd, mcap)
    rows = [("duration", f"{metrics.duration_s:.1f} s"), ("keyframes", str(metrics.keyframes))]
    if metrics.ate_mean_m is not None:
        rows.append(("ATE mean", f"{metrics.ate_mean_m:.4f} m"))
    if metrics.yaw_mae_deg is not None:
        rows.append(("yaw MAE", f"{metrics.yaw_mae_deg:.3f} deg"))
    if metrics.nees_over_3 is not None:
        rows.append(("NEES/3", f"{metrics.nees_over_3:.2f}"))
    rows += [("rejected", str(sum(metrics.rejections.values()))), ("report", str(out / "report.html"))]
    if metrics.ate_mean_m is not None:
        align = " --align" if result.config is not None and result.config.truth.align != "none" else ""
        rows.append(("evo", f"evo_ape tum {out / 'truth.tum'} {out / 'trajectory.tum'}{align}"))
    rows += [(name, str(path)) for name, path in (("MCAP", mcap), ("rerun", rrd)) if path is not None]
    if mcap is not None:
        rows.append(("Foxglove", f"layout: {foxglove_layout()}"))
    for finding in metrics.findings:
        if finding.severity != "note":
            say_remark(finding.severity, finding.text)
    for judgement in gravest(metrics.judgements, _TOLD):
        say(f"judged: {judgement.when}: {judgement.what} ({judgement.evidence}); {judgement.effect}")
    for finding in metrics.findings:
        if finding.severity == "note":
            say_remark(finding.severity, finding.text)
    say_table(None, rows)
    exit_unless_trusted(result, metrics)


def _demo_row(mode: str, metrics: Metrics) -> tuple[str, ...]:
    return (
        mode,
        number(metrics.ate_mean_m, "{:.4f} m"),
        number(metrics.ate_rmse_m, "{:.4f} m"),
        number(metrics.yaw_mae_deg, "{:.3f} deg"),
        number(metrics.nees_over_3, "{:.2f}"),
        number(metrics.real_time_factor, "{:.1f} x"),
    )


# --- Many runs: smooth of several bags, ablate ------------------------------------------------------------------------


def ablate(
    suite: Annotated[
        Path, typer.Argument(metavar="SUITE.yaml", help="recordings, failures and variants (docs/ablation.md)")
    ],
    out: Out,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    retry: Annotated[bool, typer.Option("--retry", help="run jobs that gave no result once more")] = False,
    figures: FiguresOption = None,
) -> None:
    """Tell what the failure of each sensor costs. The same command goes on with a killed sweep."""
    from fgloc.ablation.jobs import make_jobs, only_sweep
    from fgloc.ablation.report import write_report
    from fgloc.ablation.suite import expand, load_suite
    from fgloc.ablation.sweep import sweep

    need("sweep", "fgloc ablate")
    forms = figure_formats(figures)
    check_out(out)
    plan = load_suite(suite)
    jobs = make_jobs(expand(plan, suite.parent))
    kept = f"finished runs are kept in {out}; the same command goes on with the others"
    with only_sweep(out):
        with kept_on_interrupt(kept), run_bar("runs", "") as show:
            records = sweep(jobs, out, workers, scheduler, retry, show)
        sentences = write_report(plan, jobs, records, out, typed(), forms)
    for sentence in sentences:
        say(sentence)
    if without := sum(records[job.key].outcome != "done" for job in jobs):
        say(f"{without} of {len(jobs)} runs gave no result; the report says why", err=True)
    say(f"report: {out / 'report.html'}")


def smooth_many(
    bags: Sequence[Path],
    out: Path,
    map_file: Path | None,
    model: Path | None,
    config_file: Path | None,
    workers: int | None,
    scheduler: str | None,
) -> None:
    """Smooth each bag into a folder of its own; one that fails is listed and tried again next time."""
    from fgloc.ablation.jobs import only_sweep
    from fgloc.ablation.sweep import plan_bags, sweep

    need("sweep", "fgloc smooth of several bags")
    check_out(out)
    if config_file is not None:
        configured(bags[0], config_file, model)  # a wrong one is wrong for all
    plan = plan_bags(bags, map_file, lambda bag: configured(bag, config_file, model), typed())
    kept = f"finished bags are kept in {out}; the same command goes on with the others"
    with kept_on_interrupt(kept), only_sweep(out), run_bar("bags", "") as show:
        records = sweep(plan.jobs, out, workers, scheduler, retry=True, progress=show)
    by_name = {name: records[job.key] for job in plan.jobs if (name := job.folder) is not None}
    head = ("", "duration", "keyframes", "ATE mean", "yaw MAE", "NEES/3", "LOST")
    say_table(head, [_row(name, by_name.get(name)) for name in plan.names])
    errors = plan.errors | {name: _reason(record) for name, record in by_name.items() if record.outcome != "done"}
    for name in plan.names:
        if name in errors:
            say(f"{name}: {errors[name]}", err=True)
    for name, record in by_name.items():
        for mistake in record.mistakes:
            say(f"{name}: {mistake}", err=True)
    say(f"reports: {out / '*' / 'report.html'}")
    if errors:
        say(f"{len(errors)} of {len(bags)} bags gave no result", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    lost = any(record.modes.get("LOST") for record in by_name.values())
    if lost:
        say("LOST for part of a run: do not trust it there", err=True)
    if lost or any(record.mistakes for record in by_name.values()):
        raise typer.Exit(EXIT_LOST)


def _reason(record: Record) -> str:
    """The message of a refused run; the last line of a crashed one's traceback."""
    return record.error if record.outcome == "refused" else record.error.strip().splitlines()[-1]


def _row(name: str, record: Record | None) -> tuple[str, ...]:
    if record is None or record.outcome != "done":
        return name, *("-" for _ in range(5)), "failed"
    figures = record.figures
    return (
        name,
        f"{figures['duration_s']:.1f} s",
        str(figures["keyframes"]),
        number(figures["ate_mean_m"], "{:.4f} m"),
        number(figures["yaw_mae_deg"], "{:.3f} deg"),
        number(figures["nees_over_3"], "{:.2f}"),
        f"{100.0 * record.modes.get('LOST', 0.0):.1f} %",
    )


# --- Results for other tools: export, --mcap, --rrd -------------------------------------------------------------------

_BASE = "base_link"


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", file_okay=False, help="results of smooth or online")],
    mcap: Annotated[
        Path | None, typer.Option(metavar="FILE", dir_okay=False, help="a bag of standard ROS 2 messages")
    ] = None,
    kitti: Annotated[
        Path | None, typer.Option(metavar="FILE", dir_okay=False, help="poses as KITTI has them, without stamps")
    ] = None,
) -> None:
    """Write a finished run for other tools. TUM, CSV and JSON are in its folder already."""
    if mcap is None and kitti is None:
        raise ConfigError("nothing to write: give --mcap FILE or --kitti FILE, or both")
    from fgloc.evaluation.results import read_results
    from fgloc.files.outputs import write_kitti
    from fgloc.recording.mcap_export import write_mcap

    results = read_results(folder)
    if mcap is not None:
        write_mcap(results, mcap, _base_frame(results.provenance.get("config")))
        say(f"MCAP: {mcap}")
        say(f"Foxglove layout: {foxglove_layout()}")
    if kitti is not None:
        write_kitti(kitti, results.trajectory)
        say(f"KITTI: {kitti}")


def foxglove_layout() -> Path:
    """The layout that shows what ``--mcap`` writes; it comes with the package."""
    import fgloc.view

    return Path(fgloc.view.__file__).parent / "foxglove.json"


def write_for_viewers(result: RunResult, rrd: Path | None, mcap: Path | None) -> None:
    """Write what ``--rrd`` and ``--mcap`` ask for. A truth in another frame than the map's is left out."""
    if rrd is not None:
        from fgloc.view.scene import write_rrd

        write_rrd(result, rrd)
    if mcap is not None:
        from fgloc.recording.mcap_export import write_mcap

        elsewhere = result.config is not None and result.config.truth.align != "none"
        base = None if result.config is None else result.config.recording.base_frame
        write_mcap(replace(result, truth=None) if elsewhere else result, mcap, base or _BASE)


def _base_frame(config: Any) -> str:
    """Name of the base frame in a configuration as ``config.json`` has it; the default if it names none."""
    recording = config.get("recording") if isinstance(config, dict) else None
    base = recording.get("base_frame") if isinstance(recording, dict) else None
    return base if isinstance(base, str) else _BASE


# --- evaluate ---------------------------------------------------------------------------------------------------------


class Align(StrEnum):
    """How an estimate and a truth in different frames are brought together."""

    NONE = "none"
    SE2 = "se2"


def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="EST.tum", help="trajectory to be compared")],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH.tum", help="reference trajectory")],
    align: Annotated[
        Align, typer.Option(help="se2: the best rigid motion between the two, without scale")
    ] = Align.NONE,
    max_gap: Annotated[float, typer.Option(metavar="S", help="the truth is not interpolated across longer gaps")] = 0.2,
) -> None:
    """Compare two TUM trajectories. The truth is interpolated at the estimate's stamps; evo takes its nearest pose."""
    from fgloc.evaluation import metrics
    from fgloc.evaluation.metrics import match
    from fgloc.files.outputs import read_tum
    from fgloc.recording.truth import lacks_yaw

    kind: Literal["none", "se2"] = "se2" if align is Align.SE2 else "none"
    true = read_tum(truth)
    true = replace(true, has_yaw=not lacks_yaw(true.poses))
    estimated = read_tum(estimate)
    matched = match(estimated, true, kind, max_gap)
    drift, relative, yaw = metrics.drift_percent(matched), metrics.relative_error(matched, 1.0), matched.has_yaw
    rows = [
        ("poses matched", f"{len(matched.stamps_ns)} of {len(estimated)}"),
        ("ATE mean", f"{metrics.ate_mean_m(matched):.6f} m"),
        ("ATE rmse", f"{metrics.ate_rmse_m(matched):.6f} m"),
        ("yaw MAE", f"{metrics.yaw_mae_deg(matched):.6f} deg" if yaw else "-"),
        ("end error", f"{metrics.end_error_m(matched):.6f} m"),
        ("drift", "-" if drift is None else f"{drift:.4f} %"),
        ("RPE per metre, position", "-" if relative is None else f"{relative.translation_m:.6f} m"),
        ("RPE per metre, yaw", "-" if relative is None or not yaw else f"{relative.rotation_deg:.6f} deg"),
    ]
    size = metrics.size_of(matched)
    if size is not None:
        rows.append(("scale, Sim(3)", f"{size.scale:.6f}"))
    say_table(None, rows)
    if size is not None and size.told:
        say_remark("warning", size.finding.text)
    if remark := metrics.frame_remark(matched):
        warn(remark)


def compare(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR", file_okay=False, help="results of smooth or online, two or more")
    ],
    figure: Annotated[
        Path | None,
        typer.Option(metavar="FILE", dir_okay=False, help="draw ways and distances; by its ending png, svg or pdf"),
    ] = None,
) -> None:
    """Compare finished runs of one recording. All distances are from the first one's poses."""
    from fgloc.evaluation.compare import HEAD, plot_comparison, remarks
    from fgloc.evaluation.compare import compare as held
    from fgloc.evaluation.style import FORMATS, image_of
    from fgloc.files.outputs import write_bytes

    if len(folders) < 2:
        raise typer.BadParameter(f"got {len(folders)} folder, expected two or more", param_hint="DIR")
    form = next((f for f in FORMATS if figure is not None and figure.suffix == f".{f}"), None)
    if figure is not None and form is None:
        raise typer.BadParameter(f"{figure.name!r} does not end in .png, .svg or .pdf", param_hint="--figure")
    runs = held(folders)
    say_table(HEAD, [run.row() for run in runs])
    for sentence in remarks(runs):
        warn(sentence)
    if figure is not None and form is not None:
        check_out(figure, folder=False)
        write_bytes(figure, image_of(plot_comparison(runs), form))
        say(f"figure: {figure}")
