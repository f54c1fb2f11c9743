"""Ranges with bearings as a sensor."""

from __future__ import annotations

from fgloc.sensors.base import BuiltIn, Stream
from fgloc.sensors.range_bearing import messages, validation
from fgloc.sensors.range_bearing.events import RangeBearingEvent
from fgloc.sensors.topic_checks import SightingsChecks

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
)
