"""What a sensor writes into the first ``robot.yaml`` of an unknown robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fgloc.types import Event


@dataclass(frozen=True, slots=True)
class FirstLook:
    """What a recording of an unknown robot holds.

    Attributes:
        roles: topic by role.
        events: by class, of the classes that the sensor asked for.
        recording: opened.
        has_map: a map lies beside it.
    """

    roles: Mapping[str, str]
    events: Mapping[type[Event], Sequence[Event]]
    recording: Any
    has_map: bool


@dataclass(frozen=True, slots=True)
class FirstSection:
    """Lines of ``robot.yaml``, and sentences on what the recording does not tell."""

    lines: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FirstSettings:
    """How a sensor takes part: the events it wants to see, and what it makes of them."""

    events: tuple[type[Event], ...]
    section: Callable[[FirstLook], FirstSection]
