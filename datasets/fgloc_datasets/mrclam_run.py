"""What MRCLAM's files say of one robot, and the constants of its configuration."""

from __future__ import annotations

from dataclasses import dataclass

from fgloc.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Calibration:
    """Constants of ``robot.yaml``, named as in `fgloc.config`."""

    scale_v: float
    scale_omega: float
    delay_s: float
    yaw_per_m: float  # rad/m
    x_per_sqrt_m: float
    y_per_sqrt_m: float
    yaw_per_sqrt_m: float
    xy_per_sqrt_rad: float
    yaw_per_sqrt_rad: float
    xy_per_sqrt_s: float
    yaw_per_sqrt_s: float
    range_scale: float
    camera_x: float  # m, in the base frame
    bearing_bias_rad: float
    latency_s: float
    range_sigma_m: float
    range_sigma_per_m: float
    bearing_sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One robot's files. Stamps are integer nanoseconds, in order."""

    commands_ns: IntArray  # (n,)
    commands: FloatArray  # (n, 2) v [m/s], omega [rad/s]
    sightings_ns: IntArray  # (m,)
    subjects: IntArray  # (m,) landmark ids, 6 to 20
    sightings: FloatArray  # (m, 2) reported range [m], bearing [rad]
    truth_ns: IntArray  # (k,)
    truth: FloatArray  # (k, 3) x, y [m], yaw [rad]
    landmarks: dict[int, tuple[float, float]]  # subject -> x, y [m]
    robots_left_out: int  # sightings of other robots
    unknown_left_out: int  # sightings of barcodes that no subject carries
