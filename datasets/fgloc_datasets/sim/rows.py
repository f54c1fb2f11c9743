"""Values of a channel's messages, computed as far as the log reaches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

from fgloc.types import IntArray
from fgloc_datasets.sim.physics import Log

T = TypeVar("T")


class Rows(Generic[T]):
    """Message by message, in order: from a finished log all are computed at once, else those that can be."""

    def __init__(self, log: Log, ticks: IntArray, make: Callable[[int, int], T]) -> None:
        """Compute nothing yet.

        Args:
            log: of the run, which may still go on.
            ticks: ``(n,)`` row of the log that each message is of, ascending.
            make: values of the messages from the first to before the last; asked in order, without gaps.
        """
        self._log, self._ticks, self._make = log, ticks, make
        self._first = self._last = 0
        self._block: T | None = None

    def at(self, i: int) -> tuple[T, int]:
        """A block of values and the message's row in it. Messages of earlier blocks are gone.

        Raises:
            IndexError: the log does not reach the message, or its block is gone.
        """
        if i >= self._last:
            self._first, self._last = self._last, int(np.searchsorted(self._ticks, self._log.ticks))
            self._block = self._make(self._first, self._last) if self._last > self._first else None
        if self._block is None or not self._first <= i < self._last:
            raise IndexError(
                f"message {i}: the log has {self._log.ticks} ticks, the block {self._first} to {self._last}"
            )
        return self._block, i - self._first
