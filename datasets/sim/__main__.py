"""``python -m datasets.sim``: record simulated runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from datasets.sim.record import record as record_run
from datasets.sim.suite import BUNDLED, load_suite
from fgloc.errors import ConfigError, FglocError

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def main() -> None:
    """Record wheeled robots in a physical simulator (MuJoCo), with known truth."""


@app.command()
def record(
    scenario: Annotated[str, typer.Argument(help="a scenario of the bundled suite, or a YAML file with one")],
    out: Annotated[Path, typer.Option(help="folder: bag/, map.yaml, robot.yaml, scenario.yaml")],
    seed: Annotated[int, typer.Option(min=0)] = 1,
    camera: Annotated[bool, typer.Option(help="render images")] = True,
) -> None:
    """Record one run of a scenario."""
    path = Path(scenario)
    suite = load_suite(path if path.suffix in (".yaml", ".yml") else BUNDLED)
    entry = suite.entries[0] if path.suffix in (".yaml", ".yml") else suite.find(scenario)
    if entry is None:
        names = ", ".join(e.scenario.name for e in suite.entries)
        raise ConfigError(f"scenario '{scenario}' is not in the bundled suite; it has {names}; or give a YAML file")
    typer.echo(record_run(entry.scenario, seed, out, camera))


if __name__ == "__main__":
    try:
        app()
    except (FglocError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise SystemExit(1) from error
