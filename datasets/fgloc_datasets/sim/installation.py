"""How far a robot, its camera and the markers are from what is written of them.

An installer measures where markers hang, calibrates the camera, copies a wheel's radius from its data sheet, and is
never quite right. What stands beside the bag or in it (``map.yaml``, ``robot.yaml``, ``camera_info``, ``tf_static``) is
what the installer believes; ``installed.yaml`` is the truth.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from fgloc_datasets.sim.section import Section

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
    imu_angle_deg: Spread = 0.0  # sigma per axis
    gyro_scale_share: float = Field(0.0, ge=0, lt=0.1)  # sigma

    @classmethod
    def as_installed(cls) -> Installation:
        """What a careful person leaves: tape measure and spirit level, checkerboard, data sheet, no common clock.

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
