"""What the commands say: tables, progress bars, exit codes."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from fgloc.replay.options import Progress
    from fgloc.types import RunResult

EXIT_BAD_INPUT = 1
EXIT_LOST = 3


def say(text: str, err: bool = False, nl: bool = True) -> None:
    """Print. Control characters, which names in a recording may hold to command the terminal, are shown as escapes."""
    typer.echo("".join(c if c.isprintable() or c == "\n" else _escaped(c) for c in text), err=err, nl=nl)


def _escaped(c: str) -> str:
    return c.encode("unicode_escape", errors="replace").decode("ascii")


def typed() -> str:
    """The command as the user typed it."""
    return shlex.join(["fgloc", *sys.argv[1:]])


def exit_code(result: RunResult) -> int:
    """0, or 3 if a part of the run is not to be trusted, or its set-up is wrong."""
    from fgloc.types import Mode

    return EXIT_LOST if Mode.LOST in result.modes or result.mistakes else 0


def exit_unless_trusted(result: RunResult) -> None:
    """End with code 3 if a part of the run is not to be trusted, or its set-up is wrong."""
    from fgloc.types import Mode

    lost = sum(mode is Mode.LOST for mode in result.modes)
    if lost:
        say(f"LOST for {lost} of {len(result.modes)} poses: do not trust them", err=True)
    if result.mistakes:
        say("the set-up is wrong, as the first note says: correct it and run again", err=True)
    if code := exit_code(result):
        raise typer.Exit(code)


@contextmanager
def run_bar(label: str) -> Iterator[Progress]:
    """Seconds of one recording: a bar on a terminal, nothing on a pipe."""
    from tqdm import tqdm

    form = "{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s [{elapsed}<{remaining}]"
    with tqdm(desc=label, total=1.0, disable=None, bar_format=form, file=sys.stderr, leave=False) as bar:

        def show(done_s: float, length_s: float) -> None:
            if not bar.disable:
                bar.total = length_s
                bar.update(done_s - bar.n)

        yield show


@contextmanager
def jobs_bar(label: str, count: int) -> Iterator[Callable[[int, int], None]]:
    """Jobs of a sweep, with an estimate of the time left: a bar on a terminal, nothing on a pipe."""
    from tqdm import tqdm

    with tqdm(desc=label, total=count, disable=None, file=sys.stderr, leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def number(value: float | None, form: str) -> str:
    """A figure, or a dash where there is none."""
    return "-" if value is None else form.format(value)


def columns(head: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> str:
    """A plain table: the first column to the left, the others to the right; without a head all to the left."""
    lines = [head, *rows] if head else list(rows)
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    pad = str.rjust if head else str.ljust
    return "\n".join("  ".join([line[0].ljust(widths[0]), *map(pad, line[1:], widths[1:])]).rstrip() for line in lines)
