"""``fgloc init``: the first step with a new robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fgloc.cli.options import Bag
from fgloc.cli.terminal import next_step, say, say_table, shown_path, warn
from fgloc.errors import OutputError
from fgloc.files.atomic import check_out


def init(
    bag: Bag,
    out: Annotated[
        Path, typer.Option("--out", metavar="ROBOT.yaml", dir_okay=False, help="configuration to be written")
    ] = Path("robot.yaml"),
    force: Annotated[bool, typer.Option("--force", help="replace an existing file")] = False,
) -> None:
    """Write a robot.yaml from a recording. It is commented; what the recording does not tell is a warning.

    Exit code 1: no topic of it measures motion.
    """
    check_out(out, folder=False)
    if out.exists() and not force:
        raise OutputError(f"{out}: is there already; give another --out, or --force to replace it")
    from fgloc.calibration.first_settings import first_settings
    from fgloc.config import load_config
    from fgloc.files.outputs import write_text
    from fgloc.recording.storage import find_beside

    found = first_settings(bag)
    write_text(out, found.text)
    load_config(out)
    say_table(("role", "topic"), list(found.roles.items()))
    for finding in found.found:
        if finding.lines:
            say(f"found: {finding.text.replace(': set ', '; written: ', 1)}")
    for sentence in found.missing:
        warn(sentence)
    say(f"configuration: {out}")
    next_step(f"fgloc info {shown_path(bag)} --config {shown_path(out)}", "check the recording with it")
    if not {"odometry", "joints", "command", "imu"} & found.roles.keys():
        raise typer.Exit(1)  # no run is possible
    if not {"image", "sightings"} & found.roles.keys():
        return  # nothing to survey, or to calibrate on
    beside = find_beside(bag, "map.yaml")
    if beside is None:
        next_step(f"fgloc map {shown_path(bag)} --config {shown_path(out)} --out map.yaml", "survey the markers")
    else:
        next_step(
            f"fgloc calibrate {shown_path(bag)} --map {shown_path(beside)} --config {shown_path(out)} "
            "--out calibrated.yaml",
            "find what wheels, camera and clocks are off by",
        )
