"""What an IMU measures in the hands of a person."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fgloc.frames import rpy_matrix
from fgloc.sensors.failures import Carriage
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.types import Event

_BOUNCE_HZ, _BOUNCE_M_S2 = 1.9, 1.0  # vertical acceleration of what a walking person carries: amplitude
_SWAY_HZ, _SWAY_RAD = 0.7, 0.03  # of the hands, in roll and pitch
_TILT_RAD = 0.12  # largest tilt at which it is held


def carried(carriage: Carriage) -> Callable[[Event], Event]:
    """The IMU is shaken in the air. It is taken to be level."""
    hands = {(a, b): _Hands(a, b, carriage) for a, b in carriage.intervals}

    def tell(event: Event) -> Event:
        assert isinstance(event, ImuEvent)
        interval = carriage.interval(event)
        return event if interval is None else hands[interval].shake(event, carriage.seconds(event))

    return tell


class _Hands:
    """What the hands do to the IMU in one interval."""

    def __init__(self, start_s: float, end_s: float, carriage: Carriage) -> None:
        rng = carriage.scene.rng
        self.start_s, self.end_s = start_s, end_s
        self._rise_s, self._height = min(carriage.rise_s, 0.5 * (end_s - start_s)), carriage.height_m
        self._tilt = rng.uniform(-_TILT_RAD, _TILT_RAD, 2)
        self._phase = rng.uniform(0.0, 2.0 * math.pi, 3)

    def shake(self, event: ImuEvent, t: float) -> ImuEvent:
        """The message with the hands' motion added."""
        s = min(t - self.start_s, self.end_s - t) / self._rise_s  # 0 on the floor, 1 up
        up, rate, rises = _minimum_jerk(s)
        sign = 1.0 if t - self.start_s < self.end_s - t else -1.0
        swing = 2.0 * math.pi * _SWAY_HZ
        angles = self._phase[:2] + swing * t
        tilt = up * (self._tilt + _SWAY_RAD * np.sin(angles))
        turning = up * _SWAY_RAD * swing * np.cos(angles)
        turning = turning + sign * rate / self._rise_s * (self._tilt + _SWAY_RAD * np.sin(angles))
        vertical = self._height * rises / self._rise_s**2
        vertical += up * _BOUNCE_M_S2 * math.sin(2.0 * math.pi * _BOUNCE_HZ * t + self._phase[2])
        R = rpy_matrix(tilt[0], tilt[1], 0.0)
        force = R.T @ (event.linear_acceleration + np.array([0.0, 0.0, vertical]))
        rates = R.T @ event.angular_velocity + np.array([turning[0], turning[1], 0.0])
        return replace(event, angular_velocity=rates, linear_acceleration=force)


def _minimum_jerk(s: float) -> tuple[float, float, float]:
    """Height and its first and second derivative on the way from 0 to 1 in unit time.

    Source: Flash, Hogan 1985, "The coordination of arm movements".
    """
    if s >= 1.0:
        return 1.0, 0.0, 0.0
    return (
        10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5,
        30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4,
        60.0 * s - 180.0 * s**2 + 120.0 * s**3,
    )
