"""A commented ``robot.yaml`` from what a recording of an unknown robot holds, and what it does not tell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgloc.config import Config, Role
from fgloc.frames import BASE_NAMES
from fgloc.recording.files import find_beside
from fgloc.recording.info import RecordingInfo, inspect_recording
from fgloc.recording.reader import Recording
from fgloc.sensors import registry
from fgloc.sensors.first_settings import FirstLook, FirstSection
from fgloc.types import Event

_OTHER_CLOCK_S = 5.0  # no driver takes so long: stamps further from the receive times are of another clock
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
class RobotFile:
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
    has_map: bool  # beside the bag
    frames: tuple[str, ...]
    sections: tuple[FirstSection, ...]


def first_settings(bag: Path) -> RobotFile:
    """Read a recording through and write down what it tells of the robot.

    Raises:
        RecordingError: nothing can be read.
    """
    seen = _look(bag)
    missing: list[str] = [*seen.info.problems]
    lines = [
        f"# Robot of {bag}. What is commented out has to be filled in or is the default.",
        "# All keys: docs/configuration.md. `fgloc info BAG --config robot.yaml` checks it.",
        *_recording(seen, missing),
    ]
    for section in seen.sections:
        lines += ["", *section.lines] if section.lines else []
        missing += section.missing
    lines += [
        "",
        "# Learned motion: once trained (fgloc train --init BAG... --out train.yaml), or of a robot of this kind.",
        "# motion:",
        "#   model: models/model.safetensors",
    ]
    lacking = ("nothing measures", "nothing bounds", "CameraInfo", "calibration is for", "frame", "tf")
    missing += [text for text in seen.info.findings if any(word in text for word in lacking)]
    return RobotFile("\n".join(lines) + "\n", dict(seen.info.roles), tuple(dict.fromkeys(missing)))


def _look(bag: Path) -> _Seen:
    config = Config()
    wanted = registry.first_settings()
    events: dict[type[Event], list[Event]] = {kind: [] for of in wanted for kind in of.events}

    def watch(event: Event) -> None:
        if type(event) in events:
            events[type(event)].append(event)

    with Recording(bag, config.recording) as recording:
        info = inspect_recording(recording, config, watch)
        has_map = find_beside(bag, "map.yaml") is not None
        look = FirstLook(info.roles, events, recording, has_map)
        frames = tuple(name for name in BASE_NAMES if name in recording.frames)
        return _Seen(info, has_map, frames, tuple(of.section(look) for of in wanted))


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
    if other := _of_other_clocks(seen.info):
        roles = ", ".join(other)
        yield f"  received_stamps: [{roles}]  # their header stamps are of another clock"
        missing.append(f"the header stamps of {roles} are of another clock: receive times are used, which jitter")
    if "truth" in seen.info.roles:
        yield ""
        yield "# The truth's frame: the map's (none), or another one (se2: fitted, for evaluation only)."
        yield f"truth: {{align: {'none' if seen.has_map else 'se2'}}}"
    else:
        missing.append(
            "no truth: to train, smooth the recordings first (their trajectories are the truth); there will be no "
            "errors in the reports"
        )


def _of_other_clocks(info: RecordingInfo) -> tuple[Role, ...]:
    """Roles whose stamps are further from the receive times than those of most; a topic without stamps counts as 0."""
    delays = {role: t.delay_s or 0.0 for t in info.topics for role, name in info.roles.items() if name == t.name}
    usual = float(np.median(list(delays.values()))) if delays else 0.0
    found = tuple(role for role, delay in delays.items() if abs(delay - usual) > _OTHER_CLOCK_S)
    return found if len(delays) > 2 else ()  # of two, either may be wrong
