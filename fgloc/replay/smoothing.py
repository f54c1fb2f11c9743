"""Batch smoothing of a replayed run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from fgloc import se2
from fgloc.assembly import Assembly
from fgloc.graph.batch import BatchSmoother, Smoothed
from fgloc.graph.contradictions import Contradiction, as_given, smoothed_within_priors, spread
from fgloc.graph.ground import ground_at
from fgloc.graph.installation import InstallationEstimate
from fgloc.types import (
    Estimate,
    Ground,
    LandmarkMap,
)


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedRun:
    """Estimates at every keyframe, with the modes they had online, and what else came out."""

    estimates: list[Estimate]
    landmarks: LandmarkMap | None  # given or estimated
    notes: tuple[str, ...]
    installation: InstallationEstimate
    cost: float
    contradiction: Contradiction | None = None  # constants that are not used as they were found


def smooth_run(parts: Assembly) -> SmoothedRun:
    """Smooth a run that was replayed with ``keep_all``.

    Args:
        parts: the run's parts; the localizer's log is read.

    Raises:
        EstimatorError: the graph cannot be solved.
    """
    localizer, config = parts.localizer, parts.config
    log = localizer.estimator.log
    probability = config.estimator.gate_probability
    solver, contradiction = smoothed_within_priors(log, localizer.factors, config.batch, probability)
    notes = []
    result, installed = solver.result(), solver.installed()
    if contradiction is not None:
        result.covs[:] += spread(
            result.poses, contradiction.rivals or ()
        )  # a view of `ground_covs`, where there is one
        installed = as_given(installed, localizer.factors.installation, contradiction.names)
    estimates = [
        Estimate(frame.stamp_ns, pose, se2.rotate_cov(cov + frame.added_cov, float(pose[2])), frame.mode, (), ground)
        for frame, pose, cov, ground in zip(
            solver.frames, result.poses, result.covs, _ground(solver, result), strict=True
        )
    ]
    landmarks = parts.landmark_map
    if landmarks is None and result.landmarks:
        landmarks = LandmarkMap(result.landmarks, source="estimated")
    notes.append(f"Batch: {len(estimates)} keyframes, cost {result.error:.1f}.")
    return SmoothedRun(estimates, landmarks, tuple(notes), installed, solver.cost(), contradiction)


def _ground(solver: BatchSmoother, result: Smoothed) -> Iterator[Ground | None]:
    """Of each keyframe; None: the floor is flat."""
    if result.ground is None or result.ground_covs is None:
        yield from (None for _ in solver.frames)
        return
    for frame, pose, ground, cov in zip(solver.frames, result.poses, result.ground, result.ground_covs, strict=True):
        whole = cov.copy()
        whole[:3, :3] += frame.added_cov
        found = ground_at(ground, whole, float(pose[2]))
        by_clock = frame.ground_clock_cov
        yield found if by_clock is None else replace(found, cov=found.cov + by_clock)
