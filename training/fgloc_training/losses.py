"""Losses over rolled-out trajectories."""

from __future__ import annotations

import torch
from torch import Tensor

from fgloc_training.config import OptimizationConfig
from fgloc_training.planar import relative


def rollout_loss(predicted: Tensor, truth: Tensor, dt_s: float, config: OptimizationConfig) -> Tensor:
    """Distance of trajectories in units of the configured sigmas, averaged; later poses weigh less, as 1/√t.

    The root makes it robust: a window that nothing explains pulls with constant force.

    Args:
        predicted: ``(b, n, 3)`` seen from the start.
        truth: ``(b, n + 1, 3)`` float64 in the map frame, from the start on.
        dt_s: time step.
        config: sigmas.

    Source: paper section 3, the trajectory "repeats the real trajectory as closely as possible"; eq. 11 and 12.
    """
    error = predicted - relative(truth[:, :1], truth[:, 1:]).float()
    position = error[..., :2].square().sum(dim=-1) / config.position_sigma_m**2
    yaw = error[..., 2].square() / config.yaw_sigma_rad**2
    times = torch.arange(1, predicted.shape[1] + 1) * dt_s
    return (torch.sqrt(position + yaw + 1e-4) / torch.sqrt(times)).mean()


def composed_nll(error: Tensor, adjoints: Tensor, log_density: Tensor, dt_s: float, beta: float = 0.0) -> Tensor:
    """Negative log-likelihood of the errors at the ends of windows, their covariance composed from each step's.

    Args:
        error: ``(b, 3)`` right perturbation of the predicted end pose.
        adjoints: ``(b, n, 3, 3)`` that carry each step's perturbation to the end.
        log_density: ``(b, n, 3)`` log-variances per second.
        dt_s: time step.
        beta: each window weighs as its variance to this power: 0 is the likelihood, towards 1 windows that are known
            well count no more than the others.

    Source: Seitzer et al., "On the pitfalls of heteroscedastic uncertainty estimation with probabilistic neural
    networks", ICLR 2022, eq. 5 (β-NLL).
    """
    variances = torch.exp(log_density) * dt_s
    cov = torch.einsum("bnij,bnj,bnkj->bik", adjoints, variances, adjoints)
    root = torch.linalg.cholesky(cov)
    white = torch.linalg.solve_triangular(root, error[..., None], upper=False)[..., 0]
    log_root = torch.log(torch.diagonal(root, dim1=-2, dim2=-1)).sum(dim=-1)
    losses = 0.5 * white.square().sum(dim=-1) + log_root
    if beta == 0.0:
        return losses.mean()
    weights = torch.softmax(beta * 2.0 / error.shape[-1] * log_root.detach(), dim=0)
    return (weights * losses).sum()


def end_errors(poses: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Errors at the ends and the adjoints that carry earlier perturbations there, for `composed_nll`.

    Args:
        poses: ``(b, n, 3)`` predicted, seen from the start.
        truth: ``(b, n + 1, 3)`` float64.
    """
    end = poses[:, -1:]
    difference = relative(end[:, 0], relative(truth[:, 0], truth[:, -1]).float())
    half = 0.5 * difference[..., 2]
    a = torch.where(half.abs() < 1e-4, 1.0 - half.square() / 3.0, half / torch.tan(half))
    x, y = difference[..., 0], difference[..., 1]
    error = torch.stack([a * x + half * y, a * y - half * x, difference[..., 2]], dim=-1)
    back = relative(end, poses)  # each pose seen from the end: (T_pose⁻¹ T_end)⁻¹
    c, s = torch.cos(back[..., 2]), torch.sin(back[..., 2])
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    rows = [c, -s, back[..., 1], s, c, -back[..., 0], zero, zero, one]
    return error, torch.stack(rows, dim=-1).reshape(*c.shape, 3, 3)
