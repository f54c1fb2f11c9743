"""Ranges with bearings from plain numbers."""

from __future__ import annotations

from collections.abc import Iterable

from fgloc.sensors.event_input import BASE, EventInput
from fgloc.sensors.range_bearing.events import RangeBearing, RangeBearingEvent


class RangeBearingInput(EventInput):
    """What a sensor of landmarks measures."""

    def ranges(self, stamp_ns: int, landmarks: Iterable[tuple[int, float, float]], frame_id: str = BASE) -> None:
        """Landmarks by id, range [m] and bearing [rad], counter-clockwise from the sensor's x axis."""
        found = tuple(RangeBearing(int(i), float(r), float(b)) for i, r, b in landmarks)
        self._deliver(RangeBearingEvent(*self._when("sightings", stamp_ns), frame_id, found))
