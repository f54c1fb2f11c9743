"""Batch smoothing of a replayed run: the graph is solved, what depends on the solution is measured again, and so on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fgloc import se2
from fgloc.assembly import Assembly
from fgloc.calibration.wheel_gains import calibrate_wheels
from fgloc.config import LandmarksConfig
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.slip_noise import Footing
from fgloc.localizer import Localizer
from fgloc.sensors.sighting_calibration import Calibration, calibration_gradient, prior, shifted
from fgloc.types import (
    Estimate,
    FloatArray,
    IntArray,
    LandmarkMap,
    MotionMeasurement,
    RangeBearingMeasurement,
    WheelCalibration,
)

_VELOCITY_WINDOW_S = 0.5  # velocities of the smoothed trajectory are differences over this long
_NUDGE = 0.005  # of log scale, and of radians: finite differences
_NEWTON_STEPS = 2


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedRun:
    """Estimates at every keyframe, with the modes they had online, and what else came out."""

    estimates: list[Estimate]
    landmarks: LandmarkMap | None  # given or estimated
    notes: tuple[str, ...]
    wheels: WheelCalibration | None


def smooth_run(parts: Assembly) -> SmoothedRun:
    """Smooth a run that was replayed with ``keep_all``.

    Args:
        parts: the run's parts; the localizer's log is read, and its motions are replaced.

    Raises:
        EstimatorError: the graph cannot be solved, or holds no wheels that could be calibrated.
    """
    localizer, config = parts.localizer, parts.config
    log, moved = localizer.estimator.log, localizer.weights.quarantine.displacements
    take_room_back(localizer)
    solver = BatchSmoother(log, localizer.factors, config.batch, config.estimator.gate_probability, moved)
    if config.batch.robust == "gnc" and solver.outliers:
        solver.replace_motions(_without(parts, solver))
    if parts.learned is not None and parts.learned.reads_velocity:
        for _ in range(config.batch.outer_iterations - 1):
            solver.replace_motions(_measure_again(parts, solver))
    notes = []
    spread = np.zeros((len(solver.frames), 3, 3))
    if localizer.calibrator is not None and parts.landmark_map is not None:
        refined = refine(solver, parts.landmark_map, config.landmarks, localizer.calibrator.calibration)
        spread = refined.pose_covs
        scale, offset = np.exp(refined.value[0]), refined.value[1]
        sigmas = np.sqrt(np.diag(refined.cov))
        notes.append(
            f"Sightings calibrated on top of the configuration: ranges x {scale:.4f} ± {sigmas[0]:.4f}, "
            f"bearings - {offset:.4f} ± {sigmas[1]:.4f} rad."
        )
    wheels = None
    if config.batch.calibrate_wheels:
        wheels = calibrate_wheels(parts, solver)
        notes.append(f"Wheels calibrated on this run: {wheels}.")
    result = solver.result()
    estimates = [
        Estimate(frame.stamp_ns, pose, se2.rotate_cov(cov, float(pose[2])), frame.mode)
        for frame, pose, cov in zip(solver.frames, result.poses, result.covs + spread, strict=True)
    ]
    landmarks = parts.landmark_map
    if landmarks is None and result.landmarks:
        landmarks = LandmarkMap(result.landmarks, source="estimated")
    notes.append(f"Batch: {len(estimates)} keyframes, {result.factors} factors, error {result.error:.1f}.")
    return SmoothedRun(estimates, landmarks, tuple(notes), wheels)


def take_room_back(localizer: Localizer) -> None:
    """Room for slides in the dark is not needed where sightings of the other end show them, too."""
    for frame in localizer.estimator.log.keyframes.values():
        if frame.footing.blind and frame.prior is None:
            frame.footing = Footing()
            frame.motions = tuple(localizer.sources.combine_again(frame)) or frame.motions


def _without(parts: Assembly, solver: BatchSmoother) -> dict[int, tuple[MotionMeasurement, ...]]:
    """Motions of the keyframes with outliers, made as if these sources had been switched off online."""
    changed = {}
    for frame in solver.frames:
        if frame.k in solver.outliers:
            frame.off = {**dict.fromkeys(solver.outliers[frame.k], "outlier"), **frame.off}
            if motions := parts.localizer.sources.combine_again(frame):
                changed[frame.k] = tuple(motions)
    return changed


def _measure_again(parts: Assembly, solver: BatchSmoother) -> dict[int, tuple[MotionMeasurement, ...]]:
    """Evaluate the learned motion at the velocities of the smoothed trajectory."""
    stamps, poses = solver.stamps_ns(), solver.poses()
    starts = [i for i, frame in enumerate(solver.frames) if frame.prior is not None]
    sources, again = parts.localizer.sources, {}
    for start, end in pairwise([*starts, len(stamps)]):  # no motion leads from one stretch to the next
        velocities = smoothed_velocities(stamps[start:end], poses[start:end])
        for frame, velocity in zip(solver.frames[start + 1 : end], velocities[1:], strict=True):
            if frame.step is None:
                continue
            readings = sources.read_again(frame.readings, frame.step, velocity)
            if motions := sources.combine_again(frame, readings):
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


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Calibration of the sightings over the whole run.

    Attributes:
        value: ``(2,)`` log range scale, bearing offset [rad].
        cov: ``(2, 2)``.
        pose_covs: ``(n, 3, 3)`` what the calibration's uncertainty adds to each pose (body frame).
    """

    value: FloatArray
    cov: FloatArray
    pose_covs: FloatArray


def refine(solver: BatchSmoother, landmark_map: LandmarkMap, config: LandmarksConfig, online: Calibration) -> Refined:
    """Newton's method on the cost that is left when the poses have been solved for, by finite differences.

    At the optimum over the poses, the derivative of the whole cost with respect to the calibration is the partial one
    (envelope theorem). Its differences between nearby calibrations give the Hessian, and the poses' differences how
    far an error of the calibration moves them.
    """
    fixed = config.range_scale_sigma == 0.0, config.bearing_bias_sigma_rad == 0.0
    free = [i for i in range(2) if not fixed[i]]
    information = np.linalg.inv(prior(config)[np.ix_(free, free)])
    value = np.zeros(2)

    def move(to: FloatArray) -> FloatArray:
        """Solve with this calibration; gradient of the profiled cost."""
        nonlocal value
        value = to
        solver.replace_sightings(lambda raw: shifted(raw, *to) if isinstance(raw, RangeBearingMeasurement) else raw)
        return gradient()

    def gradient() -> FloatArray:
        poses, seen = [], []
        for frame, pose in zip(solver.frames, solver.poses(), strict=True):
            for sighting in solver.believed[frame.k]:
                if isinstance(sighting.measurement, RangeBearingMeasurement):
                    poses.append(pose)
                    seen.append(sighting.measurement)
        partial = calibration_gradient(poses, seen, landmark_map, config.cauchy_k)
        return np.asarray(partial[free] + information @ value[free])

    # 1. Every sighting was corrected by what was known when it was made: take the last word for all
    here = move(online.value.copy())
    # 2. Hessian of the profiled cost, and derivative of the poses
    at, poses = value.copy(), solver.poses()
    hessian, slopes = np.zeros((len(free), len(free))), []
    for column, i in enumerate(free):
        nudged = at.copy()
        nudged[i] += _NUDGE
        hessian[:, column] = (move(nudged) - here) / _NUDGE
        slopes.append([se2.log(se2.between(a, b)) / _NUDGE for a, b in zip(poses, solver.poses(), strict=True)])
    hessian = 0.5 * (hessian + hessian.T)
    # 3. Newton, with that Hessian
    step = here
    for _ in range(_NEWTON_STEPS):
        at[free] -= np.linalg.solve(hessian, step)
        step = move(at.copy())
    cov = np.zeros((2, 2))
    cov[np.ix_(free, free)] = np.linalg.inv(hessian)
    J = np.array(slopes).transpose(1, 2, 0)  # (n, 3, free)
    return Refined(value, cov, J @ np.linalg.inv(hessian) @ J.transpose(0, 2, 1))
