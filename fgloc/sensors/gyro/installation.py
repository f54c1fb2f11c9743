"""What a gyro is off by: its scale, estimated beside the poses."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from fgloc import se2
from fgloc.sensors.base import FoundRow, InstallationState, MotionInstallation, MotionRole, Parameter
from fgloc.types import FloatArray, Setting

if TYPE_CHECKING:
    from fgloc.config import Config


BIASES = ("gyro.bias_x", "gyro.bias_y")  # rad/s, in the axes of the base
TILTS = ("gyro.roll_rad", "gyro.pitch_rad")  # of the IMU, beside its mounting as it is given
LEVELS = ("gyro.level_x_rad", "gyro.level_y_rad")  # tilt about x and y that the accelerometer's bias makes


def parameters(config: Config, roles: Collection[MotionRole]) -> tuple[Parameter, ...]:
    """With their priors; on uneven ground also of what tells roll and pitch."""
    scale = Parameter("gyro.scale", config.gyro.scale_sigma if MotionRole.RATE in roles else 0.0, effects=("turn",))
    if config.estimator.ground == "flat" or MotionRole.RATE not in roles:
        return (scale,)
    biases = (Parameter(name, config.gyro.bias_sigma) for name in BIASES)
    tilts = (Parameter(name, config.gyro.tilt_sigma_rad) for name in TILTS)
    return (scale, *biases, *tilts, *(Parameter(name, config.gyro.level_sigma_rad) for name in LEVELS))


def found(config: Config) -> tuple[FoundRow, ...]:
    """Rows of ``metrics.json``."""
    return (FoundRow("gyro.scale", "gyro.scale", 1.0, -1.0),)


def settings(state: InstallationState, config: Config) -> Iterator[Setting]:
    """Lines of ``robot.yaml``."""
    scale = config.gyro.scale
    yield from state.setting("gyro.scale", scale, scale * (1.0 + state.value("gyro.scale")), {"gyro.scale": scale})


def derivatives(motion: FloatArray) -> dict[str, FloatArray]:
    """Derivative ``(3,)`` of a motion whose turn is the gyro's (right perturbation) by each parameter."""
    rho_x, rho_y, phi = se2.log(motion)
    return {"gyro.scale": phi * np.array([-0.5 * rho_y, 0.5 * rho_x, 1.0])}


INSTALLATION = MotionInstallation(parameters, found, settings, {"gyro.scale": "gyro.scale_sigma"})
