"""From the facts of a stream, a map and a configuration to its sensors, checked before anything runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Protocol

import numpy as np

from fgloc.config import CAMERA_ROLES, Config, Role, base_roles, camera_role
from fgloc.errors import CameraError, ConfigError, RecordingError
from fgloc.extensions import outside_sensors
from fgloc.frames import BASE_NAMES, OPTICAL_TO_BODY, homogeneous, rpy_matrix
from fgloc.recording.reader import Recording, is_rectified
from fgloc.recording.transforms import FrameTree
from fgloc.sensors import registry
from fgloc.sensors.base import Context, Sensor, with_values
from fgloc.sensors.cameras import camera_from_info, corrected, load_camera, rescaled
from fgloc.sensors.learned.sensor import LearnedMotion, learned_motion
from fgloc.sensors.maps import configured_map
from fgloc.sensors.markers.detector import MarkerDetector, configured_detector
from fgloc.sensors.odometry import BesideOdometry
from fgloc.types import (
    Camera,
    CameraInfoEvent,
    Event,
    FloatArray,
    InertialEvent,
    LandmarkMap,
    MotionEvent,
    RawEvent,
    SightingsEvent,
)

# --- Facts of a stream, recorded or live ------------------------------------------------------------------------------

_SCAN_EVENTS = 20_000  # how far into a recording an image that can be decoded is looked for


class StreamFacts(Protocol):
    """Facts of a stream that are known before it is run."""

    @property
    def name(self) -> str:
        """Name of the stream, for messages to the user."""
        ...

    @property
    def roles(self) -> Mapping[Role, str]:
        """Topic of each role that the stream has."""
        ...

    @property
    def topics(self) -> str:
        """All topics with their types, for messages to the user."""
        ...

    @property
    def frames(self) -> FrameTree:
        """All transforms between frames."""
        ...

    @property
    def first(self) -> Mapping[type[Event], Event]:
        """The first event of each kind."""
        ...

    @property
    def firsts(self) -> Iterable[Event]:
        """The first event of each kind on each topic."""
        ...

    def image_size(self, topic: str | None) -> tuple[int, int] | None:
        """Width and height of the first image of a topic that can be decoded; None if there is none."""
        ...

    @property
    def camera(self) -> Camera | None:
        """The calibrated and mounted camera, if it is known without CameraInfo and transforms."""
        ...


class RecordingFacts:
    """The facts of a recording, read when they are asked for."""

    camera: Camera | None = None

    def __init__(self, recording: Recording) -> None:
        """Use an opened recording."""
        self._recording = recording
        self.name = str(recording.path)
        self.roles: Mapping[Role, str] = recording.roles

    @property
    def topics(self) -> str:
        """All topics with their types."""
        return ", ".join(f"{t.name} ({t.message_type})" for t in self._recording.topics) or "none"

    @property
    def frames(self) -> FrameTree:
        """All transforms."""
        return self._recording.frames

    @cached_property
    def first(self) -> Mapping[type[Event], Event]:
        """The first event of each kind."""
        return _by_kind(self.firsts)

    @cached_property
    def firsts(self) -> Iterable[Event]:
        """The first event of each kind on each topic, from as far as it takes for each to have a message."""
        found: dict[tuple[type[Event], str], Event] = {}
        missing = set(self.roles.values())
        for event in self._recording.events():
            found.setdefault((type(event), event.topic), event)
            missing.discard(event.topic)
            if not missing:
                break
        return tuple(found.values())

    def image_size(self, topic: str | None) -> tuple[int, int] | None:
        """Width and height of the first image near the beginning of a topic that can be decoded."""
        for event in islice(self._recording.events(), _SCAN_EVENTS):
            if event.topic == topic and isinstance(event, RawEvent) and (size := event.decoded_size()) is not None:
                return size
        return None


def _by_kind(firsts: Iterable[Event]) -> dict[type[Event], Event]:
    found: dict[type[Event], Event] = {}
    for event in firsts:
        found.setdefault(type(event), event)
    return found


# --- Sensors, by the facts --------------------------------------------------------------------------------------------

_ESTIMATED = {  # uncertainties of what is estimated of a sensor of landmarks on a known map
    "landmarks": ("range_scale_sigma", "bearing_bias_sigma_rad", "position_sigma_m", "time_offset_sigma_s"),
    "camera": (
        "position_sigma_m",
        "rotation_sigma_rad",
        "focal_sigma",
        "principal_sigma_px",
        "distortion_sigma",
        "time_offset_sigma_s",
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class SensorSetup:
    """The sensors of a stream, and where they are.

    Attributes:
        config: all settings, as the run uses them.
        landmark_map: None: landmarks are estimated.
        detector: of markers; None: there are no images.
        cameras: calibrated and mounted, each with its name where there are several; empty: there are neither images
            nor corners.
        T_base_sensor: ``(4, 4)`` place of a sensor that reports ranges or marker poses; None: the base, or not known.
        learned: motion model; None: none is used.
        imu_up: the base's z axis in the IMU's frame, see `mounted_up`; None: there is no gyro, or it is not used.
        T_base_imu: ``(4, 4)`` its mounting; None likewise.
        sensors: those of other packages.
        notes: what the user should know.
        sees: whether anything in the stream can tell where the robot is.
        unmeasured: whether sightings alone tell how it moves.
        beside: odometries beside the wheels.
    """

    config: Config
    landmark_map: LandmarkMap | None
    detector: MarkerDetector | None
    cameras: tuple[Camera, ...]
    T_base_sensor: FloatArray | None
    learned: LearnedMotion | None
    imu_up: FloatArray | None
    T_base_imu: FloatArray | None
    sensors: tuple[Sensor, ...]
    notes: tuple[str, ...]
    sees: bool
    beside: tuple[BesideOdometry, ...] = ()
    unmeasured: bool = False


def recorded_setup(
    recording: Recording, map_path: Path | None, config: Config, landmark_map: LandmarkMap | None = None
) -> SensorSetup:
    """The sensors of a recording.

    Args:
        recording: to be run.
        map_path: map; None: landmarks are estimated.
        config: all settings.
        landmark_map: the map as it is to be used, if not as the file has it.

    Raises:
        RecordingError: nothing in the recording measures how the robot moves, or a frame is missing.
        CameraError: the calibration is missing, unusable or does not fit the images.
        MapError, ModelError, ConfigError: as their loaders have it.
    """
    facts = RecordingFacts(recording)
    _need_motion(facts)
    if landmark_map is None and map_path is not None:
        landmark_map = configured_map(map_path, config)
    return sensor_setup(facts, landmark_map, config)


def sensor_setup(facts: StreamFacts, landmark_map: LandmarkMap | None, config: Config) -> SensorSetup:
    """The sensors of a stream of which these facts are known; otherwise as `recorded_setup`."""
    _need_motion(facts)
    notes = list(landmark_map.notes) if landmark_map is not None else []
    there = [one for one in config.recording.odometries if one.role in facts.roles]
    unmeasured = not there and not {*_WHEELS, "imu"} & set(facts.roles)
    if unmeasured:
        notes.append(
            "Nothing but sightings tells how the robot moves (no odometry, joint states, commands or IMU): between "
            "them its speed is taken to stay as it was for about two seconds."
        )
    elif not _WHEELS & set(facts.roles):
        notes.append(
            "No odometry, joint states or commands: between sightings the robot may have gone as far as a fifth of "
            "expert.gate.max_speed takes it."
        )
    cameras = _cameras(facts, config)
    notes += [note for camera in cameras for note in camera.notes]
    kinds = base_roles(facts.roles)
    T_base_sensor = _sensor_pose(facts, config, notes)
    sensors = _sensors(facts, config, landmark_map)
    # by places of their own
    placed = bool(sensors) and all(getattr(s, "needs", "") and not getattr(s, "uses_map", False) for s in sensors)
    if placed and {"image", "sightings"}.isdisjoint(kinds):  # a search for the first pose would wait for a landmark
        landmark_map = None
    if sensors and landmark_map is None:
        landmark_map = _no_landmarks(facts, sensors)
    if landmark_map is None and {"image", "sightings"} & kinds:
        for name in config.camera_names:
            notes += _without_effect(config.of_camera(name), "camera" if cameras else "landmarks", name)
        config = resolved(config, landmark_map)
        notes.append(
            "No map: landmarks are estimated with the trajectory, by the whole-run estimator, and the first pose is "
            "the map's origin (online: until a loop closes, then poses already given stay as well as they can); "
            "for long runs build the map once with `fgloc map`."
        )
    detector = configured_detector(config, landmark_map) if "image" in kinds else None
    imu_up = T_base_imu = None
    learned = learned_motion(config, lambda: mounted_up(facts, config))
    if "imu" in facts.roles and config.gyro.use:
        imu_up, T_base_imu = mounted_up(facts, config), _mounted_imu(facts, config)
    sees = bool(sensors) or not {"image", "sightings"}.isdisjoint(kinds)
    beside = tuple(BesideOdometry(one, config.gate, _frames(facts, config)) for one in there)
    return SensorSetup(
        config,
        landmark_map,
        detector,
        cameras,
        T_base_sensor,
        learned,
        imu_up,
        T_base_imu,
        sensors,
        tuple(notes),
        sees,
        beside,
        unmeasured,
    )


def _without_effect(config: Config, section: str, camera: str) -> Iterator[str]:
    """A sentence on the uncertainties of a sensor of landmarks that were given, where there is no map."""
    part = getattr(config, section)
    given = [key for key in _ESTIMATED[section] if key in part.model_fields_set and getattr(part, key) > 0.0]
    if given:
        keys = ", ".join(f"cameras.{camera}.{key}" if camera else f"{section}.{key}" for key in given)
        yield (
            f"Without a map {keys} has no effect: the sensor's constants are taken as they are configured, because "
            "landmarks that are estimated with them could be off alike. Build a map with `fgloc map`, then they are "
            "estimated."
        )


_WHEELS: frozenset[Role] = frozenset({"odometry", "joints", "command"})
TELLING_MOTION = _WHEELS | {"imu", "image", "sightings"}
"""Roles of which a run needs one: without wheels, sightings tell how the robot moves."""


CONVERT = (
    "Wheels whose angles or rates come in messages of another type: name the fields in recording.joints "
    "(docs/drives.md). Poses or velocities of an odometry (PoseStamped, TwistStamped, also with covariance): name the "
    "topic in recording.topics.odometry."
)


def _need_motion(facts: StreamFacts) -> None:
    """Refuse a stream in which nothing tells how the robot moves."""
    if not TELLING_MOTION & base_roles(facts.roles):
        raise RecordingError(
            f"{facts.name}: no odometry, joint states or commands, no IMU and no images or sightings; a run needs one "
            f"of them. {CONVERT} Topics: {facts.topics}"
        )


def _sensors(facts: StreamFacts, config: Config, landmark_map: LandmarkMap | None) -> tuple[Sensor, ...]:
    """Those registered sensors that have settings and a topic in this stream."""
    contexts = {
        sensor.name: Context(config, getattr(config, sensor.name), facts.roles, landmark_map, _frames(facts, config))
        for sensor in outside_sensors()
        if hasattr(config, sensor.name) and any(stream.role in facts.roles for stream in sensor.streams)
    }
    return registry.build(contexts)


def _frames(facts: StreamFacts, config: Config) -> Callable[[str], FloatArray | None]:
    """Function from the name of a frame to ``T_base_frame (4, 4)``; None: tf has no such frame."""

    def frame(name: str) -> FloatArray | None:
        base = base_frame(facts, config)
        if name.lstrip("/") == base.lstrip("/"):
            return np.eye(4)
        return facts.frames.lookup(base, name) if name in facts.frames and base in facts.frames else None

    return frame


def _no_landmarks(facts: StreamFacts, sensors: Sequence[Sensor]) -> LandmarkMap:
    """The map of a run that has the map's frame from registered sensors alone.

    Raises:
        ConfigError: there are sightings, whose landmarks would make a frame of their own.
    """
    seen = [role for role in ("image", "sightings") if role in base_roles(facts.roles)]
    if seen:
        names = ", ".join(sensor.name for sensor in sensors)
        raise ConfigError(
            f"{facts.name}: {names} measures in the frame of a map, and {' and '.join(seen)} without a map would make "
            f"another one; give --map, or set recording.topics.{seen[0]}: none"
        )
    return LandmarkMap({})


def resolved(config: Config, given_map: Path | LandmarkMap | None) -> Config:
    """The configuration a run uses: without a map landmarks are variables, which the fixed lag would forget."""
    if given_map is not None or config.estimator.kind != "fixed_lag":
        return config
    return with_values(config, "estimator", {"kind": "isam2"})


def base_frame(facts: StreamFacts, config: Config) -> str:
    """Name of the robot's base frame: as configured, a usual one among the transforms, or the odometry's child."""
    if config.recording.base_frame is not None:
        return config.recording.base_frame
    for name in BASE_NAMES:
        if name in facts.frames:
            return name
    named = (event.base_frame_id for event in facts.first.values() if isinstance(event, MotionEvent))
    return next(filter(None, named), BASE_NAMES[0])


def camera_frame(first: Mapping[type[Event], Event]) -> str:
    """Name of the camera's frame, by the first event of each kind: CameraInfo, image, or what was found in one."""
    seen = [event for event in first.values() if isinstance(event, RawEvent)]
    found = [event for event in first.values() if isinstance(event, SightingsEvent) and event.in_pixels]
    info = first.get(CameraInfoEvent)
    return next(
        (e.frame_id for e in (info, *seen, *found) if isinstance(e, CameraInfoEvent | RawEvent | SightingsEvent)), ""
    )


def _in_pixels(first: Mapping[type[Event], Event]) -> bool:
    """Whether there are sightings that take a calibrated camera."""
    return any(isinstance(event, SightingsEvent) and event.in_pixels for event in first.values())


def _cameras(facts: StreamFacts, config: Config) -> tuple[Camera, ...]:
    """The cameras that have images or corners in a stream."""
    found = []
    for name in config.camera_names:
        own = OneCamera(facts, name) if name else facts
        if "image" not in own.roles and not ("sightings" in own.roles and _in_pixels(own.first)):
            continue
        camera = _camera(own, config.of_camera(name))
        topics = tuple(own.roles[role] for role in ("image", "sightings") if role in own.roles)
        found.append(replace(camera, name=name, topics=topics) if name else camera)
    return tuple(found)


class OneCamera:
    """Facts of a stream as if it had one of its cameras alone; see `StreamFacts`."""

    def __init__(self, facts: StreamFacts, name: str) -> None:
        """Take the facts of the whole stream, and the name of the camera."""
        own = {camera_role(name, role): role for role in CAMERA_ROLES}
        self._facts = facts
        self._name = name
        self.name, self.topics, self.camera = facts.name, facts.topics, facts.camera
        self.roles = {
            own.get(role, role): topic for role, topic in facts.roles.items() if "/" not in role or role in own
        }

    @property
    def frames(self) -> FrameTree:
        """All transforms."""
        return self._facts.frames

    @property
    def firsts(self) -> Iterable[Event]:
        """The first event of each kind on each topic."""
        others = {t for role, t in self._facts.roles.items() if "/" in role} - set(self.roles.values())
        return [event for event in self._facts.firsts if event.topic not in others]

    @property
    def first(self) -> Mapping[type[Event], Event]:
        """The first event of each kind."""
        return _by_kind(self.firsts)

    def image_size(self, topic: str | None) -> tuple[int, int] | None:
        """Width and height of the first image of a topic that can be decoded."""
        return self._facts.image_size(topic)


def _camera(facts: StreamFacts, config: Config) -> Camera:
    topic = facts.roles.get("image")
    size = facts.image_size(topic)
    if facts.camera is not None:
        return _fitting(facts.camera, size, facts.name, config)
    first = facts.first
    info, frame = first.get(CameraInfoEvent), camera_frame(first)
    T_base_cam = given_pose(config, default_axes="optical")
    if T_base_cam is None:
        T_base_cam = facts.frames.lookup(base_frame(facts, config), frame)
    if config.camera.file is not None:
        camera = load_camera(config.camera.file, T_base_cam, topic)
    elif isinstance(info, CameraInfoEvent):
        camera = camera_from_info(info, T_base_cam, size, is_rectified(topic or ""))
    else:
        raise CameraError(
            f"{facts.name}: images or marker corners, but no sensor_msgs/CameraInfo; "
            "set camera.file to a calibration YAML in --config"
        )
    return _fitting(camera, size, facts.name, config)


def _fitting(camera: Camera, size: tuple[int, int] | None, name: str, config: Config) -> Camera:
    """The camera as the configuration corrects it, for the size of the images."""
    if size is None or not camera.width or size == (camera.width, camera.height):
        return corrected(camera, config.camera)
    scaled = rescaled(camera, *size)
    if not config.camera.rescale:
        raise CameraError(
            f"{name}: images are {size[0]}x{size[1]}, the calibration is for {camera.width}x{camera.height}; "
            "calibrate at this size, or set expert.camera.rescale: true"
        )
    return corrected(scaled, config.camera)


def _mounted_imu(facts: StreamFacts, config: Config) -> FloatArray:
    """``T_base_imu (4, 4)``; without a transform the IMU is taken to be level and at the base."""
    if config.recording.imu_pose is not None:
        x, y, z, roll, pitch, yaw = config.recording.imu_pose
        return homogeneous(rpy_matrix(roll, pitch, yaw), (x, y, z))
    base = base_frame(facts, config)
    event = next((e for e in facts.first.values() if isinstance(e, InertialEvent)), None)
    if event is not None and event.frame_id in facts.frames and base in facts.frames:
        return facts.frames.lookup(base, event.frame_id)
    return np.eye(4)


def mounted_up(facts: StreamFacts, config: Config) -> FloatArray:
    """The base's z axis in the IMU's frame ``(3,)``; without a transform the IMU is taken to be mounted level.

    Its length is ``gyro.scale``, so that rates along it are true ones.
    """
    return np.asarray(config.gyro.scale * _mounted_imu(facts, config)[2, :3])


def base_up(recording: Recording, config: Config) -> FloatArray | None:
    """`mounted_up` of a recording's gyro; None: there is none, or it is not to be used."""
    if "imu" not in recording.roles or not config.gyro.use:
        return None
    return mounted_up(RecordingFacts(recording), config)


def given_pose(config: Config, default_axes: str) -> FloatArray | None:
    """``T_base_sensor (4, 4)`` as configured: z forward for optical axes; None if it is not configured."""
    if config.recording.sightings_pose is None:
        return None
    x, y, z, roll, pitch, yaw = config.recording.sightings_pose
    optical = (config.recording.sightings_axes or default_axes) == "optical"
    rotation = rpy_matrix(roll, pitch, yaw)
    return homogeneous(rotation @ OPTICAL_TO_BODY if optical else rotation, (x, y, z))


def _sensor_pose(facts: StreamFacts, config: Config, notes: list[str]) -> FloatArray | None:
    """Place of a sensor that reports ranges or marker poses: as configured, or from tf, or at the base."""
    given = given_pose(config, default_axes="body")
    event = next((e for e in facts.first.values() if isinstance(e, SightingsEvent) and not e.in_pixels), None)
    if given is not None or event is None:
        return given
    base = base_frame(facts, config)
    T = np.eye(4)
    if event.frame_id in facts.frames and base in facts.frames:
        T = facts.frames.lookup(base, event.frame_id).copy()
    elif event.frame_id.lstrip("/") != base.lstrip("/"):
        notes.append(
            f"No transform from {base} to {event.frame_id or 'the sightings frame'}: sightings are taken as made at "
            "the base; set recording.sightings_pose otherwise."
        )
    if config.recording.sightings_axes == "optical":  # although the frame that the header names has x forward
        T[:3, :3] = T[:3, :3] @ OPTICAL_TO_BODY
    return T
