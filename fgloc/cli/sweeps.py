"""Commands of many runs: ``ablate``, and ``smooth`` of several bags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgloc.cli.extras import need
from fgloc.cli.options import Out, SchedulerOption, WorkersOption, configured
from fgloc.cli.progress import jobs_bar
from fgloc.cli.terminal import EXIT_BAD_INPUT, EXIT_LOST, kept_on_interrupt, number, say, say_table, typed
from fgloc.files.atomic import check_out

if TYPE_CHECKING:
    from fgloc.ablation.jobs import Record


def ablate(
    suite: Annotated[
        Path, typer.Argument(metavar="SUITE.yaml", help="recordings, failures and variants (docs/ablation.md)")
    ],
    out: Out,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    retry: Annotated[bool, typer.Option("--retry", help="run jobs that gave no result once more")] = False,
) -> None:
    """Tell what the failure of each sensor costs. The same command goes on with a killed sweep."""
    from fgloc.ablation.jobs import make_jobs, only_sweep
    from fgloc.ablation.report import failed, write_report
    from fgloc.ablation.suite import expand, load_suite
    from fgloc.ablation.sweep import sweep

    need("sweep", "fgloc ablate")
    check_out(out)
    plan = load_suite(suite)
    jobs = make_jobs(expand(plan, suite.parent))
    kept = f"finished runs are kept in {out}; the same command goes on with the others"
    with only_sweep(out):
        with kept_on_interrupt(kept), jobs_bar("runs") as show:
            records = sweep(jobs, out, workers, scheduler, retry, show)
        sentences = write_report(plan, jobs, records, out, typed())
    for sentence in sentences:
        say(sentence)
    without = failed(jobs, records)
    if without:
        say(f"{len(without)} of {len(jobs)} runs gave no result; the report says why", err=True)
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
    with kept_on_interrupt(kept), only_sweep(out), jobs_bar("bags") as show:
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
