"""Wheel angles that roll over, although the settings do not say so."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fgloc.config import Config
from fgloc.errors import ConfigError
from fgloc.sensors.base import RawMistake
from fgloc.sensors.wheels.encoders import wheel_names
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import Event, FloatArray

_JUMP = 8.0  # times a usual step of a wheel's angle, and ...
_LEAST_JUMP_RAD = 0.5  # ... at least so much
_ROLLS = 2  # jumps of one size that make it a roll-over; an encoder that restarts jumps by any amount
_SAME_JUMP = 0.03  # share by which they may differ
_WHOLE_TURN = 0.02  # share by which a range may be off one turn to be taken as one turn


def mistakes(motion: Sequence[Event], config: Config) -> tuple[RawMistake, ...]:
    """What the messages show to be wrong with the settings."""
    rolled = roll_over(motion, config)
    if rolled is None:
        return ()
    sentence = (
        f"The wheel angles roll over after {rolled[0]:.4f} rad ({rolled[1]} times in what was looked at): "
        f"set wheels.angle_range: {rolled[0]:.4f}."
    )
    return (RawMistake(sentence, "wheels", {"angle_range": rolled[0]}),)


def roll_over(motion: Sequence[Event], config: Config) -> tuple[float, int] | None:
    """After how much the wheels' angles roll over [rad], and how often they did; None: they do not.

    Args:
        motion: events in order of receipt, among them joint states.
        config: of the wheels.
    """
    joints = [e for e in motion if isinstance(e, JointsEvent) and len(e.position) == len(e.names)]
    if config.wheels.angle_range is not None or len(joints) < 10:
        return None
    try:
        pair = wheel_names(joints[0].names, config.wheels.left_joint, config.wheels.right_joint)
    except ConfigError:  # ambiguous: the run reports it
        return None
    if pair is None:
        return None
    jumps: list[float] = []
    for name in pair:
        angles = np.array([e.position[e.names.index(name)] for e in joints if name in e.names])
        jumps += _jumps(angles[np.isfinite(angles)])
    if len(jumps) < _ROLLS:
        return None
    size = float(np.median(jumps))
    if float(np.mean(np.abs(np.array(jumps) - size) < _SAME_JUMP * size)) < 0.9:
        return None
    turn = 2.0 * math.pi
    return (turn if abs(size - turn) < _WHOLE_TURN * turn else size), len(jumps)


def _jumps(angles: FloatArray) -> list[float]:
    """By how much [rad] each jump differs from the steps beside it."""
    steps = np.diff(angles)
    if len(steps) < 3:
        return []
    usual = max(_JUMP * float(np.median(np.abs(steps))), _LEAST_JUMP_RAD)
    found = []
    for k in np.flatnonzero(np.abs(steps) > usual).tolist():
        beside = [steps[i] for i in (k - 1, k + 1) if 0 <= i < len(steps) and abs(steps[i]) <= usual]
        if beside:
            found.append(abs(float(steps[k] - np.mean(beside))))
    return found
