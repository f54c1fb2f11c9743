"""ROS messages of marker poses as events."""

from __future__ import annotations

import re
from typing import Any

from fgloc.sensors.base import When
from fgloc.sensors.marker_pose.events import MarkerPose, MarkerPosesEvent
from fgloc.sensors.messages import matrix, xyz, xyzw
from fgloc.types import Event

_ID = re.compile(r"(?:^|[^0-9A-Za-z])(\d+)$")  # "7", "tag36h11:7", "marker_7"; not the 11 of "tag36h11"


def aruco_poses(m: Any, when: When) -> Event:
    """From ``aruco_msgs/MarkerArray``."""
    frame = m.header.frame_id or next((marker.header.frame_id for marker in m.markers), "")
    return MarkerPosesEvent(*when, frame, tuple(_marker_pose(int(marker.id), marker.pose) for marker in m.markers))


def detections(m: Any, when: When) -> Event:
    """From ``vision_msgs/Detection3DArray``.

    Things whose id holds no number are no markers; a message of nothing else is an error.
    """
    named = [(_detection_id(d, d.results[0]), d.results[0].pose) for d in m.detections if d.results]
    sightings = tuple(_marker_pose(marker_id, pose) for marker_id, pose in named if marker_id is not None)
    if named and not sightings:
        raise ValueError("no detection's id holds a number")
    return MarkerPosesEvent(*when, m.header.frame_id, sightings)


def _marker_pose(marker_id: int, pose: Any) -> MarkerPose:
    """From a PoseWithCovariance."""
    return MarkerPose(marker_id, xyz(pose.pose.position), xyzw(pose.pose.orientation), matrix(pose.covariance, 6))


def _detection_id(detection: Any, result: Any) -> int | None:
    """Marker number of a Detection3D: its hypothesis' class, in older definitions its result's id, else its own id."""
    hypothesis = getattr(result, "hypothesis", None)
    for value in (getattr(hypothesis, "class_id", ""), getattr(result, "id", ""), getattr(detection, "id", "")):
        if isinstance(value, int):
            return value
        if match := _ID.search(value.strip()):
            return int(match.group(1))
    return None
