"""Writer of standard rosbag2 recordings: one method per kind of message, for the converters and the simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from fgloc.frames import yaw_quaternion
from fgloc.recording.messages import Messages, default_typestore
from fgloc.recording.standard_messages import Message, header, rotation, xyz

# --- Messages ---------------------------------------------------------------------------------------------------------

Tap = Callable[[str, str, Any, int], None]
_LONGEST_RANGE_M = 82.0  # of a laser scanner


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
        self._messages = Messages(self._store)
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
        self._send(topic, message_type, bytes(self._store.serialize_cdr(message, message_type)), received_ns)

    def make(self, message_type: str, **fields: Any) -> Any:
        """A message of the typestore, for `write`."""
        return self._store.types[message_type](**fields)

    def _write(
        self, topic: str, kind: str, stamp_ns: int, received_ns: int | None, frame_id: str, content: Message
    ) -> None:
        """Write a message with a header, given as `Messages.encode` has it."""
        raw = self._messages.encode(kind, {"header": header(stamp_ns, frame_id), **content})
        self._send(topic, kind, raw, stamp_ns if received_ns is None else received_ns)

    def _send(self, topic: str, message_type: str, raw: bytes, received_ns: int) -> None:
        self.copy(topic, message_type, raw, received_ns)
        if self._tap is not None:
            self._tap(topic, message_type, self._messages.decode(message_type, raw), received_ns)

    def _connection(self, topic: str, message_type: str) -> Connection:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, message_type, typestore=self._store)
        return self._connections[topic]


def quaternion_fields(xyzw: Sequence[float]) -> Message:
    """geometry_msgs/Quaternion of x, y, z, w."""
    return dict(zip("xyzw", map(float, xyzw), strict=True))


def flat_cov(cov: ArrayLike | None) -> Any:
    """Covariance ``(6, 6)`` as an array ``(36,)`` of a message; None, for which a message has zeros, as it is."""
    return None if cov is None else np.asarray(cov, dtype=float).reshape(36)


# --- Landmarks --------------------------------------------------------------------------------------------------------


class LandmarkMessages(MessageWriter):
    """Ranges, positions, corners and poses, one method per kind of message."""

    def range_reading(
        self, topic: str, stamp_ns: int, range_m: float, frame_id: str, received_ns: int | None = None
    ) -> None:
        """``sensor_msgs/Range`` of a radio, of 0.1 to 100 m."""
        content = dict(radiation_type=2, min_range=0.1, max_range=100.0, range=range_m)
        self._write(topic, "sensor_msgs/msg/Range", stamp_ns, received_ns, frame_id, content)

    def laser_scan(
        self,
        topic: str,
        stamp_ns: int,
        ranges: ArrayLike,
        intensities: ArrayLike,
        bearings: tuple[float, float],
        beam_s: float = 0.0,
    ) -> None:
        """``sensor_msgs/LaserScan``: ranges [m] and intensities ``(n,)``, bearings of the first and the last beam."""
        content = dict(
            angle_min=bearings[0],
            angle_max=bearings[1],
            angle_increment=(bearings[1] - bearings[0]) / max(np.size(ranges) - 1, 1),
            time_increment=beam_s,
            range_max=_LONGEST_RANGE_M,
            ranges=ranges,
            intensities=intensities,
        )
        self._write(topic, "sensor_msgs/msg/LaserScan", stamp_ns, None, "laser", content)

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
            status={"status": 2, "service": 1},
            latitude=float(latitude),
            longitude=float(longitude),
            altitude=float(altitude),
            position_covariance=np.diag(variances).ravel(),
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
        landmarks = [dict(id=i, goodness=1.0, decision_margin=1.0, range=r, bearing=b) for i, r, b in sightings]
        kind = "landmark_msgs/msg/LandmarkArray"
        self._write(topic, kind, stamp_ns, received_ns, frame_id, dict(landmarks=landmarks))

    def marker_poses(
        self,
        topic: str,
        stamp_ns: int,
        sightings: Iterable[tuple[int, Sequence[float], Sequence[float], ArrayLike | None]],
        received_ns: int | None = None,
        frame_id: str = "camera_optical",
    ) -> None:
        """``aruco_msgs/MarkerArray`` of (id, position, quaternion x, y, z, w, covariance (6, 6) or None)."""
        markers = []
        for number, position, quaternion, cov in sightings:
            pose = {"position": xyz(*position), "orientation": quaternion_fields(quaternion)}
            measured = {"pose": pose, "covariance": flat_cov(cov)}
            markers.append(dict(header=header(stamp_ns, frame_id), id=number, pose=measured, confidence=1.0))
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

        The message counts from the first pixel's corner, and from the bottom left of the tag to the right.
        """
        detections = []
        for number, given in markers.items():
            corners = np.asarray(given, dtype=float)[[3, 2, 1, 0]] + 0.5
            centre, *points = (dict(x=float(x), y=float(y)) for x, y in [corners.mean(axis=0), *corners])
            detections.append(dict(id=number, decision_margin=100.0, centre=centre, corners=points))
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
        twist = {"linear": xyz(v, vy), "angular": xyz(z=omega)}
        self._write(topic, "geometry_msgs/msg/TwistStamped", stamp_ns, received_ns, frame_id, dict(twist=twist))

    def ackermann(
        self, topic: str, stamp_ns: int, speed: float, steering: float, received_ns: int | None = None
    ) -> None:
        """``ackermann_msgs/AckermannDriveStamped``: speed [m/s] and steering angle [rad]."""
        content = dict(drive={"steering_angle": steering, "speed": speed})
        self._write(topic, "ackermann_msgs/msg/AckermannDriveStamped", stamp_ns, received_ns, "base_link", content)

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
        x, y, yaw = pose
        moved = {"linear": xyz(twist[0], twist[1] if len(twist) > 2 else 0.0), "angular": xyz(z=twist[-1])}
        content = dict(
            child_frame_id=child_frame_id,
            pose={"pose": {"position": xyz(x, y), "orientation": rotation(yaw)}, "covariance": flat_cov(pose_cov)},
            twist={"twist": moved, "covariance": flat_cov(twist_cov)},
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
        content = dict(name=names, position=position, velocity=velocity, effort=effort)
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
        content = dict(
            orientation={"w": 1.0},
            orientation_covariance=np.append(-1.0, np.zeros(8)),
            angular_velocity=xyz(*angular_velocity),
            angular_velocity_covariance=np.eye(3).ravel() * variances[0],
            linear_acceleration=xyz(*linear_acceleration),
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
        **fields: Any,
    ) -> None:
        """``sensor_msgs/CameraInfo`` (plumb_bob): width and height, K (3, 3), D (n,); other fields as given."""
        matrix = np.asarray(K, dtype=float).reshape(3, 3)
        projection = np.zeros((3, 4))
        projection[:, :3] = matrix
        content = dict(
            height=size[1],
            width=size[0],
            distortion_model="plumb_bob",
            d=D,
            k=matrix.ravel(),
            r=np.eye(3).ravel(),
            p=projection.ravel(),
        )
        content |= fields
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
        transform = {"translation": xyz(*translation), "rotation": quaternion_fields(quaternion)}
        stamped = {"header": header(stamp_ns, parent), "child_frame_id": child, "transform": transform}
        raw = self._messages.encode("tf2_msgs/msg/TFMessage", {"transforms": [stamped]})
        self._send(topic, "tf2_msgs/msg/TFMessage", raw, stamp_ns if received_ns is None else received_ns)

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
        pose = {"position": xyz(*position), "orientation": quaternion_fields(quaternion)}
        self._write(topic, "geometry_msgs/msg/PoseStamped", stamp_ns, received_ns, frame_id, dict(pose=pose))

    def planar_truth(
        self, topic: str, stamp_ns: int, pose: Sequence[float], received_ns: int | None = None, frame_id: str = "map"
    ) -> None:
        """``geometry_msgs/PoseStamped`` of a pose x, y, yaw on the ground."""
        x, y, yaw = pose
        self.truth(topic, stamp_ns, (x, y, 0.0), yaw_quaternion(yaw).tolist(), received_ns, frame_id)

    def twist(
        self,
        topic: str,
        stamp_ns: int,
        linear: Sequence[float],
        angular: Sequence[float],
        received_ns: int | None = None,
    ) -> None:
        """``geometry_msgs/TwistWithCovarianceStamped`` (which nothing takes for a command), covariance zero."""
        content = dict(twist={"twist": {"linear": xyz(*linear), "angular": xyz(*angular)}})
        kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
        self._write(topic, kind, stamp_ns, received_ns, "base_link", content)

    def flag(self, topic: str, value: bool, received_ns: int) -> None:
        """``std_msgs/Bool``, which has no stamp."""
        self._send(topic, "std_msgs/msg/Bool", self._messages.encode("std_msgs/msg/Bool", {"data": value}), received_ns)

    def illuminance(self, topic: str, stamp_ns: int, lux: float, received_ns: int | None = None) -> None:
        """``sensor_msgs/Illuminance``."""
        self._write(topic, "sensor_msgs/msg/Illuminance", stamp_ns, received_ns, "map", dict(illuminance=lux))
