"""The textbook's smoother: odometry and sightings, constant noise, Huber's kernel, Levenberg–Marquardt.

It has no installation, no gate and no judgement: what a run is compared with, see `fgloc.diagnosis.sanity`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from fgloc.graph.batch import with_deep_stack
from fgloc.types import FloatArray, IntArray

_HUBER = 1.345  # sigmas: 95 % efficiency for Gaussian noise (Huber 1981)
_STEP_M_PER_SQRT_M, _STEP_RAD_PER_SQRT_M = 0.03, 0.03  # noise of the motion by its length ...
_STEP_RAD_PER_SQRT_RAD, _STEP_FLOOR = 0.05, 0.003  # ... by its turn, and at least [m, rad]
_MAP_M = 0.02  # sigma of a landmark's surveyed place
_START_M, _START_RAD = 100.0, 10.0  # where the run begins is not known
_MOST_ITERATIONS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Sightings ``(m,)``: pose that each belongs to, landmark, place in the base frame [m], sigma [m]."""

    pose: IntArray  # (m,) row of the poses
    ids: IntArray  # (m,)
    places: FloatArray  # (m, 2)
    sigmas: FloatArray  # (m,)


def textbook_poses(
    start: FloatArray, motions: FloatArray, seen: Seen, landmarks: Mapping[int, FloatArray]
) -> tuple[FloatArray, FloatArray] | None:
    """Poses ``(n, 3)`` of the textbook's smoother with covariances ``(n, 3, 3)``, right perturbation.

    Args:
        start: ``(n, 3)`` initial values.
        motions: ``(n - 1, 3)`` odometry between the poses.
        seen: all usable sightings.
        landmarks: places ``(2,)`` of the map by id.

    Returns:
        None if it does not converge to finite poses.
    """
    if not np.isfinite(start).all():
        return None
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, pose in enumerate(start):
        values.insert(k, gtsam.Pose2(*pose))
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start[0]), _sigmas(_START_M, _START_M, _START_RAD)))
    for k, motion in enumerate(motions):
        length, turn = math.hypot(motion[0], motion[1]), abs(motion[2])
        m = math.hypot(_STEP_M_PER_SQRT_M * math.sqrt(length), _STEP_FLOOR)
        rad = math.sqrt(_STEP_RAD_PER_SQRT_M**2 * length + _STEP_RAD_PER_SQRT_RAD**2 * turn + _STEP_FLOOR**2)
        graph.add(gtsam.BetweenFactorPose2(k, k + 1, gtsam.Pose2(*motion), _sigmas(m, m, rad)))
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER)
    placed: set[int] = set()
    for k, landmark_id, place, sigma in zip(
        seen.pose.tolist(), seen.ids.tolist(), seen.places, seen.sigmas, strict=True
    ):
        if landmark_id not in landmarks:
            continue
        key = gtsam.symbol("l", landmark_id)
        if landmark_id not in placed:
            placed.add(landmark_id)
            values.insert(key, landmarks[landmark_id])
            surveyed = gtsam.noiseModel.Isotropic.Sigma(2, _MAP_M)
            graph.add(gtsam.PriorFactorPoint2(key, landmarks[landmark_id], surveyed))
        distance = math.hypot(*place)
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma / max(distance, sigma), sigma]))
        robust = gtsam.noiseModel.Robust.Create(kernel, noise)
        bearing = gtsam.Rot2(math.atan2(place[1], place[0]))
        graph.add(gtsam.BearingRangeFactor2D(k, key, bearing, distance, robust))
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(_MOST_ITERATIONS)
    try:
        return with_deep_stack(lambda: _solved(graph, values, params, len(start)))
    except (RuntimeError, IndexError, ValueError):  # GTSAM's: underconstrained, or a variable ran away
        return None


def _solved(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, params: gtsam.LevenbergMarquardtParams, count: int
) -> tuple[FloatArray, FloatArray] | None:
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    poses = np.asarray(gtsam.utilities.extractPose2(solution))
    marginals = gtsam.Marginals(graph, solution)
    covs = np.array([marginals.marginalCovariance(k) for k in range(count)])
    return (poses, covs) if np.isfinite(poses).all() and np.isfinite(covs).all() else None


def _sigmas(x: float, y: float, yaw: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([x, y, yaw]))
