"""Pairs of estimated and true poses at the same times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fgloc import se2
from fgloc.errors import TrajectoryError
from fgloc.types import FloatArray, IntArray, Trajectory

FEWEST = 2  # matched poses; one cannot be aligned, and is no trajectory
_TRUTH = np.diag([0.005, 0.005, 0.01]) ** 2  # m², rad²: no positioning system, brought to other stamps, knows better
_ROUNDS = 10  # of Gauss-Newton; the problem is linear but for one angle


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """An estimate and a truth at the same stamps, both in the map frame."""

    stamps_ns: IntArray  # (n,)
    estimate: FloatArray  # (n, 3)
    truth: FloatArray  # (n, 3)
    covs: FloatArray | None  # (n, 3, 3) of the estimate
    T_map_truth: FloatArray  # (3,) how the truth was moved; zeros if it was not
    ground: FloatArray | None = None  # (n, 3) estimated height, roll and pitch; None: the floor is flat
    true_ground: FloatArray | None = None  # (n, 3); None: not known
    ground_covs: FloatArray | None = None  # (n, 6, 6) of x, y, z, roll, pitch, yaw

    @property
    def spatial_errors(self) -> FloatArray | None:
        """``(n, 6)`` estimate minus truth of x, y, z [m], roll, pitch and yaw; None where they were not estimated."""
        if self.ground is None or self.true_ground is None:
            return None
        planar, off = self.errors, self.ground - self.true_ground
        return np.column_stack(
            [planar[:, :2], off[:, 0], se2.wrap_array(off[:, 1]), se2.wrap_array(off[:, 2]), planar[:, 2]]
        )

    @property
    def errors(self) -> FloatArray:
        """``(n, 3)`` estimate minus truth: x, y [m] and wrapped yaw [rad]."""
        difference = self.estimate - self.truth
        difference[:, 2] = se2.wrap_array(difference[:, 2])
        return difference

    @property
    def distances(self) -> FloatArray:
        """``(n,)`` distance from the truth [m]."""
        return np.asarray(np.hypot(*(self.estimate - self.truth)[:, :2].T))


def match(
    estimate: Trajectory, truth: Trajectory, align: Literal["none", "se2"] = "none", max_gap_s: float = 0.2
) -> Matched:
    """Bring the truth to the estimate's stamps and, if asked, into its frame.

    Equal stamps match exactly; between two stamps of the truth no further apart than `max_gap_s` the truth is
    interpolated; elsewhere the estimate has no partner and is left out.

    Raises:
        TrajectoryError: fewer than two poses have a partner.
    """
    indices = matchable(estimate, truth, max_gap_s)
    if len(indices) < FEWEST:
        raise TrajectoryError(
            f"{len(indices)} of {len(estimate)} poses have a truth at their time, expected {FEWEST} or more: the "
            f"estimate spans {_span(estimate)}, the truth {_span(truth)}, gaps over {max_gap_s} s are not bridged; "
            "check the clocks, or raise the largest gap"
        )
    stamps = estimate.stamps_ns[indices]
    poses = estimate.poses[indices]
    reference = se2.interpolate(truth.stamps_ns, truth.poses, stamps)
    T_map_truth = np.zeros(3)
    if align == "se2":
        T_map_truth = se2.rigid(reference[:, :2], poses[:, :2])
        reference = se2.compose_array(T_map_truth, reference)
    covs = None if estimate.covs is None else estimate.covs[indices]
    if estimate.ground is None or estimate.ground_covs is None or truth.ground is None or align == "se2":
        return Matched(stamps, poses, reference, covs, T_map_truth)
    true = np.column_stack([np.interp(stamps, truth.stamps_ns, column) for column in truth.ground.T])
    ground, spatial = estimate.ground[indices], estimate.ground_covs[indices]
    return Matched(stamps, poses, reference, covs, T_map_truth, ground, true, spatial)


def in_own_gauge(matched: Matched) -> tuple[FloatArray, FloatArray]:
    """Errors ``(n, 3)`` and their covariances ``(n, 3, 3)`` where the truth's frame is fitted.

    Without a map the covariance is relative to the first pose, which is the origin, while a frame that is fitted to all
    positions alike spreads the drift over the whole path. So the frame is fitted by the covariances: weighted least
    squares over its rigid motion, the truth's own noise added.
    """
    assert matched.covs is not None
    covs = matched.covs + _TRUTH
    weights, truth = np.linalg.inv(covs), matched.truth
    errors = matched.errors
    for _ in range(_ROUNDS):
        J = np.zeros((len(truth), 3, 3))  # of the moved truth by x, y and yaw of the frame
        J[:] = np.eye(3)
        J[:, 0, 2], J[:, 1, 2] = -truth[:, 1], truth[:, 0]
        H, b = np.einsum("nij,nik,nkl->jl", J, weights, J), np.einsum("nij,nik,nk->j", J, weights, errors)
        step = np.linalg.lstsq(H, b, rcond=None)[0]
        truth = se2.compose_array(step, truth)
        errors = matched.estimate - truth
        errors[:, 2] = se2.wrap_array(errors[:, 2])
        if float(np.abs(step).max()) < 1e-9:
            break
    return errors, covs


def matchable(estimate: Trajectory, truth: Trajectory, max_gap_s: float) -> IntArray:
    """Indices of the estimate's poses that have a truth at, or around, their stamp."""
    if len(estimate) == 0 or len(truth) == 0:
        return np.array([], dtype=np.int64)
    after = np.searchsorted(truth.stamps_ns, estimate.stamps_ns)
    inside = np.clip(after, 0, len(truth) - 1)
    exact = truth.stamps_ns[inside] == estimate.stamps_ns
    between = (after > 0) & (after < len(truth))
    gap_ns = truth.stamps_ns[inside] - truth.stamps_ns[np.maximum(inside - 1, 0)]
    return np.asarray(np.flatnonzero(exact | (between & (gap_ns <= round(max_gap_s * 1e9)))))


def _span(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return "nothing"
    first, last = trajectory.stamps_ns[[0, -1]].tolist()
    return f"{first * 1e-9:.3f} to {last * 1e-9:.3f} s"
