"""Sightings made a little before or after a keyframe, as they would have been made at it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from fgloc import se2
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.wheels import WheelMotion
from fgloc.types import (
    CornerMeasurement,
    FloatArray,
    LandmarkMeasurement,
    MarkerPoseMeasurement,
    Step,
)


def carry(
    m: LandmarkMeasurement, motion: FloatArray, cov: FloatArray, size_m: float = 0.0, together: int = 1
) -> LandmarkMeasurement:
    """Move a sighting to the keyframe.

    Args:
        m: the sighting, as made from the base at its own time.
        motion: ``T_keyframe_then`` ``(3,)``: the base at the sighting's time, seen from the keyframe.
        cov: ``(3, 3)`` covariance of that motion (right perturbation); added to what the sighting itself has.
        size_m: side of the marker whose corners were seen.
        together: markers carried by the same motion, which share its error; only corners, which have one sigma for
            all, take account of it.
    """
    if isinstance(m, CornerMeasurement):
        x, y, yaw = motion
        T = np.eye(4)
        T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        T[:2, 3] = x, y
        camera = dataclasses.replace(m.camera, T_base_cam=T @ m.camera.T_base_cam)
        spread = _corner_variance(m, cov, size_m) * 4 * together  # four corners share it: taken for independent later
        return dataclasses.replace(m, camera=camera, sigma_px=math.sqrt(m.sigma_px**2 + spread))
    if isinstance(m, MarkerPoseMeasurement):
        pose = se2.compose(motion, m.pose)
        return dataclasses.replace(m, pose=pose, cov=se2.compose_cov(cov, m.pose, m.cov))
    x, y = m.range_m * math.cos(m.bearing_rad), m.range_m * math.sin(m.bearing_rad)
    px, py, _ = se2.compose(motion, (x, y, 0.0))
    r, bearing = math.hypot(px, py), math.atan2(py, px)
    return dataclasses.replace(
        m, range_m=r, bearing_rad=bearing, cov=m.cov + _bearing_range_cov(cov, motion, np.array([x, y]), r, bearing)
    )


def _bearing_range_cov(cov: FloatArray, motion: FloatArray, point: FloatArray, r: float, bearing: float) -> FloatArray:
    """Covariance ``(2, 2)`` (bearing, range) that an uncertain motion adds to a sighted point."""
    c, s = math.cos(motion[2]), math.sin(motion[2])
    R = np.array([[c, -s], [s, c]])
    J_point = np.column_stack([R, R @ np.array([-point[1], point[0]])])  # of motion ∘ point, by right perturbation
    cb, sb = math.cos(bearing), math.sin(bearing)
    J_polar = np.array([[-sb / r, cb / r], [cb, sb]])
    J = J_polar @ J_point
    return np.asarray(J @ cov @ J.T)


def _corner_variance(m: CornerMeasurement, cov: FloatArray, size_m: float) -> float:
    """Variance [px²] that an uncertain motion adds to a corner: by its yaw, and by its translation at the depth."""
    focal = max(m.camera.K[0, 0], m.camera.K[1, 1])
    sides = m.corners_px - np.roll(m.corners_px, 1, axis=0)
    longest_px = math.sqrt(float((sides**2).sum(axis=1).max()))  # the least foreshortened: focal * size / depth
    by_translation = 0.0 if size_m <= 0.0 else (longest_px / size_m) ** 2 * max(cov[0, 0], cov[1, 1])
    return float(focal**2 * cov[2, 2] + by_translation)


def measure_carried(
    step: Step, landmarks: LandmarkSensor, wheels: WheelMotion, sizes_m: Mapping[int, float]
) -> list[LandmarkMeasurement]:
    """All sightings of a step, as if made at its end: the wheels carry those that were made before it."""
    measured: list[LandmarkMeasurement] = []
    for event in step.sightings:
        found = landmarks.measure(event)
        if found and event.stamp_ns != step.stamp_ns:
            motion, cov = wheels.carry(step, step.stamp_ns, event.stamp_ns)
            found = tuple(carry(m, motion, cov, sizes_m.get(m.landmark_id, 0.0), len(found)) for m in found)
        measured.extend(found)
    return measured
