"""Two motion measurements with correlated errors, made independent without losing their joint information."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from fgloc import se2
from fgloc.errors import CovarianceError
from fgloc.types import FloatArray, MotionMeasurement

# Of the norms of the gain and of the correlation: at 1 one of the two would add no information and its covariance would
# be singular; near it their difference would be blown up.
MAX_GAIN = 0.95


class JointCalibration:
    """How the errors of wheel odometry (W) and of learned motion (N) go together.

    Kept as the dimensionless ``R = L_n⁻¹ C L_w⁻ᵀ`` with the Cholesky factors of N and W, so that a calibration from
    long windows serves a step of any length and any predicted covariance: ``C = L_n R L_wᵀ`` of that step.

    Source: conditional mean of the joint Gaussian.
    """

    def __init__(self, W: ArrayLike, N: ArrayLike, C: ArrayLike) -> None:
        """Take covariances estimated over windows.

        Args:
            W: ``(3, 3)`` of the wheels' error.
            N: ``(3, 3)`` of the learned motion's error.
            C: ``(3, 3)`` E[e_n e_wᵀ].

        Raises:
            CovarianceError: W or N is not a covariance, or the three are not a joint one.
        """
        L_w, L_n = _cholesky(np.asarray(W, dtype=float), "W"), _cholesky(np.asarray(N, dtype=float), "N")
        self.correlation = np.linalg.solve(L_n, np.linalg.solve(L_w, np.asarray(C, dtype=float).T).T)
        norm = float(np.linalg.norm(self.correlation, 2))
        if not norm <= 1.0 + 1e-9:
            raise CovarianceError(
                f"W, N and C are not a joint covariance: their correlation has norm {norm:.4g}, expected at most 1; "
                "estimate the three from the same windows"
            )
        if norm > MAX_GAIN:
            self.correlation *= MAX_GAIN / norm
        self._last: tuple[FloatArray, FloatArray, FloatArray] | None = None  # covariances and gain

    def gain(self, W: FloatArray, N: FloatArray) -> FloatArray:
        """K = C W⁻¹ ``(3, 3)`` for a step with these covariances.

        Shrunk until its norm, in units of the wheels' sigmas, is at most 0.95.
        """
        last = self._last  # it is asked for twice in most steps; other threads ask too
        if last is None or last[0] is not W or last[1] is not N:
            L_w, L_n = _cholesky(W, "the wheels' covariance"), _cholesky(N, "the learned covariance")
            last = self._last = W, N, self._gain(L_w, L_n)
        return last[2]

    def difference_cov(self, W: FloatArray, N: FloatArray) -> FloatArray:
        """Covariance ``(3, 3)`` of the difference of the two motions over a step: W + N - C - Cᵀ."""
        C = self.gain(W, N) @ W
        return W + N - C - C.T

    def decorrelate(self, wheels: MotionMeasurement, learned: MotionMeasurement) -> MotionMeasurement:
        """The learned measurement that may enter beside the unchanged wheels' as if independent.

        Raises:
            CovarianceError: a covariance is not one.
            ValueError: the two measure different steps.
        """
        if (wheels.start_ns, wheels.stamp_ns) != (learned.start_ns, learned.stamp_ns):
            raise ValueError(
                f"wheels measure [{wheels.start_ns}, {wheels.stamp_ns}] ns, learned motion [{learned.start_ns}, "
                f"{learned.stamp_ns}] ns; only measurements of one step can be decorrelated"
            )
        K = self.gain(wheels.cov, learned.cov)
        inverse = np.linalg.inv(np.eye(3) - K)
        difference = se2.log(se2.between(wheels.motion, learned.motion))
        motion = se2.compose(wheels.motion, se2.exp(inverse @ difference))
        cov = inverse @ (learned.cov - K @ wheels.cov @ K.T) @ inverse.T
        depends = {}
        for name in {**wheels.depends_on, **learned.depends_on}:
            by_wheels, assumed = wheels.depends_on.get(name, (np.zeros(3), None))
            by_learned, also = learned.depends_on.get(name, (np.zeros(3), None))
            value = assumed if assumed is not None else also
            assert value is not None
            depends[name] = by_wheels + inverse @ (by_learned - by_wheels), value
        return replace(learned, motion=motion, cov=0.5 * (cov + cov.T), depends_on=depends)

    def _gain(self, L_w: FloatArray, L_n: FloatArray) -> FloatArray:
        scaled = np.linalg.solve(L_w, L_n @ self.correlation)  # K as the wheels' sigmas see it
        if np.vdot(scaled, scaled) > MAX_GAIN**2:  # else the norm, which is not above Frobenius', is small enough
            scaled *= MAX_GAIN / max(float(np.linalg.norm(scaled, 2)), MAX_GAIN)
        return np.asarray(L_w @ np.linalg.solve(L_w.T, scaled.T).T)


def _cholesky(cov: FloatArray, name: str) -> FloatArray:
    try:
        if not np.isfinite(cov).all():
            raise np.linalg.LinAlgError("not finite")
        return np.asarray(np.linalg.cholesky(cov))
    except np.linalg.LinAlgError as error:
        raise CovarianceError(f"{name} is not positive definite ({error}): {cov.tolist()}") from error
