"""The command line. Only this module prints and exits.

Exit codes: 0 done, 1 bad input, 2 usage, 3 finished but LOST for part of the run.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from tqdm import tqdm
from typer.core import TyperGroup

import fgloc
from fgloc.config import Config, load_config
from fgloc.errors import FglocError, RecordingError
from fgloc.types import Mode, RunResult

if TYPE_CHECKING:
    from fgloc.evaluation.metrics import Metrics
    from fgloc.runner import Progress

EXIT_BAD_INPUT = 1
EXIT_LOST = 3

SAMPLE = Path(fgloc.__file__).parent.parent / "datasets" / "samples" / "first_run" / "bag"


class _Commands(TyperGroup):
    """Turns the package's errors into one line on stderr."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except FglocError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(EXIT_BAD_INPUT) from error


app = typer.Typer(
    cls=_Commands,
    help="Where a wheeled robot is, without GPS, with an honest covariance.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


class Speed(StrEnum):
    """How fast a recording is replayed."""

    REAL_TIME = "1"
    MAX = "max"


class Align(StrEnum):
    """How an estimate and a truth in different frames are brought together."""

    NONE = "none"
    SE2 = "se2"


Bag = Annotated[Path, typer.Argument(metavar="BAG", help="ROS 1 .bag, rosbag2 folder, .mcap or .db3")]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="folder for the results; made if missing")]
MapOption = Annotated[
    Path | None, typer.Option("--map", metavar="MAP", help="marker map; default: map.yaml beside the bag, else none")
]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", metavar="M", help="learned motion (.safetensors); default: the configuration's"),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", metavar="C", help="configuration; default: robot.yaml beside the bag, else none"),
]


def main() -> None:
    """Entry point of the ``fgloc`` command."""
    app()


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="folder for the results")] = Path("demo-out"),
) -> None:
    """Smooth the bundled recording and replay it online; say where the reports are."""
    if not SAMPLE.is_dir():
        raise RecordingError(
            f"{SAMPLE}: the bundled recording is not here; it comes with a source checkout: clone the repository and "
            "run `make demo` there"
        )
    runs: list[tuple[str, Metrics]] = []
    lost = False
    for mode, command in (("batch", "smooth"), ("online", "online")):
        folder = out / mode
        text = f"fgloc {command} {SAMPLE.relative_to(SAMPLE.parents[3])} --out {folder}"
        result, metrics = _localise(SAMPLE, None, None, None, folder, "batch" if mode == "batch" else "online", text)
        runs.append((mode, metrics))
        lost = lost or Mode.LOST in result.modes
    typer.echo(f"{runs[0][1].duration_s:.0f} s of {SAMPLE.parent.name}, {runs[0][1].keyframes} keyframes\n")
    typer.echo(_columns(("", "ATE mean", "ATE rmse", "yaw MAE", "NEES/3", "real time"), [_demo_row(*r) for r in runs]))
    typer.echo("")
    for mode, _ in runs:
        typer.echo(f"{mode:<8}{out / mode / 'report.html'}")
    if lost:
        raise typer.Exit(EXIT_LOST)


@app.command()
def info(bag: Bag, config: ConfigOption = None) -> None:
    """Tell what a recording holds: topics, rates, gaps, what would be used, what looks wrong."""
    from fgloc.recording.info import format_info, inspect

    typer.echo(format_info(inspect(bag, _config(bag, config, None))), nl=False)


@app.command()
def smooth(
    bag: Bag,
    out: Out,
    map_file: MapOption = None,
    model: ModelOption = None,
    config: ConfigOption = None,
) -> None:
    """Estimate the trajectory from the whole recording at once."""
    _finish(*_localise(bag, map_file, model, config, out, "batch", _typed()), out)


@app.command()
def online(
    bag: Bag,
    out: Out,
    map_file: MapOption = None,
    model: ModelOption = None,
    config: ConfigOption = None,
    speed: Annotated[Speed, typer.Option(help="1: in real time; max: as fast as possible")] = Speed.MAX,
) -> None:
    """Replay the recording as a live robot would hear it; each pose knows only what came before."""
    pace = 1.0 if speed is Speed.REAL_TIME else None
    _finish(*_localise(bag, map_file, model, config, out, "online", _typed(), pace), out)


@app.command()
def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="EST.tum")],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH.tum")],
    align: Annotated[
        Align, typer.Option(help="se2: the best rigid motion between the two, without scale")
    ] = Align.NONE,
    max_gap: Annotated[float, typer.Option(metavar="S", help="the truth is not interpolated across longer gaps")] = 0.2,
) -> None:
    """Compare two TUM trajectories."""
    from fgloc.evaluation import metrics
    from fgloc.recording.outputs import read_tum

    kind: Literal["none", "se2"] = "se2" if align is Align.SE2 else "none"
    matched = metrics.match(read_tum(estimate), read_tum(truth), kind, max_gap)
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
    typer.echo(_columns(None, rows))


@app.command(name="map")
def make_map(
    bag: Bag,
    out: Annotated[Path, typer.Option("--out", metavar="MAP.yaml", help="map file to be written")],
    model: ModelOption = None,
    config: ConfigOption = None,
) -> None:
    """Survey the landmarks of a recording; the first pose is the map's origin."""
    from fgloc.runner import run
    from fgloc.sensors.maps import write_map

    with _progress(bag.name) as progress:
        result = run(bag, None, _config(bag, config, model), "batch", progress)
    if result.landmarks is None or not len(result.landmarks):
        raise RecordingError(f"{bag}: no landmark was seen often enough to be surveyed; see `fgloc info {bag}`")
    write_map(result.landmarks, out)
    typer.echo(f"{len(result.landmarks)} landmarks in {out}")
    _exit_if_lost(result)


@app.command()
def ablate(
    suite: Annotated[Path, typer.Argument(metavar="SUITE.yaml", help="see ablations/")],
    out: Out,
    workers: Annotated[int | None, typer.Option(min=1, help="processes; default: one per core")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="a running Dask scheduler, instead of local processes")
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="run jobs that gave no result once more")] = False,
) -> None:
    """Tell what the failure of each sensor costs; a killed sweep goes on where it was."""
    from fgloc.ablation.jobs import make_jobs
    from fgloc.ablation.report import failed, write_report
    from fgloc.ablation.suite import expand, load_suite
    from fgloc.ablation.sweep import sweep

    plan = load_suite(suite)
    jobs = make_jobs(expand(plan, suite.parent))
    with tqdm(desc="runs", total=len(jobs), disable=None, file=sys.stderr, leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        records = sweep(jobs, out, workers, scheduler, retry, show)
    for sentence in write_report(plan, jobs, records, out, _typed()):
        typer.echo(sentence)
    without = failed(jobs, records)
    if without:
        typer.echo(f"{len(without)} of {len(jobs)} runs gave no result; the report says why", err=True)
    typer.echo(f"report: {out / 'report.html'}")


def _localise(
    bag: Path,
    map_file: Path | None,
    model: Path | None,
    config_file: Path | None,
    out: Path,
    mode: Literal["batch", "online"],
    command: str,
    pace: float | None = None,
) -> tuple[RunResult, Metrics]:
    """Run one recording and write its results."""
    # Imported here: gtsam, OpenCV and matplotlib take a second to load, which `fgloc --help` need not wait for.
    from fgloc.assembly import resolved
    from fgloc.evaluation.report import write_results
    from fgloc.recording.outputs import sha256_of
    from fgloc.runner import find_beside, run

    map_path = map_file or find_beside(bag, "map.yaml")
    config = resolved(_config(bag, config_file, model), map_path)
    with _progress(mode) as progress:
        result = run(bag, map_path, config, mode, progress, pace)
    return result, write_results(result, config, out, command, sha256_of(bag))


def _config(bag: Path, config_file: Path | None, model: Path | None) -> Config:
    """The given configuration, else the one beside the bag, else the defaults; `model` overrides it."""
    from fgloc.runner import find_beside

    file = config_file or find_beside(bag, "robot.yaml")
    config = Config() if file is None else load_config(file)
    if model is None:
        return config
    return config.model_copy(update={"motion": config.motion.model_copy(update={"model": model, "use": True})})


def _finish(result: RunResult, metrics: Metrics, out: Path) -> None:
    """Say what came out."""
    rows = [("duration", f"{metrics.duration_s:.1f} s"), ("keyframes", str(metrics.keyframes))]
    if metrics.ate_mean_m is not None and metrics.yaw_mae_deg is not None:
        rows += [("ATE mean", f"{metrics.ate_mean_m:.4f} m"), ("yaw MAE", f"{metrics.yaw_mae_deg:.3f} deg")]
    if metrics.nees_over_3 is not None:
        rows.append(("NEES/3", f"{metrics.nees_over_3:.2f}"))
    rows += [("rejected", str(sum(metrics.rejections.values()))), ("report", str(out / "report.html"))]
    typer.echo(_columns(None, rows))
    for note in result.notes:
        typer.echo(f"note: {note}")
    _exit_if_lost(result)


def _exit_if_lost(result: RunResult) -> None:
    lost = sum(mode is Mode.LOST for mode in result.modes)
    if lost:
        typer.echo(f"LOST for {lost} of {len(result.modes)} poses: do not trust them", err=True)
        raise typer.Exit(EXIT_LOST)


@contextmanager
def _progress(label: str) -> Iterator[Progress]:
    """A bar on a terminal, nothing on a pipe."""
    form = "{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s [{elapsed}<{remaining}]"
    with tqdm(desc=label, total=1.0, disable=None, bar_format=form, file=sys.stderr, leave=False) as bar:

        def show(done_s: float, length_s: float) -> None:
            if not bar.disable:
                bar.total = length_s
                bar.update(done_s - bar.n)

        yield show


def _demo_row(mode: str, metrics: Metrics) -> tuple[str, ...]:
    def show(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    return (
        mode,
        show(metrics.ate_mean_m, "{:.4f} m"),
        show(metrics.ate_rmse_m, "{:.4f} m"),
        show(metrics.yaw_mae_deg, "{:.3f} deg"),
        show(metrics.nees_over_3, "{:.2f}"),
        show(metrics.real_time_factor, "{:.1f} x"),
    )


def _columns(head: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> str:
    """A plain table: the first column to the left, the others to the right; without a head all to the left."""
    lines = [head, *rows] if head else list(rows)
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    pad = str.rjust if head else str.ljust
    return "\n".join("  ".join([line[0].ljust(widths[0]), *map(pad, line[1:], widths[1:])]).rstrip() for line in lines)


def _typed() -> str:
    return shlex.join(["fgloc", *sys.argv[1:]])


if __name__ == "__main__":
    main()
