"""A gated recurrent unit before a multilayer perceptron, in numpy: commands as a sequence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fgloc.sensors.learned.network import Float32Array, Network


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """Weights of the unit, torch's layout: rows of the reset gate, the update gate, then the candidate."""

    weight_ih: Float32Array  # (3 h, 2)
    weight_hh: Float32Array  # (3 h, h)
    bias_ih: Float32Array  # (3 h,)
    bias_hh: Float32Array  # (3 h,)


class RecurrentNetwork:
    """The commands of the age bins, oldest first, through the cell; its last state and the other inputs to the layers.

    Source: Cho et al. 2014, in the form of torch.nn.GRU.
    """

    def __init__(
        self, cell: Cell, head: Network, n_bins: int, mean: NDArray[np.float64], std: NDArray[np.float64]
    ) -> None:
        """Take the parts.

        Args:
            cell: reads two numbers at a time.
            head: of the last state and the normalized other inputs.
            n_bins: age bins of two commands each, with which the inputs begin, youngest first.
            mean: ``(in,)`` of the inputs.
            std: ``(in,)`` of the inputs.
        """
        self._cell, self._head, self._n_bins = cell, head, n_bins
        self._mean, self._std = mean.astype(np.float32), std.astype(np.float32)

    def __call__(self, x: Float32Array) -> Float32Array:
        """Outputs ``(rows, out)`` of inputs ``(rows, in)``, perhaps not finite; the next call overwrites them."""
        c, width = self._cell, len(self._cell.bias_ih) // 3
        normal = (x - self._mean) / self._std
        state = np.zeros((len(x), width), dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self._n_bins - 1, -1, -1):
                read = normal[:, 2 * k : 2 * k + 2] @ c.weight_ih.T + c.bias_ih
                kept = state @ c.weight_hh.T + c.bias_hh
                gates = _sigmoid(read[:, : 2 * width] + kept[:, : 2 * width])
                reset, update = gates[:, :width], gates[:, width:]
                candidate = np.tanh(read[:, 2 * width :] + reset * kept[:, 2 * width :])
                state = candidate + update * (state - candidate)
        return self._head(np.concatenate([state, normal[:, 2 * self._n_bins :]], axis=1))


def _sigmoid(x: Float32Array) -> Float32Array:
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x)), dtype=np.float32)
