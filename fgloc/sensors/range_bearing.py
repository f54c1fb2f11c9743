"""Ranges with bearings to landmarks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fgloc.sensors.base import BASE, BuiltIn, EventInput, Stream, When
from fgloc.sensors.checks import FieldChecks, SightingsChecks
from fgloc.sensors.measurements import PointMeasurement
from fgloc.types import Event, Sighting, SightingsEvent

if TYPE_CHECKING:
    from fgloc.sensors.landmarks import SightingContext


@dataclass(frozen=True, slots=True, eq=False)
class RangeBearing(Sighting):
    """Distance and direction to one landmark in the sensor's plane (x forward, bearing counter-clockwise)."""

    range_m: float
    bearing_rad: float

    def distance(self) -> float | None:
        """Range [m] of the landmark."""
        return self.range_m

    def noisy(self, sigmas: Mapping[str, float], rng: np.random.Generator) -> Sighting:
        """Sighting with Gaussian noise on range and bearing."""
        range_m, bearing_rad = sigmas["range_m"], sigmas["bearing_rad"]
        if not (range_m or bearing_rad):
            return self
        return replace(
            self,
            range_m=self.range_m + float(rng.normal(0.0, range_m)),
            bearing_rad=self.bearing_rad + float(rng.normal(0.0, bearing_rad)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class RangeBearingEvent(SightingsEvent):
    """``landmark_msgs/LandmarkArray``."""

    sightings: tuple[RangeBearing, ...]


def from_landmark_array(m: Any, when: When) -> Event:
    """Event of a ``landmark_msgs/LandmarkArray``."""
    sightings = tuple(RangeBearing(int(k.id), float(k.range), float(k.bearing)) for k in m.landmarks)
    return RangeBearingEvent(*when, m.header.frame_id, sightings)


def validator(checks: FieldChecks) -> Callable[[RangeBearingEvent], Event | str]:
    """Validator of ranges with bearings."""
    bounds = checks.config
    bearings: dict[str, list[int]] = {}  # by topic: beyond 2 pi, all

    def judge(topic: str, sighting: RangeBearing) -> RangeBearing | str:
        distance, bearing = sighting.range_m, sighting.bearing_rad
        if not math.isfinite(distance + bearing):
            return "non_finite"
        if not bounds.min_range < distance <= bounds.max_range:
            return "range_bound"
        beyond = bearings.setdefault(topic, [0, 0])
        beyond[1] += 1
        if abs(bearing) > 2.0 * math.pi:
            beyond[0] += 1
            return "bearing_bound"
        if beyond[0] >= 3 and beyond[0] > 0.2 * beyond[1]:
            checks.note(
                f"{topic}: many bearings lie beyond 2 pi: probably degrees where radians were expected; none is used "
                "while that is so: convert the recording"
            )
            return "bearing_unit"
        if abs(bearing) > math.pi:
            return replace(sighting, bearing_rad=math.remainder(bearing, 2.0 * math.pi))
        return sighting

    return lambda event: checks.sift(event, judge)


class RangeBearingInput(EventInput):
    """Method that makes the events of ranges with bearings."""

    def ranges(self, stamp_ns: int, landmarks: Iterable[tuple[int, float, float]], frame_id: str = BASE) -> None:
        """Landmarks by id, range [m] and bearing [rad], counter-clockwise from the sensor's x axis."""
        if (odd := next((i for i, _, _ in landmarks if float(i) != int(i)), None)) is not None:
            raise ValueError(f"a landmark's id is {odd}, expected a whole number")
        found = tuple(RangeBearing(int(i), float(r), float(b)) for i, r, b in landmarks)
        self._deliver(RangeBearingEvent(*self._when("sightings", stamp_ns), frame_id, found))


_MIN_COS_ALONG_AXIS = math.cos(math.radians(80.0))  # beyond it a distance along the axis says nothing of the range


class RangeBearingMeasurer:
    """Calibrates ranges and bearings and moves them from the sensor to the base."""

    def __init__(self, context: SightingContext) -> None:
        self._context = context

    def __call__(self, event: RangeBearingEvent) -> Iterator[PointMeasurement]:
        """Measurements of one message."""
        made = (self._range_bearing(event.stamp_ns, seen) for seen in self._context.usable(event.sightings))
        return (m for m in made if m is not None)

    def _range_bearing(self, stamp_ns: int, seen: RangeBearing) -> PointMeasurement | None:
        section = self._context.config.landmarks
        distance = self._context.distance(seen.range_m)
        if distance is None:
            return None
        bearing = seen.bearing_rad - section.bearing_bias_rad
        c, s = math.cos(bearing), math.sin(bearing)
        if section.range_along_axis:
            if c < _MIN_COS_ALONG_AXIS:
                self._context.reject("bearing_bound")
                return None
            point = np.array([distance, distance * s / c])
            J = np.array([[1.0, 0.0], [s / c, distance / c**2]])
        else:
            point = distance * np.array([c, s])
            J = np.array([[c, -distance * s], [s, distance * c]])
        R, t = self._context.T_base_sensor[:2, :2], self._context.T_base_sensor[:2, 3]
        cov = R @ J @ self._context.range_bearing_cov(distance) @ J.T @ R.T
        return self._context.polar(stamp_ns, seen.landmark_id, R @ point + t, cov)


RANGE_BEARING = BuiltIn(
    name="range_bearing",
    streams=(
        Stream(
            "sightings",
            RangeBearingEvent,
            {"landmark_msgs/msg/LandmarkArray": from_landmark_array},
            (),
            keyframe=True,
            validator=validator,
            findings=SightingsChecks,
        ),
    ),
    failing_as="camera",
    measures=RangeBearingMeasurer,
    measured=(PointMeasurement,),
)
