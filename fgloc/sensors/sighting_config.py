"""Settings that the sensors of landmarks share: ranges, bearings and poses, and the camera."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from fgloc.files.section import Section


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
    cauchy_k: float = Field(3.0, ge=0.01, le=1e6, description="Cauchy constant in units of sigma")
    min_sightings: int = Field(
        3, gt=0, le=1_000_000, description="sightings that an unknown landmark needs before it is used"
    )
    repeat_s: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="correlation time of one landmark's errors: sightings closer than this share their information",
    )
