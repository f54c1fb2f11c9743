"""How far long work has come, told to whoever listens. By default nobody does: the library prints nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeVar

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
    """Within the block, work of this thread is told to the listener."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def tell(label: str, done: float, total: float | None, unit: str = "", detail: str = "") -> None:
    """Tell how far it is; cheap where nobody listens."""
    if (listener := _listener.get()) is not None:
        listener(Advance(label, done, total, unit, detail))


def end(label: str) -> None:
    """Tell that it is done or given up."""
    if (listener := _listener.get()) is not None:
        listener(Advance(label, 0, None, ended=True))


def counted(items: Iterable[T], label: str, total: float | None = None, unit: str = "") -> Iterator[T]:
    """The items, each of which is told when it is done."""
    try:
        for done, item in enumerate(items, 1):
            yield item
            tell(label, done, total, unit)
    finally:
        end(label)
