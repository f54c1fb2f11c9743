"""Mistakes that the messages alone show: stamps of another clock, wheel angles that roll over."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from fgloc.config import Config, Role
from fgloc.errors import ConfigError
from fgloc.sensors.wheels.encoders import wheel_names
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import Event, FloatArray

_OTHER_CLOCK_S = 5.0  # no driver takes so long: stamps that differ more from the receive times are of another clock
_FEWEST = 5  # messages of a role
_JUMP = 8.0  # times a usual step of a wheel's angle, and ...
_LEAST_JUMP_RAD = 0.5  # ... at least so much
_ROLLS = 2  # jumps of one size that make it a roll-over; an encoder that restarts jumps by any amount
_SAME_JUMP = 0.03  # share by which they may differ
_WHOLE_TURN = 0.02  # share by which a range may be off one turn to be taken as one turn


def other_clocks(delays: Mapping[Role, Sequence[float]]) -> tuple[Role, ...]:
    """Roles whose stamps are of another clock than most.

    Args:
        delays: received minus stamped [s], by role.
    """
    middle = {role: float(np.median(values)) for role, values in delays.items() if len(values) >= _FEWEST}
    if len(middle) < 3:
        return ()
    usual = float(np.median(list(middle.values())))
    return tuple(sorted(role for role, delay in middle.items() if abs(delay - usual) > _OTHER_CLOCK_S))


def clock_sentence(roles: Sequence[Role], delays: Mapping[Role, Sequence[float]], given: Sequence[Role]) -> str:
    """The sentence on such roles; ``given``: those that the configuration lists already."""
    usual = float(np.median([np.median(values) for role, values in delays.items() if role not in roles]))
    off = [float(np.median(delays[role])) - usual for role in roles]
    sentence = " and ".join(
        f"those of {role} are {abs(late):.4g} s {'behind' if late > 0 else 'ahead'}"
        for role, late in zip(roles, off, strict=True)
    )
    line = f"recording.received_stamps: [{', '.join([*given, *roles])}]"
    return f"Some stamps are of another clock ({sentence}): set {line}."


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
