"""Settings of the wheels."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from fgloc.files.section import Section
from fgloc.sensors.noise_density import NoiseDensity


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
