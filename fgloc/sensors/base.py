"""What a sensor is to the rest of fgloc: streams of events, measurements by pose, and a section of ``robot.yaml``.

A sensor in one file of another package has a subclass of each of `SensorEvent`, `PoseMeasurement`, `Section` and
`Failure`, and one class like `Sensor`, which the package declares as an entry point of the group ``fgloc.sensors``.
docs/adding-a-sensor.md goes through one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, Self

from fgloc.config import Config, GateConfig, Section
from fgloc.types import FloatArray, LandmarkMap, PoseMeasurement, SensorEvent

When = tuple[int, int, str]
"""``stamp_ns``, ``received_ns`` and topic: the first three fields of an event."""

Converter = Callable[[Any, When], SensorEvent]
"""From a decoded message (fields as the message definition names them) to an event."""

Check = Callable[[Any, GateConfig], SensorEvent | str]
"""Validates an event: the event, a repaired copy, or in one word why it is rejected."""


class Stream(NamedTuple):
    """Messages of one topic that a sensor reads.

    Attributes:
        role: key of ``recording.topics``, of the rejections, and of the topic's line in `fgloc info`.
        event: class of the events.
        converters: by message type, ``"sensor_msgs/msg/Range"``.
        usual_names: topics that are taken without asking where several have such a type.
        keyframe: whether each event gets a pose of its own; otherwise it is moved to the next pose by the wheels, which
            costs nothing within ``keyframes.max_interval_s`` unless they slip.
        check: see `Check`. Stamps are checked for every sensor alike.
    """

    role: str
    event: type[SensorEvent]
    converters: Mapping[str, Converter]
    usual_names: tuple[str, ...]
    keyframe: bool
    check: Check


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """What a sensor may know of the run before it begins.

    Attributes:
        config: all settings; the sensor's own ones are in `section`.
        section: the sensor's own settings, its ``Config``.
        roles: topic of each role that the recording has.
        landmark_map: None if there is none.
        frame: ``T_base_frame (4, 4)`` of a frame by name, as tf has it; None if tf has no such frame.
    """

    config: Config
    section: Any
    roles: Mapping[str, str]
    landmark_map: LandmarkMap | None
    frame: Callable[[str], FloatArray | None]


class Sensor(Protocol):
    """A sensor whose measurements depend on the robot's pose.

    Attributes:
        name: key of ``robot.yaml`` and name of the entry point.
        Config: the section under that key. All its values need defaults.
        streams: what it reads.
        failures: subclasses of `fgloc.ablation.failures.base.Failure`, for ``fgloc ablate``.
        notes: what the user should know, one sentence each.
    """

    name: ClassVar[str]
    Config: ClassVar[type[Section]]
    streams: ClassVar[tuple[Stream, ...]]
    failures: ClassVar[tuple[type[Section], ...]]

    @classmethod
    def build(cls, context: Context) -> Self | None:
        """The sensor of one run; None if its settings or the recording do without it.

        Raises:
            ConfigError: its settings do not fit together or not the recording.
        """
        ...

    def measure(self, event: Any) -> Iterable[PoseMeasurement]:
        """What one event (that passed its check) measured, at its own stamp."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """See above."""
        ...
