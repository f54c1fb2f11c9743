"""Reflectors of the map as a laser scanner sees them: bright spots without identity.

Found by its entry point, as a sensor of another package is (docs/adding-a-sensor.md).

Reads `sensor_msgs/LaserScan` with intensities. Bright beams next to each other are one hit, with range and bearing;
which beacon of the map it is of is decided by the predicted pose (`fgloc.estimation.unnamed`). The settings::

    reflectors:
      min_intensity: 200.0        # of the beams that a reflector returns
      pose: [1.20, 0.0, 0.0]      # x y [m], yaw [rad] of the scanner in the base frame

The reflectors are the points of the map: landmarks without an orientation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from fgloc.config import Config, GateConfig, Section
from fgloc.errors import ConfigError
from fgloc.frames import homogeneous, rpy_matrix
from fgloc.sensors.base import Context, FirstLook, FirstSection, FirstSettings, Stream, When
from fgloc.sensors.measurements import UNNAMED, LandmarkMeasurement, PointMeasurement
from fgloc.types import Event, FloatArray, SensorEvent

_Metres = Annotated[float, Field(ge=-100, le=100)]
_MOST_TURN_S = 1.0  # that a scanner takes for one scan
_FARTHEST_M = 500.0  # that a scanner sees a reflector
_MOST_HITS = 64  # in one scan: of more, what is bright is not a reflector


# --- Settings ---------------------------------------------------------------------------------------------------------


class ReflectorsConfig(Section):
    """Reflectors seen by a laser scanner."""

    min_intensity: float | None = Field(
        None, gt=0, le=1e9, description="of a beam from a reflector; None: none is used"
    )
    size_m: float = Field(
        0.3,
        ge=0.01,
        le=5,
        description="largest reflector; nearer bright beams are one",
    )
    radius_m: float = Field(0.0, ge=0, le=2, description="of round reflectors: added to ranges")
    pose: tuple[_Metres, _Metres, Annotated[float, Field(ge=-7, le=7)]] | None = Field(
        None, description="x y [m], yaw [rad] of the scanner in the base frame; None: tf, else the base"
    )
    range_sigma_m: float = Field(0.03, ge=1e-3, le=10, description="noise of the distance")
    bearing_sigma_rad: float = Field(0.005, ge=1e-4, le=1, description="noise of the direction")


# --- Events -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ScanEvent(SensorEvent):
    """One turn of a laser scanner; beams without an echo within the scanner's range are NaN."""

    frame_id: str
    first_rad: float  # bearing of the first beam, counter-clockwise from the scanner's x axis
    step_rad: float  # from beam to beam
    step_s: float  # likewise; 0: all at the stamp
    ranges: FloatArray  # (n,) m
    intensities: FloatArray  # (n,); (0,) if the message has none


def from_scan(message: Any, when: When) -> SensorEvent:
    """From `sensor_msgs/LaserScan`."""
    ranges = np.array(message.ranges, dtype=float)
    ranges[~((ranges >= message.range_min) & (ranges <= min(message.range_max, _FARTHEST_M)))] = np.nan
    return ScanEvent(
        *when,
        message.header.frame_id,
        float(message.angle_min),
        float(message.angle_increment),
        float(message.time_increment),
        ranges,
        np.array(message.intensities, dtype=float),
    )


def check(event: ScanEvent, gate: GateConfig) -> ScanEvent | str:
    """The event, or why it cannot be used."""
    if not math.isfinite(event.first_rad + event.step_rad + event.step_s):
        return "non_finite"
    if max(abs(event.first_rad), abs(event.step_rad)) > 2.0 * math.tau:
        return "bearing_bound"
    if abs(event.step_s) * len(event.ranges) > _MOST_TURN_S:
        return "beam_time"
    if not len(event.intensities):
        return "no_intensities"
    return event if len(event.intensities) == len(event.ranges) else "malformed"


# --- Hits -------------------------------------------------------------------------------------------------------------


class Hit(PointMeasurement):
    """One bright spot, by range and bearing from the base; which beacon it is of the map says."""

    row_kind: ClassVar[str] = "reflectors"
    counted_as: ClassVar[str] = "reflectors"


def spots(event: ScanEvent, min_intensity: float, size_m: float) -> tuple[FloatArray, int]:
    """Clusters of bright beams in one scan.

    Returns:
        Range [m], bearing [rad] and index of the middle beam ``(n, 3)``, and how many are wider than ``size_m``.
    """
    bright = np.flatnonzero(np.isfinite(event.ranges) & (event.intensities >= min_intensity))
    if not len(bright):
        return np.zeros((0, 3)), 0
    bearings = event.first_rad + event.step_rad * bright
    points = event.ranges[bright, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    groups = np.split(np.arange(len(bright)), np.flatnonzero(np.hypot(*np.diff(points, axis=0).T) > size_m) + 1)
    if len(groups) > 1 and np.hypot(*(points[0] - points[-1])) <= size_m:  # a scan all around begins within it
        groups[0] = np.concatenate([groups.pop(), groups[0]])
    kept = [g for g in groups if np.hypot(*(points[g[0]] - points[g[-1]])) <= size_m]
    found = np.zeros((len(kept), 3))
    for row, group in zip(found, kept, strict=True):
        x, y = points[group].mean(axis=0)
        row[:] = event.ranges[bright[group]].mean(), math.atan2(y, x), bright[group[len(group) // 2]]
    return found, len(groups) - len(kept)


# --- What a recording shows -------------------------------------------------------------------------------------------

_RARE, _SCANS = 0.05, 200  # share of the beams that reflectors return at most; scans that are looked at
_GAP = 0.1  # of the largest intensity: between reflectors and everything else


class ScanChecks:
    """Scans that have no intensities, or none of a reflector."""

    def __init__(self) -> None:
        self._count = self._dark = 0
        self._brightest = 0.0

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, ScanEvent)
        self._count += 1
        self._dark += not len(event.intensities)
        self._brightest = max(self._brightest, float(np.nanmax(event.intensities, initial=0.0)))

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each; nothing if reflectors are not looked for."""
        section = getattr(config, Reflectors.name, None)  # settings may be made without those of registered sensors
        least = None if section is None else section.min_intensity
        if least is None:
            return []
        if self._dark:
            return [
                f"{topic}: {self._dark} of {self._count} scans have no intensities, by which reflectors are found; "
                "switch them on in the scanner's driver."
            ]
        if self._brightest < least:
            return [
                f"{topic}: no beam is as bright as a reflector: the brightest has {self._brightest:g}; correct "
                "reflectors.min_intensity."
            ]
        return []


def _least_intensity(values: FloatArray) -> float | None:
    """Middle of the widest gap in the intensities ``(n,)`` above which they are rare; None: there is none."""
    levels, counts = np.unique(values, return_counts=True)
    above = 1.0 - np.cumsum(counts) / len(values)  # share of the beams brighter than each level
    gaps = np.where(above[:-1] <= _RARE, np.diff(levels), 0.0)
    if not len(gaps) or gaps.max() < _GAP * levels[-1]:
        return None
    k = int(np.argmax(gaps))
    return float(0.5 * (levels[k] + levels[k + 1]))


def _first_section(look: FirstLook) -> FirstSection:
    """Intensity of reflectors, used where nothing else sees the points of the map; else a proposal."""
    scans = [e for e in look.of(ScanEvent) if e.intensities.any()]
    if not scans:
        return FirstSection()
    values = np.concatenate([e.intensities for e in scans[:: -(-len(scans) // _SCANS)]])
    least = _least_intensity(values[np.isfinite(values)])
    if least is None:
        return FirstSection()
    landmarks = look.landmark_map.landmarks.values() if look.landmark_map is not None else ()
    seen_otherwise = look.kinds & {"image", "sightings"}
    asked = any(m.is_point for m in landmarks) and not seen_otherwise
    placed = scans[0].frame_id in look.recording.frames
    hits = np.mean([len(spots(e, least, ReflectorsConfig().size_m)[0]) for e in scans])
    lines = [
        "reflectors:",
        f"  # {np.mean(values >= least):.2%} of the beams are much brighter: {hits:.1f} spots a scan.",
    ]
    if asked and placed:
        lines.append(f"  min_intensity: {least:.4g}")
    else:
        lines += ["  # Used as reflectors of the map once this is given.", f"  # min_intensity: {least:.4g}"]
    if not placed:
        lines.append("  # pose: [0.0, 0.0, 0.0]  # x y [m], yaw [rad] of the scanner in the base frame; tf lacks it")
    place = "where on the robot the laser scanner is: reflectors are not used without (reflectors.pose, .min_intensity)"
    return FirstSection(tuple(lines), (place,) if asked and not placed else ())


# --- The sensor -------------------------------------------------------------------------------------------------------


class Reflectors:
    """Reflectors seen by a laser scanner."""

    name: ClassVar[str] = "reflectors"
    needs: ClassVar[str] = "min_intensity"  # the setting without which it is not built
    optional: ClassVar[bool] = True  # a scan is read only if that is given
    purpose: ClassVar[str] = "to find the map's reflectors in it"
    uses_map: ClassVar[bool] = True  # it has no places of its own
    Config: ClassVar[type[Section]] = ReflectorsConfig
    streams: ClassVar[tuple[Stream, ...]] = (
        Stream(
            "reflectors",
            ScanEvent,
            {"sensor_msgs/msg/LaserScan": from_scan},
            ("scan",),
            keyframe=False,
            check=check,
            findings=ScanChecks,
        ),
    )
    failures: ClassVar[tuple[type[Section], ...]] = ()
    first_settings: ClassVar[FirstSettings] = FirstSettings((ScanEvent,), _first_section)

    def __init__(self, context: Context) -> None:
        self._config: ReflectorsConfig = context.section
        self._frame = context.frame
        self._places: dict[str, FloatArray] = {}
        self._wide = self._crowded = 0
        self._notes: dict[str, None] = {}  # an ordered set

    @classmethod
    def build(cls, context: Context) -> Reflectors | None:
        """The sensor of one run; None if no intensity is given, or no map.

        Raises:
            ConfigError: the map has no points.
        """
        landmark_map = context.landmark_map
        if context.section.min_intensity is None or landmark_map is None:
            return None
        if not any(landmark.is_point for landmark in landmark_map.landmarks.values()):
            raise ConfigError(
                "reflectors.min_intensity is given, but the map has no points, which reflectors are: landmarks with a "
                "position and no orientation; add them to the map, or leave reflectors.min_intensity out"
            )
        return cls(context)

    def measure(self, event: ScanEvent) -> Iterable[LandmarkMeasurement]:
        """Bright spots of one scan, each at the time of its own beam."""
        config = self._config
        assert config.min_intensity is not None
        found, wide = spots(event, config.min_intensity, config.size_m)
        self._wide += wide
        if len(found) > _MOST_HITS:
            self._crowded += 1
            return
        T = self._place(event.frame_id)
        variances = np.array([config.range_sigma_m**2, config.bearing_sigma_rad**2 + event.step_rad**2 / 12.0])
        for distance, bearing, beam in found.tolist():
            r, c, s = distance + config.radius_m, math.cos(bearing), math.sin(bearing)
            axes = T[:2, :2] @ np.array([[c, -r * s], [s, r * c]])  # by range and bearing
            point = T[:2, :2] @ (r * np.array([c, s])) + T[:2, 3]
            stamp_ns = event.stamp_ns + round(beam * event.step_s * 1e9)
            if math.hypot(*point) > 0.0:
                hit = Hit.of_point(stamp_ns, UNNAMED, point, (axes * variances) @ axes.T)
                yield replace(hit, scan_ns=event.stamp_ns)

    def _place(self, frame_id: str) -> FloatArray:
        """``T_base_scanner (4, 4)``."""
        if frame_id not in self._places:
            at = self._config.pose
            T = self._frame(frame_id) if at is None else homogeneous(rpy_matrix(0.0, 0.0, at[2]), (*at[:2], 0.0))
            if T is None:
                self._notes.setdefault(
                    f"No transform to the laser scanner's frame {frame_id!r}: taken to be at the base; set "
                    "reflectors.pose."
                )
                T = np.eye(4)
            self._places[frame_id] = T
        return self._places[frame_id]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the scanner's place, and on bright spots that are no reflectors."""
        told = list(self._notes)
        if self._wide:
            told.append(f"{self._wide} bright spots are wider than reflectors.size_m and are not used.")
        if self._crowded:
            told.append(
                f"{self._crowded} scans have more than {_MOST_HITS} bright spots and are not used; raise "
                "reflectors.min_intensity."
            )
        return tuple(told)
