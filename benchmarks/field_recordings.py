"""Recordings that others made with a wheeled robot, as bags: `RECORDINGS` for `benchmarks.field`.

Bags are taken as they are. A set that is text, ``.mat`` or PyFG is only rewritten, in its owner's units, signs and
frames: no constant is fitted, no sign put right, nothing left out (NaN: no message). An odometry that its owner's
program would publish is computed by its owner's formula and nominal geometry. Stamps that count from the start of a set
are put on `_EPOCH_S`, since the day is not stated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path
from shutil import copy
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from rosbags.convert.converter import convert
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.io import loadmat

from benchmarks.common import DATA, stamp_of
from fgloc import se2
from fgloc.frames import yaw_quaternion
from fgloc.sensors.maps import write_map
from fgloc.types import FloatArray, IntArray, Landmark, LandmarkMap
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import Message, nanoseconds, new_bag, read_table, write_merged

_EPOCH_S = 1_600_000_000.0
Kind = Literal["map", "se2"]


@dataclass(frozen=True, slots=True)
class Recording:
    """One robot's run, and how its truth is to be compared.

    Attributes:
        name: of rows and folders.
        source: file or folder in `DATA`.
        peculiar: what is peculiar about it, for the page.
        make: writes a bag (and ``map.yaml``) into a folder; None: the source is a bag.
        truth: topic of the truth; empty: there is none.
        frame: "map": the truth is in the frame of the set's map; "se2": in another, which is fitted.
        lever: the tracked body's place on the robot is not stated: it is fitted.
        map: map in `DATA`; empty: that which `make` writes, or none.
        development: whether choices were made with it (the others are for reporting only).
        landmarks: whether it has landmarks that fgloc reads.
    """

    name: str
    source: str
    peculiar: str
    make: Callable[[Path, Path], None] | None = None
    truth: str = ""
    frame: Kind = "se2"
    lever: bool = False
    map: str = ""
    development: bool = False
    landmarks: bool = True

    def bag(self, out: Path) -> Path:
        """The recording as a bag; converted into ``out`` if it is none."""
        source = DATA / self.source
        if self.make is None:
            return source
        if not (out / "bag" / "metadata.yaml").is_file():
            self.make(source, out)
        return out / "bag"

    def map_path(self, out: Path) -> Path | None:
        """The set's own map, if it has one."""
        path = DATA / self.map if self.map else out / "map.yaml"
        return path if path.is_file() else None


def window(recording: Recording, first: float, last: float, mapped: bool = True) -> Recording:
    """The part of a recording between two shares of its time, as a recording of its own; without its map if wished."""
    name = f"{recording.name}_{1000.0 * first:.0f}_{1000.0 * last:.0f}"
    part = replace(recording, name=name, make=partial(_window, recording, first, last, mapped), development=True)
    return part if mapped else replace(part, map="", frame="se2")


def _window(recording: Recording, first: float, last: float, mapped: bool, _: Path, out: Path) -> None:
    with TemporaryDirectory() as scratch:
        whole = recording.bag(Path(scratch))
        if whole.suffix == ".bag":
            convert([whole], Path(scratch) / "ros2", "mcap", 9, None, "file", None, None, (), (), (), ())
            whole = Path(scratch) / "ros2"
        found_map = recording.map_path(Path(scratch))
        with AnyReader([whole]) as reader, Writer(out / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topics = {
                c.id: writer.add_connection(c.topic, c.msgtype, typestore=reader.typestore) for c in reader.connections
            }
            begin, end = (
                reader.start_time + round(share * (reader.end_time - reader.start_time)) for share in (first, last)
            )
            for connection, stamp_ns, raw in reader.messages():
                latched = any(name in connection.topic for name in ("static", "camera_info"))
                if begin <= stamp_ns <= end or (latched and stamp_ns < begin):
                    writer.write(topics[connection.id], max(stamp_ns, begin), raw)
        if mapped and found_map is not None and not recording.map:
            copy(found_map, out / "map.yaml")


# --- converters -------------------------------------------------------------------------------------------------------


def _mrclam(robot: int, source: Path, out: Path) -> None:
    """MRCLAM: commands, range and bearing by subject (robots too), Vicon. Barcodes are subjects by ``Barcodes.dat``."""
    tables = {name: read_table(source / f"Robot{robot}_{name}.dat", n) for name, n in _MRCLAM_COLUMNS.items()}
    commands, seen, truth = (table[np.argsort(table[:, 0], kind="stable")] for table in tables.values())
    subject_of = {int(barcode): int(subject) for subject, barcode in read_table(source / "Barcodes.dat", 2)}
    with new_bag(out, "mcap") as bag:
        write_merged(
            (
                (t, partial(bag.command, "/cmd_vel", t, v, omega, frame_id="base_link"))
                for t, (v, omega) in _timed(commands)
            ),
            _sightings(bag, [(t, subject_of.get(int(k), int(k)), r, b) for t, (k, r, b) in _timed(seen)]),
            _poses(bag, nanoseconds(truth[:, 0]), truth[:, 1:], "map"),
        )
    _write_map(out, {int(row[0]): row[1:3] for row in read_table(source / "Landmark_Groundtruth.dat", 5)})


_MRCLAM_COLUMNS = {"Odometry": 3, "Measurement": 4, "Groundtruth": 4}


def _turtlebot_aruco(source: Path, out: Path) -> None:
    """TurtleBot of turtlebot_MHE: odometry, distance and bearing by row of ``landmarks``, mocap."""
    data, true = (loadmat(source / f"{name}_data.mat") for name in ("processed", "truth"))
    stamps = nanoseconds(_EPOCH_S + data["l_time"].ravel())
    seen = [
        (int(stamps[k]), int(i), float(data["l_depth"][i, k]), float(data["l_bearing"][i, k]))
        for k in range(len(stamps))
        for i in np.flatnonzero(~np.isnan(data["l_depth"][:, k]))
    ]
    truth = np.column_stack([true[f"{name}_truth"].ravel() for name in ("x", "y", "th")])
    with new_bag(out, "mcap") as bag:
        write_merged(
            _odometry(bag, nanoseconds(_EPOCH_S + data["odom_t"].ravel()), data["pos_odom_se2"].T, data["vel_odom"].T),
            _sightings(bag, seen),
            _poses(bag, nanoseconds(_EPOCH_S + true["t_truth"].ravel()), truth, "map"),
        )
    _write_map(out, dict(enumerate(data["landmarks"])))


def mecanum(source: Path, out: Path, share: float = 1.0) -> None:
    """Mecanum robot: the bag, or a share of its beginning, and the odometry of its owner's formula and geometry."""
    radius, half_x, half_y, ticks_per_rad = 0.07, 0.200, 0.169, 5.0 * 42.0 / math.tau
    joints: list[Any] = []
    with AnyReader([source]) as reader, new_bag(out, "mcap") as bag:
        messages: list[Message] = []
        until = reader.start_time + round(share * reader.duration) + 1
        for connection, received, raw in reader.messages(stop=until):
            m: Any = reader.deserialize(raw, connection.msgtype)
            stamp = stamp_of(m.header)
            if connection.topic == "/wheel_states":
                joints.append((received, stamp, np.array(m.position)))
                arrays = (m.position.tolist(), m.velocity.tolist(), m.effort.tolist())
                messages.append(
                    (received, partial(bag.joints, connection.topic, stamp, m.name, *arrays, received_ns=received))
                )
            else:
                p, q = m.pose.position, m.pose.orientation
                pose = ((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
                send = partial(bag.truth, connection.topic, stamp, *pose, received, m.header.frame_id)
                messages.append((received, send))
        times = np.array([stamp for _, stamp, _ in joints])
        turned = np.diff([angles for _, _, angles in joints], axis=0) / ticks_per_rad
        fl, fr, rl, rr = turned.T
        steps = np.column_stack([fl + fr + rl + rr, -fl + fr + rl - rr, (-fl + fr - rl + rr) / (half_x + half_y)]) * (
            radius / 4.0
        )
        poses, twists = _integrated(times * 1e-9, steps)
        write_merged(iter(messages), _odometry(bag, times, poses, twists, [received for received, _, _ in joints]))


def tricycle(source: Path, out: Path, share: float = 1.0) -> None:
    """Tricycle: raw ticks, the owner's odometry (``model_pose``), pose of the laser; or a share of the beginning."""
    lines = (source / "dataset.txt").read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if line.startswith("time:")]
    rows = rows[: round(share * len(rows))]
    stamps = nanoseconds([float(row[1]) for row in rows])
    ticks = np.array([row[3:5] for row in rows], dtype=float)
    model, tracker = (np.array([row[k : k + 3] for row in rows], dtype=float) for k in (6, 10))
    poses, twists = model, _twists(stamps * 1e-9, model)
    with new_bag(out, "mcap") as bag:
        write_merged(
            _joints(bag, "/ticks", stamps, ("steering", "traction_wheel"), ticks),
            _odometry(bag, stamps, poses, twists),
            _poses(bag, stamps, tracker, "tracker"),
        )


def _car_park(source: Path, out: Path) -> None:
    """ACFR's car park: speed of the left rear wheel and steering, odometry by the owner's geometry, laser, GPS."""
    data = loadmat(source / "data_set.mat")
    wheelbase, encoder_left = 2.83, 0.76
    stamps = nanoseconds(_EPOCH_S + data["Time_VS"].ravel())
    speed, steering = data["Velocity"].ravel(), data["Steering"].ravel()
    v = speed / (1.0 - encoder_left * np.tan(steering) / wheelbase)
    omega = v * np.tan(steering) / wheelbase
    dt = np.diff(stamps) * 1e-9
    poses, twists = _integrated(stamps * 1e-9, np.column_stack([v[:-1] * dt, 0.0 * dt, omega[:-1] * dt]))
    scans = nanoseconds(_EPOCH_S + data["TimeLaser"].ravel()).tolist()
    fixes = np.column_stack([data["GPSLon"].ravel(), data["GPSLat"].ravel()])
    with new_bag(out, "mcap") as bag:
        write_merged(
            _joints(
                bag,
                "/joints",
                stamps,
                ("steering", "rear_left_wheel"),  # an angle [rad] and a speed [m/s]
                np.column_stack([steering, np.full(len(stamps), np.nan)]),
                np.column_stack([np.full(len(stamps), np.nan), speed]),
            ),
            _odometry(bag, stamps, poses, twists),
            (
                (t, partial(bag.laser_scan, "/scan", t, ranges, intensity, (-0.5 * math.pi, 0.5 * math.pi)))
                for t, ranges, intensity in zip(scans, data["Laser"], data["Intensity"], strict=True)
            ),
            _points(bag, "/gps", nanoseconds(_EPOCH_S + data["TimeGPS"].ravel()), fixes),
        )
    _write_map(out, dict(enumerate(loadmat(source / "beac_juan3.mat")["estbeac"])))


def car_gnss(source: Path, out: Path) -> None:
    """Car on a race track: speed [m/s] and angle at the steering wheel [rad] as joints, both antennas on ``/fix``.

    The owner gives no place of the antennas: the rear one is put over the rear axle, the front one a baseline ahead.
    """
    antennas = {"/swiftnav/rear/gps_pose": ("rear_antenna", 0.0), "/swiftnav/front/gps_pose": ("front_antenna", 2.03)}
    with AnyReader([source / "project.bag"]) as reader, new_bag(out, "mcap") as bag:
        for frame, x in antennas.values():
            bag.static_transform(reader.start_time, "base_link", frame, (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        for connection, received, raw in reader.messages():
            m: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic in antennas:
                place = (m.latitude, m.longitude, m.altitude)
                frame = antennas[connection.topic][0]
                bag.satellite_fix("/fix", stamp_of(m.header), place, (0.0, 0.0, 0.0), received, frame)
            else:
                steering, speed = math.radians(m.point.x), m.point.y / 3.6
                arrays = ((steering, math.nan), (math.nan, speed))
                bag.joints("/joints", stamp_of(m.header), ("steering_wheel", "speed"), *arrays, received_ns=received)


def plaza(source: Path, out: Path, since: float = 0.0) -> None:
    """CMU's Plaza 1: increments summed up, ranges to beacons, GPS with the gyro's heading.

    ``since``: share of the recording that is left out at its beginning.
    """
    data = loadmat(source / "Plaza1.mat")
    first, *_, last = data["DR"][:, 0]
    increments, ranges, truth = (
        data[name][data[name][:, 0] >= first + since * (last - first)] for name in ("DR", "TD", "GT")
    )
    stamps = nanoseconds(_EPOCH_S + increments[:, 0])
    steps = np.column_stack([increments[1:, 1], np.zeros(len(increments) - 1), increments[1:, 2]])
    with new_bag(out, "mcap") as bag:
        write_merged(
            _odometry(bag, stamps, *_integrated(stamps * 1e-9, steps)),
            _ranges(bag, nanoseconds(_EPOCH_S + ranges[:, 0]), ranges[:, 2].astype(int), ranges[:, 3]),
            _poses(bag, nanoseconds(_EPOCH_S + truth[:, 0]), truth[:, 1:], "gps"),
        )
    _write_map(out, {int(i): (x, y) for i, x, y in data["TL"][:, :3]})


def _uwb_indoor(source: Path, out: Path) -> None:
    """Small robot of libRSF: right, then left wheel's speed and "distance between wheels", as its readme has them."""
    rows = [line.split() for line in (source / "Indoor_UWB_Input.txt").read_text(encoding="utf-8").splitlines()]
    wheels = np.array([row[1:6] for row in rows if row[0] == "odom2diff"], dtype=float)
    ranges = np.array([row[1:7] for row in rows if row[0] == "range2"], dtype=float)
    lines = (source / "Indoor_UWB_GT.txt").read_text(encoding="utf-8").splitlines()
    truth = np.array([line.split()[1:4] for line in lines if line.strip()], dtype=float)
    stamps, (right, left, track) = nanoseconds(_EPOCH_S + wheels[:, 0]), wheels[:, [1, 2, 4]].T
    dt = np.diff(stamps) * 1e-9
    v, omega = 0.5 * (right + left), (right - left) / track
    steps = np.column_stack([v[1:] * dt, 0.0 * dt, omega[1:] * dt])
    with new_bag(out, "mcap") as bag:
        write_merged(
            _joints(bag, "/wheels", stamps, ("right_wheel", "left_wheel"), None, np.column_stack([right, left])),
            _odometry(bag, stamps, *_integrated(stamps * 1e-9, steps)),
            _ranges(bag, nanoseconds(_EPOCH_S + ranges[:, 0]), ranges[:, 5].astype(int), ranges[:, 1]),
            _points(bag, "/position", nanoseconds(_EPOCH_S + truth[:, 0]), truth[:, 1:]),
        )
    _write_map(out, {int(row[5]): row[3:5] for row in ranges})


def _pyfg(robot: str, source: Path, out: Path) -> None:
    """One robot of a PyFG file: odometry edges one after the other, sightings, ranges to other robots, vertices."""
    truth, edges, seen, ranges, places = [], [], [], [], {}
    for line in source.read_text(encoding="utf-8").splitlines():
        kind, *row = line.split()
        if kind == "VERTEX_SE2" and row[1].startswith(robot):
            truth.append([float(value) for value in (row[0], *row[2:5])])
        elif kind == "VERTEX_XY":
            places[int(row[0][1:])] = (float(row[1]), float(row[2]))
        elif kind == "EDGE_SE2" and row[1].startswith(robot):
            edges.append([float(value) for value in (row[0], *row[3:6])])
        elif kind == "EDGE_SE2_XY" and row[1].startswith(robot):
            x, y = float(row[3]), float(row[4])
            stamp = int(nanoseconds(float(row[0])))
            seen.append((stamp, int(row[2][1:]), math.hypot(x, y), math.atan2(y, x)))
        elif kind == "EDGE_RANGE" and row[1].startswith(robot):
            ranges.append((float(row[0]), ord(row[2][0]), float(row[3])))
    true = np.array(truth)
    steps, others = np.array(edges), np.array(ranges).reshape(-1, 3)
    stamps = nanoseconds([true[0, 0], *steps[:, 0]])
    poses = np.array(list(accumulate(steps[:, 1:], se2.compose, initial=np.zeros(3))))
    with new_bag(out, "mcap") as bag:
        write_merged(
            _odometry(bag, stamps, poses, _twists(stamps * 1e-9, poses)),
            _sightings(bag, sorted(seen)),
            _ranges(bag, nanoseconds(others[:, 0]), others[:, 1].astype(int), others[:, 2]),
            _poses(bag, nanoseconds(true[:, 0]), true[:, 1:], "map"),
        )
    _write_map(out, places)


# --- streams of messages ----------------------------------------------------------------------------------------------


def _timed(table: FloatArray) -> Iterator[tuple[int, list[float]]]:
    return zip(nanoseconds(table[:, 0]).tolist(), table[:, 1:].tolist(), strict=True)


def _odometry(
    bag: BagWriter, stamps: IntArray, poses: FloatArray, twists: FloatArray, received: Sequence[int] | None = None
) -> Iterator[Message]:
    for t, pose, twist, r in zip(stamps.tolist(), poses, twists, received or stamps.tolist(), strict=True):
        yield r, partial(bag.odometry, "/odom", t, pose.tolist(), twist.tolist(), received_ns=r)


def _poses(bag: BagWriter, stamps: IntArray, poses: FloatArray, frame: str) -> Iterator[Message]:
    for t, (x, y, yaw) in zip(stamps.tolist(), poses.tolist(), strict=True):
        yield t, partial(bag.truth, "/truth", t, (x, y, 0.0), yaw_quaternion(yaw).tolist(), frame_id=frame)


def _sightings(bag: BagWriter, seen: Sequence[tuple[int, int, float, float]]) -> Iterator[Message]:
    """One message for each stamp."""
    by_stamp: dict[int, list[tuple[int, float, float]]] = {}
    for t, *one in seen:
        by_stamp.setdefault(t, []).append((one[0], one[1], one[2]))
    for t, sightings in by_stamp.items():
        yield t, partial(bag.range_bearing, "/landmarks", t, sightings)


def _ranges(bag: BagWriter, stamps: IntArray, ids: IntArray, ranges: FloatArray) -> Iterator[Message]:
    for t, i, r in zip(stamps.tolist(), ids.tolist(), ranges.tolist(), strict=True):
        yield t, partial(bag.range_reading, "/ranges", t, r, f"beacon_{i}")


def _joints(
    bag: BagWriter,
    topic: str,
    stamps: IntArray,
    names: Sequence[str],
    positions: FloatArray | None,
    rates: FloatArray | None = None,
) -> Iterator[Message]:
    for k, t in enumerate(stamps.tolist()):
        arrays = [[] if values is None else values[k].tolist() for values in (positions, rates)]
        yield t, partial(bag.joints, topic, t, names, *arrays)


def _points(bag: BagWriter, topic: str, stamps: IntArray, places: FloatArray) -> Iterator[Message]:
    """``geometry_msgs/PointStamped``: a place without a heading."""
    for t, (x, y) in zip(stamps.tolist(), places.tolist(), strict=True):
        header = bag.make(
            "std_msgs/msg/Header",
            stamp=bag.make("builtin_interfaces/msg/Time", sec=t // 10**9, nanosec=t % 10**9),
            frame_id="world",
        )
        point = bag.make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        message = bag.make("geometry_msgs/msg/PointStamped", header=header, point=point)
        yield t, partial(bag.write, topic, "geometry_msgs/msg/PointStamped", message, t)


def _write_map(out: Path, places: dict[int, Any]) -> None:
    points = {i: np.array([float(p[0]), float(p[1]), 0.0]) for i, p in places.items()}
    write_map(LandmarkMap({i: Landmark(i, p, np.eye(3), size_m=0.0) for i, p in points.items()}), out / "map.yaml")


def _integrated(seconds: FloatArray, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses ``(n, 3)`` from the origin on, and twists ``(n, 3)``, of arcs ``(n - 1, 3)``: travel and turn."""
    poses = [np.zeros(3)]
    for step in steps:
        half = 0.5 * step[2]
        c, s = math.cos(half), math.sin(half)
        poses.append(se2.compose(poses[-1], (c * step[0] - s * step[1], s * step[0] + c * step[1], step[2])))
    rates = steps / np.maximum(np.diff(seconds), 1e-3)[:, None]
    return np.array(poses), np.vstack([np.zeros(3), rates])


def _twists(seconds: FloatArray, poses: FloatArray) -> FloatArray:
    """Body twists ``(n, 3)`` by differences of poses."""
    steps = np.array([se2.between(a, b) for a, b in pairwise(poses)])
    return np.vstack([np.zeros(3), steps / np.maximum(np.diff(seconds), 1e-3)[:, None]])


# --- all --------------------------------------------------------------------------------------------------------------

_T3, _MORE = "turtlebot3/rosbag2_2025_11_", "turtlebot3_more/rosbag2_2025_11_06-"
_MOCAP = "/mocap_node/Robot_1/ground_pose"
RECORDINGS = (
    Recording(
        "duarte",
        "pioneer_aruco/duarte.bag",
        "positions of markers in the optical frame under header `base_link`; header stamps of odometry 10⁶ s off; "
        "truth turned by 87°, in bursts, without stamps",
        truth=_MOCAP,
        lever=True,
        development=True,
    ),
    Recording("pinto1", "pioneer_aruco/pinto1.bag", "the same robot", truth=_MOCAP, lever=True),
    Recording(
        "turtlebot_aruco",
        "turtlebot_aruco",
        "range 0.044 m long, bearing +0.56°; odometry 0.05 s late; no message of 15 % of images",
        _turtlebot_aruco,
        "/truth",
        "map",
        lever=True,
        development=True,
    ),
    *(
        Recording(
            f"mrclam6_{k}",
            "mrclam6",
            "commands in place of odometry, with gaps; range is depth; other robots carry barcodes too",
            partial(_mrclam, k),
            "/truth",
            "map",
            development=k <= 2,
        )
        for k in range(1, 6)
    ),
    Recording(
        "turtlebot3_15_11_34",
        f"{_T3}25-15_11_34",
        "spikes of ±125 rad/s in the twist; nine ids and eight coordinates in the map; blackout of 21 s",
        map="turtlebot3/landmarks_2025_real.yaml",
    ),
    Recording("turtlebot3_14_27_38", f"{_T3}25-14_27_38", "spikes in the twist; nothing but odometry", landmarks=False),
    Recording(
        "turtlebot3_17_25_46",
        f"{_T3}06-17_25_46",
        "yaw of odometry is the gyro's; held (31.5–43 s), then turned by hand",
        development=True,
        landmarks=False,
    ),
    Recording("turtlebot3_17_00_32", f"{_MORE}17_00_32", "held (20.6–26.5 s), then turned by hand", landmarks=False),
    Recording(
        "turtlebot3_17_30_33",
        f"{_MORE}17_30_33",
        "turned by hand (22.6–29.7 s), blackouts up to 4.3 s, messages up to 4.9 s late",
        landmarks=False,
    ),
    Recording(
        "mecanum_bag1",
        "mecanum/bag1.bag",
        "four wheels, ticks of the motor for angles, nominal geometry 7 % short; truth freezes (23 %)",
        mecanum,
        "/robot/pose",
        lever=True,
        development=True,
        landmarks=False,
    ),
    Recording(
        "mecanum_bag2",
        "mecanum/bag2.bag",
        "the same; truth freezes (44 %)",
        mecanum,
        "/robot/pose",
        lever=True,
        landmarks=False,
        development=True,
    ),
    Recording(
        "tricycle",
        "tricycle",
        "guessed geometry; steering and traction ticks, a counter that wraps",
        tricycle,
        "/truth",
        lever=True,
        landmarks=False,
        development=True,
    ),
    Recording(
        "car_park",
        "car_park",
        "Ackermann, begins while it moves; laser with reflectors, no ids; GPS without heading",
        _car_park,
        "/gps",
        lever=True,
        landmarks=False,
        development=True,
    ),
    Recording(
        "car_gnss",
        "car_gnss/project.bag",
        "degrees at the steering wheel and km/h; fixes at latitude 0",
        truth="/swiftnav/front/gps_pose",
        lever=True,
        landmarks=False,
    ),
    Recording(
        "plaza",
        "plaza",
        "ranges without bearing, 7 % long; the truth's heading is the odometry's gyro",
        plaza,
        "/truth",
        lever=True,
        landmarks=False,
        development=True,
    ),
    Recording(
        "uwb_indoor",
        "uwb_indoor",
        "wheels swapped and half the track by its readme; UWB ranges without bearing",
        _uwb_indoor,
        "/position",
        lever=True,
        development=True,
        landmarks=False,
    ),
    Recording(
        "robot_localization",
        "robot_localization_bags/test1.bag",
        "IMU on its side; odometry 0.39 s behind the IMU; skid steer",
        truth="/fix",
        lever=True,
        development=True,
        landmarks=False,
    ),
    *(
        Recording(
            f"mrclam5_{robot}",
            "mrclam_robots/mrclam5a.pyfg",
            "integrated commands at sparse stamps; ranges to other robots" + ("; unwrapped turns" * (robot == "D")),
            partial(_pyfg, robot),
            "/truth",
            "map",
            development=robot != "B",
        )
        for robot in "ABCDE"
    ),
)
