"""The two smoothers of GTSAM behind one interface: a fixed lag, and the whole run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import gtsam
import numpy as np
from scipy.linalg.lapack import dpotri

from fgloc.config import EstimatorConfig
from fgloc.graph.factors import (
    INSTALLATION,
    pose_key,
)
from fgloc.graph.ground import ground_key
from fgloc.graph.installation import GROUND, InstallationEstimate
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.types import (
    FloatArray,
)

_NEVER = 1e9


class Backend(Protocol):
    """What `IncrementalEstimator` needs of a smoother."""

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, elapsed_s: float) -> list[int]:
        """Add a keyframe; the slots of its factors, in their order."""

    def swap(self, graph: gtsam.NonlinearFactorGraph, slots: list[int]) -> list[int]:
        """Put factors in the place of those in these slots; their own slots."""

    def hold(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """Add factors of what is there already."""

    def holds(self, k: int) -> bool:
        """Whether a keyframe is in the window."""

    def pose(self, k: int) -> FloatArray:
        """Estimated pose ``(3,)`` of a keyframe."""
        ...

    def belief(self, k: int, n: int, ground: bool = False) -> PoseWithCovariance:
        """Pose of a keyframe with an installation of ``n`` parameters, and their joint covariance.

        ``ground``: the installation ends with height, roll and pitch of the keyframe.
        """


class FixedLag:
    """``IncrementalFixedLagSmoother`` over poses, and the installation, which never leaves the window."""

    def __init__(self, config: EstimatorConfig, installed: int, careful: bool = False) -> None:
        self._smoother = gtsam.IncrementalFixedLagSmoother(config.lag_s, isam2_params(config, installed, careful))
        self._installed = False

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, elapsed_s: float) -> list[int]:
        """Add a keyframe."""
        stamps = dict.fromkeys(values.keys(), elapsed_s)
        self._installed |= INSTALLATION in stamps
        if self._installed:
            stamps[INSTALLATION] = elapsed_s
        self._smoother.update(graph, values, stamps)  # type: ignore[arg-type]
        return list(self._smoother.getISAM2Result().getNewFactorsIndices())

    def swap(self, graph: gtsam.NonlinearFactorGraph, slots: list[int]) -> list[int]:
        """Put factors in the place of others."""
        self._smoother.update(graph, gtsam.Values(), {}, slots)
        return list(self._smoother.getISAM2Result().getNewFactorsIndices())

    def hold(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """Add factors of what is there already."""
        self._smoother.update(graph, gtsam.Values(), {})

    def holds(self, k: int) -> bool:
        """Whether a keyframe is in the window."""
        return bool(self._smoother.getISAM2().valueExists(pose_key(k)))

    def pose(self, k: int) -> FloatArray:
        """Estimated pose of a keyframe."""
        return pose_vector(self._smoother.calculateEstimatePose2(pose_key(k)))

    def belief(self, k: int, n: int, ground: bool = False) -> PoseWithCovariance:
        """Pose and installation with their joint covariance."""
        pose = self.pose(k)
        if ground:
            return _joint_on_ground(self._smoother.getISAM2(), pose, self._smoother.calculateEstimateVector, k, n)
        if not n:
            return PoseWithCovariance(pose, np.asarray(self._smoother.marginalCovariance(pose_key(k))))
        return _joint(self._smoother.getISAM2(), pose, self._smoother.calculateEstimateVector(INSTALLATION), k)


class WholeRun:
    """``ISAM2`` over the whole run: landmarks may be variables; the cost grows with the run."""

    def __init__(self, config: EstimatorConfig, careful: bool = False) -> None:
        self._isam2 = gtsam.ISAM2(isam2_params(config, careful=careful))

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, elapsed_s: float) -> list[int]:
        """Add a keyframe."""
        return list(self._isam2.update(graph, values).getNewFactorsIndices())

    def swap(self, graph: gtsam.NonlinearFactorGraph, slots: list[int]) -> list[int]:
        """Put factors in the place of others."""
        return list(self._isam2.update(graph, gtsam.Values(), slots).getNewFactorsIndices())

    def hold(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """Add factors of what is there already."""
        self._isam2.update(graph, gtsam.Values())

    def holds(self, k: int) -> bool:
        """Whether a keyframe is in the window."""
        return bool(self._isam2.valueExists(pose_key(k)))

    def pose(self, k: int) -> FloatArray:
        """Estimated pose of a keyframe."""
        return pose_vector(self._isam2.calculateEstimatePose2(pose_key(k)))

    def belief(self, k: int, n: int, ground: bool = False) -> PoseWithCovariance:
        """Pose and installation with their joint covariance."""
        pose = self.pose(k)
        if ground:
            return _joint_on_ground(self._isam2, pose, self._isam2.calculateEstimateVector, k, n)
        if not n:
            return PoseWithCovariance(pose, np.asarray(self._isam2.marginalCovariance(pose_key(k))))
        return _joint(self._isam2, pose, self._isam2.calculateEstimateVector(INSTALLATION), k)


def _joint(isam2: gtsam.ISAM2, pose: FloatArray, theta: FloatArray, k: int) -> PoseWithCovariance:
    """Pose and installation with their joint covariance, of its square-root information: (RᵀR)⁻¹."""
    R, _ = isam2.jointBayesNet(pose_key(k), INSTALLATION).matrix()
    upper, failed = dpotri(R)
    if failed:
        raise RuntimeError("the joint information of pose and installation is singular")
    upper = np.triu(upper)
    P = upper + np.triu(upper, 1).T
    return PoseWithCovariance(pose, P[:3, :3], P[:3, 3:], InstallationEstimate(np.asarray(theta), P[3:, 3:]))


def _joint_on_ground(
    isam2: gtsam.ISAM2, pose: FloatArray, estimate: Callable[[int], FloatArray], k: int, n: int
) -> PoseWithCovariance:
    """As `_joint`, where the installation ends with the ground's height, roll and pitch at the keyframe."""
    keys = [pose_key(k), *([INSTALLATION] if n > len(GROUND) else []), ground_key(k)]
    found = isam2.jointMarginalCovariance(keys)
    P = np.block([[np.asarray(found.at(a, b)) for b in keys] for a in keys])
    known = InstallationEstimate(np.concatenate([np.asarray(estimate(key)) for key in keys[1:]]), P[3:, 3:])
    return PoseWithCovariance(pose, P[:3, :3], P[:3, 3:], known)


def isam2_params(config: EstimatorConfig, installed: int = 0, careful: bool = False) -> gtsam.ISAM2Params:
    """iSAM2 settings that every backend shares; see gtsam's defaults for the rest.

    Args:
        config: for the threshold.
        installed: parameters of the installation, in which all factors are linear: relinearizing gives the same.
        careful: by QR; Cholesky takes a third of its time, but fails where sigmas are metres apart from millimetres:
            at a first pose that is hardly known, and after minutes without a fix.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR" if careful else "CHOLESKY")
    if installed:
        thresholds = gtsam.ISAM2ThresholdMap()
        thresholds.insert(("x", np.full(3, config.relinearize_threshold)))
        thresholds.insert(("i", np.full(installed, _NEVER)))
        thresholds.insert(("g", np.full(len(GROUND), _NEVER)))
        params.setRelinearizeThreshold(thresholds)
    else:
        params.setRelinearizeThreshold(config.relinearize_threshold)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


def pose_vector(pose: gtsam.Pose2) -> FloatArray:
    """A pose as ``(3,)``."""
    return np.array([pose.x(), pose.y(), pose.theta()])
