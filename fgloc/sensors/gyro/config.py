"""Settings of the gyro."""

from __future__ import annotations

from pydantic import Field

from fgloc.files.section import Section


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
