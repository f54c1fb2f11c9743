"""What the robot's own sensors said in a recording, and how it is told apart into steps."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from fgloc.buffers import EventBuffer
from fgloc.config import Config, GyroConfig, WheelsConfig
from fgloc.motion.card import WheelJoints
from fgloc.motion.signals import Signals, signals_of
from fgloc.sensors.gyro import Gyro
from fgloc.sensors.wheels import WheelMotion
from fgloc.types import CommandEvent, Event, FloatArray, ImuEvent, JointsEvent, OdometryEvent, Step

_STEP_NS = 200_000_000  # of the gyro's filter


class Heard:
    """Commands, IMU, joints and odometry of one recording.

    Attributes:
        commands: in order of stamp.
        imu_up: ``(3,)`` the base's z axis in the IMU's frame.
        wheels: how the robot's wheels are read.
    """

    def __init__(
        self, events: Iterable[Event], config: Config | None = None, imu_up: ArrayLike = (0.0, 0.0, 1.0)
    ) -> None:
        """Keep what a motion model may read.

        Args:
            events: of any kind, in any order.
            config: the robot's.
            imu_up: ``(3,)`` the base's z axis in the IMU's frame.
        """
        config = Config() if config is None else config
        self.wheels: WheelsConfig = config.wheels
        self.imu_up = imu_up
        self._commands: EventBuffer[CommandEvent] = EventBuffer()
        self._imu: EventBuffer[ImuEvent] = EventBuffer()
        self._joints: EventBuffer[JointsEvent] = EventBuffer()
        self._odometry: EventBuffer[OdometryEvent] = EventBuffer()
        for event in events:
            if isinstance(event, CommandEvent):
                self._commands.insert(event)
            elif isinstance(event, ImuEvent):
                self._imu.insert(event)
            elif isinstance(event, JointsEvent):
                self._joints.insert(event)
            elif isinstance(event, OdometryEvent):
                self._odometry.insert(event)
        self.commands = _all(self._commands)
        self._biases = self._gyro_biases(config.gyro)

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
        """All that was heard around a time, as the localizer would get it."""
        return Step(
            index=0,
            segment=0,
            start_ns=start_ns,
            stamp_ns=end_ns,
            odometry=self._odometry.window(start_ns, end_ns),
            commands=self._commands.window(start_ns - round(history_s * 1e9), end_ns),
            joints=self._joints.window(start_ns, end_ns),
            imu=self._imu.window(start_ns, end_ns),
        )

    def gyro_bias(self, stamp_ns: int) -> float:
        """What was known of the gyro's bias [rad/s] at a time."""
        if not len(self._biases):
            return 0.0
        return float(self._biases[max(0, int(np.searchsorted(self._imu.stamps, stamp_ns, "right")) - 1)])

    def signals(self, wanted: tuple[str, ...], origin_ns: int) -> Signals:
        """The wanted signals over the whole recording."""
        return signals_of(
            wanted, _all(self._imu), _all(self._joints), self.joints, origin_ns, self._biases, self.imu_up
        )

    def _gyro_biases(self, config: GyroConfig) -> FloatArray:
        """Bias at each IMU message, by the filter that the localizer uses; nothing but rests teaches it here."""
        stamps = self._imu.stamps
        if not stamps:
            return np.zeros(0)
        gyro, wheels = Gyro(config, self.imu_up), WheelMotion(self.wheels) if self.has_wheels else None
        at, biases = [stamps[0]], [0.0]
        for start in range(stamps[0], stamps[-1], _STEP_NS):
            step = self.step(start, start + _STEP_NS)
            measured = None if wheels is None else wheels.measure(step)
            gyro.measure(step, None if measured is None else measured.motion)
            at.append(step.stamp_ns)
            biases.append(gyro.bias)
        return np.array(biases)[np.searchsorted(at, stamps, "right") - 1]


def _all(buffer: EventBuffer[Event]) -> tuple[Event, ...]:  # type: ignore[type-var]
    return buffer.window(buffer.stamps[0], buffer.stamps[-1]) if buffer.stamps else ()
