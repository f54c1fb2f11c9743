"""Ranges with bearings as a sensor."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from fgloc.sensors.base import BuiltIn, Stream
from fgloc.sensors.range_bearing import messages, validation
from fgloc.sensors.range_bearing.events import RangeBearingEvent
from fgloc.sensors.topic_checks import SightingsChecks
from fgloc.types import LandmarkSighting, PointMeasurement

if TYPE_CHECKING:
    from fgloc.sensors.landmarks import SightingContext


def _measures(context: SightingContext) -> Callable[[Any], Iterator[LandmarkSighting]]:
    from fgloc.sensors.range_bearing.measure import RangeBearingMeasurer

    return RangeBearingMeasurer(context)


RANGE_BEARING = BuiltIn(
    name="range_bearing",
    streams=(
        Stream(
            "sightings",
            RangeBearingEvent,
            {"landmark_msgs/msg/LandmarkArray": messages.landmarks},
            (),
            keyframe=True,
            validator=validation.range_bearings,
            findings=SightingsChecks,
        ),
    ),
    failing_as="camera",
    measures=_measures,
    measured=(PointMeasurement,),
)
