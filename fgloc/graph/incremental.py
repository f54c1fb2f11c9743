"""The incremental estimator: iSAM2 in a fixed-lag window (flat cost, however long the run) or whole (short runs).

See design.md §7. A GTSAM update that throws leaves the smoother in ruins; the window is then rebuilt from our own log
without the sightings of the step, and the caller is told.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Protocol

import gtsam
import numpy as np

from fgloc import se2
from fgloc.config import EstimatorConfig
from fgloc.errors import EstimatorError
from fgloc.graph.factors import LandmarkFactors, landmark_key, motion_factor, pose_key, prior_factor
from fgloc.graph.log import Belief, Keyframe, MeasurementLog, Sighting
from fgloc.types import (
    FloatArray,
    LandmarkMeasurement,
    MarkerPoseMeasurement,
    MotionMeasurement,
    RangeBearingMeasurement,
)

_GTSAM_ERRORS = (RuntimeError, IndexError, ValueError)


class _Backend(Protocol):
    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int, elapsed_s: float) -> None: ...
    def pose(self, k: int) -> FloatArray: ...
    def covariance(self, k: int) -> FloatArray: ...


class _FixedLag:
    """``IncrementalFixedLagSmoother`` over poses."""

    def __init__(self, config: EstimatorConfig) -> None:
        self._smoother = gtsam.IncrementalFixedLagSmoother(config.lag_s, isam2_params(config))

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int, elapsed_s: float) -> None:
        self._smoother.update(graph, values, dict.fromkeys(values.keys(), elapsed_s))

    def pose(self, k: int) -> FloatArray:
        return _vector(self._smoother.calculateEstimatePose2(pose_key(k)))

    def covariance(self, k: int) -> FloatArray:
        return np.asarray(self._smoother.marginalCovariance(pose_key(k)))


class _Full:
    """``ISAM2`` over the whole run: landmarks may be variables; the cost grows with the run."""

    def __init__(self, config: EstimatorConfig) -> None:
        self._isam2 = gtsam.ISAM2(isam2_params(config))

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int, elapsed_s: float) -> None:
        self._isam2.update(graph, values)

    def pose(self, k: int) -> FloatArray:
        return _vector(self._isam2.calculateEstimatePose2(pose_key(k)))

    def covariance(self, k: int) -> FloatArray:
        return np.asarray(self._isam2.marginalCovariance(pose_key(k)))


class IncrementalEstimator:
    """Poses of the newest keyframes, one update a step.

    Attributes:
        log: every measurement of the window (or of the run, if ``keep_all``).
        belief: the newest pose.
        rebuilt: how often the window had to be rebuilt.
    """

    def __init__(self, config: EstimatorConfig, factors: LandmarkFactors, keep_all: bool = False) -> None:
        self._config = config
        self._factors = factors
        self.log = MeasurementLog(None if keep_all or config.kind == "isam2" else config.lag_s)
        self.rebuilt = 0
        self.belief: Belief | None = None
        self._k = -1
        self._elapsed_s = 0.0
        self._backend: _Backend | None = None
        self._landmarks: dict[int, FloatArray] = {}  # initial values of the variables in the graph

    @property
    def k(self) -> int:
        """Index of the newest keyframe, -1 before the first."""
        return self._k

    def start(self, stamp_ns: int, prior: Belief, sightings: Sequence[Sighting] = ()) -> Belief:
        """Begin a segment: a first pose with a prior, unconnected to what was before."""
        self._k += 1
        self._elapsed_s += 1e-3
        if self._backend is None or self._config.kind == "fixed_lag":
            self._backend = self._new_backend()
        frame = Keyframe(self._k, stamp_ns, self._elapsed_s, prior, prior=prior, sightings=tuple(sightings))
        return self._insert(frame, prior.pose)

    def predict(self, motions: Sequence[MotionMeasurement]) -> Belief:
        """Where the robot is expected after the motions of one step (information-weighted), before any sighting.

        Raises:
            EstimatorError: not started, or no motion.
        """
        if self.belief is None or not motions:
            raise EstimatorError("predict needs a started estimator and at least one motion measurement")
        motion, cov = fuse(motions)
        return Belief(se2.compose(self.belief.pose, motion), se2.compose_cov(self.belief.cov, motion, cov))

    def update(
        self,
        stamp_ns: int,
        dt: float,
        motions: Sequence[MotionMeasurement],
        sightings: Sequence[Sighting] = (),
        refused: Sequence[Sighting] = (),
        predicted: Belief | None = None,
    ) -> Belief:
        """Add one keyframe with its measurements; return the filtered pose.

        Args:
            stamp_ns: time of the keyframe.
            dt: time since the one before [s].
            motions: between-factors from the one before; at least one.
            sightings: landmark measurements carried to this keyframe.
            refused: sightings that are only logged, for the batch smoother to look at again.
            predicted: what `predict` said of these motions, if the caller has asked already.
        """
        predicted = predicted or self.predict(motions)
        self._k += 1
        self._elapsed_s += max(dt, 1e-6)
        frame = Keyframe(
            self._k, stamp_ns, self._elapsed_s, predicted, None, tuple(motions), tuple(sightings), tuple(refused)
        )
        return self._insert(frame, predicted.pose)

    def _insert(self, frame: Keyframe, initial: FloatArray) -> Belief:
        backend = self._backend
        if backend is None:
            raise EstimatorError("the estimator was not started")
        try:
            graph, values = self._graph_of(frame, initial, frame.prior)
            backend.update(graph, values, frame.k, frame.elapsed_s)
            frame.belief = Belief(backend.pose(frame.k), backend.covariance(frame.k))
            if not (math.isfinite(frame.belief.pose[2]) and math.isfinite(frame.belief.cov[0, 0])):
                raise ValueError("estimate is not finite")
        except _GTSAM_ERRORS:
            self._rebuild(frame, initial)
        self.log.append(frame)
        self.belief = frame.belief
        return frame.belief

    def _graph_of(
        self, frame: Keyframe, initial: FloatArray, prior: Belief | None
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(pose_key(frame.k), gtsam.Pose2(*initial))
        if prior is not None:
            graph.add(prior_factor(frame.k, prior.pose, prior.cov))
        else:
            for motion in frame.motions:
                graph.add(motion_factor(frame.k, motion))
        for sighting in frame.sightings:
            self._introduce(sighting.measurement, initial, values)
            for factor in sighting.factors:
                graph.add(factor)
        return graph, values

    def _introduce(self, m: LandmarkMeasurement, pose: FloatArray, values: gtsam.Values) -> None:
        """Give a first value to a landmark that is a variable and not yet in the graph."""
        if self._factors.known or m.landmark_id in self._landmarks:
            return
        key = landmark_key(m.landmark_id)
        if isinstance(m, RangeBearingMeasurement):
            initial = se2.compose(
                pose, [m.range_m * np.cos(m.bearing_rad), m.range_m * np.sin(m.bearing_rad), m.bearing_rad]
            )
            values.insert(key, initial[:2])
        elif isinstance(m, MarkerPoseMeasurement):
            initial = se2.compose(pose, m.pose)
            values.insert(key, gtsam.Pose2(*initial))
        else:
            return
        self._landmarks[m.landmark_id] = initial

    def _rebuild(self, frame: Keyframe, initial: FloatArray) -> None:
        """Build the window again from the log, without the sightings of the offending step."""
        self.rebuilt += 1
        frame.refused = (*frame.refused, *frame.sightings)
        frame.sightings = ()
        lag = self._config.lag_s if self._config.kind == "fixed_lag" else np.inf
        frames = [f for f in self.log.since(frame.elapsed_s - lag) if frame.prior is None]
        try:
            frame.belief = self._replayed([*frames, frame], initial)
        except _GTSAM_ERRORS:  # an older sighting is at fault; what the window knew is in the prediction
            frame.belief = self._replayed([frame], initial)

    def _replayed(self, frames: Sequence[Keyframe], initial: FloatArray) -> Belief:
        """Give these keyframes to a new backend; the belief of the last, whose pose starts at ``initial``."""
        self._backend = backend = self._new_backend()
        self._landmarks.clear()
        newest = frames[-1].k
        for i, held in enumerate(frames):
            prior = held.prior
            if i == 0 and prior is None:  # its belief holds its sightings already
                prior, held = held.belief, dataclasses.replace(held, sightings=())
            graph, values = self._graph_of(held, initial if held.k == newest else held.belief.pose, prior)
            backend.update(graph, values, held.k, held.elapsed_s)
        return Belief(backend.pose(newest), backend.covariance(newest))

    def _new_backend(self) -> _Backend:
        return _FixedLag(self._config) if self._config.kind == "fixed_lag" else _Full(self._config)


def fuse(motions: Sequence[MotionMeasurement]) -> tuple[FloatArray, FloatArray]:
    """One motion ``(3,)`` and covariance ``(3, 3)`` out of independent ones over the same interval.

    First order: the mean of the logarithms about the first motion, weighted by information.
    """
    first = motions[0]
    if len(motions) == 1:
        return first.motion, first.cov
    information = np.linalg.inv(first.cov)
    pull = np.zeros(3)
    for m in motions[1:]:
        weight = np.linalg.inv(m.cov)
        information = information + weight
        pull += weight @ se2.log(se2.between(first.motion, m.motion))
    cov = np.linalg.inv(information)
    return se2.compose(first.motion, se2.exp(cov @ pull)), 0.5 * (cov + cov.T)


def isam2_params(config: EstimatorConfig) -> gtsam.ISAM2Params:
    """iSAM2 settings that every backend shares; see gtsam's defaults for the rest."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")  # Cholesky fails on long stretches without fixes
    params.setRelinearizeThreshold(config.relinearize_threshold)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


def _vector(pose: gtsam.Pose2) -> FloatArray:
    return np.array([pose.x(), pose.y(), pose.theta()])
