"""White noise of a motion: settings that the motion sources share."""

from __future__ import annotations

from pydantic import Field

from fgloc.files.section import Section


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
