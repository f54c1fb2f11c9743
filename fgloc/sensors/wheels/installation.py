"""What wheels are off by: gains, delay and clock, estimated beside the poses.

Sources: Deray, Sola, Andrade-Cetto 2019, "Joint on-manifold self-calibration of odometry model and sensor extrinsics
using pre-integration" (differential drive); the right Jacobian of SE(2) to first order.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from fgloc import se2
from fgloc.sensors.base import FoundRow, InstallationState, MotionInstallation, MotionRole, Parameter, Rank
from fgloc.types import FloatArray, MotionMeasurement, Setting

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.sensors.wheels.config import WheelsConfig

_SLOWEST = 0.1  # share of the reported speed that turning leaves, where it is divided by
OF_CLOCK = ("wheels.time_offset_s", "wheels.delay_s")


def parameters(config: Config, roles: Collection[MotionRole]) -> tuple[Parameter, ...]:
    """With their priors. Without a gyro theirs is the clock that others are compared to."""
    wheels = config.wheels
    return (
        Parameter("wheels.radius", wheels.scale_sigma, effects=("length", "turn"), lengthens=True),
        Parameter("wheels.track", wheels.turn_scale_sigma, effects=("turn",), lengthens=True),
        Parameter("wheels.yaw_per_m", wheels.yaw_per_m_sigma, effects=("turn",)),
        Parameter("wheels.slowdown", wheels.slowdown_sigma),
        Parameter("wheels.delay_s", wheels.delay_sigma_s),
        Parameter(
            "wheels.time_offset_s",
            wheels.time_offset_sigma_s if MotionRole.RATE in roles else 0.0,
            Rank.CLOCK,
            ("heading",),
        ),
    )


def found(config: Config) -> tuple[FoundRow, ...]:
    """Rows of ``metrics.json``."""
    wheels = config.wheels
    unequal = (
        FoundRow("wheels.radius_ratio", "wheels.yaw_per_m", 1.0, -wheels.track)
        if wheels.track is not None
        else FoundRow("wheels.yaw_per_m", "wheels.yaw_per_m", wheels.yaw_per_m, 1.0)
    )
    return (
        FoundRow("wheels.radius_scale", "wheels.radius", 1.0, 1.0),
        FoundRow("wheels.track_scale", "wheels.track", 1.0, 1.0),
        unequal,
        FoundRow("wheels.slowdown", "wheels.slowdown", wheels.slowdown, 1.0),
        FoundRow("wheels.delay_s", "wheels.delay_s", wheels.delay_s, 1.0),
        FoundRow("wheels.time_offset_s", "wheels.time_offset_s", 0.0, 1.0),
    )


def settings(state: InstallationState, config: Config) -> Iterator[Setting]:
    """Lines of ``robot.yaml``."""
    wheels = config.wheels
    longer, turn = 1.0 + state.value("wheels.radius"), 1.0 - state.value("wheels.track")
    pull = (turn * longer * wheels.yaw_per_m + state.value("wheels.yaw_per_m")) / longer
    gain = {"wheels.radius": wheels.scale_v}
    yield from state.setting("wheels.scale_v", wheels.scale_v, wheels.scale_v * longer, gain)
    gain = {"wheels.track": wheels.scale_omega, "wheels.radius": wheels.scale_omega}
    gain["wheels.track"] *= -1.0
    yield from state.setting("wheels.scale_omega", wheels.scale_omega, wheels.scale_omega * longer * turn, gain)
    yield from state.setting("wheels.yaw_per_m", wheels.yaw_per_m, pull, {"wheels.yaw_per_m": 1.0})
    for name in ("slowdown", "delay_s"):
        given = getattr(wheels, name)
        now = max(0.0, given + state.value(f"wheels.{name}"))
        yield from state.setting(f"wheels.{name}", given, now, {f"wheels.{name}": 1.0})


def derivatives(m: MotionMeasurement, change: FloatArray | None, config: WheelsConfig) -> dict[str, FloatArray]:
    """Derivative ``(3,)`` of a motion (right perturbation) by each parameter.

    Args:
        m: as it is reported.
        change: ``(3,)`` of the twist over the step: by it a wrong clock shows; None: it is not needed.
        config: as it was reported with.
    """
    rho_x, rho_y, phi = se2.log(m.motion)
    by_turn = np.array([-0.5 * rho_y, 0.5 * rho_x, 1.0])
    by = {
        "wheels.radius": np.array([rho_x, rho_y, phi]),
        "wheels.track": -phi * by_turn,
        "wheels.yaw_per_m": rho_x * by_turn,
        "wheels.slowdown": _by_slowdown(m, rho_x, phi, config),
    }
    return by if change is None else by | {"wheels.time_offset_s": change, "wheels.delay_s": -change}


def _by_slowdown(m: MotionMeasurement, rho_x: float, phi: float, config: WheelsConfig) -> FloatArray:
    """By ``slowdown``: it takes from the speed by the turning that is reported."""
    seconds = max((m.stamp_ns - m.start_ns) * 1e-9, 1e-3)
    commanded = abs(phi) / seconds / config.scale_omega
    return np.array([-commanded * rho_x / max(1.0 - config.slowdown * commanded, _SLOWEST), 0.0, 0.0])


INSTALLATION = MotionInstallation(
    parameters,
    found,
    settings,
    {
        "wheels.scale_v": "wheels.scale_sigma",
        "wheels.scale_omega": "wheels.turn_scale_sigma",
        "wheels.yaw_per_m": "wheels.yaw_per_m_sigma",
        "wheels.slowdown": "wheels.slowdown_sigma",
        "wheels.delay_s": "wheels.delay_sigma_s",
    },
)
