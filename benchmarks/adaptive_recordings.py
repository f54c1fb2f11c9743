"""Recordings for the benchmark of adaptive weights: simulated and searched for markers once, then kept.

They lie in ``FGLOC_BENCHMARK_CACHE`` (default: ``fgloc/benchmarks`` in the user's cache), in folders named by the hash
of scenario, seed and versions; what was detected is named by the hash of the detector. After a change of the
simulator's code remove the folder. Floors are those of the simulated suite with the control functions of the split, and
everything is exactly as written; test and validation use seeds of their own, which neither the suite's training nor the
tuning of any setting has seen.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from fgloc.config import Config, MarkersConfig, config_of
from fgloc.files.atomic import atomic_file
from fgloc.frames import BASE_NAMES, quaternion_yaw
from fgloc.recording.reader import Recording, open_recording
from fgloc.sensors.cameras import camera_from_info
from fgloc.sensors.maps import load_map
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.sensors.markers.images import CornersEvent, ImageError, ImageEvent, MarkerCorners
from fgloc.types import Camera, CameraInfoEvent, Event, FloatArray, LandmarkMap, TruthEvent
from fgloc_datasets.sim.record import BUNDLED, Job, describe, is_recorded, load_suite, record_suite, robot_settings
from fgloc_datasets.sim.scenario import Scenario

Split = Literal["train", "validation", "test"]
Floor = Literal["unequal_radii", "patches", "slippery"]
Change = Callable[[Scenario], Scenario]
"""Of a floor's scenario, by another benchmark: a function of a module, so that recordings can be distinguished."""
SEEDS: dict[Split, tuple[int, ...]] = {
    "train": (13, 14),
    "validation": (22, 23, 24),
    "test": (31, 32, 33, 34, 35),
}
DURATION_S = 80.0
_ROOT = Path(__file__).resolve().parent.parent
_CAMERA_HZ = 5.0
_LOOK_EVERY = 50  # messages of the truth: 1 s
_DETECTOR = [f"fgloc/sensors/markers/{name}.py" for name in ("edges", "images", "detector")]


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
    slip_s: FloatArray  # (n,) stamps of the truth of slip, seconds from the start
    slipping: NDArray[np.bool_]  # (n,) whether a wheel slips, by the simulator
    slip: FloatArray  # (n, 3) true minus wheels' twist: forward, sideways [m/s], turn [rad/s]
    truth: FloatArray  # (m, 4) seconds from the start, x, y, yaw
    duration_s: float
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


def unchanged(made: Scenario) -> Scenario:
    """The scenario as it is."""
    return made


def scenario(floor: Floor, split: Split, change: Change = unchanged) -> Scenario:
    """The suite's scenario of this name with the control functions of the split."""
    entry = next(e for e in load_suite(BUNDLED).entries if e.scenario.name == floor)
    control = next(run.control for run in entry.runs if run.split == split)
    camera = entry.scenario.camera
    assert control is not None
    assert camera is not None
    changes = {
        "control": control,
        "duration_s": DURATION_S,
        "camera": camera.model_copy(update={"rate_hz": _CAMERA_HZ}),
        "installation": None,
    }
    return change(entry.scenario.model_copy(update=changes))


def prepare(floors: Sequence[Floor], split: Split, seeds: Sequence[int], change: Change = unchanged) -> None:
    """Record what is not yet there, in as many processes as there are cores.

    Raises:
        RenderError: there is no OpenGL.
        SimulationError: a run failed.
    """
    todo = [job(floor, split, seed, change) for floor in floors for seed in seeds]
    record_missing(todo)


def job(floor: Floor, split: Split, seed: int, change: Change = unchanged) -> Job:
    """Recording to be made, and its folder in the cache."""
    made = scenario(floor, split, change)
    key = hashlib.sha256(describe(made, seed, True).encode()).hexdigest()[:12]
    return Job(made, seed, f"{floor}_{split}_{seed}_{key}", split)


def record_missing(todo: list[Job]) -> None:
    """Record what is not yet there; raises as `prepare`."""
    if any(not is_recorded(j.scenario, j.seed, cache_folder() / j.folder, True) for j in todo):
        record_suite(todo, cache_folder(), camera=True, workers=os.cpu_count() or 1)


@lru_cache(maxsize=6)
def load(floor: Floor, split: Split, seed: int, change: Change = unchanged) -> Recorded:
    """One recording, made first if it is not there."""
    made = job(floor, split, seed, change)
    record_missing([made])
    folder = cache_folder() / made.folder
    config = config_of(robot_settings(made.scenario))
    landmarks = load_map(folder / "map.yaml")
    with open_recording(folder / "bag", config.recording) as recording:
        start_ns, duration_s = recording.span_ns[0], recording.duration_s
        found = _sightings(folder, landmarks.dictionary, recording.events())
        events = tuple(_replaced(recording.events(), found))
        camera = _camera(recording, events)
    slip_s, slip, slipping = _slip(folder / "bag", start_ns)
    truth_path = folder / "installed.yaml"
    installed = yaml.safe_load(truth_path.read_text(encoding="utf-8")) if truth_path.is_file() else None
    truth = [
        ((e.stamp_ns - start_ns) * 1e-9, e.position[0], e.position[1], quaternion_yaw(e.orientation))
        for e in events
        if isinstance(e, TruthEvent)
    ]
    return Recorded(
        name=f"{floor}/{split}_{seed}",
        bag=folder / "bag",
        map_path=folder / "map.yaml",
        config=config,
        landmarks=landmarks,
        events=events,
        start_ns=start_ns,
        slip_s=slip_s,
        slipping=slipping,
        slip=slip,
        truth=np.array(truth),
        duration_s=duration_s,
        camera=camera,
        installed=installed,
    )


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
    return b"".join((_ROOT / name).read_bytes() for name in names)


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
