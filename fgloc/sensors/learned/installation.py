"""What a learned motion is off by on this robot: its scale, estimated beside the poses."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from fgloc import se2
from fgloc.sensors.base import FoundRow, InstallationState, MotionInstallation, MotionRole, Parameter, Rank
from fgloc.types import FloatArray, Setting

if TYPE_CHECKING:
    from fgloc.config import Config


def parameters(config: Config, roles: Collection[MotionRole]) -> tuple[Parameter, ...]:
    """With their priors."""
    return (
        Parameter(
            "learned.scale",
            config.motion.scale_sigma if MotionRole.MODEL in roles else 0.0,
            Rank.MODEL,
            ("length",),
            lengthens=True,
        ),
    )


def found(config: Config) -> tuple[FoundRow, ...]:
    """Rows of ``metrics.json``."""
    return (FoundRow("learned.scale", "learned.scale", 1.0, 1.0),)


def settings(state: InstallationState, config: Config) -> Iterator[Setting]:
    """Lines of ``robot.yaml``."""
    scale = config.motion.scale
    now = scale * (1.0 + state.value("learned.scale"))
    yield from state.setting("motion.scale", scale, now, {"learned.scale": scale})


def derivatives(motion: FloatArray) -> dict[str, FloatArray]:
    """Derivative ``(3,)`` of a motion (right perturbation) by each parameter."""
    rho_x, rho_y, _ = se2.log(motion)
    return {"learned.scale": np.array([rho_x, rho_y, 0.0])}


INSTALLATION = MotionInstallation(parameters, found, settings, {"motion.scale": "motion.scale_sigma"})
