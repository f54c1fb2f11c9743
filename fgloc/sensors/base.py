"""What a sensor is to the rest of fgloc: streams of events, measurements by pose, and a section of ``robot.yaml``.

A sensor in one file of another package has a subclass of each of `SensorEvent`, `PoseMeasurement`, `Section` and
`Failure`, and one class like `Sensor`, which the package declares as an entry point of the group ``fgloc.sensors``.
docs/adding-a-sensor.md goes through one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self

from fgloc.sensors.field_checks import FieldChecks
from fgloc.sensors.first_settings import FirstSettings
from fgloc.sensors.topic_checks import Collector, TimingOnly
from fgloc.types import Event, FloatArray, LandmarkMap, LandmarkSighting, PoseMeasurement, Setting

if TYPE_CHECKING:
    from fgloc.config import Config, GateConfig, Section
    from fgloc.sensors.channels import Channel
    from fgloc.sensors.roles import MotionSource, RawLandmarksRole

When = tuple[int, int, str]
"""``stamp_ns``, ``received_ns`` and topic: the first three fields of an event."""

Converter = Callable[[Any, When], Event]
"""From a decoded message (fields as the message definition names them) to an event."""

Check = Callable[[Any, "GateConfig"], Event | str]
"""Validates an event: the event, a repaired copy, or in one word why it is rejected."""

Validator = Callable[[FieldChecks], Callable[[Any], Event | str]]
"""Makes a `Check` for one run that counts the parts it rejects, or tells the user what it assumed."""


class Stream(NamedTuple):
    """Messages of one topic that a sensor reads.

    Attributes:
        role: key of ``recording.topics``, of the rejections, and of the topic's line in `fgloc info`.
        event: class of the events.
        converters: by message type, ``"sensor_msgs/msg/Range"``.
        usual_names: topics that are taken without asking where several have such a type.
        keyframe: whether each event gets a pose of its own; otherwise it is moved to the next pose by the wheels, which
            costs nothing within ``keyframes.max_interval_s`` unless they slip. Events of motion never get one.
        check: see `Check`. Stamps are checked for every sensor alike.
        validator: takes the place of the check where a run's counts and notes are needed.
        findings: what looks wrong with the topic of a recording, for ``fgloc info``.
    """

    role: str
    event: type[Event]
    converters: Mapping[str, Converter]
    usual_names: tuple[str, ...]
    keyframe: bool = False
    check: Check | None = None
    validator: Validator | None = None
    findings: Callable[[], Collector] = TimingOnly

    def validate(self, checks: FieldChecks) -> Callable[[Any], Event | str]:
        """What judges the events of one run."""
        if self.validator is not None:
            return self.validator(checks)
        check = self.check
        return _unchecked if check is None else partial(_checked, check, checks.config)


def _unchecked(event: Event) -> Event | str:
    return event


def _checked(check: Check, config: GateConfig, event: Any) -> Event | str:
    return check(event, config)


class RawMistake(NamedTuple):
    """What a recording shows to be wrong with the settings of a sensor.

    Attributes:
        sentence: for the user.
        section: of ``robot.yaml``.
        values: that undo it; empty where no settings do.
    """

    sentence: str
    section: str
    values: Mapping[str, object]


class Joined(Protocol):
    """One topic without a jump where a piece of the recording was cut out."""

    def join(self, event: Event, shift: int) -> Event:
        """The event as if nothing had been cut out before it; ``shift`` is how much was [ns]."""
        ...


@dataclass(frozen=True, slots=True)
class Turn:
    """How far the robot turned over a step.

    Attributes:
        yaw: [rad], rid of the bias.
        variance: [rad²], of the noise and of what the bias may be off.
        noise: [rad²], of the noise alone.
        noise_density: [rad²/s], of the same.
    """

    yaw: float
    variance: float
    noise: float = 0.0
    noise_density: float = 0.0


class MotionRole(StrEnum):
    """What a motion source is to the others."""

    ODOMETER = "odometer"  # always there, and what others are compared to
    MODEL = "model"  # predicts the motion from control inputs
    RATE = "rate"  # measures the turn alone


class Rank(IntEnum):
    """Where a parameter of the installation stands in the state."""

    GAIN = 0
    CLOCK = 1
    MODEL = 2


class Parameter(NamedTuple):
    """A parameter of the installation that motions depend on.

    Attributes:
        name: ``sensor.parameter``.
        sigma: of the prior; 0: it is exact.
        rank: its place among the parameters of all sensors.
        effects: what it changes: "length" (distances), "turn", "heading" (where landmarks are seen while the robot
            turns). Parameters of one effect may be taken for one another.
        lengthens: whether it is one of those that, changed alike, make motions longer and leave turns as they are.
    """

    name: str
    sigma: float
    rank: Rank = Rank.GAIN
    effects: tuple[str, ...] = ()
    lengthens: bool = False


class FoundRow(NamedTuple):
    """A value of ``metrics.json`` that a parameter makes: ``at + gain * parameter``."""

    name: str
    parameter: str
    at: float
    gain: float


class InstallationState(Protocol):
    """What a run has found of the installation."""

    def value(self, name: str) -> float:
        """Of a parameter; 0 if it is no state."""

    def setting(self, name: str, given: float, found: float, gains: Mapping[str, float]) -> Iterator[Setting]:
        """A setting that depends on parameters with these derivatives; none if it depends on no state."""


@dataclass(frozen=True, slots=True)
class MotionInstallation:
    """The parameters of one motion source.

    Attributes:
        parameters: with their priors, from all settings and the roles that there are.
        found: rows of ``metrics.json``, from all settings.
        settings: the lines of ``robot.yaml`` that a run makes of what it found.
        sigmas: the setting that takes the sigma of another one back, by that one.
    """

    parameters: Callable[[Config, Collection[MotionRole]], tuple[Parameter, ...]]
    found: Callable[[Config], tuple[FoundRow, ...]]
    settings: Callable[[InstallationState, Config], Iterator[Setting]]
    sigmas: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class BuiltIn:
    """What a sensor of fgloc itself brings: as much of `Sensor` as it shares with those of other packages.

    Attributes:
        name: of its rows in ``steps.csv``, and in the counts.
        streams: what it reads.
        title: in sentences; "": its name.
        motion: its role as a motion source; None: it is none.
        raw_landmarks: its role as what finds landmarks in raw data; None: it does not.
        channels: what it offers to motion models as inputs.
        mistakes: what the first messages of a recording show to be wrong with its settings.
        failing_as: by what name failures call it; "": by its own.
        failures: subclasses of `fgloc.sensors.failures.Failure`, for ``fgloc ablate``.
        carried: from a `fgloc.sensors.failures.Carriage` to what it measures while the robot is carried: an event of
            its streams is changed. None: nothing is special about it.
        measures: from a `fgloc.sensors.landmarks.SightingContext` to what makes measurements of its events; None: it
            sees no landmarks.
        measured: classes of measurements that have its name in ``steps.csv``.
        joined: makes its events count on across a piece of the recording that was cut out; None: they count nothing.
        first_settings: what ``fgloc init`` writes of it; None: nothing.
    """

    name: str
    streams: tuple[Stream, ...] = ()
    title: str = ""
    motion: MotionSource | None = None
    raw_landmarks: RawLandmarksRole | None = None
    channels: tuple[Channel, ...] = ()
    mistakes: Callable[[Sequence[Event], Config], tuple[RawMistake, ...]] | None = None
    failing_as: str = ""
    failures: Callable[[], tuple[type[Any], ...]] = tuple
    carried: Callable[[Any], Callable[[Event], Event]] | None = None
    joined: Callable[[], Joined] | None = None
    measures: Callable[[Any], Callable[[Any], Iterator[LandmarkSighting]]] | None = None
    measured: tuple[type[LandmarkSighting], ...] = ()
    first_settings: FirstSettings | None = None


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
        failures: subclasses of `fgloc.sensors.failures.Failure`, for ``fgloc ablate``.
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
