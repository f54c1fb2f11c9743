"""Arguments that several commands share, their defaults, and the extras that commands need."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import typer

from fgloc.cli.terminal import warn
from fgloc.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from fgloc.config import Config


BAG_HELP = "ROS 1 .bag, rosbag2 folder, .mcap or .db3"

Bag = Annotated[Path, typer.Argument(metavar="BAG", help=BAG_HELP)]
Bags = Annotated[list[Path], typer.Argument(metavar="BAG", help=BAG_HELP)]
Out = Annotated[
    Path, typer.Option("--out", metavar="DIR", file_okay=False, help="folder for the results; made if missing")
]
MapOption = Annotated[
    Path | None,
    typer.Option("--map", metavar="MAP.yaml", help="landmarks; default: map.yaml beside the bag, else none"),
]
ModelOption = Annotated[
    Path | None,
    typer.Option(
        "--model", metavar="MODEL", help="learned motion: a .safetensors, or shipped:NAME; default: the configuration's"
    ),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", metavar="ROBOT.yaml", help="configuration; default: robot.yaml beside the bag, else none"),
]
RrdOption = Annotated[
    Path | None, typer.Option("--rrd", metavar="FILE", dir_okay=False, help="also write the run for rerun's viewer")
]
McapOption = Annotated[
    Path | None,
    typer.Option("--mcap", metavar="FILE", dir_okay=False, help="also write the run as a bag of standard messages"),
]
ForceOption = Annotated[bool, typer.Option("--force", help="write over a map or a configuration that is read")]
FigureFormat = Literal["png", "svg", "pdf"]
FiguresOption = Annotated[
    str | None,
    typer.Option(
        "--figures",
        metavar="png,svg,pdf",
        help="also write every figure, sized for print, in one or more of these formats",
    ),
]
WorkersOption = Annotated[int | None, typer.Option("--workers", min=1, help="processes; default: one per core")]
SchedulerOption = Annotated[
    str | None, typer.Option(metavar="tcp://HOST:PORT", help="a running Dask scheduler, instead of local processes")
]


def figure_formats(text: str | None) -> list[FigureFormat]:
    """The formats that ``--figures`` names.

    Raises:
        typer.BadParameter: one of them is unknown.
    """
    known = get_args(FigureFormat)
    named = [name.strip() for name in (text or "").split(",") if name.strip()]
    if wrong := [name for name in named if name not in known]:
        raise typer.BadParameter(f"{wrong[0]!r} is not one of {', '.join(known)}", param_hint="--figures")
    return [form for form in known if form in named]


def configured(bag: Path | None, config_file: Path | None, model: Path | None) -> Config:
    """The given configuration, else the one beside the bag (if any), else the defaults; `model` overrides it.

    Raises:
        ConfigError: the file is missing or wrong.
    """
    from pydantic import ValidationError

    from fgloc.config import config_of, load_config
    from fgloc.recording.storage import find_beside
    from fgloc.sensors.learned.sensor import with_model

    file = config_file or (None if bag is None else find_beside(bag, "robot.yaml"))
    config = config_of({}) if file is None else load_config(file)
    if model is None:
        return config
    try:
        return with_model(config, model)
    except ValidationError as error:
        raise ConfigError(f"--model: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from error


def warn_of_several_robots(bags: Sequence[Path]) -> None:
    """Warn if the configurations beside the recordings say other things: they may be of two robots."""
    from fgloc.files.settings import Settings
    from fgloc.recording.storage import find_beside

    found = dict.fromkeys(find_beside(bag, "robot.yaml") for bag in bags)
    files = [Settings(file, "give the robot's") for file in found if file is not None]
    for file in files[1:]:
        if file.content != files[0].content:
            warn(f"{files[0].path} and {file.path} differ: expected recordings of one robot, and one configuration")


_RESULTS = ("map.yaml", "installation.yaml")  # of a result folder, which the next run may read


def spare_inputs(
    out: Path, bag: Path, map_file: Path | None, config: Path | None, force: bool, folder: bool = True
) -> None:
    """Find out before a command runs whether it would write over a map or a configuration that it reads.

    Args:
        out: file, or folder of results.
        bag: recording; what is not given is read from beside it.
        map_file: as given.
        config: as given.
        force: it may.
        folder: whether ``out`` is a folder.

    Raises:
        OutputError: it would.
    """
    from fgloc.recording.storage import find_beside

    written = {(out / name).resolve() for name in _RESULTS} if folder else {out.resolve()}
    kept = [map_file or find_beside(bag, "map.yaml"), config or find_beside(bag, "robot.yaml")]
    if folder:  # nobody asked for a file of this name
        kept.append(find_beside(bag, "map.yaml"))
    for given in kept:
        if given is not None and given.resolve() in written and not force:
            raise OutputError(
                f"--out {out}: {given} is an input and would be written over; give another --out, or --force"
            )


# --- Extras -----------------------------------------------------------------------------------------------------------

_NEEDED = {  # extra of pyproject.toml: what it brings
    "train": ("torch",),
    "sim": ("mujoco",),
    "sweep": ("dask", "distributed"),
    "live": ("cyclonedds",),
    "view": ("rerun",),
}
_HINTS = {"train": "; on Linux, --extra-index-url https://download.pytorch.org/whl/cpu spares 2 GB of CUDA"}


def need(extra: str, command: str) -> None:
    """Find out before a command runs whether its extra is installed.

    Raises:
        ConfigError: it is not; the message says how to install it.
    """
    missing = [name for name in _NEEDED[extra] if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"{command} needs {' and '.join(missing)}, which the base install leaves out; "
            f"install the extra '{extra}': {shlex.quote(sys.executable)} -m pip install 'fgloc[{extra}]'"
            f"{_HINTS.get(extra, '')}"
        )
