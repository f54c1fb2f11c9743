"""Small motion models for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from fgloc.motion import ModelCard
from fgloc.motion.load import Tensors

_EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def make_card(kind: str, **changes: Any) -> ModelCard:
    """A valid card; ``changes`` override its fields."""
    inputs = changes.get("inputs", ("commands", "velocity") if kind == "velocity" else ("commands",))
    edges = () if kind == "velocity" else tuple(0.1 * i for i in range(9))
    widths = {"velocity": 2, "gyro": 1, "effort": 2, "wheels": 2}
    n = 5 if kind == "velocity" else 16 + sum(widths.get(name, 0) for name in inputs)
    fields: dict[str, Any] = dict(
        kind=kind,
        robot="test robot",
        inputs=inputs,
        dt_s=0.1,
        hidden=(16, 16),
        hold_s=1.5,
        history_s=2.0,
        kinematics=dict(scale_v=0.95, scale_omega=0.9, delay_s=0.1),
        joints=dict(left_radius=0.05, right_radius=0.05, track=0.26),
        lag=dict(delay_s=0.05, lag_s=(0.2, 0.3)) if kind == "velocity" else None,
        edges_s=edges,
        input_mean=(0.1,) * n,
        input_std=(0.5,) * n,
        output_scale=(0.5, 1.0) if kind == "velocity" else (0.05, 0.01, 0.2),
        noise={} if kind == "velocity" else None,
        joint=dict(window_s=5.0, W=_EYE, N=_EYE, C=((0.4, 0, 0), (0, 0.5, 0), (0, 0, 0.7))),
        split=dict(train=("a",), validation=("b",)),
    )
    return ModelCard.model_validate(fields | changes)


def make_tensors(card: ModelCard, rng: np.random.Generator) -> Tensors:
    """Random weights of the right shapes; those of a velocity model pull towards the commands, so that it is stable."""
    widths = [card.n_inputs, *card.hidden, card.n_outputs]
    out: Tensors = {}
    for i in range(len(widths) - 1):
        shape = (widths[i + 1], widths[i])
        out[f"layer{i}.weight"] = (rng.normal(size=shape) / np.sqrt(widths[i])).astype(np.float32)
        out[f"layer{i}.bias"] = (0.1 * rng.normal(size=shape[0])).astype(np.float32)
    last = len(widths) - 2
    if card.kind == "displacement":
        out[f"layer{last}.weight"][3:] *= 0.1
        out[f"layer{last}.bias"][3:] = -9.0
    else:
        out[f"layer{last}.weight"] *= 0.2
    return out
