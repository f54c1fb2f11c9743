"""The command line. Only this package prints and exits.

Exit codes: 0 done, 1 bad input, 2 usage, 3 finished but LOST for part of the run, 130 interrupted.

Its modules import at the top what is light. What takes long to load (pydantic, gtsam, OpenCV, matplotlib, rosbags) is
imported by the command that needs it: ``fgloc --help`` and shell completion do not wait for it.
"""

from __future__ import annotations

import errno
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from fgloc.cli import data, live, robot, runs
from fgloc.cli.terminal import EXIT_BAD_INPUT, kept_on_interrupt, say, shown
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
def common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Where a wheeled robot is, without GPS, with an honest covariance."""


app.command()(runs.demo)
app.command()(robot.info)
app.command()(robot.init)
app.command()(runs.smooth)
app.command()(runs.online)
app.command()(live.live)
app.command()(live.play)
app.command()(runs.evaluate)
app.command()(runs.export)
app.command(name="map")(robot.make_map)
app.command()(robot.calibrate)
app.command()(data.train)
app.command()(data.evaluate_model)
app.command()(runs.ablate)
app.add_typer(data.sim_app, name="sim")
app.add_typer(data.convert_app, name="convert")


def main(*command: str) -> None:
    """Entry point of the ``fgloc`` command, or of one command of it."""
    sys.argv[1:1] = command
    app(prog_name="fgloc")
