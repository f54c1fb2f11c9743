"""Progress of long work, reported to a listener if there is one, work beside other work, and wall time by phase."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

# --- Progress ---------------------------------------------------------------------------------------------------------

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Advance:
    """State of one piece of work.

    Attributes:
        label: what is being done.
        done: how much of it.
        total: of how much; None: unknown.
        unit: of both.
        detail: a figure to show beside.
        ended: nothing more is told of it.
    """

    label: str
    done: float
    total: float | None
    unit: str = ""
    detail: str = ""
    ended: bool = False


Listener = Callable[[Advance], None]
_listener: ContextVar[Listener | None] = ContextVar("fgloc_progress", default=None)


@contextmanager
def told_to(listener: Listener | None) -> Iterator[None]:
    """Report progress of this thread's work to the listener inside the block."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def tell(label: str, done: float, total: float | None, unit: str = "", detail: str = "") -> None:
    """Report progress; cheap where nobody listens."""
    if (listener := _listener.get()) is not None:
        listener(Advance(label, done, total, unit, detail))


def end(label: str) -> None:
    """Report that the work is done or given up."""
    if (listener := _listener.get()) is not None:
        listener(Advance(label, 0, None, ended=True))


@contextmanager
def working(label: str) -> Iterator[None]:
    """Report work of unknown length while the block runs."""
    tell(label, 0, None)
    try:
        yield
    finally:
        end(label)


def counted(items: Iterable[T], label: str, total: float | None = None, unit: str = "") -> Iterator[T]:
    """Iterate over the items and report each one that is done."""
    try:
        for done, item in enumerate(items, 1):
            yield item
            tell(label, done, total, unit)
    finally:
        end(label)


@contextmanager
def repeated(work: Callable[[], None], every_s: float, name: str) -> Iterator[None]:
    """Do a piece of work again and again in a thread while the block runs; an error that it raises ends the thread."""
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(every_s):
            work()

    thread = threading.Thread(target=repeat, name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


# --- Time and threads -------------------------------------------------------------------------------------------------

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


# --- Work in the background -------------------------------------------------------------------------------------------


class _Background(threading.local):
    wait: Callable[[], None] | None = None


_background = _Background()


@contextmanager
def giving_way(wait: Callable[[], None]) -> Iterator[None]:
    """Call ``wait`` at each `give_way` of this thread while the block runs: it returns when others have no work."""
    before, _background.wait = _background.wait, wait
    try:
        yield
    finally:
        _background.wait = before


def give_way() -> None:
    """Let more urgent work go first, if this is the background of it; called every few milliseconds of long work."""
    if _background.wait is not None:
        _background.wait()


def one_blas_thread(work: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let BLAS use one thread meanwhile: threads that wait for one another cost a step ten times its time."""

    @wraps(work)
    def limited(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with threadpool_limits(limits=1, user_api="blas"):
            return work(*args, **kwargs)

    return limited
