"""Configuration: strict pydantic models, read from ``robot.yaml`` and written out, resolved, beside every result."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import yaml
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PrivateAttr,
    StringConstraints,
    create_model,
    field_validator,
    model_validator,
)

from fgloc.drives.every import AnyDrive
from fgloc.errors import ConfigError
from fgloc.extensions import outside_sensors
from fgloc.files.settings import (
    SHIPPED,
    Settings,
    constant,
    expert,
    file_type,
    joined,
    key_in_file,
    parted,
    refuse_misplaced,
)
from fgloc.files.settings import Section as Section
from fgloc.stats import GATE

# --- Sections of the built-in sensors ---------------------------------------------------------------------------------


class NoiseDensity(Section):
    """Densities of white noise, per square root of distance, rotation or time.

    The variance over a step is the sum of each squared density times the metres, radians and seconds travelled, so that
    splitting a step leaves the covariance as it was.
    """

    x_per_sqrt_m: float = expert(0.03, ge=0, le=100, description="m/√m, along the motion")
    y_per_sqrt_m: float = expert(0.015, ge=0, le=100, description="m/√m, across the motion")
    yaw_per_sqrt_m: float = expert(0.03, ge=0, le=100, description="rad/√m")
    xy_per_sqrt_rad: float = expert(0.01, ge=0, le=100, description="m/√rad")
    yaw_per_sqrt_rad: float = expert(0.05, ge=0, le=100, description="rad/√rad")
    xy_per_sqrt_s: float = expert(0.002, ge=0, le=100, description="m/√s")
    yaw_per_sqrt_s: float = expert(0.002, ge=0, le=100, description="rad/√s")

    def per_second(self, v: float, omega: float) -> tuple[float, float, float]:
        """Variances per second of x, y, yaw at a velocity [m/s, rad/s]."""
        v, omega = abs(v), abs(omega)
        turning = self.xy_per_sqrt_rad**2 * omega + self.xy_per_sqrt_s**2
        yaw = self.yaw_per_sqrt_m**2 * v + self.yaw_per_sqrt_rad**2 * omega + self.yaw_per_sqrt_s**2
        return self.x_per_sqrt_m**2 * v + turning, self.y_per_sqrt_m**2 * v + turning, yaw


_LEAST_SCALE = 1e-3
_LEAST_RADIUS = 1e-6  # m: of a way per tick


class WheelsConfig(Section):
    """Wheel odometry."""

    source: Literal["auto", "twist", "pose", "ticks", "command", "none"] = Field(
        "auto",
        description="auto: ticks of the joints if the geometry is given, else pose of the odometry if it moves along "
        "its heading, else its twist, else command",
    )
    left_joint: str | None = Field(None, description="joint of the wheel")
    right_joint: str | None = Field(None, description="joint of the wheel")
    left_radius: float | None = Field(
        None, ge=-2.0, le=2.0, description="distance per unit of the angle, usually rad; negative: counts backwards"
    )
    right_radius: float | None = Field(
        None, ge=-2.0, le=2.0, description="distance per unit of the angle, usually rad; negative: counts backwards"
    )
    track: float | None = Field(None, ge=1e-3, le=5.0, description="distance of the contact points")
    angle_range: float | None = expert(None, ge=1e-3, le=1e9, description="where the angle rolls over")
    drive: AnyDrive | None = Field(None, description="another drive (docs/drives.md)")
    scale_v: float = Field(1.0, ge=_LEAST_SCALE, le=1e3, description="true over reported forward speed")
    scale_omega: float = Field(1.0, ge=-1e3, le=1e3, description="true over reported yaw rate; negative: clockwise")
    yaw_per_m: float = expert(0.0, ge=-1, le=1, description="yaw gained on the straight, by unequal wheels")
    slowdown: float = expert(0.0, ge=0, le=5.0, description="share of the speed lost per rad/s of turning")
    delay_s: float = expert(0.0, ge=0, le=2.0, description="delay from message to motion")
    hold_s: float = expert(0.5, gt=0, le=60, description="longest time that a twist is held")
    zero_speed: float = expert(0.0, ge=0, le=10, description="a lower speed is rest")
    zero_yaw_rate: float = expert(0.0, ge=0, le=10, description="a lower rate is rest")
    noise: NoiseDensity = NoiseDensity()
    scale_sigma: float = Field(0.01, ge=0, le=0.5, description="sigma of both radii together")
    turn_scale_sigma: float = Field(0.01, ge=0, le=0.5, description="sigma of the track")
    time_offset_sigma_s: float = expert(0.005, ge=0, le=1.0, description="sigma of the clock")
    yaw_per_m_sigma: float = expert(0.015, ge=0, le=1, description="sigma of yaw_per_m")
    slowdown_sigma: float = expert(0.0, ge=0, le=5.0, description="sigma of slowdown")
    delay_sigma_s: float = expert(0.0, ge=0, le=1.0, description="sigma of delay_s")

    @model_validator(mode="after")
    def _turns(self) -> WheelsConfig:
        for name, radius in (("left_radius", self.left_radius), ("right_radius", self.right_radius)):
            if radius is not None and abs(radius) < _LEAST_RADIUS:
                raise ValueError(f"{name} is {radius:g} m, expected {_LEAST_RADIUS:g} or more, or its negative")
        if abs(self.scale_omega) < _LEAST_SCALE:
            raise ValueError(
                f"scale_omega is {self.scale_omega:g}, expected {_LEAST_SCALE:g} or more, or its negative; "
                "where yaw rates tell nothing, widen turn_scale_sigma"
            )
        return self

    @property
    def in_radians(self) -> bool:
        """Whether the wheels' joints report angles and rates in radians."""
        return self.drive is None or self.drive.ticks_per_turn is None


class GyroConfig(Section):
    """Yaw rate of an IMU."""

    use: bool = expert(True, description="false: the gyro is not read")
    scale: float = expert(1.0, ge=-1e3, le=1e3, description="true over reported rate; negative: clockwise")
    yaw_per_sqrt_s: float = expert(0.002, ge=1e-6, le=10, description="rad/√s: noise of the integrated rate")
    scale_sigma: float = expert(0.005, ge=0, le=0.5, description="sigma of scale")
    bias_sigma: float = expert(0.02, ge=1e-6, le=10, description="sigma of the bias at the start")
    tilt_sigma_rad: float = constant(
        0.0087,
        "mounting to half a degree",
        ge=0,
        le=0.5,
        description="roll and pitch that the mounting is off by; estimated on uneven ground",
    )
    level_sigma_rad: float = constant(
        0.005,
        "a bias of 0.05 m/s², over gravity",
        ge=0,
        le=0.5,
        description="tilt that the accelerometer's bias makes, in roll and pitch; estimated on uneven ground",
    )
    acceleration_sigma: float = constant(
        0.15,
        "vibration of a driving robot",
        ge=1e-3,
        le=100,
        description="of the specific force of a step, beside gravity; on uneven ground",
    )
    bias_walk: float = constant(0.0003, "of a MEMS gyro; rests measure the bias", ge=0, le=10, description="rad/s/√s")


_Place = Annotated[float, Field(ge=-1e3, le=1e3)]  # m or rad, on a robot


class CameraConfig(Section):
    """The camera, where the recording does not say."""

    file: Path | None = Field(None, description="calibration, ROS or Kalibr YAML; None: CameraInfo")
    rescale: bool = expert(False, description="scale the calibration to the image size")
    focal_scale: float = expert(1.0, ge=0.01, le=100, description="true focal length over the calibration's")
    cx_px: float | None = expert(None, ge=-1e5, le=1e5, description="principal point; None: the calibration's")
    cy_px: float | None = expert(None, ge=-1e5, le=1e5, description="principal point; None: the calibration's")
    k1: float | None = expert(None, ge=-100, le=100, description="of plumb_bob; None: the calibration's")
    k2: float | None = expert(None, ge=-100, le=100, description="of plumb_bob; None: the calibration's")
    position_sigma_m: float = expert(0.003, ge=0, le=1.0, description="sigma of the mounting, on each axis")
    rotation_sigma_rad: float = expert(0.007, ge=0, le=0.5, description="likewise, about each axis")
    focal_sigma: float = expert(0.003, ge=0, le=0.5, description="sigma of the focal length, as a share")
    principal_sigma_px: float = expert(2.0, ge=0, le=100.0, description="sigma of the principal point")
    distortion_sigma: float = expert(0.005, ge=0, le=0.5, description="sigma of k1 and k2")
    time_offset_sigma_s: float = expert(0.012, ge=0, le=1.0, description="sigma of its clock")
    time_jitter_s: float = constant(
        0.002, "jitter of a driver that stamps on arrival", ge=0, le=0.1, description="sigma of each stamp"
    )


class NamedCameraConfig(CameraConfig):
    """One of several cameras: these keys, and those of `camera` and `expert.camera`."""

    image: str | None = Field(None, description="topic of its images")
    camera_info: str | None = Field(None, description="topic of its calibration; None: beside its images")
    sightings: str | None = Field(None, description="topic of markers found in them")
    pose: tuple[_Place, _Place, _Place, _Place, _Place, _Place] | None = Field(
        None, description="as recording.sightings_pose"
    )
    axes: Literal["body", "optical"] | None = Field(None, description="as recording.sightings_axes; None: optical")

    @model_validator(mode="after")
    def _has_a_topic(self) -> NamedCameraConfig:
        if self.image is None and self.sightings is None:
            raise ValueError("a camera needs the topic of its images (image) or of the markers in them (sightings)")
        return self


class LandmarksConfig(Section):
    """Range/bearing and marker-pose sightings."""

    range_sigma_m: float = Field(0.1, ge=1e-4, le=100, description="noise of a range")
    range_sigma_per_m: float = expert(0.0, ge=0, le=10, description="added sigma per metre of range")
    bearing_sigma_rad: float = Field(0.02, ge=1e-5, le=3.2, description="noise of a bearing")
    range_scale: float = expert(1.0, ge=1e-4, le=1e4, description="true over reported range")
    range_along_axis: bool = expert(False, description="the reported range is a depth along the sensor's axis")
    range_bias_m: float = expert(0.0, ge=-100, le=100, description="subtracted from the reported range")
    bearing_bias_rad: float = expert(0.0, ge=-6.3, le=6.3, description="subtracted from the reported bearing")
    range_scale_sigma: float = expert(0.005, ge=0, le=0.5, description="sigma of range_scale")
    bearing_bias_sigma_rad: float = expert(0.007, ge=0, le=0.5, description="sigma of bearing_bias_rad")
    position_sigma_m: float = expert(0.0, ge=0, le=1.0, description="sigma of the mounting, ahead and to the left")
    time_offset_sigma_s: float = expert(0.012, ge=0, le=1.0, description="sigma of the sensor's clock")
    yaw_sigma_rad: float | None = expert(
        None, ge=1e-5, le=3.2, description="noise of a marker pose's yaw; None: yaw is not used"
    )
    cauchy_k: float = expert(
        3.0, ge=0.01, le=1e6, description="sigmas: Cauchy kernel, on unknown maps and in fits of a pose"
    )
    min_sightings: int = constant(
        3,
        "two may agree by chance",
        gt=0,
        le=1_000_000,
        description="sightings that an unknown landmark needs before it is used",
    )
    repeat_s: float = expert(0.0, ge=0, le=1e6, description="correlation time of a landmark's errors; not of corners")


class MarkersConfig(Section):
    """Marker detection in images."""

    dictionary: str | None = Field(None, description="OpenCV's name, as DICT_4X4_50; None: the map's")
    default_size_m: float | None = Field(None, ge=1e-3, le=5.0, description="side, where the map gives none")
    sigma_px: float = Field(0.5, ge=1e-3, le=100, description="noise of one corner coordinate")
    blur_s: float = expert(2e-4, ge=0, le=0.1, description="a corner's error is the image's motion in this time")
    sway_rad: float = constant(
        0.005,
        "between 0.0005 and 0.015 nothing changes",
        ge=0,
        le=0.5,
        description="sigma of a base's roll and pitch in each image, on a flat floor",
    )
    cauchy_k: float = constant(
        3.0,
        "as for ranges",
        ge=0.01,
        le=1e6,
        description="sigmas: Cauchy kernel, on unknown maps and in fits of a pose",
    )
    max_sightings: int = constant(
        12,
        "more cost time and hardly add information",
        gt=0,
        le=1000,
        description="the largest markers of an image that are used",
    )


MODELS = Path(__file__).parent / "sensors" / "learned" / "models"


def model_path(given: Any) -> Any:
    """The file of a motion model; ``shipped:NAME`` is one that comes with the package.

    Raises:
        ValueError: no model of this name is shipped; those that are get listed.
    """
    if not str(given).startswith(SHIPPED):
        return given
    path = MODELS / (str(given).removeprefix(SHIPPED) + ".safetensors")
    if path.is_file():
        return path
    names = ", ".join(
        sorted(f"{SHIPPED}{p.relative_to(MODELS).with_suffix('')}" for p in MODELS.rglob("*.safetensors"))
    )
    raise ValueError(f"{given} is not shipped; there are {names}")


def shipped_name(path: Path) -> str | None:
    """``shipped:NAME`` of a file that comes with the package; None for others."""
    return f"{SHIPPED}{path.relative_to(MODELS).with_suffix('')}" if path.is_relative_to(MODELS) else None


class MotionConfig(Section):
    """The learned motion model."""

    model: Annotated[Path | None, BeforeValidator(model_path)] = Field(
        None, description="file of `fgloc train`, or shipped:sim/diff_drive"
    )
    use: bool = expert(True, description="false: the model is not used")
    scale: float = expert(1.0, ge=0.01, le=100, description="this robot's distance over the model's")
    scale_sigma: float = expert(0.01, ge=0, le=0.5, description="sigma of scale")
    turn_scale: float = expert(1.0, ge=0.01, le=100, description="this robot's turn over the model's")
    yaw_per_m: float = expert(0.0, ge=-10, le=10, description="pull to the left beyond the model's [rad/m]")
    adaptation_sigma: float = expert(
        0.03, ge=0, le=0.5, description="sigma of those two (share, rad/m); 0: scale alone is estimated"
    )
    correlation: Literal["joint", "independent"] = expert(
        "joint", description="joint: decorrelated from the wheels; independent: for comparison"
    )


MOTION_SOURCES = ("wheels", "learned", "gyro")
"""Names of the motion sources: of their measurements, in ``steps.csv``, of their parameters of the installation."""
BESIDE = "odometry."
"""Begins the name of an odometry beside the wheels, which is its role and its source: ``odometry.visual``."""
ODOMETRIES = "odometries"
"""Role of streams of such odometries of any name, under which their messages are counted."""


def is_motion_source(name: str) -> bool:
    """Whether a motion source has this name: one of `MOTION_SOURCES`, or an odometry beside them."""
    return name in MOTION_SOURCES or name.startswith(BESIDE)


_CameraName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]


class SensorSections(Section):
    """Settings of the built-in sensors, by their keys of ``robot.yaml``: one line each."""

    wheels: WheelsConfig = WheelsConfig()
    gyro: GyroConfig = GyroConfig()
    camera: CameraConfig = CameraConfig()
    cameras: dict[_CameraName, NamedCameraConfig] = Field({}, description="several cameras, by name (docs/cameras.md)")
    markers: MarkersConfig = MarkersConfig()
    landmarks: LandmarksConfig = LandmarksConfig()
    motion: MotionConfig = MotionConfig()


# --- The configuration ------------------------------------------------------------------------------------------------

_Far = Annotated[float, Field(ge=-1e9, le=1e9)]  # m or rad, in a map
_Sigma = Annotated[float, Field(ge=1e-6, le=1e4)]  # m or rad
Role = str
"""Of a topic: a built-in one, or one that a sensor of another package brings."""
BUILT_IN_ROLES = ("odometry", "command", "joints", "imu", "image", "camera_info", "sightings", "truth")


CAMERA_ROLES = ("image", "camera_info", "sightings")
"""Roles that each camera has."""


def camera_role(camera: str, role: Role) -> Role:
    """Role of one of several cameras: ``front/image``; of one camera, whose name is "", the role itself."""
    return f"{camera}/{role}" if camera else role


def camera_folder(topic: str) -> str:
    """Namespace of a camera: the folder of its images, its calibration, or what is found in its images."""
    return topic.removesuffix("/compressed").rpartition("/")[0]


def base_role(role: Role) -> Role:
    """Role without the camera that it is of: ``image`` of ``front/image``."""
    return role.rpartition("/")[2]


def base_roles(roles: Iterable[Role]) -> frozenset[Role]:
    """`base_role` of each."""
    return frozenset(map(base_role, roles))


def role_names() -> tuple[Role, ...]:
    """All roles, the built-in ones first."""
    outside = (stream.role for sensor in outside_sensors() for stream in sensor.streams if stream.role != ODOMETRIES)
    return tuple(dict.fromkeys((*BUILT_IN_ROLES, *outside)))  # one may read a built-in role from a message of its own


def known_role(role: str) -> str:
    """A role that there is.

    Raises:
        ValueError: it is none; the message has those that are.
    """
    if role not in role_names() and not role.startswith(BESIDE) and base_role(role) not in CAMERA_ROLES:
        names = ", ".join(role_names())
        raise ValueError(f"expected one of {names}, {BESIDE}NAME of recording.odometries, or a camera's: front/image")
    return role


def _known_source(name: str) -> str:
    if not is_motion_source(name):
        raise ValueError(f"expected one of {', '.join(MOTION_SOURCES)}, or {BESIDE}NAME of recording.odometries")
    return name


_KnownRole = Annotated[str, AfterValidator(known_role)]


class TopicsConfig(Section):
    """Topic of each role. None: found by message type; "none": not used although it is there."""

    odometry: str | None = None
    command: str | None = None
    joints: str | None = None
    imu: str | None = None
    image: str | None = None
    camera_info: str | None = None
    sightings: str | None = None
    truth: str | None = None

    _cameras: dict[Role, str | None] = PrivateAttr(default_factory=dict)
    _asked: frozenset[Role] = PrivateAttr(default=frozenset())
    _of_joints: tuple[str, ...] = PrivateAttr(default=())
    _of_fields: dict[Role, str] = PrivateAttr(default_factory=dict)

    @property
    def of_fields(self) -> Mapping[Role, str]:
        """Topic of any type by the role that `recording.fields` makes of it, where no other topic is given."""
        return {role: topic for role, topic in self._of_fields.items() if getattr(self, role, None) in (None, topic)}

    @property
    def of_joints(self) -> tuple[str, ...]:
        """Topics of any type in which `recording.joints` names fields, the first one being that of the role."""
        return () if self.joints == "none" else self._of_joints

    @property
    def of_cameras(self) -> Mapping[Role, str | None]:
        """Topic that is given for each role of several cameras, as `camera_role` names them; empty: there is one."""
        return self._cameras

    def role_on(self, topic: str, base: Role) -> Role:
        """Role of a topic that plays this one, of the camera that it is of where there are several."""
        same = [(role, given) for role, given in self._cameras.items() if base_role(role) == base]
        for role, given in same:
            beside = {self._cameras[role.removesuffix(base) + r] for r in ("image", "sightings")} - {None, "none"}
            if given == topic or (given is None and camera_folder(topic) in {camera_folder(str(t)) for t in beside}):
                return role
        return base

    def given(self, role: Role) -> str | None:
        """Topic that is given for a role; None: none is given."""
        if role in self._cameras:
            return self._cameras[role]
        given: str | None = getattr(self, role, None)
        if role == "joints" and given is None and self._of_joints:
            return self._of_joints[0]
        given = given or self._of_fields.get(role)
        if given is None and role in optional_roles() and role not in self._asked:
            return "none"
        return "none" if given is None and self._cameras and role in CAMERA_ROLES else given

    def only(self, roles: Collection[Role]) -> Self:
        """Copy in which no topic plays another role than these."""
        other = self.model_copy(update={role: "none" for role in type(self).model_fields if role not in roles})
        other._cameras = dict.fromkeys(self._cameras, "none")
        return other

    def asking(self, roles: Collection[Role]) -> Self:
        """Copy that looks for topics of these roles, of `optional_roles`, as for those of all others.

        Among several topics that could play one of them, the user has to choose.
        """
        other = self.model_copy()
        other._asked = frozenset(roles)
        return other

    @property
    def asked(self) -> frozenset[Role]:
        """Roles of sensors by entry point that the settings ask for."""
        return self._asked


class OdometryTopic(Section):
    """One odometry beside the wheels."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,31}$", description="in reports: visual, lidar, rear_wheels")
    topic: str = Field(min_length=1, description="of nav_msgs/Odometry")
    pose: tuple[_Place, _Place, _Place] | None = Field(
        None, description="of what it tracks, in the base frame: x y [m] yaw [rad]; None: by tf, else the base"
    )

    @property
    def role(self) -> Role:
        """Role of its topic and name of the motion source."""
        return BESIDE + self.name


_FieldPath = Annotated[
    str, StringConstraints(pattern=r"^[A-Za-z_]\w*(\[\d+\])?(\.[A-Za-z_]\w*(\[\d+\])?)*$", max_length=200)
]


class JointField(Section):
    """One joint whose angle or rate is a field of a message of any type."""

    topic: str = Field(min_length=1, description="of any message type")
    position: _FieldPath | None = Field(None, description="field of the angle: data, point.x, wheels[0].ticks")
    velocity: _FieldPath | None = Field(None, description="field of the rate")
    scale: float = Field(
        1.0, ge=-1e9, le=1e9, description="rad, rad/s or m/s for one unit of the field; negative: it counts backwards"
    )
    offset: float = Field(0.0, ge=-1e9, le=1e9, description="added after the scale")
    rolls_over: float | None = Field(None, gt=0, le=1e19, description="a counter begins anew after it: 65536")

    @model_validator(mode="after")
    def _measured(self) -> JointField:
        if self.position is None and self.velocity is None:
            raise ValueError("it has neither position nor velocity, expected the field of one of them")
        if not self.scale:
            raise ValueError("scale is 0, expected the size of the field's unit")
        return self


_EntryPath = Annotated[
    str, StringConstraints(pattern=r"^[A-Za-z_]\w*(\[\d*\])?(\.[A-Za-z_]\w*(\[\d*\])?)*$", max_length=200)
]
_MADE = {"odometry": ("forward", "turn"), "sightings": ("id",), "uwb": ("id", "range")}  # what a role needs


class RoleFields(Section):
    """A role played by fields of a message of any type; of each entry of an array by ``[]``: ``nodes[].id``."""

    topic: str = Field(min_length=1, description="of any message type")
    id: _EntryPath | None = Field(None, description="of the landmark or anchor: tags[].id, ids[]")
    range: _EntryPath | None = Field(None, description="its distance")
    bearing: _EntryPath | None = Field(None, description="its direction [rad]")
    pose: _EntryPath | None = Field(None, description="of a marker, in place of range and bearing: a Pose or Transform")
    forward: _EntryPath | None = Field(None, description="speed of an odometry [m/s]")
    turn: _EntryPath | None = Field(None, description="yaw rate of an odometry [rad/s]")


class RecordingConfig(Section):
    """How to read a recording."""

    topics: TopicsConfig = TopicsConfig()
    joints: dict[str, JointField] = Field(
        {}, max_length=100, description="joints in messages of other types (docs/drives.md)"
    )
    fields: dict[Literal["odometry", "sightings", "uwb"], RoleFields] = Field(
        {}, description="other roles in messages of other types: topic and fields of each (docs/formats.md)"
    )
    odometries: tuple[OdometryTopic, ...] = Field(
        (), max_length=8, description="beside the wheels: name, topic, pose of each (docs/odometries.md)"
    )
    received_stamps: tuple[_KnownRole, ...] = Field(
        (), description="roles with receive times in place of header stamps"
    )
    clock_sigma_s: float = constant(
        0.003,
        "the other clocks are measured against it",
        ge=0,
        le=1.0,
        description="how far the clock may be off to which the others are compared: the gyro's, or the wheels'",
    )
    stamp_offset_s: dict[_KnownRole, Annotated[float, Field(ge=-4e9, le=4e9)]] = Field(
        {}, description="added to a role's stamps"
    )
    base_frame: str | None = Field(None, description="None: base_link, base_footprint or base")
    sightings_pose: tuple[_Place, _Place, _Place, _Place, _Place, _Place] | None = Field(
        None, description="sensor in the base frame, x forward: x y z [m] roll pitch yaw [rad]; None: tf"
    )
    sightings_axes: Literal["body", "optical"] | None = Field(
        None, description="of what it measures: body (x forward), optical (z forward); None: optical of cameras"
    )
    imu_pose: tuple[_Place, _Place, _Place, _Place, _Place, _Place] | None = Field(
        None, description="IMU, likewise; None: tf"
    )

    @model_validator(mode="after")
    def _distinct(self) -> RecordingConfig:
        for what in ("name", "topic"):
            given = [getattr(one, what) for one in self.odometries]
            if len(set(given)) < len(given):
                raise ValueError(f"odometries have the {what}s {', '.join(given)}, expected each once")
        return self

    @model_validator(mode="after")
    def _with_topic_of_joints(self) -> RecordingConfig:
        topics = tuple(dict.fromkeys(joint.topic for joint in self.joints.values()))
        if topics and self.topics.joints not in (None, "none", topics[0]):
            raise ValueError(
                f"topics.joints is {self.topics.joints}, expected no topic beside recording.joints, or none"
            )
        made = {str(role): fields.topic for role, fields in self.fields.items()}
        for role, fields in self.fields.items():
            needed = _MADE[role] + (("range", "bearing") if role == "sightings" and fields.pose is None else ())
            if lacking := [key for key in needed if getattr(fields, key) is None]:
                raise ValueError(f"fields.{role} lacks {' and '.join(lacking)}, expected the field of each")
            if [*topics, *made.values()].count(fields.topic) > 1:
                raise ValueError(f"{fields.topic} is in fields or joints more than once, expected one role for a topic")
        if topics != self.topics._of_joints or made != self.topics._of_fields:
            read = self.topics.model_copy()
            read._of_joints, read._of_fields = topics, made
            self.__dict__["topics"] = read
        return self

    @property
    def beside(self) -> dict[Role, str]:
        """Topics of the odometries beside the wheels, by role."""
        return {one.role: one.topic for one in self.odometries}


class GateConfig(Section):
    """What is too wrong to enter the graph."""

    max_speed: float = expert(5.0, gt=0, le=1e3, description="of the robot")
    max_yaw_rate: float = expert(10.0, gt=0, le=1e4, description="of the robot")
    max_wheel_rate: float = expert(500.0, gt=0, le=1e6, description="of a joint [rad/s]; ticks exceed it")
    max_position: float = expert(1e6, gt=0, le=1e9, description="of an odometry or truth pose")
    max_range: float = expert(50.0, gt=0, le=1e5, description="of a sighting")
    min_range: float = constant(
        0.0, "a range is positive", ge=0, le=1e5, description="sightings have to be farther off than this"
    )
    max_variance: float = constant(
        1e6, "drivers write 1e6 or more for unknown", gt=0, le=1e12, description="above it a variance says 'unknown'"
    )
    quaternion_tolerance: float = constant(
        0.05,
        "more than rounding is no quaternion",
        gt=0,
        le=1,
        description="less off unit length: normalised; more: rejected",
    )
    gap_s: float = constant(
        1.0,
        "it is reported, and changes no pose",
        gt=0,
        le=1e9,
        description="a silence of a sensor longer than this is reported",
    )
    clock_jump_s: float = constant(
        60.0,
        "shorter ones are silences",
        gt=0,
        le=1e9,
        description="a jump ahead larger than this starts a new segment",
    )
    clock_back_s: float = constant(
        1.0,
        "messages late by less are sorted",
        gt=0,
        le=1e9,
        description="a jump back larger than this starts a new segment",
    )
    _units: dict[Role, float] = PrivateAttr(default_factory=dict)

    min_marker_side_px: float = constant(
        8.0, "of smaller ones the corners are not fitted well", gt=0, le=1e4, description="a smaller marker is rejected"
    )

    def unit_m(self, role: Role) -> float:
        """Unit of a role's distances as its messages have them [m]."""
        return self._units.get(role, 1.0)

    def in_units(self, units: Mapping[Role, float]) -> Self:
        """Copy for messages whose distances are in these units [m], by role."""
        other = self.model_copy()
        other._units = dict(units)
        return other


class KeyframesConfig(Section):
    """When a pose is added to the graph."""

    max_interval_s: float = expert(0.2, ge=0.001, le=60, description="between two poses, at most")
    min_interval_s: float = constant(0.05, "bounds the poses per second", ge=0, le=60)
    reorder_s: float = expert(0.1, ge=0, le=60, description="time in which late messages are put in order")
    history_s: float = constant(
        2.0,
        "the shipped models read 0.8 s",
        ge=0,
        le=60,
        description="commands before a step that the learned motion may read",
    )

    @model_validator(mode="after")
    def _in_order(self) -> KeyframesConfig:
        if self.min_interval_s > self.max_interval_s:
            raise ValueError(f"min_interval_s is {self.min_interval_s}, expected at most max_interval_s")
        return self


class MapConfig(Section):
    """Units and survey of the map, where it does not give sigmas of its own."""

    scale: float = Field(1.0, ge=1e-4, le=1e4, description="metres per unit of positions")
    size_scale: float = expert(1.0, ge=1e-4, le=1e4, description="metres per unit of the map's marker sizes")
    position_sigma_m: float = Field(0.005, ge=0, le=10.0, description="sigma of a landmark, on each axis")
    rotation_sigma_rad: float = expert(0.0087, ge=0, le=1.0, description="sigma of a marker, about each axis")


class EstimatorConfig(Section):
    """The incremental estimator."""

    kind: Literal["fixed_lag", "isam2", "ekf"] = Field(
        "fixed_lag", description="isam2: the whole run; ekf: for comparison"
    )
    ground: Literal["flat", "uneven"] = Field("flat", description="uneven: also height, roll and pitch")
    lag_s: float = expert(10.0, ge=0.05, le=1e5, description="window of the fixed lag")
    relinearize_threshold: float = constant(0.01, "1 cm or 0.6 degrees", ge=1e-6, le=10)
    initial_pose: tuple[_Far, _Far, _Far] | None = Field(None, description="x y [m] yaw [rad]; None: from sightings")
    initial_sigmas: tuple[_Sigma, _Sigma, _Sigma] = expert((0.05, 0.05, 0.05), description="of initial_pose")
    initialise_s: float = expert(5.0, ge=0.01, le=1e5, description="time to collect sightings for the first pose")
    gate_probability: float = constant(
        GATE,
        "one sound sighting in 10 000",
        gt=0,
        lt=1,
        description="a sighting less likely than 1 - this is not fused",
    )
    dead_reckoning_after_s: float = expert(2.0, gt=0, le=1e6, description="without a fix, until DEAD_RECKONING")
    motion_kernel: Literal["none", "huber", "cauchy", "dcs"] = expert(
        "none", description="robust kernel on the wheels, online; for comparison"
    )

    @field_validator("initial_pose")
    @classmethod
    def _is_in_radians(cls, pose: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if pose is not None and abs(pose[2]) > math.tau + 0.01:
            raise ValueError(
                f"the yaw of {pose[2]:g} is more than a turn; expected radians ({pose[2]:g}° are "
                f"{math.radians(pose[2]):.4f})"
            )
        return pose


class Distrust(Section):
    """A time in which a motion source is known to be wrong."""

    source: Annotated[str, AfterValidator(_known_source)]
    start_s: float = Field(ge=-1e9, le=1e9, description="since the first step of the run")
    end_s: float = Field(ge=-1e9, le=1e9)

    @model_validator(mode="after")
    def _in_order(self) -> Distrust:
        if not self.end_s > self.start_s:
            raise ValueError(f"end_s is {self.end_s}, expected more than start_s, {self.start_s}")
        return self


class WeightsConfig(Section):
    """Weights of motion and landmark factors."""

    adaptive: bool = expert(True, description="false: no test of sources; sightings are still gated")
    distrust: tuple[Distrust, ...] = expert((), description="known failures to leave out: `source`, `start_s`, `end_s`")
    window_s: float = constant(
        2.0,
        "part of the fault test",
        ge=0.01,
        le=1e3,
        description="the motion sources are compared over windows of up to this long",
    )
    release_s: float = constant(0.6, "three keyframes", gt=0, le=1e4, description="agreement for this long ends it")
    quarantine_after: int = constant(
        6,
        "fewer may agree by chance",
        gt=0,
        le=1_000_000,
        description="sightings that a displacement has to explain before a landmark is left out as moved",
    )


class BatchConfig(Section):
    """The batch smoother."""

    max_iterations: int = constant(50, "it converges in some ten", ge=1, le=1000, description="of Levenberg–Marquardt")


class LiveConfig(Section):
    """A live run."""

    startup_s: float = expert(
        2.0, ge=0, le=1e6, description="from the first event to the start with the sensors present"
    )
    image_queue: int = constant(
        4, "older images are late", gt=0, le=100_000, description="images that may wait for detection; the oldest goes"
    )


class IntegrityConfig(Section):
    """Bounds on the error of each pose (docs/integrity.md)."""

    risk_per_hour: float = expert(
        1e-3, ge=1e-9, le=0.5, description="that the error exceeds the bound, in an hour of driving"
    )
    alert_m: float | None = Field(None, gt=0, le=1e6, description="alert where the bound on the position is larger")
    alert_yaw_rad: float | None = Field(None, gt=0, le=3.2, description="likewise, on the yaw")


class TruthConfig(Section):
    """Frame of the truth. Only evaluation reads it."""

    yaw_offset_rad: float = Field(0.0, ge=-100, le=100, description="yaw of the tracked body in the base frame")
    offset_m: tuple[_Place, _Place] = Field((0.0, 0.0), description="its origin in the base frame: x y")
    axes: Literal["enu", "ned"] = expert("enu", description="ned: x north, y east, yaw clockwise")
    scale: float = expert(1.0, ge=1e-4, le=1e4, description="metres per unit of positions")
    align: Literal["none", "se2"] = Field("none", description="se2: the truth's frame is not the map's")
    max_gap_s: float = expert(0.2, gt=0, le=1e6, description="longer gaps are not interpolated")


class Config(SensorSections):
    """All settings.

    ``robot.yaml`` holds the parts that differ from these defaults.
    """

    recording: RecordingConfig = RecordingConfig()
    gate: GateConfig = GateConfig()
    keyframes: KeyframesConfig = KeyframesConfig()
    map: MapConfig = MapConfig()
    estimator: EstimatorConfig = EstimatorConfig()
    weights: WeightsConfig = WeightsConfig()
    batch: BatchConfig = BatchConfig()
    live: LiveConfig = LiveConfig()
    integrity: IntegrityConfig = IntegrityConfig()
    truth: TruthConfig = TruthConfig()

    @model_validator(mode="after")
    def _with_topics_of_cameras(self) -> Self:
        """Copy the cameras' topics into `recording.topics`, by which a recording is read."""
        if self.cameras and self.camera != CameraConfig():
            raise ValueError("camera is one camera and cameras are several; give one of the two sections")
        recording = _with_topics(self.recording, self.cameras)
        needed = ((s, getattr(self, s.name, None), getattr(s, "needs", "")) for s in outside_sensors())
        asking = [sensor for sensor, section, key in needed if key and getattr(section, key, None)]
        if asked := {stream.role for sensor in asking for stream in sensor.streams}:
            recording = recording.model_copy(update={"topics": recording.topics.asking(asked)})
        self.__dict__["recording"] = recording
        return self

    def of_camera(self, name: str) -> Config:
        """The configuration of a robot that has this camera alone; the configuration itself for the name ""."""
        if not name:
            return self
        entry, recording = self.cameras[name], self.recording
        own = {key: getattr(entry, key) for key in entry.model_fields_set & CameraConfig.model_fields.keys()}
        image, info, sightings = entry.image or "none", entry.camera_info, entry.sightings or "none"
        topics = _with_topics(recording, {}).topics.model_copy(
            update={"image": image, "camera_info": info, "sightings": sightings}
        )
        alone = {camera_role(name, role): role for role in CAMERA_ROLES}
        read = _renamed(recording, alone, topics=topics, sightings_pose=entry.pose, sightings_axes=entry.axes)
        camera = CameraConfig.model_validate(own)
        return self.model_copy(update={"camera": camera, "cameras": {}, "recording": read})

    def with_camera(self, name: str, alone: Config) -> Config:
        """The configuration after that of `of_camera` was changed: what is the camera's own goes to its section."""
        if not name:
            return alone
        entry, recording = self.cameras[name], alone.recording
        own = {key: getattr(alone.camera, key) for key in alone.camera.model_fields_set}
        if recording.sightings_pose is not None:
            own |= {"pose": recording.sightings_pose, "axes": recording.sightings_axes}
        cameras = {**self.cameras, name: entry.model_copy(update=own)}
        named = {role: camera_role(name, role) for role in CAMERA_ROLES}
        shared = {key: getattr(self.recording, key) for key in ("topics", "sightings_pose", "sightings_axes")}
        read = _renamed(recording, named, **shared)
        return alone.model_copy(update={"camera": self.camera, "cameras": cameras, "recording": read})

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the cameras; ("",) where there is one."""
        return tuple(self.cameras) or ("",)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """With sections of other packages, its class has no name to be found by in another process."""
        if type(self) is Config:
            return super().__reduce_ex__(protocol)
        return config_of, (self.model_dump(exclude_unset=True),)


def _renamed(recording: RecordingConfig, names: Mapping[Role, Role], **changes: Any) -> RecordingConfig:
    """The recording's section with the roles of its stamps under other names, and with further changes."""
    stamps = {
        "received_stamps": tuple(names.get(role, role) for role in recording.received_stamps),
        "stamp_offset_s": {names.get(role, role): s for role, s in recording.stamp_offset_s.items()},
    }
    return recording.model_copy(update=stamps | changes)


def _with_topics(recording: RecordingConfig, cameras: Mapping[str, NamedCameraConfig]) -> RecordingConfig:
    roles = {
        camera_role(name, role): getattr(camera, role) or (None if role == "camera_info" else "none")
        for name, camera in cameras.items()
        for role in CAMERA_ROLES
    }
    if recording.topics.of_cameras == roles:
        return recording
    topics = recording.topics.model_copy()
    topics._cameras = roles
    return recording.model_copy(update={"topics": topics})


def optional_roles() -> dict[Role, tuple[str, str]]:
    """Roles whose topics are looked for only where a setting of their sensor is given: its section and key, by role.

    Their message type says little: most robots have a laser scanner, and few have reflectors.
    """
    return _optional_roles(outside_sensors())


@cache
def _optional_roles(sensors: tuple[type[Any], ...]) -> dict[Role, tuple[str, str]]:
    asked = [sensor for sensor in sensors if getattr(sensor, "optional", False)]
    return {stream.role: (sensor.name, sensor.needs) for sensor in asked for stream in sensor.streams}


def config_type() -> type[Config]:
    """`Config` with a section for each sensor by entry point, under its name."""
    return _with_sensors(outside_sensors())


@cache
def _with_sensors(sensors: tuple[type[Any], ...]) -> type[Config]:
    if not sensors:
        return Config
    for sensor in sensors:
        if sensor.name in Config.model_fields:
            raise ConfigError(f"sensor '{sensor.name}': {sensor.name} is a key of robot.yaml already; rename it")
    roles: dict[str, Any] = {
        s.role: (str | None, None) for sensor in sensors for s in sensor.streams if s.role != ODOMETRIES
    }
    topics = create_model("TopicsConfig", __base__=TopicsConfig, __doc__=TopicsConfig.__doc__, **roles)
    recording = create_model(
        "RecordingConfig", __base__=RecordingConfig, __doc__=RecordingConfig.__doc__, topics=(topics, topics())
    )
    sections: dict[str, Any] = {sensor.name: (sensor.Config, sensor.Config()) for sensor in sensors}
    return create_model(
        "Config", __base__=Config, __doc__=Config.__doc__, recording=(recording, recording()), **sections
    )


def robot_file() -> type[Section]:
    """Model of ``robot.yaml``: sections of users, and ``expert``."""
    return file_type(config_type())


def config_of(content: Any) -> Config:
    """Settings from values in their sections; nothing is under ``expert``, and constants may be among them.

    Raises:
        pydantic.ValidationError: a key or a value is wrong.
    """
    return config_type().model_validate(content)


def config_of_file(content: Any) -> Config:
    """Settings as `load_config` has them, from what a file would say.

    Raises:
        ConfigError: a key is misplaced, or a constant.
        pydantic.ValidationError: a key or a value is wrong.
    """
    refuse_misplaced(content, config_type())
    robot_file().model_validate(content)
    return config_of(joined(content))


def file_content(content: Mapping[str, Any]) -> dict[str, Any]:
    """Values in their sections as ``robot.yaml`` has them: those of experts under ``expert``, and no constants."""
    return parted(content, config_type())


def with_value(config: Config, key: str, value: Any) -> Config:
    """The configuration with one value set, by its key in ``robot.yaml``; a mapping is merged.

    Raises:
        pydantic.ValidationError: the value is wrong.
    """
    *sections, name = key.removeprefix("expert.").split(".")
    content = config.model_dump(mode="json", exclude_unset=True)
    part = content
    for section in sections:
        part = part.setdefault(section, {})
    part[name] = {**part.get(name, {}), **value} if isinstance(value, dict) else value
    return config_of(content)


def setting(key: str) -> str:
    """Key of a value in ``robot.yaml``: ``expert.wheels.delay_s`` for ``wheels.delay_s``."""
    return key_in_file(key, config_type())


def files_of(config: type[Config]) -> Iterator[tuple[str, str]]:
    """Section and key of each setting that is a file."""
    for name, section in config.model_fields.items():
        if isinstance(section.annotation, type) and issubclass(section.annotation, Section):
            for key, field in section.annotation.model_fields.items():
                if Path in (field.annotation, *get_args(field.annotation)):
                    yield name, key


def one_line(value: Any) -> str:
    """A setting's value as YAML in one line; floats to nine decimals."""
    return yaml.safe_dump(_rounded(value), default_flow_style=True, width=1000).removesuffix("\n...\n").strip()


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 9) + 0.0
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, (list, tuple)) else value


def yaml_of(config: Config, folder: Path) -> str:
    """YAML of a configuration for a file in this folder: the values that were given, without the defaults."""
    data = config.model_dump(mode="json", exclude_unset=True)
    for section, key in files_of(type(config)):
        path = getattr(getattr(config, section), key)
        if path is not None:
            data[section][key] = shipped_name(path) or os.path.relpath(path, folder)
    for name, camera in config.cameras.items():
        if camera.file is not None:
            data["cameras"][name]["file"] = os.path.relpath(camera.file, folder)
    return str(yaml.safe_dump(parted(data, type(config)), sort_keys=False, default_flow_style=None, width=110))


def load_config(path: Path) -> Config:
    """Read a YAML configuration. Relative paths in it are relative to the file.

    Raises:
        ConfigError: the file is missing, is not YAML, or has an unknown key or a value out of range; all are named.
    """
    settings = Settings(path, "give a YAML file with --config")
    if isinstance(settings.content.get("landmarks"), list):
        raise ConfigError(f"{path} is a map, expected settings of a robot; give a map with --map")
    for section, key in files_of(config_type()):  # none of them is an expert's
        part = settings.content.get(section)
        if isinstance(part, dict) and isinstance(part.get(key), str) and not part[key].startswith(SHIPPED):
            settings.content[section] = part | {key: path.parent / part[key]}
    cameras = settings.content.get("cameras")
    for camera in cameras.values() if isinstance(cameras, dict) else ():
        if isinstance(camera, dict) and isinstance(camera.get("file"), str):
            camera["file"] = path.parent / camera["file"]
    return settings.validated_in_parts(config_type())
