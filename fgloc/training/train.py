"""``python -m training.train CONFIG --data DIR --out DIR``: identify a robot from its recordings.

Read from top to bottom: fit the known kinematics, train the mean on rolled-out trajectories with early stopping on
validation recordings, train the variance with the mean frozen, calibrate it on the validation recordings, export.
A run that was killed goes on from its last checkpoint when the same command is given again, and ends at the same files.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

try:
    import torch
except ModuleNotFoundError as missing:
    raise SystemExit("error: torch is not installed; pip install 'fgloc[train]'") from missing
from tqdm import tqdm

from fgloc.errors import ConfigError, FglocError
from fgloc.files.atomic import atomic_folder, check_out
from fgloc.sensors.learned.card import ModelCard, Split
from fgloc.sensors.learned.load import Tensors, load_model, model_of, read_model, save_model
from fgloc.training.adapt import adapted
from fgloc.training.calibrate import fit_joint, fit_noise, fit_variance, noise_covs
from fgloc.training.checkpoint import Checkpoints, Curve
from fgloc.training.config import CalibrationConfig, TrainConfig, load_train_config
from fgloc.training.controls import controls, draw_controls
from fgloc.training.data import Run, load_runs
from fgloc.training.evaluate import STEP_S, card_figures
from fgloc.training.export import card_of, tensors_of
from fgloc.training.members import train_member
from fgloc.training.plots import draw_losses
from fgloc.training.rollouts import Rollout, roll_kinematics, roll_model, roll_wheels

_NOTHING_KEPT = Checkpoints()


def train(
    config: TrainConfig,
    split: Split,
    runs: dict[str, Run],
    path: Path,
    made_by: str,
    checkpoints: Checkpoints = _NOTHING_KEPT,
) -> ModelCard:
    """Train one model, calibrate it on its validation recordings, write it, and the curves of its losses beside it.

    Without validation recordings the training runs its full length and the covariance stays uncalibrated.
    """
    validation = [runs[name] for name in split.validation]
    tensors, card, curves = train_uncalibrated(config, split, runs, path, made_by, checkpoints)
    if curves:
        draw_losses(path.with_name(f"{path.stem}.losses.png"), curves)
    if not validation:
        return card
    held_out = held_out_rollouts(path, card, validation)
    if config.calibration.cross:
        held_out += cross_rollouts(config, split, runs, path, made_by, checkpoints)
    card = calibrate(card, held_out, config.calibration)
    if (window_s := config.adaptation.after_training_s) is not None:
        card = adapted(tensors, card, [runs[name] for name in split.train], config.adaptation, window_s)
    tested = [runs[name] for name in split.test] or validation
    save_model(path, tensors, card)
    card = card.model_copy(update={"figures": card_figures([roll_model(load_model(path), r, STEP_S) for r in tested])})
    save_model(path, tensors, card)
    return card


def adapt(start: Path, config: TrainConfig, runs: dict[str, Run], path: Path, made_by: str) -> ModelCard:
    """Write a model that was made of other robots, fitted to this one on the training recordings of the split.

    Its covariance stays that of a robot not seen. Figures are of the split's test recordings, or else its validation's.

    Raises:
        ConfigError: there is no split.
        RecordingError: the recordings are too short.
    """
    if config.split is None:
        raise ConfigError("a model is adapted to the training recordings of a split; give one, not leave_one_out")
    tensors, card = read_model(start)
    card = adapted(tensors, card, [runs[name] for name in config.split.train], config.adaptation)
    tested = config.split.test or config.split.validation
    rollouts = [roll_model(model_of(tensors, card), runs[name], STEP_S) for name in tested]
    update = {"robot": config.robot, "split": config.split, "made_by": made_by, "figures": card_figures(rollouts)}
    card = card.model_copy(update=update)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_model(path, tensors, card)
    return card


def train_uncalibrated(
    config: TrainConfig, split: Split, runs: dict[str, Run], path: Path, made_by: str, checkpoints: Checkpoints
) -> tuple[Tensors, ModelCard, dict[str, Curve]]:
    """Train all members and write them with a card that knows no calibration yet."""
    nets, curves = [], {}
    for member in range(config.network.members):
        net, found = train_member(config, split, runs, member, checkpoints)
        nets.append(net)
        curves |= {
            f"{stage}, member {member}" if config.network.members > 1 else stage: c for stage, c in found.items()
        }
    tensors, card = tensors_of(nets), card_of(nets[0], config, split, made_by)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_model(path, tensors, card)
    return tensors, card, curves


def held_out_rollouts(path: Path, card: ModelCard, runs: list[Run]) -> list[tuple[Rollout, Rollout]]:
    """Of the model and of wheel odometry, or of the model's kinematics where there is none, over each run."""
    model = load_model(path)

    def wheels(run: Run) -> Rollout:
        return roll_wheels(run, card.dt_s) if run.heard.has_wheels else roll_kinematics(card.kinematics, run, card.dt_s)

    return [(roll_model(model, run, card.dt_s), wheels(run)) for run in runs]


def cross_rollouts(
    config: TrainConfig, split: Split, runs: dict[str, Run], path: Path, made_by: str, checkpoints: Checkpoints
) -> list[tuple[Rollout, Rollout]]:
    """Over each training recording, by a model that left it out. These models are not kept."""
    found, scratch = [], path.with_name(path.name + ".fold")
    for name in split.train:
        fold = split.model_copy(update={"train": tuple(n for n in split.train if n != name)})
        _, card, _ = train_uncalibrated(config, fold, runs, scratch, made_by, checkpoints)
        found += held_out_rollouts(scratch, card, [runs[name]])
        scratch.unlink()
    return found


def calibrate(card: ModelCard, held_out: list[tuple[Rollout, Rollout]], config: CalibrationConfig) -> ModelCard:
    """The card with covariances that hold on these rollouts, and their correlation with the wheels' stand-in."""
    rollouts, wheels = [learned for learned, _ in held_out], [kinematics for _, kinematics in held_out]
    if card.family != "displacement":
        noise = fit_noise(rollouts, config)
        card = card.model_copy(update={"noise": noise})
        rollouts = [replace(r, covs=noise_covs(r, noise)) for r in rollouts]
    else:
        scale, memory = fit_variance(rollouts, config)
        card = card.model_copy(update={"variance_scale": scale, "memory": memory})
        factors = np.sqrt(scale)
        rollouts = [replace(r, covs=r.covs * np.outer(factors, factors), memory=memory) for r in rollouts]
    wheels_noise = fit_noise(wheels, config)
    wheels = [replace(r, covs=noise_covs(r, wheels_noise)) for r in wheels]
    return card.model_copy(update={"wheels_noise": wheels_noise, "joint": fit_joint(rollouts, wheels, config)})


def leave_one_out(names: list[str]) -> list[Split]:
    """A split per recording left out: it tests, the next one validates, the rest train."""
    splits = []
    for i, name in enumerate(names):
        other = names[(i + 1) % len(names)]
        rest = tuple(n for n in names if n not in (name, other))
        splits.append(Split(train=rest, validation=(other,), test=(name,)))
    return splits


def _from_all(
    config: TrainConfig,
    runs: dict[str, Run],
    folds: list[ModelCard],
    path: Path,
    made_by: str,
    checkpoints: Checkpoints,
) -> ModelCard:
    """A model from every recording, calibrated and judged by the models that left one out."""
    split = Split(train=tuple(runs), validation=())
    card = train(config, split, runs, path, made_by, checkpoints)
    scale = np.exp(np.mean([np.log(c.variance_scale) for c in folds], axis=0))
    update: dict[str, object] = {
        "variance_scale": tuple(float(s) for s in scale),
        "figures": {k: round(float(np.mean([c.figures[k] for c in folds])), 4) for k in folds[0].figures},
    }
    for name in ("noise", "wheels_noise", "memory", "joint"):
        parts = [getattr(c, name) for c in folds]
        if parts[0] is not None:
            update[name] = type(parts[0]).model_validate(_mean([p.model_dump() for p in parts]))
    tensors, _ = read_model(path)
    card = card.model_copy(update=update)
    save_model(path, tensors, card)
    return card


def _mean(dumps: list[dict[str, object]]) -> dict[str, object]:
    return {key: np.mean([d[key] for d in dumps], axis=0).tolist() for key in dumps[0]}  # type: ignore[arg-type]


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m training.train", description=__doc__.splitlines()[0])
    parser.add_argument("config", type=Path)
    parser.add_argument("--data", type=Path, default=Path(), help="folder that the recordings' paths are relative to")
    parser.add_argument("--out", type=Path, required=True, help="folder for the models")
    parser.add_argument(
        "--from",
        dest="start",
        type=Path,
        metavar="MODEL",
        help="adapt this model to the robot of the split's training recordings, a minute of which will do",
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    try:
        config = load_train_config(options.config)
        check_out(options.out)
        made_by = f"python -m training.train {options.config.as_posix()}; {config.model_dump_json()}"
        smoothed = {name: options.data / folder for name, folder in config.truth.items()}
        parts = {
            name: load_runs(options.data / bag, name, config.network.dt_s, config.data, smoothed.get(name))
            for name, bag in tqdm(config.recordings.items(), desc="reading", disable=None, leave=False)
        }
        runs = {name: run for part in parts.values() for name, run in part.items()}
        if config.split is not None:
            config = config.model_copy(update={"split": _in_parts(config.split, parts)})
        checkpoints = Checkpoints(options.out / ".checkpoints")
        with atomic_folder(options.out, own=("*.safetensors", "*.png", ".checkpoints")) as stage:
            if options.start is not None:
                path = stage / "model.safetensors"
                _report(path.stem, adapt(options.start, config, runs, path, f"{made_by}; from {options.start.name}"))
            else:
                _train_all(config, runs, stage, made_by, checkpoints)
    except FglocError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _train_all(config: TrainConfig, runs: dict[str, Run], out: Path, made_by: str, checkpoints: Checkpoints) -> None:
    """The model of the configuration's split, or one for each recording left out, and one of all."""
    trained = list(runs) if config.split is None else config.split.train
    _report_controls([runs[name] for name in trained], config, out)
    if config.split is not None:
        path = out / "model.safetensors"
        _report(path.stem, train(config, config.split, runs, path, made_by, checkpoints))
        return
    folds = []
    for split in leave_one_out(list(runs)):
        path = out / f"without_{split.test[0]}.safetensors"
        folds.append(train(config, split, runs, path, made_by, checkpoints))
        _report(path.stem, folds[-1])
    _report("all", _from_all(config, runs, folds, out / "all.safetensors", made_by, checkpoints))


def _report_controls(training: list[Run], config: TrainConfig, out: Path) -> None:
    found = controls(training, config.limits)
    draw_controls(out / "controls.png", found)
    for missing in found.missing():
        print(f"warning: the recordings hold too little of {missing}", file=sys.stderr)


def _in_parts(split: Split, parts: dict[str, dict[str, Run]]) -> Split:
    """The split of recordings as one of the runs that they are made of."""

    def names(recordings: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(name for recording in recordings for name in parts[recording])

    return Split(train=names(split.train), validation=names(split.validation), test=names(split.test))


def _report(name: str, card: ModelCard) -> None:
    figures = ", ".join(f"{k} {v:g}" for k, v in card.figures.items() if k.startswith(("drift", "nis")))
    print(f"{name}: {figures}", flush=True)
