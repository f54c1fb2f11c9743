"""Batch smoothing of a replayed run: the graph is solved, what depends on the solution is measured again, and so on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fgloc import se2
from fgloc.assembly import Assembly
from fgloc.errors import EstimatorError
from fgloc.graph.batch import Smoothed, smooth
from fgloc.types import Estimate, FloatArray, LandmarkMap, Mode, Step

_VELOCITY_WINDOW_S = 0.5  # velocities of the smoothed trajectory are differences over this long


def smooth_run(
    parts: Assembly, steps: Sequence[Step], filtered: Sequence[Estimate]
) -> tuple[list[Estimate], LandmarkMap | None, tuple[str, ...]]:
    """Smooth a run that was replayed with ``keep_all``.

    Args:
        parts: the run's parts; the localizer's log is read, and its motions are replaced.
        steps: every step of the replay, in order.
        filtered: the online estimates, whose modes are kept.

    Returns:
        Estimates at every keyframe, the map (given or estimated), and notes.
    """
    localizer, config = parts.localizer, parts.config
    log = localizer.estimator.log
    by_stamp = {step.stamp_ns: step for step in steps}
    result: Smoothed | None = None
    for _ in range(config.batch.outer_iterations if parts.learned is not None else 1):
        if result is not None:
            _measure_again(parts, by_stamp, result)
        result = smooth(log, localizer.factors, config.batch, config.estimator.gate_probability)
        for frame, pose in zip(log.keyframes.values(), result.poses, strict=True):
            frame.belief.pose = pose
    if result is None:
        raise EstimatorError("batch.outer_iterations is 0; expected at least 1")
    modes = {e.stamp_ns: e.mode for e in filtered}
    estimates = [
        Estimate(int(stamp), pose, se2.rotate_cov(cov, float(pose[2])), modes.get(int(stamp), Mode.OK))
        for stamp, pose, cov in zip(result.stamps_ns, result.poses, result.covs, strict=True)
    ]
    landmarks = parts.landmark_map
    if landmarks is None and result.landmarks:
        landmarks = LandmarkMap(result.landmarks, source="estimated")
    note = f"Batch: {len(estimates)} keyframes, {result.factors} factors, error {result.error:.1f}."
    return estimates, landmarks, (note,)


def _measure_again(parts: Assembly, steps: Mapping[int, Step], result: Smoothed) -> None:
    """Evaluate the learned motion at the velocities of the smoothed trajectory."""
    velocities = smoothed_velocities(result)
    for frame, velocity in zip(parts.localizer.estimator.log.keyframes.values(), velocities, strict=True):
        step = steps.get(frame.stamp_ns)
        if frame.prior is None and step is not None:
            motions = parts.localizer.measure_motion(step, velocity)
            frame.motions = tuple(motions) or frame.motions


def smoothed_velocities(result: Smoothed) -> FloatArray:
    """Body velocity ``(n, 2)`` (forward [m/s], yaw rate [rad/s]) at the *start* of each keyframe's step."""
    stamps = result.stamps_ns
    half = round(0.5e9 * _VELOCITY_WINDOW_S)
    at = np.concatenate([stamps[:1], stamps[:-1]])
    before = np.clip(at - half, stamps[0], stamps[-1])
    after = np.clip(at + half, stamps[0], stamps[-1])
    span = np.maximum((after - before) * 1e-9, 1e-3)
    start = se2.interpolate(stamps, result.poses, before)
    end = se2.interpolate(stamps, result.poses, after)
    tangents = np.array([se2.log(se2.between(a, b)) for a, b in zip(start, end, strict=True)])
    return np.asarray(tangents[:, [0, 2]] / span[:, None])
