"""Ranges by radio (ultra-wideband or other) from a tag on the robot to anchors at known places.

Found by its entry point, as a sensor of another package is: docs/adding-a-sensor.md goes through this file.

A reading is a `sensor_msgs/Range` whose ``frame_id`` ends in the anchor's number ("anchor_3"). A driver with a message
of its own needs one more converter. Topics that differ by a number only (a driver's topic for each anchor) are all
read, and tell the number where ``frame_id`` has none; others are named by a pattern (``recording.topics.uwb:
/radio/*``). The settings::

    uwb:
      anchors: {1: [0.0, 0.0, 2.1], 2: [6.0, 0.0, 2.1], 3: [6.0, 5.0, 2.3]}
      tag: [0.0, 0.0, 0.3]

Where something stands between anchor and tag, the pulse arrives late and the range is too long, by decimeters to
meters. Such a range is told by the chi-square gate, against the prediction. With ``non_line_of_sight: mixture`` it is
then taken as what it says at least: too long by ``nlos_bias_m``, give or take ``nlos_sigma_m``. With ``reject`` it is
dropped.

Scale and offset that all ranges have in common are constants of the installation, estimated with the pose: Plaza's
radios measure 7 % too much, antenna delays of ultra-wideband are worth a decimeter. So are the places of anchors that
``anchors_sigma_m`` says are not known exactly. Where they are not known at all, ``fgloc map`` finds them.

Source: Olson, Agarwal 2013, "Inference on networks of mixtures for robust robot mapping".
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from fgloc.config import Config, GateConfig, Section
from fgloc.errors import ConfigError
from fgloc.sensors.base import (
    Context,
    FirstLook,
    FirstSection,
    FirstSettings,
    FoundRow,
    Parameter,
    Stream,
    UnusableMessageError,
    When,
)
from fgloc.sensors.checks import Table, count, listed
from fgloc.sensors.failures import EventFailure, Scene
from fgloc.sensors.measurements import PoseMeasurement
from fgloc.types import Event, FloatArray, Landmark, SensorEvent

_NUMBER = re.compile(r"(\d+)$")
_IN_TOPIC = re.compile(r"(\d+)\D*$")
_FARTHEST_M = 1e3  # that a radio of this kind reaches
_LEAST_ANCHORS = 3  # that tell a place in the plane
_AROUND = np.linspace(-math.pi, math.pi, 12, endpoint=False)  # of an anchor: where the search for the first pose begins
MOST_UNSURE = 40  # anchors whose places are estimated, to bound the work of a step
_Metres = Annotated[float, Field(ge=-1e5, le=1e5)]
_Sigma = Annotated[float, Field(ge=0, le=100)]
SCALE, BIAS = "uwb.range_scale", "uwb.bias_m"


# --- Settings ---------------------------------------------------------------------------------------------------------


class UwbConfig(Section):
    """Ultra-wideband ranges to anchors."""

    anchors: dict[int, tuple[_Metres, _Metres, _Metres]] = Field(
        {}, max_length=1000, description="x y z [m] in the map, by number"
    )
    anchors_sigma_m: _Sigma | dict[int, tuple[_Sigma, _Sigma, _Sigma]] = Field(
        0.0, description="sigma of their places: one for all, or x y z by number; 0: exact"
    )
    tag: tuple[_Metres, _Metres, _Metres] = Field((0.0, 0.0, 0.0), description="antenna in the base frame: x y z [m]")
    sigma_m: float = Field(0.1, ge=1e-3, le=10, description="noise of a range in line of sight")
    unit_m: float = Field(1.0, ge=1e-4, le=10, description="of the messages' ranges [m]: 0.001 for millimetres")
    scale: float = Field(1.0, ge=0.1, le=10, description="reported over true range, bias_m subtracted")
    bias_m: float = Field(0.0, ge=-10, le=10, description="subtracted from every range")
    bias_sigma_m: float = Field(0.1, ge=0, le=10, description="sigma of bias_m")
    scale_sigma: float = Field(0.05, ge=0, le=0.5, description="sigma of scale")
    non_line_of_sight: Literal["mixture", "reject"] = Field(
        "mixture", description="mixture: use too long ranges with nlos_*; reject: drop them"
    )
    nlos_bias_m: float = Field(1.0, ge=0, le=100, description="mean excess of a range without line of sight")
    nlos_sigma_m: float = Field(3.0, ge=0.01, le=100, description="sigma of this excess")

    def place_sigmas(self) -> dict[int, tuple[float, float, float]]:
        """Sigmas of x, y, z [m] of those anchors that are not known exactly."""
        given = self.anchors_sigma_m
        by_number = given if isinstance(given, dict) else dict.fromkeys(self.anchors, (given,) * 3)
        return {i: sigmas for i, sigmas in by_number.items() if i in self.anchors and any(sigmas)}


def place_parameters(anchor: int) -> tuple[str, str, str]:
    """Names of the parameters that an anchor's place is off by."""
    return f"uwb.anchor_{anchor}.x_m", f"uwb.anchor_{anchor}.y_m", f"uwb.anchor_{anchor}.z_m"


def found_rows(config: UwbConfig) -> tuple[FoundRow, ...]:
    """Rows of ``metrics.json``: scale and offset of ranges, and the places that are estimated."""
    places = (
        FoundRow(name.removesuffix("_m"), name, at, 1.0)
        for i in config.place_sigmas()
        for name, at in zip(place_parameters(i), config.anchors[i], strict=True)
    )
    return FoundRow(SCALE, SCALE, 1.0, 1.0), FoundRow(BIAS, BIAS, 0.0, 1.0), *places


# --- Events -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class UwbEvent(SensorEvent):
    """Distance of the tag from one anchor."""

    anchor: int
    range_m: float


def from_range(message: Any, when: When) -> SensorEvent:
    """From `sensor_msgs/Range`."""
    number = _NUMBER.search(message.header.frame_id.strip()) or _IN_TOPIC.search(when[2])
    if number is None:
        raise UnusableMessageError(
            f"frame_id {message.header.frame_id!r} does not end in an anchor's number (expected such as anchor_3), and "
            "the topic's name has none either: which anchor they are of is not known"
        )
    return UwbEvent(*when, int(number.group(1)), float(message.range))


def check(event: UwbEvent, gate: GateConfig) -> UwbEvent | str:
    """The event, in metres, or why it cannot be used."""
    unit_m = gate.unit_m("uwb")
    range_m = event.range_m * unit_m
    if not math.isfinite(range_m):
        return "non_finite"
    if not (range_m > 0.0 and gate.min_range <= range_m <= gate.max_range):
        return "range_bound"
    return event if unit_m == 1.0 else replace(event, range_m=range_m)


# --- Measurements -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class UwbRange(PoseMeasurement):
    """One range as a function of the robot's pose."""

    range_m: float
    anchor: FloatArray  # (3,) in the map
    tag: FloatArray  # (3,) in the base frame
    behind_obstacle: PoseMeasurement | None = None  # the same range, if it is too long
    constants: tuple[str, ...] = (SCALE, BIAS)

    def residual_at(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted minus measured range ``(1,)``, and its derivative ``(1, 3)`` by the pose."""
        residual, J, _ = self.by_constants(pose, np.zeros(2))  # anchors at their given places
        return residual, J

    def by_constants(self, pose: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residual ``(1,)`` and derivatives by pose ``(1, 3)`` and constants ``(1, c)``.

        They are scale and bias [m] of ranges and, where the anchor is not known exactly, what its place is off by [m].
        """
        x, y, yaw = pose
        c, s = math.cos(yaw), math.sin(yaw)
        tag_x, tag_y, tag_z = self.tag
        anchor = self.anchor + values[2:] if len(values) > 2 else self.anchor
        dx = x + c * tag_x - s * tag_y - anchor[0]
        dy = y + s * tag_x + c * tag_y - anchor[1]
        dz = tag_z - anchor[2]
        distance = max(math.hypot(dx, dy, dz), 1e-6)
        forward, left = (c * dx + s * dy) / distance, (c * dy - s * dx) / distance  # unit vector in the base's axes
        scale, bias = 1.0 + values[0], values[1]
        J = scale * np.array([[forward, left, left * tag_x - forward * tag_y]])
        H = np.array([[distance, 1.0, *(-scale / distance * np.array([dx, dy, dz]))][: len(values)]])
        return np.array([scale * distance + bias - self.range_m]), J, H

    def places(self) -> Iterable[FloatArray]:
        """On the circle about the anchor."""
        height = self.anchor[2] - self.tag[2]
        radius = math.sqrt(max(self.range_m**2 - height**2, 0.0))
        return (self.anchor[:2] + radius * np.array([math.cos(a), math.sin(a)]) for a in _AROUND)

    def alternatives(self, predicted: FloatArray) -> Sequence[PoseMeasurement]:
        """That something stands between, which never makes a range too short."""
        too_long = self.residual_at_keyframe(predicted)[0][0] < 0.0
        return (self.behind_obstacle,) if too_long and self.behind_obstacle is not None else ()


# --- Failure for `fgloc ablate` ---------------------------------------------------------------------------------------


class NonLineOfSight(EventFailure):
    """Ranges are too long, each by a draw of its own, exponentially distributed."""

    changes: ClassVar[tuple[type[Event], ...]] = (UwbEvent,)
    sizes: ClassVar[tuple[str, ...]] = ("mean_m",)
    kind: Literal["uwb_non_line_of_sight"] = "uwb_non_line_of_sight"
    mean_m: float = Field(1.0, gt=0, description="mean excess of a range [m]")

    def change(self, event: UwbEvent, scene: Scene) -> Event:
        """Lengthen one range."""
        return replace(event, range_m=event.range_m + scene.rng.exponential(self.mean_m))


# --- First settings ---------------------------------------------------------------------------------------------------

_FEWEST = 20  # ranges with a neighbour on either side that tell the noise
_MOST_NOISE_M = 10.0  # that `uwb.sigma_m` may be
_SPAN_S = 2.0  # of three ranges in a row that lie on a line but for noise and the robot's turns
_FAR = 1.2  # times the longest range but one in a hundred: bound of ranges


UNITS = {0.001: "millimetres", 0.01: "centimetres"}
"""Units [m] of drivers that do not give metres."""
_ROOM_M = 5.0  # that ranges reach at least


def usual_unit(ranges: Sequence[float], bound: float) -> float | None:
    """Unit [m] of ranges most of which are beyond a bound [m]; None: they are not, or it is not sure."""
    middle, reach = np.percentile(ranges, [50.0, 99.0])
    fitting = [unit for unit in UNITS if middle * unit <= bound < middle]
    return fitting[0] if len(fitting) == 1 or (fitting and reach * fitting[0] > _ROOM_M) else None


def _first_section(look: FirstLook) -> FirstSection:
    """Anchors by the map, where nothing else can see what is in it, noise and bound of the ranges."""
    events = [e for e in look.of(UwbEvent) if math.isfinite(e.range_m)]
    if not events:
        return FirstSection()
    unit_m = usual_unit([event.range_m for event in events], GateConfig().max_range) or 1.0
    events = [replace(event, range_m=event.range_m * unit_m) for event in events]
    heard = sorted({event.anchor for event in events})
    given = look.landmark_map.landmarks if look.landmark_map is not None else {}
    seen_otherwise = look.kinds & {"image", "sightings"}
    places = {} if seen_otherwise else {i: given[i] for i in heard if i in given}
    shown = ", ".join(map(str, heard[:12]))
    if len(places) >= _LEAST_ANCHORS:
        missing: tuple[str, ...] = ()
        lines = [
            "uwb:",
            "  # Nothing but ranges can see the map of this recording: its landmarks are taken for their anchors.",
            *anchor_lines(places),
        ]
    else:
        text = f"the places of the anchors {shown}, without which ranges are not used (uwb.anchors)"
        missing = (text if seen_otherwise else f"{text}; `fgloc map` finds them",)
        lines = ["uwb:", f"  # anchors: {{{heard[0]}: [0.0, 0.0, 2.0]}}  # x y z [m] in the map, of each of {shown}"]
    lines.append("  # tag: [0.0, 0.0, 0.3]  # antenna in the base frame: x y z [m]")
    if unit_m != 1.0:
        lines.append(f"  unit_m: {unit_m:g}  # by their size the ranges are in {UNITS[unit_m]}")
    sigma = noise_m(events)
    if sigma is not None and UwbConfig().sigma_m < sigma <= _MOST_NOISE_M:
        lines += ["  # By the scatter of ranges that follow one another.", f"  sigma_m: {sigma:.2g}"]
    far, usual = _FAR * float(np.percentile([event.range_m for event in events], 99.0)), GateConfig().max_range
    about = f"  # Ranges reach {far / _FAR:.0f} m."
    others = {"expert.gate": (about, f"  max_range: {math.ceil(far)}")} if usual < far < _FARTHEST_M else {}
    return FirstSection(tuple(lines), missing, others)


def anchor_lines(places: Mapping[int, Landmark]) -> list[str]:
    """Lines of the section: anchors, and their sigmas where these are known; of x and y alone the height is exact."""
    sigmas = {i: [*np.sqrt(np.diag(m.cov))[:3], 0.0][:3] for i, m in places.items() if m.cov is not None}
    rows = {i: m.position for i, m in places.items()}
    lines = ["  anchors:", *(f"    {i}: [{', '.join(f'{v:.6g}' for v in row)}]" for i, row in rows.items())]
    known = [f"    {i}: [{', '.join(f'{v:.2g}' for v in row)}]" for i, row in sigmas.items()]
    return [*lines, "  anchors_sigma_m:", *known] if known else lines


def noise_m(events: Sequence[UwbEvent]) -> float | None:
    """Standard deviation [m] of a range by its distance from the line through its neighbours; None: too few."""
    off: list[float] = []
    for number in {event.anchor for event in events}:
        own = sorted((e.stamp_ns * 1e-9, e.range_m) for e in events if e.anchor == number)
        for (t0, r0), (t1, r1), (t2, r2) in zip(own, own[1:], own[2:], strict=False):
            if t1 - t0 > 0.0 and t2 - t1 > 0.0 and t2 - t0 < _SPAN_S:
                w = (t1 - t0) / (t2 - t0)
                off.append((r1 - (1.0 - w) * r0 - w * r2) / math.sqrt(1.0 + w**2 + (1.0 - w) ** 2))
    return None if len(off) < _FEWEST else 1.4826 * float(np.median(np.abs(off)))


# --- For `fgloc info` -------------------------------------------------------------------------------------------------

_MOST_NUMBERS = 1000  # that are kept: damaged messages have any


class UwbChecks:
    """Checks of a topic of ranges: anchors that the settings do not have, and ranges that will be rejected."""

    def __init__(self) -> None:
        self._heard: set[int] = set()
        self._ranges = Table(1)

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, UwbEvent)
        if len(self._heard) < _MOST_NUMBERS:
            self._heard.add(event.anchor)
        self._ranges.add(event.range_m)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each."""
        section: UwbConfig = getattr(config, Uwb.name, UwbConfig())
        found, gate = [], config.gate
        unknown = self._heard - section.anchors.keys()
        if section.anchors and unknown != self._heard and unknown:
            silent = section.anchors.keys() - self._heard
            more = f", of which {listed(silent)} are not heard on this topic" if silent else ""
            found.append(
                f"{topic}: ranges to anchors {listed(unknown)} are not used, as uwb.anchors has "
                f"{listed(section.anchors)}{more}: give their places."
            )
        ranges = self._ranges.array()[:, 0] * section.unit_m
        if (bad := ~np.isfinite(ranges)).any():
            found.append(f"{topic}: {count(bad)} ranges are NaN or infinite and will be rejected.")
        if (bad := np.isfinite(ranges) & ~((ranges >= gate.min_range) & (ranges <= gate.max_range))).any():
            low, high = np.min(ranges[bad]), np.max(ranges[bad])
            found.append(
                f"{topic}: {count(bad)} ranges ({low:.4g} to {high:.4g} m) are not between {gate.min_range:g} and "
                f"{gate.max_range:g} m and will be rejected: raise expert.gate.max_range if they are right, or set "
                "uwb.unit_m (0.001 for millimetres, 0.01 for centimetres)."
            )
        return found


# --- The sensor -------------------------------------------------------------------------------------------------------


class Uwb:
    """Ultra-wideband ranges to anchors."""

    name: ClassVar[str] = "uwb"
    needs: ClassVar[str] = "anchors"  # the setting without which it is not built
    Config: ClassVar[type[Section]] = UwbConfig
    streams: ClassVar[tuple[Stream, ...]] = (
        Stream(
            "uwb",
            UwbEvent,
            {"sensor_msgs/msg/Range": from_range},
            ("uwb", "uwb/range"),
            check=check,
            findings=UwbChecks,
            several=True,
        ),
    )
    failures: ClassVar[tuple[type[Section], ...]] = (NonLineOfSight,)
    first_settings: ClassVar[FirstSettings] = FirstSettings((UwbEvent,), _first_section)
    found: ClassVar[Callable[[UwbConfig], tuple[FoundRow, ...]]] = staticmethod(found_rows)

    def __init__(self, config: UwbConfig) -> None:
        self._config = config
        self._sigmas = config.place_sigmas()
        self._anchors: Mapping[int, FloatArray] = {i: np.array(place) for i, place in config.anchors.items()}
        self._tag = np.array(config.tag)
        self._unknown: set[int] = set()

    @classmethod
    def build(cls, context: Context) -> Uwb | None:
        """The sensor of one run; None if no anchors are given.

        Raises:
            ConfigError: fewer anchors than tell a place, or more that are not known exactly than can be estimated.
        """
        config = context.section
        if not config.anchors:
            return None
        if len(config.anchors) < _LEAST_ANCHORS and context.landmark_map is None:
            raise ConfigError(
                f"uwb.anchors has {len(config.anchors)} anchor(s), expected at least {_LEAST_ANCHORS} where no map "
                "says where the robot is; give all that are installed"
            )
        if len(unsure := config.place_sigmas()) > MOST_UNSURE:
            raise ConfigError(
                f"uwb.anchors_sigma_m is of {len(unsure)} anchors, expected at most {MOST_UNSURE}, as each makes a "
                "step longer; give it by number, of those that are known least"
            )
        return cls(config)

    def measure(self, event: UwbEvent) -> Iterable[UwbRange]:
        """One range, if its anchor is known."""
        anchor = self._anchors.get(event.anchor)
        if anchor is None:
            if len(self._unknown) < 100:
                self._unknown.add(event.anchor)
            return
        config = self._config
        in_sight = UwbRange(
            source="uwb",
            stamp_ns=event.stamp_ns,
            cov=np.array([[config.sigma_m**2]]),
            target=event.anchor,
            range_m=(event.range_m - config.bias_m) / config.scale,
            anchor=anchor,
            tag=self._tag,
            constants=(SCALE, BIAS, *(place_parameters(event.anchor) if event.anchor in self._sigmas else ())),
        )
        if config.non_line_of_sight == "reject":
            yield in_sight
            return
        range_m, cov = in_sight.range_m - config.nlos_bias_m, np.array([[config.nlos_sigma_m**2]])
        yield replace(in_sight, behind_obstacle=replace(in_sight, source="uwb_nlos", range_m=range_m, cov=cov))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Scale and offset of all ranges, and places of anchors."""
        config = self._config
        places = [zip(place_parameters(i), sigmas, strict=True) for i, sigmas in self._sigmas.items()]
        return (
            Parameter(SCALE, config.scale_sigma, effects=("length",)),
            Parameter(BIAS, config.bias_sigma_m),
            *(Parameter(name, sigma) for place in places for name, sigma in place),
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Which anchors are not in the settings."""
        if not self._unknown:
            return ()
        numbers = ", ".join(map(str, sorted(self._unknown)[:12]))
        return (f"Ranges to anchors that uwb.anchors does not have are not used: {numbers}.",)
