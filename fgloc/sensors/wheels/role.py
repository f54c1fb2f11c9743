"""The wheels as the odometer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from fgloc.sensors.base import RawMistake
from fgloc.sensors.roles import OdometerErrors, OdometerRole, SetupMistake, with_values
from fgloc.sensors.wheels.installation import INSTALLATION
from fgloc.types import Event

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.sensors.equipment import Odometer

_FREED = {"scale_sigma": 0.2, "turn_scale_sigma": 0.2, "yaw_per_m_sigma": 0.2}  # priors before anything was seen
_FREED_COMMANDS = _FREED | {"slowdown_sigma": 1.0, "delay_sigma_s": 0.2}


def _build(config: Config) -> Odometer:
    from fgloc.sensors.wheels.motion import WheelMotion

    return WheelMotion(config.wheels)


def _errors(config: Config) -> OdometerErrors:
    wheels = config.wheels
    return OdometerErrors(
        noise=wheels.noise,
        scale_sigma=wheels.scale_sigma,
        turn_scale_sigma=wheels.turn_scale_sigma,
        yaw_per_m_sigma=wheels.yaw_per_m_sigma,
        time_offset_sigma_s=wheels.time_offset_sigma_s,
    )


def _freed(config: Config) -> tuple[Config, ...]:
    of_commands = with_values(config, "wheels", _FREED_COMMANDS)
    return (of_commands,) if config.wheels.source == "command" else (with_values(config, "wheels", _FREED), of_commands)


def _correct(mistake: SetupMistake, config: Config) -> RawMistake:
    from fgloc.sensors.wheels.corrections import correct

    return correct(mistake, config)


def _by_angles(events: Sequence[Event]) -> dict[str, Any] | None:
    from fgloc.sensors.wheels.geometry import settings_of

    return settings_of(events)


ROLE = OdometerRole(
    installation=INSTALLATION,
    build=_build,
    errors=_errors,
    freed=_freed,
    distance_gain="wheels.scale_v",
    correct=_correct,
    by_angles=_by_angles,
)
