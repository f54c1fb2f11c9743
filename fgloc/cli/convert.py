"""``fgloc convert``: public sets as bags."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fgloc.cli.terminal import group, next_step, say, shown_path
from fgloc.files.atomic import check_out

app = group("Convert public data sets to bags. Each gets a robot.yaml and, where landmarks were surveyed, a map.yaml.")

Storage = Annotated[str, typer.Option("--storage", help="mcap or sqlite3")]
Download = Annotated[
    Path | None, typer.Option("--download", metavar="FOLDER", help="fetch the set into this folder first")
]
Url = Annotated[str | None, typer.Option("--url", metavar="ADDRESS", help="where --download finds it")]


@app.command()
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
    from fgloc_datasets.mrclam_run import Calibration

    check_out(out)
    if download is not None:
        source = data.download(download, dataset)
    if source is None:
        raise typer.BadParameter("give the folder of the unpacked set, or --download FOLDER", param_hint="SRC")
    if fit:
        from fgloc_datasets.mrclam_fit import left_out

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


@app.command()
def pioneer(
    source: Annotated[Path | None, typer.Argument(metavar="BAG", help="duarte.bag or pinto1.bag")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder for bag/ and robot.yaml")] = Path("pioneer"),
    storage: Storage = "mcap",
    download: Download = None,
    name: Annotated[str, typer.Option(help="which one to download: duarte or pinto1")] = "duarte",
) -> None:
    """A Pioneer with ArUco markers. Truth by motion capture."""
    from fgloc_datasets.download import fetch
    from fgloc_datasets.pioneer import REMOTES
    from fgloc_datasets.pioneer import convert as converted

    check_out(out)
    if download is not None:
        if name not in REMOTES:
            raise typer.BadParameter(f"{name!r} is not one of {', '.join(REMOTES)}", param_hint="--name")
        source = fetch(REMOTES[name], download)
    if source is None:
        raise typer.BadParameter("give the bag, or --download FOLDER", param_hint="BAG")
    converted(source, out, storage)
    _say_written(out)


@app.command()
def turtlebot3(
    source: Annotated[Path | None, typer.Argument(metavar="BAG", help="rosbag2 folder")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder for bag/, map.yaml and robot.yaml")] = Path(
        "turtlebot3"
    ),
    landmarks: Annotated[
        Path | None, typer.Option(metavar="FILE", help="list of landmarks, if it is not beside the bag")
    ] = None,
    storage: Storage = "mcap",
    download: Download = None,
    url: Url = None,
) -> None:
    """A TurtleBot3 Burger with AprilTags."""
    from fgloc_datasets.download import unpack
    from fgloc_datasets.turtlebot3 import convert_and_tell

    check_out(out)
    unknown = "the set has no public address that we know; give one with --url"
    source = _given_or_fetched(source, "BAG", download, url, unknown)
    if download is not None and source.suffix == ".zip":
        source = unpack(source, source.with_suffix(""))
        found = sorted(source.rglob("metadata.yaml"))
        source = found[0].parent if found else source
    _, dropped, notes = convert_and_tell(source, out, storage, landmarks)
    for what, count in dropped.items():
        say(f"left out: {count} messages of {what}: the definition of their type is not known")
    for note in notes:
        say(f"note: {note}")
    _say_written(out)


@app.command()
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
    from fgloc_datasets.drive import convert as converted
    from fgloc_datasets.drive import span

    check_out(out)
    unknown = "the owner publishes a pickle, which is not opened; give a CSV's address with --url"
    source = _given_or_fetched(source, "CSV", download, url, unknown)
    converted(source, out, storage, span(windows, "--windows"), span(calibration, "--calibration"))
    _say_written(out)


def _given_or_fetched(source: Path | None, name: str, download: Path | None, url: str | None, unknown: str) -> Path:
    """The recording that was given as the argument ``name``, or downloaded; ``unknown``: why it needs an address."""
    from fgloc_datasets.download import Remote, fetch

    if download is not None:
        if url is None:
            raise typer.BadParameter(unknown, param_hint="--download")
        return fetch(Remote(url), download)
    if source is None:
        raise typer.BadParameter("give the recording, or --download FOLDER --url ADDRESS", param_hint=name)
    return source


def _say_written(out: Path) -> None:
    """The files of one converted recording, and what to do with them."""
    names = [name for name in ("bag", "map.yaml", "robot.yaml", "windows.csv") if (out / name).exists()]
    say(f"written to {out}: {', '.join(names)}")
    _say_next(out)


def _say_next(folder: Path) -> None:
    next_step(f"fgloc smooth {shown_path(folder / 'bag')} --out {shown_path(folder / 'result')}", "localize with it")
