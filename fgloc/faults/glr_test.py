"""Whether two motion sources still agree: a generalized likelihood ratio test over windows, with hysteresis."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from fgloc.config import WeightsConfig
from fgloc.types import FloatArray

_CALM = 0.6  # of the alarm: below it the newest window agrees


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is thought of the newest step.

    Attributes:
        flagged: whether the sources disagree now.
        since: on the step that raises the flag, how many of the newest steps (this one included) the disagreement
            spans; else 0.
        nis: largest NIS of any window that ends with this step.
    """

    flagged: bool
    since: int
    nis: float


class Disagreement:
    """Compares two motion sources over all windows up to a length at once.

    A single step says little (encoder quantization alone trips it), a long window says it late. The test takes, of all
    windows that end now, the one whose summed difference is least likely; its beginning is the most likely onset of
    what goes wrong. A flag is taken back after the newest steps have agreed for a while.

    Source: Willsky and Jones 1976, generalized likelihood ratio for a jump of unknown time; design.md §6.2.
    """

    def __init__(self, config: WeightsConfig) -> None:
        self._config = config
        self.flagged = False
        self._steps: deque[tuple[float, FloatArray, FloatArray]] = deque()  # dt, difference, covariance
        self._length_s = 0.0
        self._calm_s = 0.0

    def reset(self) -> None:
        """Forget all: nothing connects what comes with what was."""
        self.flagged = False
        self._steps.clear()
        self._length_s = self._calm_s = 0.0

    def judge(self, dt: float, difference: FloatArray, cov: FloatArray) -> Verdict:
        """Take in one step.

        Args:
            dt: its length [s].
            difference: ``(3,)`` in the body frame. Summed as it is: over a window the body hardly moves by more than a
                metre, and the position error of a yaw difference over so short a way is small beside the yaw's own.
            cov: ``(3, 3)`` of it if both sources are right.
        """
        self._steps.append((dt, difference, cov))
        self._length_s += dt
        while len(self._steps) > 1 and self._length_s - self._steps[0][0] >= self._config.window_s:
            self._length_s -= self._steps.popleft()[0]
        nis, span = self._worst()
        if not self.flagged:
            if nis <= self._config.alarm:
                return Verdict(False, 0, nis)
            self.flagged, self._calm_s = True, 0.0
            return Verdict(True, span, nis)
        self._calm_s = self._calm_s + dt if self._newest_nis() < _CALM * self._config.alarm else 0.0
        if self._calm_s >= self._config.release_s:
            self.flagged = False
            self._steps.clear()
            self._length_s = 0.0
        return Verdict(self.flagged, 0, nis)

    def _worst(self) -> tuple[float, int]:
        """NIS of the least likely window that ends now, and the number of its steps."""
        differences = np.cumsum([d for _, d, _ in reversed(self._steps)], axis=0)
        covs = np.cumsum([S for _, _, S in reversed(self._steps)], axis=0)
        nis = np.einsum("ni,ni->n", differences, np.linalg.solve(covs, differences[:, :, None])[:, :, 0])
        worst = int(np.argmax(nis))
        return float(nis[worst]), worst + 1

    def _newest_nis(self) -> float:
        """NIS of the newest steps, as many as the release takes."""
        d, S, length = np.zeros(3), np.zeros((3, 3)), 0.0
        for dt, difference, cov in reversed(self._steps):
            d, S, length = d + difference, S + cov, length + dt
            if length >= self._config.release_s:
                break
        return float(d @ np.linalg.solve(S, d))
