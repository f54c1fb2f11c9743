"""Learned motion as a source of measurements, step by step."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from numpy.typing import ArrayLike

from fgloc import se2
from fgloc.sensors.learned import installation
from fgloc.sensors.learned.config import MotionConfig
from fgloc.sensors.learned.forms import MotionModel
from fgloc.sensors.learned.signals import SignalReader
from fgloc.types import FloatArray, MotionEvent, MotionMeasurement, Step


class LearnedMotion:
    """Turns the commands of a step into a `MotionMeasurement` of source "learned".

    Between contiguous steps it carries the model's own velocity; a gap or a new segment forgets it, and the model
    starts from the commands before the step.

    Attributes:
        rejections: steps without a measurement, by reason: ``learned.no_commands``, ``learned.stale_commands``,
            ``learned.non_finite``, and ``learned.no_gyro``, ``learned.no_effort`` or ``learned.no_wheels`` where a
            signal that the model reads has a gap.
    """

    def __init__(self, model: MotionModel, config: MotionConfig, imu_up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        """Take a loaded model.

        Args:
            model: the model.
            config: whether it is used.
            imu_up: ``(3,)`` the base's z axis in the IMU's frame.
        """
        self.model = model
        self.rejections: Counter[str] = Counter()
        self._use = config.use
        self._scale = config.scale
        self._reader = SignalReader(model.card, imu_up)
        self._velocity: FloatArray | None = None
        self._reached: tuple[int, int] | None = None  # segment and stamp at which that velocity holds

    @property
    def signals_back_ns(self) -> int:
        """How far before a step the measured signals reach that the model reads; 0: it reads none."""
        return self._reader.back_ns

    def fork(
        self, model: MotionModel | None, events: Mapping[type[MotionEvent], Sequence[MotionEvent]]
    ) -> LearnedMotion:
        """A copy that may predict beyond the newest step without changing this one.

        Args:
            model: a copy of this one's, for use in another thread: a model writes into buffers of its own. None: to be
                forked again with one.
            events: of each class, those of the last `signals_back_ns` before the newest step's end.
        """
        forked = copy.copy(self)
        if model is None:
            del forked.model
        else:
            forked.model = model
        forked._reader, forked.rejections = self._reader.fork(events), Counter()
        return forked

    def measure(self, step: Step, gyro_bias: float = 0.0) -> MotionMeasurement | None:
        """Predict the step.

        Args:
            step: its commands must reach ``model.card.history_s`` back for a start from nothing.
            gyro_bias: to be taken out of the IMU's yaw rate [rad/s].

        Returns:
            None if the model is not used or cannot predict; the reason is counted in `rejections`.
        """
        if not self._use:
            return None
        if reason := self._unusable(step):
            self._reject(reason)
            return None
        signals = self._reader.read(step, gyro_bias)
        if isinstance(signals, str):
            self._reject(f"learned.no_{signals}")
            return None
        velocity = self._velocity if self._reached == (step.segment, step.start_ns) else None
        prediction = self.model.predict(step.controls, step.start_ns, step.stamp_ns, velocity, signals)
        if prediction is None:
            self._reject("learned.non_finite")
            return None
        self._velocity = prediction.velocity
        self._reached = (step.segment, step.stamp_ns)
        return MotionMeasurement("learned", step.start_ns, step.stamp_ns, prediction.motion, prediction.cov)

    def measure_scaled(self, step: Step, gyro_bias: float = 0.0) -> MotionMeasurement | None:
        """As `measure`, for this robot: distances are ``motion.scale`` times the model's."""
        m, scale = self.measure(step, gyro_bias), self._scale
        if m is None or scale == 1.0:
            return m
        return replace(m, motion=se2.exp(se2.log(m.motion) * (scale, scale, 1.0)))

    def derivatives(self, motion: FloatArray) -> dict[str, FloatArray]:
        """Of a motion of this source by what it is off by."""
        return installation.derivatives(motion)

    def _unusable(self, step: Step) -> str:
        for command in reversed(step.controls):
            if command.stamp_ns <= step.stamp_ns:
                stale = (step.stamp_ns - command.stamp_ns) * 1e-9 > self.model.card.hold_s
                return "learned.stale_commands" if stale else ""
        return "learned.no_commands"

    def _reject(self, reason: str) -> None:
        self.rejections[reason] += 1
        self._velocity = self._reached = None
