"""Output of the commands: sentences, tables, exit codes, and progress on stderr."""

from __future__ import annotations

import json
import math
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand

from fgloc.instrumentation import Advance, end, tell, told_to

if TYPE_CHECKING:
    from fgloc.evaluation.metrics import Metrics
    from fgloc.replay import Progress
    from fgloc.runner import RunResult
    from fgloc.sensors.base import Asked, Question


EXIT_BAD_INPUT = 1
EXIT_LOST = 3
EXIT_INTERRUPTED = 130
UNTRUSTED = "not to be trusted, for the reason that is named first"
_MAPPED = "none: landmarks that are seen are estimated with the trajectory"


def say(text: str, err: bool = False, nl: bool = True) -> None:
    """Print. Control characters, which names in a recording may hold to command the terminal, are shown as escapes."""
    typer.echo(_plain(text), err=err, nl=nl)


def _plain(text: str) -> str:
    return "".join(c if c.isprintable() or c == "\n" else _escaped(c) for c in text)


def _escaped(c: str) -> str:
    return c.encode("unicode_escape", errors="replace").decode("ascii")


def typed() -> str:
    """The command as the user typed it."""
    return shlex.join(["fgloc", *sys.argv[1:]])


def exit_code(result: RunResult, metrics: Metrics | None = None) -> int:
    """0, or 3 if a part of the run is not to be trusted, or its set-up is wrong, also by its figures."""
    from fgloc.types import Mode

    return EXIT_LOST if Mode.LOST in result.modes or _is_wrong(result, metrics) else 0


def _is_wrong(result: RunResult, metrics: Metrics | None) -> bool:
    by_figures = metrics is not None and any(finding.severity == "error" for finding in metrics.findings)
    return bool(result.mistakes) or by_figures


def exit_unless_trusted(result: RunResult, metrics: Metrics | None = None) -> None:
    """End with code 3 if a part of the run is not to be trusted, or its set-up is wrong, also by its figures."""
    from fgloc.types import Mode

    lost = sum(mode is Mode.LOST for mode in result.modes)
    if lost:
        say(f"LOST for {lost} of {len(result.modes)} poses: do not trust them", err=True)
    if _is_wrong(result, metrics):
        say(UNTRUSTED, err=True)
    if code := exit_code(result, metrics):
        raise typer.Exit(code)


def exit_if_wrong(errors: Sequence[str], verdict: str = "") -> None:
    """End with code 3 if there are errors, each of them said, and then what they mean."""
    for text in errors:
        say_remark("error", text, err=True)
    if errors:
        if verdict:
            say(verdict, err=True)
        raise typer.Exit(EXIT_LOST)


@contextmanager
def kept_on_interrupt(kept: str = "of this result nothing was written; an earlier one is as it was") -> Iterator[None]:
    """Print on Ctrl-C what was kept, and end with the exit code that shells expect of an interrupt."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"interrupted: {kept}", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None


class Command(TyperCommand):
    """A command whose help names arguments as they are typed, without the types of Python."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Parts of the usage line: ``BAG...``, not ``{BAG}...``."""
        return [piece.replace("{", "").replace("}", "") for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the lists of arguments and options."""
        for kind, title in (("argument", "Arguments"), ("option", "Options")):
            found = (p.get_help_record(ctx) for p in self.get_params(ctx) if p.param_type_name == kind)
            rows = [(_named(name, kind == "option"), about) for name, about in filter(None, found)]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


def _named(name: str, is_option: bool) -> str:
    """Left column of a list: a value without a name gets a letter for its type; alternatives, as <1|max>, stay."""
    return re.sub(r" <(\w+)[^>|]*>", lambda kind: f" {_LETTERS.get(kind[1], 'TEXT')}" if is_option else "", name)


_LETTERS = {"int": "N", "float": "X", "Path": "PATH", "path": "PATH"}


def examples(*lines: str) -> dict[str, Any]:
    """Class and last paragraph of a command: examples of it."""
    return {"cls": Command, "epilog": "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)}


def group(about: str) -> typer.Typer:
    """Typer application for a group of commands."""
    return typer.Typer(help=about, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)


def warn(text: str) -> None:
    """Print a warning on stderr, in red on a terminal."""
    say_remark("warning", text, err=True)


def say_remark(kind: str, text: str, err: bool = False) -> None:
    """A sentence under its kind; on a terminal all but notes are red."""
    head, stream = f"{kind}:", sys.stderr if err else sys.stdout
    if kind != "note" and stream.isatty():
        head = typer.style(head, fg=typer.colors.RED, bold=True)
    typer.echo(f"{head} {_plain(text)}", err=err)


def asks() -> bool:
    """Whether somebody is there to answer: input and error stream are a terminal."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def ask(wanted: Asked) -> dict[str, str] | None:
    """Answers of the user by setting; None where Enter says that one of them is not known.

    Raises:
        KeyboardInterrupt: by Ctrl-C, or at the end of the input.
    """
    say(f"Not in the recording: {wanted.missing}. Enter alone leaves it open.", err=True)
    answers: dict[str, str] = {}
    for question in wanted.questions:
        try:
            given = typer.prompt(
                f"  {_plain(question.text)}", "", show_default=False, err=True, value_proc=partial(_answer, question)
            )
        except typer.Abort:
            raise KeyboardInterrupt from None
        if not given:
            return None
        answers |= dict.fromkeys(question.keys, given)
    return answers


def _answer(question: Question, text: str) -> str:
    """An answer as it stands in YAML; empty where there is none."""
    text = text.strip()
    if not text:
        return ""
    if question.most is None:
        if question.among and text not in question.among:
            raise typer.BadParameter(f"{text!r} is not one of {', '.join(question.among)}")
        return json.dumps(text, ensure_ascii=False)  # a JSON string is one of YAML
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        value = math.nan
    if not 0.0 < value <= question.most:
        raise typer.BadParameter(f"{text!r} is not a number of metres above 0, up to {question.most:g}")
    return f"{value:g}"


def next_step(command: str, why: str) -> None:
    """The command that a user is likely to want next."""
    say(f"next: {command}    # {why}")


def shown_path(path: Path) -> str:
    """A path as it is typed in a shell."""
    return shlex.quote(str(path))


def say_inputs(bag: Path, map_file: Path | None, config_file: Path | None, without_map: str = _MAPPED) -> None:
    """Print which map and configuration are read, also where they were not asked for."""
    from fgloc.recording.storage import find_beside, passed_over

    for given, file, option, name, without in (
        (map_file, "map.yaml", "map", "map", without_map),
        (config_file, "robot.yaml", "config", "configuration", "defaults"),
    ):
        found = given or find_beside(bag, file)
        say(f"{name}: {without if found is None else found}{'' if given or not found else ' (beside the recording)'}")
        result = None if given else passed_over(bag, file)
        if result is not None:
            say(f"note: {result} is what a run found, and not read; give --{option} {shown_path(result)} to use it")


def say_table(head: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> None:
    """Print a table: drawn on a terminal, plain columns on a pipe."""
    if not sys.stdout.isatty() or not rows:
        say(columns(head, rows))
        return
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD if head else None, show_header=head is not None, pad_edge=False)
    for name, cells in zip(head or ("",) * len(rows[0]), zip(*rows, strict=True), strict=True):
        table.add_column(Text(name), justify="right" if head and _are_figures(cells) else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(_plain(cell)) for cell in row))
    Console(highlight=False).print(table)


def _are_figures(cells: Sequence[str]) -> bool:
    return all(cell[:1].isdigit() or cell[:1] in "-+±" for cell in cells)


def number(value: float | None, form: str) -> str:
    """A figure, or a dash where there is none."""
    return "-" if value is None else form.format(value)


def columns(head: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> str:
    """A plain table: figures to the right, all else to the left."""
    lines = [head, *rows] if head else list(rows)
    if not lines:
        return ""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    right = [bool(head) and len(rows) > 0 and _are_figures([row[i] for row in rows]) for i in range(len(widths))]
    return "\n".join(
        "  ".join(
            cell.rjust(w) if r else cell.ljust(w) for cell, w, r in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in lines
    )


# --- Progress: bars on a terminal, else a line every ten seconds, both with the time left -----------------------------

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
def run_bar(label: str, unit: str = "s") -> Iterator[Progress]:
    """Progress bar of one recording, or of what else is counted: yields a function of how much is done, and of all."""
    try:
        yield lambda done, total: tell(label, done, total, unit)
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
        """Prepare; nothing is shown before the first progress is reported."""
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
        """Remove the bars."""
        if self._progress is not None:
            self._progress.stop()
        self._progress = None
        self._tasks = {}


def _rich_progress() -> Any:
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
    if not of.done and of.total is None:  # of unknown length
        return of.detail
    unit = f" {of.unit}" if of.unit else ""
    share = f" of {of.total:.0f}{unit} ({100.0 * of.done / of.total:.0f} %)" if of.total else unit
    return f"{of.done:.0f}{share}" + (f", {of.detail}" if of.detail else "")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"
