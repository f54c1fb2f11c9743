"""Commands that set up a robot: ``init``, ``info``, ``map`` and ``calibrate``."""

from __future__ import annotations

from collections.abc import Sequence, Set
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgloc.cli.options import (
    Bag,
    Bags,
    ConfigOption,
    ForceOption,
    MapOption,
    ModelOption,
    configured,
    spare_inputs,
    warn_of_several_robots,
)
from fgloc.cli.terminal import (
    ask,
    asks,
    exit_if_wrong,
    exit_unless_trusted,
    next_step,
    run_bar,
    say,
    say_inputs,
    say_remark,
    say_table,
    shown_path,
    typed,
    warn,
)
from fgloc.errors import ConfigError, FglocError, MapError, OutputError, RecordingError
from fgloc.files.atomic import check_out

if TYPE_CHECKING:
    from fgloc.calibration.anchors import AnchorSurvey
    from fgloc.calibration.survey import Distance, Survey
    from fgloc.config import Config
    from fgloc.types import LandmarkMap


# --- init and info ----------------------------------------------------------------------------------------------------


def init(
    bag: Bag,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="ROBOT.yaml",
            dir_okay=False,
            help="configuration to be written; default: robot.yaml beside the bag, where other commands read it",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace an existing file")] = False,
) -> None:
    """Write a robot.yaml from a recording. At a terminal it asks for what the recording does not tell.

    The file is commented. What is still missing is a warning. Exit code 1: no topic measures motion.
    """
    from fgloc.recording.storage import beside, find_beside

    out = out or find_beside(bag, "robot.yaml") or beside(bag, "robot.yaml")
    check_out(out, folder=False)
    if out.exists() and not force:
        raise OutputError(f"{out}: is there already; give another --out, or --force to replace it")
    from fgloc.calibration.first_settings import first_settings
    from fgloc.config import base_roles, load_config
    from fgloc.files.outputs import write_text
    from fgloc.motion_noise import with_motion_noise
    from fgloc.sensor_setup import CONVERT, TELLING_MOTION

    found = first_settings(bag, ask if asks() else None)
    with run_bar("init") as progress:
        found = with_motion_noise(found, bag, progress)
    write_text(out, found.text)
    load_config(out)
    say_table(("role", "topic"), list(found.roles.items()))
    for finding in found.found:
        if finding.lines:
            say(f"found: {finding.text.replace(': set ', '; written: ', 1).replace('; set ', ', ')}")
    for sentence in found.missing:
        warn(sentence)
    say(f"configuration: {out}")
    read = find_beside(bag, "robot.yaml")  # by commands that are given none
    given = "" if read is not None and read.resolve() == out.resolve() else f" --config {shown_path(out)}"
    next_step(f"fgloc info {shown_path(bag)}{given}", "check the recording with it")
    if not TELLING_MOTION & base_roles(found.roles):
        raise ConfigError(
            f"{bag}: no run is possible, as no topic tells how the robot moves: give one under recording.topics in "
            f"{out}, or record odometry, joint states, commands, an IMU or images of markers. {CONVERT}"
        )
    survey = f"fgloc map {shown_path(bag)}{given} --out {shown_path(out.parent / 'map.yaml')}"
    if not {"image", "sightings"} & base_roles(found.roles):
        if "uwb" in found.roles and not load_config(out).uwb.anchors:  # type: ignore[attr-defined]
            next_step(survey, "survey the anchors")
        return  # nothing else to survey, or to calibrate on
    landmarks = find_beside(bag, "map.yaml")
    if landmarks is None:
        next_step(survey, "survey the markers")
    else:
        next_step(
            f"fgloc calibrate {shown_path(bag)} --map {shown_path(landmarks)}{given} --out calibrated.yaml",
            "find what wheels, camera and clocks are off by",
        )


def info(bag: Bag, map_file: MapOption = None, config: ConfigOption = None) -> None:
    """Tell what a recording holds. Topics, rates, gaps, what a run would use, what looks wrong (also with the map)."""
    from fgloc.diagnosis.mistakes import inspect_all
    from fgloc.recording.info import format_info
    from fgloc.recording.storage import find_beside

    if map_file is not None and not map_file.exists():
        raise MapError(f"{map_file}: there is no such file; give the map, or leave --map out")
    map_path = map_file or find_beside(bag, "map.yaml")
    settings = configured(bag, config, None)
    say_inputs(bag, map_file, config, "none")
    found = inspect_all(bag, map_path, settings)
    say(format_info(found), nl=False)
    if found.exit_code:
        raise typer.Exit(found.exit_code)


# --- map --------------------------------------------------------------------------------------------------------------


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
    force: ForceOption = False,
) -> None:
    """Survey the landmarks of recordings. Without --anchor the first pose is the map's origin.

    Markers in images (or their corners) are surveyed in position and orientation, from one or several recordings.
    Radio anchors whose places uwb.anchors does not have are surveyed by their ranges to a robot that drives curves;
    where it has some, they make the frame. The lines for robot.yaml are shown.
    """
    from fgloc.calibration.anchors import surveys_anchors
    from fgloc.calibration.survey import sees_corners, survey
    from fgloc.sensors.maps import configured_map, write_map

    check_out(out, folder=False)
    spare_inputs(out, bags[0], anchor, config, force, folder=False)
    settings = configured(bags[0], config, model)
    given = None if anchor is None else configured_map(anchor, settings, size)
    settings = _with_markers(settings, dictionary, size, given)
    if not sees_corners(bags[0], settings):
        if len(bags) > 1 or anchor is not None or distance:
            raise RecordingError(
                f"{bags[0]}: no images and no corners of markers; from other sightings only one recording is surveyed, "
                "without --anchor and --distance"
            )
        if surveys_anchors(bags[0], settings):
            _of_anchors(bags[0], out, settings, config)
            return
        _of_points(bags[0], out, settings, config)
        return
    distances = [_distance(text) for text in distance or ()]
    with run_bar("map") as progress:
        found = survey(bags, settings, given, distances, progress)
    write_map(found.landmarks, out)
    _tell(found, out)
    exit_if_wrong(found.errors)
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
    from fgloc.types import Severity, ordered

    with run_bar("map") as progress:
        result = run(bag, None, settings, "batch", progress)
    if result.landmarks is None or not len(result.landmarks):
        raise RecordingError(f"{bag}: no landmark was seen often enough to be surveyed; see `fgloc info {bag}`")
    write_map(result.landmarks, out)
    say(f"{len(result.landmarks)} landmarks in {out}")
    for finding in ordered(result.findings):
        if finding.severity is Severity.ERROR:
            say_remark("error", finding.text, err=True)
    exit_unless_trusted(result)
    _tell_next([bag], out, config)


def _of_anchors(bag: Path, out: Path, settings: Config, config: Path | None) -> None:
    """A map of radio anchors; ``config``: the file that was given."""
    import numpy as np

    from fgloc.calibration.anchors import survey_anchors
    from fgloc.recording.storage import beside
    from fgloc.sensors.maps import write_map
    from fgloc.sensors.uwb import anchor_lines

    with run_bar("map") as progress:
        found = survey_anchors(bag, settings, progress)
    write_map(found.landmarks, out)
    rows = []
    for i, count in found.ranges.items():
        landmark = found.landmarks.landmarks[i]
        x, y, z = landmark.position
        sigma = np.sqrt(np.diag(landmark.cov))  # type: ignore[arg-type]
        rows.append((str(i), str(count), f"{x:.2f}, {y:.2f}, {z:.2f}", f"{sigma[:2].max():.2f}", f"{sigma[2]:.2f}"))
    say_table(("anchor", "ranges", "x, y, z [m]", "sigma", "of height"), rows)
    _tell_left_out("anchor", found)
    say(f"{len(found.landmarks)} anchors in {out}; for robot.yaml:")
    say("\n".join(["uwb:", *anchor_lines(found.landmarks.landmarks), f"  sigma_m: {found.noise_m:.2g}"]))
    if out.resolve() == beside(bag, "map.yaml").resolve():
        next_step(f"fgloc init {shown_path(bag)} --force", "write a robot.yaml with these lines")


def _tell(found: Survey, out: Path) -> None:
    import numpy as np

    rows = []
    for i, views in found.views.items():
        cov = found.landmarks.landmarks[i].cov
        sigma = np.sqrt(np.diag(np.eye(6) if cov is None else cov))
        rows.append((str(i), str(views), f"{1e3 * sigma[:3].max():.1f} mm", f"{np.degrees(sigma[3:].max()):.2f} deg"))
    say_table(("marker", "views", "position", "direction"), rows)
    _tell_left_out("marker", found)
    say(f"{len(found.landmarks)} landmarks in {out}")


def _tell_left_out(kind: str, found: AnchorSurvey | Survey) -> None:
    for i, why in found.left_out.items():
        say(f"left out: {kind} {i}: {why}")
    for note in found.notes:
        say(f"note: {note}")


def _with_markers(settings: Config, dictionary: str | None, size: float | None, given: LandmarkMap | None) -> Config:
    """The configuration with the markers of the command line or the given map."""
    from fgloc.sensors.base import with_values

    if size is not None and not 0.0 < size <= 5.0:
        raise ConfigError(f"--size {size:g}: expected the side of the black square in metres, more than 0 and up to 5")
    markers = settings.markers
    sizes = {m.size_m for m in given.landmarks.values() if m.size_m > 0.0} if given is not None else set()
    dictionary = dictionary or markers.dictionary or (given.dictionary if given is not None else None) or None
    size = size or markers.default_size_m or (sizes.pop() if len(sizes) == 1 else None)
    return with_values(settings, "markers", {"dictionary": dictionary, "default_size_m": size})


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


# --- calibrate --------------------------------------------------------------------------------------------------------


def _bending(bags: Sequence[Path], map_file: Path | None, before: Config, after: Config, fitted: Set[str]) -> list[str]:
    """Mistakes of the set-up that no fitted constant can undo, where no map tells them from what the wheels are off.

    Landmarks agree with whatever the wheels were fitted to: they are held against the wheels ``before``. A truth is not
    fitted: what it still contradicts ``after`` is a mistake.
    """
    from fgloc.calibrate import only_truth
    from fgloc.diagnosis.mistakes import find_mistakes
    from fgloc.recording.storage import find_beside
    from fgloc.types import Severity

    texts = []
    for bag in bags:
        if map_file is not None or find_beside(bag, "map.yaml") is not None:
            continue
        with suppress(FglocError):  # a recording that calibrates the wheels alone, by its truth, need not be one to run
            for finding in find_mistakes(bag, None, after if only_truth(bag, before) else before).findings:
                keys = {key.removeprefix("expert.") for key in finding.lines}
                if finding.severity is Severity.ERROR and not (keys and keys <= fitted):
                    texts.append(f"{bag}: {finding.text}" if len(bags) > 1 else finding.text)
    return texts


def _commanded(bag: Path, config: Config) -> bool:
    """Whether a recording holds commands, which training reads."""
    from fgloc.recording.reader import Recording

    with Recording(bag, config.recording) as recording:
        return "command" in recording.roles


def calibrate(
    bags: Bags,
    out: Annotated[
        Path, typer.Option("--out", metavar="ROBOT.yaml", dir_okay=False, help="configuration file to be written")
    ],
    map_file: MapOption = None,
    config: ConfigOption = None,
    force: ForceOption = False,
) -> None:
    """Calibrate wheels, camera and clocks. From recordings on a known map, or in which landmarks are seen again.

    Recordings without landmarks but with a truth calibrate the wheels alone: their motion is compared with the truth.
    Exit code 3: without a map, something else of the set-up is wrong, and the constants are bent by it.
    """
    from fgloc.calibrate import calibrate as calibrated
    from fgloc.calibrate import only_truth
    from fgloc.calibration.installation import found_text, given_text, setting_unit
    from fgloc.config import yaml_of
    from fgloc.files.outputs import write_text
    from fgloc.recording.storage import refuse_repeats

    check_out(out, folder=False)
    refuse_repeats(bags)
    spare_inputs(out, bags[0], map_file, config, force, folder=False)
    before = configured(bags[0], config, None)
    say_inputs(bags[0], map_file, config)
    if config is None:
        warn_of_several_robots(bags)
    with run_bar("calibrate") as progress:
        after, settings = calibrated(bags, map_file, before, progress)
    write_text(out, f"# {typed()}\n{yaml_of(after, out.parent)}")
    rows = [(s.name, setting_unit(s.name), given_text(s), found_text(s)) for s in settings]
    say_table(("setting", "unit", "given", "found"), rows)
    say(f"configuration: {out}")
    wrong = _bending(bags, map_file, before, after, {s.name for s in settings})
    exit_if_wrong(wrong, "not to be trusted: what is wrong there was fitted by the constants above; correct it first")
    if len(bags) == 1 and only_truth(bags[0], before):
        text = "the noise is that of the wheels within one drive; they differ more from drive to drive: give several"
        say_remark("note", text)
    if len(bags) > 1 and all(_commanded(bag, before) for bag in bags):
        paths = " ".join(shown_path(bag) for bag in bags)
        next_step(f"fgloc train --init {paths} --out train.yaml", "learn how this robot moves; or smooth with it:")
    next_step(f"fgloc smooth {shown_path(bags[-1])} --config {shown_path(out)} --out result", "the best estimate")
