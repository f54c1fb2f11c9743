"""A training as ``fgloc train`` runs it: recordings read, models trained or adapted, all of it in one folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from fgloc.files.atomic import atomic_folder, check_out
from fgloc.instrumentation import counted
from fgloc.sensors.learned.card import ModelCard, Split
from fgloc_training.checkpoint import Checkpoints
from fgloc_training.config import TrainConfig, load_train_config
from fgloc_training.controls import controls, draw_controls
from fgloc_training.data import Run, load_runs
from fgloc_training.train import adapt, leave_one_out, train, train_on_all

CHECKPOINTS = ".checkpoints"


@dataclass(frozen=True, slots=True)
class Reporter:
    """Where messages go: `say` those on each finished model, `warn` those on what looks wrong."""

    say: Callable[[str], None]
    warn: Callable[[str], None]


def train_models(config_file: Path, data: Path, out: Path, start: Path | None, reporter: Reporter) -> list[Path]:
    """Train what a configuration asks for. Interrupted and run again it goes on, and ends at the same files.

    Args:
        config_file: see `fgloc_training.config.TrainConfig`.
        data: folder that the recordings' paths are relative to.
        out: folder of the models; it appears whole.
        start: a model to adapt, instead of training one.
        reporter: where messages go.

    Returns:
        The models' files.

    Raises:
        ConfigError: the configuration is wrong.
        RecordingError: a recording cannot be used.
        OutputError: `out` cannot be written.
    """
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    config = load_train_config(config_file)
    check_out(out)
    made_by = f"fgloc train {config_file.as_posix()}; {config.model_dump_json()}"
    smoothed = {name: data / folder for name, folder in config.truth.items()}
    parts = {
        name: load_runs(data / bag, name, config.network.dt_s, config.data, smoothed.get(name))
        for name, bag in counted(config.recordings.items(), "reading", len(config.recordings), "recordings")
    }
    runs = {name: run for part in parts.values() for name, run in part.items()}
    if config.split is not None:
        config = config.model_copy(update={"split": _in_parts(config.split, parts)})
    with atomic_folder(out, own=("*.safetensors", "*.png", CHECKPOINTS)) as stage:
        if start is not None:
            path = stage / "model.safetensors"
            reporter.say(_figures(path.stem, adapt(start, config, runs, path, f"{made_by}; from {start.name}")))
        else:
            _train_all(config, runs, stage, made_by, Checkpoints(out / CHECKPOINTS), reporter)
        names = sorted(path.name for path in stage.glob("*.safetensors"))
    return [out / name for name in names]


def _train_all(
    config: TrainConfig, runs: dict[str, Run], out: Path, made_by: str, checkpoints: Checkpoints, reporter: Reporter
) -> None:
    """The model of the configuration's split, or one for each recording left out, and one of all."""
    trained = list(runs) if config.split is None else config.split.train
    found = controls([runs[name] for name in trained], config.limits)
    draw_controls(out / "controls.png", found)
    for missing in found.missing():
        reporter.warn(f"the recordings hold too little of {missing}")
    if config.split is not None:
        path = out / "model.safetensors"
        card = train(config, config.split, runs, path, made_by, checkpoints, reporter.warn)
        reporter.say(_figures(path.stem, card))
        return
    folds = []
    for split in leave_one_out(list(runs)):
        path = out / f"without_{split.test[0]}.safetensors"
        folds.append(train(config, split, runs, path, made_by, checkpoints, reporter.warn))
        reporter.say(_figures(path.stem, folds[-1]))
    reporter.say(_figures("all", train_on_all(config, runs, folds, out / "all.safetensors", made_by, checkpoints)))


def _in_parts(split: Split, parts: dict[str, dict[str, Run]]) -> Split:
    """The split of recordings as one of the runs that they are made of."""

    def names(recordings: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(name for recording in recordings for name in parts[recording])

    return Split(train=names(split.train), validation=names(split.validation), test=names(split.test))


def _figures(name: str, card: ModelCard) -> str:
    figures = ", ".join(f"{k} {v:g}" for k, v in card.figures.items() if k.startswith(("drift", "nis")))
    return f"{name}: {figures}"
