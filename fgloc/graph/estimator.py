"""What all estimators share: the measurement log, the newest pose, and its prediction."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np

from fgloc.config import EstimatorConfig
from fgloc.errors import EstimatorError
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import Installation, InstallationEstimate
from fgloc.graph.joint import considered, joint_cov, split
from fgloc.graph.measurement_log import Keyframe, LandmarkFactor, MeasurementLog, PoseWithCovariance
from fgloc.graph.uneven import levelled, predict, starting
from fgloc.types import FloatArray, MotionMeasurement


class Estimator(ABC):
    """Poses of the newest keyframes, one update a step.

    Attributes:
        factors: makes the factors of landmarks; it has what is known of the installation.
        log: every measurement of the window (or of the run, if ``keep_all``).
        belief: the newest pose.
        rebuilt: how often what the estimator held had to be built again from the log.
        contradicted: constants that left the gate of their prior, with value and sigma that they had then. They are
            held at what was given from then on, and their prior's uncertainty stays in the covariance of the pose.
    """

    def __init__(self, config: EstimatorConfig, factors: LandmarkFactors, keep_all: bool = False) -> None:
        self._config = config
        self.factors = factors
        self.log = MeasurementLog(config.lag_s, keep_all or config.kind == "isam2")
        self.rebuilt = 0
        self.belief: PoseWithCovariance | None = None
        self._k = -1
        self._corrected = -1  # the keyframe that was corrected last: those before it lead elsewhere
        self._elapsed_s = 0.0
        self.contradicted: dict[str, tuple[float, float]] = {}

    @property
    def elapsed_s(self) -> float:
        """The estimator's own time: runs on through clock jumps."""
        return self._elapsed_s

    @property
    def installation(self) -> Installation:
        """The parameters beside the pose."""
        return self.factors.installation

    @property
    def installed(self) -> InstallationEstimate:
        """What is known of the installation now."""
        return self.factors.estimated

    @property
    def k(self) -> int:
        """Index of the newest keyframe, -1 before the first."""
        return self._k

    @property
    def newest(self) -> Keyframe:
        """The newest keyframe."""
        return self.log.keyframes[self._k]

    def start(
        self, stamp_ns: int, prior: PoseWithCovariance, sightings: Sequence[LandmarkFactor] = ()
    ) -> PoseWithCovariance:
        """Begin a segment: a first pose with a prior, unconnected to what was before."""
        self._k += 1
        self._elapsed_s += 1e-3
        frame = Keyframe(self._k, stamp_ns, self._elapsed_s, prior, prior=prior, sightings=tuple(sightings))
        return self._take(frame)

    def predict(self, motions: Sequence[MotionMeasurement]) -> PoseWithCovariance:
        """Where the robot is expected after the motions of one step (information-weighted), before any sighting.

        Raises:
            EstimatorError: not started, or no motion.
        """
        if self.belief is None or not motions:
            raise EstimatorError("predict needs a started estimator and at least one motion measurement")
        if not self.installation.ground:
            return predict(self.belief, self.installed, self.factors.installation, motions)
        predicted = predict(self.belief, self.belief.installation or self.installed, self.installation, motions)
        assert predicted.installation is not None
        self.factors.estimated = predicted.installation  # sightings are held against the ground as predicted
        return predicted

    def level(self, motions: Sequence[MotionMeasurement]) -> None:
        """While no pose is known, follow roll and pitch by what gravity tells of this step."""
        if self.installation.ground:
            self.factors.estimated = levelled(self.installed, motions, self.installation)

    def forget_ground(self) -> None:
        """A first pose comes: height, roll and pitch there may be others than those of the newest step."""
        if self.installation.ground:
            self.factors.estimated = starting(self.installed, self.installation)

    def update(
        self,
        stamp_ns: int,
        dt: float,
        motions: Sequence[MotionMeasurement],
        sightings: Sequence[LandmarkFactor] = (),
        rejected: Sequence[LandmarkFactor] = (),
        predicted: PoseWithCovariance | None = None,
    ) -> PoseWithCovariance:
        """Add one keyframe with its measurements; return the filtered pose.

        Args:
            stamp_ns: time of the keyframe.
            dt: time since the one before [s].
            motions: between-factors from the one before; at least one.
            sightings: landmark measurements, motion-compensated to this keyframe.
            rejected: sightings that are only logged, for the cost of the batch.
            predicted: result of `predict` for these motions, if the caller has it already.
        """
        predicted = predicted or self.predict(motions)
        self._k += 1
        self._elapsed_s += max(dt, 1e-6)
        frame = Keyframe(
            self._k, stamp_ns, self._elapsed_s, predicted, None, tuple(motions), tuple(sightings), tuple(rejected)
        )
        return self._take(frame)

    def revise(self, motions: Mapping[int, Sequence[MotionMeasurement]]) -> None:
        """Replace the motion factors of keyframes that the estimator still holds; the newest belief follows.

        Older ones are changed in the log alone, for the batch smoother.
        """
        for k, changed in motions.items():
            self.log.keyframes[k].motions = tuple(changed)
        if motions and self.belief is not None:
            self._solve_again(sorted(motions))
            self._adopt(self.newest.belief)

    def correct(self, belief: PoseWithCovariance, landmark_id: int) -> None:
        """Go on from another newest pose, which owes nothing to a landmark; its sightings are only logged."""
        for frame in self.log.keyframes.values():
            of_it = tuple(s for s in frame.sightings if s.measurement.landmark_id == landmark_id)
            if of_it:
                frame.sightings = tuple(s for s in frame.sightings if s.measurement.landmark_id != landmark_id)
                frame.rejected = (*frame.rejected, *of_it)
        newest = self.newest
        newest.belief, self._corrected = belief, self._k
        self._begin_at(newest)
        self._adopt(newest.belief)

    @abstractmethod
    def _begin_at(self, newest: Keyframe) -> None:
        """Forget what led to the belief of this keyframe, which stands as it is."""

    def _take(self, frame: Keyframe) -> PoseWithCovariance:
        self._solve(frame)
        frame.ground = self.ground_of(frame.belief)
        self.log.append(frame)
        self._adopt(frame.belief)
        return frame.belief

    def ground_of(self, belief: PoseWithCovariance) -> FloatArray | None:
        """Height, roll and pitch ``(3,)``; None where the floor is flat."""
        if not self.installation.ground:
            return None
        return (belief.installation or self.installed).mean[self.installation.constants :]

    def asked(self) -> InstallationEstimate:
        """The installation with what is held as it was when it left the gate of its prior."""
        mean, cov = self.installed.mean.copy(), self.installed.cov.copy()
        for name, (value, sigma) in self.contradicted.items():
            i = self.installation.index[name]
            cov[i], cov[:, i] = 0.0, 0.0
            mean[i], cov[i, i] = value, sigma**2
        return InstallationEstimate(mean, cov)

    def _held(self) -> list[int]:
        """Rows of pose and installation together that are held."""
        return [3 + self.installation.index[name] for name in self.contradicted]

    def _hold_beyond_gate(self, belief: PoseWithCovariance) -> bool:
        """From now on hold what this belief has furthest beyond the gate of its prior; whether there was something.

        Not all at once: what one wrong constant makes impossible pulls others along.
        """
        known = belief.installation
        names = () if known is None else self.installation.beyond_gate(known)
        new = [name for name in names if name not in self.contradicted][:1]
        for name in new:
            i = self.installation.index[name]
            assert known is not None
            self.contradicted[name] = float(known.mean[i]), math.sqrt(max(0.0, float(known.cov[i, i])))
        return bool(new)

    def _considered(self, belief: PoseWithCovariance) -> PoseWithCovariance:
        """The belief with what is held as uncertain as its prior."""
        if not self.contradicted or belief.installation is None:
            return belief
        rows, prior = self._held(), self.installation.prior()
        held = [i - 3 for i in rows]
        P = considered(joint_cov(belief, belief.installation), rows, prior.cov[np.ix_(held, held)])
        found = split(belief, P)
        assert found.installation is not None
        found.installation.mean[held] = prior.mean[held]
        return found

    def _adopt(self, belief: PoseWithCovariance) -> None:
        self.belief = belief
        if belief.installation is not None:
            self.factors.estimated = belief.installation

    def _solve_again(self, changed: Sequence[int]) -> None:
        """The motions of these keyframes (in order) have changed: filter anew from the first of them on."""
        for k in range(max(changed[0], self._corrected + 1), self._k + 1):
            before, frame = self.log.keyframes.get(k - 1), self.log.keyframes[k]
            if before is None or frame.prior is not None:
                continue
            known = before.belief.installation or self.installed
            frame.belief = predict(before.belief, known, self.factors.installation, frame.motions)
            self._solve(frame)

    @abstractmethod
    def _solve(self, frame: Keyframe) -> None:
        """Replace the belief of a keyframe, which is its prior or its prediction, by the filtered one."""
