"""``fgloc map``: landmarks surveyed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgloc.cli.options import Bags, ConfigOption, ModelOption, configured
from fgloc.cli.progress import run_bar
from fgloc.cli.terminal import exit_unless_trusted, next_step, say, say_table, shown_path
from fgloc.errors import ConfigError, RecordingError
from fgloc.files.atomic import check_out

if TYPE_CHECKING:
    from fgloc.calibration.survey import Distance, Survey
    from fgloc.config import Config
    from fgloc.types import LandmarkMap


def make_map(
    bags: Bags,
    out: Annotated[Path, typer.Option("--out", metavar="MAP.yaml", dir_okay=False, help="map file to be written")],
    dictionary: Annotated[
        str | None, typer.Option("--dictionary", metavar="NAME", help="of the markers in images, such as DICT_4X4_50")
    ] = None,
    size: Annotated[
        float | None, typer.Option("--size", metavar="M", help="side of the markers' black square in metres")
    ] = None,
    anchor: Annotated[
        Path | None,
        typer.Option(
            "--anchor", metavar="MAP.yaml", help="markers that are known: they make the frame, and are refined"
        ),
    ] = None,
    distance: Annotated[
        list[str] | None,
        typer.Option("--distance", metavar="A,B,M", help="metres between the middles of markers A and B; repeatable"),
    ] = None,
    model: ModelOption = None,
    config: ConfigOption = None,
) -> None:
    """Survey the landmarks of recordings. Without --anchor the first pose is the map's origin.

    Markers in images (or their corners) are surveyed in position and orientation, from one or several recordings.
    """
    from fgloc.calibration.survey import sees_corners, survey
    from fgloc.sensors.maps import configured_map, write_map

    check_out(out, folder=False)
    settings = configured(bags[0], config, model)
    given = None if anchor is None else configured_map(anchor, settings, size)
    settings = _with_markers(settings, dictionary, size, given)
    if not sees_corners(bags[0], settings):
        if len(bags) > 1 or anchor is not None or distance:
            raise RecordingError(
                f"{bags[0]}: no images and no corners of markers; from other sightings only one recording is surveyed, "
                "without --anchor and --distance"
            )
        _of_points(bags[0], out, settings, config)
        return
    distances = [_distance(text) for text in distance or ()]
    with run_bar("map") as progress:
        found = survey(bags, settings, given, distances, progress)
    write_map(found.landmarks, out)
    _tell(found, out)
    _tell_next(bags, out, config)


def _tell_next(bags: list[Path], out: Path, config: Path | None) -> None:
    paths = " ".join(shown_path(bag) for bag in bags)
    configuration = "" if config is None else f" --config {shown_path(config)}"
    next_step(
        f"fgloc calibrate {paths} --map {shown_path(out)}{configuration} --out calibrated.yaml",
        "find what wheels, camera and clocks are off by",
    )


def _of_points(bag: Path, out: Path, settings: Config, config: Path | None) -> None:
    """A map of points, from ranges and bearings or marker poses; ``config``: the file that was given."""
    from fgloc.runner import run
    from fgloc.sensors.maps import write_map

    with run_bar("map") as progress:
        result = run(bag, None, settings, "batch", progress)
    if result.landmarks is None or not len(result.landmarks):
        raise RecordingError(f"{bag}: no landmark was seen often enough to be surveyed; see `fgloc info {bag}`")
    write_map(result.landmarks, out)
    say(f"{len(result.landmarks)} landmarks in {out}")
    _tell_next([bag], out, config)
    exit_unless_trusted(result)


def _tell(found: Survey, out: Path) -> None:
    import numpy as np

    rows = []
    for i, views in found.views.items():
        cov = found.landmarks.landmarks[i].cov
        sigma = np.sqrt(np.diag(np.eye(6) if cov is None else cov))
        rows.append((str(i), str(views), f"{1e3 * sigma[:3].max():.1f} mm", f"{np.degrees(sigma[3:].max()):.2f} deg"))
    say_table(("marker", "views", "position", "direction"), rows)
    for i, why in found.left_out.items():
        say(f"left out: marker {i}: {why}")
    for note in found.notes:
        say(f"note: {note}")
    say(f"{len(found.landmarks)} landmarks in {out}")


def _with_markers(settings: Config, dictionary: str | None, size: float | None, given: LandmarkMap | None) -> Config:
    """The configuration with the markers of the command line or the given map."""
    from fgloc.sensors import registry

    if size is not None and not 0.0 < size <= 5.0:
        raise ConfigError(f"--size {size:g}: expected the side of the black square in metres, more than 0 and up to 5")
    markers = registry.raw_landmarks()
    sizes = {m.size_m for m in given.landmarks.values() if m.size_m > 0.0} if given is not None else set()
    dictionary = dictionary or markers.dictionary(settings) or (given.dictionary if given is not None else None) or None
    size = size or markers.size(settings) or (sizes.pop() if len(sizes) == 1 else None)
    return markers.given(settings, dictionary, size)


def _distance(text: str) -> Distance:
    from fgloc.calibration.survey import Distance

    try:
        first, second, metres = text.split(",")
        made = Distance(int(first), int(second), float(metres))
    except ValueError:
        made = None
    if made is None or made.first == made.second or not 0.0 < made.metres < 1e4:
        raise ConfigError(f"--distance {text}: expected two ids and metres, such as 3,7,2.415")
    return made
