"""``python -m datasets.sim``: record simulated runs and draw them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

try:
    import mujoco  # noqa: F401
except ModuleNotFoundError as error:
    raise SystemExit("error: MuJoCo is not installed; in the repository: pip install -e '.[sim]'") from error

from datasets.sim.record import record as record_run
from datasets.sim.suite import BUNDLED, jobs, load_suite, record_suite
from fgloc.errors import FglocError
from fgloc.files.atomic import check_out

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def main() -> None:
    """Record wheeled robots in a physical simulator (MuJoCo), with known truth."""


@app.command()
def record(
    what: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO|SUITE",
            help="a scenario of the bundled suite by name, 'suite' for all of it, or a YAML file with either",
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder of bag/, map.yaml and so on; a suite: one for each")],
    seed: Annotated[int, typer.Option(min=0, help="of a scenario; a suite brings its own")] = 1,
    camera: Annotated[bool, typer.Option(help="render images")] = True,
    perfect: Annotated[
        bool, typer.Option("--perfect", help="all is as written, whatever the scenario installs")
    ] = False,
    jobs_: Annotated[int, typer.Option("--jobs", min=1, help="processes, for a suite")] = 1,
    longest: Annotated[float | None, typer.Option(min=0.5, help="cut runs to this length [s]")] = None,
) -> None:
    """Record one run of a scenario, or all that is missing of a suite."""
    check_out(out)
    from_file = Path(what).suffix in (".yaml", ".yml")
    suite = load_suite(Path(what) if from_file else BUNDLED)
    suite = suite.perfect() if perfect else suite
    todo = jobs(suite, longest)
    if (from_file and todo) or what == "suite":
        count = record_suite(todo, out, camera, jobs_)
        typer.echo(f"{count} recorded, {len(todo) - count} were there: {out}")
        return
    scenario = suite.entries[0].scenario if from_file else suite.find(what)
    if longest is not None:
        scenario = scenario.model_copy(update={"duration_s": min(longest, scenario.duration_s)})
    typer.echo(record_run(scenario, seed, out, camera, progress=True))


@app.command()
def figures(
    run: Annotated[Path, typer.Argument(help="folder of a recorded run")],
    out: Annotated[Path, typer.Option(help="folder for the pictures")],
) -> None:
    """Draw a run: trajectory, controls, slip and, if it has images, a contact sheet with detections."""
    from datasets.sim.figures import draw

    for path in draw(run, out):
        typer.echo(path)


if __name__ == "__main__":
    try:
        app()
    except (FglocError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise SystemExit(1) from error
