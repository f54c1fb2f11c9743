"""The network that predicts how uncertain motion is: what makes motion uncertain is not what makes it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_START_SIGMAS = (1e-2, 1e-2, 3e-2)  # m, m, rad per √s


def variance_net(net: nn.Sequential, mean: Tensor, std: Tensor, neighbors: list[tuple[int, int]]) -> nn.Sequential:
    """The network, its first units started as the sizes of changes from age to age, then of the inputs themselves.

    Robots pick up changed commands at instants that nobody knows; steady ones they follow.

    Args:
        net: linear layers with ReLU between them, inputs to three log-variances per second.
        mean: ``(n,)`` with which the inputs are normalized.
        std: ``(n,)`` likewise.
        neighbors: columns of the same input at neighboring ages, the younger first.
    """
    first = net[0]
    rows: list[Tensor] = []
    offsets: list[float] = []
    for younger, older in [*neighbors, *((i, None) for i in range(len(mean)))]:
        row, offset = torch.zeros(len(mean)), float(mean[younger] / std[younger])
        row[younger] = 1.0
        if older is not None:
            row[older] = -float(std[older] / std[younger])
            offset -= float(mean[older] / std[younger])
        rows += [row, -row]
        offsets += [offset, -offset]
    n = min(first.out_features, len(rows))
    with torch.no_grad():
        first.weight[:n] = torch.stack(rows[:n])
        first.bias[:n] = torch.tensor(offsets[:n])
    start(net[-1])
    return net


def start(head: nn.Linear) -> nn.Linear:
    """The last layer, started from the same variance everywhere."""
    with torch.no_grad():
        head.weight.zero_()
        head.bias.copy_(torch.log(torch.tensor(_START_SIGMAS) ** 2))
    return head
