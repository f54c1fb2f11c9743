"""Batch smoothing of a replayed run: the graph is solved, what depends on the solution is measured again, and so on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fgloc import se2
from fgloc.assembly import Assembly
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.installation import InstallationEstimate
from fgloc.types import (
    Estimate,
    FloatArray,
    IntArray,
    LandmarkMap,
    MotionMeasurement,
)

_VELOCITY_WINDOW_S = 0.5  # velocities of the smoothed trajectory are differences over this long


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedRun:
    """Estimates at every keyframe, with the modes they had online, and what else came out."""

    estimates: list[Estimate]
    landmarks: LandmarkMap | None  # given or estimated
    notes: tuple[str, ...]
    installation: InstallationEstimate
    cost: float


def smooth_run(parts: Assembly) -> SmoothedRun:
    """Smooth a run that was replayed with ``keep_all``.

    Args:
        parts: the run's parts; the localizer's log is read, and its motions are replaced.

    Raises:
        EstimatorError: the graph cannot be solved.
    """
    localizer, config = parts.localizer, parts.config
    log = localizer.estimator.log
    solver = BatchSmoother(log, localizer.factors, config.batch, config.estimator.gate_probability)
    if parts.learned is not None and parts.learned.reads_velocity:
        for _ in range(config.batch.outer_iterations - 1):
            solver.replace_motions(_measure_again(parts, solver))
    notes = []
    result = solver.result()
    estimates = [
        Estimate(frame.stamp_ns, pose, se2.rotate_cov(cov + frame.added_cov, float(pose[2])), frame.mode)
        for frame, pose, cov in zip(solver.frames, result.poses, result.covs, strict=True)
    ]
    landmarks = parts.landmark_map
    if landmarks is None and result.landmarks:
        landmarks = LandmarkMap(result.landmarks, source="estimated")
    notes.append(f"Batch: {len(estimates)} keyframes, cost {result.error:.1f}.")
    return SmoothedRun(estimates, landmarks, tuple(notes), solver.installed(), solver.cost())


def _measure_again(parts: Assembly, solver: BatchSmoother) -> dict[int, tuple[MotionMeasurement, ...]]:
    """Evaluate the learned motion at the velocities of the smoothed trajectory."""
    stamps, poses = solver.stamps_ns(), solver.poses()
    starts = [i for i, frame in enumerate(solver.frames) if frame.prior is not None]
    sources, again = parts.localizer.motion.sources, {}
    for start, end in pairwise([*starts, len(stamps)]):  # no motion leads from one stretch to the next
        velocities = smoothed_velocities(stamps[start:end], poses[start:end])
        for frame, velocity in zip(solver.frames[start + 1 : end], velocities[1:], strict=True):
            if frame.step is None:
                continue
            readings = sources.read_again(frame.readings, frame.step, velocity)
            if motions := frame.budget.combine(readings, sources.rules):
                again[frame.k] = tuple(motions)
    return again


def smoothed_velocities(stamps_ns: IntArray, poses: FloatArray) -> FloatArray:
    """Body velocity ``(n, 2)`` (forward [m/s], yaw rate [rad/s]) at the *start* of each keyframe's step."""
    half = round(0.5e9 * _VELOCITY_WINDOW_S)
    at = np.concatenate([stamps_ns[:1], stamps_ns[:-1]])
    before = np.clip(at - half, stamps_ns[0], stamps_ns[-1])
    after = np.clip(at + half, stamps_ns[0], stamps_ns[-1])
    span = np.maximum((after - before) * 1e-9, 1e-3)
    start = se2.interpolate(stamps_ns, poses, before)
    end = se2.interpolate(stamps_ns, poses, after)
    tangents = np.array([se2.log(se2.between(a, b)) for a, b in zip(start, end, strict=True)])
    return np.asarray(tangents[:, [0, 2]] / span[:, None])
