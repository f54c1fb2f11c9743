"""Measured signals as functions of time: what a model may read beside commands."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from fgloc.sensors.learned.card import ModelCard, WheelJoints
from fgloc.sensors.wheels.encoders import wheel_names
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import FloatArray, InertialEvent, Step

MAX_GAP_S = 0.25  # a signal without a sample for longer has a gap
_E = TypeVar("_E", InertialEvent, JointsEvent)
_FOREVER_S = 1e4  # the first and the last values hold on; the caller decides whether to use them


class Signal:
    """One or more channels over time, integrated once so that any mean is two look-ups per channel."""

    def __init__(self, times_s: FloatArray, integrals: FloatArray) -> None:
        """Take the integrals.

        Args:
            times_s: ``(n,)`` increasing, at least two.
            integrals: ``(c, n)`` of the channels up to these times; between them each channel is constant.
        """
        n = len(times_s)
        self._times = np.empty(n + 2)
        self._times[1:-1] = times_s
        self._times[0], self._times[-1] = times_s[0] - _FOREVER_S, times_s[-1] + _FOREVER_S
        self._integrals = np.empty((len(integrals), n + 2))
        self._integrals[:, 1:-1] = integrals
        first = (integrals[:, 1] - integrals[:, 0]) / (times_s[1] - times_s[0])
        last = (integrals[:, -1] - integrals[:, -2]) / (times_s[-1] - times_s[-2])
        self._integrals[:, 0] = integrals[:, 0] - _FOREVER_S * first
        self._integrals[:, -1] = integrals[:, -1] + _FOREVER_S * last

    @classmethod
    def of_samples(cls, times_s: FloatArray, values: FloatArray) -> Signal:
        """From samples ``(c, n)``, joined by straight lines."""
        integrals = np.zeros(values.shape)
        np.cumsum(0.5 * (values[:, 1:] + values[:, :-1]) * np.diff(times_s), axis=1, out=integrals[:, 1:])
        return cls(times_s, integrals)

    def integrals(self, times_s: FloatArray) -> FloatArray:
        """Integrals of the channels ``(c, ...)`` up to times ``(...)``."""
        return np.array([np.interp(times_s, self._times, channel) for channel in self._integrals])

    def covers(self, start_s: float, end_s: float) -> bool:
        """Whether no moment between these times is farther than `MAX_GAP_S` from a sample."""
        times = self._times[1:-1]
        first = max(0, int(np.searchsorted(times, start_s, "right")) - 1)
        inside = times[first : int(np.searchsorted(times, end_s, "left")) + 1]
        if not len(inside) or inside[0] > start_s + MAX_GAP_S or inside[-1] < end_s - MAX_GAP_S:
            return False
        return bool((np.diff(inside) <= MAX_GAP_S).all())

    def means(self, limits_s: FloatArray) -> FloatArray:
        """Means ``(..., m - 1, c)`` between neighboring limits ``(..., m)``, strictly monotonic along the last axis."""
        means = np.diff(self.integrals(limits_s)) / np.diff(limits_s)
        return np.ascontiguousarray(np.moveaxis(means, 0, -1))


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """What was measured around a step. Times are seconds since ``origin_ns``.

    Attributes:
        origin_ns: time zero.
        gyro: yaw rate [rad/s], its bias taken out.
        effort: torque [Nm] of both wheels together, and of the right less the left.
        wheels: v [m/s] and ω [rad/s] by the wheels' angles and nominal geometry.
    """

    origin_ns: int
    gyro: Signal | None = None
    effort: Signal | None = None
    wheels: Signal | None = None

    def named(self, name: str) -> Signal | None:
        """By the name that a card's inputs use."""
        return {"gyro": self.gyro, "effort": self.effort, "wheels": self.wheels}[name]


class SignalReader:
    """Keeps of the steps' events what a model reads, for as long as it looks back, and makes signals of it.

    Steps that do not continue the last one, by stamp or segment, begin anew: before the first event of a signal its
    first value is taken to have held.
    """

    def __init__(self, card: ModelCard, imu_up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        """Read what the card's model needs; ``imu_up`` is the base's z axis in the IMU's frame."""
        self._up = np.asarray(imu_up, dtype=float)
        self._wanted = card.measured
        self._joints = card.joints
        self._back_ns = round((card.signal_edges_s[-1] + card.wheel_kinematics.delay_s) * 1e9)
        self._reached: tuple[int, int] | None = None
        self._imu_events: list[InertialEvent] = []
        self._joints_events: list[JointsEvent] = []

    def fork(self) -> SignalReader:
        """A copy that may read on without changing this one."""
        forked = copy.copy(self)
        forked._imu_events, forked._joints_events = list(self._imu_events), list(self._joints_events)
        return forked

    def read(self, step: Step, gyro_bias: float = 0.0) -> Signals | str:
        """Signals over the step and what the model wants before it; else the name of the first one with a hole."""
        if not self._wanted:
            return Signals(step.start_ns)
        if self._reached != (step.segment, step.start_ns):
            self._imu_events.clear()
            self._joints_events.clear()
        self._reached = (step.segment, step.stamp_ns)
        oldest = step.start_ns - self._back_ns
        _follow(self._imu_events, step.inertial, oldest)
        _follow(self._joints_events, step.of(JointsEvent), oldest)
        found = signals_of(
            self._wanted, self._imu_events, self._joints_events, self._joints, step.start_ns, gyro_bias, self._up
        )
        for name in self._wanted:
            signal = found.named(name)
            if signal is None or not signal.covers(0.0, step.dt):
                return name
        return found


def signals_of(
    wanted: Sequence[str],
    imu: Sequence[InertialEvent],
    joints: Sequence[JointsEvent],
    wheel_joints: WheelJoints | None,
    origin_ns: int,
    gyro_bias: ArrayLike = 0.0,
    imu_up: ArrayLike = (0.0, 0.0, 1.0),
) -> Signals:
    """The wanted signals, as far as the events hold them.

    Args:
        wanted: names of inputs.
        imu: in order of stamp.
        joints: in order of stamp.
        wheel_joints: which of the joints are the wheels.
        origin_ns: time zero of the signals.
        gyro_bias: one number, or one for each IMU event [rad/s].
        imu_up: ``(3,)`` the base's z axis in the IMU's frame.
    """
    gyro = _gyro(imu, origin_ns, gyro_bias, imu_up) if "gyro" in wanted else None
    effort = wheels = None
    if wheel_joints is not None:
        effort = _effort(joints, origin_ns, wheel_joints) if "effort" in wanted else None
        wheels = _wheels(joints, origin_ns, wheel_joints) if "wheels" in wanted else None
    return Signals(origin_ns, gyro, effort, wheels)


def _follow(events: list[_E], new: Sequence[_E], oldest_ns: int) -> None:
    """Add what is new and drop what is older than the last one at or before a time."""
    last_ns = events[-1].stamp_ns if events else -1
    events.extend(e for e in new if e.stamp_ns > last_ns)
    first = 0
    while first + 1 < len(events) and events[first + 1].stamp_ns <= oldest_ns:
        first += 1
    del events[:first]


def _gyro(events: Sequence[InertialEvent], origin_ns: int, bias: ArrayLike, up: ArrayLike) -> Signal | None:
    if not events:
        return None
    rates = np.concatenate([e.angular_velocity for e in events]).reshape(-1, 3) @ np.asarray(up) - np.asarray(bias)
    return _of_samples([e.stamp_ns for e in events], rates[None], origin_ns)


def _effort(events: Sequence[JointsEvent], origin_ns: int, joints: WheelJoints) -> Signal | None:
    stamps, (left, right) = _pairs(events, joints, "effort")
    return _of_samples(stamps, np.array([right + left, right - left]), origin_ns)


def _wheels(events: Sequence[JointsEvent], origin_ns: int, joints: WheelJoints) -> Signal | None:
    """By the angles or, where the joints report none, by the rates."""
    if joints.left_radius is None or joints.right_radius is None or joints.track is None:
        return None
    stamps, pair = _pairs(events, joints, "position")
    of_angles = len(stamps) > 1
    if not of_angles:
        stamps, pair = _pairs(events, joints, "velocity")
    left, right = joints.left_radius * pair[0], joints.right_radius * pair[1]
    body = np.array([0.5 * (left + right), (right - left) / joints.track])
    return Signal(_seconds(stamps, origin_ns), body) if of_angles else _of_samples(stamps, body, origin_ns)


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


def _of_samples(stamps: Sequence[int], values: FloatArray, origin_ns: int) -> Signal | None:
    return Signal.of_samples(_seconds(stamps, origin_ns), values) if len(stamps) > 1 else None


def _seconds(stamps: Sequence[int], origin_ns: int) -> FloatArray:
    return np.array([stamp - origin_ns for stamp in stamps]) * 1e-9
