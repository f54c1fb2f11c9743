"""What the robot's own sensors measured in a recording, and how it is cut into steps."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fgloc.config import Config
from fgloc.intake.keyframing import EventBuffer
from fgloc.sensors.base import Mounting, WheelJoints
from fgloc.sensors.gyro import Gyro, ImuEvent
from fgloc.sensors.learned.card import Signals, signals_of
from fgloc.sensors.settings import GyroConfig, WheelsConfig
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import ControlEvent, Event, FloatArray, InertialEvent, MotionEvent, Step

_STEP_NS = 200_000_000  # of the gyro's filter
_NO_FIX_NS = 10_000_000_000  # without a fix: no window that is judged may have taught the bias it is judged with
_FIRST_NS = 2_000_000_000
_FIX_SIGMA = 0.002  # rad
_MAX_TRUTH_GAP_NS = 200_000_000


class SensorRecord:
    """Commands, IMU, joints and odometry of one recording.

    Attributes:
        commands: in order of stamp.
        imu_up: ``(3,)`` the base's z axis in the IMU's frame.
        wheels: how the robot's wheels are read.
    """

    def __init__(
        self,
        events: Iterable[Event],
        config: Config | None = None,
        imu_up: ArrayLike = (0.0, 0.0, 1.0),
        truth: tuple[NDArray[np.int64], FloatArray] | None = None,
    ) -> None:
        """Keep what a motion model may read.

        Args:
            events: of any kind, in any order.
            config: the robot's.
            imu_up: ``(3,)`` the base's z axis in the IMU's frame.
            truth: stamps ``(n,)`` and poses ``(n, 3)``: the fixes from which the gyro's bias is learned, as the
                localizer learns it from sightings. None: from rests alone.
        """
        config = Config() if config is None else config
        self.wheels: WheelsConfig = config.wheels
        self.imu_up = imu_up
        kinds = (ControlEvent, ImuEvent, JointsEvent, OdometryEvent)
        self._buffers: dict[type[MotionEvent], EventBuffer[Any]] = {kind: EventBuffer() for kind in kinds}
        for event in events:
            if isinstance(event, kinds):
                self._buffers[type(event)].insert(event)
        self.commands: tuple[ControlEvent, ...] = self._all(ControlEvent)
        self._biases = self._gyro_biases(config.gyro, truth)

    @property
    def has_wheels(self) -> bool:
        """Whether wheel odometry comes from wheels, not from commands."""
        if self.wheels.source in ("command", "none"):
            return False
        by_joints = bool(self._stamps(JointsEvent)) and self.wheels.left_radius is not None
        return by_joints or bool(self._stamps(OdometryEvent))

    @property
    def joints(self) -> WheelJoints | None:
        """The wheels by name and size; None if there are no joints."""
        if not self._stamps(JointsEvent):
            return None
        w = self.wheels
        return WheelJoints(
            left=w.left_joint,
            right=w.right_joint,
            left_radius=w.left_radius,
            right_radius=w.right_radius,
            track=w.track,
        )

    def step(self, start_ns: int, end_ns: int, history_s: float = 0.0) -> Step:
        """All messages around a time, as the localizer would get them."""
        return Step(
            index=0,
            segment=0,
            start_ns=start_ns,
            stamp_ns=end_ns,
            motion={
                kind: buffer.window(start_ns - round(history_s * 1e9), end_ns, beyond=False)
                if kind is ControlEvent
                else buffer.window(start_ns, end_ns)
                for kind, buffer in self._buffers.items()
            },
        )

    def gyro_bias(self, stamp_ns: int) -> float:
        """What was known of the gyro's bias [rad/s] 10 s before a time, as after 10 s of dead reckoning."""
        if not len(self._biases):
            return 0.0
        return float(self._biases[max(0, int(np.searchsorted(self._stamps(ImuEvent), stamp_ns, "right")) - 1)])

    def signals(self, wanted: tuple[str, ...], origin_ns: int) -> Signals:
        """The wanted signals over the whole recording."""
        events = {InertialEvent: self._all(ImuEvent), JointsEvent: self._all(JointsEvent)}
        return signals_of(wanted, events.__getitem__, origin_ns, Mounting(self.joints, self._biases, self.imu_up))

    def _stamps(self, kind: type[MotionEvent]) -> list[int]:
        return self._buffers[kind].stamps

    def _all(self, kind: type[MotionEvent]) -> tuple[Any, ...]:
        stamps = self._stamps(kind)
        return self._buffers[kind].window(stamps[0], stamps[-1]) if stamps else ()

    def _gyro_biases(self, config: GyroConfig, truth: tuple[NDArray[np.int64], FloatArray] | None) -> FloatArray:
        """What the localizer's own filter knew of the bias some time before each IMU message."""
        stamps = self._stamps(ImuEvent)
        if not stamps:
            return np.zeros(0)
        gyro, wheels = Gyro(config, self.imu_up), WheelMotion(self.wheels) if self.has_wheels else None
        at, biases = [stamps[0]], [0.0]
        for start in range(stamps[0], stamps[-1], _STEP_NS):
            step = self.step(start, start + _STEP_NS)
            measured = None if wheels is None else wheels.measure(step)
            turn = gyro.measure(step, None if measured is None else measured.motion)
            if turn is None:
                gyro.forget_fix()
            else:
                gyro.turned(turn.yaw, step.dt)
            at.append(step.stamp_ns)
            if truth is not None and (yaw := _yaw_at(*truth, step.stamp_ns)) is not None:
                gyro.fix(yaw, _FIX_SIGMA**2)
            biases.append(gyro.bias)
        known = np.searchsorted(at, np.array(stamps) - _NO_FIX_NS, "right") - 1
        first = np.searchsorted(at, stamps[0] + _FIRST_NS)  # a robot rests before it sets out
        return np.array(biases)[np.maximum(known, np.minimum(np.searchsorted(at, stamps, "right") - 1, first))]


def _yaw_at(stamps_ns: NDArray[np.int64], poses: FloatArray, at_ns: int) -> float | None:
    """Yaw [rad] between the poses around a time; None if there is no truth there."""
    k = int(np.searchsorted(stamps_ns, at_ns, "right")) - 1
    if k < 0 or k + 1 >= len(stamps_ns) or stamps_ns[k + 1] - stamps_ns[k] > _MAX_TRUTH_GAP_NS:
        return None
    share = (at_ns - stamps_ns[k]) / (stamps_ns[k + 1] - stamps_ns[k])
    return float(poses[k, 2] + share * math.remainder(poses[k + 1, 2] - poses[k, 2], math.tau))
