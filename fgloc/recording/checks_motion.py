"""Checks of how the robot moved: odometry, commands, IMU and truth."""

from __future__ import annotations

import numpy as np

from fgloc.config import Config
from fgloc.recording.checks_base import Table, count, finite_rows, times
from fgloc.types import CommandEvent, Event, FloatArray, ImuEvent, OdometryEvent, TruthEvent

_UNIT_TOLERANCE = 0.05
_MOVED_M = 0.1  # a pose that moved further did move


class OdometryChecks:
    """Pose, twist and covariances against each other and against the gate's bounds."""

    def __init__(self) -> None:
        self._rows = Table(12)

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, OdometryEvent)
        self._rows.add(
            *event.position[:2],
            *event.orientation,
            *event.linear[:2],
            event.angular[2],
            float(np.abs(event.pose_cov).max()),
            float(np.abs(event.twist_cov).max()),
            event.stamp_ns * 1e-9,
        )

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        rows = self._rows.array()
        found = []
        finite = finite_rows(rows[:, :9])
        if not finite.all():
            found.append(f"{topic}: {count(~finite)} hold NaN or infinity and will be rejected.")
        found += _quaternions(topic, rows[finite, 2:6])
        zero = [name for name, column in (("pose", 9), ("twist", 10)) if not rows[:, column].any()]
        if zero:
            found.append(f"{topic}: the covariance of {' and '.join(zero)} is all zero; the configured noise is used.")
        if finite.sum() > 1:
            found += self._motion(topic, rows[finite], seconds[finite], config)
        return found

    @staticmethod
    def _motion(topic: str, rows: FloatArray, seconds: FloatArray, config: Config) -> list[str]:
        x, y, qx, qy, qz, qw = rows[:, :6].T
        speed, rate = np.hypot(rows[:, 6], rows[:, 7]), np.abs(rows[:, 8])
        found = _spikes(topic, "yaw rate", "rad/s", rate, config.gate.max_yaw_rate, seconds)
        found += _spikes(topic, "speed", "m/s", speed, config.gate.max_speed, seconds)
        steps = np.hypot(np.diff(x), np.diff(y))
        turns = np.abs(np.diff(np.unwrap(np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)))))
        dt = np.maximum(np.diff(seconds), 0.0)
        jumped = steps > config.gate.max_speed * dt + 0.5
        if jumped.any():
            at = int(np.argmax(np.where(jumped, steps, 0)))
            found.append(
                f"{topic}: the pose jumps {times(int(jumped.sum()))}, by up to {steps[at]:.3g} m "
                f"at {seconds[at + 1]:.1f} s: reset, or another robot."
            )
        whole = ~jumped & (dt <= config.gate.gap_s)  # what happened in a gap only the pose can know
        path, turned = float(steps[whole].sum()), float(turns[whole].sum())
        if path > _MOVED_M and not speed.any() and not rate.any():
            found.append(
                f"{topic}: the twist is always zero while the pose moves {path:.1f} m; "
                "motion is taken from the pose (wheels.source: pose)."
            )
            return found
        sane = (rate[:-1] <= config.gate.max_yaw_rate) & whole
        for name, unit, by_twist, by_pose, least in (
            ("speed", "m", float((speed[:-1] * dt)[whole].sum()), path, 1.0),
            ("yaw rate", "rad", float((rate[:-1] * dt)[sane].sum()), float(turns[sane].sum()), 1.0),
        ):
            if by_pose > least and not 0.7 < by_twist / by_pose < 1.4:
                degrees = " (degrees for radians?)" if unit == "rad" and 40 < by_twist / by_pose < 75 else ""
                found.append(
                    f"{topic}: the twist's {name} adds up to {by_twist:.1f} {unit}, the pose's to {by_pose:.1f} {unit}"
                    f"{degrees}."
                )
        if path <= _MOVED_M and turned <= _MOVED_M:
            found.append(f"{topic}: the robot does not move ({path:.2f} m, {turned:.2f} rad).")
        return found


class CommandChecks:
    """Commands against the gate's bounds."""

    def __init__(self) -> None:
        self._rows = Table(2)

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, CommandEvent)
        self._rows.add(event.v, event.omega)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        rows = np.abs(self._rows.array())
        found = _spikes(topic, "yaw rate", "rad/s", rows[:, 1], config.gate.max_yaw_rate, seconds)
        found += _spikes(topic, "speed", "m/s", rows[:, 0], config.gate.max_speed, seconds)
        if not rows.any():
            found.append(f"{topic}: all {len(rows)} commands are zero.")
        return found


class ImuChecks:
    """Gyro and accelerometer for plausibility."""

    def __init__(self) -> None:
        self._rows = Table(6)

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, ImuEvent)
        self._rows.add(*event.angular_velocity, *event.linear_acceleration)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        rows = self._rows.array()
        found = []
        finite = finite_rows(rows)
        if not finite.all():
            found.append(f"{topic}: {count(~finite)} hold NaN or infinity and will be rejected.")
        found += _spikes(topic, "yaw rate", "rad/s", np.abs(rows[:, 2]), config.gate.max_yaw_rate, seconds)
        if not rows[:, :3].any():
            found.append(f"{topic}: the gyro is always zero.")
        gravity = float(np.median(np.linalg.norm(rows[finite, 3:], axis=1))) if finite.any() else 0.0
        if 0.0 < gravity < 8.8 or gravity > 10.8:
            hint = " (unit g?)" if 0.9 < gravity < 1.1 else ""
            found.append(f"{topic}: the acceleration's median is {gravity:.2f} m/s², expected about 9.81{hint}.")
        return found


class TruthChecks:
    """Truth that is not always there."""

    def __init__(self) -> None:
        self._rows = Table(7)

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, TruthEvent)
        self._rows.add(*event.position, *event.orientation)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        rows = self._rows.array()
        found = []
        finite = finite_rows(rows)
        if not finite.all():
            found.append(f"{topic}: {count(~finite)} hold NaN or infinity.")
        found += _quaternions(topic, rows[finite, 3:7])
        if len(seconds) > 1:
            gaps = np.diff(seconds)
            covered = float(gaps[gaps <= config.truth.max_gap_s].sum() / max(seconds[-1] - seconds[0], 1e-9))
            if covered < 0.95:
                found.append(
                    f"{topic}: truth arrives in bursts: gaps of more than {config.truth.max_gap_s:g} s make up "
                    f"{1 - covered:.0%} of the time, where nothing can be compared."
                )
        return found


def _spikes(topic: str, name: str, unit: str, values: FloatArray, bound: float, seconds: FloatArray) -> list[str]:
    beyond = values > bound
    if not beyond.any():
        return []
    at = int(np.argmax(np.where(beyond, values, 0.0)))
    return [
        f"{topic}: {count(beyond)} have a {name} beyond {bound:g} {unit} (up to {values[at]:.4g}, at "
        f"{seconds[at]:.1f} s) and will be rejected."
    ]


def _quaternions(topic: str, quaternions: FloatArray) -> list[str]:
    off = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) > _UNIT_TOLERANCE
    return [f"{topic}: {count(off)} have a quaternion that is not of unit length."] if off.any() else []
