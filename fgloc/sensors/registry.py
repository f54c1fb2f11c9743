"""All sensors, the built-in ones and those by entry point, by role and by event."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator

from fgloc.config import BESIDE, ODOMETRIES
from fgloc.extensions import outside_sensors
from fgloc.files.settings import Section
from fgloc.sensors.base import (
    BuiltIn,
    Context,
    Converter,
    FirstSettings,
    FoundRow,
    Joiner,
    Parameter,
    Sensor,
    Stream,
)
from fgloc.sensors.commands import COMMANDS, CommandInput
from fgloc.sensors.gyro import GYRO, GyroInput
from fgloc.sensors.learned.sensor import LEARNED
from fgloc.sensors.marker_pose import MARKER_POSE
from fgloc.sensors.markers.sensor import MARKERS, MarkersInput
from fgloc.sensors.measurements import LandmarkSighting
from fgloc.sensors.odometry import ODOMETRY, OdometriesInput
from fgloc.sensors.range_bearing import RANGE_BEARING, RangeBearingInput
from fgloc.sensors.wheels.events import WheelsInput
from fgloc.sensors.wheels.sensor import WHEELS
from fgloc.types import Event, RawEvent

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.sensors.failures import Carriage
    from fgloc.sensors.landmarks import SightingContext


class SensorInput(WheelsInput, OdometriesInput, CommandInput, GyroInput, MarkersInput, RangeBearingInput):
    """Methods that make the events of the built-in sensors from plain numbers."""


BUILT_IN: tuple[BuiltIn, ...] = (
    WHEELS,
    ODOMETRY,
    COMMANDS,
    GYRO,
    LEARNED,
    MARKERS,
    MARKER_POSE,
    RANGE_BEARING,
)
MOTION_INSTALLATIONS = tuple(sensor.installation for sensor in BUILT_IN if sensor.installation is not None)


def streams() -> tuple[Stream, ...]:
    """Streams of all sensors, the built-in ones first."""
    return _streams(outside_sensors())


@cache
def _streams(outside: tuple[type[Sensor], ...]) -> tuple[Stream, ...]:
    own = [stream for sensor in BUILT_IN for stream in sensor.streams]
    return (*own, *(stream for sensor in outside for stream in sensor.streams))


@cache
def _role_by_class(outside: tuple[type[Sensor], ...]) -> dict[type[Event], str]:
    return {stream.event: stream.role for stream in _streams(outside)}


def streams_of(role: str) -> tuple[Stream, ...]:
    """Streams that a role may have: for each class of events one."""
    kind = ODOMETRIES if role.startswith(BESIDE) else role
    return tuple(stream for stream in streams() if stream.role == kind)


def converters(role: str) -> Mapping[str, Converter]:
    """Converters of a role, by message type; empty if no sensor has it."""
    return _converters(role, outside_sensors())


@cache  # asked for every message
def _converters(role: str, outside: tuple[type[Sensor], ...]) -> Mapping[str, Converter]:
    return {kind: converter for stream in streams_of(role) for kind, converter in stream.converters.items()}


def usual_names(role: str) -> tuple[str, ...]:
    """Topics that are taken for a role without asking."""
    return tuple(name for stream in streams_of(role) for name in stream.usual_names)


def of_several(role: str) -> bool:
    """Whether the messages of a role may be on several topics."""
    return any(stream.several for stream in streams_of(role))


def role_of_event(event: Event) -> str | None:
    """Role of a sensor's event; None if no sensor has it."""
    return _role_by_class(outside_sensors()).get(type(event))


def events_by_sensor() -> dict[str, tuple[type[Event], ...]]:
    """Classes of events by the name that failures have for their sensor."""
    found: dict[str, tuple[type[Event], ...]] = {}
    for sensor in BUILT_IN:
        name = sensor.failing_as or sensor.name
        found[name] = (*found.get(name, ()), *(stream.event for stream in sensor.streams))
    return found | {s.name: tuple(stream.event for stream in s.streams) for s in outside_sensors()}


def _known_sensor(name: str) -> str:
    events_of(name)
    return name


SensorName = Annotated[str, AfterValidator(_known_sensor)]


def events_of(sensor: str) -> tuple[type[Event], ...]:
    """Classes of the events of a sensor, by the name that failures have for it.

    Raises:
        ValueError: there is no sensor of this name.
    """
    known = events_by_sensor()
    if sensor not in known:
        raise ValueError(f"expected one of {', '.join(known)}")
    return known[sensor]


def failures() -> tuple[type[Section], ...]:
    """Failures of all sensors."""
    sensors: tuple[BuiltIn | type[Sensor], ...] = (*BUILT_IN, *outside_sensors())
    return tuple(failure for sensor in sensors for failure in sensor.failures)


def carried(carriage: Carriage) -> dict[type[Event], Callable[[Event], Event]]:
    """Functions that change the events of a carried robot, by class; events of other classes are left as they are."""
    made: dict[type[Event], Callable[[Event], Event]] = {}
    for sensor in BUILT_IN:
        if sensor.carried is not None:
            made |= dict.fromkeys((stream.event for stream in sensor.streams), sensor.carried(carriage))
    return made


def title_of(name: str) -> str:
    """Title of a sensor in sentences; its name if it has none."""
    return next((sensor.title for sensor in BUILT_IN if sensor.name == name and sensor.title), name)


def motion_parameters(config: Config, sources: Collection[str]) -> tuple[Parameter, ...]:
    """Parameters of the motion sources in the order in which they stand in the state."""
    made = [p for installation in MOTION_INSTALLATIONS for p in installation.parameters(config, sources)]
    return tuple(sorted(made, key=lambda p: p.rank))


def found_rows(config: Config) -> Iterator[FoundRow]:
    """Rows of ``metrics.json`` that parameters of the sensors by entry point make."""
    for sensor in outside_sensors():
        rows = getattr(sensor, "found", ())
        section = getattr(config, sensor.name, None)
        yield from (() if section is None else rows(section)) if callable(rows) else rows


def first_settings() -> tuple[FirstSettings, ...]:
    """Contributions of the sensors to the first settings of an unknown robot."""
    found = (getattr(sensor, "first_settings", None) for sensor in (*BUILT_IN, *outside_sensors()))
    return tuple(settings for settings in found if settings is not None)


def detected_kinds() -> tuple[str, ...]:
    """Names of the landmark measurements that are made of raw data."""
    raw = [s for s in BUILT_IN if any(issubclass(stream.event, RawEvent) for stream in s.streams)]
    return tuple(sensor.name for sensor in raw if sensor.measured)


def measurers(context: SightingContext) -> dict[type, Callable[[Any], Iterator[LandmarkSighting]]]:
    """Functions that make measurements of the sightings of one run, by class of event."""
    made: dict[type, Callable[[Any], Iterator[LandmarkSighting]]] = {}
    for sensor in BUILT_IN:
        if sensor.measures is not None:
            made |= dict.fromkeys((stream.event for stream in sensor.streams), sensor.measures(context))
    return made


def landmark_kinds() -> tuple[str, ...]:
    """Names of all landmark measurements."""
    return tuple(sensor.name for sensor in BUILT_IN if sensor.measured)


def joiner_of(event: Event) -> Callable[[], Joiner] | None:
    """Factory of the function that continues a topic across a cut; None if its events count nothing."""
    return next((s.joined for s in BUILT_IN if any(type(event) is stream.event for stream in s.streams)), None)


def build(context_of: Mapping[str, Context]) -> tuple[Sensor, ...]:
    """The sensors by entry point for one run, of those that have a context."""
    built = (s.build(context_of[s.name]) for s in outside_sensors() if s.name in context_of)
    return tuple(sensor for sensor in built if sensor is not None)
