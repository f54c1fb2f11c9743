"""The description of a model in its file: the JSON in the safetensors header, checked field by field."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Field, FiniteFloat, model_validator

from fgloc.config import NoiseDensity, Section
from fgloc.sensors.base import Mounting, Signal, WheelJoints
from fgloc.sensors.gyro import CHANNELS as _GYRO_CHANNELS
from fgloc.sensors.wheels.sensor import CHANNELS as _WHEEL_CHANNELS
from fgloc.types import MotionEvent, Step

FORMAT = "fgloc-motion"
VERSION = 1
CHANNELS = {c.name: c for c in sorted((*_GYRO_CHANNELS, *_WHEEL_CHANNELS), key=lambda c: c.rank)}
"""What a model may read beside commands, by name, in the order in which a network reads it."""
_OWN_INPUTS = ("commands", "sideways", "velocity")  # others are channels that sensors bring


def _known_input(name: str) -> str:
    if name not in (known := (*_OWN_INPUTS, *CHANNELS)):
        raise ValueError(f"expected one of {', '.join(known)}")
    return name


Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Matrix = tuple[Row, Row, Row]
Input = Annotated[str, AfterValidator(_known_input)]
Kind = Literal["naive", "lag", "arx", "velocity", "rate", "displacement", "gru"]
Family = Literal["naive", "velocity", "displacement"]
FAMILIES: dict[Kind, Family] = {
    "naive": "naive",
    "lag": "velocity",
    "arx": "velocity",
    "velocity": "velocity",
    "rate": "velocity",
    "displacement": "displacement",
    "gru": "displacement",
}
Positive = Annotated[FiniteFloat, Field(gt=0)]
Share = Annotated[FiniteFloat, Field(lt=1)]


class Kinematics(Section):
    """Calibrated kinematics: the robot moves as commanded, scaled, later, and drawn to one side by unequal wheels.

    The names are those of `fgloc.config.WheelsConfig`; the values were fitted on the training recordings.
    """

    scale_v: Positive = 1.0
    scale_omega: Positive = 1.0
    scale_vy: Annotated[FiniteFloat, Field(ge=0)] = Field(0.0, description="0: the robot is not commanded sideways")
    yaw_per_m: FiniteFloat = 0.0
    delay_s: Annotated[FiniteFloat, Field(ge=0, le=2.0)] = 0.0


class Lag(Section):
    """First-order response to commands, from which a velocity model's network learns the difference."""

    delay_s: Annotated[FiniteFloat, Field(ge=0, le=2.0)]
    lag_s: tuple[Positive, Positive] = Field(description="time constants of v and ω")


class ErrorMemory(Section):
    """Correlation of the errors of neighboring steps, axis by axis.

    The model's densities are those of long windows, because a chain of steps composes them as if independent. Of each
    density a share is slow, an Ornstein-Uhlenbeck rate: over a window shorter than its time constant less of it has
    shown. A negative share is what cancels again, as a command obeyed too late or the noise of a truth does: over a
    short window there is more of it.
    """

    time_s: tuple[Positive, Positive, Positive] = Field(description="time constants of x, y and yaw")
    share: tuple[Share, Share, Share] = Field(description="of x, y and yaw")

    def growth(self, window_s: float) -> Row:
        """Factors on the densities of x, y and yaw with which the covariance composed over such a window holds."""
        hidden = (-math.expm1(-window_s / time_s) * time_s / window_s for time_s in self.time_s)
        x, y, yaw = (1.0 - share * part for share, part in zip(self.share, hidden, strict=True))
        return x, y, yaw


class JointErrors(Section):
    """Error covariances of wheels (W) and model (N) over windows, and C = E[e_n e_wᵀ]; body frame at its end."""

    window_s: Positive
    W: Matrix
    N: Matrix
    C: Matrix


class Split(Section):
    """Recordings by name."""

    train: tuple[str, ...] = Field(description="weights are fitted to these")
    validation: tuple[str, ...] = Field(description="early stopping, and the covariance's scale")
    test: tuple[str, ...] = Field((), description="the model is evaluated on these")


class ModelCard(Section):
    """Description of a learned model: everything but its weights.

    ``naive``: the robot moves as commanded. A ``velocity`` model maps (v, ω, u_v, u_ω, Δt) to the velocity Δt later: a
    first-order lag plus Δt times a network. ``lag`` has no network, ``arx`` a linear one, ``rate`` no lag: its network
    is the acceleration. A ``displacement`` model maps the mean commands of the age bins ``edges_s`` and whatever else
    ``inputs`` names (``sideways``: vy of the commands in the same bins; means of measured signals over the sub-step and
    over ages before it; the velocity's innovation) to a residual twist on the best known kinematics and three
    log-variances. ``gru`` reads the bins one after the other, oldest first, by a cell of ``hidden[0]`` units.
    """

    format: Literal["fgloc-motion"] = "fgloc-motion"
    version: Literal[1] = 1
    kind: Kind
    robot: str
    inputs: tuple[Input, ...]
    dt_s: Positive = Field(description="longest sub-step: a step is cut into equal parts no longer than this")
    hidden: tuple[Annotated[int, Field(gt=0, le=4096)], ...]
    members: Annotated[int, Field(ge=1, le=64)] = Field(1, description="displacement: networks that are averaged")
    hold_s: Positive = Field(description="a command is taken to hold for this long when the next one is missing")
    history_s: Positive = Field(description="seconds of commands before a step that the model wants")
    kinematics: Kinematics = Kinematics()
    lag: Lag | None = Field(None, description="lag, arx, velocity: the known part of the response")
    edges_s: tuple[FiniteFloat, ...] = Field((), description="displacement: limits of the age bins, youngest first")
    joints: WheelJoints | None = Field(None, description="the wheels, for the inputs effort and wheels")
    signal_edges_s: tuple[FiniteFloat, ...] = Field(
        (0.0,),
        description="displacement: limits of ages before a sub-step; measured signals are averaged over it and them",
    )
    wheel_kinematics: Kinematics = Field(Kinematics(), description="true over nominal wheel motion")
    velocity_decay_s: Positive = Field(0.3, description="displacement: time constant of the velocity's innovation")
    input_mean: tuple[FiniteFloat, ...]
    input_std: tuple[Positive, ...]
    output_scale: tuple[Positive, ...]
    noise: NoiseDensity | None = Field(None, description="all but displacement and gru: densities of the error")
    variance_scale: tuple[Positive, Positive, Positive] = Field(
        (1.0, 1.0, 1.0), description="displacement: calibration of the predicted variance densities"
    )
    memory: ErrorMemory | None = Field(None, description="displacement: how long errors last; None: not at all")
    joint: JointErrors | None = None
    wheels_noise: NoiseDensity | None = Field(None, description="of the calibrated kinematics as wheel odometry")
    split: Split
    figures: dict[str, FiniteFloat] = Field({}, description="on the test recordings, or else the validation's")
    made_by: str = Field("", description="command and configuration that made the file")

    @property
    def family(self) -> Family:
        """Family of the model: naive, velocity or displacement."""
        return FAMILIES[self.kind]

    @property
    def n_inputs(self) -> int:
        """Width of the network's input that this card implies; 0 if there is no network."""
        if self.family != "displacement":
            return 0 if self.kind in ("naive", "lag") else 5
        measured = len(self.signal_edges_s) * sum(CHANNELS[name].width for name in self.measured)
        return self.n_commands * (len(self.edges_s) - 1) + measured + 2 * ("velocity" in self.inputs)

    @property
    def n_commands(self) -> int:
        """How many numbers of a command a displacement model reads: v and ω, perhaps vy."""
        return 2 + ("sideways" in self.inputs)

    @property
    def measured(self) -> tuple[str, ...]:
        """Inputs that sensors measure during the step, in the network's order."""
        return tuple(name for name in CHANNELS if name in self.inputs)

    def reads(self, name: str) -> bool:
        """Whether the model reads this channel."""
        return name in self.measured

    @property
    def n_outputs(self) -> int:
        """Width of the network's output."""
        if self.family != "displacement":
            return 0 if self.kind in ("naive", "lag") else 2
        return 6

    @model_validator(mode="after")
    def _fits_together(self) -> ModelCard:
        needed = {"commands", "velocity"} if self.family == "velocity" else {"commands"}
        if missing := needed - set(self.inputs):
            raise ValueError(f"a {self.kind} model needs the inputs {sorted(needed)}, the card lacks {sorted(missing)}")
        if (self.kind in ("naive", "lag", "arx")) == bool(self.hidden):
            raise ValueError(
                f"hidden is {self.hidden}; naive, lag and arx models have no hidden layer, others have one"
            )
        if self.family == "displacement":
            edges = self.edges_s
            if len(edges) < 2 or edges[0] < 0 or any(b <= a for a, b in pairwise(edges)):
                raise ValueError(f"expected at least two increasing ages >= 0, got {edges}")
            if self.signal_edges_s[:1] != (0.0,) or any(b <= a for a, b in pairwise(self.signal_edges_s)):
                raise ValueError(f"signal_edges_s: expected ages that increase from 0, got {self.signal_edges_s}")
        elif self.noise is None or (self.lag is None) != (self.kind in ("naive", "rate")):
            lag = "no lag" if self.kind in ("naive", "rate") else "a lag"
            raise ValueError(
                f"a {self.kind} model needs {lag} and the noise densities of its error; the card does not fit"
            )
        if self.members > 1 and self.kind != "displacement":
            raise ValueError(f"a {self.kind} model has one network, the card says {self.members}")
        for channel in (CHANNELS[name] for name in self.measured):
            if channel.needs_joints and self.joints is None:
                raise ValueError(f"the input {channel.name} needs the card's joints; it names none")
            if channel.needs_geometry and (self.joints is None or not self.joints.measured):
                raise ValueError(
                    f"the input {channel.name} needs left_radius, right_radius and track of the card's joints"
                )
        if self.family != "displacement" and set(self.inputs) - {"commands", "velocity"}:
            raise ValueError(f"a {self.kind} model reads commands and velocity, got {', '.join(self.inputs)}")
        if ("sideways" in self.inputs) != (self.kinematics.scale_vy > 0.0):
            need = "more than 0" if "sideways" in self.inputs else "0"
            given = f"kinematics.scale_vy is {self.kinematics.scale_vy:g}"
            raise ValueError(f"{given}, the inputs {', '.join(self.inputs)} need {need}")
        if self.wheel_kinematics.scale_vy > 0.0:
            raise ValueError(f"wheel_kinematics.scale_vy is {self.wheel_kinematics.scale_vy:g}, wheels' is 0")
        n_scales = self.n_outputs if self.family != "displacement" else 3
        for name, values, wanted in (
            ("input_mean", self.input_mean, self.n_inputs),
            ("input_std", self.input_std, self.n_inputs),
            ("output_scale", self.output_scale, n_scales),
        ):
            if len(values) != wanted:
                raise ValueError(f"normalization {name} has {len(values)} values, the inputs and outputs need {wanted}")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """Signals measured around a step; their times are seconds since ``origin_ns``.

    Attributes:
        origin_ns: time zero.
        by_name: signal of each channel that was wanted and is known.
    """

    origin_ns: int
    by_name: Mapping[str, Signal] = field(default_factory=dict)

    def named(self, name: str) -> Signal | None:
        """Signal of a channel, by the name that a card's inputs use; None if it is not known."""
        return self.by_name.get(name)


class SignalReader:
    """Keeps the events that a model reads, as far back as it reads them, and makes signals of them.

    Steps that do not continue the last one, by stamp or segment, begin anew: before the first event of a signal its
    first value is taken to have held.
    """

    def __init__(self, card: ModelCard, imu_up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        """Read what the card's model needs; ``imu_up`` is the base's z axis in the IMU's frame."""
        self._mounting = Mounting(card.joints, imu_up=np.asarray(imu_up, dtype=float))
        self._wanted = card.measured
        self._back_ns = round((card.signal_edges_s[-1] + card.wheel_kinematics.delay_s) * 1e9)
        self._reached: tuple[int, int] | None = None
        self._events: dict[type[MotionEvent], list[MotionEvent]] = {CHANNELS[name].event: [] for name in self._wanted}

    @property
    def back_ns(self) -> int:
        """Time before a step [ns] for which events are read; 0: none are read."""
        return self._back_ns if self._wanted else 0

    def fork(self, events: Mapping[type[MotionEvent], Sequence[MotionEvent]]) -> SignalReader:
        """A copy that may read on without changing this one, with these events in place of its own."""
        forked = copy.copy(self)
        forked._events = {kind: list(events.get(kind, ())) for kind in self._events}
        return forked

    def read(self, step: Step, gyro_bias: float = 0.0) -> Signals | str:
        """Signals over the step and the time before it that the model reads; else the name of the first with a gap."""
        if not self._wanted:
            return Signals(step.start_ns)
        continued = self._reached == (step.segment, step.start_ns)
        self._reached = (step.segment, step.stamp_ns)
        oldest = step.start_ns - self._back_ns
        for kind, events in self._events.items():
            if not continued:
                events.clear()
            _follow(events, step.of(kind), oldest)
        mounting = replace(self._mounting, gyro_bias=gyro_bias)
        found = signals_of(self._wanted, self._events, step.start_ns, mounting)
        for name in self._wanted:
            signal = found.named(name)
            if signal is None or not signal.covers(0.0, step.dt):
                return name
        return found


def signals_of(
    wanted: Sequence[str],
    events: Mapping[type[MotionEvent], Sequence[MotionEvent]],
    origin_ns: int,
    mounting: Mounting,
) -> Signals:
    """The wanted signals, as far as the events hold them.

    Args:
        wanted: names of channels.
        events: by class, in order of stamp.
        origin_ns: time zero of the signals.
        mounting: what the channels need to know of the robot.
    """
    channels = [CHANNELS[name] for name in wanted]
    made = {channel.name: channel.signal(events[channel.event], origin_ns, mounting) for channel in channels}
    return Signals(origin_ns, {name: signal for name, signal in made.items() if signal is not None})


def _follow(events: list[MotionEvent], new: Sequence[MotionEvent], oldest_ns: int) -> None:
    """Add what is new and drop what is older than the last one at or before a time."""
    last_ns = events[-1].stamp_ns if events else -1
    events.extend(e for e in new if e.stamp_ns > last_ns)
    first = 0
    while first + 1 < len(events) and events[first + 1].stamp_ns <= oldest_ns:
        first += 1
    del events[:first]
