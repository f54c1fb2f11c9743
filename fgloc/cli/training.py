"""Commands of learned motion: ``train`` and ``evaluate-model``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fgloc.cli.extras import need
from fgloc.cli.options import BAG_HELP
from fgloc.cli.terminal import kept_on_interrupt, next_step, say, warn
from fgloc.errors import ConfigError
from fgloc.files.atomic import check_out


def train(
    inputs: Annotated[
        list[Path], typer.Argument(metavar="CONFIG | BAG...", help="training configuration; with --init: recordings")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="DIR", help="folder for the models; with --init: the configuration to be written"
        ),
    ],
    data: Annotated[
        Path | None,
        typer.Option(
            "--data", metavar="DIR", help="what the recordings' paths are relative to; default: CONFIG's folder"
        ),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="MODEL",
            help="adapt this model to the robot of the training recordings; a minute of driving is enough",
        ),
    ] = None,
    init: Annotated[
        bool, typer.Option("--init", help="write a training configuration of these bags, split by recording")
    ] = False,
) -> None:
    """Train a motion model of a robot. It is calibrated and judged; the same command goes on with a killed training."""
    if init:
        _write_config(inputs, out)
        return
    need("train", "fgloc train")
    if len(inputs) != 1:
        raise ConfigError(
            f"fgloc train: got {len(inputs)} files, expected one training configuration; "
            "for one of these recordings: fgloc train --init BAG... --out train.yaml"
        )
    check_out(out)
    from fgloc_training.session import CHECKPOINTS, Reporter, train_models

    (config,) = inputs
    kept = f"what was trained so far is kept in {out / CHECKPOINTS}; the same command goes on from there"
    with kept_on_interrupt(kept):
        models = train_models(config, data or config.parent, out, start, Reporter(say, warn))
    for model in models:
        say(f"model: {model}")
    next_step(f"fgloc smooth BAG --model {models[0]} --out DIR", "localize with it")


def evaluate_model(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="a .safetensors that fgloc train wrote")],
    bags: Annotated[list[Path], typer.Argument(metavar="BAG...", help=BAG_HELP)],
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="also write the figures here")
    ] = None,
    plots: Annotated[
        Path | None, typer.Option("--plots", metavar="DIR", help="draw tracks, growth of errors and calibration here")
    ] = None,
    against: Annotated[
        list[Path] | None, typer.Option("--against", metavar="MODEL", help="another model, for comparison; repeatable")
    ] = None,
) -> None:
    """Compare a motion model with the truth. It predicts whole recordings, without sightings."""
    for path, folder in ((json_file, False), (plots, True)):
        if path is not None:
            check_out(path, folder)
    from fgloc_training.evaluate import compare, draw, table, write_json

    found, rows = compare(model, bags, against or [])
    say(table(rows))
    if json_file is not None:
        write_json(json_file, rows)
    if plots is not None:
        draw(plots, found, rows)


def _write_config(bags: list[Path], out: Path) -> None:
    """``--init``."""
    from fgloc.cli.options import configured
    from fgloc.files.outputs import write_text
    from fgloc_training.initial import look, missing, training_yaml

    check_out(out, folder=False)
    found = [look(bag, configured(bag, None, None)) for bag in bags]
    write_text(out, training_yaml(found, out))
    for sentence in missing(found):
        warn(sentence)
    if not all(f.has_truth for f in found):
        next_step("fgloc smooth BAG --out smoothed/NAME", f"for each recording, as {out} says: they are the truth")
    next_step(f"fgloc train {out} --out models", "train")
