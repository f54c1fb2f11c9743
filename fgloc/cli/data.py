"""Commands of data sets, simulator and training: ``convert``, ``sim``, ``train`` and ``evaluate-model``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fgloc.cli.options import BAG_HELP, configured, need, warn_of_several_robots
from fgloc.cli.terminal import examples, group, kept_on_interrupt, next_step, say, shown_path, warn
from fgloc.errors import ConfigError
from fgloc.files.atomic import check_out

# --- convert: public sets as bags -------------------------------------------------------------------------------------

convert_app = group(
    "Convert public data sets that are no bags. Each gets a robot.yaml and, where landmarks were surveyed, a map.yaml."
)

Storage = Annotated[str, typer.Option("--storage", help="mcap or sqlite3")]
Download = Annotated[
    Path | None, typer.Option("--download", metavar="FOLDER", help="fetch the set into this folder first")
]
Url = Annotated[str | None, typer.Option("--url", metavar="ADDRESS", help="where --download finds it")]


@convert_app.command(
    **examples(
        "fgloc convert mrclam MRCLAM_Dataset6 --out mrclam6",
        "fgloc convert mrclam --download sets --dataset 6 --robot 1 --out robot1",
    )
)
def mrclam(
    source: Annotated[Path | None, typer.Argument(metavar="SRC", help="folder of the unpacked set")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder for bag/, map.yaml and robot.yaml")] = Path("mrclam"),
    robot: Annotated[int | None, typer.Option(min=1, max=5, help="all five into DIR/robotN if omitted")] = None,
    storage: Storage = "mcap",
    download: Download = None,
    dataset: Annotated[int, typer.Option(min=1, max=9, help="which one to download")] = 6,
    fit: Annotated[bool, typer.Option("--fit", help="refit the leave-one-out constants and print them")] = False,
) -> None:
    """UTIAS MRCLAM: iRobot Creates and landmarks. Five robots that see each other; truth by Vicon."""
    from fgloc_datasets import mrclam as data
    from fgloc_datasets.mrclam import Calibration

    check_out(out)
    if download is not None:
        source = data.download(download, dataset)
    if source is None:
        raise typer.BadParameter("give the folder of the unpacked set, or --download FOLDER", param_hint="SRC")
    if fit:
        from fgloc_datasets.mrclam import left_out

        fitted = left_out({k: data.read(source, k) for k in data.ROBOTS})
        for name in Calibration.__dataclass_fields__:
            say(f'    "{name}": ({", ".join(f"{getattr(fitted[k], name):g}" for k in data.ROBOTS)}),')
        return
    for k in data.ROBOTS if robot is None else (robot,):
        run = data.read(source, k)
        folder = out / f"robot{k}" if robot is None else out
        data.write(run, k, folder, storage)
        say(
            f"{folder / 'bag'}: {len(run.commands_ns)} commands, {len(run.sightings_ns)} sightings of landmarks, "
            f"{len(run.truth_ns)} true poses; left out: {run.robots_left_out} sightings of robots, "
            f"{run.unknown_left_out} of no known barcode"
        )
    _say_next(folder)


@convert_app.command(**examples("fgloc convert drive husky.csv --windows 0-9 --out husky"))
def drive(
    source: Annotated[Path | None, typer.Argument(metavar="CSV", help="file of the windows")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder for bag/, robot.yaml, windows.csv")] = Path("drive"),
    windows: Annotated[str | None, typer.Option(help="windows wanted, as 0-399")] = None,
    calibration: Annotated[str | None, typer.Option(help="calibration steps wanted, as 0-133")] = None,
    storage: Storage = "mcap",
    download: Download = None,
    url: Url = None,
) -> None:
    """DRIVE: a skid-steered Husky. Windows of 2 s; truth by ICP."""
    from fgloc_datasets.convert import Remote, fetch
    from fgloc_datasets.drive import convert as converted
    from fgloc_datasets.drive import span

    check_out(out)
    if download is not None:
        if url is None:
            told = "the owner publishes a pickle, which is not opened; give a CSV's address with --url"
            raise typer.BadParameter(told, param_hint="--download")
        source = fetch(Remote(url), download)
    if source is None:
        raise typer.BadParameter("give the file, or --download FOLDER --url ADDRESS", param_hint="CSV")
    converted(source, out, storage, span(windows, "--windows"), span(calibration, "--calibration"))
    say(f"written to {out}: bag, robot.yaml, windows.csv")
    _say_next(out)


def _say_next(folder: Path) -> None:
    next_step(f"fgloc smooth {shown_path(folder / 'bag')} --out {shown_path(folder / 'result')}", "localize with it")


# --- sim: simulated runs, recorded and drawn --------------------------------------------------------------------------

sim_app = group("Simulate robots, with known truth. The physics is MuJoCo's.")

ScenarioArgument = Annotated[
    str, typer.Argument(metavar="SCENARIO", help="of the bundled suite by name, or a YAML file")
]
Corners = Annotated[
    bool, typer.Option("--corners", help="the camera sends corners of markers, not images: no OpenGL, faster")
]


@sim_app.callback()
def needed() -> None:
    """Simulate robots, with known truth. The physics is MuJoCo's."""
    need("sim", "fgloc sim")


@sim_app.command(
    **examples("fgloc sim record calibrated --seed 3 --out run3", "fgloc sim record suite --workers 4 --out runs")
)
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
    from fgloc_datasets.sim.record import BUNDLED, find_scenario, jobs, load_suite, record_suite
    from fgloc_datasets.sim.record import record as record_run

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


@sim_app.command(name="follow", **examples("fgloc sim follow calibrated --path eight --out followed"))
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
    from fgloc_datasets.sim.following.cases import draw_drives, table
    from fgloc_datasets.sim.following.loop import POSES, Drive, follow, read_failures, seen_by
    from fgloc_datasets.sim.following.pursuit import load_path
    from fgloc_datasets.sim.record import find_scenario

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


@sim_app.command(**examples("fgloc sim follow-demo --out follow-out"))
def follow_demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder of following.png and following.txt")],
    workers: Annotated[int, typer.Option("--workers", min=1, help="processes")] = 2,
    corners: Corners = False,
) -> None:
    """Six drives, with a picture and a table. Flat, on ice, with sensors that fail."""
    from fgloc_datasets.sim.following.cases import PICTURE, demonstrate
    from fgloc_datasets.sim.following.loop import seen_by

    check_out(out)
    say(demonstrate(out, workers, seen_by(corners)))
    say(f"\n{out / PICTURE}")


@sim_app.command(**examples("fgloc sim figures run3 --out pictures"))
def figures(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="folder of a recorded run")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder for the pictures")],
) -> None:
    """Draw a recorded run. Trajectory, controls, slip and, if it has images, a contact sheet with detections."""
    from fgloc_datasets.sim.figures import draw

    check_out(out)
    for path in draw(run, out):
        say(str(path))


# --- train, evaluate-model: learned motion ----------------------------------------------------------------------------


def train(
    inputs: Annotated[
        list[Path], typer.Argument(metavar="CONFIG | BAG", help="training configuration; with --init: recordings")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="DIR", help="folder for the models; with --init: the configuration to be written"
        ),
    ],
    data: Annotated[
        Path | None,
        typer.Option(
            "--data", metavar="DIR", help="what the recordings' paths are relative to; default: CONFIG's folder"
        ),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="MODEL",
            help="adapt this model to the robot of the training recordings; a minute of driving is enough",
        ),
    ] = None,
    init: Annotated[
        bool, typer.Option("--init", help="write a training configuration of these bags, split by recording")
    ] = False,
) -> None:
    """Train a motion model of a robot. It is calibrated and judged; the same command goes on with a killed training."""
    if init:
        _write_config(inputs, out)
        return
    need("train", "fgloc train")
    if len(inputs) != 1:
        raise ConfigError(
            f"fgloc train: got {len(inputs)} files, expected one training configuration; "
            "for one of these recordings: fgloc train --init BAG... --out train.yaml"
        )
    check_out(out)
    from fgloc_training.train import CHECKPOINTS, train_models

    (config,) = inputs
    kept = f"what was trained so far is kept in {out / CHECKPOINTS}; the same command goes on from there"
    with kept_on_interrupt(kept):
        models = train_models(config, data or config.parent, out, start, say, warn)
    for model in models:
        say(f"model: {model}")
    next_step(f"fgloc smooth BAG --model {models[0]} --out DIR", "localize with it")


def evaluate_model(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="a .safetensors that fgloc train wrote")],
    bags: Annotated[list[Path], typer.Argument(metavar="BAG", help=BAG_HELP)],
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="also write the figures here")
    ] = None,
    plots: Annotated[
        Path | None, typer.Option("--plots", metavar="DIR", help="draw tracks, growth of errors and calibration here")
    ] = None,
    against: Annotated[
        list[Path] | None, typer.Option("--against", metavar="MODEL", help="another model, for comparison; repeatable")
    ] = None,
) -> None:
    """Compare a motion model with the truth. It predicts whole recordings, without sightings."""
    for path, folder in ((json_file, False), (plots, True)):
        if path is not None:
            check_out(path, folder)
    from fgloc_training.evaluate import compare, draw, table, write_json

    found, rows = compare(model, bags, against or [])
    say(table(rows))
    if json_file is not None:
        write_json(json_file, rows)
    if plots is not None:
        draw(plots, found, rows)


def _write_config(bags: list[Path], out: Path) -> None:
    """Write the training configuration that ``--init`` asks for, and print warnings and the next step."""
    from fgloc.files.outputs import write_text
    from fgloc.recording.storage import refuse_repeats
    from fgloc_training.recordings import look, missing, training_yaml

    check_out(out, folder=False)
    refuse_repeats(bags)
    warn_of_several_robots(bags)
    found = [look(bag, configured(bag, None, None)) for bag in bags]
    write_text(out, training_yaml(found, out))
    for sentence in missing(found):
        warn(sentence)
    if not all(f.has_truth for f in found):
        next_step("fgloc smooth BAG --out smoothed/NAME", f"for each recording, as {out} says: they are the truth")
    next_step(f"fgloc train {out} --out models", "train")
