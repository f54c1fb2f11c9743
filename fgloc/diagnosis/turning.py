"""Whether the gyro and the wheels turn at the same time."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from fgloc.diagnosis.pool import Evidence, Pool, eliminated
from fgloc.diagnosis.window import Window
from fgloc.types import FloatArray, InertialEvent

_MIN_TURNING = 0.15  # rad/s, standard deviation of the yaw rate: less does not distinguish one time from another
_STARTS_S = np.arange(-1.0, 1.01, 0.1)
_ITERATIONS = 5
_KEPT_S = 16.0
_NOISE_RAD = 0.003
_SLIPPED_RAD = 0.015  # rms of the yaw that wheels and gyro differ by in a window, whatever their scales and clocks
_OWN_DOF = 4.0


class Turning(IntEnum):
    """Parameters that all windows share."""

    LATE = 0  # s: the gyro's stamps are later than the wheels' by this
    SCALE = 1  # wheel rotation per gyro rotation


class GyroComparison:
    """Compares yaw angles of gyro and wheels, window by window."""

    def __init__(self, up: FloatArray | None) -> None:
        """``up`` ``(3,)``: the base's z axis in the IMU's frame; None: its messages are not used."""
        self._up = up
        self.pool = Pool(np.array([2.0, 2.0]))
        self._times: list[float] = []
        self._rates: list[float] = []

    def record(self, event: InertialEvent, at_s: float) -> None:
        """Take in a message; those of the step before come again and are passed over."""
        if self._up is None:
            return
        if self._times and at_s <= self._times[-1]:
            if at_s > self._times[-1] - _KEPT_S:
                return
            self._times, self._rates = [], []  # the clock was set back
        self._times.append(at_s)
        self._rates.append(float(event.angular_velocity @ self._up))
        if self._times[-1] - self._times[0] > 2.0 * _KEPT_S:
            keep = next(i for i, t in enumerate(self._times) if t > at_s - _KEPT_S)
            del self._times[:keep], self._rates[:keep]

    def compare(self, window: Window) -> bool:
        """Add the evidence of this window; whether the wheels slipped in it, as they and the gyro contradict."""
        times = np.array(self._times) - window.start_s
        if len(times) < 20 or np.diff(times).max() > 0.5:
            return False
        rates = np.array(self._rates)
        angles = np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(times))])
        yaw = np.concatenate([[0.0], np.cumsum(window.motions[:, 2])])
        inside = (window.times > times[0] + 1.0) & (window.times < times[-1] - 1.0)
        if inside.sum() < 20:
            return False
        at, yaw = window.times[inside], yaw[inside]
        if float(np.std(np.diff(yaw) / np.diff(at))) < _MIN_TURNING:
            return _misfit(at, yaw, times, angles, 0.0) > _SLIPPED_RAD
        late = min(_STARTS_S.tolist(), key=lambda start: _misfit(at, yaw, times, angles, start))
        scale, fitted = _line(at, yaw, times, angles, late)
        for _ in range(_ITERATIONS):
            J = _jacobian(at, times, angles, rates, late, scale)
            step = np.linalg.lstsq(J, yaw - fitted, rcond=None)[0]
            late = float(np.clip(late + np.clip(step[2], -0.1, 0.1), -1.0, 1.0))
            scale, fitted = _line(at, yaw, times, angles, late)
        r, J = yaw - fitted, -_jacobian(at, times, angles, rates, late, scale)
        noise = (float(r @ r) / _NOISE_RAD**2 + _OWN_DOF) / (len(r) - 4 + _OWN_DOF) * _NOISE_RAD**2
        information, pull = eliminated(J.T @ J / noise, -(J.T @ r) / noise, 2)
        value = np.array([late, scale])
        self.pool.add(Evidence(window.start_s + float(at.mean()), information, pull + information @ value))
        return math.sqrt(float(np.mean(r**2))) > _SLIPPED_RAD


def _jacobian(
    at: FloatArray, times: FloatArray, angles: FloatArray, rates: FloatArray, late: float, scale: float
) -> FloatArray:
    """Of the fitted yaw by its constant, its drift, the lateness and the scale ``(n, 4)``."""
    shifted = at + late  # a late stamp: what happened at a time is found later
    return np.column_stack(
        [np.ones(len(at)), at, scale * np.interp(shifted, times, rates), np.interp(shifted, times, angles)]
    )


def _line(
    at: FloatArray, yaw: FloatArray, times: FloatArray, angles: FloatArray, late: float
) -> tuple[float, FloatArray]:
    """Scale and fitted yaw at this lateness; constant and drift (the gyro's bias) are the window's own."""
    A = np.column_stack([np.interp(at + late, times, angles), np.ones(len(at)), at])
    x = np.linalg.lstsq(A, yaw, rcond=None)[0]
    return float(x[0]), np.asarray(A @ x)


def _misfit(at: FloatArray, yaw: FloatArray, times: FloatArray, angles: FloatArray, late: float) -> float:
    _, fitted = _line(at, yaw, times, angles, late)
    return math.sqrt(float(np.mean((yaw - fitted) ** 2)))
