"""From a recording, a map and a configuration to the parts of a run, checked before the run begins."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from fgloc.config import Config
from fgloc.diagnosis.handling import FloorWatch
from fgloc.diagnosis.mistakes import Diagnosis
from fgloc.diagnosis.sanity import Sanity
from fgloc.estimation.localizer import Localizer
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.intake.validation import EventValidator, reported_bounds
from fgloc.recording.reader import Recording
from fgloc.sensor_setup import SensorSetup, StreamFacts, recorded_setup, sensor_setup
from fgloc.sensors.base import Sensor
from fgloc.sensors.equipment import LandmarkSensor, MotionSensors, PoseSensors
from fgloc.sensors.gyro import Attitude, Gyro
from fgloc.sensors.learned.sensor import LearnedMotion
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Camera, LandmarkMap


@dataclass(frozen=True, slots=True, eq=False)
class Assembly:
    """All parts of one run."""

    config: Config
    landmark_map: LandmarkMap | None
    gate: EventValidator
    detector: MarkerDetector | None
    detections: EventValidator  # what the detector found has the stamps of its images, which the gate has seen
    stepper: KeyframeBuilder
    wheels: WheelMotion
    landmarks: LandmarkSensor
    cameras: tuple[Camera, ...]
    learned: LearnedMotion | None
    sensors: tuple[Sensor, ...]
    localizer: Localizer
    diagnosis: Diagnosis
    sanity: Sanity
    notes: tuple[str, ...]

    @property
    def rejections(self) -> Counter[str]:
        """Everything refused by any part so far, by reason."""
        localizer, gyro = self.localizer, self.localizer.motion.sources.gyro
        counters = [self.gate.rejections, self.detections.rejections, self.stepper.rejections, self.wheels.rejections]
        counters += [self.landmarks.rejections, localizer.rejections]
        counters += [] if self.learned is None else [self.learned.rejections]
        counters += [] if gyro is None else [gyro.rejections]
        total: Counter[str] = Counter()
        for counter in counters:
            total.update(counter)
        return total

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences for the user about the parts so far."""
        parts = (self.gate, self.detections, self.stepper, self.wheels)
        return (
            *self.notes,
            *(note for part in parts for note in part.notes),
            *(note for sensor in self.sensors for note in sensor.notes),
            *self.localizer.notes,
        )


def assemble(
    recording: Recording,
    map_path: Path | None,
    config: Config,
    keep_all: bool,
    landmark_map: LandmarkMap | None = None,
    causal: bool = True,
) -> Assembly:
    """Build and check the parts for a recording.

    Args:
        recording: to be run.
        map_path: map; None: landmarks are estimated.
        config: all settings.
        keep_all: as `Localizer` has it.
        landmark_map: the map as it is to be used, if not as the file has it.
        causal: as `KeyframeBuilder` has it.

    Raises:
        FglocError: as `recorded_setup` has it.
    """
    return _assembled(recorded_setup(recording, map_path, config, landmark_map), keep_all, causal)


def assemble_stream(facts: StreamFacts, landmark_map: LandmarkMap | None, config: Config, keep_all: bool) -> Assembly:
    """Build and check the parts for a stream of which these facts are known; otherwise as `assemble`."""
    return _assembled(sensor_setup(facts, landmark_map, config), keep_all)


def _assembled(setup: SensorSetup, keep_all: bool, causal: bool = True) -> Assembly:
    config, landmark_map, sensors = setup.config, setup.landmark_map, setup.sensors
    learned, cameras = setup.learned, setup.cameras
    joint = learned.model.joint if learned is not None and config.motion.correlation == "joint" else None
    wheels = WheelMotion(config.wheels.model_copy(update={"source": "none"}) if setup.unmeasured else config.wheels)
    gyro = None if setup.imu_up is None else Gyro(config.gyro, setup.imu_up)
    watched_gyro = None if setup.imu_up is None else Gyro(config.gyro, setup.imu_up)
    attitude = None if setup.T_base_imu is None else Attitude(config.gyro, setup.T_base_imu)
    flat = config.estimator.ground == "flat"
    tilt = None if flat else attitude
    motion = MotionSensors(wheels, learned, joint, gyro, tilt, not setup.sees, setup.beside, setup.unmeasured)
    landmarks = LandmarkSensor(config, landmark_map, cameras, setup.T_base_sensor)
    seen = LandmarkSensor(config, landmark_map, cameras, setup.T_base_sensor)  # what it refuses does not count
    floor = FloorWatch(attitude, wheels, seen, landmark_map) if flat else None
    known_ids = None if landmark_map is None else set(landmark_map.landmarks)
    streams = [stream for sensor in sensors for stream in sensor.streams]
    named = {topic: camera.name for camera in cameras for topic in camera.topics}
    return Assembly(
        config=config,
        landmark_map=landmark_map,
        gate=EventValidator(reported_bounds(config), known_ids, streams, named),
        detector=setup.detector,
        detections=EventValidator(reported_bounds(config), known_ids, named=named),
        stepper=KeyframeBuilder(config.keyframes, config.gate, config.estimator.lag_s, streams, named, causal),
        wheels=wheels,
        landmarks=landmarks,
        cameras=cameras,
        learned=learned,
        sensors=sensors,
        localizer=Localizer(config, landmark_map, motion, PoseSensors(landmarks, sensors), keep_all),
        diagnosis=Diagnosis(config, landmark_map, cameras, setup.T_base_sensor, setup.imu_up, floor),
        sanity=Sanity(config, landmark_map, cameras, setup.T_base_sensor, wheels, watched_gyro),
        notes=setup.notes,
    )
