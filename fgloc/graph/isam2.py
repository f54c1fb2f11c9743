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
from fgloc.graph.estimator import Estimator
from fgloc.graph.factors import LandmarkFactors, landmark_key, motion_factor, pose_key, prior_factor
from fgloc.graph.measurement_log import Belief, Keyframe
from fgloc.graph.pose_fit import likeliest
from fgloc.types import (
    FloatArray,
    LandmarkMeasurement,
    MarkerPoseMeasurement,
    RangeBearingMeasurement,
)

_GTSAM_ERRORS = (RuntimeError, IndexError, ValueError)
_MARGIN_S = 1e-3  # a keyframe this near to the end of the window may be gone


class _Backend(Protocol):
    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int, elapsed_s: float) -> list[int]:
        """Add a keyframe; the slots of its factors, in their order."""

    def swap(self, graph: gtsam.NonlinearFactorGraph, slots: list[int]) -> list[int]:
        """Put factors in the place of those in these slots; their own slots."""

    def pose(self, k: int) -> FloatArray: ...
    def covariance(self, k: int) -> FloatArray: ...


class _FixedLag:
    """``IncrementalFixedLagSmoother`` over poses."""

    def __init__(self, config: EstimatorConfig) -> None:
        self._smoother = gtsam.IncrementalFixedLagSmoother(config.lag_s, isam2_params(config))

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int, elapsed_s: float) -> list[int]:
        self._smoother.update(graph, values, dict.fromkeys(values.keys(), elapsed_s))
        return list(self._smoother.getISAM2Result().getNewFactorsIndices())

    def swap(self, graph: gtsam.NonlinearFactorGraph, slots: list[int]) -> list[int]:
        self._smoother.update(graph, gtsam.Values(), {}, slots)
        return list(self._smoother.getISAM2Result().getNewFactorsIndices())

    def pose(self, k: int) -> FloatArray:
        return _vector(self._smoother.calculateEstimatePose2(pose_key(k)))

    def covariance(self, k: int) -> FloatArray:
        return np.asarray(self._smoother.marginalCovariance(pose_key(k)))


class _Full:
    """``ISAM2`` over the whole run: landmarks may be variables; the cost grows with the run."""

    def __init__(self, config: EstimatorConfig) -> None:
        self._isam2 = gtsam.ISAM2(isam2_params(config))

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int, elapsed_s: float) -> list[int]:
        return list(self._isam2.update(graph, values).getNewFactorsIndices())

    def swap(self, graph: gtsam.NonlinearFactorGraph, slots: list[int]) -> list[int]:
        return list(self._isam2.update(graph, gtsam.Values(), slots).getNewFactorsIndices())

    def pose(self, k: int) -> FloatArray:
        return _vector(self._isam2.calculateEstimatePose2(pose_key(k)))

    def covariance(self, k: int) -> FloatArray:
        return np.asarray(self._isam2.marginalCovariance(pose_key(k)))


class IncrementalEstimator(Estimator):
    """The factor graph of the window, or of the run, kept solved."""

    def __init__(self, config: EstimatorConfig, factors: LandmarkFactors, keep_all: bool = False) -> None:
        super().__init__(config, factors, keep_all)
        self._backend: _Backend | None = None
        self._landmarks: dict[int, FloatArray] = {}  # initial values of the variables in the graph
        self._slots: dict[int, tuple[float, list[int]]] = {}  # keyframe -> elapsed_s, slots of its motion factors

    def _solve(self, frame: Keyframe) -> None:
        if self._backend is None or (frame.prior is not None and self._config.kind == "fixed_lag"):
            self._backend = self._new_backend()
            self._slots.clear()
        backend = self._backend
        initial = likeliest(frame.k, frame.belief, frame.sightings, self._factors)
        try:
            graph, values = self._graph_of(frame, initial, frame.prior)
            self._keep_slots(frame, backend.update(graph, values, frame.k, frame.elapsed_s))
            belief = Belief(backend.pose(frame.k), backend.covariance(frame.k))
            if not (math.isfinite(belief.pose[2]) and math.isfinite(belief.cov[0, 0])):
                raise ValueError("estimate is not finite")
            frame.belief = belief
        except _GTSAM_ERRORS:
            self._rebuild(frame, initial)

    def _solve_again(self, changed: Sequence[int]) -> None:
        """Swap the motion factors of these keyframes, as far as the window holds them."""
        backend = self._backend
        if backend is None:
            return
        frames = [self.log.keyframes[k] for k in changed if k in self._slots]
        newest = self.log.keyframes[self._k]
        graph, slots = gtsam.NonlinearFactorGraph(), []
        for frame in frames:
            slots += self._slots[frame.k][1]
            for motion in frame.motions:
                graph.add(motion_factor(frame.k, motion, self._config.motion_kernel))
        try:
            new = backend.swap(graph, slots) if frames else []
            newest.belief = Belief(backend.pose(newest.k), backend.covariance(newest.k))
        except _GTSAM_ERRORS:
            self.rebuilt += 1
            self._build_again(changed)
            return
        for frame in frames:
            held, new = new[: len(frame.motions)], new[len(frame.motions) :]
            self._slots[frame.k] = frame.elapsed_s, held

    def _begin_at(self, newest: Keyframe) -> None:
        if self._config.kind == "fixed_lag":
            newest.belief = self._replayed([newest], newest.belief.pose)
        else:
            self._build_again([newest.k])

    def _build_again(self, changed: Sequence[int]) -> None:
        newest = self.log.keyframes[self._k]
        initial = newest.belief.pose
        try:
            newest.belief = self._replayed(self._window(newest) or [newest], initial)
        except _GTSAM_ERRORS:  # what the window knew is in the belief
            self.rebuilt += 1
            newest.belief = self._replayed([newest], initial)

    def _keep_slots(self, frame: Keyframe, slots: Sequence[int], prior: Belief | None = None) -> None:
        """Remember where the motion factors of a keyframe are, while both of their poses are in the window."""
        if frame.prior is None and prior is None:
            self._slots[frame.k] = frame.elapsed_s, list(slots[: len(frame.motions)])
        if self._config.kind == "fixed_lag":
            horizon = frame.elapsed_s - self._config.lag_s
            while self._slots:
                oldest = next(iter(self._slots))
                before = self.log.keyframes.get(oldest - 1)
                if before is not None and before.elapsed_s > horizon + _MARGIN_S:
                    break
                if oldest == frame.k:
                    break
                del self._slots[oldest]

    def _window(self, frame: Keyframe) -> list[Keyframe]:
        """Logged keyframes that are in the window together with this one: of its segment, unless all are kept."""
        if self._config.kind != "fixed_lag":
            return list(self.log.keyframes.values())
        if frame.prior is not None:
            return []
        frames = [f for f in self.log.since(frame.elapsed_s - self._config.lag_s) if f.k >= self._corrected]
        starts = [i for i, f in enumerate(frames) if f.prior is not None]
        return frames[starts[-1] :] if starts else frames

    def _graph_of(
        self, frame: Keyframe, initial: FloatArray, prior: Belief | None
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(pose_key(frame.k), gtsam.Pose2(*initial))
        if prior is not None:
            graph.add(prior_factor(frame.k, prior.pose, prior.cov))
        else:
            for motion in frame.motions:
                graph.add(motion_factor(frame.k, motion, self._config.motion_kernel))
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
        try:
            frame.belief = self._replayed([*self._window(frame), frame], initial)
        except _GTSAM_ERRORS:  # an older sighting is at fault; what the window knew is in the prediction
            frame.belief = self._replayed([frame], initial)

    def _replayed(self, frames: Sequence[Keyframe], initial: FloatArray) -> Belief:
        """Give these keyframes to a new backend; the belief of the last, whose pose starts at ``initial``."""
        self._backend = backend = self._new_backend()
        self._landmarks.clear()
        self._slots.clear()
        newest = frames[-1].k
        for i, held in enumerate(frames):
            prior = held.prior
            if i == 0 and prior is None:  # its belief holds its sightings already
                prior, held = held.belief, dataclasses.replace(held, sightings=())
            graph, values = self._graph_of(held, initial if held.k == newest else held.belief.pose, prior)
            self._keep_slots(held, backend.update(graph, values, held.k, held.elapsed_s), prior)
        return Belief(backend.pose(newest), backend.covariance(newest))

    def _new_backend(self) -> _Backend:
        return _FixedLag(self._config) if self._config.kind == "fixed_lag" else _Full(self._config)


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
