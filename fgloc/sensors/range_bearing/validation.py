"""Which ranges and bearings can be used."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from fgloc.sensors.field_checks import FieldChecks
from fgloc.sensors.range_bearing.events import RangeBearing, RangeBearingEvent
from fgloc.types import Event


def range_bearings(checks: FieldChecks) -> Callable[[RangeBearingEvent], Event | str]:
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
