"""What motion models may read of the wheels: their torques, and the motion by their angles."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

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
    values: list[FloatArray] = [np.empty((0, 2))]
    for names, group in groupby(events, key=lambda event: event.names):
        pair = wheel_names(names, joints.left, joints.right) or ("", "")
        at = [names.index(name) for name in pair if name in names]
        reported = [(event.stamp_ns, getattr(event, what)) for event in group]
        reported = [(stamp, found) for stamp, found in reported if len(found) == len(names)]
        if len(at) == 2 and reported:
            stamps += [stamp for stamp, _ in reported]
            values.append(np.array([found for _, found in reported])[:, at])
    both = np.concatenate(values)
    known = np.flatnonzero(np.isfinite(both).all(axis=1)).tolist()
    return [stamps[k] for k in known], both[known].T


CHANNELS = (
    Channel("effort", 2, 1, JointsEvent, _effort, needs_joints=True),
    Channel("wheels", 2, 2, JointsEvent, _motion, MotionRole.ODOMETER, needs_joints=True, needs_geometry=True),
)
