"""Whether the covariance is right: NEES, coverage, and the bounds that χ² sets for their averages.

Source: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4.
"""

from __future__ import annotations

import numpy as np

from fgloc.errors import CovarianceError
from fgloc.stats import chi2_bound
from fgloc.types import FloatArray


def nees(errors: FloatArray, covs: FloatArray) -> FloatArray:
    """Normalized estimation error squared ``(n,)``, ``eᵀ P⁻¹ e``; its mean is d for an honest covariance.

    Args:
        errors: ``(n, d)``.
        covs: ``(n, d, d)`` in the errors' frame.

    Raises:
        CovarianceError: a covariance is not positive definite.
    """
    try:
        whitening = np.linalg.cholesky(covs)
    except np.linalg.LinAlgError as error:
        bad = int(np.argmin(np.linalg.eigvalsh(covs)[:, 0]))
        raise CovarianceError(
            f"covariance {bad} is not positive definite: {covs[bad].tolist()}; it cannot weigh an error"
        ) from error
    whitened = np.linalg.solve(whitening, errors[..., None])[..., 0]
    return np.asarray(np.sum(whitened**2, axis=1))


def coverage(errors: FloatArray, covs: FloatArray, k: float) -> float:
    """Share of error components, over all times and axes, that lie inside ±k of their own standard deviation.

    An honest Gaussian covariance gives 0.683, 0.954, 0.997 for k = 1, 2, 3, whatever the correlation of the axes.
    """
    sigmas = np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
    return float(np.mean(np.abs(errors) <= k * sigmas))


def mean_bounds(dof: int, samples: int, probability: float = 0.95) -> tuple[float, float]:
    """Interval that holds the mean of `samples` independent χ² variables of `dof` with the given probability.

    For the mean NEES or NIS over independent runs or seeds; successive poses of one run are not independent.
    """
    tail = 0.5 * (1.0 - probability)
    low, high = (chi2_bound(p, dof * samples) / samples for p in (tail, 1.0 - tail))
    return low, high
