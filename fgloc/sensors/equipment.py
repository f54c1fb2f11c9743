"""The sensors of one run: those of the motion, and those whose measurements depend on the robot's pose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import ArrayLike

from fgloc.sensors.base import Sensor, Turn
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.types import FloatArray, InertialEvent, InertialReading, MotionEvent, MotionMeasurement, Step


class Odometer(Protocol):
    """Measures every step; what others are compared to."""

    @property
    def rejections(self) -> Counter[str]:
        """What could not be used so far, by reason."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know so far, one sentence each."""
        ...

    @property
    def source(self) -> str:
        """Where the motion comes from; empty before anything was received."""
        ...

    @property
    def from_commands(self) -> bool:
        """Whether control inputs stand in for it."""
        ...

    @property
    def track_m(self) -> float | None:
        """Distance of left and right [m], to tell them apart; None: not known."""
        ...

    def measure(self, step: Step) -> MotionMeasurement | None:
        """Motion over the step; measured again, the same step gives the same."""
        ...

    def motion_between(self, step: Step, from_ns: int, to_ns: int) -> tuple[FloatArray, FloatArray]:
        """``T_from_to (3,)`` between two times near the step, with its covariance ``(3, 3)``."""
        ...

    def twist(self, step: Step, at_ns: int) -> FloatArray:
        """Of the base ``(3,)`` at a time near the step's end."""
        ...

    def derivatives(
        self,
        step: Step,
        m: MotionMeasurement,
        wanted: Container[str] = (),
        rates: tuple[float, FloatArray] | None = None,
    ) -> dict[str, FloatArray]:
        """Of a step's motion by what the sensor is off by; weight and ``(2,)`` yaw rates at its ends of another."""
        ...


class RateSensor(Protocol):
    """Measures the turn alone, with a bias."""

    bias: float
    bias_variance: float
    rejections: Counter[str]

    @property
    def up(self) -> FloatArray:
        """The base's z axis ``(3,)`` in the sensor's frame, times the scale of its rates."""
        ...

    @property
    def at_rest(self) -> bool:
        """Whether over the last step, and for a while, it has shown nothing but its bias beside wheels that stand."""
        ...

    def measure(self, step: Step, wheels: ArrayLike | None, since_fix_s: float = 0.0) -> Turn | None:
        """Turn over the step."""
        ...

    def rates_at(self, events: Any, stamps_ns: tuple[int, ...]) -> FloatArray:
        """Yaw rates [rad/s] at these times."""
        ...

    def derivatives(self, motion: FloatArray) -> dict[str, FloatArray]:
        """Of a motion with this turn by what the sensor is off by."""
        ...

    def turned(self, yaw: float, seconds: float) -> None:
        """The robot went on by a step."""
        ...

    def fix(self, yaw: float, variance: float, apart_s: float = 0.0) -> None:
        """Take in a yaw that fixes determine; the turn between two that are ``apart_s`` apart corrects the bias."""
        ...

    def forget_fix(self) -> None:
        """Nothing connects what comes with the last fix."""
        ...

    def resume(self, bias: float, bias_variance: float) -> None:
        """Go on from what an earlier run learned."""
        ...

    def fork(self) -> Any:
        """A copy that may go on without changing this one."""
        ...


class AttitudeSensor(Protocol):
    """Measures roll and pitch."""

    def measure(self, step: Step, twist: Callable[[Step, int], FloatArray]) -> InertialReading | None:
        """Of a step; ``twist`` tells that of the base at a time near its end."""
        ...

    def rates_at(self, events: Sequence[InertialEvent], at_ns: int) -> FloatArray:
        """Angular velocity ``(3,)`` [rad/s] of the base at a time."""
        ...


class MotionPredictor(Protocol):
    """Predicts the motion from control inputs, by a model.

    Attributes:
        model: with its card.
        rejections: steps without a prediction, by reason.
    """

    model: Any
    rejections: Counter[str]

    def measure_scaled(self, step: Step, gyro_bias: float = 0.0) -> MotionMeasurement | None:
        """Predict the step, for this robot."""
        ...

    def derivatives(self, motion: FloatArray) -> dict[str, FloatArray]:
        """Of a predicted motion by what the model is off by."""
        ...

    @property
    def signals_back_ns(self) -> int:
        """How far before a step the measured signals reach that the model reads; 0: it reads none."""
        ...

    def fork(self, model: Any, events: Mapping[type[MotionEvent], Sequence[MotionEvent]]) -> Any:
        """A copy, which may go on without changing this one.

        Args:
            model: another copy of the model; None: the copy is to be forked again with one.
            events: of each class, those of the last `signals_back_ns` before the newest step's end.
        """
        ...


class ErrorCorrelation(Protocol):
    """How the errors of odometer and predictor go together."""

    def difference_cov(self, W: FloatArray, N: FloatArray) -> FloatArray:
        """Covariance ``(3, 3)`` of the difference of the two motions."""
        ...

    def decorrelate(self, wheels: MotionMeasurement, learned: MotionMeasurement) -> MotionMeasurement:
        """The predicted motion that may enter beside the odometer's as if independent."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class MotionSensors:
    """What measures motion.

    Attributes:
        wheels: wheel odometry.
        learned: the learned motion, if any.
        joint: its correlation with the wheels; None: the two are taken as independent.
        gyro: the gyro, if any.
        attitude: roll and pitch, on uneven ground; None: it is flat, or nothing measures them.
    """

    wheels: Odometer
    learned: MotionPredictor | None = None
    joint: ErrorCorrelation | None = None
    gyro: RateSensor | None = None
    attitude: AttitudeSensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PoseSensors:
    """What measures where the robot is.

    Attributes:
        landmarks: sightings of the map's landmarks.
        registered: sensors of the registry, whose measurements are judged and fused as sightings are.
    """

    landmarks: LandmarkSensor
    registered: Sequence[Sensor] = ()
