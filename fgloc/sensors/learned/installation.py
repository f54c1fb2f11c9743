"""What a learned motion is off by on this robot: its scale, and a speed that depends on its turning."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from fgloc import se2
from fgloc.sensors.base import FoundRow, InstallationState, MotionInstallation, MotionRole, Parameter, Rank
from fgloc.types import FloatArray, MotionMeasurement, Setting

if TYPE_CHECKING:
    from fgloc.config import Config


def parameters(config: Config, roles: Collection[MotionRole]) -> tuple[Parameter, ...]:
    """With their priors."""
    there, motion = MotionRole.MODEL in roles, config.motion
    return (
        Parameter("learned.scale", motion.scale_sigma * there, Rank.MODEL),
        Parameter("learned.slowdown", motion.slowdown_sigma * there, Rank.MODEL),
    )


def found(config: Config) -> tuple[FoundRow, ...]:
    """Rows of ``metrics.json``."""
    return (
        FoundRow("learned.scale", "learned.scale", 1.0, 1.0),
        FoundRow("learned.slowdown", "learned.slowdown", 0.0, 1.0),
    )


def settings(state: InstallationState, config: Config) -> Iterator[Setting]:
    """Lines of ``robot.yaml``."""
    scale = config.motion.scale
    now = scale * (1.0 + state.value("learned.scale"))
    yield from state.setting("motion.scale", scale, now, {"learned.scale": scale})


def derivatives(m: MotionMeasurement) -> dict[str, FloatArray]:
    """Derivative ``(3,)`` of a motion (right perturbation) by each parameter."""
    rho_x, rho_y, turn = se2.log(m.motion)
    rate = abs(turn) / max((m.stamp_ns - m.start_ns) * 1e-9, 1e-3)
    return {
        "learned.scale": np.array([rho_x, rho_y, 0.0]),
        "learned.slowdown": np.array([-rate * rho_x, 0.0, 0.0]),
    }


INSTALLATION = MotionInstallation(parameters, found, settings, {"motion.scale": "motion.scale_sigma"})
