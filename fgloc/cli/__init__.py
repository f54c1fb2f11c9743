"""The command line. Only this package prints and exits.

Exit codes: 0 done, 1 bad input, 2 usage, 3 finished but LOST for part of the run.
"""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from fgloc.cli import exports, live, runs, surveys, sweeps, tools
from fgloc.cli.terminal import EXIT_BAD_INPUT, say
from fgloc.errors import FglocError


class _Commands(TyperGroup):
    """Turns the package's errors into one line on stderr."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except FglocError as error:
            say(f"error: {error}", err=True)
            raise typer.Exit(EXIT_BAD_INPUT) from error


app = typer.Typer(
    cls=_Commands,
    help="Where a wheeled robot is, without GPS, with an honest covariance.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command()(runs.demo)
app.command()(tools.info)
app.command()(runs.smooth)
app.command()(runs.online)
app.command(name="live")(live.live)
app.command(name="play")(live.play)
app.command()(tools.evaluate)
app.command()(exports.export)
app.command(name="map")(surveys.make_map)
app.command()(runs.calibrate)
app.command()(sweeps.ablate)


def main() -> None:
    """Entry point of the ``fgloc`` command."""
    app()
