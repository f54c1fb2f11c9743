"""The command line. Only this package prints and exits.

Exit codes: 0 done, 1 bad input, 2 usage, 3 finished but LOST for part of the run, 130 interrupted.
"""

from __future__ import annotations

import errno
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from fgloc.cli import begin, convert, exports, live, runs, sim, surveys, sweeps, tools, training
from fgloc.cli.progress import shown
from fgloc.cli.terminal import EXIT_BAD_INPUT, kept_on_interrupt, say
from fgloc.errors import FglocError


class _Commands(TyperGroup):
    """Turns the package's errors into one line on stderr, and shows progress there."""

    def invoke(self, ctx: Any) -> Any:
        try:
            with kept_on_interrupt(), shown():
                return super().invoke(ctx)
        except FglocError as error:
            say(f"error: {error}", err=True)
        except OSError as error:  # of a file that a converter or the system refused
            if error.errno == errno.EPIPE:
                raise
            say(f"error: {error}", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)


app = typer.Typer(
    cls=_Commands,
    help="Where a wheeled robot is, without GPS, with an honest covariance.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        say(f"fgloc {version('fgloc')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Where a wheeled robot is, without GPS, with an honest covariance."""


app.command()(runs.demo)
app.command()(tools.info)
app.command(name="init")(begin.init)
app.command()(runs.smooth)
app.command()(runs.online)
app.command(name="live")(live.live)
app.command(name="play")(live.play)
app.command()(tools.evaluate)
app.command()(exports.export)
app.command(name="map")(surveys.make_map)
app.command()(runs.calibrate)
app.command()(training.train)
app.command(name="evaluate-model")(training.evaluate_model)
app.command()(sweeps.ablate)
app.add_typer(sim.app, name="sim")
app.add_typer(convert.app, name="convert")


def main(*command: str) -> None:
    """Entry point of the ``fgloc`` command, or of one command of it."""
    sys.argv[1:1] = command
    app(prog_name="fgloc")
