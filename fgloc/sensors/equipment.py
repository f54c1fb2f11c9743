"""The sensors of one run: those of motion and of landmarks, and sightings moved from their exposure to the keyframe."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any

import numpy as np

from fgloc.config import Config
from fgloc.frames import homogeneous, rotation_of
from fgloc.sensors import registry
from fgloc.sensors.base import Sensor
from fgloc.sensors.gyro import Attitude, Gyro
from fgloc.sensors.landmarks import SightingContext
from fgloc.sensors.learned.network import JointCalibration
from fgloc.sensors.learned.sensor import LearnedMotion
from fgloc.sensors.measurements import LandmarkMeasurement, LandmarkSighting
from fgloc.sensors.odometry import BesideOdometry
from fgloc.sensors.wheels.motion import WheelMotion, mean_twist
from fgloc.types import (
    Camera,
    FloatArray,
    LandmarkMap,
    SightingsEvent,
    Step,
    camera_of,
)

_Measurers = dict[type, Callable[[Any], Iterator[LandmarkSighting]]]


class LandmarkSensor:
    """Turns sightings into measurements, by the sensor that they are of.

    Two sightings of one id in one message: both are dropped, as nothing shows which one is false.

    ``rejections`` counts what was not used: "sightings.duplicate_id", ".unknown_id", ".beyond_max" (more markers than
    ``markers.max_sightings``, the smallest go), ".no_size", ".undistortable", ".no_pose", ".range", ".bearing_bound".
    """

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | None,
        camera: Camera | Sequence[Camera] | None,
        T_base_sensor: FloatArray | None,
    ) -> None:
        """Prepare the conversion.

        Args:
            config: all settings.
            landmark_map: the known map; None if landmarks are estimated.
            camera: of corners, or several, each for the corners of its topics; None if there is none.
            T_base_sensor: ``(4, 4)`` takes coordinates as the sensor reports them (optical axes included) to the base;
                None: they are in the base frame.
        """
        place = np.eye(4) if T_base_sensor is None else np.asarray(T_base_sensor, dtype=float)
        self.cameras = () if camera is None else (camera,) if isinstance(camera, Camera) else tuple(camera)
        one = self.cameras[0] if len(self.cameras) == 1 else None
        self._context = SightingContext(config, landmark_map, one, place)
        self._measure: _Measurers = registry.measurers(self._context)
        self._of_camera: dict[str, _Measurers] = {}  # by name, of several
        if one is None:
            contexts = {camera.name: replace(self._context, camera=camera) for camera in self.cameras}
            self._of_camera = {name: registry.measurers(context) for name, context in contexts.items()}

    @property
    def rejections(self) -> Counter[str]:
        """Number of sightings that were not used, by reason; see the class."""
        return self._context.rejections

    @property
    def sees_corners(self) -> bool:
        """Whether there is a camera, so that sightings may be corners in images."""
        return bool(self.cameras)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the cameras; "" of one that is alone."""
        return tuple(camera.name for camera in self.cameras)

    def camera_name(self, event: SightingsEvent) -> str:
        """Name of the camera that a message is of; "" if there are not several."""
        camera = camera_of(self.cameras, event.topic)
        return "" if camera is None else camera.name

    def measure(self, event: SightingsEvent) -> tuple[LandmarkSighting, ...]:
        """Measurements of the landmarks in one message.

        Raises:
            CameraError: marker corners, but no camera.
            ConfigError: marker corners without map, and no marker size.
        """
        measurers = self._of_camera.get(self.camera_name(event), self._measure)
        return tuple(measurers[type(event)](event))

    def known(self, measurements: Iterable[LandmarkMeasurement]) -> list[LandmarkMeasurement]:
        """Measurements of a registered sensor, as the settings calibrate sightings.

        Those of landmarks that the map does not have are left out and counted as rejected.
        """
        landmark_map, section, kept = self._context.landmark_map, self._context.config.landmarks, []
        scale, bias_rad = section.range_scale, section.bearing_bias_rad
        for m in measurements:
            if m.of_landmark and (landmark_map is None or not (m.unnamed or m.landmark_id in landmark_map)):
                self._context.rejections[f"{m.counted_as}.unknown_id"] += 1
            else:
                kept.append(m if (scale, bias_rad) == (1.0, 0.0) else m.calibrated(scale, bias_rad))
        return kept


@dataclass(frozen=True, slots=True, eq=False)
class MotionSensors:
    """Sensors of the robot's motion.

    Attributes:
        wheels: wheel odometry.
        learned: the learned motion, if any.
        joint: its correlation with the wheels; None: the two are taken as independent.
        gyro: the gyro, if any.
        attitude: roll and pitch, on uneven ground; None: it is flat, or nothing measures them.
        alone: nothing in the stream can tell where the robot is.
        beside: odometries beside the wheels.
        unmeasured: none of these has a topic in the stream: sightings alone show how the robot moves.
    """

    wheels: WheelMotion
    learned: LearnedMotion | None = None
    joint: JointCalibration | None = None
    gyro: Gyro | None = None
    attitude: Attitude | None = None
    alone: bool = False
    beside: Sequence[BesideOdometry] = ()
    unmeasured: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class PoseSensors:
    """Sensors of the robot's pose.

    Attributes:
        landmarks: sightings of the map's landmarks.
        registered: sensors of the registry, whose measurements are judged and fused as sightings are.
    """

    landmarks: LandmarkSensor
    registered: Sequence[Sensor] = ()


_SHORT_NS = 100_000_000  # over so short a time the rate of turn is that at the exposure


def _tilt(rates: FloatArray, seconds: float) -> FloatArray:
    """Tilt ``(4, 4)`` of the base in a time, by its roll and pitch rates ``(2,)``; none over a long one."""
    turned = rates * (seconds if abs(seconds) < 1e-9 * _SHORT_NS else 0.0)
    return homogeneous(rotation_of((*turned.tolist(), 0.0)))


class MotionCompensation:
    """Moves sightings from their exposure to the keyframe, by the wheels and, where it is measured, the gyro's turn.

    Where commands stand in for wheels, a model of the same commands takes their place, if it tells the motion between
    any two times: a robot follows its commands late.
    """

    def __init__(self, poses: PoseSensors, motion: MotionSensors, jitter_s: float) -> None:
        """Take the sensors, and the sigma ``jitter_s`` [s] of the stamp of each single image."""
        self._landmarks, self._jitter_s = poses.landmarks, jitter_s
        self._wheels, self._gyro, self._attitude = motion.wheels, motion.gyro, motion.attitude
        self._learned = motion.learned
        self._sensor_of = {stream.event: sensor for sensor in poses.registered for stream in sensor.streams}

    def measure(self, step: Step, late_s: float | Callable[[str], float]) -> list[LandmarkMeasurement]:
        """Measurements of a step, moved to its end.

        Args:
            step: the newest one.
            late_s: how late stamps of sightings are, as far as is known, or a function that gives it by the name of
                the camera; what is left of it, the residual sees with the speed at the exposure.
        """
        measured: list[LandmarkMeasurement] = []
        for event in step.sightings:
            found = self._landmarks.measure(event)
            if not found:
                continue
            offset_s = late_s(self._landmarks.camera_name(event)) if callable(late_s) else late_s
            exposure_ns = event.stamp_ns - round(offset_s * 1e9)
            twist = self.twist(step, exposure_ns)
            late = [m.exposed(twist, offset_s, self._jitter_s) for m in found]
            if self._attitude is not None and step.inertial:
                rates = self._attitude.rates_at(step.inertial, exposure_ns)[:2]
                tilt = _tilt(rates, (exposure_ns - step.stamp_ns) * 1e-9)
                late = [m.tilted(tilt, rates) for m in late]
            if exposure_ns != step.stamp_ns:
                motion, cov = self._motion_to(step, exposure_ns)
                late = [m.compensated(motion, cov) for m in late]
            measured.extend(late)
        for sensed in step.sensed:
            now = self._landmarks.known(self._sensor_of[type(sensed)].measure(sensed))
            for stamp_ns, same in groupby(now, key=lambda m: m.stamp_ns):
                twist = self.twist(step, stamp_ns)
                made = [m.exposed(twist, 0.0, self._jitter_s) for m in same]
                if stamp_ns != step.stamp_ns:
                    motion, cov = self._motion_to(step, stamp_ns)
                    made = [m.compensated(motion, cov) for m in made]
                measured.extend(made)
        return measured

    def _motion_to(self, step: Step, at_ns: int) -> tuple[FloatArray, FloatArray]:
        """Motion ``T_keyframe_then`` ``(3,)`` to another time, with its covariance ``(3, 3)``."""
        motion, cov = self._moved(step, step.stamp_ns, at_ns)
        turned = None if self._gyro is None else self._turned(self._gyro, step, at_ns)
        return (motion if turned is None else np.array([*motion[:2], turned])), cov

    def _moved(self, step: Step, start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray]:
        """Motion ``(3,)`` between two times, with its covariance ``(3, 3)``, by the model of commands or the wheels."""
        learned = self._learned if self._wheels.from_commands else None
        by_model = None if learned is None else learned.motion_between(step, start_ns, end_ns)
        return self._wheels.motion_between(step, start_ns, end_ns) if by_model is None else by_model

    def _turned(self, gyro: Gyro, step: Step, at_ns: int) -> float | None:
        """Yaw of ``T_keyframe_then`` [rad] by the gyro; None: it was silent for some of that time."""
        events = step.inertial
        if not events:
            return None
        if abs(at_ns - step.stamp_ns) < _SHORT_NS:
            return float(gyro.rates_at(events, (at_ns,))[0] * (at_ns - step.stamp_ns) * 1e-9)
        first, last = sorted((at_ns, step.stamp_ns))
        nodes = [first, *(e.stamp_ns for e in events if first < e.stamp_ns < last), last]
        if np.diff(nodes).max() > _SHORT_NS:
            return None
        turn = float(np.trapezoid(gyro.rates_at(events, tuple(nodes)), np.array([n - first for n in nodes]) * 1e-9))
        return turn if at_ns > step.stamp_ns else -turn

    def twist(self, step: Step, at_ns: int) -> FloatArray:
        """Twist ``(3,)`` of the base [m/s, m/s, rad/s] at a time near the step's end."""
        twist = mean_twist(partial(self._moved, step), at_ns)
        if self._gyro is not None and step.inertial:
            twist[2] = self._gyro.rates_at(step.inertial, (at_ns,))[0]
        return twist
