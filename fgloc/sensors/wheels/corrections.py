"""The sentence for a mistake in the settings of the wheels, and the values that undo it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from fgloc.sensors.base import RawMistake
from fgloc.sensors.roles import SetupMistake

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.sensors.wheels.config import WheelsConfig


def correct(mistake: SetupMistake, config: Config) -> RawMistake:
    """What to tell the user of a mistake, and to set."""
    wheels = config.wheels
    match mistake.kind:
        case "track":
            return _track(mistake, wheels)
        case "radius":
            return _radius(mistake, wheels)
        case "odometry_frame":
            c, s = mistake.turned[:2, 0]
            sentence = (
                f"The odometry's twist is in axes turned by {-math.degrees(math.atan2(s, c)):.0f}° against the base: "
                "set wheels.source: pose, or correct its child_frame_id."
            )
            return RawMistake(sentence, "wheels", {"source": "pose"})
        case _:
            return _sides(mistake, wheels)


def _track(mistake: SetupMistake, wheels: WheelsConfig) -> RawMistake:
    if mistake.source == "ticks" and wheels.track is not None:
        new = {"track": wheels.track * mistake.factor}
    else:
        new = {"scale_omega": wheels.scale_omega / mistake.factor}
    sentence = f"The wheels turn the robot {1.0 / mistake.factor:.3f} times as far as given: set {_lines(new)}."
    return RawMistake(sentence, "wheels", new)


def _radius(mistake: SetupMistake, wheels: WheelsConfig) -> RawMistake:
    factor = mistake.factor
    if mistake.source == "ticks" and wheels.left_radius is not None and wheels.right_radius is not None:
        new = {"left_radius": wheels.left_radius * factor, "right_radius": wheels.right_radius * factor}
        sentence = f"The wheels' radii are {factor:.3f} times those given: set {_lines(new)}."
    else:
        new = {"scale_v": wheels.scale_v * factor, "scale_omega": wheels.scale_omega * factor}
        sentence = f"The robot moves {factor:.3f} times as far as its odometry says: set {_lines(new)}."
    return RawMistake(sentence, "wheels", new)


def _sides(mistake: SetupMistake, wheels: WheelsConfig) -> RawMistake:
    """Left and right exchanged, or forward and backward."""
    if mistake.source == "ticks" and mistake.kind == "exchanged" and wheels.left_joint and wheels.right_joint:
        sentence = (
            "The left and the right wheel are exchanged: set wheels.left_joint: "
            f"{wheels.right_joint} and wheels.right_joint: {wheels.left_joint}."
        )
        return RawMistake(sentence, "wheels", {"left_joint": wheels.right_joint, "right_joint": wheels.left_joint})
    how = {
        "exchanged": "turn the robot the other way (left and right exchanged)",
        "reversed": "turn backward when the robot goes forward",
        "both_reversed": "turn backward when the robot goes forward, and left and right are exchanged",
    }[mistake.kind]
    line = "exchange wheels.left_joint and wheels.right_joint, or correct the driver's signs"
    return RawMistake(f"The wheels {how}: {line}.", "wheels", {})


def _lines(values: Mapping[str, float]) -> str:
    return " and ".join(f"wheels.{name}: {value:.4g}" for name, value in values.items())
