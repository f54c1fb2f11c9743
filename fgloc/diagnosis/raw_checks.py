"""Mistakes that the messages alone show: stamps of another clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fgloc.config import Role

_OTHER_CLOCK_S = 5.0  # no driver takes so long: stamps that differ more from the receive times are of another clock
_FEWEST = 5  # messages of a role


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
