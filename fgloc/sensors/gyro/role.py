"""The gyro as the rate sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fgloc.sensors.gyro.installation import BIASES, INSTALLATION, LEVELS, TILTS
from fgloc.sensors.roles import AttitudeNames, RateErrors, RateRole
from fgloc.types import FloatArray

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.sensors.equipment import AttitudeSensor, RateSensor


def _build(config: Config, up: FloatArray) -> RateSensor:
    from fgloc.sensors.gyro.rate import Gyro

    return Gyro(config.gyro, up)


def _errors(config: Config) -> RateErrors:
    return RateErrors(config.gyro.yaw_per_sqrt_s, config.gyro.scale_sigma, config.gyro.bias_sigma)


def _attitude(config: Config, T_base_imu: FloatArray) -> AttitudeSensor:
    from fgloc.sensors.gyro.attitude import Attitude

    return Attitude(config.gyro, T_base_imu)


ROLE = RateRole(
    installation=INSTALLATION,
    build=_build,
    errors=_errors,
    is_used=lambda config: config.gyro.use,
    scale=lambda config: config.gyro.scale,
    attitude=_attitude,
    attitude_names=AttitudeNames(BIASES, TILTS, LEVELS),
)
