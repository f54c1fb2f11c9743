"""Comparison of pairs of signals that measure the same quantity, without map and pose.

Each comparison is a robust regression that gives sign, axis, scale and lag of one signal against the other, with their
uncertainty from a jackknife over blocks of time: neighbouring errors are alike, so that the residuals of single
messages would promise too much.

Sources: Huber and Ronchetti, Robust Statistics, 2nd edition, 7.8 (iteratively reweighted least squares); Efron and
Tibshirani, An Introduction to the Bootstrap, chapter 11 (jackknife).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fgloc.diagnosis.signals import Path
from fgloc.instrumentation import give_way
from fgloc.types import FloatArray

ComplexArray = NDArray[np.complex128]

MOST_LAG_S = 1.5  # a clock that is further off shows in the receive times
BLOCKS = 8  # of time, or of landmarks, of the jackknife
_RATE_HALF_S = 0.15  # yaw rates are means over twice this
_TURN_HALF_S = 1.0
MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_CLIPPED = 4.0  # standard deviations beyond which a rate counts as this much: spikes of a driver
_REWEIGHTED = 6  # times
CAUCHY = 2.385  # tuning constant of 95 % efficiency
SITS = 1e-2  # information on a place on the robot, over that of a row: it is small where the robot does not turn
TURN = 0.1  # prior of the share by which a robot turns more or less than its wheels say
FOLLOWS = 0.5  # share of a motion that another explains: enough for a lag with its sigma
TELLS = 0.7  # share of a turn that another explains: two that tell the same
LAG_SIGMAS = 3.5  # of a lag, beyond which it is named
RATE_SCALE = 0.1  # of a turn: no gyro and no careful track is off by more
LATE_S = 0.03  # less is within what drivers mean by a stamp
SKID = 0.7  # logarithm of a turn over another: a driver may give both of them, by different tracks
ROUGHLY = 0.35  # logarithm of a scale: nothing else is so near to degrees for radians
VARIED = 0.05  # rad/s, m/s: standard deviation of a motion that tells one time from another


@dataclass(frozen=True, slots=True)
class Figure:
    """A value with its standard deviation."""

    value: float
    sigma: float

    def off(self, expected: float, least: float, sigmas: float = 5.0) -> bool:
        """Whether the value is surely, and by more than ``least``, away from the expected one."""
        return abs(self.value - expected) > max(least, sigmas * self.sigma)


def weighted(figures: Sequence[Figure]) -> Figure:
    """Mean of figures of one quantity, weighted by their information."""
    weights = np.array([figure.sigma for figure in figures]) ** -2.0
    mean = float(weights @ np.array([figure.value for figure in figures]) / weights.sum())
    return Figure(mean, float(weights.sum() ** -0.5))


def irls(A: ComplexArray, y: ComplexArray, floor: float, prior: float = 0.0) -> tuple[ComplexArray, FloatArray]:
    """Robust least squares of complex rows with Cauchy weights: solution ``(k,)`` and absolute residuals ``(n,)``.

    Args:
        A: ``(n, k)``.
        y: ``(n,)``.
        floor: residuals below are none.
        prior: information that a row of 1 gives, on the last unknown.
    """
    weights = np.ones(len(y))
    x, residual = np.zeros(A.shape[1], dtype=complex), np.abs(y)
    for _ in range(_REWEIGHTED):
        give_way()
        weighted_rows = A.conj().T * weights
        H = weighted_rows @ A
        H[-1, -1] += prior * weights.sum() / len(y)
        x = np.linalg.solve(H + 1e-12 * np.eye(len(x)), weighted_rows @ y)
        residual = np.abs(A @ x - y)
        weights = 1.0 / (1.0 + (residual / (CAUCHY * (MAD * float(np.median(residual)) + floor))) ** 2)
    return x, residual


def jackknife(left_out: FloatArray) -> FloatArray:
    """Standard deviations ``(p,)`` of estimates, from those ``(b, p)`` with one block of data left out."""
    b = len(left_out)
    return np.asarray(np.sqrt((b - 1) / b * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0)))


@dataclass(frozen=True, slots=True)
class RateFit:
    """A rate that follows another: ``reference(t) = scale · rate(t + late) + offset``.

    ``share``: of the reference's robust variance that is explained; near 1 for two that tell the same.
    """

    scale: Figure
    late_s: Figure
    share: float


def fit_rate(path: Path, times: FloatArray, integral: FloatArray) -> RateFit | None:
    """Scale and lag of a turn against the wheels' turn.

    Args:
        path: motion of the wheels.
        times: ``(n,)`` [s].
        integral: ``(n,)`` of the rate over time [rad], in whatever unit and sign it is reported.

    Returns:
        None where the wheels do not turn, or the two share too little time.
    """
    first, last = max(path.times[0], times[0]), min(path.times[-1], times[-1])
    at = np.arange(first + MOST_LAG_S + 0.3, last - MOST_LAG_S - 0.3, 0.1)
    at = at[path.known(at - 0.3, at + 0.3)]
    if len(at) < 50:
        return None
    reference = path.yaw_rate(at, _RATE_HALF_S)
    if float(np.sqrt(np.mean(reference**2))) < 0.03:
        return None

    def rates(late: FloatArray, half_s: float) -> FloatArray:
        later = np.interp(at + late[:, None] + half_s, times, integral)
        return np.asarray((later - np.interp(at + late[:, None] - half_s, times, integral)) / (2.0 * half_s))

    late, share = best_lag(lambda lags: explained(reference, rates(lags, _RATE_HALF_S))[1], MOST_LAG_S)
    turned = path.yaw_rate(at, _TURN_HALF_S)  # over longer: a driver's filter takes from short turns
    scale = float(explained(turned, rates(np.array([late]), _TURN_HALF_S))[0][0])
    near = np.arange(late - 0.1, late + 0.1001, 0.02)
    nearby = rates(near, _RATE_HALF_S)
    left_out = []
    for part in np.array_split(np.arange(len(at)), BLOCKS):
        use = np.ones(len(at), dtype=bool)
        use[part] = False
        at_best = _vertex(near, explained(reference[use], nearby[:, use])[1])
        slope = explained(turned[use], rates(np.array([at_best]), _TURN_HALF_S)[:, use])[0][0]
        left_out.append((float(slope), at_best))
    sigmas = jackknife(np.array(left_out))
    return RateFit(Figure(scale, float(sigmas[0])), Figure(late, float(sigmas[1]) + 0.002), share)


def fit_way(path: Path, times: FloatArray, way: FloatArray) -> RateFit | None:
    """Scale and lag of a way ahead ``(n,)`` [m] against that of the wheels, as `fit_rate` has them of turns."""
    along = np.column_stack([np.zeros((len(path.times), 2)), path.way])
    return fit_rate(Path(path.times, along, path.gaps), times, way)


def best_lag(shares: Callable[[FloatArray], FloatArray], longest_s: float) -> tuple[float, float]:
    """Lag [s] at which two signals share most, and that share, by the shares ``(m,)`` at lags ``(m,)``."""
    coarse = np.arange(-longest_s, longest_s + 1e-9, 0.05)
    near = coarse[int(np.argmax(shares(coarse)))] + np.arange(-0.06, 0.0601, 0.01)
    fine = shares(near)
    return _vertex(near, fine), float(fine.max())


def _vertex(x: FloatArray, y: FloatArray) -> float:
    """Place of the maximum of equally spaced values, by the parabola through the three highest neighbours."""
    k = int(np.argmax(y))
    if k in (0, len(x) - 1):
        return float(x[k])
    a, b, c = y[k - 1 : k + 2].tolist()
    bend = a - 2.0 * b + c
    return float(x[k] + (0.5 * (a - c) / bend if bend < 0.0 else 0.0) * (x[1] - x[0]))


def explained(y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slopes ``(m,)`` of ``y (n,)`` by each row of ``x (m, n)`` with an offset, robust, and the shares explained.

    A share is of the variance of y's inliers. Both are 0 for a row that does not vary.
    """
    weights = np.ones_like(x)
    typical = float(np.sqrt(np.mean(np.minimum(np.abs(y - np.median(y)), _CLIPPED * np.std(y)) ** 2)))
    constant = ~np.any(np.abs(x) > 1e-12, axis=1)
    for _ in range(_REWEIGHTED):
        give_way()
        total = weights.sum(axis=1)
        dx = x - (np.einsum("ij,ij->i", weights, x) / total)[:, None]
        dy = y - (weights @ y / total)[:, None]
        weighted_dx = weights * dx
        variance = np.einsum("ij,ij->i", weighted_dx, dx)
        constant |= variance <= 0.0
        slope = np.einsum("ij,ij->i", weighted_dx, dy) / np.where(constant, 1.0, variance)
        residual = np.abs(dy - slope[:, None] * dx)
        # a robot that mostly stands makes the median a lie: what it does while it turns must count
        spread = np.maximum(MAD * np.median(residual, axis=1), 0.2 * typical) + 1e-9
        weights = 1.0 / (1.0 + (residual / (CAUCHY * spread)[:, None]) ** 2)
    left = np.mean(np.minimum(residual, _CLIPPED * typical) ** 2, axis=1)
    return np.where(constant, 0.0, slope), np.where(constant, 0.0, 1.0 - left / max(typical**2, 1e-12))


def varied(path: Path) -> bool:
    """Whether speed or yaw rate vary: otherwise a lag and a turn of the sensor are the same."""
    at = np.arange(path.times[0] + 0.5, path.times[-1] - 0.5, 0.5)
    at = at[path.known(at - 0.5, at + 0.5)]
    if len(at) < 2:
        return False
    speed = np.hypot(*(path.at(at + 0.5) - path.at(at - 0.5))[:, :2].T)
    return max(float(np.std(path.yaw_rate(at, 0.5))), float(np.nanstd(speed))) > VARIED


def complex_poses(path: Path, times: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Places x + iy and directions e^(i yaw) of a path at some times, ``(n,)`` each."""
    outside = (times < path.times[0]) | (times > path.times[-1])
    place: ComplexArray = np.interp(times, path.times, path.poses[:, 0] + 1j * path.poses[:, 1])  # type: ignore[assignment]
    direction = np.exp(1j * np.interp(times, path.times, path.poses[:, 2]))
    place[outside] = direction[outside] = np.nan
    return place, direction
