"""Poses of markers, as another node has estimated them from single views."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fgloc.frames import quaternion_matrix
from fgloc.sensors.base import BuiltIn, Stream, When, matrix, xyz, xyzw
from fgloc.sensors.checks import Changes, FieldChecks, SightingsChecks
from fgloc.sensors.landmarks import planar_yaw
from fgloc.sensors.measurements import FrameMeasurement, LandmarkSighting
from fgloc.types import Event, FloatArray, Sighting, SightingsEvent

if TYPE_CHECKING:
    from fgloc.sensors.landmarks import SightingContext


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPose(Sighting):
    """One marker's pose in the sensor frame."""

    position: FloatArray  # (3,)
    orientation: FloatArray  # (4,) quaternion x, y, z, w
    cov: FloatArray  # (6, 6) ROS order; zeros if the message gives none

    def place(self) -> FloatArray | None:
        """Position ``(3,)`` [m] of the marker in the sensor frame."""
        return self.position

    def distance(self) -> float | None:
        """Distance of the marker from the sensor [m]."""
        return float(np.linalg.norm(self.position))

    def noisy(self, sigmas: Mapping[str, float], rng: np.random.Generator) -> Sighting:
        """Marker pose with Gaussian noise on each coordinate of its position."""
        if not (sigma := sigmas["position_m"]):
            return self
        return replace(self, position=self.position + rng.normal(0.0, sigma, 3))


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPosesEvent(SightingsEvent):
    """Poses of the markers in one image, in the axes of the sensor."""

    sightings: tuple[MarkerPose, ...]


_ID = re.compile(r"(?:^|[^0-9A-Za-z])(\d+)$")  # "7", "tag36h11:7", "marker_7"; not the 11 of "tag36h11"


def from_aruco(m: Any, when: When) -> Event:
    """Event of a ``aruco_msgs/MarkerArray``."""
    frame = m.header.frame_id or next((marker.header.frame_id for marker in m.markers), "")
    return MarkerPosesEvent(*when, frame, tuple(_marker_pose(int(marker.id), marker.pose) for marker in m.markers))


def from_detections(m: Any, when: When) -> Event:
    """Event of a ``vision_msgs/Detection3DArray``.

    Things whose id holds no number are no markers; a message of nothing else is an error.
    """
    named = [(_detection_id(d, d.results[0]), d.results[0].pose) for d in m.detections if d.results]
    sightings = tuple(_marker_pose(marker_id, pose) for marker_id, pose in named if marker_id is not None)
    if named and not sightings:
        raise ValueError("no detection's id holds a number")
    return MarkerPosesEvent(*when, m.header.frame_id, sightings)


def from_aruco_opencv(m: Any, when: When) -> Event:
    """Event of a ``aruco_opencv_msgs/ArucoDetection``; the boards in it have no number, and are left out."""
    return MarkerPosesEvent(*when, m.header.frame_id, tuple(_bare_pose(int(s.marker_id), s.pose) for s in m.markers))


def from_ros2_aruco(m: Any, when: When) -> Event:
    """Event of a ``ros2_aruco_interfaces/ArucoMarkers``.

    Raises:
        ValueError: it has not as many poses as ids.
    """
    seen = tuple(_bare_pose(int(i), pose) for i, pose in zip(m.marker_ids, m.poses, strict=True))
    return MarkerPosesEvent(*when, m.header.frame_id, seen)


def from_fiducial_transforms(m: Any, when: When) -> Event:
    """Event of a ``fiducial_msgs/FiducialTransformArray``."""
    seen = (
        MarkerPose(int(t.fiducial_id), xyz(t.transform.translation), xyzw(t.transform.rotation), np.zeros((6, 6)))
        for t in m.transforms
    )
    return MarkerPosesEvent(*when, m.header.frame_id, tuple(seen))


def from_apriltag_ros(m: Any, when: When) -> Event:
    """Event of a ``apriltag_ros/AprilTagDetectionArray`` (ROS 1); bundles of tags have no number, and are left out."""
    seen = tuple(_marker_pose(int(d.id[0]), d.pose.pose) for d in m.detections if len(d.id) == 1)
    return MarkerPosesEvent(*when, m.header.frame_id or _frame(d.pose for d in m.detections), seen)


def from_isaac(m: Any, when: When) -> Event:
    """Event of a ``isaac_ros_apriltag_interfaces/AprilTagDetectionArray``, by its poses."""
    seen = tuple(_marker_pose(int(d.id), d.pose.pose) for d in m.detections)
    return MarkerPosesEvent(*when, m.header.frame_id or _frame(d.pose for d in m.detections), seen)


def from_alvar(m: Any, when: When) -> Event:
    """Event of a ``ar_track_alvar_msgs/AlvarMarkers``, whose poses are in the frame that each of them names.

    Raises:
        ValueError: they are in several frames.
    """
    seen = tuple(_bare_pose(int(marker.id), marker.pose.pose) for marker in m.markers)
    frames = {_frame((marker, marker.pose)) for marker in m.markers} - {""}
    if len(frames) > 1:
        raise ValueError(f"poses in several frames: {', '.join(sorted(frames))}")
    return MarkerPosesEvent(*when, next(iter(frames), m.header.frame_id), seen)


def _frame(stamped: Iterable[Any]) -> str:
    """The first frame that one of these messages names in its header."""
    return next((frame for one in stamped if (frame := one.header.frame_id)), "")


def _bare_pose(marker_id: int, pose: Any) -> MarkerPose:
    """Marker pose of a ``geometry_msgs/Pose``, which has no covariance."""
    return MarkerPose(marker_id, xyz(pose.position), xyzw(pose.orientation), np.zeros((6, 6)))


def _marker_pose(marker_id: int, pose: Any) -> MarkerPose:
    """Marker pose of a ``geometry_msgs/PoseWithCovariance``."""
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


def validator(checks: FieldChecks) -> Callable[[MarkerPosesEvent], Event | str]:
    """Validator of marker poses."""
    bounds = checks.config

    def judge(topic: str, sighting: MarkerPose) -> MarkerPose | str:
        distance = math.hypot(*sighting.position.tolist())
        if not math.isfinite(distance):
            return "non_finite"
        if not bounds.min_range < distance <= bounds.max_range:
            return "range_bound"
        changes: Changes = {}
        reason = checks.quaternion(sighting.orientation, "orientation", changes)
        reason = reason or checks.covariance(topic, "marker pose", sighting.cov, range(6), "cov", changes)
        if reason:
            return reason
        return replace(sighting, **changes) if changes else sighting

    return lambda event: checks.sift(event, judge)


class MarkerPoseMeasurer:
    """Planar poses of markers; range and bearing only if ``landmarks.yaw_sigma_rad`` is not set."""

    def __init__(self, context: SightingContext) -> None:
        self._context = context

    def __call__(self, event: MarkerPosesEvent) -> Iterator[LandmarkSighting]:
        """Measurements of one message."""
        made = (self._marker_pose(event.stamp_ns, seen) for seen in self._context.usable(event.sightings))
        return (m for m in made if m is not None)

    def _marker_pose(self, stamp_ns: int, seen: MarkerPose) -> LandmarkSighting | None:
        section = self._context.config.landmarks
        arm = self._context.T_base_sensor[:3, :3] @ seen.position  # from the sensor, in the base's axes
        distance = self._context.distance(math.hypot(arm[0], arm[1]))
        if distance is None:
            return None
        bearing = math.atan2(arm[1], arm[0]) - section.bearing_bias_rad
        c, s = math.cos(bearing), math.sin(bearing)
        J = np.array([[c, -distance * s], [s, distance * c]])
        place = self._context.T_base_sensor[:2, 3] + distance * np.array([c, s])
        cov = J @ self._context.range_bearing_cov(distance) @ J.T
        landmark = self._context.landmark(seen.landmark_id)
        if section.yaw_sigma_rad is None or (landmark is not None and landmark.size_m == 0.0):
            return self._context.polar(stamp_ns, seen.landmark_id, place, cov)
        rotation = self._context.T_base_sensor[:3, :3] @ quaternion_matrix(seen.orientation)
        yaw = planar_yaw(rotation, landmark) - section.bearing_bias_rad
        return self._context.planar(stamp_ns, seen.landmark_id, place, cov, yaw, section.yaw_sigma_rad**2)


MARKER_POSE = BuiltIn(
    name="marker_pose",
    streams=(
        Stream(
            "sightings",
            MarkerPosesEvent,
            {
                "apriltag_ros/msg/AprilTagDetectionArray": from_apriltag_ros,
                "ar_track_alvar_msgs/msg/AlvarMarkers": from_alvar,
                "aruco_msgs/msg/MarkerArray": from_aruco,
                "aruco_opencv_msgs/msg/ArucoDetection": from_aruco_opencv,
                "fiducial_msgs/msg/FiducialTransformArray": from_fiducial_transforms,
                "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": from_isaac,
                "ros2_aruco_interfaces/msg/ArucoMarkers": from_ros2_aruco,
                "vision_msgs/msg/Detection3DArray": from_detections,
            },
            (),
            keyframe=True,
            validator=validator,
            findings=SightingsChecks,
        ),
    ),
    failing_as="camera",
    measures=MarkerPoseMeasurer,
    measured=(FrameMeasurement,),
)
