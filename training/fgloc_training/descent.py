"""A gradient descent that can be interrupted and gone on with, and keeps the best state that it has passed."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fgloc.instrumentation import end, tell
from fgloc_training.checkpoint import Checkpoint, Curve

_MOST_GRADIENT = 5.0  # norm above which the gradient is clipped


@dataclass(frozen=True, slots=True)
class Plan:
    """How long a descent goes on and how often it is judged."""

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
    """Everything that changes while it goes on.

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
        """Go on where an earlier descent was stopped; the next iteration."""
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
        """One iteration."""
        loss = loss_of_batch(self._rng)
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._module.parameters(), _MOST_GRADIENT)
        self._optimizer.step()
        if self._schedule is not None:
            self._schedule.step()
        self.curve.losses.append(float(loss.detach()))

    def judge(self, iteration: int, score: float) -> None:
        """Note a score; the least one so far marks the best state."""
        self.curve.scores.append((iteration, score))
        self._waited += 1
        if score < self._best:
            self._best, self.best_state, self._waited = score, copy.deepcopy(self._module.state_dict()), 0

    @property
    def is_tired(self) -> bool:
        """Whether the scores have not improved for long."""
        return self._plan.patience is not None and self._waited >= self._plan.patience

    def state(self, iteration: int) -> dict[str, Any]:
        """What `resume` goes on from."""
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
