"""Writing standard rosbag2 recordings: one method per kind of message, used by the converters and the simulator."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fgloc_datasets.landmark_messages import LandmarkMessages
from fgloc_datasets.message_writer import flat_cov, xyz_fields


class BagWriter(LandmarkMessages):
    """Writes a rosbag2 folder. Stamps are integer nanoseconds; ``received_ns`` defaults to the stamp.

    Example:
        >>> with BagWriter(Path("out/run")) as bag:  # doctest: +SKIP
        ...     bag.command("/cmd_vel", 1_000_000_000, v=0.2, omega=0.0)
    """

    def command(
        self, topic: str, stamp_ns: int, v: float, omega: float, received_ns: int | None = None, frame_id: str = ""
    ) -> None:
        """``geometry_msgs/TwistStamped``: v [m/s], omega [rad/s]."""
        twist = self._twist([v, 0.0, 0.0], [0.0, 0.0, omega])
        self._write(topic, "geometry_msgs/msg/TwistStamped", stamp_ns, received_ns, frame_id, dict(twist=twist))

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
