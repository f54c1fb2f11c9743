"""Beacons of the map that tell their numbers, a sensor of landmarks in one file.

Each is one of the three kinds of sighting that the built-in sensors have, and treated as theirs are: sightings near in
time share their information, moved beacons are found and left out, the first pose is searched among all places.

``fgloc online BAG --map map.yaml``; sigmas are in the section ``beacons`` of ``robot.yaml``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from fgloc.config import Section
from fgloc.sensors.base import Context, Stream, When
from fgloc.sensors.measurements import LandmarkMeasurement, PointMeasurement
from fgloc.types import FloatArray, SensorEvent


class BeaconsConfig(Section):
    """Beacons seen by a scanner."""

    range_sigma_m: float = Field(0.03, gt=0, le=10, description="noise of the distance")
    bearing_sigma_rad: float = Field(0.005, gt=0, le=1, description="noise of the direction")


@dataclass(frozen=True, slots=True, eq=False)
class BeaconsEvent(SensorEvent):
    """Beacons that were seen in one turn of the scanner."""

    frame_id: str
    ids: tuple[int, ...]
    points: FloatArray  # (n, 2) m, in the scanner's axes


def from_cloud(message: Any, when: When) -> SensorEvent:
    """From `sensor_msgs/PointCloud` with a channel of ids."""
    ids = next(channel.values for channel in message.channels if channel.name == "id")
    points = np.array([(p.x, p.y) for p in message.points], dtype=float).reshape(-1, 2)
    if len(ids) != len(points):
        raise ValueError(f"{len(ids)} ids, expected one for each of {len(points)} points")
    return BeaconsEvent(*when, message.header.frame_id, tuple(int(i) for i in ids), points)


def check(event: BeaconsEvent, gate: Any) -> BeaconsEvent | str:
    """The event, or why it cannot be used."""
    if not np.isfinite(event.points).all():
        return "non_finite"
    ranges = np.hypot(event.points[:, 0], event.points[:, 1])
    return event if ((gate.min_range <= ranges) & (ranges <= gate.max_range)).all() else "range_bound"


class Beacon(PointMeasurement):
    """One beacon, by range and bearing from the base."""

    row_kind: ClassVar[str] = "beacons"
    counted_as: ClassVar[str] = "beacons"


class Beacons:
    """Beacons seen by a scanner."""

    name: ClassVar[str] = "beacons"
    Config: ClassVar[type[Section]] = BeaconsConfig
    streams: ClassVar[tuple[Stream, ...]] = (
        Stream(
            "beacons",
            BeaconsEvent,
            {"sensor_msgs/msg/PointCloud": from_cloud},
            ("beacons",),
            keyframe=True,
            check=check,
        ),
    )
    failures: ClassVar[tuple[type[Section], ...]] = ()

    def __init__(self, context: Context) -> None:
        self._config, self._frame = context.section, context.frame
        self._unplaced: set[str] = set()

    @classmethod
    def build(cls, context: Context) -> Beacons | None:
        """The sensor of one run; None without a map, which says where the beacons are."""
        return None if context.landmark_map is None else cls(context)

    def measure(self, event: BeaconsEvent) -> Iterable[LandmarkMeasurement]:
        """Those that were seen once, from the base; fgloc itself counts and drops those that the map lacks."""
        T = self._frame(event.frame_id)
        if T is None:
            self._unplaced.add(event.frame_id)
            T = np.eye(4)
        times = Counter(event.ids)
        for number, point in zip(event.ids, event.points, strict=True):
            if times[number] > 1:  # nothing shows which one is false
                continue
            distance = max(float(np.hypot(*point)), 1e-3)
            along = point / distance
            axes = T[:2, :2] @ np.array([[along[0], -along[1]], [along[1], along[0]]])  # along and across the beam
            sigmas = np.array([self._config.range_sigma_m, distance * self._config.bearing_sigma_rad])
            cov = (axes * sigmas**2) @ axes.T
            yield Beacon.of_point(event.stamp_ns, number, T[:2, :2] @ point + T[:2, 3], cov)

    @property
    def notes(self) -> tuple[str, ...]:
        """Scanners without a transform."""
        return tuple(f"beacons: no transform to {name}; it is taken to be the base" for name in self._unplaced)
