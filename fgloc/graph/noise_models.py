"""Noise models of GTSAM, and square roots of information, from checked covariances."""

from __future__ import annotations

import math

import gtsam
import numpy as np

from fgloc.errors import CovarianceError
from fgloc.types import (
    FloatArray,
)

_SAME_STAMP_S = 0.01  # sightings nearer than this are one


def repetition(correlation_s: float, last_ns: int | None, stamp_ns: int) -> float:
    """Scale on the covariance of a sighting by how soon it follows the last one of its landmark.

    Errors last for a time: what is seen again within it has its information in common with what was seen before.

    Args:
        correlation_s: that time [s].
        last_ns: stamp of the last one; None: there was none.
        stamp_ns: of this one.
    """
    if last_ns is None:
        return 1.0
    return max(1.0, correlation_s / max(abs(stamp_ns - last_ns) * 1e-9, _SAME_STAMP_S))


def gaussian(cov: FloatArray) -> gtsam.noiseModel.Base:
    """Noise model of a covariance, which is checked because GTSAM does not.

    Raises:
        CovarianceError: not finite, not symmetric or not positive definite.
    """
    problem = covariance_problem(cov)
    if problem:
        raise CovarianceError(f"{problem}: {cov.tolist()}; a measurement like this has to be rejected by the gate")
    return gtsam.noiseModel.Gaussian.Covariance(cov)


def robust(noise: gtsam.noiseModel.Base, cauchy_k: float | None) -> gtsam.noiseModel.Base:
    """Wrap a noise model in a Cauchy kernel (k in units of sigma); None leaves it Gaussian."""
    if cauchy_k is None:
        return noise
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(cauchy_k), noise)


def whitening_of(cov: FloatArray) -> FloatArray:
    """W with ``Wᵀ W`` the inverse of a covariance.

    Raises:
        CovarianceError: it is none.
    """
    try:
        if not np.isfinite(cov).all():
            raise np.linalg.LinAlgError("not finite")
        return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))
    except np.linalg.LinAlgError as error:
        raise CovarianceError(f"a covariance of diagonal {np.diag(cov).tolist()} is none: {error}") from error


def sighting_whitening(cov: FloatArray) -> FloatArray:
    """W with ``Wᵀ W`` the inverse of a covariance that is no less than the identity.

    Of a corner hardly in front of the camera it is so large that the identity is lost to rounding.

    Raises:
        CovarianceError: it is not finite.
    """
    if not np.isfinite(cov).all():
        raise CovarianceError(f"a covariance of diagonal {np.diag(cov).tolist()} is none: not finite")
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(cov)
        return np.asarray((vectors / np.sqrt(np.maximum(values, 1.0))).T)


def covariance_problem(cov: FloatArray) -> str:
    """What is wrong with a covariance; "" if nothing.

    Sylvester's criterion in plain floats, because this runs for every factor of every step.
    """
    if cov.shape == (3, 3):
        (a, b, c), (d, e, f), (g, h, i) = cov.tolist()
        minors: tuple[float, ...] = a, a * e - b * d, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        skew = abs(b - d) + abs(c - g) + abs(f - h)
        size = abs(a) + abs(e) + abs(i)
    elif cov.shape == (2, 2):
        (a, b), (d, e) = cov.tolist()
        minors = (a, a * e - b * d)
        skew, size = abs(b - d), abs(a) + abs(e)
    elif cov.ndim == 2 and cov.shape[0] == cov.shape[1] > 0:
        minors = tuple(float(np.linalg.det(cov[:i, :i])) for i in range(1, len(cov) + 1))
        skew, size = float(np.abs(cov - cov.T).max()), float(np.abs(np.diag(cov)).sum())
    else:
        return f"covariance of shape {cov.shape}, expected a square matrix"
    if not math.isfinite(size + skew):
        return "covariance with NaN or Inf"
    if skew > 1e-9 * size:
        return "asymmetric covariance"
    return "" if min(minors) > 0.0 else "covariance is not positive definite"


def _symmetric(m: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (m + m.T))
