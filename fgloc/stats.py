"""Quantiles that decide: one place for what "unlikely" means."""

from __future__ import annotations

from functools import lru_cache

from scipy.special import gammaincinv  # scipy.stats takes half a second to load


@lru_cache(maxsize=256)
def chi2_bound(probability: float, dof: int) -> float:
    """χ² quantile: a sum of ``dof`` squared standard normal variables exceeds it with one minus this probability."""
    return float(2.0 * gammaincinv(0.5 * dof, probability))
