"""Progress of a command on stderr: bars on a terminal, else a line every ten seconds, both with the time left."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from fgloc.instrumentation import Advance, Listener, end, tell, told_to

if TYPE_CHECKING:
    from fgloc.replay import Progress

LINE_S = 10.0  # between two lines on a pipe; shorter work says nothing
_RATE_S = 1.0  # work has to have gone on for this long before a rate, and so the time left, can be given


@contextmanager
def shown() -> Iterator[None]:
    """Show the progress of what runs within the block."""
    if not sys.stderr.isatty():
        with told_to(Lines(lambda line: print(line, file=sys.stderr, flush=True))):
            yield
        return
    bars = Bars()
    try:
        with told_to(bars):
            yield
    finally:
        bars.close()


@contextmanager
def run_bar(label: str) -> Iterator[Progress]:
    """Takes seconds of one recording that are done, and its length [s]."""
    try:
        yield lambda done_s, length_s: tell(label, done_s, length_s, "s")
    finally:
        end(label)


@contextmanager
def jobs_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Takes jobs of a sweep that are done, and their number."""
    try:
        yield lambda done, total: tell(label, done, total)
    finally:
        end(label)


class Lines:
    """A listener that gives a line at most every `LINE_S`."""

    def __init__(self, write: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        """Write lines by `write`, at times [s] of `clock`."""
        self._write, self._clock = write, clock
        self._began: dict[str, tuple[float, float]] = {}  # by label: when, and how much was done then
        self._last = clock()

    def __call__(self, of: Advance) -> None:
        """Give a line if it is time for one."""
        if of.ended:
            self._began.pop(of.label, None)
            return
        now = self._clock()
        began, before = self._began.setdefault(of.label, (now, of.done))
        if now - self._last < LINE_S or now - began < _RATE_S or of.done == of.total:
            return
        self._last = now
        self._write(_line(of, now - began, before))


class Bars:
    """A listener that shows bars on a terminal; they vanish when their work is done."""

    def __init__(self) -> None:
        """Show nothing until something is told."""
        self._progress: Any = None
        self._tasks: dict[str, Any] = {}

    def __call__(self, of: Advance) -> None:
        """Move the bar of this work."""
        if of.ended:
            if (task := self._tasks.pop(of.label, None)) is not None:
                self._progress.remove_task(task)
            if not self._tasks:
                self.close()
            return
        if self._progress is None:
            self._progress = _rich_progress()
            self._progress.start()
        if of.label not in self._tasks:
            self._tasks[of.label] = self._progress.add_task(of.label, total=of.total, amount="")
        self._progress.update(self._tasks[of.label], completed=of.done, total=of.total, amount=_amount(of))

    def close(self) -> None:
        """Take the bars away."""
        if self._progress is not None:
            self._progress.stop()
        self._progress = None
        self._tasks = {}


def _rich_progress() -> Any:
    # Imported here: a tenth of a second that `fgloc --help` need not wait for.
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[amount]}", markup=False),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )


def _line(of: Advance, seconds: float, before: float) -> str:
    rate = (of.done - before) / seconds
    left = "" if of.total is None or rate <= 0.0 else f", {_duration((of.total - of.done) / rate)} left"
    return f"{of.label}: {_amount(of)}{left}"


def _amount(of: Advance) -> str:
    unit = f" {of.unit}" if of.unit else ""
    share = f" of {of.total:.0f}{unit} ({100.0 * of.done / of.total:.0f} %)" if of.total else unit
    return f"{of.done:.0f}{share}" + (f", {of.detail}" if of.detail else "")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


__all__ = ["Bars", "Lines", "Listener", "jobs_bar", "run_bar", "shown"]
