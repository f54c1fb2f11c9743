"""Markers in images as a sensor: their topics, settings and failures."""

from __future__ import annotations

from fgloc.sensors.base import BuiltIn, Stream
from fgloc.sensors.markers import messages, validation
from fgloc.sensors.markers.events import CornersEvent, ImageEvent
from fgloc.sensors.topic_checks import RawChecks, SightingsChecks

MARKERS = BuiltIn(
    name="corners",
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
)
