"""A few seconds of wheel motion and sightings, and what systematic errors would make them fit together.

Wheel odometry is good over seconds, however wrong it is over minutes: within a window, the place of the whole window is
unknown and everything else is taken from the wheels. What then remains between sightings and map is noise, or the
faults that `Fault` lists, which are the same in every window.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from fgloc.diagnosis.pool import Evidence, eliminated
from fgloc.types import FloatArray, IntArray

_CAUCHY_K = 3.0
_ITERATIONS = 8
_MIN_SPREAD_M = 0.4  # of the landmarks seen: nearer together they do not determine the window's yaw
_MIN_SIGHTINGS = 8
_NUDGE = 1e-5
_POOR = 3.0  # median whitened residual above which other clock offsets are tried as starts
_STARTS_S = (0.3, -0.3, 0.8, -0.8)
_INCONSISTENT, _STRAINED = 4.0, 1.5
_PLAIN = 1.5  # median whitened residual of a window that fits without any fault
_NONE = 1e12  # information that leaves no fault
_OWN_DOF = 4.0  # how much the assumed noise counts beside a window's own residuals


class Fault(IntEnum):
    """Systematic errors, in the order of the parameter vector."""

    LATE = 0  # s: the sightings' stamps are later than the wheels' by this
    SCALE = 1  # log of true over reported range
    TURN = 2  # rad: reported minus true bearing
    WHEEL_SCALE = 3  # log of true over reported distance
    WHEEL_TURN = 4  # true over reported rotation, minus 1
    WHEEL_PULL = 5  # rad/m gained going straight
    FORWARD = 6  # m: the sensor sits this much further forward than configured
    LEFT = 7  # m
    DEPTH = 8  # log of true over given depth along a camera's axis: a wrong focal length leaves what is across as it is


PRIOR_SIGMAS = np.array([1.0, 0.5, 0.5, 0.3, 0.3, 0.2, 0.3, 0.3, 0.3])
"""How large each fault may be: wide, to bind only what a window does not determine."""
PRIOR_SIGMAS_NO_MAP = np.array([1.0, 0.3, 0.5, 0.01, 0.1, 0.1, 0.1, 0.1, 0.3])
"""Without a map the wheels are the measure of length."""


@dataclass(frozen=True, slots=True, eq=False)
class RelativeSightings:
    """Sightings ``(m,)``: time [s], landmark, place in the sensor's axes ``(m, 3)``, noise of bearing and range."""

    times: FloatArray
    ids: IntArray
    points: FloatArray
    sigmas: FloatArray  # (m, 2) rad, m


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Wheel motion and the sightings made meanwhile."""

    start_s: float
    times: FloatArray  # (n + 1,) s
    motions: FloatArray  # (n, 3) between them
    sightings: RelativeSightings


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How a window fits together.

    Attributes:
        place: ``T_map_start (3,)`` of the window's first pose; zeros without a map.
        misfit: median whitened residual; about 0.7 for the noise assumed; infinite if no faults make it fit.
        strain: length of the faults in units of how large they may be; 0 if the window fits as well without them, as
            then it does not determine them (as with a robot that drives one circle).
        evidence: of the window for the faults.
    """

    place: FloatArray
    misfit: float
    strain: float
    evidence: Evidence

    @property
    def inconsistent(self) -> bool:
        """Whether no faults of a plausible size make the window fit."""
        return self.misfit > _INCONSISTENT or self.strain > _STRAINED


def fit_window(
    window: Window, T_base_sensor: FloatArray, known: Mapping[int, FloatArray] | None, any_clock: bool = True
) -> Fit | None:
    """Fit the window's place (or, without a map, its landmarks) together with the faults.

    Args:
        window: motion and sightings.
        T_base_sensor: ``(4, 4)`` as configured.
        known: landmark places ``(2,)``; None: they are unknown.
        any_clock: look for large clock offsets too, where none makes it fit.

    Returns:
        None if the window does not determine its place: too few sightings, or all of one point.
    """
    problem = _Problem.make(window, T_base_sensor, known)
    if problem is None:
        return None
    best = problem.solve(0.0)
    if any_clock and best.misfit > _POOR:
        best = min([best, *map(problem.solve, _STARTS_S)], key=lambda fit: fit.misfit)
    if best.strain > _STRAINED and problem.solve(0.0, faults=False).misfit < _PLAIN:
        best = replace(best, strain=0.0)
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    window: Window
    arms: FloatArray  # (m, 2) reported places about the sensor, in the base's axes
    along: FloatArray  # (m, 2) their parts along a camera's axis; zeros for other sensors
    sensor: FloatArray  # (2,) where it sits
    landmarks: FloatArray | None  # (m, 2) known places of what was seen
    slots: IntArray  # (m,) which unknown landmark was seen
    local: FloatArray  # start of what is this window's own: its place, or its landmarks
    prior: FloatArray  # (p,) information

    @staticmethod
    def make(window: Window, T_base_sensor: FloatArray, known: Mapping[int, FloatArray] | None) -> _Problem | None:
        sightings = window.sightings
        if len(sightings.times) < _MIN_SIGHTINGS:
            return None
        sensor = T_base_sensor[:2, 3]
        arms = (sightings.points @ T_base_sensor[:3, :3].T)[:, :2]
        if np.hypot(arms[:, 0], arms[:, 1]).min() < 1e-3:
            return None
        axis = T_base_sensor[:2, 2]  # of a camera: z forward; of other sensors z is up, and this is nothing
        along = (arms @ axis)[:, None] * axis
        seen = _in_path(_path(window.times, window.motions, np.zeros(len(Fault)), sightings.times), arms + sensor)
        numbers, slots = np.unique(sightings.ids, return_inverse=True)
        if known is None:
            counts = np.bincount(slots)
            if len(numbers) < 2 or counts.min() < 2:
                return None
            local = np.stack([np.bincount(slots, seen[:, k]) / counts for k in (0, 1)], axis=1).ravel()
            return _Problem(window, arms, along, sensor, None, slots, local, PRIOR_SIGMAS_NO_MAP**-2.0)
        landmarks = np.array([known[int(i)] for i in sightings.ids])
        place = rigid(seen, landmarks, sightings.sigmas[:, 1] ** -2.0)
        return (
            None
            if place is None
            else _Problem(window, arms, along, sensor, landmarks, slots, place, PRIOR_SIGMAS**-2.0)
        )

    def residuals(self, x: FloatArray) -> FloatArray:
        """Whitened ``(2 m,)``: bearings, then ranges."""
        n = len(self.local)
        local, fault = x[:n], x[n:]
        sightings = self.window.sightings
        poses = _path(self.window.times, self.window.motions, fault, sightings.times - fault[Fault.LATE])
        if self.landmarks is None:
            targets = local.reshape(-1, 2)[self.slots]
        else:  # into the window's frame
            c, s = math.cos(local[2]), math.sin(local[2])
            targets = (self.landmarks - local[:2]) @ np.array([[c, -s], [s, c]])
        away = targets - poses[:, :2]
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        ahead = cos * away[:, 0] + sin * away[:, 1] - self.sensor[0] - fault[Fault.FORWARD]
        left = -sin * away[:, 0] + cos * away[:, 1] - self.sensor[1] - fault[Fault.LEFT]
        arms = self.arms + math.expm1(fault[Fault.DEPTH]) * self.along
        off = np.arctan2(arms[:, 1], arms[:, 0]) - fault[Fault.TURN] - np.arctan2(left, ahead)
        off = (off + math.pi) % (2.0 * math.pi) - math.pi
        far = np.hypot(arms[:, 0], arms[:, 1]) * math.exp(fault[Fault.SCALE]) - np.hypot(ahead, left)
        return np.concatenate([off / sightings.sigmas[:, 0], far / sightings.sigmas[:, 1]])

    def solve(self, late_s: float, faults: bool = True) -> Fit:
        """Gauss–Newton with Cauchy weights, from this clock offset; without ``faults`` only for the place."""
        n = len(self.local)
        x = np.concatenate([self.local, np.zeros(len(Fault))])
        x[n + Fault.LATE] = late_s
        prior = np.concatenate([np.zeros(n), self.prior if faults else np.full(len(Fault), _NONE)])
        damping = 1e-9 * np.eye(len(x))
        for _ in range(_ITERATIONS):
            r, J = self._linearized(x)
            w = 1.0 / (1.0 + (r / _CAUCHY_K) ** 2)
            step = np.linalg.solve((J.T * w) @ J + np.diag(prior) + damping, -(J.T @ (w * r) + prior * x))
            longest = np.abs(step[n:] / PRIOR_SIGMAS).max()
            x = x + step / max(1.0, longest)
            if not np.isfinite(x).all() or np.abs(x[n:] / PRIOR_SIGMAS).max() > 5.0:
                p = len(Fault)
                return Fit(np.zeros(3), math.inf, math.inf, Evidence(0.0, np.zeros((p, p)), np.zeros(p)))
            if np.abs(step).max() < 1e-4:
                break
        r, J = self._linearized(x)
        w = 1.0 / (1.0 + (r / _CAUCHY_K) ** 2)
        noise = (float(w @ r**2) + _OWN_DOF) / (max(len(r) - n, 1) + _OWN_DOF)
        information, pull = (J.T * w) @ J / noise, -(J.T @ (w * r)) / noise
        information, pull = eliminated(information, pull, n)
        middle = float(self.window.sightings.times.mean())
        evidence = Evidence(self.window.start_s + middle, information, pull + information @ x[n:])
        place = x[:3] if self.landmarks is not None else np.zeros(3)
        strain = math.sqrt(float(self.prior @ x[n:] ** 2))
        return Fit(place, float(np.median(np.abs(r))), strain, evidence)

    def _linearized(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        r = self.residuals(x)
        J = np.empty((len(r), len(x)))
        for i in range(len(x)):
            nudged = x.copy()
            nudged[i] += _NUDGE
            J[:, i] = (self.residuals(nudged) - r) / _NUDGE
        return r, J


def _path(times: FloatArray, motions: FloatArray, fault: FloatArray, at: FloatArray) -> FloatArray:
    """Poses ``(m, 3)`` at some times, from the window's first pose on, with the wheels' faults taken out."""
    along, across = motions[:, 0] * math.exp(fault[Fault.WHEEL_SCALE]), motions[:, 1]
    turns = motions[:, 2] * (1.0 + fault[Fault.WHEEL_TURN]) + motions[:, 0] * fault[Fault.WHEEL_PULL]
    yaw = np.concatenate([[0.0], np.cumsum(turns)])
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    x = np.concatenate([[0.0], np.cumsum(c * along - s * across)])
    y = np.concatenate([[0.0], np.cumsum(s * along + c * across)])
    return np.column_stack([np.interp(at, times, values) for values in (x, y, yaw)])


def _in_path(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Points ``(m, 2)`` seen from these poses, in the window's frame."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + c * points[:, 0] - s * points[:, 1]
    return np.column_stack([x, poses[:, 1] + s * points[:, 0] + c * points[:, 1]])


def rigid(source: FloatArray, target: FloatArray, weights: FloatArray) -> FloatArray | None:
    """Pose ``(3,)`` that takes source points to target points; None where these lie too close together.

    Source: Arun, Huang, Blostein, "Least-squares fitting of two 3-D point sets", PAMI 9(5), 1987, in the plane.
    """
    share = weights / weights.sum()
    a, b = source - share @ source, target - share @ target
    if float(share @ (b**2).sum(axis=1)) < _MIN_SPREAD_M**2:
        return None
    yaw = math.atan2(share @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), share @ (a * b).sum(axis=1))
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = share @ target - np.array([[c, -s], [s, c]]) @ (share @ source)
    return np.array([x, y, yaw])


def spread_ratio(window: Window, T_base_sensor: FloatArray, known: Mapping[int, FloatArray]) -> float:
    """How much wider apart the landmarks of a window are on the map than wheels and sightings put them."""
    sightings = window.sightings
    arms = (sightings.points @ T_base_sensor[:3, :3].T)[:, :2] + T_base_sensor[:2, 3]
    seen = _in_path(_path(window.times, window.motions, np.zeros(len(Fault)), sightings.times), arms)
    landmarks = np.array([known[int(i)] for i in sightings.ids])
    return float(np.sqrt(landmarks.var(axis=0).sum() / max(seen.var(axis=0).sum(), 1e-12)))
