"""DRIVE (Norlab): a skid-steered Husky in 603 windows of 2 s, with wheel speeds (commanded, measured), gyro, ICP pose.

    fgloc convert drive test_husky_windows.csv --windows 0-399 --out DIR

writes ``bag/`` (``/cmd_vel``, ``/joint_states``, ``/imu``, ``/truth``), ``robot.yaml`` and ``windows.csv`` (window,
calibration step, steady, start). The file has no clock: window w starts at 10⁹ + 100 w seconds, so each window is a
segment of its own for whoever reads the bag, and begins at the origin of its own map.

- Wheel speeds are rad/s: 7 rad/s on a radius of 0.165 m is the Husky's top speed of 1.1 m/s, and straight windows give
  0.161 to 0.172 m of way per radian. ``/cmd_vel`` is the commanded wheel speeds through the nominal radius and track;
  they may exceed what the motors can do.
- Wheel angles are the integral of the measured speeds (trapezoids), from 0 in each window.
- ``imu_yaw`` is a rate: its integral follows the ICP's yaw with a slope of 0.995.
- ICP poses come at about 10 Hz and are held in the rows between; a held pose is not written again.
- Wheel odometry with the nominal track turns 2.5 times too far: skid-steering. ``robot.yaml`` keeps the nominal values
  and says so by its noise.

The owner publishes the set (BSD-3) in github.com/norlab-ulaval/DRIVE as a pickled table. Pickles run code when opened,
so this program never does; ``--download`` takes the ``--url`` of the CSV.

Source: Baril et al., "DRIVE: Data-driven Robot Input Vector Exploration", ICRA 2024. Radius and track are those of
Clearpath's URDF.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fgloc.errors import ConfigError, RecordingError
from fgloc.files.documents import check_regular
from fgloc.files.outputs import write_text
from fgloc.types import FloatArray, IntArray
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import Message, new_bag, read_table, write_merged, write_robot

WHEEL_RADIUS_M = 0.1651
TRACK_M = 0.5708
_JOINTS = ("left_wheel", "right_wheel")
_MOST_BYTES = 1 << 30  # of the windows: 3.5 MB
_STEP_NS = 50_000_000
_EPOCH_NS = 1_000_000_000 * 1_000_000_000
_APART_NS = 100 * 1_000_000_000  # more than gate.clock_jump_s
_COLUMNS = (
    "window",
    "calib_step",
    "steady",
    "i",
    "cmd_left",
    "cmd_right",
    "left_wheel_vel",
    "right_wheel_vel",
    "icp_x",
    "icp_y",
    "icp_z",
    "icp_roll",
    "icp_pitch",
    "icp_yaw",
    "imu_yaw",
    "imu_acceleration_x",
    "imu_acceleration_y",
    "imu_acceleration_z",
)


def convert(
    source: Path,
    out: Path,
    storage: str = "mcap",
    windows: range | None = None,
    calibration: range | None = None,
) -> Path:
    """Convert the windows.

    Args:
        source: the CSV file.
        out: folder that gets ``bag/``, ``robot.yaml`` and ``windows.csv``.
        storage: "mcap" or "sqlite3".
        windows: numbers of the windows wanted; None: all.
        calibration: calibration steps wanted (a step has three windows); None: all.

    Returns:
        The bag's folder.

    Raises:
        RecordingError: the file is not the set's, or nothing is selected.
    """
    table = _read(source)
    wanted = np.ones(len(table["window"]), dtype=bool)
    for numbers, column in ((windows, "window"), (calibration, "calib_step")):
        if numbers is not None:
            wanted &= np.isin(table[column], list(numbers))
    if not wanted.any():
        raise RecordingError(f"{source}: no window is selected; it has windows 0 to {table['window'].max():.0f}")
    table = {name: column[wanted] for name, column in table.items()}
    stamps = _stamps(table)
    with new_bag(out, storage) as bag:
        streams = (_commands(bag, table, stamps), _joints(bag, table, stamps), _imu(bag, table, stamps))
        write_merged(*streams, _truth(bag, table, stamps), total=4 * len(stamps))
    write_robot(out / "robot.yaml", robot_settings(), f"Husky, {source.name}: nominal wheels of a skid-steered robot")
    write_text(out / "windows.csv", _list_windows(table, stamps))
    return out / "bag"


def robot_settings() -> dict[str, Any]:
    """Content of ``robot.yaml``."""
    return {
        "recording": {
            "topics": {"command": "/cmd_vel", "joints": "/joint_states", "imu": "/imu", "truth": "/truth"},
            "base_frame": "base_link",
        },
        "wheels": {
            "source": "ticks",
            "left_joint": _JOINTS[0],
            "right_joint": _JOINTS[1],
            "left_radius": WHEEL_RADIUS_M,
            "right_radius": WHEEL_RADIUS_M,
            "track": TRACK_M,
            "noise": {
                "x_per_sqrt_m": 0.15,
                "y_per_sqrt_m": 0.15,
                "yaw_per_sqrt_m": 0.15,
                "xy_per_sqrt_rad": 0.1,
                "yaw_per_sqrt_rad": 0.8,
                "xy_per_sqrt_s": 0.005,
                "yaw_per_sqrt_s": 0.01,
            },
        },
        "estimator": {"initial_pose": [0.0, 0.0, 0.0], "initial_sigmas": [0.02, 0.02, 0.02]},
    }


def _read(source: Path) -> dict[str, FloatArray]:
    """Columns of the CSV file by name, ordered by window and row."""
    check_regular(source, RecordingError, "give the CSV file of the windows", _MOST_BYTES)
    try:
        with source.open(encoding="utf-8", newline="") as file:
            names = next(csv.reader(file), [])
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{source}: cannot be read ({error}); give the CSV file of the windows") from error
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        raise RecordingError(f"{source}: no column {', '.join(missing)} in its first line; expected the windows' CSV")
    table = read_table(source, len(names), delimiter=",", header_rows=1)
    columns = {name: table[:, names.index(name)] for name in _COLUMNS}
    for name in ("window", "calib_step", "i"):
        if not (np.isfinite(columns[name]).all() and (columns[name] >= 0).all()):
            raise RecordingError(f"{source}: column {name} holds what is not a count")
    order = np.lexsort((columns["i"], columns["window"]))
    return {name: column[order] for name, column in columns.items()}


def _stamps(table: dict[str, FloatArray]) -> IntArray:
    window, row = table["window"].astype(np.int64), table["i"].astype(np.int64)
    return np.asarray(_EPOCH_NS + window * _APART_NS + row * _STEP_NS, dtype=np.int64)


def _starts(table: dict[str, FloatArray]) -> IntArray:
    """Indices of the rows with which windows begin."""
    return np.flatnonzero(np.diff(table["window"], prepend=-1.0))


def _commands(bag: BagWriter, table: dict[str, FloatArray], stamps: IntArray) -> Iterator[Message]:
    v = 0.5 * WHEEL_RADIUS_M * (table["cmd_right"] + table["cmd_left"])
    omega = WHEEL_RADIUS_M / TRACK_M * (table["cmd_right"] - table["cmd_left"])
    for stamp, forward, turn in zip(stamps.tolist(), v.tolist(), omega.tolist(), strict=True):
        yield stamp, partial(bag.command, "/cmd_vel", stamp, forward, turn, frame_id="base_link")


def _joints(bag: BagWriter, table: dict[str, FloatArray], stamps: IntArray) -> Iterator[Message]:
    speed = np.column_stack([table["left_wheel_vel"], table["right_wheel_vel"]])
    turned = np.zeros_like(speed)
    for rows in np.split(np.arange(len(speed)), _starts(table)[1:]):
        mean = 0.5 * (speed[rows[1:]] + speed[rows[:-1]])
        turned[rows[1:]] = np.cumsum(mean * np.diff(stamps[rows])[:, None] * 1e-9, axis=0)
    for stamp, position, velocity in zip(stamps.tolist(), turned.tolist(), speed.tolist(), strict=True):
        yield stamp, partial(bag.joints, "/joint_states", stamp, _JOINTS, position, velocity)


def _imu(bag: BagWriter, table: dict[str, FloatArray], stamps: IntArray) -> Iterator[Message]:
    acceleration = np.column_stack([table[f"imu_acceleration_{axis}"] for axis in "xyz"])
    for stamp, rate, a in zip(stamps.tolist(), table["imu_yaw"].tolist(), acceleration.tolist(), strict=True):
        yield stamp, partial(bag.imu, "/imu", stamp, (0.0, 0.0, rate), a)


def _truth(bag: BagWriter, table: dict[str, FloatArray], stamps: IntArray) -> Iterator[Message]:
    """ICP poses where they are new, and the first of each window."""
    poses = np.column_stack([table[f"icp_{name}"] for name in ("x", "y", "z", "roll", "pitch", "yaw")])
    fresh = np.any(np.diff(poses, axis=0, prepend=np.nan) != 0.0, axis=1)
    fresh[_starts(table)] = True
    rotations = Rotation.from_euler("xyz", poses[:, 3:]).as_quat()
    for k in np.flatnonzero(fresh).tolist():
        stamp = int(stamps[k])
        yield stamp, partial(bag.truth, "/truth", stamp, poses[k, :3].tolist(), rotations[k].tolist())


def _list_windows(table: dict[str, FloatArray], stamps: IntArray) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("window", "calib_step", "steady", "start_ns"))
    for k in _starts(table).tolist():
        writer.writerow((*(int(table[name][k]) for name in ("window", "calib_step", "steady")), int(stamps[k])))
    return text.getvalue()


def span(text: str | None, option: str) -> range | None:
    """Numbers of ``a-b``, both included, or of one number alone, as an option of the command line gives them.

    Raises:
        ConfigError: it is neither.
    """
    if text is None:
        return None
    first, _, last = text.partition("-")
    if not (first.isdigit() and (last or first).isdigit()):
        raise ConfigError(f"{option} {text}: expected a number, or a span such as 0-399")
    return range(int(first), int(last or first) + 1)
