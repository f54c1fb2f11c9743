"""What the user is told while a live run goes on: each thing once."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

_PATIENCE_S = 2.0  # what is missing for less than this is not worth a sentence
_FIGURES = re.compile(r"\d+(\.\d+)?")


class Teller:
    """Passes sentences on, but none again that differs from an earlier one in its figures only."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        """``tell`` is given one sentence at a time."""
        self._tell = tell
        self._told: set[str] = set()
        self._waiting = ""
        self._since_s = 0.0

    def tell(self, *sentences: str) -> None:
        """What is to be known at once."""
        for sentence in sentences:
            if (kind := _FIGURES.sub("", sentence)) not in self._told:
                self._told.add(kind)
                self._tell(sentence)

    def waiting(self, sentence: str) -> None:
        """What is missing now; empty if nothing is. Told when it has been so for a while."""
        if sentence != self._waiting:
            self._waiting, self._since_s = sentence, time.monotonic()
        if sentence and time.monotonic() - self._since_s >= _PATIENCE_S:
            self.tell(sentence)
