"""Marker poses as a sensor."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from fgloc.sensors.base import BuiltIn, Stream
from fgloc.sensors.marker_pose import messages, validation
from fgloc.sensors.marker_pose.events import MarkerPosesEvent
from fgloc.sensors.topic_checks import SightingsChecks
from fgloc.types import FrameMeasurement, LandmarkSighting

if TYPE_CHECKING:
    from fgloc.sensors.landmarks import SightingContext


def _measures(context: SightingContext) -> Callable[[Any], Iterator[LandmarkSighting]]:
    from fgloc.sensors.marker_pose.measure import MarkerPoseMeasurer

    return MarkerPoseMeasurer(context)


MARKER_POSE = BuiltIn(
    name="marker_pose",
    streams=(
        Stream(
            "sightings",
            MarkerPosesEvent,
            {
                "aruco_msgs/msg/MarkerArray": messages.aruco_poses,
                "vision_msgs/msg/Detection3DArray": messages.detections,
            },
            (),
            keyframe=True,
            validator=validation.marker_poses,
            findings=SightingsChecks,
        ),
    ),
    failing_as="camera",
    measures=_measures,
    measured=(FrameMeasurement,),
)
