"""Recordings that benchmarks share: simulated and searched for markers once, then kept; and robots of MRCLAM 6.

Simulated ones lie in ``FGLOC_BENCHMARK_CACHE`` (default: ``fgloc/benchmarks`` in the user's cache), in folders named by
the hash of scenario, seed and versions; what was detected is named by the hash of the detector. After a change of the
simulator's code remove the folder. Floors are those of the simulated suite with the control functions of the split;
seeds are such as no training and no setting has seen. In an ``installed`` recording every error of a careful
installation is drawn by the seed (`fgloc_datasets.sim.scenario`), and the floor's own error of the wheels is left out;
``map5mm`` errs in the places of the markers only; ``perfect`` in nothing. ``found`` is ``installed`` with a longer
drive, ``tour`` with one of three minutes around a room of 6 m.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from benchmarks.common import DATA, MODELS, ROOT
from fgloc.config import Config, MarkersConfig, config_of, load_config
from fgloc.files.atomic import atomic_file
from fgloc.frames import BASE_NAMES, quaternion_yaw
from fgloc.recording.reader import Recording, open_recording
from fgloc.recording.storage import find_beside
from fgloc.sensors.cameras import camera_from_info
from fgloc.sensors.maps import load_map
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.sensors.markers.images import CornersEvent, ImageError, ImageEvent, MarkerCorners
from fgloc.types import Camera, CameraInfoEvent, Event, FloatArray, LandmarkMap, TruthEvent
from fgloc_datasets import mrclam
from fgloc_datasets.sim.record import BUNDLED, Job, describe, is_recorded, load_suite, record_suite, robot_settings
from fgloc_datasets.sim.scenario import Control, Installation, Markers, Scenario, World

Split = Literal["validation", "test"]
Floor = Literal["unequal_radii", "patches", "slippery"]
Variant = Literal["installed", "map5mm", "perfect", "found", "tour"]
SEEDS: dict[Split, tuple[int, ...]] = {"validation": tuple(range(41, 46)), "test": tuple(range(61, 71))}
MRCLAM = DATA / "mrclam6"
_DURATION_S, _FOUND_S, _TOUR_S = 80.0, 120.0, 180.0
_ROBOTS_S = 200.0  # of each robot of MRCLAM 6
_MAP_M = 0.005
_CAMERA_HZ = 5.0
_LOOK_EVERY = 50  # messages of the truth: 1 s
_DETECTOR = [f"fgloc/sensors/markers/{name}.py" for name in ("edges", "images", "detector")]
_TOUR = (
    (-1.8, -1.6), (-0.4, -1.5), (1.0, -1.5), (1.8, -0.5), (1.4, 1.2), (0.2, 1.6), (-0.3, 0.3), (-1.4, -0.2),
    (-1.8, 1.2), (-0.9, 1.7), (0.3, 0.5), (1.2, -0.5), (0.3, -1.2), (-1.0, -0.8),
)  # fmt: skip

_scratch: list[tempfile.TemporaryDirectory[str]] = []


@dataclass(frozen=True, slots=True, order=True)
class Take:
    """One simulated recording."""

    variant: Variant
    floor: Floor
    split: Split
    seed: int


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """One recording in memory, its images replaced by the corners of the markers in them."""

    name: str
    bag: Path
    map_path: Path
    config: Config  # as in robot.yaml
    landmarks: LandmarkMap
    events: tuple[Event, ...]
    start_ns: int  # receive time of the first message
    truth: FloatArray  # (m, 4) seconds from the start, x, y, yaw
    duration_s: float
    slip_s: FloatArray = field(default_factory=lambda: np.zeros(0))  # (n,) of the truth of slip, from the start
    slipping: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,) by the simulator
    slip: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3) true minus wheels' twist [m/s, rad/s]
    camera: Camera | None = None  # as in the recording
    installed: Mapping[str, Any] | None = None  # where it is not what is written: the truth

    @property
    def path_m(self) -> float:
        """Distance travelled, by the truth [m]."""
        return float(np.hypot(*np.diff(self.truth[:, 1:3], axis=0).T).sum())


def cache_folder() -> Path:
    """Folder in which recordings are kept."""
    user = os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")
    return Path(os.environ.get("FGLOC_BENCHMARK_CACHE", Path(user) / "fgloc" / "benchmarks"))


def scenario(floor: Floor, split: Split) -> Scenario:
    """The suite's scenario of this name with the control functions of the split, everything exactly as written."""
    entry = next(e for e in load_suite(BUNDLED).entries if e.scenario.name == floor)
    control = next(run.control for run in entry.runs if run.split == split)
    camera = entry.scenario.camera
    assert control is not None
    assert camera is not None
    changes = {
        "control": control,
        "duration_s": _DURATION_S,
        "camera": camera.model_copy(update={"rate_hz": _CAMERA_HZ}),
        "installation": None,
    }
    return entry.scenario.model_copy(update=changes)


def _scenario(take: Take) -> Scenario:
    made = scenario(take.floor, take.split)
    if take.variant == "perfect":
        return made
    if take.variant == "map5mm":
        return made.model_copy(update={"installation": Installation(marker_position_m=_MAP_M)})
    robot = made.robot.model_copy(update={"radius_scale": (1.0, 1.0)})
    made = made.model_copy(update={"robot": robot, "installation": Installation.as_installed()})
    if take.variant == "found":
        return made.model_copy(update={"duration_s": _FOUND_S})
    if take.variant == "tour":
        changes = {
            "duration_s": _TOUR_S,
            "start": (*_TOUR[0], 0.0),
            "world": World(size_m=(6.0, 6.0), markers=Markers(count=16)),
            "control": Control(waypoints=_TOUR, speed=0.42),
        }
        return made.model_copy(update=changes)
    return made


def _job(take: Take) -> Job:
    """Recording to be made, and its folder in the cache."""
    made = _scenario(take)
    key = hashlib.sha256(describe(made, take.seed, True).encode()).hexdigest()[:12]
    return Job(made, take.seed, f"{take.floor}_{take.split}_{take.seed}_{key}", take.split)


def folder(take: Take) -> str:
    """Name of the recording's folder in the cache, which changes with its scenario."""
    return _job(take).folder


def prepare(takes: Iterable[Take]) -> None:
    """Record what is not yet there, in as many processes as there are cores.

    Raises:
        RenderError: there is no OpenGL.
        SimulationError: a run failed.
    """
    todo = sorted((_job(take) for take in sorted(set(takes))), key=lambda job: -job.scenario.duration_s)
    if any(not is_recorded(j.scenario, j.seed, cache_folder() / j.folder, True) for j in todo):
        record_suite(todo, cache_folder(), camera=True, workers=os.cpu_count() or 1)


@lru_cache(maxsize=6)
def load(take: Take) -> Recorded:
    """One recording, made first if it is not there."""
    prepare([take])
    job = _job(take)
    place = cache_folder() / job.folder
    config = config_of(robot_settings(job.scenario))
    landmarks = load_map(place / "map.yaml")
    with open_recording(place / "bag", config.recording) as recording:
        start_ns, duration_s = recording.span_ns[0], recording.duration_s
        found = _sightings(place, landmarks.dictionary, recording.events())
        events = tuple(_replaced(recording.events(), found))
        camera = _camera(recording, events)
    slip_s, slip, slipping = _slip(place / "bag", start_ns)
    truth_path = place / "installed.yaml"
    installed = yaml.safe_load(truth_path.read_text(encoding="utf-8")) if truth_path.is_file() else None
    return Recorded(
        name=f"{take.floor}/{take.split}_{take.seed}",
        bag=place / "bag",
        map_path=place / "map.yaml",
        config=config,
        landmarks=landmarks,
        events=events,
        start_ns=start_ns,
        slip_s=slip_s,
        slipping=slipping,
        slip=slip,
        truth=truth_of(events, start_ns),
        duration_s=duration_s,
        camera=camera,
        installed=installed,
    )


def changed(config: Config, changes: Mapping[str, Any]) -> Config:
    """The configuration with some of its values replaced, given as nested mappings."""

    def merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
        return {**old, **{k: merged(old[k], v) if isinstance(v, Mapping) else v for k, v in new.items()}}

    return config_of(merged(config.model_dump(), changes))


def converted(robot: int, scratch: Path) -> tuple[Path, Path, Config]:
    """Bag, map and settings of a robot of MRCLAM 6, with the model of the other four; converted into a folder."""
    bag = mrclam.convert(MRCLAM, robot, scratch / f"robot{robot}")
    robot_yaml, map_path = find_beside(bag, "robot.yaml"), find_beside(bag, "map.yaml")
    assert robot_yaml is not None
    assert map_path is not None
    model = {"motion": {"model": MODELS / f"without_robot{robot}.safetensors"}}
    return bag, map_path, changed(load_config(robot_yaml), model)


@lru_cache(maxsize=2)
def robot(number: int) -> Recorded:
    """The first minutes of a robot of MRCLAM 6, which has commands and no wheels."""
    _scratch.append(tempfile.TemporaryDirectory())  # lasts as long as the process
    bag, map_path, config = converted(number, Path(_scratch[-1].name))
    with open_recording(bag, config.recording) as recording:
        start_ns = recording.span_ns[0]
        until_ns = start_ns + round(_ROBOTS_S * 1e9)
        events = tuple(e for e in recording.events() if e.received_ns < until_ns)
    return Recorded(
        name=f"mrclam/robot{number}",
        bag=bag,
        map_path=map_path,
        config=changed(config, {"wheels": {"source": "command"}}),
        landmarks=load_map(map_path),
        events=events,
        start_ns=start_ns,
        truth=truth_of(events, start_ns),
        duration_s=_ROBOTS_S,
    )


def truth_of(events: Iterable[Event], start_ns: int) -> FloatArray:
    """Poses of the truth ``(n, 4)``: seconds from the start, x, y, yaw."""
    poses = [
        ((e.stamp_ns - start_ns) * 1e-9, e.position[0], e.position[1], quaternion_yaw(e.orientation))
        for e in events
        if isinstance(e, TruthEvent)
    ]
    return np.array(poses)


def slip_intervals(recorded: Recorded, least_s: float = 0.1, join_s: float = 0.3) -> list[tuple[float, float]]:
    """Intervals of slip by the simulator [s from the start]; closer than ``join_s`` is one, short ones are left out."""
    out: list[tuple[float, float]] = []
    for t, slips in zip(recorded.slip_s.tolist(), recorded.slipping.tolist(), strict=True):
        if slips:
            if out and t - out[-1][1] <= join_s:
                out[-1] = (out[-1][0], t)
            else:
                out.append((t, t))
    return [(a, b) for a, b in out if b - a >= least_s]


def moved_interval(recorded: Recorded, start_s: float, distance_m: float) -> tuple[float, float]:
    """The first time not before ``start_s`` from which the robot gets ``distance_m`` away, and when it does so [s].

    Raises:
        ValueError: there is none.
    """
    rows = recorded.truth[recorded.truth[:, 0] >= start_s]
    for i in range(0, len(rows), _LOOK_EVERY):
        away = np.hypot(*(rows[i:, 1:3] - rows[i, 1:3]).T) >= distance_m
        if away.any():
            return float(rows[i, 0]), float(rows[i + int(np.argmax(away)), 0])
    raise ValueError(f"{recorded.name}: from {start_s} s on never {distance_m} m away from any of its places")


def _camera(recording: Recording, events: Sequence[Event]) -> Camera:
    info = next(e for e in events if isinstance(e, CameraInfoEvent))
    base = next(name for name in BASE_NAMES if name in recording.frames)
    return camera_from_info(info, recording.frames.lookup(base, info.frame_id))


@cache
def _sources(names: tuple[str, ...]) -> bytes:
    return b"".join((ROOT / name).read_bytes() for name in names)


def _sightings(folder: Path, dictionary: str, events: Iterator[Event]) -> dict[int, CornersEvent]:
    """Detected corners by the image's stamp; detected once, then read from a file."""
    made = hashlib.sha256(cv2.__version__.encode() + _sources(tuple(_DETECTOR))).hexdigest()[:12]
    path = folder / f"corners_{made}.npz"
    if not path.is_file():
        detector = MarkerDetector(dictionary, MarkersConfig())
        cv2.setNumThreads(1)
        found = list(_detected(events, detector))
        with atomic_file(path, binary=True) as file:
            np.savez_compressed(
                file,
                stamps=np.array([(e.stamp_ns, e.received_ns) for e in found]),
                frames=np.array([(e.frame_id, e.topic) for e in found]),
                images=np.array([i for i, e in enumerate(found) for _ in e.sightings], dtype=int),
                ids=np.array([s.landmark_id for e in found for s in e.sightings], dtype=int),
                corners=np.array([s.corners_px for e in found for s in e.sightings]).reshape(-1, 4, 2),
            )
    with np.load(path, allow_pickle=False) as held:
        stamps, frames, images = held["stamps"].tolist(), held["frames"].tolist(), held["images"]
        ids, corners = held["ids"].tolist(), held["corners"]
    out = {}
    for i, ((stamp, received), (frame, topic)) in enumerate(zip(stamps, frames, strict=True)):
        seen = tuple(MarkerCorners(ids[k], corners[k]) for k in np.flatnonzero(images == i))
        out[stamp] = CornersEvent(stamp, received, topic, frame, seen)
    return out


def _detected(events: Iterator[Event], detector: MarkerDetector) -> Iterator[CornersEvent]:
    for event in events:
        if isinstance(event, ImageEvent):
            try:
                yield detector.detect(event)
            except ImageError:
                continue


def _replaced(events: Iterator[Event], found: dict[int, CornersEvent]) -> Iterator[Event]:
    for event in events:
        if not isinstance(event, ImageEvent):
            yield event
        elif event.stamp_ns in found:
            yield found[event.stamp_ns]


def _slip(bag: Path, start_ns: int) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Stamps [s from the start], differences of the twist and flags of slip, by the simulator."""
    stamps, twists, flags = [], [], []
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.topic in ("/truth/slip", "/truth/slipping")]
        for connection, _, raw in reader.messages(wanted):
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/truth/slipping":
                flags.append(bool(message.data))
                continue
            stamp = message.header.stamp
            twist = message.twist.twist
            stamps.append((stamp.sec * 1_000_000_000 + stamp.nanosec - start_ns) * 1e-9)
            twists.append((twist.linear.x, twist.linear.y, twist.angular.z))
    return np.array(stamps), np.array(twists), np.array(flags)
