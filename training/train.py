"""``python -m training.train CONFIG --data DIR --out DIR``: identify a robot from its recordings.

Read from top to bottom: fit the known kinematics, train the mean on rolled-out trajectories with early stopping on
validation recordings, train the variance with the mean frozen, calibrate it on the validation recordings, export.
"""

from __future__ import annotations

import argparse
import copy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from fgloc.errors import FglocError, RecordingError
from fgloc.motion.card import Kinematics, ModelCard, Split
from fgloc.motion.load import Tensors, load_model, read_model, save_model
from fgloc.motion.signals import Signal
from training.calibrate import fit_joint, fit_kinematics, fit_lag, fit_noise, fit_variance, noise_covs
from training.config import CalibrationConfig, NetworkConfig, OptimizationConfig, TrainConfig, load_train_config
from training.data import Run, load_run
from training.evaluate import STEP_S, card_figures
from training.export import card_of, tensors_of
from training.losses import composed_nll, end_errors, rollout_loss
from training.models import DisplacementNet, MotionNet, Samples, VelocityNet, relative
from training.rollouts import Rollout, roll_kinematics, roll_model, roll_wheels

_VALIDATION_S = (10.0, 30.0)
_SEEDS_APART = 1_000  # between the members of an ensemble
HISTORY_S = 3.0  # of commands before the first sample of a run: enough for every model


def train(config: TrainConfig, split: Split, runs: dict[str, Run], path: Path, made_by: str) -> ModelCard:
    """Train one model, calibrate it on its validation recordings, write it.

    Without validation recordings the training runs its full length and the covariance stays uncalibrated.
    """
    validation = [runs[name] for name in split.validation]
    tensors, card = train_uncalibrated(config, split, runs, path, made_by)
    if not validation:
        return card
    held_out = held_out_rollouts(path, card, validation)
    if config.calibration.cross:
        held_out += cross_rollouts(config, split, runs, path, made_by)
    card = calibrate(card, held_out, config.calibration)
    tested = [runs[name] for name in split.test] or validation
    save_model(path, tensors, card)
    card = card.model_copy(update={"figures": card_figures([roll_model(load_model(path), r, STEP_S) for r in tested])})
    save_model(path, tensors, card)
    return card


def train_uncalibrated(
    config: TrainConfig, split: Split, runs: dict[str, Run], path: Path, made_by: str
) -> tuple[Tensors, ModelCard]:
    """Train all members and write them with a card that knows no calibration yet."""
    training = [runs[name] for name in split.train]
    validation = [runs[name] for name in split.validation]
    nets = [train_member(config, training, validation, member) for member in range(config.network.members)]
    tensors, card = tensors_of(nets), card_of(nets[0], config, split, made_by)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_model(path, tensors, card)
    return tensors, card


def held_out_rollouts(path: Path, card: ModelCard, runs: list[Run]) -> list[tuple[Rollout, Rollout]]:
    """Of the model and of wheel odometry, or of the model's kinematics where there is none, over each run."""
    model = load_model(path)

    def wheels(run: Run) -> Rollout:
        return roll_wheels(run, card.dt_s) if run.heard.has_wheels else roll_kinematics(card.kinematics, run, card.dt_s)

    return [(roll_model(model, run, card.dt_s), wheels(run)) for run in runs]


def cross_rollouts(
    config: TrainConfig, split: Split, runs: dict[str, Run], path: Path, made_by: str
) -> list[tuple[Rollout, Rollout]]:
    """Over each training recording, by a model that left it out. These models are not kept."""
    found, scratch = [], path.with_name(path.name + ".fold")
    for name in split.train:
        fold = split.model_copy(update={"train": tuple(n for n in split.train if n != name)})
        _, card = train_uncalibrated(config, fold, runs, scratch, made_by)
        found += held_out_rollouts(scratch, card, [runs[name]])
        scratch.unlink()
    return found


def train_member(config: TrainConfig, training: list[Run], validation: list[Run], member: int) -> MotionNet:
    """One network; the members of an ensemble differ by their seed."""
    optimization = config.optimization.model_copy(update={"seed": config.optimization.seed + _SEEDS_APART * member})
    torch.manual_seed(optimization.seed)
    net = new_net(config.network, training)
    train_mean(net, training, validation, optimization)
    if isinstance(net, DisplacementNet):
        train_variance(net, training, validation, optimization)
    return net


def new_net(config: NetworkConfig, training: list[Run]) -> MotionNet:
    """An untrained network on top of what is known of these recordings' robot."""
    kinematics = fit_kinematics(training)
    if config.kind == "displacement":
        wheel_kinematics = fit_kinematics(training, _wheels_of) if "wheels" in config.inputs else Kinematics()
        return DisplacementNet(config, kinematics, wheel_kinematics, training)
    return VelocityNet(config, kinematics, fit_lag(training, kinematics), training)


def _wheels_of(run: Run) -> Signal:
    wheels = run.heard.signals(("wheels",), run.origin_ns).wheels
    if wheels is None:
        raise RecordingError(
            f"{run.name}: the model is to read the wheels, but no joints with known geometry are there"
        )
    return wheels


def train_mean(net: MotionNet, training: list[Run], validation: list[Run], config: OptimizationConfig) -> None:
    """Adam on the multi-step loss; keeps the weights that were best on the validation recordings."""
    rng = torch.Generator().manual_seed(config.seed)
    samples = net.samples(training)
    steps = round(config.horizon_s / samples.dt_s)
    starts = window_starts(training, steps)
    held_out = net.samples(validation) if validation else None
    optimizer = torch.optim.Adam(net.parameters(), lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.iterations)
    best, best_state, waited = np.inf, copy.deepcopy(net.state_dict()), 0
    with tqdm(total=config.iterations, desc="mean", disable=None, leave=False) as bar:
        for i in range(1, config.iterations + 1):
            chosen = starts[torch.randint(len(starts), (config.batch,), generator=rng)]
            truth = samples.poses[chosen[:, None] + torch.arange(steps + 1)]
            loss = rollout_loss(net.roll(samples, chosen, steps, rng), truth, samples.dt_s, config)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0)
            optimizer.step()
            schedule.step()
            bar.update()
            if held_out is None or i % config.validate_every:
                continue
            score = validate(net, held_out, validation)
            bar.set_postfix(validation=f"{score:.2f} %")
            waited += 1
            if score < best:
                best, best_state, waited = score, copy.deepcopy(net.state_dict()), 0
            if waited >= config.patience:
                break
    if held_out is not None:
        net.load_state_dict(best_state)


def validate(net: MotionNet, samples: Samples, runs: list[Run]) -> float:
    """Drift [%] of free rollouts, averaged over the horizons that the runs allow."""
    drifts = []
    for horizon in _VALIDATION_S:
        steps = round(horizon / samples.dt_s)
        starts = window_starts(runs, steps, stride=round(1.0 / samples.dt_s))
        if not len(starts):
            continue
        with torch.no_grad():
            predicted = net.roll(samples, starts, steps)[:, -1]
        truth = samples.poses[starts[:, None] + torch.arange(steps + 1)]
        error = predicted - relative(truth[:, 0], truth[:, -1])
        distance = truth[:, 1:, :2].sub(truth[:, :-1, :2]).norm(dim=-1).sum()
        drifts.append(100.0 * float(error[:, :2].norm(dim=-1).sum() / distance))
    if not drifts:
        raise FglocError(
            f"the validation recordings hold no {_VALIDATION_S[0]:.0f} s of unbroken truth; give longer ones"
        )
    return float(np.mean(drifts))


def train_variance(
    net: DisplacementNet, training: list[Run], validation: list[Run], config: OptimizationConfig
) -> None:
    """Likelihood of the composed errors over windows; only the variance head learns."""
    rng = torch.Generator().manual_seed(config.seed)
    samples = net.samples(training)
    steps = round(config.variance_horizon_s / samples.dt_s)
    starts = window_starts(training, steps)
    held_out = net.samples(validation) if validation else None
    optimizer = torch.optim.Adam(net.variance_head.parameters(), lr=config.learning_rate)
    best, best_state = np.inf, copy.deepcopy(net.variance_head.state_dict())

    def loss_of(on: Samples, chosen: Tensor) -> Tensor:
        with torch.no_grad():
            _, hidden = net.hidden(on, chosen, steps, None)
            truth = on.poses[chosen[:, None] + torch.arange(steps + 1)]
            error, adjoints = end_errors(net.roll(on, chosen, steps), truth)
        return composed_nll(error, adjoints, net.variance_head(hidden), on.dt_s)

    for i in tqdm(range(1, config.variance_iterations + 1), desc="variance", disable=None, leave=False):
        loss = loss_of(samples, starts[torch.randint(len(starts), (config.batch,), generator=rng)])
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.variance_head.parameters(), 5.0)
        optimizer.step()
        if held_out is not None and i % 25 == 0:
            with torch.no_grad():
                score = float(loss_of(held_out, window_starts(validation, steps, stride=round(1.0 / samples.dt_s))))
            if score < best:
                best, best_state = score, copy.deepcopy(net.variance_head.state_dict())
    if held_out is not None:
        net.variance_head.load_state_dict(best_state)


def calibrate(card: ModelCard, held_out: list[tuple[Rollout, Rollout]], config: CalibrationConfig) -> ModelCard:
    """The card with covariances that hold on these rollouts, and their correlation with the wheels' stand-in."""
    rollouts, wheels = [learned for learned, _ in held_out], [kinematics for _, kinematics in held_out]
    if card.kind == "velocity":
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


def window_starts(runs: list[Run], steps: int, stride: int = 1) -> Tensor:
    """Rows of `Samples` from which a window of steps has truth throughout."""
    offsets = np.concatenate([[0], np.cumsum([len(run.poses) for run in runs])])
    parts = [run.starts(steps, stride) + offset for run, offset in zip(runs, offsets, strict=False)]
    return torch.from_numpy(np.concatenate(parts))


def _from_all(config: TrainConfig, runs: dict[str, Run], folds: list[ModelCard], path: Path, made_by: str) -> ModelCard:
    """A model from every recording, calibrated and judged by the models that left one out."""
    split = Split(train=tuple(runs), validation=())
    card = train(config, split, runs, path, made_by)
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
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    try:
        config = load_train_config(options.config)
        made_by = f"python -m training.train {options.config.as_posix()}; {config.model_dump_json()}"
        runs = {
            name: load_run(options.data / bag, name, config.network.dt_s, HISTORY_S, config.data)
            for name, bag in tqdm(config.recordings.items(), desc="reading", disable=None, leave=False)
        }
        if config.split is not None:
            _report("model", train(config, config.split, runs, options.out / "model.safetensors", made_by))
            return 0
        folds = []
        for split in leave_one_out(list(runs)):
            path = options.out / f"without_{split.test[0]}.safetensors"
            folds.append(train(config, split, runs, path, made_by))
            _report(path.stem, folds[-1])
        _report("all", _from_all(config, runs, folds, options.out / "all.safetensors", made_by))
    except FglocError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _report(name: str, card: ModelCard) -> None:
    figures = ", ".join(f"{k} {v:g}" for k, v in card.figures.items() if k.startswith(("drift", "nis")))
    print(f"{name}: {figures}", flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
