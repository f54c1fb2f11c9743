"""Linear factors as GTSAM takes them, and the keys of the installation in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gtsam

from fgloc.graph.ground import ground_key
from fgloc.types import FloatArray

INSTALLATION = int(gtsam.symbol("i", 0))
"""Key of the installation state: one vector."""


def insert_installation(k: int, theta: FloatArray, constants: int, values: gtsam.Values) -> None:
    """Where a factor of keyframe k is linear: the installation ``(n,)``, the last rows of which may be its own."""
    if constants:
        values.insert(INSTALLATION, theta[:constants])
    if len(theta) > constants:
        values.insert(ground_key(k), theta[constants:])


def installation_blocks(k: int, H: FloatArray, constants: int) -> dict[int, FloatArray]:
    """Derivatives ``(d, n)`` by the installation, by key; the last of them may be keyframe k's own."""
    blocks = {INSTALLATION: H[:, :constants]} if constants else {}
    return blocks if H.shape[1] == constants else {**blocks, ground_key(k): H[:, constants:]}


def linear_factor(
    blocks: Mapping[int, FloatArray], residual: FloatArray, values: gtsam.Values
) -> gtsam.NonlinearFactor:
    """A factor of whitened residual ``(d,)``, linear about these values; up to three keys with their Jacobians."""
    pairs: list[Any] = [part for key, A in blocks.items() for part in (key, A)]
    noise = gtsam.noiseModel.Unit.Create(len(residual))
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(*pairs, -residual, noise), values)  # type: ignore[call-overload]
