"""Identification of a robot from its recordings: ``fgloc train CONFIG --data DIR --out DIR``.

Steps in their order: fit the known kinematics, train the mean on rolled-out trajectories with early stopping on
validation recordings, train the variance with the mean frozen, calibrate it on the validation recordings, export. A
run that was killed goes on from its last checkpoint when the same command is given again, and ends at the same
files.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from fgloc.errors import ConfigError, FglocError, RecordingError
from fgloc.files.atomic import atomic_folder, check_out
from fgloc.instrumentation import counted
from fgloc.recording.storage import refuse_repeats
from fgloc.sensors.base import Signal
from fgloc.sensors.learned.card import Kinematics, ModelCard, Split
from fgloc.sensors.learned.sensor import Tensors, load_model, model_of, read_model, save_model
from fgloc_training.calibrate import adapted, fit_joint, fit_kinematics, fit_lag, fit_noise, fit_variance, noise_covs
from fgloc_training.config import CalibrationConfig, NetworkConfig, TrainConfig, load_train_config
from fgloc_training.data import Run, load_runs, need_windows
from fgloc_training.evaluate import STEP_S, card_figures, save, told_worth, worth
from fgloc_training.models import DisplacementNet, MotionNet, NaiveNet, Trunk, VelocityNet
from fgloc_training.optimize import Checkpoints, Curve, train_mean, train_variance
from fgloc_training.recordings import controls, draw_controls
from fgloc_training.rollouts import Rollout, roll_kinematics, roll_model, roll_sources

# --- Networks of an ensemble ------------------------------------------------------------------------------------------

_SEEDS_APART = 1_000  # between the members of an ensemble


def train_member(
    config: TrainConfig, split: Split, runs: dict[str, Run], member: int, checkpoints: Checkpoints
) -> tuple[MotionNet, dict[str, Curve]]:
    """Train one network; the members of an ensemble differ by their seed."""
    optimization = config.optimization.model_copy(update={"seed": config.optimization.seed + _SEEDS_APART * member})
    training, validation = ([runs[name] for name in names] for names in (split.train, split.validation))
    kept = {stage: checkpoints.of(config, split, runs, member, stage) for stage in ("mean", "variance")}
    torch.manual_seed(optimization.seed)
    net = new_net(config.network, training)
    curves = {}
    if not isinstance(net, NaiveNet) and any(True for _ in net.parameters()):
        curves["mean"] = train_mean(net, training, validation, optimization, kept["mean"])
    if isinstance(net, DisplacementNet):
        curves["variance"] = train_variance(net, training, validation, optimization, kept["variance"])
    return net, curves


def new_net(config: NetworkConfig, training: list[Run]) -> MotionNet:
    """An untrained network on top of what is known of these recordings' robot."""
    if config.kind == "naive":
        return NaiveNet(config)
    displaced = config.kind in ("displacement", "gru")
    kinematics = fit_kinematics(training, sideways=displaced and "sideways" in config.inputs)
    if displaced:
        wheel_kinematics = fit_kinematics(training, _wheels_of) if "wheels" in config.inputs else Kinematics()
        return DisplacementNet(config, kinematics, wheel_kinematics, training)
    lag = None if config.kind == "rate" else fit_lag(training, kinematics)
    return VelocityNet(config, kinematics, lag, training)


def _wheels_of(run: Run) -> Signal:
    wheels = run.sensors.signals(("wheels",), run.origin_ns).named("wheels")
    if wheels is None:
        raise RecordingError(
            f"{run.name}: the model is to read the wheels, but no joints with known geometry are there"
        )
    return wheels


# --- Curves of a training ---------------------------------------------------------------------------------------------

_SMOOTH = 25  # batches in the running mean of a loss
_WORSE_DRIFT = 1.2  # last validated drift over the best one; less is the scatter between validations
_WORSE_NLL = 3.0  # nats of the mean negative log-likelihood of a window: its errors are e³ times less likely


def warnings_of(curves: Mapping[str, Curve]) -> list[str]:
    """Sentences on stages whose validation went wrong; none if all is well.

    Args:
        curves: by stage: ``mean`` scores are drifts [%], ``variance`` scores negative log-likelihoods.
    """
    return [text for stage, curve in curves.items() if (text := _warning(stage, curve)) is not None]


def _warning(stage: str, curve: Curve) -> str | None:
    if not curve.scores:
        return None
    kind = "drift of the validation recordings [%]" if stage.startswith("mean") else "negative log-likelihood"
    finite = [(i, s) for i, s in curve.scores if math.isfinite(s)]
    if not finite:
        return f"{stage}: the {kind} is not finite; the recordings hold errors that no variance explains"
    (first_at, first), (last_at, last) = finite[0], finite[-1]
    best_at, best = min(finite, key=lambda pair: pair[1])
    worse = last > _WORSE_DRIFT * best if stage.startswith("mean") else last > best + _WORSE_NLL
    if not worse:
        return None
    kept = f"the state of iteration {best_at} is kept"
    if best_at == first_at and len(finite) > 1:
        return (
            f"{stage}: the {kind} got worse from the first validation on, from {first:.3g} to {last:.3g} at iteration "
            f"{last_at} ({kept}): the validation recordings differ from those that train, or these are too few; record "
            "more like them, or give a smaller network (network.hidden)"
        )
    return (
        f"{stage}: the {kind} got worse after iteration {best_at}, from {best:.3g} to {last:.3g} at iteration "
        f"{last_at} ({kept}): the network learns the training recordings by heart; record more, or give a smaller "
        "network (network.hidden)"
    )


def draw_losses(path: Path, curves: dict[str, Curve]) -> None:
    """Losses of the batches and scores on the validation recordings, a panel for each stage."""
    figure = Figure(figsize=(5.5 * len(curves), 3.6), layout="constrained")
    for axes, (name, curve) in zip(np.atleast_1d(figure.subplots(1, len(curves))), curves.items(), strict=True):
        losses = np.array(curve.losses)
        axes.plot(np.arange(1, len(losses) + 1), losses, color="0.8", linewidth=0.6, label="batch")
        if len(losses) > _SMOOTH:
            mean = np.convolve(losses, np.full(_SMOOTH, 1.0 / _SMOOTH), "valid")
            axes.plot(np.arange(_SMOOTH, len(losses) + 1), mean, color="C0", label=f"mean of {_SMOOTH} batches")
        axes.set_title(name, pad=20)
        axes.set(xlabel="iteration", ylabel="training loss")
        low, high = np.percentile(losses, [0.5, 99.5]) if len(losses) else (0.0, 1.0)
        axes.set_ylim(low - 0.05 * (high - low) - 1e-9, high + 0.05 * (high - low) + 1e-9)
        lines = list(axes.get_lines())
        if curve.scores:
            other = axes.twinx()
            at, scores = np.array(curve.scores).T
            lines += other.plot(at, scores, "o-", color="C1", markersize=3, label="validation")
            best = int(np.argmin(scores))
            lines += other.plot(at[best], scores[best], "o", color="C3", label="kept")
            other.set_ylabel("drift [%]" if name.startswith("mean") else "negative log-likelihood")
        axes.legend(
            handles=lines, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(lines), frameon=False
        )
    save(figure, path)


# --- Model files ------------------------------------------------------------------------------------------------------

_WARM_UP_S = 2.0  # a velocity model that is given no velocity starts from rest this long ago


def tensors_of(nets: list[MotionNet]) -> Tensors:
    """Weights by the names that `fgloc.sensors.learned.load_model` expects; those of several networks stacked."""
    out: Tensors = {}
    for i, members in enumerate(zip(*(net.layers() for net in nets), strict=True)):
        for name, tensors in zip(("weight", "bias"), zip(*members, strict=True), strict=True):
            arrays = [np.ascontiguousarray(tensor.detach().numpy()) for tensor in tensors]
            out[f"layer{i}.{name}"] = np.stack(arrays) if len(arrays) > 1 else arrays[0]
    if isinstance(nets[0], DisplacementNet) and isinstance(nets[0].trunk, Trunk):
        out |= {name: tensor.detach().numpy() for name, tensor in nets[0].trunk.weights().items()}
    return out


def _widths(net: MotionNet) -> tuple[int, ...]:
    """Widths of the hidden layers as `tensors_of` stacks them; empty for a model without any."""
    kind, hidden = net.config.kind, net.config.hidden
    if kind in ("naive", "lag", "arx"):
        return ()
    return tuple(h + net.config.variance_units for h in hidden) if kind == "displacement" else hidden


def card_of(net: MotionNet, config: TrainConfig, split: Split, made_by: str) -> ModelCard:
    """The card of a network that is trained and not yet calibrated."""
    network = config.network
    displacement = isinstance(net, DisplacementNet)
    velocity = isinstance(net, VelocityNet)
    return ModelCard.model_validate(
        dict(
            kind=network.kind,
            robot=config.robot,
            inputs=network.inputs if displacement else ("commands", "velocity") if velocity else ("commands",),
            dt_s=network.dt_s,
            hidden=_widths(net),
            members=network.members,
            hold_s=network.hold_s,
            history_s=max(network.edges_s[-1], net.kinematics.delay_s) if displacement else _WARM_UP_S,
            kinematics=net.kinematics,
            lag=None if displacement else net.lag,
            edges_s=network.edges_s if displacement else (),
            joints=net.joints if displacement and {"effort", "wheels"} & set(network.inputs) else None,
            signal_edges_s=network.signal_edges_s,
            wheel_kinematics=net.wheel_kinematics if displacement else {},
            velocity_decay_s=network.velocity_decay_s,
            input_mean=net.mean.tolist(),
            input_std=net.std.tolist(),
            output_scale=net.scale.tolist(),
            noise=None if displacement else {},
            split=split,
            made_by=made_by,
        )
    )


# --- One model --------------------------------------------------------------------------------------------------------

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
    """Rollouts over each run of the model and of wheel odometry, or of the model's kinematics where there is none."""
    model = load_model(path)

    def wheels(run: Run) -> Rollout:
        return (
            roll_sources(run, card.dt_s) if run.sensors.has_wheels else roll_kinematics(card.kinematics, run, card.dt_s)
        )

    return [(roll_model(model, run, card.dt_s), wheels(run)) for run in runs]


def cross_rollouts(
    config: TrainConfig, split: Split, runs: dict[str, Run], path: Path, made_by: str, checkpoints: Checkpoints
) -> list[tuple[Rollout, Rollout]]:
    """Rollouts over each training recording by a model that left it out; these models are not kept."""
    found, scratch = [], path.with_name(path.name + ".fold")
    for name in split.train:
        fold = split.model_copy(update={"train": tuple(n for n in split.train if n != name)})
        _, card, _ = train_uncalibrated(config, fold, runs, scratch, made_by, checkpoints)
        found += held_out_rollouts(scratch, card, [runs[name]])
        scratch.unlink()
    return found


def calibrate(card: ModelCard, held_out: list[tuple[Rollout, Rollout]], config: CalibrationConfig) -> ModelCard:
    """Calibrate the card's covariances on these rollouts, and their correlation with the wheels' stand-in."""
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
    """Splits, one per recording left out: it tests, the next one validates, the rest train."""
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
    """Train a model on every recording, calibrated and judged by the models that left one out."""
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


# --- All models of a configuration ------------------------------------------------------------------------------------

CHECKPOINTS = ".checkpoints"
Tell = Callable[[str], None]


def train_models(config_file: Path, data: Path, out: Path, start: Path | None, say: Tell, warn: Tell) -> list[Path]:
    """Train what a configuration asks for. Interrupted and run again it goes on, and ends at the same files.

    Args:
        config_file: see `fgloc_training.config.TrainConfig`.
        data: folder that the recordings' paths are relative to.
        out: folder of the models; it appears whole.
        start: a model to adapt, instead of training one.
        say: given a sentence on each finished model.
        warn: given sentences on what looks wrong.

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
    refuse_repeats([data / bag for bag in config.recordings.values()], [*config.recordings])
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
            say(_figures(path, adapt(start, config, runs, path, f"{made_by}; from {start.name}"), runs))
        else:
            _train_all(config, runs, stage, made_by, Checkpoints(out / CHECKPOINTS), say, warn)
        names = sorted(path.name for path in stage.glob("*.safetensors"))
    return [out / name for name in names]


def _train_all(
    config: TrainConfig, runs: dict[str, Run], out: Path, made_by: str, checkpoints: Checkpoints, say: Tell, warn: Tell
) -> None:
    """Train the model of the configuration's split, or one for each recording left out, and one of all."""
    splits = leave_one_out(list(runs)) if config.split is None else [config.split]
    for split in splits:
        _check_samples(config, split, runs)
    trained = list(runs) if config.split is None else config.split.train
    found = controls([runs[name] for name in trained], config.limits)
    draw_controls(out / "controls.png", found)
    for missing in found.missing():
        warn(f"the recordings hold too little of {missing}")
    if config.split is not None:
        path = out / "model.safetensors"
        card = train(config, config.split, runs, path, made_by, checkpoints, warn)
        say(_figures(path, card, runs))
        return
    folds = []
    for split in splits:
        path = out / f"without_{split.test[0]}.safetensors"
        folds.append(train(config, split, runs, path, made_by, checkpoints, warn))
        say(_figures(path, folds[-1], runs))
    path = out / "all.safetensors"
    say(_figures(path, train_on_all(config, runs, folds, path, made_by, checkpoints), {}))


def _check_samples(config: TrainConfig, split: Split, runs: dict[str, Run]) -> None:
    """Raise the `RecordingError` of `need_windows` before hours of training, not after."""
    plan = config.optimization
    if config.network.kind in ("naive", "lag"):  # fitted whole
        train_s, validate_s = config.network.dt_s, min(config.calibration.horizons_s)
    else:
        train_s = max(plan.horizon_s, plan.variance_horizon_s)
        validate_s = max(min(plan.validation_s), plan.variance_horizon_s)
    need_windows([runs[name] for name in split.train], train_s, "train on")
    need_windows([runs[name] for name in split.validation], validate_s, "validate on")


def _in_parts(split: Split, parts: dict[str, dict[str, Run]]) -> Split:
    """Split of the runs that the recordings of a split consist of."""

    def names(recordings: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(name for recording in recordings for name in parts[recording])

    return Split(train=names(split.train), validation=names(split.validation), test=names(split.test))


def _figures(path: Path, card: ModelCard, runs: Mapping[str, Run]) -> str:
    """Figures of a model, and what it is worth in the recordings that test it, or else validated it."""
    figures = ", ".join(f"{k} {v:g}" for k, v in card.figures.items() if k.startswith(("drift", "nis")))
    tested = [runs[name] for name in card.split.test or card.split.validation if name in runs]
    told = ""
    with suppress(FglocError):  # it is a remark: the model is made
        told = told_worth(worth(load_model(path), tested)) if tested else ""
    return f"{path.stem}: {figures}" + (f"\n{path.stem}: {told}" if told else "")
