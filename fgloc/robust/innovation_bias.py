"""Errors that last: a few innovations of one source that are all small enough for the gate, but off to one side.

An anchor without line of sight or a reflected satellite signal is wrong in the same way for seconds. Each innovation by
itself passes the chi-square gate; their sum over the last few does not.

Source: Mehra, Peschon 1971, "An innovations approach to fault detection and diagnosis in dynamic systems"; the test of
the innovations' mean.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from fgloc.graph.joint import MOST_JOINT
from fgloc.graph.observation import Linearized
from fgloc.stats import chi2_bound
from fgloc.types import FloatArray


@dataclass(slots=True)
class _Window:
    stamps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=MOST_JOINT))
    innovations: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=MOST_JOINT))
    prediction: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=MOST_JOINT))


class InnovationBias:
    """The newest innovations of each source and target."""

    def __init__(self, probability: float, window_s: float) -> None:
        """Take the probability with which sound measurements pass, and the silence after which what was is forgotten.

        What is older than such a silence may be of another place. `MOST_JOINT` innovations show a bias from one sigma
        on; one of half a sigma, as a survey leaves it, passes however long it lasts.
        """
        self._probability, self._window_ns = probability, round(window_s * 1e9)
        self._windows: dict[tuple[str, int], _Window] = {}

    def forget(self) -> None:
        """The pose was set anew."""
        self._windows.clear()

    def is_biased(self, key: tuple[str, int], stamp_ns: int, one: Linearized, pose_cov: FloatArray) -> bool:
        """Add an innovation that passed the gate; whether the newest ones together do not.

        Their own noise is white. What is not known of the pose is taken to be the same in all of them.

        Args:
            key: of the source and its target.
            stamp_ns: of the measurement; asked again of the same one, it counts once.
            one: the measurement at the predicted pose.
            pose_cov: ``(3, 3)`` of the prediction.
        """
        held = self._windows.setdefault(key, _Window())
        while held.stamps_ns and not 0 < stamp_ns - held.stamps_ns[-1] < self._window_ns:
            if stamp_ns - held.stamps_ns[-1] >= self._window_ns:
                self._windows[key] = held = _Window()
                break
            for column in (held.stamps_ns, held.innovations, held.prediction):
                column.pop()
        held.stamps_ns.append(stamp_ns)
        held.innovations.append(one.residual)
        held.prediction.append(np.hstack([one.J @ np.linalg.cholesky(pose_cov), one.shared]))
        if len(held.stamps_ns) < 2 or len({part.shape for part in held.prediction}) > 1:
            return False
        total, common = np.sum(held.innovations, axis=0), np.sum(held.prediction, axis=0)
        cov = len(held.stamps_ns) * np.eye(len(total)) + common @ common.T
        return bool(total @ np.linalg.solve(cov, total) > chi2_bound(self._probability, len(total)))
