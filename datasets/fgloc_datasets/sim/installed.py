"""An installation as it came about: the draws of a seed, what is believed of them, and ``installed.yaml``, the truth.

The room and the camera are what the scenario says; what is written of them is wrong. The robot's wheels and the IMU are
themselves other than written. So the same seed renders the same walls and images however wrong map and camera are.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.files.settings import Settings
from fgloc.frames import quaternion_matrix, rpy_matrix
from fgloc.types import FloatArray, Landmark, LandmarkMap
from fgloc_datasets.sim.scenario import (
    FRONT,
    REAR,
    Camera,
    Installation,
    Robot,
    Scenario,
    Section,
    Vector2,
    Vector3,
    channel_rng,
)
from fgloc_datasets.sim.scene import intrinsics, optical_rotation

INSTALLED = "installed.yaml"
_WITH_WHEELBASE = ("ackermann", "mecanum")  # skid-steer robots have one that nobody needs
_OTHER_CAMERA = 1_000_003  # is added to the seed for the draws of the second camera


class MountedCamera(Section):
    """A camera on the robot. ``rpy`` [rad] turns its forward looking body axes."""

    position: Vector3  # m, in the base frame
    rpy: Vector3
    focal_px: float
    principal_px: Vector2
    distortion: tuple[float, float, float, float, float]  # plumb_bob: k1, k2, p1, p2, k3

    @property
    def matrix(self) -> FloatArray:
        """Camera matrix K ``(3, 3)``."""
        f, (cx, cy) = self.focal_px, self.principal_px
        return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])

    @property
    def rotation(self) -> FloatArray:
        """Rotation R_base_cam ``(3, 3)`` of the optical frame."""
        return optical_rotation(self.rpy)


class TrueCamera(MountedCamera):
    """True mounting and lens of the camera, and the offset of its clock."""

    time_offset_s: float = 0.0  # stamp minus the middle of the exposure, on average


class Steering(Section):
    """Steering of an Ackermann robot: true angles are ``ratio`` times the reported ones, and ``zero_rad`` besides."""

    zero_rad: float = 0.0
    ratio: float = 1.0


class Wheels(Section):
    """Radii and track [m]; wheelbase [m] and steering of robots that have them."""

    left_radius: float
    right_radius: float
    track: float
    wheelbase: float | None = None
    steering: Steering | None = None


class TrueWheels(Wheels):
    """True radii and track of the wheels, and the offset of their clock."""

    time_offset_s: float = 0.0  # stamp minus the time of the reading


class TrueImu(Section):
    """True IMU: it measures ``gyro_scale`` times the rates, in axes turned by ``rpy`` [rad] in the base frame."""

    rpy: Vector3 = (0.0, 0.0, 0.0)
    gyro_scale: float = 1.0
    time_offset_s: float = 0.0  # stamp minus the time of the sample


class Marker(Section):
    """True place of a marker."""

    id: int
    position: Vector3  # m
    quaternion: tuple[float, float, float, float]  # x, y, z, w of R_map_marker
    size: float  # m


class TrueMap(Section):
    """True places of all markers."""

    landmarks: tuple[Marker, ...]

    def landmark_map(self) -> LandmarkMap:
        """The true places as a map, without a dictionary."""
        return LandmarkMap(
            {
                m.id: Landmark(m.id, np.array(m.position), quaternion_matrix(m.quaternion), m.size)
                for m in self.landmarks
            }
        )


class Believed(Section):
    """Installation as camera_info, tf_static and robot.yaml have it."""

    camera: MountedCamera | None
    wheels: Wheels
    rear: MountedCamera | None = None


class Installed(Section):
    """The truth of an installation, for evaluation only, and what is believed of it (but for the map: map.yaml)."""

    camera: TrueCamera | None  # None: the scenario has none
    wheels: TrueWheels
    imu: TrueImu
    map: TrueMap
    believed: Believed
    rear: TrueCamera | None = None

    def true_camera(self, name: str) -> TrueCamera:
        """The camera of this name as it is."""
        found = self.camera if name == FRONT else self.rear
        assert found is not None
        return found

    def believed_camera(self, name: str) -> MountedCamera:
        """The camera of this name as it is written down."""
        found = self.believed.camera if name == FRONT else self.believed.rear
        assert found is not None
        return found


def install(scenario: Scenario, seed: int, landmarks: LandmarkMap) -> Installed:
    """Draw an installation.

    Args:
        scenario: with its installation.
        seed: of the run.
        landmarks: where the markers hang.
    """
    errors = scenario.installation or Installation()
    cameras: dict[str, TrueCamera] = {}
    believed: dict[str, MountedCamera] = {}
    for name, given in scenario.cameras.items():
        true, of = _mounted(given), seed if name == FRONT else seed + _OTHER_CAMERA
        cameras[name] = TrueCamera(**true.model_dump(), time_offset_s=_uniform(of, errors, "camera_time_s"))
        believed[name] = true if scenario.installation is None else _misjudged(true, of, errors)
    robot = scenario.robot
    imu = TrueImu(
        rpy=se2.triple(np.radians(_normal(seed, errors, "imu_angle_deg", 3))),
        gyro_scale=1.0 + float(_normal(seed, errors, "gyro_scale_share", 1)[0]),
        time_offset_s=_uniform(seed, errors, "imu_time_s"),
    )
    return Installed(
        camera=cameras.get(FRONT),
        wheels=_true_wheels(robot, seed, errors),
        imu=imu,
        map=TrueMap(landmarks=tuple(_marker(landmark) for landmark in landmarks.landmarks.values())),
        believed=Believed(
            camera=believed.get(FRONT),
            wheels=Wheels(
                left_radius=robot.radius_m,
                right_radius=robot.radius_m,
                track=robot.track_m,
                wheelbase=robot.wheelbase_m if robot.kind in _WITH_WHEELBASE else None,
                steering=Steering() if robot.kind == "ackermann" else None,
            ),
            rear=believed.get(REAR),
        ),
        rear=cameras.get(REAR),
    )


def true_robot(robot: Robot, wheels: Wheels) -> Robot:
    """The robot with the wheels that it really has; what its regulator and odometry believe does not change."""
    update = {
        "radius_scale": (wheels.left_radius / robot.radius_m, wheels.right_radius / robot.radius_m),
        "track_m": wheels.track,
        "track_scale": robot.track_scale * robot.track_m / wheels.track,
    }
    if wheels.wheelbase is not None:
        update |= {"wheelbase_m": wheels.wheelbase}
        update |= {"wheelbase_scale": robot.wheelbase_scale * robot.wheelbase_m / wheels.wheelbase}
    if wheels.steering is not None:
        update |= {"steering_zero_rad": wheels.steering.zero_rad, "steering_ratio": wheels.steering.ratio}
    return robot.model_copy(update=update)


def survey(installation: Installation | None, seed: int, landmarks: LandmarkMap) -> LandmarkMap:
    """The map as somebody measured it."""
    if installation is None:
        return landmarks
    n = len(landmarks)
    shifts = _normal(seed, installation, "marker_position_m", n, 3)
    turns = np.radians(_normal(seed, installation, "marker_direction_deg", n))
    tilts = np.radians(_normal(seed, installation, "marker_tilt_deg", n, 2))
    measured = {}
    for landmark, shift, turn, (pitch, roll) in zip(landmarks.landmarks.values(), shifts, turns, tilts, strict=True):
        rotation = rpy_matrix(0.0, 0.0, turn) @ landmark.rotation @ rpy_matrix(pitch, 0.0, roll)
        measured[landmark.landmark_id] = replace(landmark, position=landmark.position + shift, rotation=rotation)
    return replace(landmarks, landmarks=measured)


def camera_jitter_s(installation: Installation | None, seed: int, n: int) -> FloatArray:
    """Delay ``(n,)`` [s] of the images' stamps beyond the constant offset."""
    return _normal(seed, installation or Installation(), "camera_jitter_s", n)


def write_installed(installed: Installed, path: Path) -> None:
    """Write ``installed.yaml``."""
    note = "# The truth of the installation, for evaluation only: no program that localises reads it.\n"
    unused: Any = {"rear": True, "believed": {"rear"}} if installed.rear is None else None
    content = installed.model_dump(mode="json", exclude=unused)
    for told in (content["wheels"], content["believed"]["wheels"]):
        for name in ("wheelbase", "steering"):
            if told[name] is None:  # the robot has none
                del told[name]
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    path.write_text(note + text, encoding="utf-8")


def load_installed(path: Path) -> Installed:
    """Read the ``installed.yaml`` of a run.

    Raises:
        ConfigError: no such file, no YAML, a key is missing or unknown, or a value is not a number; all are named.
    """
    return Settings(path, "record the run anew").validated(Installed)


def _mounted(camera: Camera) -> MountedCamera:
    K = intrinsics(camera)
    return MountedCamera(
        position=camera.position,
        rpy=se2.triple(np.radians(camera.rpy_deg)),
        focal_px=camera.focal_px,
        principal_px=(float(K[0, 2]), float(K[1, 2])),
        distortion=camera.distortion,
    )


def _misjudged(true: MountedCamera, seed: int, errors: Installation) -> MountedCamera:
    turn = rpy_matrix(*np.radians(_normal(seed, errors, "camera_angle_deg", 3)))
    off = _uniforms(seed, errors, "principal_point_px", 2)
    k1, k2, *rest = true.distortion
    k1 += float(_normal(seed, errors, "distortion_k1", 1)[0])
    k2 += float(_normal(seed, errors, "distortion_k2", 1)[0])
    return MountedCamera(
        position=se2.triple(true.position + _normal(seed, errors, "camera_position_m", 3)),
        rpy=_rpy(rpy_matrix(*true.rpy) @ turn),
        focal_px=true.focal_px * (1.0 + _uniform(seed, errors, "focal_share")),
        principal_px=(true.principal_px[0] + float(off[0]), true.principal_px[1] + float(off[1])),
        distortion=(k1, k2, rest[0], rest[1], rest[2]),
    )


def _true_wheels(robot: Robot, seed: int, errors: Installation) -> TrueWheels:
    common = 1.0 + _uniform(seed, errors, "wheel_radius_share")
    difference = _uniform(seed, errors, "wheel_difference_share")
    left, right = (robot.radius_m * scale * common for scale in robot.radius_scale)
    steering = None
    if robot.kind == "ackermann":
        steering = Steering(
            zero_rad=robot.steering_zero_rad + math.radians(_uniform(seed, errors, "steering_zero_deg")),
            ratio=robot.steering_ratio * (1.0 + _uniform(seed, errors, "steering_share")),
        )
    longer = 1.0 + _uniform(seed, errors, "wheelbase_share")
    return TrueWheels(
        left_radius=left * (1.0 + 0.5 * difference),
        right_radius=right * (1.0 - 0.5 * difference),
        track=robot.track_m * (1.0 + _uniform(seed, errors, "track_share")),
        wheelbase=robot.wheelbase_m * longer if robot.kind in _WITH_WHEELBASE else None,
        steering=steering,
        time_offset_s=_uniform(seed, errors, "wheel_time_s"),
    )


def _marker(landmark: Landmark) -> Marker:
    x, y, z, w = (float(v) for v in Rotation.from_matrix(landmark.rotation).as_quat())
    return Marker(
        id=landmark.landmark_id, position=se2.triple(landmark.position), quaternion=(x, y, z, w), size=landmark.size_m
    )


def _normal(seed: int, errors: Installation, field: str, *shape: int) -> FloatArray:
    """Draws of the sigma that a field gives, on the field's own channel."""
    return np.asarray(getattr(errors, field) * channel_rng(seed, f"installation {field}").standard_normal(shape))


def _uniforms(seed: int, errors: Installation, field: str, n: int) -> FloatArray:
    return np.asarray(getattr(errors, field) * channel_rng(seed, f"installation {field}").uniform(-1.0, 1.0, n))


def _uniform(seed: int, errors: Installation, field: str) -> float:
    return float(_uniforms(seed, errors, field, 1)[0])


def _rpy(rotation: FloatArray) -> Vector3:
    """Fixed-axis roll, pitch, yaw [rad] of a rotation matrix."""
    forward = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], forward)
    return se2.triple(np.array([np.arctan2(*rotation[2, [1, 2]]), pitch, np.arctan2(*rotation[[1, 0], 0])]))
