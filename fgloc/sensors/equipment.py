"""The sensors of one run: those of the motion, and those whose measurements depend on the robot's pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fgloc.sensors.base import Sensor
from fgloc.sensors.gyro.rate import Gyro
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.learned.joint import JointCalibration
from fgloc.sensors.learned.source import LearnedMotion
from fgloc.sensors.wheels.motion import WheelMotion


@dataclass(frozen=True, slots=True, eq=False)
class MotionSensors:
    """What measures motion.

    Attributes:
        wheels: wheel odometry.
        learned: the learned motion, if any.
        joint: its correlation with the wheels; None: the two are taken as independent.
        gyro: the gyro, if any.
    """

    wheels: WheelMotion
    learned: LearnedMotion | None = None
    joint: JointCalibration | None = None
    gyro: Gyro | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PoseSensors:
    """What measures where the robot is.

    Attributes:
        landmarks: sightings of the map's landmarks.
        registered: sensors of the registry, whose measurements are judged and fused as sightings are.
    """

    landmarks: LandmarkSensor
    registered: Sequence[Sensor] = ()
