"""Identify a robot from its recordings: ``fgloc train CONFIG --data DIR --out DIR``.

Read from top to bottom: fit the known kinematics, train the mean on rolled-out trajectories with early stopping on
validation recordings, train the variance with the mean frozen, calibrate it on the validation recordings, export.
A run that was killed goes on from its last checkpoint when the same command is given again, and ends at the same files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from fgloc.errors import ConfigError
from fgloc.sensors.learned.card import ModelCard, Split
from fgloc.sensors.learned.sensor import Tensors, load_model, model_of, read_model, save_model
from fgloc_training.adapt import adapted
from fgloc_training.calibrate import fit_joint, fit_noise, fit_variance, noise_covs
from fgloc_training.checkpoint import Checkpoints, Curve
from fgloc_training.config import CalibrationConfig, TrainConfig
from fgloc_training.curves import warnings_of
from fgloc_training.data import Run
from fgloc_training.evaluate import STEP_S, card_figures
from fgloc_training.export import card_of, tensors_of
from fgloc_training.members import train_member
from fgloc_training.plots import draw_losses
from fgloc_training.rollouts import Rollout, roll_kinematics, roll_model, roll_wheels

_NOTHING_KEPT = Checkpoints()


def train(
    config: TrainConfig,
    split: Split,
    runs: dict[str, Run],
    path: Path,
    made_by: str,
    checkpoints: Checkpoints = _NOTHING_KEPT,
    warn: Callable[[str], None] = lambda _: None,
) -> ModelCard:
    """Train one model, calibrate it on its validation recordings, write it, and the curves of its losses beside it.

    Without validation recordings the training runs its full length and the covariance stays uncalibrated.

    Args:
        config: what is trained, and how.
        split: which recordings train, validate, test.
        runs: by name.
        path: file of the model.
        made_by: kept in the model's card.
        checkpoints: what an interrupted training goes on from.
        warn: called where the validation got worse.
    """
    validation = [runs[name] for name in split.validation]
    tensors, card, curves = train_uncalibrated(config, split, runs, path, made_by, checkpoints)
    if curves:
        draw_losses(path.with_name(f"{path.stem}.losses.png"), curves)
        for text in warnings_of(curves):
            warn(f"{path.stem}: {text}")
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
    nets, curves = [], dict[str, Curve]()
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
        return (
            roll_wheels(run, card.dt_s) if run.sensors.has_wheels else roll_kinematics(card.kinematics, run, card.dt_s)
        )

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


def train_on_all(
    config: TrainConfig,
    runs: dict[str, Run],
    folds: list[ModelCard],
    path: Path,
    made_by: str,
    checkpoints: Checkpoints = _NOTHING_KEPT,
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
