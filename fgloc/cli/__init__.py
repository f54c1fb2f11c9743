"""The command line. Only this package prints and exits.

Exit codes: 0 done, 1 bad input, 2 usage, 3 finished but LOST for part of the run, 130 interrupted.

Its modules import at the top what is light. What takes long to load (pydantic, gtsam, OpenCV, matplotlib, rosbags) is
imported by the command that needs it: ``fgloc --help`` and shell completion do not wait for it.
"""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from fgloc.cli import data, live, robot, runs
from fgloc.cli.terminal import EXIT_BAD_INPUT, examples, kept_on_interrupt, say, shown
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
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
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


_COMMANDS: tuple[tuple[str, Callable[..., None], tuple[str, ...]], ...] = (  # with examples
    ("demo", runs.demo, ("fgloc demo",)),
    ("info", robot.info, ("fgloc info run.bag --config robot.yaml",)),
    ("init", robot.init, ("fgloc init run.bag", "fgloc init run.mcap --out robot.yaml")),
    (
        "smooth",
        runs.smooth,
        (
            "fgloc smooth run.bag --config robot.yaml --map map.yaml --out results",
            "fgloc smooth *.mcap --config robot.yaml --out results    # a folder for each",
        ),
    ),
    (
        "online",
        runs.online,
        (
            "fgloc online run.bag --config robot.yaml --map map.yaml --out results",
            "fgloc online run.bag --config results/installation.yaml --map results/map.yaml --out again",
        ),
    ),
    ("live", live.live, ("fgloc live --map map.yaml --config robot.yaml --state run.state",)),
    ("play", live.play, ("fgloc play run.bag",)),
    ("evaluate", runs.evaluate, ("fgloc evaluate results/trajectory.tum results/truth.tum --align se2",)),
    ("compare", runs.compare, ("fgloc compare batch online --figure both.png",)),
    ("export", runs.export, ("fgloc export results --mcap run.mcap",)),
    ("map", robot.make_map, ("fgloc map tour.bag --dictionary DICT_4X4_50 --size 0.2 --out map.yaml",)),
    (
        "calibrate",
        robot.calibrate,
        ("fgloc calibrate run.bag --map map.yaml --config robot.yaml --out calibrated.yaml",),
    ),
    (
        "train",
        data.train,
        ("fgloc train --init run1.bag run2.bag --out train.yaml", "fgloc train train.yaml --out models"),
    ),
    ("evaluate-model", data.evaluate_model, ("fgloc evaluate-model models/model.safetensors run.bag",)),
    ("ablate", runs.ablate, ("fgloc ablate suite.yaml --out swept",)),
)
for _name, _command, _examples in _COMMANDS:
    app.command(name=_name, **examples(*_examples))(_command)
app.add_typer(data.sim_app, name="sim")
app.add_typer(data.convert_app, name="convert")


def main(*command: str) -> None:
    """Entry point of the ``fgloc`` command, or of one command of it."""
    sys.argv[1:1] = command
    app(prog_name="fgloc")
