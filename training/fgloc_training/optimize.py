"""The two descents of a training: the mean on rolled-out trajectories, then the variance on their likelihood."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from fgloc.errors import FglocError
from fgloc_training.checkpoint import Checkpoint, Curve
from fgloc_training.config import OptimizationConfig
from fgloc_training.data import Run
from fgloc_training.descent import Plan, descend
from fgloc_training.losses import composed_nll, end_errors, rollout_loss
from fgloc_training.models import DisplacementNet, MotionNet, Samples
from fgloc_training.planar import relative

_VARIANCE_EVERY = 25  # iterations between validations of the variance


def train_mean(
    net: MotionNet,
    training: list[Run],
    validation: list[Run],
    config: OptimizationConfig,
    checkpoint: Checkpoint | None = None,
) -> Curve:
    """Adam on the multi-step loss; keeps the weights that were best on the validation recordings."""
    samples = net.samples(training)
    steps = round(config.horizon_s / samples.dt_s)
    starts = window_starts(training, steps)
    held_out = net.samples(validation) if validation else None

    def loss_of_batch(rng: torch.Generator) -> Tensor:
        chosen = starts[torch.randint(len(starts), (config.batch,), generator=rng)]
        truth = samples.poses[chosen[:, None] + torch.arange(steps + 1)]
        return rollout_loss(net.roll(samples, chosen, steps, rng), truth, samples.dt_s, config)

    score = None if held_out is None else lambda: validate(net, held_out, validation, config.validation_s)
    plan = Plan("mean", config.iterations, config.learning_rate, config.validate_every, config.patience, anneal=True)
    return descend(plan, net, loss_of_batch, score, config.seed, checkpoint or Checkpoint())


def validate(net: MotionNet, samples: Samples, runs: list[Run], horizons_s: tuple[float, ...]) -> float:
    """Drift [%] of free rollouts, averaged over the horizons that the runs allow."""
    drifts = []
    for horizon in horizons_s:
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
        raise FglocError(f"the validation recordings hold no {min(horizons_s):g} s of unbroken truth; give longer ones")
    return float(np.mean(drifts))


def train_variance(
    net: DisplacementNet,
    training: list[Run],
    validation: list[Run],
    config: OptimizationConfig,
    checkpoint: Checkpoint | None = None,
) -> Curve:
    """Likelihood of the composed errors over windows and over pieces of them; only the variance learns."""
    samples = net.samples(training)
    piece = max(1, round(config.variance_piece_s / samples.dt_s))
    steps = piece * max(1, round(config.variance_horizon_s / samples.dt_s / piece))
    lengths = sorted({piece, steps})
    starts = window_starts(training, steps)
    held_out = net.samples(validation) if validation else None
    judged = window_starts(validation, steps, stride=round(1.0 / samples.dt_s)) if validation else starts

    def loss_of(on: Samples, chosen: Tensor) -> Tensor:
        with torch.no_grad():
            _, x = net.inputs(on, chosen, steps)
            poses = torch.cat([torch.zeros(len(chosen), 1, 3), net.roll(on, chosen, steps)], dim=1)
            truth = on.poses[chosen[:, None] + torch.arange(steps + 1)]
        log_density = net.log_density(x)
        return sum(_nll_of_pieces(poses, truth, log_density, length, on.dt_s, config.nll_beta) for length in lengths)

    def loss_of_batch(rng: torch.Generator) -> Tensor:
        return loss_of(samples, starts[torch.randint(len(starts), (config.batch,), generator=rng)])

    @torch.no_grad()
    def score() -> float:
        return float(loss_of(samples if held_out is None else held_out, judged))

    plan = Plan("variance", config.variance_iterations, config.learning_rate, _VARIANCE_EVERY, None, anneal=False)
    judge = score if validation else None
    return descend(plan, net.variance, loss_of_batch, judge, config.seed, checkpoint or Checkpoint())


def _nll_of_pieces(poses: Tensor, truth: Tensor, log_density: Tensor, length: int, dt_s: float, beta: float) -> Tensor:
    """`composed_nll` of windows ``(b, n + 1, 3)`` cut into pieces of ``length`` steps."""
    firsts = torch.arange(0, log_density.shape[1], length)
    rows = firsts[:, None] + torch.arange(length + 1)
    predicted, actual = (whole[:, rows].flatten(0, 1) for whole in (poses, truth))
    with torch.no_grad():
        error, adjoints = end_errors(relative(predicted[:, :1], predicted[:, 1:]), actual)
    return composed_nll(error, adjoints, log_density.reshape(-1, length, 3), dt_s, beta)


def window_starts(runs: list[Run], steps: int, stride: int = 1) -> Tensor:
    """Rows of `Samples` from which a window of steps has truth throughout."""
    offsets = np.concatenate([[0], np.cumsum([len(run.poses) for run in runs])])
    parts = [run.starts(steps, stride) + offset for run, offset in zip(runs, offsets, strict=False)]
    return torch.from_numpy(np.concatenate(parts))
