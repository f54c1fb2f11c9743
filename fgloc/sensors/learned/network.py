"""A multilayer perceptron in numpy: float32, ReLU, every intermediate result in a buffer made once."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]


class Answering(Protocol):
    """Any network: inputs ``(rows, in)`` to outputs ``(rows, out)``, or ``(members, rows, out)`` of an ensemble."""

    def __call__(self, x: Float32Array) -> Float32Array:
        """Perhaps not finite; the next call overwrites the result."""
        ...


class Network:
    """``y = scale (W_n relu(... relu(W_0 (x - mean) / std + b_0) ...) + b_n) + offset`` for a batch of rows.

    What is not a layer is folded into the first and the last. The members of an ensemble, stacked, answer in one call.
    Not for concurrent use: calls share buffers.
    """

    def __init__(
        self,
        layers: list[tuple[Float32Array, Float32Array]],
        mean: NDArray[np.float64],
        std: NDArray[np.float64],
        scale: NDArray[np.float64] | None = None,
        offset: NDArray[np.float64] | None = None,
    ) -> None:
        """Take the layers.

        Args:
            layers: (weight (out, in), bias (out,)) from input to output, of an ensemble each with a first axis more.
            mean: ``(in,)`` of the inputs.
            std: ``(in,)`` of the inputs.
            scale: ``(out,)`` of the outputs; None: 1.
            offset: ``(out,)`` added to the outputs after that; None: 0.
        """
        weights = [w.astype(np.float64) for w, _ in layers]
        biases = [b.astype(np.float64) for _, b in layers]
        weights[0] /= std
        biases[0] -= weights[0] @ mean
        if scale is not None:
            weights[-1] *= scale[:, None]
            biases[-1] *= scale
        if offset is not None:
            biases[-1] += offset
        with np.errstate(over="ignore"):
            self._weights = [np.ascontiguousarray(w.swapaxes(-1, -2), dtype=np.float32) for w in weights]
            self._biases = [b[..., None, :].astype(np.float32) for b in biases]
        self._buffers: dict[int, list[Float32Array]] = {}

    def __call__(self, x: Float32Array) -> Float32Array:
        """Outputs ``(rows, out)``, or ``(members, rows, out)``, of inputs ``(rows, in)``, perhaps not finite.

        The next call overwrites the result.
        """
        rows = len(x)
        buffers = self._buffers.get(rows)
        if buffers is None:
            buffers = [np.empty((*w.shape[:-2], rows, w.shape[-1]), dtype=np.float32) for w in self._weights]
            self._buffers[rows] = buffers
        last = len(buffers) - 1
        with np.errstate(over="ignore", invalid="ignore"):
            for i, (w, b, y) in enumerate(zip(self._weights, self._biases, buffers, strict=True)):
                np.matmul(x, w, out=y)
                np.add(y, b, out=y)
                if i < last:
                    np.maximum(y, 0.0, out=y)
                x = y
        return x
