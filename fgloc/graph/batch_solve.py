"""Parts of the batch solution that need no state: initial values, the order of elimination, a deep stack."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeAlias, TypeVar

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
from fgloc.graph.joint import fuse
from fgloc.graph.measurement_log import Keyframe, LandmarkFactor
from fgloc.types import (
    FloatArray,
    FrameMeasurement,
    Landmark,
    PointMeasurement,
)

_DEEP_STACK_BYTES = 1 << 30  # of address space; only what is used is taken

_KEYFRAMES_KEPT = 200  # whose separators GTSAM may keep: the way to the root, found again, is a twentieth of their cost

Solved: TypeAlias = gtsam.GaussianBayesTree | gtsam.Marginals | gtsam.ISAM2
"""What covariances are read from; the first where the order of elimination was given."""

_T = TypeVar("_T")


def with_deep_stack(work: Callable[[], _T]) -> _T:
    """Run in a thread of its own: in its own order GTSAM overflows 8 MB of stack with a chain of 1e5 poses."""
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
    return values_at(frames, [frame.belief.pose for frame in frames], accepted, factors)


def dead_reckoned(frames: Sequence[Keyframe]) -> list[FloatArray]:
    """Poses ``(3,)`` by the motions alone, from the pose that each segment begins at."""
    poses: list[FloatArray] = []
    for frame in frames:
        if frame.prior is not None or not frame.motions or not poses:
            poses.append(frame.belief.pose if frame.prior is None else frame.prior.pose)
        else:
            poses.append(se2.compose(poses[-1], fuse(frame.motions)[0]))
    return poses


def values_at(
    frames: list[Keyframe],
    poses: Sequence[FloatArray],
    accepted: Mapping[int, tuple[LandmarkFactor, ...]],
    factors: LandmarkFactors,
) -> gtsam.Values:
    """Values with these poses of the keyframes, and the landmarks where they are seen from there."""
    values = gtsam.Values()
    for frame, pose in zip(frames, poses, strict=True):
        values.insert(pose_key(frame.k), gtsam.Pose2(*pose))
        if frame.ground is not None:
            values.insert(ground_key(frame.k), frame.ground)
    if factors.installation.constants:
        values.insert(INSTALLATION, factors.estimated.mean[: factors.installation.constants])
    if factors.known:
        return values
    seen: dict[int, list[FloatArray]] = {}
    for frame, pose in zip(frames, poses, strict=True):
        for sighting in accepted[frame.k]:
            m = sighting.measurement
            if isinstance(m, FrameMeasurement):
                seen.setdefault(m.landmark_id, []).append(se2.compose(pose, m.pose))
            elif isinstance(m, PointMeasurement):
                local = [m.range_m * np.cos(m.bearing_rad), m.range_m * np.sin(m.bearing_rad), 0.0]
                seen.setdefault(m.landmark_id, []).append(se2.compose(pose, local)[:2])
    for landmark_id, places in seen.items():
        middle = places[int(np.argsort([p[0] for p in places])[len(places) // 2])]  # one of them: yaw has no median
        value = middle if len(middle) == 2 else gtsam.Pose2(*middle)
        values.insert(landmark_key(landmark_id), value)
    return values


def elimination_order(frames: Sequence[Keyframe], constants: int) -> gtsam.Ordering:
    """Keys in the order in which they are eliminated: poses by nested dissection of the chain, the installation last.

    The middle keyframe comes after both halves, and so in each half: a tree as deep as the logarithm of the length.
    GTSAM's default, COLAMD, leaves the chain in its own order. To find that, and then the roots of a tree as deep as
    the chain is long, for each factor of the installation anew, takes a time that grows with the square of the length.

    Source: George 1973, "Nested dissection of a regular finite element mesh".
    """
    ordering = gtsam.Ordering()
    parts = [(0, len(frames), False)]
    while parts:
        first, end, halves_done = parts.pop()
        middle = (first + end) // 2
        if halves_done:
            ordering.push_back(pose_key(frames[middle].k))
            if frames[middle].ground is not None:
                ordering.push_back(ground_key(frames[middle].k))
        elif first < end:
            parts += [(first, end, True), (middle + 1, end, False), (first, middle, False)]
    if constants:
        ordering.push_back(INSTALLATION)
    return ordering


def solved(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering | None) -> Solved:
    """The graph solved about these values, for its covariances; with long stretches that little determines, by QR.

    Raises:
        EstimatorError: the graph leaves a pose undetermined.
    """
    try:
        if ordering is not None:
            return graph.linearize(values).eliminateMultifrontal(ordering)
        return with_deep_stack(lambda: gtsam.Marginals(graph, values))
    except RuntimeError:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.relinearizeSkip = 1
        solver = gtsam.ISAM2(params)
    try:
        with_deep_stack(lambda: solver.update(graph, values))
    except RuntimeError as error:
        why = str(error).strip().partition("\n\n")[0].replace("\n", " ")  # what follows is advice on GTSAM's use
        raise EstimatorError(f"the covariances of the batch cannot be had: {why}") from error
    return solver


def pose_covs(solution: Solved, frames: Sequence[Keyframe]) -> FloatArray:
    """Covariances ``(n, 3, 3)`` of the poses, right perturbation."""
    covs = np.empty((len(frames), 3, 3))
    for row, frame in enumerate(frames):
        covs[row] = solution.marginalCovariance(pose_key(frame.k))
        forget_separators(solution, row)
    return covs


def forget_separators(solution: Solved, row: int) -> None:
    """After every so many keyframes: what GTSAM has kept of the way from the root to those before.

    That is 14 kB a keyframe with 40 parameters of the installation, 1 MB with 360. In a tree made by nested dissection
    the way of the next keyframe is short; in the others, of GTSAM's order, it may be as long as the chain.
    """
    if row % _KEYFRAMES_KEPT == _KEYFRAMES_KEPT - 1 and isinstance(solution, gtsam.GaussianBayesTree):
        solution.deleteCachedShortcuts()


def without_orphans(values: gtsam.Values, graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """Values of the keys that the graph still mentions."""
    kept, mentioned = gtsam.Values(values), set(graph.keyVector())
    for key in values.keys():  # noqa: SIM118 (gtsam.Values is not iterable)
        if key not in mentioned:
            kept.erase(key)
    return kept


def estimated_landmarks(
    accepted: Mapping[int, tuple[LandmarkFactor, ...]],
    values: gtsam.Values,
    marginals: Solved,
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
