"""Roll and pitch by an IMU: how far the robot tilts over a step, and where gravity pulls at its end."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fgloc.frames import rotation_of
from fgloc.sensors.gyro.config import GyroConfig
from fgloc.types import FloatArray, InertialEvent, InertialReading, Step

_MAX_GAP_S = 0.1  # over a longer silence neither turn nor force is known
_SPEED_SIGMA = 0.015  # m/s: by what wheels and a mean over 40 ms are off from the robot's speed at one time

Twist = Callable[[Step, int], FloatArray]
"""Of the base ``(3,)`` at a time near the step's end."""


class Attitude:
    """Integrates the rates about x and y, and takes the robot's own acceleration out of the specific force.

    Source: Titterton and Weston, Strapdown Inertial Navigation Technology, 2nd edition, 3.4 (specific force in body
    axes: ``f = dv/dt + ω × v - g``).
    """

    def __init__(self, config: GyroConfig, T_base_imu: FloatArray) -> None:
        """Take the noise, and the mounting ``(4, 4)`` of the IMU."""
        self._config = config
        self._R, self._t = T_base_imu[:3, :3], T_base_imu[:3, 3]

    def rates_at(self, events: Sequence[InertialEvent], at_ns: int) -> FloatArray:
        """Angular velocity ``(3,)`` [rad/s] of the base at a time, bias included."""
        times, rates, _ = self._samples(events, at_ns)
        return np.array([np.interp(0.0, times, rates[:, i]) for i in range(3)])

    def measure(self, step: Step, twist: Twist) -> InertialReading | None:
        """The step's reading; None if the IMU was silent.

        Args:
            step: with the IMU's messages.
            twist: tells the speed at its start and end.
        """
        dt = step.dt
        if dt <= 0.0 or not step.inertial:
            return None
        times, rates, forces = self._samples(step.inertial, step.start_ns)
        inside = times[(times > 0.0) & (times < dt)]
        nodes = np.concatenate([[0.0], inside, [dt]])
        if max(times[0], dt - times[-1]) > _MAX_GAP_S or (len(times) > 1 and np.diff(times).max() > _MAX_GAP_S):
            return None
        at = np.column_stack([np.interp(nodes, times, rates[:, i]) for i in range(3)])
        turn = np.trapezoid(at, nodes, axis=0)
        sampled = (times > 0.0) & (times <= dt)
        force, variance = None, self._config.acceleration_sigma**2 + 2.0 * (_SPEED_SIGMA / dt) ** 2
        if sampled.any() and np.isfinite(forces[sampled]).all() and forces[sampled].any():
            force = self._without_acceleration(step, turn, forces[sampled].mean(axis=0), twist)
        return InertialReading(turn[:2], self._config.yaw_per_sqrt_s**2 * dt, force, variance, dt)

    def _without_acceleration(self, step: Step, turn: FloatArray, force: FloatArray, twist: Twist) -> FloatArray:
        """The mean force over a step less the robot's own acceleration, in the base's axes at the end."""
        dt = step.dt
        start, end = twist(step, step.start_ns), twist(step, step.stamp_ns)
        omega = turn / dt
        speed = np.array([*(0.5 * (start[:2] + end[:2])), 0.0]) + np.cross(omega, self._t)
        own = np.array([*((end[:2] - start[:2]) / dt), 0.0]) + np.cross(omega, speed)
        return np.asarray(rotation_of(-0.5 * turn) @ (force - own))

    def _samples(self, events: Sequence[InertialEvent], origin_ns: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        times = np.array([(event.stamp_ns - origin_ns) * 1e-9 for event in events])
        rates = np.array([event.angular_velocity for event in events]) @ self._R.T
        forces = np.array([event.linear_acceleration for event in events]) @ self._R.T
        return times, rates, forces
