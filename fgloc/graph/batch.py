"""The batch smoother: Levenberg–Marquardt over the whole log, started from the incremental result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from fgloc import se2
from fgloc.config import BatchConfig
from fgloc.errors import EstimatorError
from fgloc.graph.factors import LandmarkFactors, landmark_key, motion_factor, pose_key, prior_factor
from fgloc.graph.log import Keyframe, MeasurementLog, Sighting
from fgloc.graph.weights import chi2_bound
from fgloc.types import FloatArray, IntArray, Landmark, MarkerPoseMeasurement, RangeBearingMeasurement


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """The result: keyframes in order."""

    keys: tuple[int, ...]
    stamps_ns: IntArray  # (n,)
    poses: FloatArray  # (n, 3)
    covs: FloatArray  # (n, 3, 3) right perturbation (body frame)
    landmarks: Mapping[int, Landmark]  # those that were variables
    used: frozenset[tuple[int, int]]  # (keyframe, landmark) sightings that the last pass believed
    factors: int  # held by the last graph
    error: float  # its GTSAM error


def smooth(log: MeasurementLog, factors: LandmarkFactors, config: BatchConfig, gate_probability: float) -> Smoothed:
    """Smooth the whole log.

    The first pass holds every sighting, also those the online gate refused, under its robust kernel; the second drops
    those that the smoothed trajectory finds less likely than ``1 - gate_probability``.

    Args:
        log: all keyframes, with filtered beliefs as initial values.
        factors: maker of landmark factors.
        config: iterations.
        gate_probability: of the χ² gate.

    Raises:
        EstimatorError: the log is empty or the optimum is not finite.
    """
    frames = list(log.keyframes.values())
    if not frames:
        raise EstimatorError("nothing to smooth: no keyframe was made; see the notes and the rejections of the run")
    believed = {frame.k: (*frame.sightings, *frame.refused) for frame in frames}
    values = _initial(frames, believed, factors)
    graph = _graph(frames, believed)
    values = _optimize(graph, values, config.max_iterations)
    believed = {k: _gated(k, sightings, factors, values, gate_probability) for k, sightings in believed.items()}
    graph = _graph(frames, believed)
    values = _optimize(graph, _without_orphans(values, graph), config.max_iterations)
    return _result(frames, believed, factors, graph, values)


def _graph(frames: list[Keyframe], believed: Mapping[int, tuple[Sighting, ...]]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for frame in frames:
        if frame.prior is not None:
            graph.add(prior_factor(frame.k, frame.prior.pose, frame.prior.cov))
        for motion in frame.motions:
            graph.add(motion_factor(frame.k, motion))
        for sighting in believed[frame.k]:
            for factor in sighting.factors:
                graph.add(factor)
    return graph


def _initial(
    frames: list[Keyframe], believed: Mapping[int, tuple[Sighting, ...]], factors: LandmarkFactors
) -> gtsam.Values:
    values = gtsam.Values()
    for frame in frames:
        values.insert(pose_key(frame.k), gtsam.Pose2(*frame.belief.pose))
    if factors.known:
        return values
    seen: dict[int, list[FloatArray]] = {}
    for frame in frames:
        for sighting in believed[frame.k]:
            m = sighting.measurement
            if isinstance(m, MarkerPoseMeasurement):
                seen.setdefault(m.landmark_id, []).append(se2.compose(frame.belief.pose, m.pose))
            elif isinstance(m, RangeBearingMeasurement):
                local = [m.range_m * np.cos(m.bearing_rad), m.range_m * np.sin(m.bearing_rad), 0.0]
                seen.setdefault(m.landmark_id, []).append(se2.compose(frame.belief.pose, local)[:2])
    for landmark_id, places in seen.items():
        middle = places[int(np.argsort([p[0] for p in places])[len(places) // 2])]  # one of them: yaw has no median
        value = middle if len(middle) == 2 else gtsam.Pose2(*middle)
        values.insert(landmark_key(landmark_id), value)
    return values


def _without_orphans(values: gtsam.Values, graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """Values of the keys that the graph still mentions."""
    kept, mentioned = gtsam.Values(values), set(graph.keyVector())
    for key in values.keys():  # noqa: SIM118 (gtsam.Values is not iterable)
        if key not in mentioned:
            kept.erase(key)
    return kept


def _optimize(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, iterations: int) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setLinearSolverType("SEQUENTIAL_CHOLESKY")  # the multifrontal one overflows the stack on long chains
    params.setRelativeErrorTol(1e-7)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    if not np.isfinite(graph.error(result)):
        raise EstimatorError("the batch optimum is not finite; look at steps.csv for the sighting that broke it")
    return result


def _gated(
    k: int, sightings: tuple[Sighting, ...], factors: LandmarkFactors, values: gtsam.Values, probability: float
) -> tuple[Sighting, ...]:
    kept = []
    for sighting in sightings:
        made = factors.make(k, sighting.measurement, None)
        nis = sum(2.0 * factor.error(values) for factor in made)
        if nis <= chi2_bound(probability, sum(factor.dim() for factor in made)):
            kept.append(sighting)
    return tuple(kept)


def _result(
    frames: list[Keyframe],
    believed: Mapping[int, tuple[Sighting, ...]],
    factors: LandmarkFactors,
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
) -> Smoothed:
    marginals = gtsam.Marginals(graph, values)
    poses, covs = np.empty((len(frames), 3)), np.empty((len(frames), 3, 3))
    for i, frame in enumerate(frames):
        pose = values.atPose2(pose_key(frame.k))
        poses[i] = pose.x(), pose.y(), pose.theta()
        covs[i] = marginals.marginalCovariance(pose_key(frame.k))
    return Smoothed(
        keys=tuple(frame.k for frame in frames),
        stamps_ns=np.array([frame.stamp_ns for frame in frames], dtype=np.int64),
        poses=poses,
        covs=covs,
        landmarks={} if factors.known else _landmarks(believed, values, marginals),
        used=frozenset((k, s.measurement.landmark_id) for k, sightings in believed.items() for s in sightings),
        factors=graph.size(),
        error=graph.error(values),
    )


def _landmarks(
    believed: Mapping[int, tuple[Sighting, ...]], values: gtsam.Values, marginals: gtsam.Marginals
) -> dict[int, Landmark]:
    landmarks = {}
    for m in (s.measurement for sightings in believed.values() for s in sightings):
        key = landmark_key(m.landmark_id)
        if m.landmark_id in landmarks:
            continue
        cov = np.asarray(marginals.marginalCovariance(key))
        if isinstance(m, MarkerPoseMeasurement):
            pose = values.atPose2(key)
            place, yaw = np.array([pose.x(), pose.y(), 0.0]), pose.theta()
            c, s = np.cos(yaw), np.sin(yaw)
            rotation = np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])  # a standing marker, normal at this yaw
            cov = se2.rotate_cov(cov, yaw)[:2, :2]
        else:
            place, rotation = np.array([*values.atPoint2(key), 0.0]), np.eye(3)
        landmarks[m.landmark_id] = Landmark(m.landmark_id, place, rotation, 0.0, cov)
    return dict(sorted(landmarks.items()))
