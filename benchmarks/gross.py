"""Gross mistakes: ``python -m benchmarks.gross [--quick] [--json FILE] [--split validation] [--mistakes NAME,...]``.

Each of `MISTAKES` is made on three simulated recordings as installed, of a minute each, and
`fgloc.runner.run` and `fgloc info` are asked about it.

- ``gross.named``: share of mistakes that the first finding of the run (or its error) names by its code, with the line
  to be set or a figure (within 2 to 25 % of the true one) and an exit code other than 0. ``gross.info``: likewise of
  the first thing that ``fgloc info`` has to say.
- ``gross.false``: sound runs of which a mistake is named: those without a mistake, and the bundled samples.
- ``gross.seconds``: processor time of the run with the mistake over that of the sound run; largest and median.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

from benchmarks.common import SAMPLES, Row, main, mean_row, not_run
from benchmarks.recordings import SEEDS, Split, Take, cache_folder, folder, prepare
from fgloc.cli.terminal import EXIT_BAD_INPUT, exit_code
from fgloc.config import file_content, load_config
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.errors import FglocError
from fgloc.files.settings import joined
from fgloc.recording.messages import default_typestore
from fgloc.replay import RunMode
from fgloc.runner import run
from fgloc.types import Finding, FloatArray, note
from fgloc_datasets.sim.camera import RenderError

RECORDINGS = 3
QUICK = ("size_0.95", "joints_swapped", "dictionary")
_VALUE = re.compile(r"\(\?#(\S+) (\S+)\)")  # in a pattern: the bounds of its group "value"
NOTHING = Finding("", "")


@dataclass(frozen=True, slots=True)
class Outcome:
    """First finding, exit code and processor time of one run; and the first finding of ``fgloc info``."""

    first: Finding
    code: int
    seconds: float
    info: Finding


def outcome(bag: Path, mode: RunMode) -> Outcome:
    """Run a recording with the ``robot.yaml`` and ``map.yaml`` beside it."""
    config = load_config(bag.parent / "robot.yaml")
    map_path = bag.parent / "map.yaml"
    began = time.process_time()
    try:
        result = run(bag, map_path, config, mode)
        first, code = next(iter(result.findings), NOTHING), exit_code(result)
    except Exception as error:  # a crash is a result too: it names nothing
        first, code = Finding(type(error).__name__, str(error)), EXIT_BAD_INPUT
    seconds = time.process_time() - began
    try:
        report = inspect_all(bag, map_path, config)
        info = next(iter((*note("problem", report.problems), *report.found)), NOTHING)
    except FglocError as error:
        info = Finding(type(error).__name__, str(error))
    return Outcome(first, code, seconds, info)


def names(pattern: str, finding: Finding) -> bool:
    """Whether code, figure, lines and text of a finding match, in this order, the value within the pattern's bounds."""
    lines = "; ".join(f"{key}: {value}" for key, value in finding.lines.items())
    found = re.match(pattern, f"{finding.code} {finding.value} {lines}\n{finding.text}")
    if found is None:
        return False
    bounds = _VALUE.search(pattern)
    return bounds is None or float(bounds[1]) <= float(found["value"]) <= float(bounds[2])


def measure(quick: bool, split: Split = "test", mistakes: Sequence[str] = (), mode: RunMode = "batch") -> Iterator[Row]:
    """The rows; a quick run has one recording and three mistakes."""
    chosen = mistakes or (QUICK if quick else tuple(MISTAKES))
    takes = [Take("installed", "unequal_radii", split, seed) for seed in SEEDS[split][: 1 if quick else RECORDINGS]]
    try:
        prepare(takes)
    except RenderError as error:
        yield from not_run(("gross.named", "gross.info", "gross.false", "gross.seconds"), str(error))
        return
    sound: list[Outcome] = []
    wrong: dict[str, list[Outcome]] = {name: [] for name in chosen}
    for take in takes:
        with tempfile.TemporaryDirectory() as made:
            source = cache_folder() / folder(take)
            sound.append(outcome(write(source, Path(made) / "sound", None), mode))
            _say(take, "sound", sound[-1])
            for name in chosen:
                wrong[name].append(outcome(write(source, Path(made) / name, MISTAKES[name]), mode))
                _say(take, name, wrong[name][-1], MISTAKES[name].said)
    for sample in () if quick else sorted(SAMPLES.iterdir()):
        if (sample / "bag").is_dir():
            sound.append(outcome(sample / "bag", mode))
            print(f"{sample.name}: {sound[-1].code} {sound[-1].first.text}", file=sys.stderr, flush=True)
    yield from _rows(sound, wrong)


def _rows(sound: Sequence[Outcome], wrong: dict[str, list[Outcome]]) -> Iterator[Row]:
    named, told, ratios = [], [], []
    for name, outcomes in wrong.items():
        said = MISTAKES[name].said
        named.append([names(said, o.first) and o.code != 0 for o in outcomes])
        told.append([names(said, o.info) for o in outcomes])
        ratios.append([o.seconds / s.seconds for o, s in zip(outcomes, sound, strict=False)])
    for name, good, times in zip(wrong, named, ratios, strict=True):
        yield mean_row(f"gross.{name}.named", good)
        yield Row(f"gross.{name}.seconds", float(np.max(times)), float(np.std(times)), len(times))
    count = sum(map(len, named))
    yield Row("gross.named", float(np.mean(named)), float(np.std(np.mean(named, axis=1))), count)
    yield Row("gross.info", float(np.mean(told)), float(np.std(np.mean(told, axis=1))), count)
    accused = [o for o in sound if o.code or any(names(m.said, o.first) for m in MISTAKES.values())]
    yield Row("gross.false", float(len(accused)), None, len(sound))
    yield Row("gross.seconds", float(np.max(ratios)), None, count)
    yield Row("gross.seconds_median", float(np.median(ratios)), None, count)


def _say(take: Take, name: str, o: Outcome, pattern: str = "") -> None:
    good = f"{names(pattern, o.first)!s:5} {names(pattern, o.info)!s:5}" if pattern else " " * 11
    print(
        f"{take.seed} {name:20} {good} {o.code} {o.seconds:6.1f} s  {o.first.text}\n    {o.info.text}",
        file=sys.stderr,
        flush=True,
    )


# --- Mistakes ---------------------------------------------------------------------------------------------------------


LENGTH_S = 60.0
SHIFT = (2.0, -1.0, 0.7)  # m, m, rad: of a frame that is not the map's
Settings = dict[str, Any]
Edit = Callable[[Any], None]
"""Changes a message in place."""


@dataclass(frozen=True, slots=True)
class Mistake:
    """One mistake, and what the first finding has to hold.

    Attributes:
        said: regular expression of code, figure and lines; where the text alone has ids or names, of these.
        robot: changes ``robot.yaml``, given the first pose of the truth too.
        map: changes ``map.yaml``.
        messages: by topic.
    """

    said: str
    robot: Callable[[Settings, tuple[float, float, float]], None] = lambda robot, start: None
    map: Callable[[Settings], None] = lambda landmarks: None
    messages: Mapping[str, Edit] = field(default_factory=dict)


def _size(factor: float) -> Mistake:
    def change(landmarks: Settings) -> None:
        for landmark in landmarks["landmarks"]:
            landmark["size"] *= factor

    return Mistake(rf"map\.size (?P<value>[\d.]+)(?#{0.98 / factor:.4f} {1.02 / factor:.4f})", map=change)


def _mounted(roll: float, pitch: float, yaw: float) -> Mistake:
    """The transform of the camera turned by these angles [deg] against the true one."""

    def change(robot: Settings, start: tuple[float, float, float]) -> None:
        angles = [math.radians(a) for a in (roll, pitch, yaw)]
        robot.setdefault("recording", {})["sightings_pose"] = [0.1, 0.0, 0.25, *angles]

    true_yaw = r"recording\.sightings_pose: \[[^\]]*, (?P<value>[-\d.e]+)\](?#-0.03 0.03)"
    return Mistake(rf"sightings\.mounting .*{true_yaw}", robot=change)


def _radius(factor: float) -> Mistake:
    def change(robot: Settings, start: tuple[float, float, float]) -> None:
        for side in ("left_radius", "right_radius"):
            robot["wheels"][side] *= factor

    return Mistake(r"wheels\.scale .*left_radius: (?P<value>[\d.]+)(?#0.0485 0.0515)", robot=change)


def _swap_joints(robot: Settings, start: tuple[float, float, float]) -> None:
    wheels = robot["wheels"]
    wheels["left_joint"], wheels["right_joint"] = wheels["right_joint"], wheels["left_joint"]


def _left_backwards(robot: Settings, start: tuple[float, float, float]) -> None:
    """Reverse one side of a robot that publishes neither an odometry nor a gyro: images alone tell it."""
    robot["wheels"]["left_radius"] *= -1.0
    robot.setdefault("recording", {}).setdefault("topics", {}).update({"odometry": "none", "imu": "none"})


def _mirror(landmarks: Settings) -> None:
    """The sign of y changed; markers look along the mirrored direction, upright as before."""
    for landmark in landmarks["landmarks"]:
        x, y, z = landmark["position"]
        qx, qy, qz, qw = landmark.pop("quaternion")
        normal = 2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx)
        landmark["position"], landmark["facing"] = [x, -y, z], math.atan2(-normal[1], normal[0])


def _swap_ids(landmarks: Settings) -> None:
    """Exchange the ids of two markers on opposite walls, most often seen in validation and test recordings alike."""
    first, second = landmarks["landmarks"][7], landmarks["landmarks"][9]
    first["id"], second["id"] = second["id"], first["id"]


def _shift_map(landmarks: Settings) -> None:
    for landmark in landmarks["landmarks"]:
        landmark["position"][0] += SHIFT[0]
        landmark["position"][1] += SHIFT[1]


def _start_here(robot: Settings, start: tuple[float, float, float]) -> None:
    robot["estimator"] = {"initial_pose": list(start)}


def _dictionary(robot: Settings, start: tuple[float, float, float]) -> None:
    robot["markers"]["dictionary"] = "DICT_6X6_50"


def _by_odometry(robot: Settings, start: tuple[float, float, float]) -> None:
    robot["wheels"] = {"source": "twist", "noise": robot["wheels"]["noise"]}


def _scaled(k: FloatArray, factor: float) -> FloatArray:
    return np.concatenate([factor * k[:6], k[6:]])


def _half(message: Any) -> None:
    message.width, message.height = message.width // 2, message.height // 2
    message.k = _scaled(message.k, 0.5)


def _double_k(message: Any) -> None:
    message.k = _scaled(message.k, 2.0)


def _no_distortion(message: Any) -> None:
    message.d = np.zeros(5)


def _roll_over(message: Any) -> None:
    message.position = np.mod(message.position, 2.0 * math.pi)


def _quarter_turn(message: Any) -> None:
    """The twist in the axes of a frame whose x axis points to the robot's left."""
    twist = message.twist.twist.linear
    twist.x, twist.y = twist.y, -twist.x


def _other_frame(message: Any) -> None:
    p, q = message.pose.position, message.pose.orientation
    yaw = 2.0 * math.atan2(q.z, q.w) + SHIFT[2]
    c, s = math.cos(SHIFT[2]), math.sin(SHIFT[2])
    p.x, p.y = c * p.x - s * p.y + SHIFT[0], s * p.x + c * p.y + SHIFT[1]
    q.x, q.y, q.z, q.w = 0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)


def _late(seconds: float) -> Edit:
    def change(message: Any) -> None:
        stamp = message.header.stamp
        total = stamp.sec * 1_000_000_000 + stamp.nanosec + round(seconds * 1e9)
        stamp.sec, stamp.nanosec = divmod(total, 1_000_000_000)

    return change


_CAMERA = ("/camera/camera_info", "/camera/image/compressed")

MISTAKES: dict[str, Mistake] = {
    "size_0.95": _size(0.95),
    "size_1.05": _size(1.05),
    "size_0.8": _size(0.8),
    "size_1.2": _size(1.2),
    "dictionary": Mistake(r"markers\.dictionary .*\n.*but of DICT_4X4_50", robot=_dictionary),
    "info_resolution": Mistake(r"(CameraError|problem) .*\n.*640x480.*320x240", messages={_CAMERA[0]: _half}),
    "info_scaled": Mistake(r"camera\.resolution (?P<value>[\d.]+)(?#0.485 0.515)", messages={_CAMERA[0]: _double_k}),
    "info_distortion": Mistake(
        r"camera\.distortion .*camera\.k1: (?P<value>-?[\d.]+)(?#-0.15 -0.09)", messages={_CAMERA[0]: _no_distortion}
    ),
    "camera_upside_down": _mounted(180.0, 0.0, 0.0),
    "camera_quarter_roll": _mounted(90.0, 0.0, 0.0),
    "camera_yaw_90": _mounted(0.0, 0.0, 90.0),
    "camera_yaw_10": _mounted(0.0, 0.0, 10.0),
    "camera_pitch_15": _mounted(0.0, 15.0, 0.0),
    "joints_swapped": Mistake(r"wheels\.sign .*right_joint: right_wheel_joint", robot=_swap_joints),
    "left_backwards": Mistake(r"wheels\.reversed .*left_radius: (?P<value>0.*)(?#0 1)", robot=_left_backwards),
    "radius_1.1": _radius(1.1),
    "radius_2": _radius(2.0),
    "roll_over": Mistake(r"wheels\.roll_over .*: (?P<value>.*)(?#6.28 6.29)", messages={"/joint_states": _roll_over}),
    "map_mirrored": Mistake(r"map\.mirrored ", map=_mirror),
    "map_shifted": Mistake(r"frame\.first_pose ", robot=_start_here, map=_shift_map),
    "ids_swapped": Mistake(r"map\.ids .*\n.*ids 7 and 9 ", map=_swap_ids),
    "odometry_frame": Mistake(
        r"odometry\.twist_unit (?P<value>\S+) .*pose(?#0.9 1.1)", robot=_by_odometry, messages={"/odom": _quarter_turn}
    ),
    "truth_frame": Mistake(r"truth\.frame .*se2", messages={"/truth": _other_frame}),
    "camera_late": Mistake(r"clock\.image (?P<value>[\d.]+)(?#0.26 0.34)", messages=dict.fromkeys(_CAMERA, _late(0.3))),
    "camera_clock": Mistake(r"clock\.received .*image", messages=dict.fromkeys(_CAMERA, _late(3600.0))),
    "imu_clock": Mistake(r"clock\.received .*imu", messages={"/imu": _late(-1000.0)}),
}


def write(source: Path, folder: Path, mistake: Mistake | None, length_s: float = LENGTH_S) -> Path:
    """A recording with a mistake in ``folder``: bag, ``robot.yaml`` and ``map.yaml``; None: a sound one.

    Args:
        source: folder of a simulated recording.
        folder: to be made.
        mistake: what is wrong.
        length_s: of it; the rest of the source is left out.

    Returns:
        The bag.
    """
    made = mistake or Mistake("")
    folder.mkdir(parents=True)
    start = _copied(source / "bag", folder / "bag", made.messages, length_s)
    robot = joined(yaml.safe_load((source / "robot.yaml").read_text(encoding="utf-8")))
    landmarks = yaml.safe_load((source / "map.yaml").read_text(encoding="utf-8"))
    robot, landmarks = deepcopy(robot), deepcopy(landmarks)
    made.robot(robot, start)
    made.map(landmarks)
    (folder / "robot.yaml").write_text(yaml.safe_dump(file_content(robot)), encoding="utf-8")
    (folder / "map.yaml").write_text(yaml.safe_dump(landmarks), encoding="utf-8")
    return folder / "bag"


def _copied(source: Path, target: Path, edits: Mapping[str, Edit], length_s: float) -> tuple[float, float, float]:
    """The beginning of a bag with these messages changed; the first pose of its truth."""
    store = default_typestore()
    first: tuple[float, float, float] | None = None
    with AnyReader([source]) as reader, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        made = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
        end_ns = reader.start_time + round(length_s * 1e9)
        for connection, received_ns, raw in reader.messages(stop=end_ns):
            content = raw
            if connection.topic in edits or (first is None and connection.topic == "/truth"):
                message: Any = reader.deserialize(raw, connection.msgtype)
                if first is None and connection.topic == "/truth":
                    p, q = message.pose.position, message.pose.orientation
                    first = (float(p.x), float(p.y), 2.0 * math.atan2(q.z, q.w))
                if connection.topic in edits:
                    edits[connection.topic](message)
                    content = store.serialize_cdr(message, connection.msgtype)
            writer.write(made[connection.id], received_ns, content)
    if first is None:
        raise ValueError(f"{source}: no /truth")
    return first


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--mistakes", default="", help="comma-separated names; default: all")
    parser.add_argument("--mode", choices=("batch", "online"), default="batch")
    known, rest = parser.parse_known_args()
    picked = tuple(filter(None, known.mistakes.split(",")))
    main(lambda quick: measure(quick, known.split, picked, known.mode), __doc__ or "", rest)
