"""Wheel odometry and joint states from plain numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fgloc.frames import yaw_quaternion
from fgloc.sensors.event_input import BASE, EventInput
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent


class WheelsInput(EventInput):
    """What wheels report."""

    def odometry(
        self,
        stamp_ns: int,
        pose: Sequence[float] | None = None,
        twist: Sequence[float] | None = None,
        frame_id: str = "odom",
    ) -> None:
        """Wheel odometry.

        Args:
            stamp_ns: when it was measured.
            pose: x, y [m], yaw [rad] in the odometry's own frame; None: it has none.
            twist: forward, left [m/s], yaw rate [rad/s] of the base; None: it has none.
            frame_id: of the pose.
        """
        unknown = np.full(3, np.nan)
        x, y, yaw = unknown if pose is None else np.asarray(pose, dtype=float)
        vx, vy, w = unknown if twist is None else np.asarray(twist, dtype=float)
        position = np.array([x, y, 0.0])
        orientation = np.full(4, np.nan) if np.isnan(yaw) else yaw_quaternion(float(yaw))
        linear, angular = np.array([vx, vy, 0.0]), np.array([0.0, 0.0, w])
        none = np.zeros((6, 6))
        when = self._when("odometry", stamp_ns)
        self._deliver(OdometryEvent(*when, frame_id, BASE, position, orientation, none, linear, angular, none))

    def joints(
        self,
        stamp_ns: int,
        names: Sequence[str],
        position: ArrayLike = (),
        velocity: ArrayLike = (),
        effort: ArrayLike = (),
    ) -> None:
        """Joint states: angles [rad], rates [rad/s] and torques [Nm] by joint; what is not measured is left out."""
        arrays = (np.asarray(a, dtype=float) for a in (position, velocity, effort))
        self._deliver(JointsEvent(*self._when("joints", stamp_ns), tuple(names), *arrays))
