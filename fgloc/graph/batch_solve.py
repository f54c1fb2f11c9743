"""Parts of the batch solution that need no state: initial values, a deep stack, landmarks that came out."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import gtsam
import numpy as np

from fgloc import se2
from fgloc.errors import EstimatorError
from fgloc.graph.factors import (
    INSTALLATION,
    LandmarkFactors,
    landmark_key,
    pose_key,
)
from fgloc.graph.ground import ground_key
from fgloc.graph.measurement_log import Keyframe, LandmarkFactor
from fgloc.types import (
    FloatArray,
    FrameMeasurement,
    Landmark,
    PointMeasurement,
)

_DEEP_STACK_BYTES = 1 << 30  # of address space; only what is used is taken

_T = TypeVar("_T")


def solvable(work: Callable[[], _T]) -> _T:
    """Do what needs the graph's covariances.

    Raises:
        EstimatorError: the graph leaves a pose undetermined.
    """
    try:
        return work()
    except RuntimeError as error:
        why = str(error).strip().partition("\n\n")[0].replace("\n", " ")  # what follows is advice on GTSAM's use
        raise EstimatorError(f"the covariances of the batch cannot be had: {why}") from error


def with_deep_stack(work: Callable[[], _T]) -> _T:
    """Run in a thread of its own: GTSAM's elimination of a chain of 1e5 poses overflows the usual 8 MB of stack."""
    before = threading.stack_size(_DEEP_STACK_BYTES)
    try:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(work).result()
    finally:
        threading.stack_size(before)


def initial_values(
    frames: list[Keyframe], accepted: Mapping[int, tuple[LandmarkFactor, ...]], factors: LandmarkFactors
) -> gtsam.Values:
    """Where the batch starts: poses, landmarks and installation as the incremental estimator has them."""
    values = gtsam.Values()
    for frame in frames:
        values.insert(pose_key(frame.k), gtsam.Pose2(*frame.belief.pose))
        if frame.ground is not None:
            values.insert(ground_key(frame.k), frame.ground)
    if factors.installation.constants:
        values.insert(INSTALLATION, factors.estimated.mean[: factors.installation.constants])
    if factors.known:
        return values
    seen: dict[int, list[FloatArray]] = {}
    for frame in frames:
        for sighting in accepted[frame.k]:
            m = sighting.measurement
            if isinstance(m, FrameMeasurement):
                seen.setdefault(m.landmark_id, []).append(se2.compose(frame.belief.pose, m.pose))
            elif isinstance(m, PointMeasurement):
                local = [m.range_m * np.cos(m.bearing_rad), m.range_m * np.sin(m.bearing_rad), 0.0]
                seen.setdefault(m.landmark_id, []).append(se2.compose(frame.belief.pose, local)[:2])
    for landmark_id, places in seen.items():
        middle = places[int(np.argsort([p[0] for p in places])[len(places) // 2])]  # one of them: yaw has no median
        value = middle if len(middle) == 2 else gtsam.Pose2(*middle)
        values.insert(landmark_key(landmark_id), value)
    return values


def without_orphans(values: gtsam.Values, graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """Values of the keys that the graph still mentions."""
    kept, mentioned = gtsam.Values(values), set(graph.keyVector())
    for key in values.keys():  # noqa: SIM118 (gtsam.Values is not iterable)
        if key not in mentioned:
            kept.erase(key)
    return kept


def estimated_landmarks(
    accepted: Mapping[int, tuple[LandmarkFactor, ...]], values: gtsam.Values, marginals: gtsam.Marginals | gtsam.ISAM2
) -> dict[int, Landmark]:
    """Landmarks that were variables, with their covariance."""
    landmarks = {}
    for m in (s.measurement for sightings in accepted.values() for s in sightings):
        key = landmark_key(m.landmark_id)
        if m.landmark_id in landmarks:
            continue
        cov = np.asarray(marginals.marginalCovariance(key))
        if isinstance(m, FrameMeasurement):
            pose = values.atPose2(key)
            place, yaw = np.array([pose.x(), pose.y(), 0.0]), pose.theta()
            c, s = np.cos(yaw), np.sin(yaw)
            rotation = np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])  # a standing marker, normal at this yaw
            cov = se2.rotate_cov(cov, yaw)[:2, :2]
        else:
            place, rotation = np.array([*values.atPoint2(key), 0.0]), np.eye(3)
        landmarks[m.landmark_id] = Landmark(m.landmark_id, place, rotation, 0.0, cov)
    return dict(sorted(landmarks.items()))
