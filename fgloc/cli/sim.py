"""``fgloc sim``: record simulated runs, and draw them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fgloc.cli.extras import need
from fgloc.cli.terminal import group, kept_on_interrupt, next_step, say, shown_path
from fgloc.files.atomic import check_out

app = group("Simulate robots, with known truth. The physics is MuJoCo's.")

ScenarioArgument = Annotated[
    str, typer.Argument(metavar="SCENARIO", help="of the bundled suite by name, or a YAML file")
]
Corners = Annotated[
    bool, typer.Option("--corners", help="the camera sends corners of markers, not images: no OpenGL, faster")
]


@app.callback()
def needed() -> None:
    """Simulate robots, with known truth. The physics is MuJoCo's."""
    need("sim", "fgloc sim")


@app.command()
def record(
    what: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO|SUITE",
            help="a scenario of the bundled suite by name, 'suite' for all of it, or a YAML file with either",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder of bag/, map.yaml and so on; a suite: one for each")],
    seed: Annotated[int, typer.Option(min=0, help="of a scenario; a suite brings its own")] = 1,
    camera: Annotated[bool, typer.Option(help="render images")] = True,
    perfect: Annotated[
        bool, typer.Option("--perfect", help="all is as written, whatever the scenario installs")
    ] = False,
    workers: Annotated[int, typer.Option("--workers", min=1, help="processes, for a suite")] = 1,
    longest: Annotated[float | None, typer.Option(metavar="S", min=0.5, help="cut runs to this length [s]")] = None,
) -> None:
    """Record a scenario, or a suite of them. Of a suite only what is missing is recorded."""
    from fgloc_datasets.sim.record import record as record_run
    from fgloc_datasets.sim.suite import BUNDLED, find_scenario, jobs, load_suite, record_suite

    check_out(out)
    from_file = Path(what).suffix in (".yaml", ".yml")
    suite = load_suite(Path(what) if from_file else BUNDLED)
    suite = suite.perfect() if perfect else suite
    todo = jobs(suite, longest)
    if (from_file and todo) or what == "suite":
        with kept_on_interrupt(f"the recordings that are finished stay in {out}; the same command records the others"):
            count = record_suite(todo, out, camera, workers)
        say(f"{count} recorded, {len(todo) - count} were there: {out}")
        return
    scenario = find_scenario(what)
    scenario = scenario.model_copy(update={"installation": None}) if perfect else scenario
    if longest is not None:
        scenario = scenario.model_copy(update={"duration_s": min(longest, scenario.duration_s)})
    bag = record_run(scenario, seed, out, camera)
    say(f"recorded: {bag}")
    next_step(f"fgloc smooth {shown_path(bag)} --out {shown_path(out / 'result')}", "localize with it")


@app.command(name="follow")
def follow_path(
    scenario: ScenarioArgument,
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder of bag/, map.yaml, following.csv, following.png")],
    path: Annotated[
        str, typer.Option(help="a bundled path by name (grid30, grid20, eight, slalom, tour, ramp), or a file")
    ],
    pose: Annotated[
        str,
        typer.Option(
            help="what guides the robot: fgloc, fgloc-no-model, fgloc-no-model-no-gyro, fgloc-constant, wheels, "
            "learned or truth"
        ),
    ] = "fgloc",
    seed: Annotated[int, typer.Option(min=0)] = 1,
    failure: Annotated[
        list[str] | None,
        typer.Option(
            help="of a sensor, as in a suite of ablations: '{kind: dropout, sensor: camera}'; may be repeated"
        ),
    ] = None,
    corners: Corners = False,
) -> None:
    """Let the robot drive itself along waypoints. Its guide is a pose that is estimated while it drives."""
    from fgloc_datasets.sim.following.failing import read_failures
    from fgloc_datasets.sim.following.figures import draw_drives, table
    from fgloc_datasets.sim.following.loop import Drive, follow, seen_by
    from fgloc_datasets.sim.following.path import load_path
    from fgloc_datasets.sim.following.poses import POSES
    from fgloc_datasets.sim.suite import find_scenario

    check_out(out)
    known = {name: name for name in POSES}
    if pose not in known:
        raise typer.BadParameter(f"{pose!r} is not one of {', '.join(POSES)}", param_hint="--pose")
    drive = Drive(
        find_scenario(scenario), load_path(path), known[pose], seed, read_failures(failure or []),
        seen_by(corners),
    )  # fmt: skip
    done = {drive.path.name: (drive, follow(drive, out))}
    draw_drives(done, out / "following.png", close=False)
    say(table(done))


@app.command()
def follow_demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder of following.png and following.txt")],
    workers: Annotated[int, typer.Option("--workers", min=1, help="processes")] = 2,
    corners: Corners = False,
) -> None:
    """Six drives, with a picture and a table. Flat, on ice, with sensors that fail."""
    from fgloc_datasets.sim.following.demo import PICTURE, demonstrate
    from fgloc_datasets.sim.following.loop import seen_by

    check_out(out)
    say(demonstrate(out, workers, seen_by(corners)))
    say(f"\n{out / PICTURE}")


@app.command()
def figures(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="folder of a recorded run")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder for the pictures")],
) -> None:
    """Draw a recorded run. Trajectory, controls, slip and, if it has images, a contact sheet with detections."""
    from fgloc_datasets.sim.figures import draw

    check_out(out)
    for path in draw(run, out):
        say(str(path))
