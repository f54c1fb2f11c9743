"""The recurrent form of the displacement model's trunk."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn


class Trunk(nn.Module):
    """A GRU over the commands of the age bins, oldest first; layers on its last state and the other inputs.

    Attributes:
        cell: the GRU.
        layers: linear ones with ReLU after each; perhaps none.
        width: of the output.
    """

    def __init__(self, n_bins: int, n_inputs: int, hidden: tuple[int, ...]) -> None:
        """Set up.

        Args:
            n_bins: age bins, of two commands each, with which the inputs begin, youngest first.
            n_inputs: all of them.
            hidden: units of the cell, then of the layers.
        """
        super().__init__()
        self._n_bins = n_bins
        self.cell = nn.GRU(2, hidden[0], batch_first=True)
        widths = [hidden[0] + n_inputs - 2 * n_bins, *hidden[1:]]
        parts: list[nn.Module] = []
        for n_in, n_out in pairwise(widths):
            parts += [nn.Linear(n_in, n_out), nn.ReLU()]
        self.layers = nn.Sequential(*parts)
        self.width = widths[-1]

    def forward(self, x: Tensor) -> Tensor:
        """Hidden values ``(..., width)`` of normalized inputs ``(..., in)``."""
        commands = x[..., : 2 * self._n_bins].reshape(-1, self._n_bins, 2).flip(1)
        _, last = self.cell(commands)
        state = last[0].reshape(*x.shape[:-1], -1)
        return self.layers(torch.cat([state, x[..., 2 * self._n_bins :]], dim=-1))

    def weights(self) -> dict[str, Tensor]:
        """Of the cell, by the names of the model file."""
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        return {f"gru.{name}": getattr(self.cell, f"{name}_l0") for name in names}
