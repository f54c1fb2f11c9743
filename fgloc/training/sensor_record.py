"""What the robot's own sensors measured in a recording, and how it is cut into steps."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fgloc.config import Config
from fgloc.intake.event_buffer import EventBuffer
from fgloc.sensors.channels import Mounting, WheelJoints
from fgloc.sensors.gyro.config import GyroConfig
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.sensors.gyro.rate import Gyro
from fgloc.sensors.learned.signals import Signals, signals_of
from fgloc.sensors.wheels.config import WheelsConfig
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import ControlEvent, Event, FloatArray, InertialEvent, Step

_E = TypeVar("_E", bound=Event)

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
        self._commands: EventBuffer[ControlEvent] = EventBuffer()
        self._imu: EventBuffer[ImuEvent] = EventBuffer()
        self._joints: EventBuffer[JointsEvent] = EventBuffer()
        self._odometry: EventBuffer[OdometryEvent] = EventBuffer()
        for event in events:
            if isinstance(event, ControlEvent):
                self._commands.insert(event)
            elif isinstance(event, ImuEvent):
                self._imu.insert(event)
            elif isinstance(event, JointsEvent):
                self._joints.insert(event)
            elif isinstance(event, OdometryEvent):
                self._odometry.insert(event)
        self.commands = _all(self._commands)
        self._biases = self._gyro_biases(config.gyro, truth)

    @property
    def has_wheels(self) -> bool:
        """Whether wheel odometry comes from wheels, not from commands."""
        if self.wheels.source in ("command", "none"):
            return False
        return bool(self._odometry.stamps) or (bool(self._joints.stamps) and self.wheels.left_radius is not None)

    @property
    def joints(self) -> WheelJoints | None:
        """The wheels by name and size; None if there are no joints."""
        if not self._joints.stamps:
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
                OdometryEvent: self._odometry.window(start_ns, end_ns),
                ControlEvent: self._commands.window(start_ns - round(history_s * 1e9), end_ns),
                JointsEvent: self._joints.window(start_ns, end_ns),
                ImuEvent: self._imu.window(start_ns, end_ns),
            },
        )

    def gyro_bias(self, stamp_ns: int) -> float:
        """What was known of the gyro's bias [rad/s] 10 s before a time, as after 10 s of dead reckoning."""
        if not len(self._biases):
            return 0.0
        return float(self._biases[max(0, int(np.searchsorted(self._imu.stamps, stamp_ns, "right")) - 1)])

    def signals(self, wanted: tuple[str, ...], origin_ns: int) -> Signals:
        """The wanted signals over the whole recording."""
        events = {InertialEvent: _all(self._imu), JointsEvent: _all(self._joints)}
        return signals_of(wanted, events.__getitem__, origin_ns, Mounting(self.joints, self._biases, self.imu_up))

    def _gyro_biases(self, config: GyroConfig, truth: tuple[NDArray[np.int64], FloatArray] | None) -> FloatArray:
        """What the localizer's own filter knew of the bias some time before each IMU message."""
        stamps = self._imu.stamps
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


def _all(buffer: EventBuffer[_E]) -> tuple[_E, ...]:
    return buffer.window(buffer.stamps[0], buffer.stamps[-1]) if buffer.stamps else ()
