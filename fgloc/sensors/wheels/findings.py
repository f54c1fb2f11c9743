"""What looks wrong with the odometry of a recording."""

from __future__ import annotations

import numpy as np

from fgloc.config import Config
from fgloc.sensors.topic_checks import Table, count, finite_rows, spikes, times, unit_length
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Event, FloatArray

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
        found += unit_length(topic, rows[finite, 2:6])
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
        found = spikes(topic, "yaw rate", "rad/s", rate, config.gate.max_yaw_rate, seconds)
        found += spikes(topic, "speed", "m/s", speed, config.gate.max_speed, seconds)
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
