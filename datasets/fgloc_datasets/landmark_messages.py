"""Messages of what was seen of landmarks and beacons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from fgloc_datasets.message_writer import MessageWriter, flat_cov, xyz_fields


class LandmarkMessages(MessageWriter):
    """Ranges, positions, corners and poses, one method per kind of message."""

    def range_reading(
        self, topic: str, stamp_ns: int, range_m: float, frame_id: str, received_ns: int | None = None
    ) -> None:
        """``sensor_msgs/Range`` of a radio, of 0.1 to 100 m."""
        content = dict(radiation_type=2, field_of_view=0.0, min_range=0.1, max_range=100.0, range=range_m)
        self._write(topic, "sensor_msgs/msg/Range", stamp_ns, received_ns, frame_id, content)

    def satellite_fix(
        self,
        topic: str,
        stamp_ns: int,
        place: Sequence[float],
        variances: Sequence[float],
        received_ns: int | None = None,
        frame_id: str = "gnss_link",
    ) -> None:
        """``sensor_msgs/NavSatFix``: latitude, longitude [degrees], altitude [m]; variances east, north, up [m²]."""
        latitude, longitude, altitude = place
        content = dict(
            status=self._make("sensor_msgs/msg/NavSatStatus", status=2, service=1),
            latitude=float(latitude),
            longitude=float(longitude),
            altitude=float(altitude),
            position_covariance=np.diag(np.asarray(variances, dtype=float)).ravel(),
            position_covariance_type=2,
        )
        self._write(topic, "sensor_msgs/msg/NavSatFix", stamp_ns, received_ns, frame_id, content)

    def range_bearing(
        self,
        topic: str,
        stamp_ns: int,
        sightings: Iterable[tuple[int, float, float]],
        received_ns: int | None = None,
        frame_id: str = "base_link",
    ) -> None:
        """``landmark_msgs/LandmarkArray`` of (id, range [m], bearing [rad])."""
        landmarks = [
            self._make(
                "landmark_msgs/msg/Landmark",
                id=i,
                hamming=0,
                goodness=1.0,
                decision_margin=1.0,
                range=r,
                bearing=b,
            )
            for i, r, b in sightings
        ]
        content = dict(landmarks=landmarks)
        self._write(topic, "landmark_msgs/msg/LandmarkArray", stamp_ns, received_ns, frame_id, content)

    def marker_poses(
        self,
        topic: str,
        stamp_ns: int,
        sightings: Iterable[tuple[int, Sequence[float], Sequence[float], ArrayLike | None]],
        received_ns: int | None = None,
        frame_id: str = "camera_optical",
    ) -> None:
        """``aruco_msgs/MarkerArray`` of (id, position, quaternion x, y, z, w, covariance (6, 6) or None)."""
        markers = [
            self._make(
                "aruco_msgs/msg/Marker",
                header=self._header(stamp_ns, frame_id),
                id=number,
                pose=self._make(
                    "geometry_msgs/msg/PoseWithCovariance",
                    pose=self._make(
                        "geometry_msgs/msg/Pose",
                        position=self._make("geometry_msgs/msg/Point", **xyz_fields(position)),
                        orientation=self._quaternion(quaternion),
                    ),
                    covariance=flat_cov(cov),
                ),
                confidence=1.0,
            )
            for number, position, quaternion, cov in sightings
        ]
        self._write(topic, "aruco_msgs/msg/MarkerArray", stamp_ns, received_ns, frame_id, dict(markers=markers))

    def corners(
        self,
        topic: str,
        stamp_ns: int,
        markers: Mapping[int, ArrayLike],
        received_ns: int | None = None,
        frame_id: str = "camera_optical",
    ) -> None:
        """``apriltag_msgs/AprilTagDetectionArray`` of corners (4, 2) [px] by id, clockwise from the top left.

        The message counts from the first pixel's corner and holds the tag upside down (`fgloc.recording.reader`).
        """
        detections = []
        for number, given in markers.items():
            corners = np.asarray(given, dtype=float)[[1, 0, 3, 2]] + 0.5
            points = [self._make("apriltag_msgs/msg/Point", x=float(x), y=float(y)) for x, y in corners]
            x, y = corners.mean(axis=0).tolist()
            centre = self._make("apriltag_msgs/msg/Point", x=x, y=y)
            detections.append(
                self._make(
                    "apriltag_msgs/msg/AprilTagDetection",
                    family="",
                    id=number,
                    hamming=0,
                    goodness=0.0,
                    decision_margin=100.0,
                    centre=centre,
                    corners=points,
                    homography=np.zeros(9),
                )
            )
        kind = "apriltag_msgs/msg/AprilTagDetectionArray"
        self._write(topic, kind, stamp_ns, received_ns, frame_id, dict(detections=detections))
