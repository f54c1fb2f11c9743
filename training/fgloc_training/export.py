"""From torch to the file that fgloc reads."""

from __future__ import annotations

import numpy as np

from fgloc.sensors.learned.card import ModelCard, Split
from fgloc.sensors.learned.sensor import Tensors
from fgloc_training.config import TrainConfig
from fgloc_training.models import DisplacementNet, MotionNet, VelocityNet
from fgloc_training.recurrent import Trunk

_WARM_UP_S = 2.0  # a velocity model that is given no velocity starts from rest this long ago


def tensors_of(nets: list[MotionNet]) -> Tensors:
    """Weights by the names that `fgloc.sensors.learned.load_model` expects; those of several networks stacked."""
    out: Tensors = {}
    for i, members in enumerate(zip(*(net.layers() for net in nets), strict=True)):
        for name, tensors in zip(("weight", "bias"), zip(*members, strict=True), strict=True):
            arrays = [np.ascontiguousarray(tensor.detach().numpy()) for tensor in tensors]
            out[f"layer{i}.{name}"] = np.stack(arrays) if len(arrays) > 1 else arrays[0]
    if isinstance(nets[0], DisplacementNet) and isinstance(nets[0].trunk, Trunk):
        out |= {name: tensor.detach().numpy() for name, tensor in nets[0].trunk.weights().items()}
    return out


def _widths(net: MotionNet) -> tuple[int, ...]:
    """Of the hidden layers as `tensors_of` stacks them."""
    kind, hidden = net.config.kind, net.config.hidden
    if kind in ("naive", "lag", "arx"):
        return ()
    return tuple(h + net.config.variance_units for h in hidden) if kind == "displacement" else hidden


def card_of(net: MotionNet, config: TrainConfig, split: Split, made_by: str) -> ModelCard:
    """The card of a network that is trained and not yet calibrated."""
    network = config.network
    displacement = isinstance(net, DisplacementNet)
    velocity = isinstance(net, VelocityNet)
    return ModelCard.model_validate(
        dict(
            kind=network.kind,
            robot=config.robot,
            inputs=network.inputs if displacement else ("commands", "velocity") if velocity else ("commands",),
            dt_s=network.dt_s,
            hidden=_widths(net),
            members=network.members,
            hold_s=network.hold_s,
            history_s=max(network.edges_s[-1], net.kinematics.delay_s) if displacement else _WARM_UP_S,
            kinematics=net.kinematics,
            lag=None if displacement else net.lag,
            edges_s=network.edges_s if displacement else (),
            joints=net.joints if displacement and {"effort", "wheels"} & set(network.inputs) else None,
            signal_edges_s=network.signal_edges_s,
            wheel_kinematics=net.wheel_kinematics if displacement else {},
            velocity_decay_s=network.velocity_decay_s,
            input_mean=net.mean.tolist(),
            input_std=net.std.tolist(),
            output_scale=net.scale.tolist(),
            noise=None if displacement else {},
            split=split,
            made_by=made_by,
        )
    )
