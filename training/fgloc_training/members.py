"""One network of a model: made on top of what is known of the robot, and trained in two stages."""

from __future__ import annotations

import torch

from fgloc.errors import RecordingError
from fgloc.sensors.base import Signal
from fgloc.sensors.learned.card import Kinematics, Split
from fgloc_training.calibrate import fit_kinematics, fit_lag
from fgloc_training.checkpoint import Checkpoints, Curve
from fgloc_training.config import NetworkConfig, TrainConfig
from fgloc_training.data import Run
from fgloc_training.models import DisplacementNet, MotionNet, NaiveNet, VelocityNet
from fgloc_training.optimize import train_mean, train_variance

_SEEDS_APART = 1_000  # between the members of an ensemble


def train_member(
    config: TrainConfig, split: Split, runs: dict[str, Run], member: int, checkpoints: Checkpoints
) -> tuple[MotionNet, dict[str, Curve]]:
    """One network and how its stages went; the members of an ensemble differ by their seed."""
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
    kinematics = fit_kinematics(training)
    if config.kind in ("displacement", "gru"):
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
