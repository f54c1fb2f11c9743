"""A commented ``robot.yaml`` from what a recording of an unknown robot holds, and what it does not tell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fgloc.config import Config, Role
from fgloc.frames import BASE_NAMES
from fgloc.recording.files import find_beside
from fgloc.recording.info import RecordingInfo, inspect_recording
from fgloc.recording.reader import Recording
from fgloc.sensors import registry
from fgloc.sensors.roles import SettingsDraft

_MEANINGS: dict[Role, str] = {
    "odometry": "the driver's odometry",
    "command": "commanded velocities; learned motion reads them",
    "joints": "angles of the wheels",
    "imu": "gyro: yaw rate",
    "image": "the camera; markers are found in it",
    "camera_info": "its calibration",
    "sightings": "detected landmarks",
    "truth": "a positioning system; evaluation and training read it",
}


@dataclass(frozen=True, slots=True)
class FirstSettings:
    """What `first_settings` found.

    Attributes:
        text: of robot.yaml.
        roles: topic by role.
        missing: sentences on what the recording does not tell, or lacks.
    """

    text: str
    roles: dict[Role, str]
    missing: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Seen:
    info: RecordingInfo
    frames: tuple[str, ...]
    odometer: SettingsDraft
    dictionary: str | None
    has_map: bool


def first_settings(bag: Path) -> FirstSettings:
    """Read a recording through and write down what it tells of the robot.

    Raises:
        RecordingError: nothing can be read.
    """
    seen = _look(bag)
    missing: list[str] = [*seen.info.problems]
    lines = [
        f"# Robot of {bag.name}. What is commented out has to be filled in or is the default.",
        "# All keys: docs/configuration.md. `fgloc info BAG --config robot.yaml` checks it.",
        *_recording(seen, missing),
        *seen.odometer.lines(missing),
        *_markers(seen, missing),
        "",
        "# Learned motion: once trained (fgloc train --init BAG... --out train.yaml), or of a robot of this kind.",
        "# motion:",
        "#   model: models/model.safetensors",
    ]
    lacking = ("nothing measures", "nothing bounds", "CameraInfo", "calibration is for", "frame", "tf")
    missing += [text for text in seen.info.findings if any(word in text for word in lacking)]
    return FirstSettings("\n".join(lines) + "\n", dict(seen.info.roles), tuple(dict.fromkeys(missing)))


def _look(bag: Path) -> _Seen:
    config, odometer = Config(), registry.odometer().draft()
    with Recording(bag, config.recording) as recording:
        info = inspect_recording(recording, config, odometer.add)
        return _Seen(
            info,
            tuple(name for name in BASE_NAMES if name in recording.frames),
            odometer,
            registry.raw_landmarks().fitting_dictionary(recording) if "image" in info.roles else None,
            find_beside(bag, "map.yaml") is not None,
        )


def _recording(seen: _Seen, missing: list[str]) -> Iterator[str]:
    yield "recording:"
    yield "  topics:  # found by message type and name; none: not used although it is there"
    for role, meaning in _MEANINGS.items():
        if role in seen.info.roles:
            yield f"    {role}: {seen.info.roles[role]}  # {meaning}"
        else:
            yield f"    # {role}:  # not found: {meaning}"
    for problem in seen.info.problems:
        yield f"    # to be settled: {problem}"
    if seen.frames:
        yield f"  base_frame: {seen.frames[0]}"
    else:
        yield "  # base_frame: base_link  # no usual name is in tf"
    if "truth" in seen.info.roles:
        yield ""
        yield "# The truth's frame: the map's (none), or another one (se2: fitted, for evaluation only)."
        yield "truth: {align: none}"
    else:
        missing.append(
            "no truth: to train, smooth the recordings first (their trajectories are the truth); there will be no "
            "errors in the reports"
        )


def _markers(seen: _Seen, missing: list[str]) -> Iterator[str]:
    if "image" not in seen.info.roles:
        return
    yield ""
    yield "markers:"
    if seen.dictionary is not None:
        yield f"  dictionary: {seen.dictionary}  # what is seen in the images fits it"
    else:
        missing.append("the dictionary of the markers: no marker was found in the images (markers.dictionary)")
        yield "  # dictionary: DICT_4X4_50"
    if seen.has_map:
        yield "  # default_size_m:  # the map beside the bag has the sizes"
    else:
        missing.append(
            "the size of the markers: measure the side of the black square and give it (markers.default_size_m)"
        )
        yield "  # default_size_m: 0.16  # side of the black square; every distance follows from it"
    yield "  sigma_px: 0.1  # of a corner: 0.1 for a sharp camera, 0.3 for one that shakes"
    if "camera_info" not in seen.info.roles:
        yield ""
        yield "# The recording has no CameraInfo:"
        yield "# camera: {file: camera.yaml}  # as camera_calibration writes it"
