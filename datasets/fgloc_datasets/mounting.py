"""Where a sensor and a positioning target sit on a robot, found from its own odometry.

A recording whose calibration nobody wrote down still tells it: a fixed landmark seen twice must be in one place, and a
rigid body's motion must be the robot's. Odometry is trusted over some seconds only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from fgloc import se2
from fgloc.errors import RecordingError
from fgloc.types import FloatArray, IntArray, Trajectory

_PAIR_S = (0.3, 6.0)  # two sightings of a landmark are compared if they are this far apart
_MOST_PAIRS = 6000
_FEWEST = 50
_POINT_SIGMA_M = 0.03
_TRUTH_GAP_S = 0.15
_WINDOW_S, _STRIDE_S = 3.0, 0.25
_MOTION_SIGMA = np.array([0.01, 0.01, 0.02])  # m, m, rad over a window


@dataclass(frozen=True, slots=True)
class Mounting:
    """Sensor in the base frame, and what its reports need.

    ``residual_m`` is the robust sigma of the disagreement, per axis, of a landmark's place between two sightings.
    """

    x: float  # m
    y: float  # m
    yaw: float  # rad
    range_scale: float  # true over reported distance
    latency_s: float  # sightings are stamped this much late
    residual_m: float


@dataclass(frozen=True, slots=True)
class Body:
    """Rigid body of a positioning system in the base frame."""

    x: float  # m
    y: float  # m
    yaw: float  # rad
    latency_s: float  # its poses are stamped this much late


def sensor_mounting(odometry: Trajectory, stamps_ns: IntArray, ids: IntArray, points: FloatArray) -> Mounting:
    """Find a sensor's place, range scale and latency from odometry and sightings of landmarks at unknown places.

    Args:
        odometry: poses of the base in the odometry frame.
        stamps_ns: ``(n,)`` times of the sightings.
        ids: ``(n,)`` landmarks.
        points: ``(n, 2)`` landmarks as seen, x ahead of the sensor and y to its left [m].

    Raises:
        RecordingError: there are too few sightings of the same landmarks.
    """
    first, second = _pairs(stamps_ns, ids)
    if len(first) < _FEWEST:
        raise RecordingError(f"{len(first)} pairs of sightings of one landmark, expected {_FEWEST} for a calibration")

    def residuals(q: FloatArray) -> FloatArray:
        a = _place(odometry, stamps_ns[first], points[first], q)
        b = _place(odometry, stamps_ns[second], points[second], q)
        return np.asarray((a - b).ravel() / _POINT_SIGMA_M)

    start = np.array([0.0, 0.0, 0.0, 1.0, 0.0])
    fit = least_squares(residuals, start, loss="cauchy", diff_step=1e-4, x_scale=[0.1, 0.1, 0.05, 0.05, 0.05])
    spread = 1.4826 * float(np.median(abs(residuals(fit.x)))) * _POINT_SIGMA_M / np.sqrt(2.0)
    x, y, yaw, scale, latency = (float(v) for v in fit.x)
    return Mounting(x, y, yaw, scale, latency, spread)


def body_mounting(odometry: Trajectory, truth: Trajectory) -> Body:
    """Find where a positioning system's rigid body sits on the robot, from the motions of both.

    Args:
        odometry: poses of the base in the odometry frame.
        truth: poses of the body in the positioning system's frame.

    Raises:
        RecordingError: too little of the truth overlaps the odometry.
    """
    span = int(_WINDOW_S * 1e9)
    begin = np.arange(odometry.stamps_ns[0], odometry.stamps_ns[-1] - span, int(_STRIDE_S * 1e9), dtype=np.int64)
    begin = begin[_covered(truth.stamps_ns, begin) & _covered(truth.stamps_ns, begin + span)]
    if len(begin) < _FEWEST:
        raise RecordingError(f"truth and odometry share {len(begin)} windows of {_WINDOW_S} s, expected {_FEWEST}")
    driven = _motions(_poses(odometry, begin), _poses(odometry, begin + span))

    def residuals(q: FloatArray) -> FloatArray:
        late = int(q[3] * 1e9)
        a = _base(_poses(truth, begin + late), q[:3])
        b = _base(_poses(truth, begin + span + late), q[:3])
        error = _motions(a, b) - driven
        error[:, 2] = se2.wrap_array(error[:, 2])
        return np.asarray((error / _MOTION_SIGMA).ravel())

    fits = [
        least_squares(residuals, [0.0, 0.0, yaw, 0.0], loss="cauchy", diff_step=1e-4, x_scale=[0.1, 0.1, 0.1, 0.05])
        for yaw in (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)
    ]
    x, y, yaw, latency = (float(v) for v in min(fits, key=lambda fit: fit.cost).x)
    return Body(x, y, se2.wrap(yaw), latency)


def _pairs(stamps_ns: IntArray, ids: IntArray) -> tuple[IntArray, IntArray]:
    """Indices of pairs of sightings of one landmark, evenly thinned out."""
    least, most = (int(s * 1e9) for s in _PAIR_S)
    found = []
    for landmark in np.unique(ids):
        own = np.flatnonzero(ids == landmark)
        own = own[np.argsort(stamps_ns[own], kind="stable")]
        at = stamps_ns[own]
        first, last = np.searchsorted(at, at + least), np.searchsorted(at, at + most, side="right")
        counts = np.maximum(last - first, 0)
        left = np.repeat(np.arange(len(own)), counts)
        right = np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)] or [left])
        found.append(np.column_stack([own[left], own[right.astype(np.int64)]]))
    pairs = np.concatenate(found) if found else np.zeros((0, 2), dtype=np.int64)
    keep = pairs[:: max(1, len(pairs) // _MOST_PAIRS)]
    return keep[:, 0], keep[:, 1]


def _place(odometry: Trajectory, at_ns: IntArray, points: FloatArray, q: FloatArray) -> FloatArray:
    """Landmarks in the odometry frame ``(n, 2)``."""
    x, y, yaw, scale, latency = q
    in_base = _turned(scale * points, yaw) + np.array([x, y])
    pose = _poses(odometry, at_ns - int(latency * 1e9))
    return np.asarray(_turned(in_base, pose[:, 2]) + pose[:, :2])


def _base(body: FloatArray, q: FloatArray) -> FloatArray:
    """``T_map_base`` of ``T_map_body`` ``(n, 3)`` for a body at q in the base."""
    x, y, yaw = q
    heading = body[:, 2] - yaw
    return np.column_stack([body[:, :2] - _turned(np.tile([x, y], (len(body), 1)), heading), heading])


def _motions(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.column_stack([_turned(b[:, :2] - a[:, :2], -a[:, 2]), se2.wrap_array(b[:, 2] - a[:, 2])])


def _poses(trajectory: Trajectory, at_ns: IntArray) -> FloatArray:
    return se2.interpolate(trajectory.stamps_ns, trajectory.poses, at_ns)


def _turned(points: FloatArray, yaw: FloatArray | float) -> FloatArray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]])


def _covered(stamps_ns: IntArray, at_ns: IntArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    after = np.clip(np.searchsorted(stamps_ns, at_ns), 1, len(stamps_ns) - 1)
    near = (stamps_ns[after] - stamps_ns[after - 1]) * 1e-9 < _TRUTH_GAP_S
    return np.asarray(near & (at_ns >= stamps_ns[0]) & (at_ns <= stamps_ns[-1]))
