"""Interfaces of a sensor: streams of events, measurements as functions of the pose, a section of ``robot.yaml``.

A sensor in one file of another package has a subclass of each of `SensorEvent`, `PoseMeasurement`, `Section` and
`Failure`, and one class like `Sensor`, which the package declares as an entry point of the group ``fgloc.sensors``.
docs/adding-a-sensor.md goes through one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, FiniteFloat

from fgloc.files.settings import Section
from fgloc.sensors.checks import Collector, FieldChecks, TimingOnly
from fgloc.sensors.measurements import LandmarkMeasurement, LandmarkSighting
from fgloc.types import Event, FloatArray, InstallationFound, LandmarkMap, MotionEvent, Setting

if TYPE_CHECKING:
    from fgloc.config import Config, GateConfig


# --- signals over time ------------------------------------------------------------------------------------------------

MAX_GAP_S = 0.25  # a signal without a sample for longer has a gap
_FOREVER_S = 1e4  # the first and the last values hold on; the caller decides whether to use them


class Signal:
    """One or more channels over time, integrated once so that any mean is two look-ups per channel."""

    def __init__(self, times_s: FloatArray, integrals: FloatArray) -> None:
        """Take the integrals.

        Args:
            times_s: ``(n,)`` increasing, at least two.
            integrals: ``(c, n)`` of the channels up to these times; between them each channel is constant.
        """
        n = len(times_s)
        self._times = np.empty(n + 2)
        self._times[1:-1] = times_s
        self._times[0], self._times[-1] = times_s[0] - _FOREVER_S, times_s[-1] + _FOREVER_S
        self._integrals = np.empty((len(integrals), n + 2))
        self._integrals[:, 1:-1] = integrals
        first = (integrals[:, 1] - integrals[:, 0]) / (times_s[1] - times_s[0])
        last = (integrals[:, -1] - integrals[:, -2]) / (times_s[-1] - times_s[-2])
        self._integrals[:, 0] = integrals[:, 0] - _FOREVER_S * first
        self._integrals[:, -1] = integrals[:, -1] + _FOREVER_S * last

    @classmethod
    def of_samples(cls, times_s: FloatArray, values: FloatArray) -> Signal:
        """Make a signal of samples ``(c, n)``, joined by straight lines."""
        integrals = np.zeros(values.shape)
        np.cumsum(0.5 * (values[:, 1:] + values[:, :-1]) * np.diff(times_s), axis=1, out=integrals[:, 1:])
        return cls(times_s, integrals)

    def integrals(self, times_s: FloatArray) -> FloatArray:
        """Integrals of the channels ``(c, ...)`` up to times ``(...)``."""
        return np.array([np.interp(times_s, self._times, channel) for channel in self._integrals])

    def covers(self, start_s: float, end_s: float) -> bool:
        """Whether no moment between these times is farther than `MAX_GAP_S` from a sample."""
        times = self._times[1:-1]
        first = max(0, int(np.searchsorted(times, start_s, "right")) - 1)
        inside = times[first : int(np.searchsorted(times, end_s, "left")) + 1]
        if not len(inside) or inside[0] > start_s + MAX_GAP_S or inside[-1] < end_s - MAX_GAP_S:
            return False
        return bool((np.diff(inside) <= MAX_GAP_S).all())

    def means(self, limits_s: FloatArray) -> FloatArray:
        """Means ``(..., m - 1, c)`` between neighboring limits ``(..., m)``, strictly monotonic along the last axis."""
        means = np.diff(self.integrals(limits_s)) / np.diff(limits_s)
        return np.ascontiguousarray(np.moveaxis(means, 0, -1))


def of_stamps(stamps: Sequence[int], values: FloatArray, origin_ns: int) -> Signal | None:
    """Signal of samples ``(c, n)`` at stamps [ns], joined by straight lines; None with fewer than two samples."""
    return Signal.of_samples(seconds(stamps, origin_ns), values) if len(stamps) > 1 else None


def seconds(stamps: Sequence[int], origin_ns: int) -> FloatArray:
    """Stamps [ns] as times ``(n,)`` [s] since an origin."""
    return np.array([stamp - origin_ns for stamp in stamps]) * 1e-9


# --- parts of ROS messages --------------------------------------------------------------------------------------------


def nanoseconds(stamp: Any) -> int:
    """Time [ns] of a ``builtin_interfaces/Time``."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def xyz(v: Any) -> FloatArray:
    """Array ``(3,)`` of a message's vector or point."""
    return np.array((v.x, v.y, v.z), dtype=float)


def xyzw(q: Any) -> FloatArray:
    """Array ``(4,)`` of a message's quaternion: x, y, z, w."""
    return np.array((q.x, q.y, q.z, q.w), dtype=float)


def vector(values: Any) -> FloatArray:
    """Float array ``(n,)`` of a message's numbers."""
    return np.asarray(values, dtype=float)


def matrix(values: Any, n: int) -> FloatArray:
    """Float array ``(n, n)`` of a message's numbers, which are stored row by row."""
    return np.asarray(values, dtype=float).reshape(n, n)


def byte_array(values: Any) -> NDArray[np.uint8]:
    """Array ``(n,)`` of a message's bytes."""
    return np.asarray(values, dtype=np.uint8)


# --- the first settings of a robot ------------------------------------------------------------------------------------


E = TypeVar("E", bound=Event)


@dataclass(frozen=True, slots=True)
class FirstLook:
    """Content of a recording of an unknown robot, from which a sensor's first settings are made.

    Attributes:
        roles: topic by role.
        events: by class, of the classes that the sensor asked for.
        recording: opened.
        has_map: a map lies beside it.
        landmark_map: that map; None where it cannot be read.
        wheels: lines of the section of the wheels, where the geometry of joints by their fields was found.
    """

    roles: Mapping[str, str]
    events: Mapping[type[Event], Sequence[Event]]
    recording: Any
    has_map: bool
    landmark_map: LandmarkMap | None = None
    wheels: tuple[str, ...] = ()

    def of(self, kind: type[E]) -> list[E]:
        """Events of a class that the sensor asked for."""
        return [event for event in self.events[kind] if isinstance(event, kind)]

    @property
    def kinds(self) -> set[str]:
        """Roles, without the names of cameras."""
        return {role.rpartition("/")[2] for role in self.roles}


@dataclass(frozen=True, slots=True)
class Question:
    """One thing that a user is asked for.

    Attributes:
        text: what it is, with its unit.
        keys: settings that the answer becomes, such as ``wheels.track``.
        most: the answer is a number above zero, up to this; None: it is a name.
        among: the names that can be given; empty: any.
    """

    text: str
    keys: tuple[str, ...]
    most: float | None = None
    among: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Asked:
    """Questions whose answers, together, settle what the recording does not determine.

    Attributes:
        missing: the sentence of `FirstSection.missing` that they settle.
        questions: about it.
        lines: further settings of the section that come with the answers.
        replaced: lines of the section that go: it was commented out, to be filled in.
    """

    missing: str
    questions: tuple[Question, ...]
    lines: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FirstSection:
    """Lines of a section of ``robot.yaml``, and sentences on values that the recording does not determine.

    Attributes:
        lines: of the section, from its head.
        missing: sentences.
        others: lines of other sections, by the section's dotted name.
        asked: questions about what is missing.
    """

    lines: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    asked: tuple[Asked, ...] = ()


@dataclass(frozen=True, slots=True)
class FirstSettings:
    """Contribution of a sensor to the first settings: the events it needs, and the function that makes its section."""

    events: tuple[type[Event], ...]
    section: Callable[[FirstLook], FirstSection]


class UnusableMessageError(ValueError):
    """A message that is decoded, but lacks what the sensor needs; the sentence goes to the user."""


# --- sensors ----------------------------------------------------------------------------------------------------------

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
        several: whether each message says what it is of, so that the messages may be on a topic for each.
    """

    role: str
    event: type[Event]
    converters: Mapping[str, Converter]
    usual_names: tuple[str, ...]
    keyframe: bool = False
    check: Check | None = None
    validator: Validator | None = None
    findings: Callable[[], Collector] = TimingOnly
    several: bool = False

    def validate(self, checks: FieldChecks) -> Callable[[Any], Event | str]:
        """Return the function that checks the events of one run."""
        if self.validator is not None:
            return self.validator(checks)
        check = self.check
        return (lambda event: event) if check is None else (lambda event: check(event, checks.config))


class RawMistake(NamedTuple):
    """Mistake in the settings of a sensor, as a recording shows it.

    Attributes:
        code: of the finding.
        sentence: for the user.
        section: of ``robot.yaml``.
        values: that undo it; empty where no settings do.
        grave: whether the poses would be wrong, or there would be none.
    """

    code: str
    sentence: str
    section: str
    values: Mapping[str, object]
    grave: bool = True


Joiner = Callable[[Event, int], Event]
"""Makes the events of one topic count on across cuts; the second argument is what was cut out before it so far [ns]."""


@dataclass(frozen=True, slots=True)
class Turn:
    """Turn of the robot over a step, with variances.

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


class Rank(IntEnum):
    """Rank of a parameter of the installation in the order of the state."""

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
        gate_sigma: by so much it may change between runs; its gate is of this sigma, where the prior's is less.
    """

    name: str
    sigma: float
    rank: Rank = Rank.GAIN
    effects: tuple[str, ...] = ()
    lengthens: bool = False
    gate_sigma: float = 0.0


class FoundRow(NamedTuple):
    """A value of ``metrics.json`` that a parameter makes: ``at + gain * parameter``."""

    name: str
    parameter: str
    at: float
    gain: float


class InstallationState:
    """Estimate of the installation by a run, from which sensors make settings."""

    def __init__(self, found: InstallationFound) -> None:
        self.index = {name: i for i, name in enumerate(found.names)}
        self.mean, self.cov, self.prior = found.mean, found.cov, found.prior_cov

    def value(self, name: str) -> float:
        """Value of a parameter; 0 if it is not in the state."""
        return float(self.mean[self.index[name]]) if name in self.index else 0.0

    def setting(self, name: str, given: float, found: float, gains: Mapping[str, float]) -> Iterator[Setting]:
        """Yield a setting that depends on parameters with these derivatives; nothing if none is in the state."""
        gains = {key: g for key, g in gains.items() if key in self.index}
        if gains:
            rows, g = [self.index[key] for key in gains], np.array(list(gains.values()))
            sigmas = [math.sqrt(g @ cov[np.ix_(rows, rows)] @ g) for cov in (self.cov, self.prior)]
            yield Setting(name, given, found, *sigmas)


@dataclass(frozen=True, slots=True)
class MotionInstallation:
    """The parameters of one motion source.

    Attributes:
        parameters: with their priors, from all settings and the names of the motion sources that there are.
        found: rows of ``metrics.json``, from all settings.
        settings: the lines of ``robot.yaml`` that a run makes of what it found.
        sigmas: the setting that takes the sigma of another one back, by that one; "": none does, as it changes again.
    """

    parameters: Callable[[Config, Collection[str]], tuple[Parameter, ...]]
    found: Callable[[Config], tuple[FoundRow, ...]]
    settings: Callable[[InstallationState, Config], Iterator[Setting]]
    sigmas: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class BuiltIn:
    """Description of a built-in sensor: the counterpart of `Sensor`, which those by entry point implement.

    Attributes:
        name: of its rows in ``steps.csv``, and in the counts.
        streams: what it reads.
        title: in sentences; "": its name.
        failing_as: by what name failures call it; "": by its own.
        failures: subclasses of `fgloc.sensors.failures.Failure`, for ``fgloc ablate``.
        carried: from a `fgloc.sensors.failures.Carriage` to what it measures while the robot is carried: an event of
            its streams is changed. None: nothing is special about it.
        measures: from a `fgloc.sensors.landmarks.SightingContext` to what makes measurements of its events; None: it
            sees no landmarks.
        measured: classes of measurements that have its name in ``steps.csv``.
        joined: makes its events count on across a piece of the recording that was cut out; None: they count nothing.
        installation: what it is off by, if it measures motion.
        first_settings: what ``fgloc init`` writes of it; None: nothing.
    """

    name: str
    streams: tuple[Stream, ...] = ()
    title: str = ""
    failing_as: str = ""
    failures: tuple[type[Any], ...] = ()
    carried: Callable[[Any], Callable[[Event], Event]] | None = None
    joined: Callable[[], Joiner] | None = None
    installation: MotionInstallation | None = None
    measures: Callable[[Any], Callable[[Any], Iterator[LandmarkSighting]]] | None = None
    measured: tuple[type[LandmarkSighting], ...] = ()
    first_settings: FirstSettings | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """Facts of a run that a sensor is given before the run begins.

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
    """A sensor whose measurements depend on the robot's pose: of landmarks of the map, or of places of its own.

    Attributes:
        name: key of ``robot.yaml`` and name of the entry point.
        Config: the section under that key. All its values need defaults.
        streams: what it reads.
        failures: subclasses of `fgloc.sensors.failures.Failure`, for ``fgloc ablate``.
        notes: what the user should know, one sentence each.

    A sensor whose measurements depend on constants (`PoseMeasurement.constants`) has a property ``parameters`` too: a
    `Parameter` for each, named ``sensor.constant``, with the sigma of its prior about 0; a tuple ``found`` of
    `FoundRow`, or a function of the section that makes one, brings them into ``metrics.json``. ``first_settings``
    (`FirstSettings`) is its part of ``fgloc init``.

    Further class attributes that a sensor may have: ``needs``, the key of its section without which it is not built;
    ``optional``, topics get its roles only where that is given, as most of their type hold nothing for it;
    ``purpose``, what one gives it for, as a sentence of ``fgloc info`` says it (with ``optional``); ``uses_map``: it
    has ``needs``, but no places of its own.
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

    def measure(self, event: Any) -> Iterable[LandmarkMeasurement]:
        """Measurements of one event that has passed its check, at the event's own stamp."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user, one sentence each."""
        ...


# --- inputs of motion models ------------------------------------------------------------------------------------------

_Positive = Annotated[FiniteFloat, Field(gt=0)]
_Radius = Annotated[FiniteFloat, Field(description="m, negative: it counts backwards; for the input wheels")]


class WheelJoints(Section):
    """Joints of two driven wheels, and their geometry."""

    left: str | None = Field(None, description="joint of the left wheel; None: the one named so")
    right: str | None = None
    left_radius: _Radius | None = None
    right_radius: _Radius | None = None
    track: _Positive | None = None

    @property
    def measured(self) -> bool:
        """Whether radii and track are known."""
        return None not in (self.left_radius, self.right_radius, self.track)


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Facts of the robot that a channel may need.

    Attributes:
        joints: of the wheels; None: not known.
        gyro_bias: one number, or one for each inertial event [rad/s].
        imu_up: ``(3,)`` the base's z axis in the axes of the inertial unit.
    """

    joints: WheelJoints | None = None
    gyro_bias: ArrayLike = 0.0
    imu_up: ArrayLike = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One input of a motion model, as a sensor measures it.

    Attributes:
        name: in the card of a model.
        width: how many numbers it has at one time.
        rank: its place among the channels that a network reads. Model files depend on it.
        event: class of the events that it is made of.
        signal: of events in order of stamp, since a time [ns]; None where they do not give it.
        needs_joints: whether it takes the names of the wheels' joints.
        needs_geometry: whether it takes their geometry too.
    """

    name: str
    width: int
    rank: int
    event: type[MotionEvent]
    signal: Callable[[Sequence[Any], int, Mounting], Signal | None]
    needs_joints: bool = False
    needs_geometry: bool = False


# --- events from plain numbers ----------------------------------------------------------------------------------------

BASE, SENSOR = "base_link", "sensor"
"""Frames of what is given without a frame: the robot's base, and the sensor of landmarks."""


class EventInput:
    """Base of the classes whose methods make a sensor's events; `Live` is all of them together."""

    def _deliver(self, event: Event) -> None:
        """Pass on an event that one of the methods has made."""
        raise NotImplementedError

    def _when(self, role: str, stamp_ns: int) -> When:
        """Stamp as the configuration corrects it, receive time and topic of a role."""
        raise NotImplementedError


def with_values(config: Config, section: str, values: Mapping[str, Any]) -> Config:
    """Return the settings with some values of one section replaced; ``drive.radius`` is one within another section."""
    own = getattr(config, section)
    for key in [key for key in values if "." in key]:
        inner, _, name = key.partition(".")
        part = values.get(inner, getattr(own, inner)).model_copy(update={name: values[key]})
        values = {k: v for k, v in values.items() if k != key} | {inner: part}
    return config.model_copy(update={section: own.model_copy(update=values)})
