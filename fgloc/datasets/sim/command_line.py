"""``python -m datasets.sim``: record simulated runs and draw them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

try:
    import mujoco  # noqa: F401
except ModuleNotFoundError as error:
    raise SystemExit("error: MuJoCo is not installed; pip install 'fgloc[sim]'") from error

from fgloc.datasets.sim.following.failing import read_failures
from fgloc.datasets.sim.following.loop import Drive, follow
from fgloc.datasets.sim.following.path import load_path
from fgloc.datasets.sim.following.poses import POSES, PoseName
from fgloc.datasets.sim.record import record as record_run
from fgloc.datasets.sim.scenario import Scenario
from fgloc.datasets.sim.suite import BUNDLED, jobs, load_suite, record_suite
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
    scenario = find_scenario(what)
    scenario = scenario.model_copy(update={"installation": None}) if perfect else scenario
    if longest is not None:
        scenario = scenario.model_copy(update={"duration_s": min(longest, scenario.duration_s)})
    typer.echo(record_run(scenario, seed, out, camera, progress=True))


def find_scenario(what: str) -> Scenario:
    """A scenario of the bundled suite by name, or of a YAML file."""
    if Path(what).suffix in (".yaml", ".yml"):
        return load_suite(Path(what)).entries[0].scenario
    return load_suite(BUNDLED).find(what)


@app.command(name="follow")
def follow_path(
    scenario: Annotated[str, typer.Argument(help="a scenario of the bundled suite by name, or a YAML file")],
    out: Annotated[Path, typer.Option(help="folder of bag/, map.yaml, following.csv, following.png and so on")],
    path: Annotated[str, typer.Option(help="a bundled path by name (grid30, grid20, eight, slalom, tour), or a file")],
    pose: Annotated[str, typer.Option(help=f"what guides the robot: {', '.join(POSES)}")] = "fgloc",
    seed: Annotated[int, typer.Option(min=0)] = 1,
    failure: Annotated[
        list[str] | None,
        typer.Option(
            help="of a sensor, as in a suite of ablations: '{kind: dropout, sensor: camera}'; may be repeated"
        ),
    ] = None,
    corners: Annotated[
        bool, typer.Option("--corners", help="the camera sends corners of markers, not images: no OpenGL, faster")
    ] = False,
) -> None:
    """Let the robot drive itself along waypoints, guided by a pose that is estimated while it drives."""
    from fgloc.datasets.sim.following.figures import draw_drives, table

    check_out(out)
    if pose not in POSES:
        raise FglocError(f"pose '{pose}' is not known; expected one of {', '.join(POSES)}")
    name: PoseName = pose  # type: ignore[assignment]
    drive = Drive(
        find_scenario(scenario), load_path(path), name, seed, read_failures(failure or []),
        "corners" if corners else "images",
    )  # fmt: skip
    done = {drive.path.name: (drive, follow(drive, out))}
    draw_drives(done, out / "following.png", close=False)
    typer.echo(table(done))


@app.command()
def follow_demo(
    out: Annotated[Path, typer.Option(help="folder of following.png and following.txt")],
    jobs_: Annotated[int, typer.Option("--jobs", min=1, help="processes")] = 2,
    corners: Annotated[bool, typer.Option("--corners", help="no images: no OpenGL, faster")] = False,
) -> None:
    """Six drives: flat, on ice, with sensors that fail; a picture and a table."""
    from fgloc.datasets.sim.following.demo import PICTURE, demonstrate

    check_out(out)
    typer.echo(demonstrate(out, jobs_, "corners" if corners else "images"))
    typer.echo(f"\n{out / PICTURE}")


@app.command()
def figures(
    run: Annotated[Path, typer.Argument(help="folder of a recorded run")],
    out: Annotated[Path, typer.Option(help="folder for the pictures")],
) -> None:
    """Draw a run: trajectory, controls, slip and, if it has images, a contact sheet with detections."""
    from fgloc.datasets.sim.figures import draw

    for path in draw(run, out):
        typer.echo(path)


def run() -> None:
    """Run the command line: an error made on purpose ends it with one line and exit code 1."""
    try:
        app()
    except (FglocError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise SystemExit(1) from error
