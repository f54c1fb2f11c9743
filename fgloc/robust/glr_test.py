"""Whether two motion sources still agree: a generalized likelihood ratio test over windows, with hysteresis."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.config import WeightsConfig
from fgloc.graph.noise import COVARIANCE_FACTOR
from fgloc.stats import GATE, alarm_bound, chi2_bound
from fgloc.types import FloatArray

_MEDIAN = chi2_bound(0.5, se2.DOF)  # of the NIS of a step, if the covariances are as given


@dataclass(frozen=True, slots=True)
class GlrResult:
    """What is thought of the newest step.

    Attributes:
        flagged: whether the sources disagree now.
        since: on the step that raises the flag, how many of the newest steps (this one included) the disagreement
            spans; else 0.
        nis: largest NIS of any window that ends with this step, over what is usual.
        bound: above which it raises the flag.
        span: the number of that window's steps.
        scale: factor on the sources' covariances: the NIS over its expectation, or the usual level if that is larger.
    """

    flagged: bool
    since: int
    nis: float
    bound: float
    span: int = 1
    scale: float = 1.0


class GlrTest:
    """Compares two motion sources over all windows up to a length at once.

    A single step has little power (encoder quantization alone exceeds its bound), a long window detects late. The
    test takes, of all windows that end now, the one whose summed difference is least likely; its beginning is the most
    likely onset of the fault. A flag is taken back after the newest steps have agreed for a while.

    Source: Willsky and Jones 1976, generalized likelihood ratio for a jump of unknown time; docs/decisions/0003.
    """

    def __init__(self, config: WeightsConfig) -> None:
        self._config = config
        self.flagged = False
        self._usual = _MEDIAN  # median of the NIS of a step
        self._steps: deque[tuple[float, FloatArray, FloatArray, FloatArray]] = deque()  # dt, value, cov, derivative
        self._length_s = self._calm_s = 0.0

    def reset(self) -> None:
        """Forget all: nothing connects what comes with what was."""
        self.flagged = False
        self._steps.clear()
        self._length_s = self._calm_s = 0.0

    def judge(
        self,
        dt: float,
        difference: FloatArray,
        cov: FloatArray,
        by_installation: FloatArray | None = None,
        installation_cov: FloatArray | None = None,
    ) -> GlrResult:
        """Take in one step.

        Args:
            dt: its length [s].
            difference: ``(3,)`` in the body frame. Summed as it is: over a window the body hardly moves by more than a
                metre, and the position error of a yaw difference over so short a way is small beside the yaw's own.
            cov: ``(3, 3)`` of it if both sources are right.
            by_installation: ``(3, p)`` its derivative by what is wrong in the same way all the time.
            installation_cov: ``(p, p)`` of that.
        """
        D = np.zeros((3, 0)) if by_installation is None else by_installation
        self._installation_cov = np.zeros((0, 0)) if installation_cov is None else installation_cov
        self._steps.append((dt, difference, cov, D))
        self._length_s += dt
        while len(self._steps) > 1 and self._length_s - self._steps[0][0] >= self._config.window_s:
            self._length_s -= self._steps.popleft()[0]
        of_windows = self._nis_of_windows()
        if not self.flagged:
            moved = math.copysign(dt / self._config.window_s, of_windows[0] - self._usual)
            self._usual = min(max(self._usual * math.exp(moved), _MEDIAN / COVARIANCE_FACTOR), _MEDIAN)
        span = int(np.argmax(of_windows)) + 1
        nis = float(of_windows[span - 1]) / self._level
        bound = alarm_bound(dt, len(self._steps), se2.DOF)
        if not self.flagged:
            if nis <= bound:
                return GlrResult(False, 0, nis, bound, span, max(self._level, nis / se2.DOF))
            self.flagged, self._calm_s = True, 0.0
            return GlrResult(True, span, nis, bound, span)
        agrees = self._newest_nis() / self._level < chi2_bound(GATE, se2.DOF)
        self._calm_s = self._calm_s + dt if agrees else 0.0
        if self._calm_s >= self._config.release_s:
            self.reset()
        return GlrResult(self.flagged, 0, nis, bound, span)

    @property
    def _level(self) -> float:
        """How large differences are while nothing is wrong, as a share of their covariances."""
        return self._usual / _MEDIAN

    def _nis_of_windows(self) -> FloatArray:
        """NIS ``(n,)`` of each window that ends now, the shortest first."""
        differences = np.cumsum([d for _, d, _, _ in reversed(self._steps)], axis=0)
        covs = np.cumsum([S for _, _, S, _ in reversed(self._steps)], axis=0)
        D = np.cumsum([D for _, _, _, D in reversed(self._steps)], axis=0)
        covs = covs + D @ self._installation_cov @ D.transpose(0, 2, 1)
        return np.asarray(np.einsum("ni,ni->n", differences, np.linalg.solve(covs, differences[:, :, None])[:, :, 0]))

    def _newest_nis(self) -> float:
        """NIS of the newest steps, as many as the release takes."""
        seconds = np.cumsum([dt for dt, *_ in reversed(self._steps)])
        steps = int(np.searchsorted(seconds, self._config.release_s)) + 1
        return float(self._nis_of_windows()[:steps][-1])
