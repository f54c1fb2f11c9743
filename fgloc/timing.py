"""Where the time of a step goes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Accumulates wall time by phase.

    Attributes:
        seconds: phase -> total [s].
        samples: phase -> every duration [s], kept only if ``keep``.
    """

    def __init__(self, keep: bool = False) -> None:
        self.keep = keep
        self.seconds: dict[str, float] = {}
        self.samples: dict[str, list[float]] = {}

    @contextmanager
    def __call__(self, phase: str) -> Iterator[None]:
        """Time the block under this name."""
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self.seconds[phase] = self.seconds.get(phase, 0.0) + spent
            if self.keep:
                self.samples.setdefault(phase, []).append(spent)
