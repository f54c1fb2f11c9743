"""What wheels and IMU measure: rows of a log as encoder ticks, odometry, specific force and means."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fgloc import se2
from fgloc.frames import quaternion_matrix
from fgloc.types import FloatArray
from fgloc_datasets.sim.physics import TICK_S, Log
from fgloc_datasets.sim.scenario import Robot

_GRAVITY = np.array([0.0, 0.0, 9.81])


def odometry(
    log: Log, robot: Robot, every: int, messages: slice = slice(0, None), before: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """What the robot's driver makes of its encoders every ``every`` ticks.

    Args:
        log: of the run.
        robot: whose *nominal* radii and track are taken.
        every: ticks.
        messages: which of them.
        before: ``(3,)`` pose at the message before the first; None: there is none.

    Returns:
        Poses ``(n, 3)`` and twists ``(n, 2)`` (v, ω) of the last interval.
    """
    turned = encoders(log, robot, every, messages)[1]
    left = turned[:, 0::2].mean(axis=1) * robot.radius_m
    right = turned[:, 1::2].mean(axis=1) * robot.radius_m
    along, turn = 0.5 * (left + right), (right - left) / (robot.track_m * robot.track_scale)
    poses = np.zeros((len(turned), 3))
    for i in range(len(poses)):
        last = poses[i - 1] if i else before
        if last is not None:
            poses[i] = se2.compose(last, se2.exp((along[i], 0.0, turn[i])))
    return poses, np.column_stack([along, turn]) / (every * TICK_S)


def encoders(log: Log, robot: Robot, every: int, messages: slice) -> tuple[FloatArray, FloatArray]:
    """Wheel angles of messages in whole encoder ticks, and how far each has turned since the message before [rad]."""
    first = max(messages.start - 1, 0)  # the one before
    last = None if messages.stop is None else (messages.stop - 1) * every + 1
    tick = 2.0 * math.pi / robot.ticks_per_turn
    angles = np.asarray(np.floor(log.wheel_angles[first * every : last : every] / tick) * tick)
    turned = np.diff(angles, axis=0, prepend=angles[:1])
    return angles[messages.start - first :], turned[messages.start - first :]


def specific_force(log: Log, every: int, first: int, last: int, at: Sequence[float]) -> FloatArray:
    """Means of the specific force over the samples ``(n, 3)`` [m/s²] at a place of the base, in its axes."""
    before = max(first - 1, 0)
    part = log.part(slice(before * every, (last - 1) * every + 1, every))
    rotation = np.array([quaternion_matrix(q) for q in part.quaternions])
    speeds = part.velocities + np.einsum("nij,nj->ni", rotation, np.cross(part.rates, at))
    gained = np.diff(speeds, axis=0, prepend=speeds[:1]) / (every * TICK_S) + _GRAVITY
    return np.asarray(np.einsum("nji,nj->ni", rotation, gained)[first - before :])


def mean_over(values: FloatArray, every: int, first: int, last: int) -> FloatArray:
    """Means ``(n, d)`` of the ``every`` ticks up to each of the messages from the first to before the last.

    Message 0 has one tick.
    """
    head = values[:1] if first == 0 else values[:0]
    after = max(first - 1, 0)
    rows = values[1 + after * every : 1 + (last - 1) * every].reshape(-1, every, values.shape[1])
    return np.concatenate([head, rows.mean(axis=1)])
