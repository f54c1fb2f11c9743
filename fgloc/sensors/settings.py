"""Settings of the built-in sensors: their sections of ``robot.yaml``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from fgloc.files.settings import SHIPPED, Section


class NoiseDensity(Section):
    """White-noise densities: standard deviation per square root of distance, rotation or time.

    The variance over a step is the sum of each squared density times the metres, radians and seconds travelled, so that
    splitting a step leaves the covariance as it was.
    """

    x_per_sqrt_m: float = Field(0.03, ge=0, le=100, description="m/√m, along the motion")
    y_per_sqrt_m: float = Field(0.015, ge=0, le=100, description="m/√m, across the motion")
    yaw_per_sqrt_m: float = Field(0.03, ge=0, le=100, description="rad/√m")
    xy_per_sqrt_rad: float = Field(0.01, ge=0, le=100, description="m/√rad")
    yaw_per_sqrt_rad: float = Field(0.05, ge=0, le=100, description="rad/√rad")
    xy_per_sqrt_s: float = Field(0.002, ge=0, le=100, description="m/√s, also at rest")
    yaw_per_sqrt_s: float = Field(0.002, ge=0, le=100, description="rad/√s, also at rest")


class WheelsConfig(Section):
    """Wheel odometry."""

    source: Literal["auto", "twist", "pose", "ticks", "command", "none"] = Field(
        "auto",
        description="twist or pose differences of the odometry, wheel angles of the joints, or (no encoder) the "
        "commands; auto: ticks if the wheels' geometry is given, else pose unless it does not move or its heading is "
        "not that of its motion, else twist, else command",
    )
    left_joint: str | None = None
    right_joint: str | None = None
    left_radius: float | None = Field(None, ge=1e-3, le=2.0, description="m")
    right_radius: float | None = Field(None, ge=1e-3, le=2.0, description="m")
    track: float | None = Field(None, ge=1e-3, le=5.0, description="m, between the wheels' contact points")
    angle_range: float | None = Field(
        None, ge=1e-3, le=1e9, description="rad: the angle rolls over after this much; None: never"
    )
    scale_v: float = Field(1.0, ge=1e-3, le=1e3, description="true over reported forward speed")
    scale_omega: float = Field(
        1.0, ge=-1e3, le=1e3, description="true over reported yaw rate; negative: it counts clockwise"
    )
    yaw_per_m: float = Field(0.0, ge=-1, le=1, description="rad/m: yaw gained going straight, by unequal wheels")
    slowdown: float = Field(
        0.0, ge=0, le=5.0, description="s/rad: share of the forward speed lost per rad/s of reported turning"
    )
    delay_s: float = Field(0.0, ge=0, le=2.0, description="the robot moves this long after the message")
    hold_s: float = Field(0.5, gt=0, le=60, description="a twist is held for this long when the next one is missing")
    zero_speed: float = Field(0.0, ge=0, le=10, description="m/s below which a reported speed is rest")
    zero_yaw_rate: float = Field(0.0, ge=0, le=10, description="rad/s below which a reported rate is rest")
    noise: NoiseDensity = NoiseDensity()
    scale_sigma: float = Field(
        0.01,
        ge=0,
        le=0.5,
        description="how far the radii of both wheels may be off alike; estimated, as all sigmas here",
    )
    turn_scale_sigma: float = Field(0.01, ge=0, le=0.5, description="how far the track may be off")
    time_offset_sigma_s: float = Field(
        0.005, ge=0, le=1.0, description="s: how far their clock may be off that of the gyro; estimated"
    )
    yaw_per_m_sigma: float = Field(
        0.015,
        ge=0,
        le=1,
        description="rad/m: how far yaw_per_m may be off: 0.4 % of unequal radii at a track of 0.26 m",
    )
    slowdown_sigma: float = Field(0.0, ge=0, le=5.0, description="s/rad: how far slowdown may be off")
    delay_sigma_s: float = Field(0.0, ge=0, le=1.0, description="s: how far delay_s may be off")


class GyroConfig(Section):
    """Yaw rate of an IMU, as a motion source of its own (unless the learned motion reads it already)."""

    use: bool = True
    scale: float = Field(1.0, ge=-1e3, le=1e3, description="true over reported rate; negative: it turns the other way")
    yaw_per_sqrt_s: float = Field(0.002, ge=1e-6, le=10, description="rad/√s: white noise of the integrated rate")
    scale_sigma: float = Field(0.005, ge=0, le=0.5, description="how far the rate's scale may be off; estimated")
    bias_sigma: float = Field(0.02, ge=1e-6, le=10, description="rad/s, before anything is known of the bias")
    tilt_sigma_rad: float = Field(
        0.0087, ge=0, le=0.5, description="rad: roll and pitch that the mounting is off by; estimated on uneven ground"
    )
    level_sigma_rad: float = Field(
        0.005,
        ge=0,
        le=0.5,
        description="rad: tilt that the accelerometer's bias makes, in roll and pitch; estimated on uneven ground",
    )
    acceleration_sigma: float = Field(
        0.15, ge=1e-3, le=100, description="m/s²: of the specific force of a step, beside gravity; on uneven ground"
    )
    bias_walk: float = Field(0.0003, ge=0, le=10, description="rad/s/√s")


class CameraConfig(Section):
    """The camera, where the recording does not say."""

    file: Path | None = Field(None, description="ROS calibration YAML or Kalibr YAML; None: CameraInfo")
    rescale: bool = Field(False, description="scale the calibration to the image size instead of refusing")
    focal_scale: float = Field(1.0, ge=0.01, le=100, description="true focal length over that of the calibration")
    cx_px: float | None = Field(
        None, ge=-1e5, le=1e5, description="px: principal point; None, as below: the calibration's"
    )
    cy_px: float | None = Field(None, ge=-1e5, le=1e5, description="px")
    k1: float | None = Field(None, ge=-100, le=100, description="of plumb_bob; other models are taken as they are")
    k2: float | None = Field(None, ge=-100, le=100)
    position_sigma_m: float = Field(
        0.003, ge=0, le=1.0, description="m: how far off it is mounted, on each axis; estimated"
    )
    rotation_sigma_rad: float = Field(0.007, ge=0, le=0.5, description="rad: likewise, about each axis (0.4 degrees)")
    focal_sigma: float = Field(0.003, ge=0, le=0.5, description="how far the focal length may be off, as a share")
    principal_sigma_px: float = Field(2.0, ge=0, le=100.0, description="px: how far the principal point may be off")
    distortion_sigma: float = Field(0.005, ge=0, le=0.5, description="how far k1 and k2 may be off")
    time_offset_sigma_s: float = Field(
        0.012,
        ge=0,
        le=1.0,
        description="s: how far its clock may be off that of the gyro (without one: of the wheels); estimated",
    )
    time_jitter_s: float = Field(0.002, ge=0, le=0.1, description="s: what each stamp is off by on its own")


class LandmarksConfig(Section):
    """Range/bearing and marker-pose sightings."""

    range_sigma_m: float = Field(0.1, ge=1e-4, le=100)
    range_sigma_per_m: float = Field(0.0, ge=0, le=10, description="added range sigma per metre of range")
    bearing_sigma_rad: float = Field(0.02, ge=1e-5, le=3.2)
    range_scale: float = Field(1.0, ge=1e-4, le=1e4, description="true over reported range")
    range_along_axis: bool = Field(
        False, description="the reported range is the distance along the sensor's axis: divided by cos(bearing)"
    )
    range_bias_m: float = Field(0.0, ge=-100, le=100, description="subtracted from the reported range")
    bearing_bias_rad: float = Field(0.0, ge=-6.3, le=6.3, description="subtracted from the reported bearing")
    range_scale_sigma: float = Field(
        0.005, ge=0, le=0.5, description="how far range_scale may be off; estimated during the run"
    )
    bearing_bias_sigma_rad: float = Field(
        0.007, ge=0, le=0.5, description="how far bearing_bias_rad may be off; estimated during the run"
    )
    time_offset_sigma_s: float = Field(
        0.012, ge=0, le=1.0, description="s: how far the sensor's clock may be off that of gyro or wheels; estimated"
    )
    yaw_sigma_rad: float | None = Field(
        None,
        ge=1e-5,
        le=3.2,
        description="of a marker pose's yaw; None: marker poses are used as range and bearing only",
    )
    cauchy_k: float = Field(
        3.0, ge=0.01, le=1e6, description="sigmas: Cauchy kernel, on unknown maps and in fits of a pose"
    )
    min_sightings: int = Field(
        3, gt=0, le=1_000_000, description="sightings that an unknown landmark needs before it is used"
    )
    repeat_s: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="correlation time of one landmark's errors: sightings closer than this share their information",
    )


class MarkersConfig(Section):
    """Marker detection in images."""

    dictionary: str | None = Field(None, description='OpenCV name, "DICT_4X4_50"; None: the map\'s')
    default_size_m: float | None = Field(None, ge=1e-3, le=5.0, description="side, for maps that give none")
    sigma_px: float = Field(0.5, ge=1e-3, le=100, description="noise of one corner coordinate")
    blur_s: float = Field(
        2e-4,
        ge=0,
        le=0.1,
        description="s: a blurred corner is off by as much as the image moves in this time (3 % of 6 ms)",
    )
    cauchy_k: float = Field(
        3.0, ge=0.01, le=1e6, description="sigmas: Cauchy kernel, on unknown maps and in fits of a pose"
    )
    max_sightings: int = Field(12, gt=0, le=1000, description="the largest markers of an image that are used")


MODELS = Path(__file__).parent / "learned" / "models"


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
        None,
        description="a .safetensors file that fgloc train wrote, or a shipped one: shipped:sim/diff_drive",
    )
    use: bool = True
    scale: float = Field(1.0, ge=0.01, le=100, description="this robot's distance over the model's")
    scale_sigma: float = Field(
        0.01, ge=0, le=0.5, description="how far this robot may be faster or slower than the model's; estimated"
    )
    correlation: Literal["joint", "independent"] = Field(
        "joint", description="joint: decorrelated from the wheels; independent: counted twice (for comparison)"
    )


MOTION_SOURCES = ("wheels", "learned", "gyro")
"""Names of the motion sources: of their measurements, in ``steps.csv``, of their parameters of the installation."""


class SensorSections(Section):
    """Settings of the built-in sensors, by their keys of ``robot.yaml``: one line each."""

    wheels: WheelsConfig = WheelsConfig()
    gyro: GyroConfig = GyroConfig()
    camera: CameraConfig = CameraConfig()
    markers: MarkersConfig = MarkersConfig()
    landmarks: LandmarksConfig = LandmarksConfig()
    motion: MotionConfig = MotionConfig()
