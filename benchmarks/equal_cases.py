"""Recordings and runs of `benchmarks.equal`: each case is a function that returns what it found, by aspect.

Recordings are the bundled samples' first seconds, drives that are made here (a robot in a room, its sensors with seeded
noise), and recordings that others made, where they are on this machine.
"""

from __future__ import annotations

import contextlib
import math
import re
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from benchmarks.common import DATA, ROOT, SAMPLES
from benchmarks.field_recordings import RECORDINGS
from benchmarks.gross import MISTAKES, Mistake
from benchmarks.gross import write as write_mistaken
from fgloc import LandmarkMap, Live, RunResult, load_config, load_map, run, se2
from fgloc.ablation.failures import AnyFailure, Corruption
from fgloc.cli import app
from fgloc.config import config_of, file_content
from fgloc.extensions import GROUP, outside_sensors
from fgloc.files.settings import joined
from fgloc.recording.reader import open_recording
from fgloc.replay import RunMode
from fgloc.sensors.maps import write_map
from fgloc.types import Estimate, Event, FloatArray, Landmark
from fgloc_datasets.bag import BagWriter

_EXAMPLES = ROOT / "examples"
Settings = dict[str, dict[str, Any]]
Found = dict[str, Any]
"""What a case found by aspect: what is hashed; under "rows", poses with sigmas, for comparison by value."""
_START_NS = 1_700_000_000_000_000_000
_LEG_S = 4.0  # after which speed and turn rate change
_TICK_S = 0.01
_RADIUS, _TRACK = 0.05, 0.26
_T_BASE_CAM = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]])
_K = np.array([[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]])
_ORIGIN = (48.137154, 11.576124, 519.0)
_DEGREES_PER_M = 1.0 / 111_200.0
_ANCHORS = {1: (-3.0, -2.5, 2.1), 2: (3.2, -2.8, 2.0), 3: (2.9, 3.1, 2.3), 4: (-3.1, 2.7, 1.9)}
_PATIENCE_S = 60.0


# --- Drives -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive to and fro in a room of 6 m.

    Attributes:
        sees: "beacons", "poses" (of markers), "corners", "radio" (UWB and GNSS) or nothing.
        seconds: length.
        ticks: whether the wheels' angles are told, in place of odometry.
        gyro: whether there is an IMU.
        hills: height of the ground's waves [m].
        moved: landmarks that are 0.4 m from where the map says.
        jumps: (time, change) of the clock of all sensors [s].
        off: factor of the odometry's speed: a mistake of the set-up.
        seed: of noise and drive.
    """

    sees: str
    seconds: float = 25.0
    ticks: bool = False
    gyro: bool = True
    hills: float = 0.0
    moved: tuple[int, ...] = ()
    jumps: tuple[tuple[float, float], ...] = ()
    off: float = 1.0
    seed: int = 0

    @property
    def settings(self) -> Settings:
        """Content of ``robot.yaml``."""
        noise = {"x_per_sqrt_m": 0.03, "y_per_sqrt_m": 0.005, "yaw_per_sqrt_m": 0.04, "xy_per_sqrt_s": 0.002}
        wheels = {"noise": noise | {"yaw_per_sqrt_s": 0.002, "xy_per_sqrt_rad": 0.01, "yaw_per_sqrt_rad": 0.04}}
        made: Settings = {"wheels": {"source": "twist", **wheels}, "markers": {"sigma_px": 0.4}}
        if self.ticks:
            joints = {"left_joint": "left_wheel_joint", "right_joint": "right_wheel_joint"}
            radii = {"left_radius": _RADIUS, "right_radius": _RADIUS, "track": _TRACK}
            made["wheels"] = {"source": "ticks", **joints, **radii, **wheels}
            made["motion"] = {"model": "shipped:sim/diff_drive"}
        made["landmarks"] = {"range_sigma_m": 0.05, "bearing_sigma_rad": 0.015}
        if self.sees == "poses":
            made["landmarks"]["yaw_sigma_rad"] = 0.05
        if self.hills:
            made["estimator"] = {"ground": "uneven"}
        if self.sees == "radio":
            made["uwb"] = {"anchors": {i: list(place) for i, place in _ANCHORS.items()}, "tag": [0.0, 0.0, 0.3]}
            made["gnss"] = {"origin": list(_ORIGIN), "antenna": [0.1, 0.0]}
        return made

    def write(self, folder: Path) -> None:
        """Write ``bag``, ``robot.yaml`` and ``map.yaml``."""
        landmarks = {} if self.sees in ("", "radio") else _beacons() if self.sees == "beacons" else _markers()
        folder.mkdir(parents=True)
        _Recorder(self, landmarks, folder / "bag").write()
        (folder / "robot.yaml").write_text(yaml.safe_dump(file_content(self.settings)), encoding="utf-8")
        if landmarks:
            shown = {i: replace(m, position=m.position + _shift(i, self.moved)) for i, m in landmarks.items()}
            write_map(LandmarkMap(shown, "DICT_4X4_50" if self.sees != "beacons" else ""), folder / "map.yaml")


def _shift(number: int, moved: Sequence[int]) -> FloatArray:
    return np.array([0.3, 0.3, 0.0]) if number in moved else np.zeros(3)


def _beacons() -> dict[int, Landmark]:
    rng = np.random.default_rng(3)
    angles = np.linspace(0.0, math.tau, 9, endpoint=False) + rng.uniform(0.0, 0.5, 9)
    places = rng.uniform(2.5, 4.5, 9)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return {i: Landmark(i, np.array([*place, 0.0]), np.eye(3), 0.0) for i, place in enumerate(places)}


def _markers() -> dict[int, Landmark]:
    made = {}
    for wall in range(4):
        for i, along in enumerate((-2.3, -1.4, -0.2, 1.1, 2.2)):
            turn = wall * math.pi / 2
            x, y, facing = se2.compose((0.0, 0.0, turn), (3.0, along + 0.11 * wall, math.pi))
            c, s = math.cos(facing), math.sin(facing)
            rotation = np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])
            made[5 * wall + i] = Landmark(5 * wall + i, np.array([x, y, 0.3]), rotation, 0.25)
    return made


class _Recorder:
    """Simulates a drive and writes what its sensors measure."""

    def __init__(self, drive: Drive, landmarks: Mapping[int, Landmark], path: Path) -> None:
        self._drive, self._landmarks, self._path = drive, landmarks, path
        self._rng = np.random.default_rng(drive.seed)
        self._angles = np.zeros(2)
        self._odometry = np.zeros(3)

    def write(self) -> None:
        """Write the bag."""
        drive, rng = self._drive, self._rng
        legs = rng.uniform([0.15, -0.9], [0.5, 0.9], (int(drive.seconds / _LEG_S) + 1, 2))
        pose, moved, wanted = np.zeros(3), [], (0.0, 0.0)
        before = self._base(pose)
        with BagWriter(self._path) as bag:
            if drive.sees in ("poses", "corners"):
                optical = Rotation.from_matrix(_T_BASE_CAM[:3, :3]).as_quat().tolist()
                bag.static_transform(_START_NS, "base_link", "camera_optical", _T_BASE_CAM[:3, 3].tolist(), optical)
            if drive.gyro:
                bag.static_transform(_START_NS, "base_link", "imu_link", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0))
            if drive.sees == "corners":
                bag.camera_info("/camera_info", _START_NS, (640, 480), _K, [0.0] * 4)
            for tick in range(round(drive.seconds / _TICK_S)):
                received = _START_NS + tick * 10_000_000
                stamp = received + round(1e9 * sum(by for at, by in drive.jumps if at <= tick * _TICK_S))
                received += round(1e9 * sum(max(by, 0.0) for at, by in drive.jumps if at <= tick * _TICK_S))
                v, omega = legs[int(tick * _TICK_S / _LEG_S)]
                omega += 0.5 * math.hypot(*pose[:2]) * math.sin(math.atan2(-pose[1], -pose[0]) - pose[2])  # back
                if tick < 150:
                    v, omega = 0.0, 0.0
                wanted = (0.9 * wanted[0] + 0.1 * v, 0.9 * wanted[1] + 0.1 * omega)  # inertia
                moved.append(wanted)
                T = self._base(pose)
                if tick % 5 == 0:
                    self._wheels(bag, stamp, received, np.mean(moved[-6:-1] or moved, axis=0))
                    bag.command("/cmd_vel", stamp, v, omega, received)
                if drive.gyro and tick % 2 == 0:
                    self._inertial(bag, stamp, received, before, T, wanted)
                if tick % 10 == 0:
                    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
                    bag.truth("/truth", stamp, T[:3, 3].tolist(), quaternion.tolist(), received)
                if tick % 20 == 7:
                    self._sight(bag, stamp, received, pose, T)
                before = T
                slope = float(T[2, 0])
                along = wanted[0] * math.sqrt(1.0 - slope**2)
                pose = se2.compose(pose, se2.exp((_TICK_S * along, 0.0, _TICK_S * wanted[1])))

    def _base(self, pose: FloatArray) -> FloatArray:
        """Return the base in the map ``(4, 4)``, on the ground."""
        x, y, yaw = pose
        h = self._drive.hills
        normal = np.array([-1.2 * h * math.cos(1.2 * x), 0.9 * h * math.sin(0.9 * y), 1.0])
        up = normal / np.linalg.norm(normal)
        left = np.cross(up, [math.cos(yaw), math.sin(yaw), 0.0])
        left /= np.linalg.norm(left)
        T = np.eye(4)
        T[:3, :3] = np.column_stack([np.cross(left, up), left, up])
        T[:3, 3] = x, y, h * (math.sin(1.2 * x) + math.cos(0.9 * y) - 1.0)
        return T

    def _wheels(self, bag: BagWriter, stamp: int, received: int, twist: FloatArray) -> None:
        v = float(twist[0]) * self._drive.off + self._rng.normal(0.0, 0.02 * math.sqrt(abs(twist[0]) / 0.05 + 1e-9))
        turn = float(twist[1]) + self._rng.normal(0.0, 0.01 * math.sqrt(abs(twist[1]) / 0.05 + 1e-9))
        self._odometry = se2.compose(self._odometry, se2.exp((0.05 * v, 0.0, 0.05 * turn)))
        speeds = np.array([v - 0.5 * _TRACK * turn, v + 0.5 * _TRACK * turn]) / _RADIUS
        self._angles += 0.05 * speeds
        if self._drive.ticks:
            angles = np.round(self._angles / 0.003) * 0.003
            bag.joints(
                "/joint_states", stamp, ("left_wheel_joint", "right_wheel_joint"), angles.tolist(), received_ns=received
            )
        else:
            bag.odometry("/odom", stamp, self._odometry.tolist(), (v, turn), received)

    def _inertial(
        self, bag: BagWriter, stamp: int, received: int, before: FloatArray, T: FloatArray, twist: tuple[float, float]
    ) -> None:
        rates = Rotation.from_matrix(before[:3, :3].T @ T[:3, :3]).as_rotvec() / _TICK_S
        force = T[:3, :3].T @ np.array([0.0, 0.0, 9.81]) + np.array([0.0, twist[0] * twist[1], 0.0])
        rates += np.array([0.0, 0.0, 0.005]) + self._rng.normal(0.0, 0.004, 3)
        bag.imu("/imu", stamp, rates, force + self._rng.normal(0.0, 0.03, 3), received)

    def _sight(self, bag: BagWriter, stamp: int, received: int, pose: FloatArray, T: FloatArray) -> None:
        rng, sees = self._rng, self._drive.sees
        if sees == "beacons":
            seen = []
            for i in rng.choice(len(self._landmarks), 3, replace=False).tolist():
                x, y, _ = se2.between(pose, (*self._landmarks[i].position[:2], 0.0))
                bearing = se2.wrap(math.atan2(y, x) + rng.normal(0.0, 0.015))
                seen.append((i, math.hypot(x, y) + rng.normal(0.0, 0.05), float(bearing)))
            bag.range_bearing("/landmarks", stamp, seen, received)
        elif sees == "radio":
            anchor = int(rng.integers(1, 5))
            away = float(np.linalg.norm((T @ [0.0, 0.0, 0.3, 1.0])[:3] - _ANCHORS[anchor]))
            late = rng.exponential(1.0) if rng.uniform() < 0.1 else 0.0
            bag.range_reading("/uwb", stamp, away + late + rng.normal(0.0, 0.1), f"anchor_{anchor}", received)
            north, east = (T @ [0.1, 0.0, 0.0, 1.0])[[1, 0]] + rng.normal(0.0, 0.3, 2)
            longitude = _ORIGIN[1] + east * _DEGREES_PER_M / math.cos(math.radians(_ORIGIN[0]))
            place = (_ORIGIN[0] + north * _DEGREES_PER_M, longitude, _ORIGIN[2])
            bag.satellite_fix("/fix", stamp, place, (0.09, 0.09, 0.25), received)
        elif sees in ("poses", "corners"):
            T_cam = T @ _T_BASE_CAM
            corners = {i: self._corners(T_cam, m) for i, m in self._landmarks.items()}
            visible = {i: c for i, c in corners.items() if c is not None}
            if sees == "corners":
                noisy = {i: c + rng.normal(0.0, 0.3, (4, 2)) for i, c in visible.items()}
                bag.corners("/tags", stamp, noisy, received)
            else:
                bag.marker_poses("/markers", stamp, [self._pose(T_cam, i) for i in visible], received)

    def _corners(self, T_cam: FloatArray, m: Landmark) -> FloatArray | None:
        """Return the corners ``(4, 2)`` of a marker that is seen whole from the front, else None."""
        points = (m.corners() - T_cam[:3, 3]) @ T_cam[:3, :3]
        ray = m.position - T_cam[:3, 3]
        if points[:, 2].min() < 0.2 or -ray @ m.rotation[:, 2] < 0.3 * np.linalg.norm(ray):
            return None
        pixels = points @ _K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        inside = (pixels > 0).all() and (pixels < [640, 480]).all()
        return np.asarray(pixels) if inside else None

    def _pose(self, T_cam: FloatArray, number: int) -> tuple[int, Sequence[float], Sequence[float], None]:
        m = self._landmarks[number]
        position = T_cam[:3, :3].T @ (m.position - T_cam[:3, 3]) + self._rng.normal(0.0, 0.02, 3)
        turn = Rotation.from_matrix(T_cam[:3, :3].T @ m.rotation) * Rotation.from_rotvec(self._rng.normal(0.0, 0.02, 3))
        return number, position.tolist(), turn.as_quat().tolist(), None


# --- Recordings -------------------------------------------------------------------------------------------------------


def _sample(name: str, seconds: float, mistake: Mistake | None, folder: Path) -> None:
    write_mistaken(SAMPLES / name, folder, mistake, seconds)


def _of_others(name: str, folder: Path) -> None:
    """Make a recording of `benchmarks.field_recordings`: ``bag`` is a link if it is one already."""
    found = next(r for r in RECORDINGS if r.name == name)
    folder.mkdir(parents=True)
    bag = found.bag(folder)
    landmark_map = found.map_path(folder)
    if bag.parent != folder:
        (folder / f"bag{bag.suffix}").symlink_to(bag)
    if landmark_map is not None and landmark_map.parent != folder:
        (folder / "map.yaml").symlink_to(landmark_map)


def there(name: str) -> bool:
    """Whether a recording that others made is on this machine."""
    return (DATA / next(r for r in RECORDINGS if r.name == name).source).exists()


OTHERS = ("duarte", "turtlebot3_15_11_34", "robot_localization", "turtlebot_aruco")
RECORDED: dict[str, Callable[[Path], None]] = {
    "sample_first": partial(_sample, "first_run", 8.0, None),
    "sample_installed": partial(_sample, "installed_run", 12.0, None),
    "sample_dark": partial(_sample, "light_drop_run", 22.0, None),
    "sample_patches": partial(_sample, "patches_run", 14.0, None),
    **{
        f"mistaken_{name}": partial(_sample, "installed_run", 20.0, MISTAKES[name])
        for name in ("radius_1.1", "camera_late", "map_mirrored", "camera_yaw_10", "ids_swapped", "imu_clock")
    },
    "beacons": Drive("beacons", seconds=15.0).write,
    "beacons_no_gyro": Drive("beacons", seconds=12.0, gyro=False, seed=1).write,
    "beacons_moved": Drive("beacons", seconds=18.0, moved=(2,), seed=2).write,
    "beacons_wrong": Drive("beacons", seconds=18.0, off=1.15, seed=3).write,
    "clock": Drive("beacons", seconds=15.0, jumps=((5.0, -3.0), (10.0, 100.0)), seed=4).write,
    "poses": Drive("poses", seconds=12.0, seed=5).write,
    "corners": Drive("corners", seconds=16.0, ticks=True, seed=6).write,
    "corners_moved": Drive("corners", seconds=16.0, ticks=True, moved=(3, 11), seed=7).write,
    "hills": Drive("corners", seconds=8.0, hills=0.06, seed=8).write,
    "radio": Drive("radio", seconds=8.0, seed=9).write,
    "blind": Drive("", seconds=8.0, seed=10).write,
    **{name: partial(_of_others, name) for name in OTHERS},
}


def bag_of(folder: Path) -> Path:
    """The bag in a recording's folder."""
    return next(path for path in (folder / "bag", folder / "bag.bag") if path.exists())


# --- What is compared -------------------------------------------------------------------------------------------------

_DECISION = ("step", "stamp_ns", "kind", "landmark_id", "residual", "nis", "dof", "weight", "reason", "threshold")


def of_run(result: RunResult, place: Path) -> Found:
    """All that a run of a recording below ``place`` found, by aspect."""
    trajectory, found = result.trajectory, result.found
    findings = [
        (f.code, int(f.severity), _plain(f.text, place), f.value, f.sigma, list(f.lines.items()))
        for f in result.findings
    ]
    whole = (found.names, found.mean, found.cov, found.prior_cov, found.seen_by, found.wheels) if found else ()
    settings = [(s.name, s.given, s.found, s.sigma, s.prior_sigma) for s in found.settings] if found else []
    config = "" if result.config is None else result.config.model_dump_json(exclude_unset=True, exclude={"motion"})
    odometry = () if result.odometry is None else (result.odometry.stamps_ns, result.odometry.poses)
    return {
        "poses": (trajectory.stamps_ns, trajectory.poses, trajectory.ground),
        "covs": (trajectory.covs, trajectory.ground_covs),
        "modes": [mode.value for mode in result.modes],
        "choices": [(d.step, d.kind, d.landmark_id, d.reason) for d in result.decisions],
        "decisions": [(*(getattr(d, name) for name in _DECISION), d.shift_m) for d in result.decisions],
        "counts": sorted(result.counts.items()),
        "rejections": sorted(result.rejections.items()),
        "installation": (list(result.installation.items()), whole, settings),
        "findings": findings,
        "landmarks": (_landmarks(result.landmarks), _landmarks(None if found is None else found.landmarks)),
        "rest": (result.cost, result.first_pose_s, sorted(result.spans), odometry, config),
        "rows": _rows(trajectory.poses, trajectory.covs),
    }


def _plain(text: str, place: Path) -> str:
    """Return a text without the folders of this machine."""
    return text.replace(str(place), "PLACE").replace(str(DATA), "DATA")


def _landmarks(landmark_map: LandmarkMap | None) -> list[Any]:
    made = [] if landmark_map is None else landmark_map.landmarks.values()
    return [(m.landmark_id, m.position, m.rotation, m.size_m, m.cov) for m in made]


def _rows(poses: FloatArray, covs: FloatArray | None) -> FloatArray:
    sigmas = np.zeros((len(poses), 0)) if covs is None else np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
    return np.hstack([poses, sigmas])


# --- Cases ------------------------------------------------------------------------------------------------------------


def _run(
    recording: str,
    mode: RunMode,
    changes: Settings | None = None,
    failures: Sequence[Mapping[str, Any]] = (),
    landmark_map: bool = True,
    seconds: float = math.inf,
    check: bool = True,
    *,
    place: Path,
) -> Found:
    """Localise a recording with changed settings and injected failures."""
    folder = place / recording
    bag = bag_of(folder)
    content = (
        joined(yaml.safe_load((folder / "robot.yaml").read_text(encoding="utf-8")))
        if "robot.yaml" in _names(folder)
        else {}
    )
    config = config_of({k: content.get(k, {}) | (changes or {}).get(k, {}) for k in {**content, **(changes or {})}})
    map_path = folder / "map.yaml" if landmark_map and "map.yaml" in _names(folder) else None
    options: dict[str, Any] = {"check": check}
    if failures:
        chain = TypeAdapter(list[AnyFailure]).validate_python(list(failures))
        with open_recording(bag, config.recording) as recorded:
            span = recorded.span_ns[0], recorded.duration_s
        failing = Corruption(chain, span, config, None if map_path is None else load_map(map_path))
        options |= {"events": failing.recorded, "sightings": failing.sightings}
    elif seconds < math.inf:
        options["events"] = partial(_first, seconds)
    return of_run(run(bag, map_path, config, mode, **options), place)


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _first(seconds: float, events: Iterator[Event]) -> Iterator[Event]:
    first = next(events)
    yield first
    yield from takewhile(lambda e: e.received_ns < first.received_ns + seconds * 1e9, events)


@contextlib.contextmanager
def example_sensors() -> Iterator[tuple[Path, Path]]:
    """While inside, fgloc finds the sensors of ``examples/`` as those of an installed package, without installing it.

    The two folders are those to put on PYTHONPATH for another process.
    """
    with tempfile.TemporaryDirectory(prefix="fgloc-sensors-") as name:
        folders = Path(name), _EXAMPLES
        project = tomllib.loads((_EXAMPLES / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        info = folders[0] / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
        info.mkdir()
        about = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
        (info / "METADATA").write_text(about)
        points = "".join(f"{name} = {value}\n" for name, value in project["entry-points"][GROUP].items())
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{points}")
        sys.path.extend(map(str, folders))
        outside_sensors.cache_clear()
        try:
            yield folders
        finally:
            for folder in folders:
                sys.path.remove(str(folder))
            outside_sensors.cache_clear()


def _radio(non_line_of_sight: str, *, place: Path) -> Found:
    """Localise with the two example sensors, which are found as those of an installed package are."""
    with example_sensors():
        return _run("radio", "online", {"uwb": {"non_line_of_sight": non_line_of_sight}}, check=False, place=place)


def _live(recording: str, *, place: Path) -> Found:
    """Feed a live run event by event, ask it for poses in between, and give it a pose."""
    folder, made, asked = place / recording, list[Estimate](), list[Any]()
    config = load_config(folder / "robot.yaml")
    with open_recording(bag_of(folder), config.recording) as recorded:
        events, roles = list(recorded.events()), recorded.roles
    with Live(config, folder / "map.yaml", roles=roles) as live:
        live.subscribe(made.append)
        for k, event in enumerate(events):
            live.push(event)
            if k % 100 == 50:
                live.wait(_PATIENCE_S)
                asked += [live.pose_at(), live.pose_at(event.stamp_ns - 700_000_000)]
            if k == len(events) * 2 // 3:
                live.wait(_PATIENCE_S)
                live.reset_pose(se2.compose(made[-1].pose, (0.2, -0.1, 0.1)).tolist(), (0.2, 0.2, 0.1))
        live.wait(_PATIENCE_S)
        status = live.status()
    poses, covs = np.array([e.pose for e in made]), np.array([e.cov for e in made])
    decisions = [d for e in made for d in e.decisions]
    return {
        "poses": ([e.stamp_ns for e in made], poses),
        "covs": covs,
        "modes": [e.mode.value for e in made],
        "choices": [(d.step, d.kind, d.landmark_id, d.reason) for d in decisions],
        "decisions": [(*(getattr(d, name) for name in _DECISION), d.shift_m) for d in decisions],
        "asked": [None if p is None else (p.stamp_ns, p.pose, p.cov, p.mode.value) for p in asked],
        "counts": (status.keyframes, sorted(status.dropped.items())),
        "rejections": sorted(status.rejections.items()),
        "rows": _rows(poses, covs),
    }


def _command(*arguments: str, outputs: Sequence[str] = (), place: Path) -> Found:
    """Run a command of fgloc in a folder of its own; ``{recording}`` in an argument is a recording's bag.

    Paths are relative and the command that the files quote is the one here: texts do not depend on the machine.
    """
    bags = {f"{{{name}}}": f"../{name}/{bag_of(place / name).name}" for name in RECORDED if (place / name).is_dir()}
    given = [bags.get(argument, argument) for argument in arguments]
    with (
        contextlib.chdir(tempfile.mkdtemp(prefix="out-", dir=place)),
        patch.object(sys, "argv", ["fgloc", *given]),
        patch("fgloc.cli.terminal.LINE_S", math.inf),  # progress is told by the clock
    ):
        done = CliRunner().invoke(app, given)
        files = {name: Path(name).read_text(encoding="utf-8") for name in outputs}
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return {
        "exit": done.exit_code,
        "said": _plain(done.stdout, place),
        "errors": _plain(done.stderr, place),
        "files": [(name, _LONG.sub(_rounded, _plain(text, place))) for name, text in files.items()],
    }


_LONG = re.compile(r"-?\d+\.\d{10,}(e[-+]?\d+)?")
"""Numbers that a file has with all their digits."""


def _rounded(number: re.Match[str]) -> str:
    return str(round(float(number[0]), 9))


_SLIP = {"kind": "wheel_slip", "speed": 0.3, "when": {"intervals": [[5, 7]]}}
_SPIN = {"kind": "wheel_slip", "yaw_rate": 0.6, "when": {"intervals": [[11, 12.5]]}}
_FROZEN = {"kind": "encoder_frozen", "when": {"intervals": [[5, 9]]}}
_DARK = {"kind": "dropout", "sensor": "camera", "when": {"intervals": [[4, 11]]}}
_WRONG_IDS = {"kind": "wrong_ids", "probability": 0.15}
_TWICE = {"kind": "duplicated_messages", "sensor": "wheels", "when": {"share": 0.1}}
_KIDNAP = {"kind": "kidnap", "when": {"intervals": [[6, 10]]}}
_LIFT = {"kind": "lift", "when": {"intervals": [[6, 11]]}}
_BIAS = {"kind": "imu_bias", "yaw_rate": 0.15, "when": {"intervals": [[5, 12]]}}
_LATE = {"kind": "latency", "sensor": "camera", "delay_s": 0.25, "jitter_s": 0.1}
_RESET = {"kind": "odometry_reset", "when": {"intervals": [[5, 5.2]]}}
_NAN = {"kind": "wheel_nan", "when": {"share": 0.05}}
_NOISE = {"kind": "sighting_noise", "corner_px": 3.0, "when": {"share": 0.1}}

Case = Callable[..., Found]
CASES: dict[str, Case] = {
    # bundled samples: images, wheels' angles, gyro, learned motion
    "first_run.online": partial(_run, "sample_first", "online"),
    "installed_run.online": partial(_run, "sample_installed", "online"),
    "installed_run.batch": partial(_run, "sample_installed", "batch"),
    "installed_run.no_map": partial(
        _run,
        "sample_installed",
        "batch",
        {"markers": {"dictionary": "DICT_4X4_50", "default_size_m": 0.2}},
        landmark_map=False,
        check=False,
    ),
    "light_drop_run.online": partial(_run, "sample_dark", "online"),
    "patches_run.online": partial(_run, "sample_patches", "online"),
    # beacons
    "beacons.online": partial(_run, "beacons", "online"),
    "beacons.batch": partial(_run, "beacons", "batch", check=False),
    "beacons.no_gyro": partial(_run, "beacons_no_gyro", "online"),
    "beacons.no_map": partial(_run, "beacons", "batch", landmark_map=False, check=False),
    "beacons.no_map_online": partial(_run, "beacons_no_gyro", "online", landmark_map=False),
    "beacons.ekf": partial(_run, "beacons", "online", {"estimator": {"kind": "ekf"}}, check=False),
    "beacons.isam2": partial(_run, "beacons_no_gyro", "online", {"estimator": {"kind": "isam2"}}, check=False),
    "beacons.moved": partial(_run, "beacons_moved", "online"),
    "beacons.moved_batch": partial(_run, "beacons_moved", "batch", check=False),
    "beacons.wrong_set_up": partial(_run, "beacons_wrong", "batch"),
    "beacons.given_pose": partial(
        _run,
        "beacons",
        "online",
        {"estimator": {"initial_pose": [0.0, 0.0, 0.0], "motion_kernel": "huber"}},
        check=False,
    ),
    "beacons.wrong_pose": partial(
        _run, "beacons", "online", {"estimator": {"initial_pose": [1.5, -1.0, 2.0]}}, check=False
    ),
    "beacons.kidnapped": partial(_run, "beacons_moved", "online", failures=[_KIDNAP]),
    "beacons.lift": partial(_run, "beacons", "online", failures=[_LIFT]),
    "beacons.late": partial(_run, "beacons", "online", failures=[_LATE, _TWICE, _NAN]),
    "clock.online": partial(_run, "clock", "online"),
    "clock.batch": partial(_run, "clock", "batch", check=False),
    "blind.online": partial(
        _run, "blind", "online", {"estimator": {"initial_pose": [0.0, 0.0, 0.0]}}, landmark_map=False
    ),
    # markers by poses and by corners
    "poses.online": partial(_run, "poses", "online"),
    "poses.kidnapped": partial(_run, "poses", "online", failures=[_KIDNAP]),
    "poses.batch": partial(_run, "poses", "batch", check=False),
    "poses.no_map": partial(_run, "poses", "batch", check=False, landmark_map=False),
    "corners.batch": partial(_run, "corners", "batch"),
    "corners.moved": partial(_run, "corners_moved", "batch"),
    "corners.moved_online": partial(_run, "corners_moved", "online", check=False),
    "corners.slip": partial(_run, "corners", "online", failures=[_SLIP, _SPIN, _NOISE]),
    "corners.slip_batch": partial(_run, "corners", "batch", failures=[_SLIP, _SPIN]),
    "corners.frozen": partial(_run, "corners", "online", failures=[_FROZEN, _RESET]),
    "corners.dark": partial(_run, "corners", "online", failures=[_DARK, _BIAS]),
    "corners.wrong_ids": partial(_run, "corners", "online", failures=[_WRONG_IDS]),
    "corners.lift": partial(_run, "corners", "online", failures=[_LIFT]),
    "corners.kidnapped": partial(_run, "corners", "online", failures=[_KIDNAP]),
    # uneven ground, sensors of other packages
    "hills.online": partial(_run, "hills", "online"),
    "hills.batch": partial(_run, "hills", "batch", check=False),
    "hills.flat": partial(_run, "hills", "online", {"estimator": {"ground": "flat"}}, check=False),
    "radio.mixture": partial(_radio, "mixture"),
    "radio.reject": partial(_radio, "reject"),
    # live
    "live.beacons": partial(_live, "beacons_moved"),
    "live.corners": partial(_live, "corners"),
    # command line: exit codes, files, texts
    "exit.0": partial(_command, "smooth", "{beacons}", "--out", "r", outputs=("r/steps.csv",)),
    "exit.1": partial(_command, "online", "absent", "--out", "r"),
    "exit.2": partial(_command, "online"),
    "exit.3": partial(_command, "online", "{beacons_wrong}", "--out", "r"),
    "calibrate": partial(_command, "calibrate", "{corners}", "--out", "found.yaml", outputs=("found.yaml",)),
    "map": partial(_command, "map", "{poses}", "--out", "map.yaml", outputs=("map.yaml",)),
    "info.installed_run": partial(_command, "info", "{sample_installed}"),
    "info.beacons": partial(_command, "info", "{beacons}"),
    **{f"info.{name}": partial(_command, "info", f"{{{name}}}") for name in RECORDED if name.startswith("mistaken_")},
    **{
        f"init.{name}": partial(_command, "init", f"{{{name}}}", "--out", "robot.yaml", outputs=("robot.yaml",))
        for name in ("sample_installed", "beacons", "poses", *OTHERS)
    },
    # recordings that others made, cut short
    "duarte.batch": partial(
        _run,
        "duarte",
        "batch",
        {"recording": {"received_stamps": ["odometry"], "sightings_axes": "optical"}},
        seconds=60.0,
    ),
    "turtlebot3.online": partial(_run, "turtlebot3_15_11_34", "online", seconds=30.0),
    "robot_localization.online": partial(_run, "robot_localization", "online", seconds=30.0, landmark_map=False),
    "turtlebot_aruco.online": partial(_run, "turtlebot_aruco", "online", seconds=60.0),
    "turtlebot_aruco.batch": partial(_run, "turtlebot_aruco", "batch", seconds=30.0),
}


def recordings_of(name: str) -> set[str]:
    """Recordings that a case is made from."""
    words = [str(word) for word in CASES[name].args]  # type: ignore[attr-defined]
    if CASES[name].func is _radio:  # type: ignore[attr-defined]
        words.append("radio")
    return {word.strip("{}") for word in words} & RECORDED.keys()
