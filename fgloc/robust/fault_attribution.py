"""Which of two motion sources that differ is wrong: the one that sightings contradict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.estimators import Estimator
from fgloc.graph.measurement_log import Keyframe
from fgloc.graph.noise import COVARIANCE_FACTOR
from fgloc.relocalization.pose_fit import Fit, fit_pose
from fgloc.sensors import registry
from fgloc.stats import chi2_bound
from fgloc.types import FloatArray, MotionMeasurement


@dataclass(frozen=True, slots=True)
class Contradicted:
    """What sightings exclude.

    Attributes:
        sources: of the motion, by name.
        steps: for how many of the newest steps this holds.
    """

    sources: frozenset[str] = frozenset()
    steps: int = 1


class FaultAttribution:
    """Compares wheels and learned motion with how far the robot went by sightings alone.

    Two sources that differ do not say which of them is wrong. A third one does: the poses that sightings give by
    themselves where the difference began and now. Wheels slip now and then, while a model that is of another robot, or
    of another floor, is wrong all the time.

    Source: Gertler 1998, "Fault detection and diagnosis in engineering systems", structured residuals.

    Attributes:
        memory_s: how far back the log goes [s].
    """

    def __init__(self, config: Config, estimator: Estimator) -> None:
        """Take the estimator, whose log has the readings and sightings of the newest keyframes."""
        self.memory_s = config.estimator.lag_s
        self._config = config
        self._estimator = estimator
        self._fits: dict[int, Fit | None] = {}

    def contradicted(self, steps: int | None) -> Contradicted | None:
        """Which of wheels and learned motion sightings contradict over the newest keyframes.

        Args:
            steps: for how many the sources differ, the last of them is not in the log yet; None: over a whole window.

        Returns:
            None if sightings cannot tell.
        """
        frames = self._stretch(steps)
        if frames is None:
            return None
        self._fits = {k: fit for k, fit in self._fits.items() if k >= frames[0].k}
        first, last = self._fit(frames[0]), self._fit(frames[-1])
        if first is None or last is None:
            return None
        went = se2.between(first.pose, last.pose)
        cov = se2.compose_cov(first.cov, went, last.cov)
        bound = chi2_bound(self._config.estimator.gate_probability, se2.DOF)
        names = registry.motion_names()
        wrong = set()
        for name, factor in ((names.odometer, 1.0), (names.model, COVARIANCE_FACTOR)):
            motions = [r.wheels if name == names.odometer else r.learned for r in (f.readings for f in frames[1:])]
            known = [replace(m, cov=factor * m.cov) for m in motions if m is not None]
            if len(known) == len(motions) and self._nis(known, went, cov) > bound:
                wrong.add(name)
        return Contradicted(frozenset(wrong), self._estimator.k + 1 - frames[0].k)

    def _stretch(self, steps: int | None) -> list[Keyframe] | None:
        """Keyframes from the last one with sightings before the difference to the newest one with sightings."""
        log, newest = self._estimator.log.keyframes, self._estimator.k
        stretch: list[Keyframe] = []
        for k in range(newest, -1, -1):
            frame = log.get(k)
            if frame is None:
                return None
            seen = bool(frame.sightings or frame.rejected)
            if seen or stretch:
                stretch.append(frame)
            age_s = self._estimator.elapsed_s - frame.elapsed_s
            began = steps is not None and k <= newest + 1 - steps
            if len(stretch) > 1 and seen and (began or age_s >= self._config.weights.window_s):
                return stretch[::-1]
            if frame.prior is not None or age_s > self.memory_s:
                return None
        return None

    def _fit(self, frame: Keyframe) -> Fit | None:
        """The pose that a keyframe's sightings give by themselves, where they check each other."""
        if frame.k not in self._fits:
            sightings = [s.alone for s in (*frame.sightings, *frame.rejected)]
            fit = fit_pose(frame.belief.pose, sightings, self._estimator.factors)
            checked = fit is not None and fit.is_checked(self._config.estimator.gate_probability)
            self._fits[frame.k] = fit if checked else None
        return self._fits[frame.k]

    def _nis(self, motions: Sequence[MotionMeasurement], went: FloatArray, cov: FloatArray) -> float:
        """Of the difference of what a source measured and ``went (3,)``, which has ``cov (3, 3)``."""
        total, cov_total = motions[0].motion, motions[0].cov
        by: dict[str, FloatArray] = {name: d for name, (d, _) in motions[0].depends_on.items()}
        for _, m in pairwise(motions):
            back = se2.adjoint(se2.inverse(m.motion))
            by = {name: back @ d for name, d in by.items()}
            for name, (d, _) in m.depends_on.items():
                by[name] = by.get(name, np.zeros(3)) + d
            total, cov_total = se2.compose(total, m.motion), se2.compose_cov(cov_total, m.motion, m.cov)
        factors = self._estimator.factors
        rows = [factors.installation.index[name] for name in by]
        D = np.array(list(by.values())).reshape(len(by), 3).T
        cov_total = cov_total + cov + D @ factors.estimated.cov[np.ix_(rows, rows)] @ D.T
        miss = se2.log(se2.between(total, went))
        return float(miss @ np.linalg.solve(cov_total, miss))
