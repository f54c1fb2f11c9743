"""Every parameter of a simulated run: robot, floor, world, sensors, control, installation. Unknown keys are errors.

The contact and motor figures were measured: with them true and wheel motion agree on a grippy floor, and wheels slip
by friction where the floor is not.

`Installation` says how far a robot, its camera and the markers are from what is written of them: an installer
measures where markers hang, calibrates the camera, copies a wheel's radius from its data sheet, and is never quite
right. What stands beside the bag or in it (``map.yaml``, ``robot.yaml``, ``camera_info``, ``tf_static``) is what the
installer believes; ``installed.yaml`` is the truth.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from fgloc.types import FloatArray

# --- Sections ---------------------------------------------------------------------------------------------------------

Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
FRONT, REAR = "camera", "rear"
"""Names of the cameras."""


class Section(BaseModel):
    """A part of a scenario: unknown keys are errors, values are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def channel_rng(seed: int, channel: str) -> np.random.Generator:
    """A generator of its own for each use, so that adding one draw does not change the others."""
    return np.random.default_rng([seed, *channel.encode()])


# --- Floors -----------------------------------------------------------------------------------------------------------


class Patch(Section):
    """A piece of floor with its own friction. ``points`` only for a polygon, relative to the center."""

    shape: Literal["ellipse", "rectangle", "polygon"] = "ellipse"
    center: Vector2
    size: Vector2 = (1.0, 1.0)  # full length and width
    yaw_deg: float = 0.0
    points: tuple[Vector2, ...] = ()
    mu: Positive


class RandomPatches(Section):
    """Patches of all shapes, drawn by the seed."""

    count: int = Field(ge=0)
    mu: Vector2 = (0.04, 0.15)
    size_m: Vector2 = (0.6, 1.6)


class Ramp(Section):
    """Up, level, down along x."""

    start_x: float
    angle_deg: Positive = 7.0
    rise_m: Positive = 1.0  # horizontal length of each slope
    top_m: Positive = 1.0
    center_y: float = 0.0
    width_m: Positive = 2.0


class Humps(Section):
    """Smooth humps drawn by the seed."""

    count: int = Field(ge=0)
    height_m: Vector2 = (0.01, 0.03)
    sigma_m: Vector2 = (0.12, 0.25)


class Tilt(Section):
    """The whole floor leans; it keeps its height in the middle of the room."""

    slope_deg: float = Field(gt=0, le=15)
    direction_deg: float = 0.0  # in which it rises

    def height(self, x: float | FloatArray, y: float | FloatArray) -> float | FloatArray:
        """Height [m] at a place [m]."""
        c, s = math.cos(math.radians(self.direction_deg)), math.sin(math.radians(self.direction_deg))
        return math.tan(math.radians(self.slope_deg)) * (c * x + s * y)


class Rough(Section):
    """A random field of heights, drawn by the seed: from ``height_m`` below the floor to ``height_m`` above it."""

    height_m: Positive = 0.03
    length_m: float = Field(0.3, ge=0.1)  # standard deviation of the Gaussian that smooths white noise


class Floor(Section):
    """Friction and height of the ground."""

    mu: Positive = 0.8
    patches: tuple[Patch, ...] = ()
    random_patches: RandomPatches | None = None
    ramp: Ramp | None = None
    humps: Humps | None = None
    ramps: tuple[Ramp, ...] = ()  # further ones
    tilt: Tilt | None = None
    rough: Rough | None = None

    @property
    def uneven(self) -> bool:
        """Whether there is any height at all."""
        return bool(self.ramp or self.humps or self.ramps or self.tilt or self.rough)


# --- Installation -----------------------------------------------------------------------------------------------------

Spread = Annotated[float, Field(ge=0)]
_NAMES = ("as_installed", "perfect")


class Installation(Section):
    """Errors of an installation; each is drawn by the seed on a channel of its own. All are 0 unless given.

    So ``Installation()`` has no error at all, ``Installation(marker_position_m=0.005)`` one of a single kind (the very
    draw that it has among others), and ``Installation.as_installed()`` those of a careful person. In YAML:
    ``installation: as_installed``, or ``installation: {marker_position_m: 0.005}``.
    """

    marker_position_m: Spread = 0.0  # sigma per axis, of what the map says
    marker_direction_deg: Spread = 0.0  # sigma, about the vertical
    marker_tilt_deg: Spread = 0.0  # sigma, about the marker's right and about its normal
    camera_position_m: Spread = 0.0  # sigma per axis, of what tf says
    camera_angle_deg: Spread = 0.0  # sigma per axis
    focal_share: float = Field(0.0, ge=0, lt=0.5)  # plus or minus, uniform, fx and fy alike
    principal_point_px: Spread = 0.0  # plus or minus per axis, uniform
    distortion_k1: Spread = 0.0  # sigma
    distortion_k2: Spread = 0.0  # sigma
    camera_time_s: Spread = 0.0  # plus or minus, uniform: by how much stamps are later than the middle of the exposure
    camera_jitter_s: Spread = 0.0  # sigma, anew for each image
    wheel_time_s: Spread = 0.0  # plus or minus, uniform: of /odom and /joint_states, which are one packet
    imu_time_s: Spread = 0.0  # plus or minus, uniform
    wheel_radius_share: float = Field(0.0, ge=0, lt=0.5)  # plus or minus, uniform, both wheels: true over believed
    wheel_difference_share: float = Field(0.0, ge=0, lt=0.5)  # plus or minus, uniform: left over right
    track_share: float = Field(0.0, ge=0, lt=0.5)  # plus or minus, uniform: true over believed
    wheelbase_share: float = Field(0.0, ge=0, lt=0.5)  # plus or minus, uniform: true over believed
    steering_zero_deg: Spread = 0.0  # plus or minus, uniform: of an Ackermann robot's wheels where 0 is reported
    steering_share: float = Field(0.0, ge=0, lt=0.5)  # plus or minus, uniform: true angle over the reported one
    imu_angle_deg: Spread = 0.0  # sigma per axis
    gyro_scale_share: float = Field(0.0, ge=0, lt=0.1)  # sigma

    @classmethod
    def as_installed(cls) -> Installation:
        """Errors of a careful installation: tape measure and spirit level, checkerboard, data sheet, no common clock.

        A checkerboard seldom reaches the image's corners: k1 and k2 stay uncertain by some thousandths. 0.005 of each
        is 0.15 px half way to the corner of a camera of 640 x 480 at 525 px, where boards were seen, and 1.3 px in it.
        """
        return cls(
            marker_position_m=0.005,
            marker_direction_deg=0.5,
            marker_tilt_deg=0.5,
            camera_position_m=0.003,
            camera_angle_deg=0.4,
            focal_share=0.005,
            principal_point_px=3.0,
            distortion_k1=0.005,
            distortion_k2=0.005,
            camera_time_s=0.020,
            camera_jitter_s=0.002,
            wheel_time_s=0.005,
            imu_time_s=0.005,
            wheel_radius_share=0.01,
            wheel_difference_share=0.004,
            track_share=0.015,
            wheelbase_share=0.01,
            steering_zero_deg=1.0,
            steering_share=0.02,
            imu_angle_deg=0.5,
            gyro_scale_share=0.005,
        )


def _named(value: Any) -> Any:
    """Read the names that stand for whole installations."""
    if not isinstance(value, str):
        return value
    if value not in _NAMES:
        raise ValueError(f"installation {value!r} is not known; expected {' or '.join(_NAMES)}, or a mapping of errors")
    return None if value == "perfect" else Installation.as_installed()


NamedInstallation = Annotated[Installation | None, BeforeValidator(_named)]


# --- Robot ------------------------------------------------------------------------------------------------------------


class Contact(Section):
    """How wheels touch the floor (MuJoCo's contact parameters)."""

    timestep_s: Positive = 0.001
    solref: Vector2 = (0.008, 1.0)
    solimp: tuple[float, float, float, float, float] = (0.95, 0.99, 0.001, 0.5, 2.0)
    impratio: Positive = 10.0
    torsional_friction: float = 0.003  # m
    rolling_friction: float = 0.0002  # m
    caster_friction: float = 0.05


class Motor(Section):
    """A DC motor per wheel under a PI speed regulator: it lags, overshoots, saturates, and droops on slopes."""

    supply_v: Positive = 12.0
    stall_torque_nm: Positive = 0.9
    no_load_rad_s: Positive = 24.0
    kp: float = 1.2  # V per rad/s
    ki: float = 8.0  # V per rad
    regulator_hz: Positive = 100.0
    armature: float = 0.008  # kg m², of the rotor through the gear
    damping: float = 0.004  # Nm s
    friction_nm: float = 0.01
    effort_noise_nm: float = 0.01  # of the measured torque (motor current)


class Payload(Section):
    """A load on a rail that is moved during the run."""

    mass_kg: Positive = 3.0
    start: Vector3 = (0.0, 0.0, 0.12)
    end: Vector3 = (-0.06, 0.08, 0.12)
    shift_at_s: float = Field(60.0, ge=0)


class Robot(Section):
    """A wheeled robot. The base frame lies on the floor between the wheels; of an Ackermann robot, the rear ones."""

    kind: Literal["diff_drive", "skid_steer", "ackermann", "mecanum"] = "diff_drive"
    mass_kg: Positive = 6.0
    wheel_mass_kg: Positive = 0.2
    radius_m: Positive = 0.05  # nominal: what the odometry believes
    radius_scale: Vector2 = (1.0, 1.0)  # true over nominal, left and right
    wheel_width_m: Positive = 0.03
    track_m: Positive = 0.26
    track_scale: Positive = 1.0  # what regulator and odometry believe over the true track (skid-steer: more than 1)
    wheelbase_m: Positive = 0.24  # not of a differential drive
    wheelbase_scale: Positive = 1.0  # what regulator and odometry believe over the true one
    caster_behind_m: Positive = 0.12  # differential drive only
    steering_zero_rad: float = 0.0  # Ackermann only: angle of the wheels where the steering reports 0
    steering_ratio: Positive = 1.0  # true angle over the reported one
    max_steering_rad: float = Field(0.55, gt=0, lt=1.2)
    steering_rad_s: Positive = 3.0  # rate of the steering's set point
    rollers: int = Field(10, ge=6, le=16)  # of a mecanum wheel
    center_of_mass: Vector3 = (-0.02, 0.01, 0.045)
    chassis: Vector3 = (0.30, 0.20, 0.08)  # length, width, height
    payload: Payload | None = None
    ticks_per_turn: int = Field(2048, gt=0)
    motor: Motor = Motor()
    contact: Contact = Contact()
    command_delay_s: float = Field(0.03, ge=0)  # from the command's stamp to the regulator
    max_v: Positive = 0.6  # m/s
    max_omega: Positive = 1.8  # rad/s
    max_acceleration: Positive = 3.0  # m/s², of the set point
    max_angular_acceleration: Positive = 15.0  # rad/s²


class Imu(Section):
    """Gyro and accelerometer: constant bias drawn once, a slow walk of the gyro's, white noise."""

    gyro_noise: float = 0.004  # rad/s per sample
    gyro_bias: float = 0.005  # rad/s, sigma of the draw
    gyro_walk: float = 0.0002  # rad/s/√s
    accel_noise: float = 0.05  # m/s²
    accel_bias: float = 0.05  # m/s²
    position: Vector3 = (0.0, 0.0, 0.08)


class Camera(Section):
    """A gray camera with a linear response, a lens and an automatic exposure that lengthens before it amplifies."""

    rate_hz: Positive = 10.0
    width: int = Field(640, gt=0)
    height: int = Field(480, gt=0)
    focal_px: Positive = 525.0
    distortion: tuple[float, float, float, float, float] = (-0.12, 0.04, 0.0005, -0.0003, 0.0)  # plumb_bob
    position: Vector3 = (0.10, 0.0, 0.25)  # in the base frame
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)  # of the forward looking body axes
    blur_px: float = Field(0.7, ge=0)  # sigma of the lens's point spread
    motion_blur: bool = True
    exposure_s: Positive = 0.006  # in full light
    max_exposure_s: Positive = 0.033
    max_gain: float = Field(4.0, ge=1.0)
    exposure_lag_s: Positive = 0.4  # time constant of the automatic exposure
    noise: float = 2.3  # gray levels at gain 1
    jpeg_quality: int = Field(80, ge=1, le=100)
    oversampling: Positive = 1.5  # rendered pixels per image pixel and axis


class Uwb(Section):
    """Ultra-wideband ranges from a tag to anchors along the walls, one anchor after the other."""

    rate_hz: Positive = 20.0  # ranges, of all anchors together
    anchors: int = Field(6, gt=0, le=100)
    heights_m: Vector2 = (1.6, 2.4)  # of the anchors, in turns
    tag: Vector3 = (-0.05, 0.0, 0.30)  # in the base frame
    sigma_m: Positive = 0.1
    nlos_share: float = Field(0.0, ge=0, lt=1)  # of an anchor's time, without line of sight ...
    nlos_s: Positive = 2.0  # ... for so long at a time, on average ...
    nlos_mean_m: Positive = 1.0  # ... and all ranges of that time too long by one draw


class Gnss(Section):
    """Positions of a receiver with carrier-phase corrections from a base station."""

    rate_hz: Positive = 5.0
    origin: Vector3 = (48.137154, 11.576124, 519.0)  # of the map: latitude, longitude [degrees], altitude [m]
    yaw_rad: float = 0.3  # of the map's x axis from east
    antenna: Vector3 = (0.05, 0.0, 0.35)  # in the base frame
    sigma_m: Positive = 0.02  # east and north
    multipath_share: float = Field(0.0, ge=0, lt=1)  # of the time ...
    multipath_s: Positive = 1.0  # ... for so long at a time, on average ...
    multipath_mean_m: Positive = 2.0  # ... and all positions of that time off by one draw


class Rates(Section):
    """How often each channel speaks [Hz]."""

    command: Positive = 20.0
    odometry: Positive = 50.0
    imu: Positive = 100.0
    truth: Positive = 50.0


class Latency(Section):
    """From stamp to recorder [s]: the least, and the mean of an exponential rest."""

    command: Vector2 = (0.0005, 0.0005)
    odometry: Vector2 = (0.002, 0.001)
    imu: Vector2 = (0.001, 0.0005)
    camera: Vector2 = (0.030, 0.004)
    truth: Vector2 = (0.004, 0.001)
    uwb: Vector2 = (0.005, 0.002)
    gnss: Vector2 = (0.060, 0.010)


# --- World ------------------------------------------------------------------------------------------------------------


class PlacedMarker(Section):
    """A marker anywhere in the room: on a post, on the ceiling, on the floor."""

    id: int = Field(ge=0)
    position: Vector3  # m, of its center
    facing_deg: float  # yaw of its normal
    elevation_deg: float = Field(0.0, ge=-90, le=90)  # of its normal above the horizon
    roll_deg: float = 0.0  # about its normal, counter-clockwise as seen


class Markers(Section):
    """Square markers on the walls, above the ground there, and wherever they are placed."""

    count: int = Field(14, ge=0)
    size_m: Positive = 0.20  # of the black square
    dictionary: str = "DICT_4X4_50"
    heights_m: Vector2 = (0.22, 0.50)  # of the centers
    placed: tuple[PlacedMarker, ...] = ()  # besides; those on the walls have the ids below `count`

    @model_validator(mode="after")
    def _has_enough_ids(self) -> Markers:
        known = getattr(cv2.aruco, self.dictionary, None)
        if known is None:
            raise ValueError(f"dictionary {self.dictionary!r} is not one of OpenCV's (DICT_4X4_50, ...)")
        ids = len(cv2.aruco.getPredefinedDictionary(known).bytesList)
        given = [marker.id for marker in self.placed]
        wrong = [i for i in given if not self.count <= i < ids or given.count(i) > 1]
        if wrong:
            raise ValueError(f"placed marker {wrong[0]}: expected ids from {self.count} to {ids - 1}, each once")
        if self.count > ids:
            raise ValueError(f"{self.count} markers, but {self.dictionary} has {ids}; take fewer or a larger one")
        return self


class LightStep(Section):
    """From ``at_s`` on the light has this level (1 is full)."""

    at_s: float = Field(ge=0)
    level: float = Field(gt=0, le=1.0)


class Occlusion(Section):
    """Screens stand in front of markers for a while."""

    start_s: float = Field(ge=0)
    end_s: float
    share: float = Field(1.0, gt=0, le=1.0)  # of the markers, drawn by the seed


class World(Section):
    """A room with its floor, markers and light."""

    size_m: Vector2 = (6.0, 5.0)
    wall_height_m: Positive = 1.4
    keep_off_m: float = Field(0.7, ge=0)  # the driver turns back before walls
    markers: Markers = Markers()
    floor: Floor = Floor()
    light: tuple[LightStep, ...] = ()
    occlusions: tuple[Occlusion, ...] = ()


# --- Control ----------------------------------------------------------------------------------------------------------

ControlKind = Literal[
    "straight", "turns", "steps", "ramps", "sines", "random_walk", "stop_and_go", "figure_eight", "spiral", "spin"
]


class Control(Section):
    """A set of control functions vʲ(t), one after the other, drawn by the seed; or a waypoint follower.

    Source: the paper's eq. 1, a set of control functions that covers the robot's velocities.
    """

    functions: tuple[ControlKind, ...] = ("straight", "turns", "steps", "ramps", "sines", "random_walk", "figure_eight")
    segment_s: Positive = 15.0
    waypoints: tuple[Vector2, ...] = ()  # if any: followed in a circle instead
    speed: Positive = 0.4  # m/s, of the waypoint follower
    rest_s: float = Field(1.0, ge=0)  # at the start


class Scenario(Section):
    """One kind of run, complete but for the seed."""

    name: str = Field(pattern=r"^[a-z0-9_]+$")
    description: str = ""
    duration_s: Positive = 60.0
    start: Vector3 = (0.0, 0.0, 0.0)  # x, y [m], yaw [rad]
    robot: Robot = Robot()
    world: World = World()
    imu: Imu = Imu()
    camera: Camera | None = Camera()
    rear: Camera | None = None  # a second camera; corners of both are found in the same light
    uwb: Uwb | None = None
    gnss: Gnss | None = None
    rates: Rates = Rates()
    latency: Latency = Latency()
    control: Control = Control()
    installation: NamedInstallation = None  # perfect: all is exactly as written

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras by the names that their topics and frames begin with."""
        return {name: c for name, c in ((FRONT, self.camera), (REAR, self.rear)) if c is not None}
