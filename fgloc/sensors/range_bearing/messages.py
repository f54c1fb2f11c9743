"""ROS messages of ranges with bearings as events."""

from __future__ import annotations

from typing import Any

from fgloc.sensors.base import When
from fgloc.sensors.range_bearing.events import RangeBearing, RangeBearingEvent
from fgloc.types import Event


def landmarks(m: Any, when: When) -> Event:
    """From ``landmark_msgs/LandmarkArray``."""
    sightings = tuple(RangeBearing(int(k.id), float(k.range), float(k.bearing)) for k in m.landmarks)
    return RangeBearingEvent(*when, m.header.frame_id, sightings)
