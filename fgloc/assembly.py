"""From a recording, a map and a configuration to the parts of a run, checked before the run begins."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgloc.config import Config, Role
from fgloc.diagnosis import Diagnosis
from fgloc.errors import CameraError, ConfigError, RecordingError
from fgloc.frames import BASE_NAMES, rpy_matrix
from fgloc.intake.keyframing import Stepper
from fgloc.intake.validation import Gate
from fgloc.localizer import Localizer
from fgloc.motion import load_model
from fgloc.motion.source import LearnedMotion
from fgloc.recording.reader import Recording
from fgloc.sensors.cameras import camera_from_info, corrected, load_camera, rescaled
from fgloc.sensors.gyro import Gyro
from fgloc.sensors.images import ImageError, decode
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.maps import load_map
from fgloc.sensors.markers import MarkerDetector
from fgloc.sensors.wheels import WheelMotion
from fgloc.types import (
    Camera,
    CameraInfoEvent,
    CornersEvent,
    Event,
    FloatArray,
    ImageEvent,
    ImuEvent,
    LandmarkMap,
    MarkerPosesEvent,
    OdometryEvent,
    RangeBearingEvent,
)

_OPTICAL_TO_BODY = np.array(
    [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
)  # optical axes in body axes (REP 103)
_SCAN_EVENTS = 20_000  # how far into a recording an image that can be decoded is looked for


@dataclass(frozen=True, slots=True, eq=False)
class Assembly:
    """All parts of one run."""

    config: Config
    landmark_map: LandmarkMap | None
    gate: Gate
    detector: MarkerDetector | None
    detections: Gate  # what the detector found has the stamps of its images, which the gate has seen
    stepper: Stepper
    wheels: WheelMotion
    landmarks: LandmarkSensor
    camera: Camera | None
    learned: LearnedMotion | None
    localizer: Localizer
    diagnosis: Diagnosis
    notes: tuple[str, ...]


def assemble(
    recording: Recording,
    map_path: Path | None,
    config: Config,
    keep_all: bool,
    landmark_map: LandmarkMap | None = None,
) -> Assembly:
    """Build and check the parts.

    Args:
        recording: to be run.
        map_path: map; None: landmarks are estimated.
        config: all settings.
        keep_all: as `Localizer` has it.
        landmark_map: the map as it is to be used, if not as the file has it.

    Raises:
        RecordingError: nothing in the recording says how the robot moves, or a frame is missing.
        CameraError: the calibration is missing, unusable or does not fit the images.
        MapError, ModelError, ConfigError: as their loaders have it.
    """
    if not {"odometry", "joints", "command", "imu"} & set(recording.roles):
        raise RecordingError(
            f"{recording.path}: no odometry, joint states or commands, and no IMU; a run needs one of them. Topics: "
            f"{', '.join(f'{t.name} ({t.message_type})' for t in recording.topics) or 'none'}"
        )
    if landmark_map is None and map_path is not None:
        landmark_map = load_map(map_path, config.markers.default_size_m)
    notes = list(landmark_map.notes) if landmark_map is not None else []
    if not {"odometry", "joints", "command"} & set(recording.roles):
        notes.append(
            "No odometry, joint states or commands: between sightings the robot may have gone as far as a fifth of "
            "gate.max_speed takes it."
        )
    first = _first_events(recording)
    camera = _camera(recording, config, first) if "image" in recording.roles or CornersEvent in first else None
    notes += camera.notes if camera is not None else ()
    T_base_sensor = _sensor_pose(recording, config, first, notes)
    if map_path is None and landmark_map is None and {"image", "sightings"} & set(recording.roles):
        config = resolved(config, map_path)
        notes.append(
            "No map: landmarks are estimated with the trajectory, by the whole-run estimator, and the first pose is "
            "the map's origin; for long runs build the map once with `fgloc map`."
        )
    detector = None
    if "image" in recording.roles:
        dictionary = config.markers.dictionary or (landmark_map.dictionary if landmark_map is not None else "")
        if not dictionary:
            raise ConfigError(
                "no marker dictionary: set markers.dictionary (such as DICT_4X4_50) in --config or the map"
            )
        detector = MarkerDetector(dictionary, config.markers)
    learned = joint = None
    if config.motion.use and config.motion.model is not None:
        model = load_model(config.motion.model)
        learned = LearnedMotion(model, config.motion, mounted_up(recording, config, first))
        joint = model.joint if config.motion.correlation == "joint" else None
    wheels = WheelMotion(config.wheels)
    imu_up = mounted_up(recording, config, first) if "imu" in recording.roles and config.gyro.use else None
    gyro = None if imu_up is None else Gyro(config.gyro, imu_up)
    landmarks = LandmarkSensor(config, landmark_map, camera, T_base_sensor)
    seen_by: Role = "sightings" if detector is None else "image"
    known_ids = None if landmark_map is None else set(landmark_map.landmarks)
    return Assembly(
        config=config,
        landmark_map=landmark_map,
        gate=Gate(config.gate, known_ids),
        detector=detector,
        detections=Gate(config.gate, known_ids),
        stepper=Stepper(config.keyframes, config.gate, config.estimator.lag_s),
        wheels=wheels,
        landmarks=landmarks,
        camera=camera,
        learned=learned,
        localizer=Localizer(config, landmark_map, wheels, landmarks, learned, joint, keep_all, gyro),
        diagnosis=Diagnosis(config, landmark_map, camera, T_base_sensor, seen_by, imu_up),
        notes=tuple(notes),
    )


def resolved(config: Config, map_path: Path | None) -> Config:
    """The configuration a run uses: without a map landmarks are variables, which the fixed lag would forget."""
    if map_path is not None or config.estimator.kind != "fixed_lag":
        return config
    return config.model_copy(update={"estimator": config.estimator.model_copy(update={"kind": "isam2"})})


def _first_events(recording: Recording) -> dict[type[Event], Event]:
    """The first event of each kind, from as far into the recording as it takes for every topic to speak."""
    found: dict[type[Event], Event] = {}
    silent = set(recording.roles.values())
    for event in recording.events():
        found.setdefault(type(event), event)
        silent.discard(event.topic)
        if not silent:
            break
    return found


def _base_frame(recording: Recording, config: Config, first: dict[type[Event], Event]) -> str:
    if config.recording.base_frame is not None:
        return config.recording.base_frame
    for name in BASE_NAMES:
        if name in recording.frames:
            return name
    odometry = first.get(OdometryEvent)
    return odometry.child_frame_id if isinstance(odometry, OdometryEvent) else BASE_NAMES[0]


def _camera(recording: Recording, config: Config, first: dict[type[Event], Event]) -> Camera:
    info = first.get(CameraInfoEvent)
    image = first.get(ImageEvent)
    seen = (info, image, first.get(CornersEvent))
    frame = next((e.frame_id for e in seen if isinstance(e, CameraInfoEvent | ImageEvent | CornersEvent)), "")
    T_base_cam = given_pose(config, default_axes="optical")
    if T_base_cam is None:
        T_base_cam = recording.frames.lookup(_base_frame(recording, config, first), frame)
    if config.camera.file is not None:
        camera = load_camera(config.camera.file, T_base_cam)
    elif isinstance(info, CameraInfoEvent):
        camera = camera_from_info(info, T_base_cam)
    else:
        raise CameraError(
            f"{recording.path}: images or marker corners, but no sensor_msgs/CameraInfo; "
            "set camera.file to a calibration YAML in --config"
        )
    size = _image_size(recording)
    if size is None or not camera.width or size == (camera.width, camera.height):
        return corrected(camera, config.camera)
    if not config.camera.rescale:
        raise CameraError(
            f"{recording.path}: images are {size[0]}x{size[1]}, the calibration is for {camera.width}x{camera.height}; "
            "calibrate at this size, or set camera.rescale: true"
        )
    return corrected(rescaled(camera, *size), config.camera)


def mounted_up(recording: Recording, config: Config, first: dict[type[Event], Event]) -> FloatArray:
    """The base's z axis in the IMU's frame ``(3,)``; without a transform the IMU is taken to be mounted level.

    Its length is ``gyro.scale``, so that rates along it are true ones.
    """
    base, event = _base_frame(recording, config, first), first.get(ImuEvent)
    if isinstance(event, ImuEvent) and event.frame_id in recording.frames and base in recording.frames:
        return np.asarray(config.gyro.scale * recording.frames.lookup(base, event.frame_id)[2, :3])
    return np.array([0.0, 0.0, config.gyro.scale])


def base_up(recording: Recording, config: Config) -> FloatArray | None:
    """`mounted_up` of a recording's gyro; None: there is none, or it is not to be used."""
    if "imu" not in recording.roles or not config.gyro.use:
        return None
    return mounted_up(recording, config, _first_events(recording))


def _image_size(recording: Recording) -> tuple[int, int] | None:
    """Width and height of the first image that can be decoded; None if there is none near the beginning."""
    for _, event in zip(range(_SCAN_EVENTS), recording.events(), strict=False):
        if isinstance(event, ImageEvent):
            try:
                height, width = decode(event).shape
            except ImageError:
                continue
            return width, height
    return None


def given_pose(config: Config, default_axes: str) -> FloatArray | None:
    """``T_base_sensor (4, 4)`` as configured: z forward for optical axes; None if it is not configured."""
    if config.recording.sightings_pose is None:
        return None
    x, y, z, roll, pitch, yaw = config.recording.sightings_pose
    T = np.eye(4)
    T[:3, :3] = rpy_matrix(roll, pitch, yaw)
    if (config.recording.sightings_axes or default_axes) == "optical":
        T[:3, :3] = T[:3, :3] @ _OPTICAL_TO_BODY
    T[:3, 3] = x, y, z
    return T


def _sensor_pose(
    recording: Recording, config: Config, first: dict[type[Event], Event], notes: list[str]
) -> FloatArray | None:
    """Place of a sensor that reports ranges or marker poses: as configured, or from tf, or at the base."""
    given = given_pose(config, default_axes="body")
    event = first.get(RangeBearingEvent) or first.get(MarkerPosesEvent)
    if given is not None or not isinstance(event, RangeBearingEvent | MarkerPosesEvent):
        return given
    base = _base_frame(recording, config, first)
    T = np.eye(4)
    if event.frame_id in recording.frames and base in recording.frames:
        T = recording.frames.lookup(base, event.frame_id).copy()
    elif event.frame_id.lstrip("/") != base.lstrip("/"):
        notes.append(
            f"No transform from {base} to {event.frame_id or 'the sightings frame'}: sightings are taken as made at "
            "the base; set recording.sightings_pose otherwise."
        )
    if config.recording.sightings_axes == "optical":  # although the frame that the header names has x forward
        T[:3, :3] = T[:3, :3] @ _OPTICAL_TO_BODY
    return T
