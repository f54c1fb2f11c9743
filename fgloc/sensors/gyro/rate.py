"""Yaw rate of an IMU, rid of its bias."""

from __future__ import annotations

import copy
import math
from collections import Counter

import numpy as np
from numpy.typing import ArrayLike

from fgloc.sensors.base import Turn
from fgloc.sensors.gyro import installation
from fgloc.sensors.gyro.config import GyroConfig
from fgloc.sensors.rest import Standing
from fgloc.stats import GATE, chi2_bound
from fgloc.types import FloatArray, InertialEvent, Step

_MAX_GAP_S = 0.1  # over a longer silence the turn is not known
_AT_REST_S = 0.3  # that the wheels have stood before the robot is taken to stand
_APART_S = 2.0  # between two yaws that the bias is learned from, at least


class Gyro:
    """Integrates the yaw rate over steps and keeps an estimate of its bias (a scalar Kalman filter).

    The bias is learned while the wheels stand, and between fixes of the yaw.

    Attributes:
        bias: [rad/s].
        bias_variance: [rad²/s²].
        rejections: steps without a turn, by reason: ``gyro.silence``.
    """

    def __init__(self, config: GyroConfig, up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        """Set up.

        Args:
            config: noise of the gyro.
            up: ``(3,)`` the base's z axis in the IMU's frame.
        """
        self.bias = 0.0
        self.bias_variance = config.bias_sigma**2
        self.rejections: Counter[str] = Counter()
        self._config = config
        self._up = np.asarray(up, dtype=float)
        self._standing_s = 0.0
        self._wheels = Standing()
        self._anchor: tuple[float, float] | None = None  # yaw and variance of the last fix ...
        self._turned = self._turned_s = 0.0  # ... and what was turned since
        self._received = False
        self.forget_fix()

    @property
    def up(self) -> FloatArray:
        """The base's z axis ``(3,)`` in the IMU's frame, times the scale of its rates."""
        return self._up

    @property
    def at_rest(self) -> bool:
        """Whether over the last step, and for a while, it has shown nothing but its bias beside wheels that stand."""
        return self._standing_s > _AT_REST_S

    def fork(self) -> Gyro:
        """A copy that may integrate beyond the newest step without changing this one."""
        forked = copy.copy(self)
        forked.rejections = Counter()
        forked._wheels = self._wheels.fork()
        return forked

    def resume(self, bias: float, bias_variance: float) -> None:
        """Go on from what an earlier run learned of the bias [rad/s], [rad²/s²]."""
        self.bias, self.bias_variance = bias, min(bias_variance, self._config.bias_sigma**2)

    def measure(self, step: Step, wheels: ArrayLike | None, since_fix_s: float = 0.0) -> Turn | None:
        """Turn over the step.

        Args:
            step: with the IMU's messages.
            wheels: ``(3,)`` what the wheels measured of the step: where they stand, the bias shows.
            since_fix_s: how long before the step no fix has determined the yaw. A wrong bias turns all steps
                alike, so that its variance grows with the square of that time, however it is cut into steps.

        Returns:
            None without data of the gyro; after its first data, that is counted.
        """
        dt = step.dt
        raw = None if dt <= 0.0 else self._integral(step.inertial, step.start_ns, step.stamp_ns)
        if raw is None:
            self._standing_s = 0.0
            if self._received:
                self.rejections["gyro.silence"] += 1
            return None
        self._received = True
        self.bias_variance += self._config.bias_walk**2 * dt
        self._watch_rest(raw / dt, dt, wheels)
        yaw = raw - self.bias * dt
        drift = self.bias_variance * ((since_fix_s + dt) ** 2 - since_fix_s**2)
        noise = self._config.yaw_per_sqrt_s**2 * dt
        return Turn(yaw, noise + drift, noise, self._config.yaw_per_sqrt_s**2)

    def rates_at(self, events: tuple[InertialEvent, ...], stamps_ns: tuple[int, ...]) -> FloatArray:
        """Yaw rates [rad/s] at these times, rid of the bias: of the neighbors, weighted."""
        times = np.array([(event.stamp_ns - stamps_ns[0]) * 1e-9 for event in events])
        rates = np.array([event.angular_velocity for event in events]) @ self._up
        at = np.array([(stamp - stamps_ns[0]) * 1e-9 for stamp in stamps_ns])
        return np.asarray(np.interp(at, times, rates) - self.bias)

    def derivatives(self, motion: FloatArray) -> dict[str, FloatArray]:
        """Of a motion whose turn is this gyro's, by what the gyro is off by."""
        return installation.derivatives(motion)

    def turned(self, yaw: float, seconds: float) -> None:
        """The robot went on by a step over which `measure` gave this turn [rad]."""
        self._turned += yaw
        self._turned_s += seconds

    def fix(self, yaw: float, variance: float, apart_s: float = 0.0) -> None:
        """Take in the yaw at the end of the last step, as fixes determine it; the turn between two corrects the bias.

        Args:
            yaw: [rad].
            variance: [rad²].
            apart_s: how far apart the two have to be at least, so that their errors do not depend on this gyro.
        """
        if self._anchor is not None:
            if self._turned_s < max(_APART_S, apart_s):
                return
            before, spread = self._anchor
            error = math.remainder(self._turned - (yaw - before), math.tau)
            noise = self._config.yaw_per_sqrt_s**2 * self._turned_s
            self._learn(self.bias + error / self._turned_s, (spread + variance + noise) / self._turned_s**2)
        self._anchor, self._turned, self._turned_s = (yaw, variance), 0.0, 0.0

    def forget_fix(self) -> None:
        """The robot may have been turned without data since the last fix."""
        self._anchor, self._turned, self._turned_s = None, 0.0, 0.0

    def _watch_rest(self, rate: float, dt: float, wheels: ArrayLike | None) -> None:
        stands = self._wheels.observe(None if wheels is None else np.asarray(wheels, dtype=float), dt)
        variance = self._config.yaw_per_sqrt_s**2 / dt
        still = (rate - self.bias) ** 2 < chi2_bound(GATE, 1) * (self.bias_variance + variance)  # or turned by hand
        self._standing_s = self._standing_s + dt if stands and still else 0.0
        if self._standing_s > _AT_REST_S:
            self._learn(rate, variance)

    def _learn(self, bias: float, variance: float) -> None:
        gain = self.bias_variance / (self.bias_variance + variance)
        change = gain * (bias - self.bias)
        self.bias += change
        self.bias_variance *= 1.0 - gain
        self._turned -= change * self._turned_s  # what was turned since the last fix, with the bias of now

    def _integral(self, events: tuple[InertialEvent, ...], start_ns: int, end_ns: int) -> float | None:
        """Turn [rad] of the rates as they are, joined by straight lines and held at the ends."""
        if not events:
            return None
        up = self._up
        times = np.array([(event.stamp_ns - start_ns) * 1e-9 for event in events])
        rates = np.array([event.angular_velocity for event in events]) @ up
        end = (end_ns - start_ns) * 1e-9
        inside = times[(times > 0.0) & (times < end)]
        nodes = np.concatenate([[0.0], inside, [end]])
        if max(times[0], end - times[-1]) > _MAX_GAP_S or (len(times) > 1 and np.diff(times).max() > _MAX_GAP_S):
            return None
        return float(np.trapezoid(np.interp(nodes, times, rates), nodes))
