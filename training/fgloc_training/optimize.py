"""Gradient descent of a training, continued from checkpoints: first the mean, then the variance."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fgloc.errors import FglocError, ModelError
from fgloc.files.atomic import atomic_file
from fgloc.instrumentation import end, tell
from fgloc.sensors.learned.card import Split
from fgloc_training.config import OptimizationConfig, TrainConfig
from fgloc_training.data import Run
from fgloc_training.models import DisplacementNet, MotionNet, Samples, relative

# --- Checkpoints ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Curve:
    """Course of one stage of training: losses of the batches, and scores on the validation recordings."""

    losses: list[float] = field(default_factory=list)
    scores: list[tuple[int, float]] = field(default_factory=list)  # after this many iterations


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Checkpoint file of one stage of one network; without a path nothing is saved."""

    path: Path | None = None

    def save(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint, atomically."""
        if self.path is None:
            return
        with atomic_file(self.path, binary=True) as file:
            torch.save(state, file)

    def load(self) -> dict[str, Any] | None:
        """Last saved checkpoint; None if there is none.

        Raises:
            ModelError: the file is damaged.
        """
        if self.path is None or not self.path.exists():
            return None
        try:
            state: dict[str, Any] = torch.load(self.path, weights_only=True)
        except Exception as error:
            raise ModelError(f"{self.path}: not a sound checkpoint ({error}); delete it to begin anew") from error
        return state


@dataclass(frozen=True, slots=True)
class Checkpoints:
    """Checkpoints of one model; each configuration, split and set of recordings has files of its own."""

    folder: Path | None = None

    def of(self, config: TrainConfig, split: Split, runs: dict[str, Run], member: int, stage: str) -> Checkpoint:
        """Checkpoint of a stage."""
        if self.folder is None:
            return Checkpoint()
        digest = hashlib.sha256((config.model_dump_json() + split.model_dump_json()).encode())
        for name in (*split.train, *split.validation):
            digest.update(name.encode())
            digest.update(runs[name].poses.tobytes())
            digest.update(runs[name].valid.tobytes())
        return Checkpoint(self.folder / f"{digest.hexdigest()[:16]}.{member}.{stage}.pt")


# --- Losses -----------------------------------------------------------------------------------------------------------


def rollout_loss(predicted: Tensor, truth: Tensor, dt_s: float, config: OptimizationConfig) -> Tensor:
    """Distance of trajectories in units of the configured sigmas, averaged; later poses weigh less, as 1/√t.

    The root makes it robust: a window that nothing explains pulls with constant force.

    Args:
        predicted: ``(b, n, 3)`` seen from the start.
        truth: ``(b, n + 1, 3)`` float64 in the map frame, from the start on.
        dt_s: time step.
        config: sigmas.

    Source: paper section 3, the trajectory "repeats the real trajectory as closely as possible"; eq. 11 and 12.
    """
    error = predicted - relative(truth[:, :1], truth[:, 1:]).float()
    position = error[..., :2].square().sum(dim=-1) / config.position_sigma_m**2
    yaw = error[..., 2].square() / config.yaw_sigma_rad**2
    times = torch.arange(1, predicted.shape[1] + 1) * dt_s
    return (torch.sqrt(position + yaw + 1e-4) / torch.sqrt(times)).mean()


def composed_nll(error: Tensor, adjoints: Tensor, log_density: Tensor, dt_s: float, beta: float = 0.0) -> Tensor:
    """Negative log-likelihood of the errors at the ends of windows, their covariance composed from each step's.

    Args:
        error: ``(b, 3)`` right perturbation of the predicted end pose.
        adjoints: ``(b, n, 3, 3)`` that carry each step's perturbation to the end.
        log_density: ``(b, n, 3)`` log-variances per second.
        dt_s: time step.
        beta: each window weighs as its variance to this power: 0 is the likelihood, towards 1 windows that are known
            well count no more than the others.

    Source: Seitzer et al., "On the pitfalls of heteroscedastic uncertainty estimation with probabilistic neural
    networks", ICLR 2022, eq. 5 (β-NLL).
    """
    variances = torch.exp(log_density) * dt_s
    cov = torch.einsum("bnij,bnj,bnkj->bik", adjoints, variances, adjoints)
    root = torch.linalg.cholesky(cov)
    white = torch.linalg.solve_triangular(root, error[..., None], upper=False)[..., 0]
    log_root = torch.log(torch.diagonal(root, dim1=-2, dim2=-1)).sum(dim=-1)
    losses = 0.5 * white.square().sum(dim=-1) + log_root
    if beta == 0.0:
        return losses.mean()
    weights = torch.softmax(beta * 2.0 / error.shape[-1] * log_root.detach(), dim=0)
    return (weights * losses).sum()


def end_errors(poses: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Errors at the ends and the adjoints that carry earlier perturbations there, for `composed_nll`.

    Args:
        poses: ``(b, n, 3)`` predicted, seen from the start.
        truth: ``(b, n + 1, 3)`` float64.
    """
    end = poses[:, -1:]
    difference = relative(end[:, 0], relative(truth[:, 0], truth[:, -1]).float())
    half = 0.5 * difference[..., 2]
    a = torch.where(half.abs() < 1e-4, 1.0 - half.square() / 3.0, half / torch.tan(half))
    x, y = difference[..., 0], difference[..., 1]
    error = torch.stack([a * x + half * y, a * y - half * x, difference[..., 2]], dim=-1)
    back = relative(end, poses)  # each pose seen from the end: (T_pose⁻¹ T_end)⁻¹
    c, s = torch.cos(back[..., 2]), torch.sin(back[..., 2])
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    rows = [c, -s, back[..., 1], s, c, -back[..., 0], zero, zero, one]
    return error, torch.stack(rows, dim=-1).reshape(*c.shape, 3, 3)


# --- Descent ----------------------------------------------------------------------------------------------------------

_MOST_GRADIENT = 5.0  # norm above which the gradient is clipped


@dataclass(frozen=True, slots=True)
class Plan:
    """Settings of a descent."""

    name: str
    iterations: int
    learning_rate: float
    validate_every: int
    patience: int | None  # validations without improvement after which to stop
    anneal: bool  # lower the rate to nothing, as a cosine


def descend(
    plan: Plan,
    module: nn.Module,
    loss_of_batch: Callable[[torch.Generator], Tensor],
    score: Callable[[], float] | None,
    seed: int,
    checkpoint: Checkpoint,
) -> Curve:
    """Adam on a module's parameters. Keeps the state with the least score, or the last if nothing is scored.

    Interrupted and begun again with the same arguments it gives the same weights, bit for bit.
    """
    descent = _Descent(plan, module, seed)
    first = descent.resume(checkpoint.load())
    detail = ""
    for i in range(first, plan.iterations + 1):
        descent.step(loss_of_batch)
        tell(plan.name, i, plan.iterations, "iterations", detail)
        if i % plan.validate_every and i < plan.iterations:
            continue
        if score is not None:
            descent.judge(i, score())
            detail = f"validation {descent.curve.scores[-1][1]:.4g}"
        checkpoint.save(descent.state(plan.iterations if descent.is_tired else i))
        if descent.is_tired:
            break
    end(plan.name)
    if score is not None:
        module.load_state_dict(descent.best_state)
    return descent.curve


class _Descent:
    """State of a descent: module, optimizer, schedule, and the best weights so far.

    Attributes:
        curve: losses and scores so far.
        best_state: the module's at the least score.
    """

    def __init__(self, plan: Plan, module: nn.Module, seed: int) -> None:
        self._plan, self._module = plan, module
        self._rng = torch.Generator().manual_seed(seed)
        self._optimizer = torch.optim.Adam(module.parameters(), lr=plan.learning_rate)
        cosine = torch.optim.lr_scheduler.CosineAnnealingLR
        self._schedule = cosine(self._optimizer, plan.iterations) if plan.anneal else None
        self._best, self._waited = float(np.inf), 0
        self.best_state = copy.deepcopy(module.state_dict())
        self.curve = Curve()

    def resume(self, kept: dict[str, Any] | None) -> int:
        """Restore a saved descent, and return its next iteration."""
        if kept is None:
            return 1
        self._module.load_state_dict(kept["module"])
        self._optimizer.load_state_dict(kept["optimizer"])
        if self._schedule is not None:
            self._schedule.load_state_dict(kept["schedule"])
        self._rng.set_state(kept["rng"])
        self._best, self.best_state, self._waited = kept["best"], kept["best_state"], kept["waited"]
        self.curve = Curve(kept["losses"], [(int(i), float(s)) for i, s in kept["scores"]])
        return int(kept["iteration"]) + 1

    def step(self, loss_of_batch: Callable[[torch.Generator], Tensor]) -> None:
        """Make one iteration."""
        loss = loss_of_batch(self._rng)
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._module.parameters(), _MOST_GRADIENT)
        self._optimizer.step()
        if self._schedule is not None:
            self._schedule.step()
        self.curve.losses.append(float(loss.detach()))

    def judge(self, iteration: int, score: float) -> None:
        """Add a score; the least one so far marks the best state."""
        self.curve.scores.append((iteration, score))
        self._waited += 1
        if score < self._best:
            self._best, self.best_state, self._waited = score, copy.deepcopy(self._module.state_dict()), 0

    @property
    def is_tired(self) -> bool:
        """Whether the scores have not improved for long."""
        return self._plan.patience is not None and self._waited >= self._plan.patience

    def state(self, iteration: int) -> dict[str, Any]:
        """State of the descent, which `resume` restores."""
        return {
            "iteration": iteration,
            "module": self._module.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "schedule": {} if self._schedule is None else self._schedule.state_dict(),
            "rng": self._rng.get_state(),
            "best": self._best,
            "best_state": self.best_state,
            "waited": self._waited,
            "losses": self.curve.losses,
            "scores": self.curve.scores,
        }


# --- Mean and variance ------------------------------------------------------------------------------------------------

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
