"""Where the time of a step goes, and how many threads it takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

_P = ParamSpec("_P")
_R = TypeVar("_R")


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


def one_blas_thread(work: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let BLAS use one thread meanwhile: threads that wait for one another cost a step ten times its time."""

    @wraps(work)
    def limited(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with threadpool_limits(limits=1, user_api="blas"):
            return work(*args, **kwargs)

    return limited
