"""What motion models may read of the wheels: their torques, and the motion by their angles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fgloc.sensors.base import MotionRole
from fgloc.sensors.channels import Channel, Mounting, WheelJoints
from fgloc.sensors.signals import Signal, of_stamps, seconds
from fgloc.sensors.wheels.encoders import wheel_names
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import FloatArray


def _effort(events: Sequence[JointsEvent], origin_ns: int, mounting: Mounting) -> Signal | None:
    """Torque [Nm] of both wheels together, and of the right less the left."""
    if mounting.joints is None:
        return None
    stamps, (left, right) = _pairs(events, mounting.joints, "effort")
    return of_stamps(stamps, np.array([right + left, right - left]), origin_ns)


def _motion(events: Sequence[JointsEvent], origin_ns: int, mounting: Mounting) -> Signal | None:
    """V [m/s] and ω [rad/s] by the angles or, where the joints report none, by the rates."""
    joints = mounting.joints
    if joints is None or joints.left_radius is None or joints.right_radius is None or joints.track is None:
        return None
    stamps, pair = _pairs(events, joints, "position")
    of_angles = len(stamps) > 1
    if not of_angles:
        stamps, pair = _pairs(events, joints, "velocity")
    left, right = joints.left_radius * pair[0], joints.right_radius * pair[1]
    body = np.array([0.5 * (left + right), (right - left) / joints.track])
    return Signal(seconds(stamps, origin_ns), body) if of_angles else of_stamps(stamps, body, origin_ns)


def _pairs(events: Sequence[JointsEvent], joints: WheelJoints, what: str) -> tuple[list[int], FloatArray]:
    """Stamps and values ``(2, n)`` of the left and the right wheel, where both are known."""
    stamps: list[int] = []
    values: list[tuple[float, float]] = []
    names: tuple[str, ...] | None = None
    left = right = -1
    for event in events:
        if event.names is not names and event.names != names:
            pair = wheel_names(event.names, joints.left, joints.right) or ("", "")
            left, right = (event.names.index(name) if name in event.names else -1 for name in pair)
        names = event.names
        found: FloatArray = getattr(event, what)
        if left < 0 or right < 0 or len(found) <= max(left, right):
            continue
        a, b = float(found[left]), float(found[right])
        if math.isfinite(a + b):
            stamps.append(event.stamp_ns)
            values.append((a, b))
    return stamps, np.array(values).reshape(-1, 2).T


CHANNELS = (
    Channel("effort", 2, 1, JointsEvent, _effort, needs_joints=True),
    Channel("wheels", 2, 2, JointsEvent, _motion, MotionRole.ODOMETER, needs_joints=True, needs_geometry=True),
)
