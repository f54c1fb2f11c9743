"""Every parameter of a simulated run: robot, world, sensors, control. Strict: unknown keys are errors.

The contact and motor figures were measured: with them true and wheel motion agree on a grippy floor, and wheels slip
by friction where the floor is not.
"""

from __future__ import annotations

from typing import Literal

import cv2
from pydantic import Field, model_validator

from fgloc_datasets.sim.floor import Floor
from fgloc_datasets.sim.installation import NamedInstallation
from fgloc_datasets.sim.section import Positive, Section, Vector2, Vector3

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
    """A wheeled robot. The base frame lies on the floor between the wheels."""

    kind: Literal["diff_drive", "skid_steer"] = "diff_drive"
    mass_kg: Positive = 6.0
    wheel_mass_kg: Positive = 0.2
    radius_m: Positive = 0.05  # nominal: what the odometry believes
    radius_scale: Vector2 = (1.0, 1.0)  # true over nominal, left and right
    wheel_width_m: Positive = 0.03
    track_m: Positive = 0.26
    track_scale: Positive = 1.0  # what regulator and odometry believe over the true track (skid-steer: more than 1)
    wheelbase_m: Positive = 0.24  # skid-steer only
    caster_behind_m: Positive = 0.12  # differential drive only
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
    uwb: Uwb | None = None
    gnss: Gnss | None = None
    rates: Rates = Rates()
    latency: Latency = Latency()
    control: Control = Control()
    installation: NamedInstallation = None  # perfect: all is exactly as written
