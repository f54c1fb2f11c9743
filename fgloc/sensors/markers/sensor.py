"""Markers in images as a sensor: their topics, settings and failures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from fgloc.sensors.base import BuiltIn, Stream
from fgloc.sensors.markers import messages, validation
from fgloc.sensors.markers.events import CornersEvent, ImageEvent
from fgloc.sensors.markers.first_settings import FIRST_SETTINGS
from fgloc.sensors.markers.role import ROLE
from fgloc.sensors.topic_checks import RawChecks, SightingsChecks
from fgloc.types import LandmarkSighting, PixelMeasurement

if TYPE_CHECKING:
    from fgloc.config import Section
    from fgloc.sensors.landmarks import SightingContext


def _failures() -> tuple[type[Section], ...]:
    from fgloc.sensors.markers.failures import Darkness, FrameRate, MirroredImage

    return (Darkness, FrameRate, MirroredImage)


def _measures(context: SightingContext) -> Callable[[Any], Iterator[LandmarkSighting]]:
    from fgloc.sensors.markers.measure import CornerMeasurer

    return CornerMeasurer(context)


MARKERS = BuiltIn(
    name="corners",
    first_settings=FIRST_SETTINGS,
    streams=(
        Stream(
            "image",
            ImageEvent,
            {"sensor_msgs/msg/Image": messages.image, "sensor_msgs/msg/CompressedImage": messages.compressed_image},
            ("image_raw", "image_raw/compressed", "image", "image/compressed"),
            validator=validation.images,
            findings=RawChecks,
        ),
        Stream(
            "sightings",
            CornersEvent,
            {"apriltag_msgs/msg/AprilTagDetectionArray": messages.apriltags},
            (),
            keyframe=True,
            validator=validation.corners,
            findings=SightingsChecks,
        ),
    ),
    failing_as="camera",
    raw_landmarks=ROLE,
    measures=_measures,
    measured=(PixelMeasurement,),
    failures=_failures,
)
