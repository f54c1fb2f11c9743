"""Small motion models for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from fgloc.sensors.learned.card import CHANNELS, FAMILIES, ModelCard
from fgloc.sensors.learned.sensor import Tensors

_EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def make_card(kind: str, **changes: Any) -> ModelCard:
    """A valid card; ``changes`` override its fields."""
    family = FAMILIES.get(kind)  # type: ignore[call-overload]
    displacement, bare = family == "displacement", kind in ("naive", "lag")
    inputs = changes.get("inputs", ("commands", "velocity") if family == "velocity" else ("commands",))
    widths = {"velocity": 2, "sideways": 8, **{name: channel.width for name, channel in CHANNELS.items()}}
    n = 0 if bare else 16 + sum(widths.get(name, 0) for name in inputs) if displacement else 5
    scale = (0.05, 0.01, 0.2) if displacement else () if bare else (0.5, 1.0)
    fields: dict[str, Any] = dict(
        kind=kind,
        robot="test robot",
        inputs=inputs,
        dt_s=0.1,
        hidden=() if kind in ("naive", "lag", "arx") else (16, 16),
        hold_s=1.5,
        history_s=2.0,
        kinematics=dict() if kind == "naive" else dict(scale_v=0.95, scale_omega=0.9, delay_s=0.1),
        joints=dict(left_radius=0.05, right_radius=0.05, track=0.26),
        lag=dict(delay_s=0.05, lag_s=(0.2, 0.3)) if kind in ("lag", "arx", "velocity") else None,
        edges_s=tuple(0.1 * i for i in range(9)) if displacement else (),
        input_mean=(0.1,) * n,
        input_std=(0.5,) * n,
        output_scale=scale,
        noise=None if displacement else {},
        joint=dict(window_s=5.0, W=_EYE, N=_EYE, C=((0.4, 0, 0), (0, 0.5, 0), (0, 0, 0.7))),
        split=dict(train=("a",), validation=("b",)),
    )
    return ModelCard.model_validate(fields | changes)


def make_tensors(card: ModelCard, rng: np.random.Generator) -> Tensors:
    """Random weights of the right shapes; those of a velocity model pull towards the commands, so that it is stable."""
    out: Tensors = {}
    if card.n_outputs == 0:
        return out
    widths = [card.n_inputs, *card.hidden, card.n_outputs]
    if card.kind == "gru":
        h = card.hidden[0]
        shapes = {"weight_ih": (3 * h, 2), "weight_hh": (3 * h, h), "bias_ih": (3 * h,), "bias_hh": (3 * h,)}
        out |= {f"gru.{name}": (0.5 * rng.normal(size=shape)).astype(np.float32) for name, shape in shapes.items()}
        widths = [h + card.n_inputs - 16, *card.hidden[1:], card.n_outputs]
    for i in range(len(widths) - 1):
        shape = (widths[i + 1], widths[i])
        out[f"layer{i}.weight"] = (rng.normal(size=shape) / np.sqrt(widths[i])).astype(np.float32)
        out[f"layer{i}.bias"] = (0.1 * rng.normal(size=shape[0])).astype(np.float32)
    last = len(widths) - 2
    if card.family == "displacement":
        out[f"layer{last}.weight"][3:] *= 0.1
        out[f"layer{last}.bias"][3:] = -9.0
    else:
        out[f"layer{last}.weight"] *= 0.2
    if card.kind == "rate":  # what holds it back is the network's part
        out[f"layer{last}.weight"] *= 0.1
    return out
