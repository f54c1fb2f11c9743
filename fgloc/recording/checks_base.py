"""What the checks share."""

from __future__ import annotations

from array import array
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fgloc.config import Config
from fgloc.types import Event, FloatArray


class Collector(Protocol):
    """Takes in the events of one topic and tells what is wrong with them."""

    def add(self, event: Event) -> None:
        """Take in one event."""

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong; ``seconds`` ``(n,)`` are the receive times from the recording's start."""


class Table:
    """Rows of floats, compact."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._values = array("d")

    def add(self, *values: float) -> None:
        """Add a row."""
        self._values.extend(values)

    def array(self) -> FloatArray:
        """All rows ``(n, width)``."""
        return np.array(self._values, dtype=float).reshape(-1, self._width)


def finite_rows(rows: FloatArray) -> NDArray[np.bool_]:
    """Which rows hold neither NaN nor infinity."""
    return np.asarray(np.isfinite(rows).all(axis=1))


def count(mask: NDArray[np.bool_]) -> str:
    """How many of how many."""
    return f"{int(mask.sum())} of {mask.size}"


def times(n: int) -> str:
    """Once, or n times."""
    return "once" if n == 1 else f"{n} times"
