"""A commented ``robot.yaml`` from a recording of an unknown robot, and the settings that it does not determine."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import yaml

from fgloc.calibration.first_fields import FirstWheels, find_joints, find_roles, fit_wheels
from fgloc.config import (
    CAMERA_ROLES,
    Config,
    Role,
    RoleFields,
    base_role,
    base_roles,
    camera_role,
    config_of,
    config_of_file,
    one_line,
    optional_roles,
    role_names,
    with_value,
)
from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.conventions import conventions
from fgloc.diagnosis.landmark_fits import Noise
from fgloc.diagnosis.signals import other_clocks, read_signals
from fgloc.errors import FglocError
from fgloc.extensions import outside_sensors
from fgloc.frames import BASE_NAMES
from fgloc.recording.fields import NumericField, unread_numbers, unread_paths
from fgloc.recording.info import LACKING, RecordingInfo, inspect_recording, placing_roles
from fgloc.recording.reader import POINT, TF_TYPES, Recording, converters_of, is_derived, unrectified
from fgloc.recording.storage import Storage, find_beside
from fgloc.sensor_setup import recorded_setup
from fgloc.sensors import registry
from fgloc.sensors.base import Asked, FirstLook, FirstSection
from fgloc.sensors.maps import load_map
from fgloc.types import Event, Finding, SightingsEvent, ordered

_UNCALIBRATED = {
    "range_scale_sigma": 0.03,
    "bearing_bias_sigma_rad": 0.02,
    "position_sigma_m": 0.05,
    "time_offset_sigma_s": 0.05,
}
_WHEELS: tuple[str, ...] = (
    "  # Nobody has calibrated this odometry: radii and track may be off by more than those of measured wheels.",
    "  scale_sigma: 0.02",
    "  turn_scale_sigma: 0.05",
)
_IMAGES = frozenset({"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"})
_CORNERS = frozenset(
    kind
    for stream in registry.streams_of("sightings")
    if issubclass(stream.event, SightingsEvent) and stream.event.in_pixels
    for kind in stream.converters
)
_RANGE_BEARING = "landmark_msgs/msg/LandmarkArray"  # of any sensor
_CORRELATED_S = 1.0  # views from about one place err alike, for longer than the scatter over seconds shows
_COMMANDED = (
    "  # Commands stand in for wheels. A robot follows them by a share that nobody has measured (5 to 12 % less is",
    "  # usual), late, and each time a little differently: priors and noise are wider than those of wheels.",
    "  scale_sigma: 0.1",
    "  turn_scale_sigma: 0.1",
)
_COMMANDED_EXPERT = (
    "  # Of commands in place of wheels, as above.",
    "  hold_s: 1.1",
    "  yaw_per_m_sigma: 0.05",
    "  delay_sigma_s: 0.1",
    "  noise: {x_per_sqrt_m: 0.07, yaw_per_sqrt_rad: 0.09}",
)
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
    """Text of a robot.yaml as `first_settings` writes it, with its topics, its gaps and its findings.

    Attributes:
        text: of robot.yaml.
        roles: topic by role.
        missing: sentences on what the recording does not tell, or lacks.
    """

    text: str
    roles: dict[Role, str]
    missing: tuple[str, ...]
    found: tuple[Finding, ...] = ()  # conventions, which the text has


@dataclass(frozen=True, slots=True)
class _Seen:
    info: RecordingInfo
    has_map: bool  # beside the bag
    frames: tuple[str, ...]
    sections: tuple[FirstSection, ...]
    others: Mapping[Role, tuple[str, ...]]  # topics that could each play a role beyond the built-in ones
    numbers: tuple[NumericField, ...]  # that may be of wheels, where no topic is
    wheels: FirstWheels  # in some of them
    made: Mapping[str, RoleFields]  # other roles in messages of other types


Ask = Callable[[Asked], Mapping[str, str] | None]
"""Value of each key, or None: the user does not know."""


def first_settings(bag: Path, ask: Ask | None = None) -> RobotFile:
    """Read a recording through and write the settings of the robot that it determines.

    Args:
        bag: the recording.
        ask: asks the user for what it does not determine; None: nobody is there.

    Raises:
        RecordingError: nothing can be read.
    """
    seen = _look(bag)
    missing: list[str] = [*seen.info.problems]
    lines = [
        f"# Robot of {bag}. What is commented out has to be filled in or is the default.",
        "# All keys: docs/configuration.md. `fgloc info BAG --config robot.yaml` checks it.",
        *_recording(seen, missing),
        *_cameras(seen),
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
    text = "\n".join(lines) + "\n"
    for section in seen.sections:
        text = _with_lines(text, section.others)
        for asked in section.asked:
            if ask is not None and (values := ask(asked)):
                text = _answered(text, asked, values)
                missing.remove(asked.missing)
    compared = None if seen.info.problems else _compared(bag, text)
    found = () if compared is None else ordered(compared.findings)
    text = with_findings(text, found)
    if compared is not None and "sightings" in base_roles(seen.info.roles):
        text = _with_lines(text, _noise_lines(compared.noise, seen.has_map))
    if compared is not None and compared.commanded:
        text = _with_lines(text, {"wheels": _COMMANDED, "expert.wheels": _COMMANDED_EXPERT})
    elif compared is not None and seen.has_map:  # without a map these constants are not estimated
        text = _with_lines(text, {"wheels": _WHEELS})
    missing += [f.text for f in found if not f.lines]
    placed = placing_roles(seen.info.roles, config_of_file(yaml.safe_load(text) or {}))
    lacking = {*LACKING} - ({"place.unbounded"} if placed else set())
    missing += [f.text for f in seen.info.found if f.code in lacking]
    return RobotFile(text, dict(seen.info.roles), tuple(dict.fromkeys(missing)), found)


def _noise_lines(noise: Noise | None, has_map: bool) -> dict[str, list[str]]:
    """Noise of the sensor of landmarks that the recording shows beyond the defaults, and its priors, by section.

    A recording can show that errors are larger than the defaults; that they are smaller it does not: over seconds the
    errors of one view are alike, and hidden.
    """
    section = Config().landmarks
    repeat_s = _CORRELATED_S if noise is None else max(noise.correlated_s, _CORRELATED_S)
    alike = ["  # So long the errors of one landmark are taken to be alike.", f"  repeat_s: {repeat_s:.2g}"]
    wide = {} if noise is None else {"range_sigma_m": noise.range_m, "bearing_sigma_rad": noise.bearing_rad}
    wide = {key: value for key, value in wide.items() if value > getattr(section, key)}
    blocks: dict[str, list[str]] = {}
    if wide:
        lines = [f"  {key}: {value:.3g}" for key, value in wide.items()]
        blocks["landmarks"] = ["  # Noise that the wheels' motion leaves unexplained.", *lines]
    if has_map:  # without one these constants are not estimated
        alike.append("  # Nobody has calibrated this sensor: it may be off by more than a measured one (the defaults).")
        alike += [f"  {key}: {value:g}" for key, value in _UNCALIBRATED.items()]
    blocks["expert.landmarks"] = alike
    if noise is not None and noise.map_m is not None and noise.map_m > Config().map.position_sigma_m:
        about = "  # By how much landmarks stand elsewhere than on the map, by sightings and wheels."
        blocks["map"] = [about, f"  position_sigma_m: {noise.map_m:.2g}"]
    return blocks


def _compared(bag: Path, text: str) -> Conventions:
    """Conventions of the recording, read as the settings so far have it."""
    config = config_of_file(yaml.safe_load(text) or {})
    map_path = find_beside(bag, "map.yaml")
    landmark_map = T_base_sensor = imu_up = None
    with Recording(bag, config.recording) as recording:
        try:
            setup = recorded_setup(recording, map_path, config)
            landmark_map, T_base_sensor, imu_up = setup.landmark_map, setup.T_base_sensor, setup.imu_up
        except FglocError:  # what is missing is said elsewhere; without it less can be compared
            pass
        return conventions(read_signals(recording, config), config, T_base_sensor, imu_up, landmark_map)


def _answered(text: str, asked: Asked, values: Mapping[str, str]) -> str:
    """A robot.yaml with the answers to questions, in place of the lines that were to be filled in."""
    text = text.replace("\n".join(asked.replaced) + "\n", "")
    section = next(iter(values)).rpartition(".")[0]
    settings = [f"{key.rpartition('.')[2]}: {value}" for key, value in values.items()]
    return _with_lines(text, {section: [f"  {line}" for line in (*asked.lines, *settings)]})


def with_findings(text: str, findings: Sequence[Finding]) -> str:
    """A robot.yaml with the lines of findings, each below a comment with its evidence."""
    lines = text.splitlines()
    values: dict[str, tuple[str, str]] = {}
    for finding in findings:
        for key, value in finding.lines.items():
            before = values.get(key)
            if before is not None and value.startswith("{"):
                value = one_line({**yaml.safe_load(before[1]), **yaml.safe_load(value)})
            values[key] = (finding.text.partition(": set ")[0] + ".", value)
    written: dict[str, list[str]] = {}
    for key, (why, value) in values.items():
        section, _, name = key.rpartition(".")
        lines = list(_without(lines, key))
        comment = textwrap.wrap(why, 110, initial_indent="  # ", subsequent_indent="  # ")
        block = written.setdefault(section, [])
        block += [*(() if comment[0] in block else comment), f"  {name}: {value}"]
    return _with_lines("\n".join(lines) + "\n", written)


def _without(lines: Sequence[str], key: str) -> Iterator[str]:
    """Lines but that of a dotted key and those below it, which are further in."""
    inside: int | None = None  # indentation of the key
    for line, place in zip(lines, _places(lines), strict=True):
        indent = len(line) - len(line.lstrip())
        if inside is not None and line.strip() and indent > inside:
            continue
        inside = indent if place == key else None
        if inside is None:
            yield line


def _with_lines(text: str, blocks: Mapping[str, Sequence[str]]) -> str:
    """A robot.yaml with lines put at the head of its sections; "expert.wheels" is one within another."""
    lines = text.splitlines()
    for section, block in blocks.items():
        outer = section.rpartition(".")[0]
        for name in (outer, section) if outer else (section,):
            if name not in (places := _places(lines)):
                head = f"{'  ' * name.count('.')}{name.rpartition('.')[2]}:"
                at = places.index(outer) + 1 if name != outer and outer else len(lines)
                lines[at:at] = [head] if at < len(lines) or name.count(".") else ["", head]
        at, indent = _places(lines).index(section) + 1, "  " * section.count(".")
        lines[at:at] = [indent + line for line in block]
    return "\n".join(lines) + "\n"


def _places(lines: Sequence[str]) -> list[str]:
    """Dotted key of each line of a robot.yaml that has one; "" for comments and the rest."""
    places: list[str] = []
    open_keys: list[str] = []  # of the line and what it is in, by its indentation of two spaces each
    for line in lines:
        key = re.match(r"((?:  )*)(\w+):", line)
        if key is not None:
            open_keys[len(key[1]) // 2 :] = [key[2]]
        places.append(".".join(open_keys) if key is not None else "")
    return places


def _look(bag: Path) -> _Seen:
    config = _with_cameras(bag, Config())
    with Recording(bag, config.recording) as recording:
        roles = recording.roles
    known = TF_TYPES.union(*map(converters_of, role_names())) - {POINT}
    with closing(Storage(bag)) as storage:
        numbers = () if _WHEELED & roles.keys() else _numbers(storage, known, roles.values())
        made = find_roles(unread_paths(storage, known, roles.values()), {*map(base_role, roles)})
    free = [n for n in numbers if n.topic not in {fields.topic for fields in made.values()}]
    wheels = FirstWheels({} if "odometry" in made else find_joints(free), {})
    config = with_value(config, "recording", _read_by_fields(wheels, made))
    if wheels.joints:
        with Recording(bag, config.recording) as recording:
            wheels = fit_wheels(wheels.joints, read_signals(recording, config), config)
        config = with_value(_with_cameras(bag, Config()), "recording", _read_by_fields(wheels, made))
    others = _others(bag, config)
    for role, (first, *_) in others.items():
        config = with_value(config, f"recording.topics.{role}", first)
    wanted = registry.first_settings()
    events: dict[type[Event], list[Event]] = {kind: [] for of in wanted for kind in of.events}

    def watch(event: Event) -> None:
        if type(event) in events:
            events[type(event)].append(event)

    with Recording(bag, config.recording) as recording:
        info = inspect_recording(recording, config, watch)
        roles = recording.roles
        map_path = find_beside(bag, "map.yaml")
        has_map = map_path is not None
        try:
            landmark_map = None if map_path is None else load_map(map_path)
        except FglocError:  # a run says what is wrong with it
            landmark_map = None
        _look_at_optional(bag, config, roles.values(), watch)
        look = FirstLook(info.roles, events, recording, has_map, landmark_map, tuple(_wheels(wheels)))
        frames = tuple(name for name in BASE_NAMES if name in recording.frames)
        return _Seen(info, has_map, frames, tuple(of.section(look) for of in wanted), others, numbers, wheels, made)


_WHEELED: frozenset[Role] = frozenset({"odometry", "joints"})
_MOST_NUMBERS = 12  # lines


def _read_by_fields(wheels: FirstWheels, made: Mapping[str, RoleFields]) -> dict[str, dict[str, dict[str, object]]]:
    """Keys of the section `recording` with joints and roles in messages of other types."""
    joints = {name: joint.model_dump(exclude_unset=True, exclude_none=True) for name, joint in wheels.joints.items()}
    fields = {role: fields.model_dump(exclude_unset=True) for role, fields in made.items()}
    return {key: found for key, found in (("joints", joints), ("fields", fields)) if found}


def _wheels(wheels: FirstWheels) -> Iterator[str]:
    """Section of wheels whose geometry was found."""
    if wheels.wheels:
        yield f"# Geometry of the joints above by this recording, {wheels.why}; measure it all the same."
        yield "wheels:"
        yield from (f"  {key}: {one_line(value)}" for key, value in wheels.wheels.items())


def _numbers(storage: Storage, known: Collection[str], taken: Collection[str]) -> tuple[NumericField, ...]:
    """Numbers on topics without a role, those first whose names are of wheels."""
    return tuple(sorted(unread_numbers(storage, known, taken), key=lambda number: not number.is_of_wheels))


_MOST_OPTIONAL = 500  # messages of such a topic


def _look_at_optional(bag: Path, config: Config, taken: Collection[str], watch: Callable[[Event], object]) -> None:
    """Show the first events of topics that are used only if a setting asks for them."""
    topics = config.recording.topics.asking(optional_roles())
    with Recording(bag, config.recording.model_copy(update={"topics": topics})) as recording:
        for role, topic in recording.roles.items():
            if role in optional_roles() and topic not in taken:
                for message in islice(recording.messages([topic]), _MOST_OPTIONAL):
                    for event in recording.decode(message, role):
                        watch(event)


def _others(bag: Path, config: Config) -> dict[Role, tuple[str, ...]]:
    """Topics of each role of an outside sensor that several topics could play, the one with most messages first."""
    with Recording(bag, config.recording) as recording:
        roles, topics = recording.roles, sorted(recording.topics, key=lambda t: (-t.count, t.name))
    found = {}
    for stream in (stream for sensor in outside_sensors() for stream in sensor.streams):
        fitting = tuple(t.name for t in topics if t.count and t.message_type in stream.converters)
        if len(fitting) > 1 and stream.role not in (*roles, *optional_roles()):
            found[stream.role] = fitting
    return found


def _with_cameras(bag: Path, config: Config) -> Config:
    """The configuration with a section for each camera, where several topics have images, or markers found in them."""
    with Recording(bag, config.recording) as recording:
        if {"image", "sightings"} & recording.roles.keys():
            return config
        topics = [t for t in recording.topics if t.count]
    # Poses of markers in messages of two types may be of one camera, those of one type are not.
    of_poses = [frozenset({kind}) for kind in converters_of("sightings") if kind not in {*_CORNERS, _RANGE_BEARING}]
    for role, kinds in (("image", _IMAGES), *(("sightings", kinds) for kinds in (_CORNERS, *of_poses))):
        there = [t.name for t in topics if t.message_type in kinds and not is_derived(t.name)]
        plain = unrectified(
            [name for name in there if name.removesuffix("/compressed") not in there or "/compressed" not in name]
        )
        if len(plain) > 1:
            cameras = {name: {role: topic} for name, topic in zip(_names(plain), plain, strict=True)}
            return config_of({"cameras": cameras})
    return config


def _names(topics: Sequence[str]) -> list[str]:
    """Names of cameras: the words by which their topics differ."""
    words = [re.findall(r"[A-Za-z0-9]+", topic) for topic in topics]
    common = set(words[0]).intersection(*words[1:])
    found = ["_".join(w for w in own if w not in common) or "camera" for own in words]
    found = [name if name[0].isalpha() else f"camera_{name}" for name in found]
    return [name if found.count(name) == 1 else f"{name}_{i}" for i, name in enumerate(found)]


def _cameras(seen: _Seen) -> Iterator[str]:
    """Section of several cameras."""
    names = dict.fromkeys(role.partition("/")[0] for role in seen.info.roles if "/" in role)
    if not names:
        return
    yield ""
    yield "cameras:  # docs/cameras.md: each has a place, a clock and a calibration of its own"
    for name in names:
        yield f"  {name}:"
        for role in CAMERA_ROLES:
            if topic := seen.info.roles.get(camera_role(name, role)):
                yield f"    {role}: {topic}"


def _recording(seen: _Seen, missing: list[str]) -> Iterator[str]:
    several = any("/" in role for role in seen.info.roles)
    yield "recording:"
    yield "  topics:  # found by message type and name; none: not used although it is there"
    for role, meaning in _MEANINGS.items():
        if several and role in CAMERA_ROLES:
            continue
        if role in seen.info.roles:
            yield f"    {role}: {seen.info.roles[role]}  # {meaning}"
        else:
            yield f"    # {role}:  # not found: {meaning}"
    for role, (first, *rest) in seen.others.items():
        yield f"    {role}: {first}  # or {', '.join(rest)}"
        missing.append(f"which topic is the {role}: {first} is taken, {', '.join(rest)} could be it too")
    for problem in seen.info.problems:
        yield f"    # to be settled: {problem}"
    for key, found in _read_by_fields(seen.wheels, seen.made).items():
        yield f"  {key}:  # in messages of other types, by the names of fields: check them"
        yield from (f"    {name}: {one_line(fields)}" for name, fields in found.items())
    numbers = () if seen.wheels.joints or "odometry" in seen.made else seen.numbers
    if numbers:
        yield "  # Fields that may be wheels' angles (position) or rates (velocity); fill in what is (docs/drives.md):"
        yield "  # joints:"
    for n in numbers[:_MOST_NUMBERS]:
        kind = "velocity" if n.is_rate else "position"
        yield f"  #   NAME: {{topic: {n.topic}, {kind}: {n.path}, scale: 1.0}}  # {n.low:.4g} to {n.high:.4g}"
    if more := len(numbers[_MOST_NUMBERS:]):
        yield f"  #   and {more} more"
    if seen.frames:
        yield f"  base_frame: {seen.frames[0]}"
    else:
        yield "  # base_frame: base_link  # no usual name is in tf"
    if "frame.unmounted" in {finding.code for finding in seen.info.found}:
        yield "  # Place of the sensor on the base, which tf lacks: x y z [m] forward, left, up; roll pitch yaw [rad]."
        yield "  # sightings_pose: [0.1, 0.0, 0.3, 0.0, 0.0, 0.0]  # looks ahead"
    timing = {role: t for t in seen.info.topics for role, topic in seen.info.roles.items() if topic == t.name}
    unstamped = {role for role, t in timing.items() if 2 * t.zero_stamps > t.count}
    other = unstamped.union(other_clocks({role: t.delay_s or 0.0 for role, t in timing.items()}))  # without stamps: 0
    if other:
        roles = ", ".join(sorted(other))
        yield f"  received_stamps: [{roles}]  # their header stamps are of another clock, or not set"
        missing.append(
            f"the header stamps of {roles} are of another clock, or not set: receive times are used, which jitter"
        )
    if "truth" in seen.info.roles:
        yield ""
        yield "# The truth's frame: the map's (none), or another one (se2: fitted, for evaluation only)."
        yield "truth:"
        yield f"  align: {'none' if seen.has_map else 'se2'}"
    else:
        missing.append(
            "no truth: the reports cannot tell how far off the poses are; to train, smooth the recordings first (their "
            "trajectories are the truth)"
        )
