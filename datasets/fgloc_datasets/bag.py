"""Writer of standard rosbag2 recordings: one method per kind of message, for the converters and the simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from fgloc.recording.messages import default_typestore

# --- Messages ---------------------------------------------------------------------------------------------------------

Tap = Callable[[str, str, Any, int], None]


class MessageWriter:
    """Writes any message of the typestore. Stamps are integer nanoseconds; ``received_ns`` defaults to the stamp."""

    def __init__(
        self, path: Path, storage: str = "mcap", overwrite: bool = False, compress: bool = False, tap: Tap | None = None
    ) -> None:
        """Open a new bag folder.

        Args:
            path: folder to be made.
            storage: "mcap" or "sqlite3".
            overwrite: replace an existing bag folder (one that holds a metadata.yaml).
            compress: zstd chunks, which readers of MCAP undo by themselves; MCAP only.
            tap: given every message as it is read from the bag, with its topic, type and receive time [ns].

        Raises:
            FileExistsError: the folder exists and is not to be replaced.
        """
        if path.exists():
            if not (overwrite and (path / "metadata.yaml").is_file()):
                raise FileExistsError(f"{path} exists; give another folder or remove it")
            for file in path.iterdir():
                file.unlink()
            path.rmdir()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._store = default_typestore()
        plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
        self._writer = Writer(path, version=9, storage_plugin=plugin)
        if compress:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._connections: dict[str, Connection] = {}
        self._tap = tap

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._writer.close()

    def copy(self, topic: str, message_type: str, raw: bytes | memoryview, received_ns: int) -> None:
        """Write a message that is already serialized (CDR); its type must be in the typestore."""
        self._writer.write(self._connection(topic, message_type), received_ns, raw)

    def knows(self, message_type: str) -> bool:
        """Whether the typestore defines a type, so that a message of it can be written."""
        return message_type in self._store.types

    def write(self, topic: str, message_type: str, message: Any, received_ns: int) -> None:
        """Write any message of the typestore."""
        raw = self._store.serialize_cdr(message, message_type)
        self._writer.write(self._connection(topic, message_type), received_ns, raw)
        if self._tap is not None:
            self._tap(topic, message_type, self._store.deserialize_cdr(raw, message_type), received_ns)

    def make(self, message_type: str, **fields: Any) -> Any:
        """A message of the typestore, for `write`."""
        return self._make(message_type, **fields)

    # --- parts of messages ---

    def _connection(self, topic: str, message_type: str) -> Connection:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, message_type, typestore=self._store)
        return self._connections[topic]

    def _make(self, message_type: str, **fields: Any) -> Any:
        return self._store.types[message_type](**fields)

    def _write(
        self, topic: str, kind: str, stamp_ns: int, received_ns: int | None, frame_id: str, content: dict[str, Any]
    ) -> None:
        message = self._make(kind, header=self._header(stamp_ns, frame_id), **content)
        self.write(topic, kind, message, stamp_ns if received_ns is None else received_ns)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        time = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame_id)

    def _vector(self, xyz: Sequence[float]) -> Any:
        return self._make("geometry_msgs/msg/Vector3", **xyz_fields(xyz))

    def _quaternion(self, xyzw: Sequence[float]) -> Any:
        x, y, z, w = (float(value) for value in xyzw)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _twist(self, linear: Sequence[float], angular: Sequence[float]) -> Any:
        return self._make("geometry_msgs/msg/Twist", linear=self._vector(linear), angular=self._vector(angular))

    def _planar_pose(self, pose: Sequence[float]) -> Any:
        x, y, yaw = pose
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", **xyz_fields((x, y, 0.0))),
            orientation=self._quaternion((0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))),
        )


def xyz_fields(values: Sequence[float]) -> dict[str, float]:
    """Fields x, y, z of a message's vector or point."""
    x, y, z = (float(value) for value in values)
    return {"x": x, "y": y, "z": z}


def flat_cov(cov: ArrayLike | None) -> Any:
    """Covariance ``(6, 6)`` as an array ``(36,)`` of a message; zeros for None."""
    return np.zeros(36) if cov is None else np.asarray(cov, dtype=float).reshape(36)


# --- Landmarks --------------------------------------------------------------------------------------------------------


class LandmarkMessages(MessageWriter):
    """Ranges, positions, corners and poses, one method per kind of message."""

    def range_reading(
        self, topic: str, stamp_ns: int, range_m: float, frame_id: str, received_ns: int | None = None
    ) -> None:
        """``sensor_msgs/Range`` of a radio, of 0.1 to 100 m."""
        content = dict(radiation_type=2, field_of_view=0.0, min_range=0.1, max_range=100.0, range=range_m)
        self._write(topic, "sensor_msgs/msg/Range", stamp_ns, received_ns, frame_id, content)

    def laser_scan(
        self,
        topic: str,
        stamp_ns: int,
        ranges: ArrayLike,
        intensities: ArrayLike,
        bearings: tuple[float, float],
        received_ns: int | None = None,
        frame_id: str = "laser",
        beam_s: float = 0.0,
        max_range: float = 82.0,
    ) -> None:
        """``sensor_msgs/LaserScan``: ranges [m] and intensities ``(n,)``, bearings of the first and the last beam."""
        measured = np.asarray(ranges, dtype=np.float32)
        content = dict(
            angle_min=bearings[0],
            angle_max=bearings[1],
            angle_increment=(bearings[1] - bearings[0]) / max(len(measured) - 1, 1),
            time_increment=beam_s,
            scan_time=0.0,
            range_min=0.0,
            range_max=max_range,
            ranges=measured,
            intensities=np.asarray(intensities, dtype=np.float32),
        )
        self._write(topic, "sensor_msgs/msg/LaserScan", stamp_ns, received_ns, frame_id, content)

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


# --- Bags -------------------------------------------------------------------------------------------------------------


class BagWriter(LandmarkMessages):
    """Writes a rosbag2 folder. Stamps are integer nanoseconds; ``received_ns`` defaults to the stamp.

    Example:
        >>> with BagWriter(Path("out/run")) as bag:  # doctest: +SKIP
        ...     bag.command("/cmd_vel", 1_000_000_000, v=0.2, omega=0.0)
    """

    def command(
        self,
        topic: str,
        stamp_ns: int,
        v: float,
        omega: float,
        received_ns: int | None = None,
        frame_id: str = "",
        vy: float = 0.0,
    ) -> None:
        """``geometry_msgs/TwistStamped``: v [m/s], omega [rad/s], vy [m/s] to the left."""
        twist = self._twist([v, vy, 0.0], [0.0, 0.0, omega])
        self._write(topic, "geometry_msgs/msg/TwistStamped", stamp_ns, received_ns, frame_id, dict(twist=twist))

    def ackermann(
        self, topic: str, stamp_ns: int, speed: float, steering: float, received_ns: int | None = None
    ) -> None:
        """``ackermann_msgs/AckermannDriveStamped``: speed [m/s] and steering angle [rad]."""
        fields = dict(steering_angle=steering, steering_angle_velocity=0.0, speed=speed, acceleration=0.0, jerk=0.0)
        drive = self._make("ackermann_msgs/msg/AckermannDrive", **fields)
        kind = "ackermann_msgs/msg/AckermannDriveStamped"
        self._write(topic, kind, stamp_ns, received_ns, "base_link", dict(drive=drive))

    def odometry(
        self,
        topic: str,
        stamp_ns: int,
        pose: Sequence[float],
        twist: Sequence[float],
        received_ns: int | None = None,
        covs: tuple[ArrayLike | None, ArrayLike | None] = (None, None),
        frames: tuple[str, str] = ("odom", "base_link"),
    ) -> None:
        """``nav_msgs/Odometry``: pose x, y, yaw; twist v, omega or vx, vy, omega.

        Args:
            topic: of the message.
            stamp_ns: of the message.
            pose: of the second frame in the first.
            twist: of the second frame.
            received_ns: see the class.
            covs: of pose and twist ``(6, 6)`` in ROS order; None: zeros.
            frames: that of the pose, and that of the robot.
        """
        pose_cov, twist_cov = covs
        frame_id, child_frame_id = frames
        content = dict(
            child_frame_id=child_frame_id,
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance", pose=self._planar_pose(pose), covariance=flat_cov(pose_cov)
            ),
            twist=self._make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._twist([twist[0], twist[1] if len(twist) > 2 else 0.0, 0.0], [0.0, 0.0, twist[-1]]),
                covariance=flat_cov(twist_cov),
            ),
        )
        self._write(topic, "nav_msgs/msg/Odometry", stamp_ns, received_ns, frame_id, content)

    def joints(
        self,
        topic: str,
        stamp_ns: int,
        names: Sequence[str],
        position: Sequence[float],
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
        received_ns: int | None = None,
    ) -> None:
        """``sensor_msgs/JointState``: rad, rad/s, Nm; an empty sequence is left empty."""
        content = dict(
            name=list(names),
            position=np.asarray(position, dtype=float),
            velocity=np.asarray(velocity, dtype=float),
            effort=np.asarray(effort, dtype=float),
        )
        self._write(topic, "sensor_msgs/msg/JointState", stamp_ns, received_ns, "", content)

    def imu(
        self,
        topic: str,
        stamp_ns: int,
        angular_velocity: Sequence[float],
        linear_acceleration: Sequence[float],
        received_ns: int | None = None,
        frame_id: str = "imu_link",
        variances: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """``sensor_msgs/Imu`` without orientation (its covariance starts with -1, as REP 145 says).

        ``variances`` are of angular velocity and linear acceleration, each axis.
        """
        no_orientation = np.zeros(9)
        no_orientation[0] = -1.0
        content = dict(
            orientation=self._make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=no_orientation,
            angular_velocity=self._vector(angular_velocity),
            angular_velocity_covariance=np.eye(3).ravel() * variances[0],
            linear_acceleration=self._vector(linear_acceleration),
            linear_acceleration_covariance=np.eye(3).ravel() * variances[1],
        )
        self._write(topic, "sensor_msgs/msg/Imu", stamp_ns, received_ns, frame_id, content)

    def compressed_image(
        self,
        topic: str,
        stamp_ns: int,
        data: bytes,
        image_format: str = "jpeg",
        received_ns: int | None = None,
        frame_id: str = "camera_optical",
    ) -> None:
        """``sensor_msgs/CompressedImage`` of encoded bytes."""
        content = dict(format=image_format, data=np.frombuffer(data, dtype=np.uint8))
        self._write(topic, "sensor_msgs/msg/CompressedImage", stamp_ns, received_ns, frame_id, content)

    def camera_info(
        self,
        topic: str,
        stamp_ns: int,
        size: tuple[int, int],
        K: ArrayLike,
        D: Sequence[float],
        received_ns: int | None = None,
        frame_id: str = "camera_optical",
    ) -> None:
        """``sensor_msgs/CameraInfo`` of an unrectified camera (plumb_bob): width and height, K (3, 3), D (n,)."""
        matrix = np.asarray(K, dtype=float).reshape(3, 3)
        projection = np.zeros((3, 4))
        projection[:, :3] = matrix
        content = dict(
            height=size[1],
            width=size[0],
            distortion_model="plumb_bob",
            d=np.asarray(D, dtype=float),
            k=matrix.ravel(),
            r=np.eye(3).ravel(),
            p=projection.ravel(),
            binning_x=0,
            binning_y=0,
            roi=self._make(
                "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            ),
        )
        self._write(topic, "sensor_msgs/msg/CameraInfo", stamp_ns, received_ns, frame_id, content)

    def static_transform(
        self,
        stamp_ns: int,
        parent: str,
        child: str,
        translation: Sequence[float],
        quaternion: Sequence[float],
        received_ns: int | None = None,
        topic: str = "/tf_static",
    ) -> None:
        """``tf2_msgs/TFMessage`` with one transform ``T_parent_child``; quaternion x, y, z, w."""
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._vector(translation),
            rotation=self._quaternion(quaternion),
        )
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp_ns, parent),
            child_frame_id=child,
            transform=transform,
        )
        message = self._make("tf2_msgs/msg/TFMessage", transforms=[stamped])
        self.write(topic, "tf2_msgs/msg/TFMessage", message, stamp_ns if received_ns is None else received_ns)

    def truth(
        self,
        topic: str,
        stamp_ns: int,
        position: Sequence[float],
        quaternion: Sequence[float],
        received_ns: int | None = None,
        frame_id: str = "map",
    ) -> None:
        """``geometry_msgs/PoseStamped``; quaternion x, y, z, w."""
        pose = self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", **xyz_fields(position)),
            orientation=self._quaternion(quaternion),
        )
        self._write(topic, "geometry_msgs/msg/PoseStamped", stamp_ns, received_ns, frame_id, dict(pose=pose))

    def twist(
        self,
        topic: str,
        stamp_ns: int,
        linear: Sequence[float],
        angular: Sequence[float],
        received_ns: int | None = None,
        frame_id: str = "base_link",
    ) -> None:
        """``geometry_msgs/TwistWithCovarianceStamped`` (which nothing takes for a command), covariance zero."""
        content = self._make(
            "geometry_msgs/msg/TwistWithCovariance", twist=self._twist(linear, angular), covariance=np.zeros(36)
        )
        kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
        self._write(topic, kind, stamp_ns, received_ns, frame_id, dict(twist=content))

    def flag(self, topic: str, value: bool, received_ns: int) -> None:
        """``std_msgs/Bool``, which has no stamp."""
        self.write(topic, "std_msgs/msg/Bool", self._make("std_msgs/msg/Bool", data=value), received_ns)

    def illuminance(
        self, topic: str, stamp_ns: int, lux: float, received_ns: int | None = None, frame_id: str = "map"
    ) -> None:
        """``sensor_msgs/Illuminance``."""
        content = dict(illuminance=lux, variance=0.0)
        self._write(topic, "sensor_msgs/msg/Illuminance", stamp_ns, received_ns, frame_id, content)
