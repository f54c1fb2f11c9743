"""Planar motions as tensors."""

from __future__ import annotations

import torch
from torch import Tensor


def integrate(twists: Tensor) -> Tensor:
    """Compose exponentials of twists ``(b, n, 3)`` into poses ``(b, n, 3)``; the yaw is not wrapped."""
    yaw = torch.cumsum(twists[..., 2], dim=-1)
    middle = yaw - 0.5 * twists[..., 2]
    chord = torch.sinc(twists[..., 2] / (2 * torch.pi))  # sin(θ/2) / (θ/2): arc to chord
    c, s = torch.cos(middle) * chord, torch.sin(middle) * chord
    x = torch.cumsum(c * twists[..., 0] - s * twists[..., 1], dim=-1)
    y = torch.cumsum(s * twists[..., 0] + c * twists[..., 1], dim=-1)
    return torch.stack([x, y, yaw], dim=-1)


def relative(a: Tensor, b: Tensor) -> Tensor:
    """``T_a⁻¹ ∘ T_b`` of poses ``(..., 3)``; the yaw is not wrapped."""
    c, s = torch.cos(a[..., 2]), torch.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return torch.stack([c * dx + s * dy, c * dy - s * dx, b[..., 2] - a[..., 2]], dim=-1)
