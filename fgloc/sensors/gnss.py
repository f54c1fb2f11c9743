"""Positions of a GNSS receiver, in a plane about a surveyed origin.

Found by its entry point, as a sensor of another package is (docs/adding-a-sensor.md).

Reads `sensor_msgs/NavSatFix`. The map's frame is a plane that touches the earth at ``origin``; its x axis is turned by
``yaw_rad`` from east, counter-clockwise. The settings::

    gnss:
      origin: [48.137154, 11.576124, 519.0]     # latitude, longitude [degrees], altitude above the ellipsoid [m]
      yaw_rad: 0.0

A position that multipath has moved is refused by the chi-square gate, against the prediction.

Source of the transformation: NIMA TR8350.2, Department of Defense World Geodetic System 1984, third edition.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from fgloc.config import Config, GateConfig, Section
from fgloc.sensors.base import Context, FirstLook, FirstSection, FirstSettings, Stream, When
from fgloc.sensors.checks import Table
from fgloc.sensors.failures import EventFailure, Scene
from fgloc.sensors.measurements import PoseMeasurement
from fgloc.types import Event, FloatArray, Grave, SensorEvent

_SEMI_MAJOR_M, _FLATTENING = 6378137.0, 1.0 / 298.257223563  # of the ellipsoid of WGS 84
_ECCENTRICITY_2 = _FLATTENING * (2.0 - _FLATTENING)
_NO_FIX, _COVARIANCE_UNKNOWN = -1, 0  # of NavSatStatus and NavSatFix
_FARTHEST_M = 20_000.0  # from the origin: beyond, the plane is 30 m off the ground
_Metres = Annotated[float, Field(ge=-100, le=100)]


# --- Settings ---------------------------------------------------------------------------------------------------------


class GnssConfig(Section):
    """Positions of a GNSS receiver."""

    origin: (
        tuple[
            Annotated[float, Field(ge=-90, le=90)],
            Annotated[float, Field(ge=-360, le=360)],
            Annotated[float, Field(ge=-1e4, le=1e5)],
        ]
        | None
    ) = Field(None, description="of the map: latitude, longitude [°], ellipsoidal altitude [m]")
    yaw_rad: float = Field(0.0, ge=-7, le=7, description="map's x axis from east, counter-clockwise")
    antenna: tuple[_Metres, _Metres] | None = Field(
        None, description="x y [m] in the base frame; None: tf, else the base"
    )
    sigma_m: float = Field(1.5, ge=1e-3, le=1e3, description="where the message has no covariance")
    sigma_scale: float = Field(1.0, ge=0.01, le=100, description="true sigma over the message's")


def east_north(latitude: float, longitude: float, altitude: float, origin: tuple[float, float, float]) -> FloatArray:
    """Position ``(2,)`` [m] in the plane that touches the ellipsoid at an origin; degrees and metres."""
    off = _earth_centered(latitude, longitude, altitude) - _earth_centered(*origin)
    phi, lam = math.radians(origin[0]), math.radians(origin[1])
    east = -math.sin(lam) * off[0] + math.cos(lam) * off[1]
    outward = math.cos(lam) * off[0] + math.sin(lam) * off[1]
    return np.array([east, -math.sin(phi) * outward + math.cos(phi) * off[2]])


def _earth_centered(latitude: float, longitude: float, altitude: float) -> FloatArray:
    phi, lam = math.radians(latitude), math.radians(longitude)
    normal = _SEMI_MAJOR_M / math.sqrt(1.0 - _ECCENTRICITY_2 * math.sin(phi) ** 2)
    across = (normal + altitude) * math.cos(phi)
    along = (normal * (1.0 - _ECCENTRICITY_2) + altitude) * math.sin(phi)
    return np.array([across * math.cos(lam), across * math.sin(lam), along])


# --- Events -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class GnssEvent(SensorEvent):
    """One position."""

    frame_id: str
    latitude: float  # degrees
    longitude: float
    altitude: float  # m above the ellipsoid; NaN if the receiver gives none
    cov: FloatArray  # (2, 2) m², east and north; zeros if the message gives none
    fixed: bool

    def near(self, origin: tuple[float, float, float]) -> FloatArray | None:
        """Place ``(2,)`` east and north of an origin [m]; None: it is too far from there."""
        altitude = self.altitude if math.isfinite(self.altitude) else origin[2]
        place = east_north(self.latitude, self.longitude, altitude, origin)
        return None if math.hypot(*place) > _FARTHEST_M else place


def from_fix(message: Any, when: When) -> SensorEvent:
    """From `sensor_msgs/NavSatFix`."""
    cov = np.asarray(message.position_covariance, dtype=float).reshape(3, 3)[:2, :2]
    if message.position_covariance_type == _COVARIANCE_UNKNOWN:
        cov = np.zeros((2, 2))
    return GnssEvent(
        *when,
        message.header.frame_id,
        float(message.latitude),
        float(message.longitude),
        float(message.altitude),
        cov,
        message.status.status != _NO_FIX,
    )


def check(event: GnssEvent, gate: GateConfig) -> GnssEvent | str:
    """The event, or why it cannot be used: receivers without a fix say so, or report zeros."""
    if not event.fixed or event.latitude == event.longitude == 0.0:
        return "no_fix"
    if not math.isfinite(event.latitude + event.longitude) or not np.isfinite(event.cov).all():
        return "non_finite"
    if abs(event.latitude) > 90.0 or abs(event.longitude) > 360.0:
        return "position_bound"
    if event.cov.any():
        if np.linalg.eigvalsh(0.5 * (event.cov + event.cov.T))[0] <= 0.0:
            return "indefinite_cov"
        if np.trace(event.cov) > gate.max_variance:
            return replace(event, cov=np.zeros((2, 2)))
    return event


# --- Measurements -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class GnssPosition(PoseMeasurement):
    """One position as a function of the robot's pose."""

    position: FloatArray  # (2,) of the antenna in the map
    antenna: FloatArray  # (2,) in the base frame

    def residual_at(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted minus measured place of the antenna ``(2,)``, and its derivative ``(2, 3)`` by the pose."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        R = np.array([[c, -s], [s, c]])
        ax, ay = self.antenna
        J = np.column_stack([R, R @ np.array([-ay, ax])])
        return pose[:2] + R @ self.antenna - self.position, J

    def places(self) -> Iterable[FloatArray]:
        """There."""
        return (self.position,)


# --- Failure for `fgloc ablate` ---------------------------------------------------------------------------------------


class Multipath(EventFailure):
    """Reflections move positions, each by a draw of its own: in any direction, exponentially far."""

    changes: ClassVar[tuple[type[Event], ...]] = (GnssEvent,)
    sizes: ClassVar[tuple[str, ...]] = ("mean_m",)
    kind: Literal["gnss_multipath"] = "gnss_multipath"
    mean_m: float = Field(3.0, gt=0, description="mean distance, exponentially distributed [m]")

    def change(self, event: GnssEvent, scene: Scene) -> Event:
        """Move one position."""
        distance, direction = scene.rng.exponential(self.mean_m), scene.rng.uniform(-math.pi, math.pi)
        north = math.degrees(distance * math.sin(direction) / _SEMI_MAJOR_M)
        meridian = _SEMI_MAJOR_M * math.cos(math.radians(event.latitude))
        east = math.degrees(distance * math.cos(direction) / max(meridian, 1.0))
        return replace(event, latitude=event.latitude + north, longitude=event.longitude + east)


# --- First settings ---------------------------------------------------------------------------------------------------

_FIRST = 10  # positions whose median is proposed for the origin


_UNITS = {"in radians": math.degrees(1.0), "degrees times 1e7": 1e-7}  # of messages that are not in degrees, in degrees


def _other_form(places: FloatArray) -> str:
    """Form that latitudes and longitudes ``(n, 2)`` seem to have, which is not degrees; empty: they may be degrees."""
    latitude, longitude = np.median(np.abs(places), axis=0)
    if not max(latitude, longitude) > 0.0:
        return ""
    if latitude <= 0.5 * math.pi and longitude <= math.pi:  # in degrees this would be open sea off Africa
        return "in radians"
    if max(latitude, longitude) > 1e4 and latitude <= 90e7 and longitude <= 360e7:
        return "degrees times 1e7"
    return "exchanged" if 90.0 < latitude <= 360.0 and longitude <= 90.0 else ""


def _away_m(place: FloatArray, origin: tuple[float, float, float]) -> float:
    """Distance [m] from the origin of a place ``(2,)`` of latitude and longitude, at its altitude."""
    latitude, longitude = place.tolist()
    return math.hypot(*east_north(latitude, longitude, origin[2], origin))


def _far_off(places: FloatArray, origin: tuple[float, float, float]) -> str:
    """Sentence part on places ``(n, 2)`` most of which are far from the origin, and why; empty: they are not."""
    off = [_away_m(place, origin) for place in places]
    off_m = float(np.median(off)) if off else 0.0
    if off_m <= _FARTHEST_M:
        return ""
    middle = np.median(places, axis=0)
    ways = {"exchanged": middle[::-1]} | {form: middle * factor for form, factor in _UNITS.items()}
    near = [form for form, place in ways.items() if _away_m(place, origin) <= _FARTHEST_M]
    text = f"{off_m / 1e3:.4g} km from gnss.origin, expected at most {_FARTHEST_M / 1e3:g} km, and are not used"
    if near:
        return f"{text}: {_form(near[0])}"
    return f"{text}: correct gnss.origin (latitude first), which they would have at {middle[0]:.6f}, {middle[1]:.6f}"


def _form(form: str) -> str:
    """Sentence part on the form of positions, with the remedy."""
    if form == "exchanged":
        return "latitude and longitude seem to be exchanged; the driver has to publish degrees, latitude in latitude"
    return f"latitude and longitude seem to be {form}; the driver has to publish degrees"


def _origin(fixes: Sequence[GnssEvent]) -> str:
    """Median of some positions, as `gnss.origin` has it."""
    about = np.median([(e.latitude, e.longitude, e.altitude) for e in fixes], axis=0)
    altitude = float(about[2]) if math.isfinite(about[2]) else 0.0
    return f"[{about[0]:.8f}, {about[1]:.8f}, {altitude:.2f}]"


def _first_section(look: FirstLook) -> FirstSection:
    """A proposal for the origin, for the user to take: how far positions may be trusted is not told by a recording."""
    passed = (check(event, GateConfig()) for event in look.of(GnssEvent))
    fixes = [event for event in passed if isinstance(event, GnssEvent)]
    events = look.of(GnssEvent)
    places = np.array([(e.latitude, e.longitude) for e in events if math.isfinite(e.latitude + e.longitude)])
    form = _other_form(places.reshape(-1, 2)) if len(places) else ""
    if form or (events and not fixes):
        why = _form(form) if form else "no message holds a position (no fix, NaN, or beyond what degrees may be)"
        return FirstSection((), (f"the positions on {events[0].topic}, which cannot be used: {why}",))
    if not fixes:
        return FirstSection()
    lines = (
        "gnss:",
        "  # Positions are used once the origin of the map is given; these are the first ones. Receivers err alike for",
        "  # a minute, by more than they say: sigma_scale 5 is a cautious start.",
        f"  # origin: {_origin(fixes[:_FIRST])}  # latitude, longitude [°], altitude [m]: is the robot there?",
        "  # sigma_scale: 5.0",
        "  # antenna: [0.0, 0.0]  # x y [m] in the base frame; else tf, else the base",
    )
    return FirstSection(
        lines, ("where on the earth the map's origin is, without which GNSS is not used (gnss.origin)",)
    )


_MOST_PLACES = 500  # of a topic, evenly chosen, whose distances are computed
_REFUSED = {
    "non_finite": "hold NaN or infinity in latitude, longitude or their covariance",
    "position_bound": "have a latitude beyond 90° or a longitude beyond 360°",
    "indefinite_cov": "have a covariance with a variance of 0 or less",
}  # by reason


class GnssChecks:
    """Checks of a topic of positions: those that cannot be used, where they are, and an origin where none is given."""

    def __init__(self) -> None:
        self._count = 0
        self._unfixed: list[int] = []  # places among the messages
        self._refused: Counter[str] = Counter()
        self._places = Table(2)
        self._first: list[GnssEvent] = []

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, GnssEvent)
        checked = check(event, GateConfig())
        if checked == "no_fix":
            self._unfixed.append(self._count)
        elif isinstance(checked, str):
            self._refused[checked] += 1
        elif len(self._first) < _FIRST:
            self._first.append(checked)
        if event.fixed and math.isfinite(event.latitude + event.longitude):
            self._places.add(event.latitude, event.longitude)
        self._count += 1

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each."""
        found = []
        if self._unfixed:
            at = ", ".join(f"{seconds[k]:.1f}" for k in (self._unfixed[0], self._unfixed[-1]) if k < len(seconds))
            found.append(
                f"{topic}: {len(self._unfixed)} of {self._count} messages hold no fix (by their status, or latitude "
                f"and longitude are 0) and are not used; the first and the last at {at} s."
            )
        section: GnssConfig = getattr(config, Gnss.name, GnssConfig())
        places = self._places.array()
        form = _other_form(places) if len(places) else ""
        for reason, n in self._refused.items():
            found.append(f"{topic}: {n} of {self._count} messages {_REFUSED[reason]} and will be rejected.")
        if section.origin is not None and not self._refused["position_bound"] and len(places):
            far = _far_off(places[:: -(-len(places) // _MOST_PLACES)], section.origin)
            found += [f"{topic}: its positions are {far}."] if far else []
        elif form:
            found.append(f"{topic}: {_form(form)}.")
        if section.origin is None and self._first and not form:
            found.append(
                f"{topic}: to use its positions, set gnss.origin: {_origin(self._first)} (its first ones) if the map "
                "begins there."
            )
        return found


# --- The sensor -------------------------------------------------------------------------------------------------------


class Gnss:
    """Positions of a GNSS receiver."""

    name: ClassVar[str] = "gnss"
    needs: ClassVar[str] = "origin"  # the setting without which it is not built
    Config: ClassVar[type[Section]] = GnssConfig
    streams: ClassVar[tuple[Stream, ...]] = (
        Stream(
            "gnss",
            GnssEvent,
            {"sensor_msgs/msg/NavSatFix": from_fix},
            ("fix", "gnss/fix", "gps/fix"),
            check=check,
            findings=GnssChecks,
        ),
    )
    failures: ClassVar[tuple[type[Section], ...]] = (Multipath,)
    first_settings: ClassVar[FirstSettings] = FirstSettings((GnssEvent,), _first_section)

    def __init__(self, context: Context) -> None:
        self._config: GnssConfig = context.section
        self._frame = context.frame
        self._antennas: dict[str, FloatArray] = {}
        c, s = math.cos(self._config.yaw_rad), math.sin(self._config.yaw_rad)
        self._R_map_enu = np.array([[c, s], [-s, c]])
        self._far = Table(2)  # latitude and longitude of positions far from the origin
        self._used = False
        self._notes: dict[str, None] = {}  # an ordered set

    @classmethod
    def build(cls, context: Context) -> Gnss | None:
        """The sensor of one run; None if no origin is given."""
        return None if context.section.origin is None else cls(context)

    def measure(self, event: GnssEvent) -> Iterable[PoseMeasurement]:
        """One position, if it is not far from the origin."""
        config = self._config
        assert config.origin is not None
        local = event.near(config.origin)
        if local is None:
            self._far.add(event.latitude, event.longitude)
            return
        self._used = True
        cov = config.sigma_scale**2 * event.cov if event.cov.any() else np.eye(2) * config.sigma_m**2
        yield GnssPosition(
            source="gnss",
            stamp_ns=event.stamp_ns,
            cov=self._R_map_enu @ (0.5 * (cov + cov.T)) @ self._R_map_enu.T,
            position=self._R_map_enu @ local,
            antenna=self._antenna(event.frame_id),
        )

    def _antenna(self, frame_id: str) -> FloatArray:
        if self._config.antenna is not None:
            return np.array(self._config.antenna)
        if frame_id not in self._antennas:
            T = self._frame(frame_id)
            if T is None:
                self._notes.setdefault(
                    f"No transform to the GNSS antenna's frame {frame_id!r}: taken to be at the base; set gnss.antenna."
                )
            self._antennas[frame_id] = np.zeros(2) if T is None else T[:2, 3]
        return self._antennas[frame_id]

    @property
    def notes(self) -> tuple[str, ...]:
        """What is missing or out of reach."""
        places, origin = self._far.array(), self._config.origin
        if not len(places) or origin is None:
            return tuple(self._notes)
        far = f"{len(places)} GNSS position(s) are {_far_off(places[:: -(-len(places) // _MOST_PLACES)], origin)}"
        return (*self._notes, far if self._used else Grave(far))
