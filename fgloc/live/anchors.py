"""What poses are propagated from: a keyframe's estimate, and the motion sources as they were then."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from fgloc import se2
from fgloc.assembly import Assembly
from fgloc.config import Config
from fgloc.errors import FglocError
from fgloc.graph.installation import Installation, InstallationEstimate
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import NoiseBudget
from fgloc.sensors.gyro import Attitude, Gyro
from fgloc.sensors.learned.network import JointCalibration
from fgloc.sensors.learned.sensor import LearnedMotion
from fgloc.types import Estimate, FloatArray, Mode, Step


@dataclass(frozen=True, slots=True, eq=False)
class MotionParts:
    """Of a run: what its motion sources are made of. Can be pickled."""

    config: Config
    installation: Installation  # the parameters that motions may depend on
    joint: JointCalibration | None
    model: Any  # of the learned motion
    attitude: Attitude | None = None  # on uneven ground
    signals_back_ns: int = 0  # how far before a keyframe the learned motion reads measured signals


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A keyframe to propagate from. Can be pickled."""

    segment: int
    stamp_ns: int
    belief: PoseWithCovariance  # with the installation of `MotionParts`
    known: InstallationEstimate  # likewise
    added_cov: FloatArray  # (3, 3) in the body frame, of what is reported beside the estimator's
    mode: Mode
    since_fix_s: float
    budget: NoiseBudget
    gyro: Gyro | None
    learned: LearnedMotion | None  # without its model, and without the events that it has read


class Outlet(Protocol):
    """Takes what a live run finds; called in its estimation thread."""

    def built(self, parts: MotionParts) -> None:
        """The parts of the run have been built, perhaps not for the first time."""
        ...

    def estimated(self, anchor: Anchor, estimate: Estimate) -> None:
        """A keyframe has been estimated."""
        ...

    def failed(self, error: FglocError) -> None:
        """The run cannot go on."""
        ...


class Anchors:
    """Makes the anchors of a run's estimates.

    Attributes:
        parts: what goes with all of them.
    """

    def __init__(self, parts: Assembly) -> None:
        """Take the parts of the run."""
        installation = parts.localizer.factors.installation
        self._run = parts
        self._rows = installation.motion_rows
        sigmas = {installation.names[i]: float(installation.sigmas[i]) for i in self._rows}
        sources = parts.localizer.motion.sources
        learned = parts.learned
        self.parts = MotionParts(
            parts.config,
            Installation(sigmas),
            sources.rules.joint,
            None if learned is None else learned.model,
            sources.attitude,
            0 if learned is None else learned.signals_back_ns,
        )

    def make(self, step: Step, estimate: Estimate) -> Anchor:
        """The anchor of the estimate that the run's last step led to."""
        localizer = self._run.localizer
        estimator, installation = localizer.estimator, localizer.factors
        frame = estimator.log.keyframes.get(estimator.k)
        gyro, learned = localizer.motion.sources.gyro, self._run.learned
        body = se2.rotate_cov(estimate.cov, -float(estimate.pose[2]))
        same_time = frame is not None and frame.stamp_ns == estimate.stamp_ns
        # Another pose is of the odometry that stands in for the estimate, see `fgloc.diagnosis.sanity`
        if frame is not None and same_time and np.array_equal(frame.belief.pose, estimate.pose):
            belief = frame.belief
            known = belief.installation or installation.estimated
            budget = replace(frame.budget, overruled_cov=None)  # that is of one step alone
        else:
            belief, known = PoseWithCovariance(estimate.pose, body), installation.estimated
            budget = NoiseBudget()
        return Anchor(
            segment=step.segment,
            stamp_ns=estimate.stamp_ns,
            belief=self._of_motion(belief),
            known=self._belief_of_motion(known),
            added_cov=body - belief.cov,
            mode=estimate.mode,
            since_fix_s=localizer.tracking.since_fix_s,
            budget=budget,
            gyro=None if gyro is None else gyro.fork(),
            learned=None if learned is None else learned.fork(None, {}),
        )

    def _of_motion(self, belief: PoseWithCovariance) -> PoseWithCovariance:
        cross = None if belief.cross is None else belief.cross[:, self._rows]
        known = None if belief.installation is None else self._belief_of_motion(belief.installation)
        return PoseWithCovariance(belief.pose, belief.cov, cross, known)

    def _belief_of_motion(self, known: InstallationEstimate) -> InstallationEstimate:
        return InstallationEstimate(known.mean[self._rows], known.cov[np.ix_(self._rows, self._rows)])
