"""The gyro as the rate sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fgloc.sensors.gyro.installation import INSTALLATION
from fgloc.sensors.roles import RateErrors, RateRole
from fgloc.types import FloatArray

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.sensors.equipment import RateSensor


def _build(config: Config, up: FloatArray) -> RateSensor:
    from fgloc.sensors.gyro.rate import Gyro

    return Gyro(config.gyro, up)


def _errors(config: Config) -> RateErrors:
    return RateErrors(config.gyro.yaw_per_sqrt_s, config.gyro.scale_sigma, config.gyro.bias_sigma)


ROLE = RateRole(
    installation=INSTALLATION,
    build=_build,
    errors=_errors,
    is_used=lambda config: config.gyro.use,
    scale=lambda config: config.gyro.scale,
)
