"""Where training stands, on disk, so that a killed run goes on where it was."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from fgloc.errors import ModelError
from fgloc.files.atomic import atomic_file
from fgloc.sensors.learned.card import Split
from fgloc_training.config import TrainConfig
from fgloc_training.data import Run


@dataclass(frozen=True, slots=True)
class Curve:
    """How one stage of training went: losses of the batches, and scores on what validates."""

    losses: list[float] = field(default_factory=list)
    scores: list[tuple[int, float]] = field(default_factory=list)  # after this many iterations


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The file of one stage of one network; without a path nothing is kept."""

    path: Path | None = None

    def save(self, state: dict[str, Any]) -> None:
        """Replace what is kept, atomically."""
        if self.path is None:
            return
        with atomic_file(self.path, binary=True) as file:
            torch.save(state, file)

    def load(self) -> dict[str, Any] | None:
        """What was kept last; None if there is nothing.

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
    """All stages of one model. Another configuration, split or recording has other files, so none is mistaken."""

    folder: Path | None = None

    def of(self, config: TrainConfig, split: Split, runs: dict[str, Run], member: int, stage: str) -> Checkpoint:
        """The stage's place."""
        if self.folder is None:
            return Checkpoint()
        digest = hashlib.sha256((config.model_dump_json() + split.model_dump_json()).encode())
        for name in (*split.train, *split.validation):
            digest.update(name.encode())
            digest.update(runs[name].poses.tobytes())
            digest.update(runs[name].valid.tobytes())
        return Checkpoint(self.folder / f"{digest.hexdigest()[:16]}.{member}.{stage}.pt")
