"""Which of two motion sources is wrong while they disagree: the one that sightings contradict."""

from __future__ import annotations

import numpy as np

from fgloc import se2
from fgloc.graph.measurement_log import Belief
from fgloc.types import FloatArray, MotionMeasurement, Readings

_STRETCH_S = 0.5  # of dead reckoning, from one fix to another, that is held against both sources
_WRONG = 16.3  # squared Mahalanobis distance that one in a thousand exceeds (three degrees of freedom)
_BETTER = 0.5  # of the other's distance: a source that is less wrong than this is in the right
_VERDICT, _MOST = 2, 4  # stretches in excess that decide against the witness, and that are remembered


class Arbiter:
    """Holds stretches of dead reckoning between two fixes against the fixes, once for each source.

    Without evidence the witness is believed: it was chosen because it does not see what makes wheels lie. What was
    found out lasts from one disagreement to the next.

    Attributes:
        credit: stretches that speak for the wheels less those that speak for the witness.
    """

    def __init__(self) -> None:
        self.credit = 0
        self.reset()

    @property
    def sides_with_wheels(self) -> bool:
        """Whether it is the witness that is wrong."""
        return self.credit >= _VERDICT

    def reset(self) -> None:
        """The disagreement is over, or nothing connects what comes with what was."""
        self._anchor: Belief | None = None
        self._wheels: list[MotionMeasurement] = []
        self._witness: list[MotionMeasurement] = []

    def hear(self, readings: Readings, fix: Belief | None) -> None:
        """Take in a step of a disagreement.

        Args:
            readings: what the sources say of it.
            fix: the pose after it, if sightings have told it.
        """
        if readings.wheels is None or readings.learned is None:
            self.reset()
            return
        if self._anchor is not None:
            self._wheels.append(readings.wheels)
            self._witness.append(readings.learned)
            seconds = (self._wheels[-1].stamp_ns - self._wheels[0].start_ns) * 1e-9
            if fix is None or seconds < _STRETCH_S:
                return
            self._judge(self._anchor, fix)
        self.reset()
        self._anchor = fix

    def _judge(self, anchor: Belief, fix: Belief) -> None:
        wheels, witness = _nis(anchor, self._wheels, fix), _nis(anchor, self._witness, fix)
        if max(wheels, witness) < _WRONG or min(wheels, witness) > _BETTER * max(wheels, witness):
            return
        self.credit = int(np.clip(self.credit + (1 if wheels < witness else -1), -_MOST, _MOST))


def _nis(anchor: Belief, motions: list[MotionMeasurement], fix: Belief) -> float:
    """Of dead reckoning from one fix to another; their errors are taken for independent, which is cautious."""
    pose: FloatArray = anchor.pose
    cov: FloatArray = anchor.cov
    for m in motions:
        pose, cov = se2.compose(pose, m.motion), se2.compose_cov(cov, m.motion, m.cov)
    miss = se2.log(se2.between(pose, fix.pose))
    return float(miss @ np.linalg.solve(cov + fix.cov, miss))
