"""UTIAS MRCLAM: five iRobot Creates, commanded velocities, range and bearing to 15 surveyed barcodes, Vicon truth.

    fgloc convert mrclam SRC --robot 3 --out DIR

writes ``bag/`` (``/cmd_vel``, ``/landmarks``, ``/truth``), ``map.yaml`` and ``robot.yaml``. Nothing is corrected in the
bag: what the files say is what it says. Sightings of the other robots (subjects 1 to 5) and of barcodes that no subject
carries are left out, and counted.

What ``robot.yaml`` corrects for was measured against the truth:

- There is no encoder: the integrated command stands in for it, with a delay and gains.
- The reported "range" is the distance along the camera's axis: the cosine of the bearing is missing.
- Sightings are stamped about 0.04 s late.

**Leave one out.** The row of robot k in the table of constants was fitted on the *other four* robots of dataset 6 only,
noise included; robot k's own truth never reaches its configuration. ``--fit`` refits the table from the files.

Source: Leung, Halpern, Barfoot, Liu, "The UTIAS multi-robot cooperative localization and mapping dataset", IJRR 30(8),
2011. The set carries no licence; cite the paper.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fgloc.errors import RecordingError
from fgloc.frames import yaw_quaternion
from fgloc.sensors.maps import write_map
from fgloc.types import FloatArray, Landmark, LandmarkMap
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import (
    Message,
    nanoseconds,
    new_bag,
    read_table,
    write_merged,
    write_robot,
)
from fgloc_datasets.download import Remote, fetch, unpack
from fgloc_datasets.mrclam_run import Calibration, Run

ROBOTS = (1, 2, 3, 4, 5)
_LANDMARKS = range(6, 21)  # subjects; 1 to 5 are the robots
_FRAME_NS = 20_000_000  # sightings of one image are stamped up to 1 ms apart, images 230 ms
_URL = "ftp://asrl3.utias.utoronto.ca/MRCLAM/MRCLAM{}.zip"  # the owner serves the archives by FTP only
_LONGEST_COMMAND_GAP_S = 1.1  # the robots kept moving through every gap of their command logs, 1.005 s at most
_CORRELATION_S = 10.0  # bearing and depth errors of one landmark are still correlated by 0.1 to 0.3 after 8-16 s
_SHARED_IN_FRAME = 1.3  # bearings of one image share half of their error; two or three are seen at a time
_SCALE_SPREAD = 0.02  # of the range scale from robot to robot
_BIAS_SPREAD_RAD = 0.01  # of the bearing offset


# Robots 1 to 5, each column fitted on the other four robots of dataset 6 (printed by --fit).
_LEFT_OUT = {
    "scale_v": (0.9666, 0.9698, 0.9682, 0.9698, 0.9666),
    "scale_omega": (0.9505, 0.9565, 0.9494, 0.9565, 0.9494),
    "delay_s": (0.2165, 0.2165, 0.2099, 0.2111, 0.2099),
    "yaw_per_m": (-0.04244, -0.03341, -0.03341, -0.04244, -0.03879),
    "x_per_sqrt_m": (0.07028, 0.07102, 0.07189, 0.06918, 0.07081),
    "y_per_sqrt_m": (0.005525, 0.008077, 0.008733, 0.008206, 0.0078),
    "yaw_per_sqrt_m": (0.03294, 0.03366, 0.03529, 0.0381, 0.03763),
    "xy_per_sqrt_rad": (0.006607, 0.006859, 0.006871, 0.007582, 0.004632),
    "yaw_per_sqrt_rad": (0.08588, 0.08851, 0.08835, 0.0827, 0.08726),
    "xy_per_sqrt_s": (0.001, 0.001, 0.001, 0.001, 0.001),
    "yaw_per_sqrt_s": (0.002, 0.002, 0.002, 0.002466, 0.002),
    "range_scale": (0.9684, 0.978, 0.9684, 0.978, 0.972),
    "camera_x": (-0.02315, -0.03096, -0.02607, -0.02315, -0.03096),
    "bearing_bias_rad": (-0.001743, -0.001743, -0.0007446, -0.0006626, -0.0006626),
    "latency_s": (0.03572, 0.03629, 0.03572, 0.03692, 0.03692),
    "range_sigma_m": (0.02, 0.02, 0.02, 0.02, 0.02),
    "range_sigma_per_m": (0.02244, 0.01496, 0.02212, 0.01824, 0.02828),
    "bearing_sigma_rad": (0.009717, 0.009686, 0.01184, 0.009257, 0.01185),
}


def calibration(robot: int) -> Calibration:
    """Constants for one robot, none of which has seen that robot's run of dataset 6."""
    return Calibration(**{name: row[robot - 1] for name, row in _LEFT_OUT.items()})


def read(source: Path, robot: int) -> Run:
    """Read one robot's files.

    Args:
        source: folder with ``Barcodes.dat``, ``Landmark_Groundtruth.dat`` and ``RobotN_*.dat``.
        robot: 1 to 5.

    Raises:
        RecordingError: no such robot, or a file is missing or not what it should be.
    """
    if robot not in ROBOTS:
        raise RecordingError(f"robot {robot}: expected one of {ROBOTS}")
    commands = _rows_in_time(source / f"Robot{robot}_Odometry.dat", 3)
    sightings = _rows_in_time(source / f"Robot{robot}_Measurement.dat", 4)
    truth = _rows_in_time(source / f"Robot{robot}_Groundtruth.dat", 4)
    subject_of = {int(barcode): int(subject) for subject, barcode in read_table(source / "Barcodes.dat", 2)}
    landmarks = {int(row[0]): (row[1], row[2]) for row in read_table(source / "Landmark_Groundtruth.dat", 5)}
    subjects = np.array([subject_of.get(int(barcode), 0) for barcode in sightings[:, 1]], dtype=np.int64)
    of_landmarks = np.isin(subjects, list(_LANDMARKS))
    return Run(
        commands_ns=nanoseconds(commands[:, 0]),
        commands=commands[:, 1:],
        sightings_ns=nanoseconds(sightings[of_landmarks, 0]),
        subjects=subjects[of_landmarks],
        sightings=sightings[of_landmarks, 2:],
        truth_ns=nanoseconds(truth[:, 0]),
        truth=truth[:, 1:],
        landmarks=landmarks,
        robots_left_out=int(np.isin(subjects, ROBOTS).sum()),
        unknown_left_out=int((~np.isin(subjects, [*ROBOTS, *_LANDMARKS])).sum()),
    )


def convert(source: Path, robot: int, out: Path, storage: str = "mcap") -> Path:
    """Convert one robot's run.

    Args:
        source: folder of the unpacked set.
        robot: 1 to 5.
        out: folder that gets ``bag/``, ``map.yaml`` and ``robot.yaml``.
        storage: "mcap" or "sqlite3".

    Returns:
        The bag's folder.

    Raises:
        RecordingError: see `read`.
    """
    write(read(source, robot), robot, out, storage)
    return out / "bag"


def frames(run: Run) -> Iterator[slice]:
    """Sightings of one image each: stamps close together, no landmark twice."""
    start = 0
    for i in range(1, len(run.sightings_ns) + 1):
        if i == len(run.sightings_ns) or (
            run.sightings_ns[i] - run.sightings_ns[start] > _FRAME_NS or run.subjects[i] in run.subjects[start:i]
        ):
            yield slice(start, i)
            start = i


def robot_settings(c: Calibration) -> dict[str, Any]:
    """The contents of ``robot.yaml``."""
    noise = {name: getattr(c, name) for name in Calibration.__dataclass_fields__ if "_per_sqrt_" in name}
    return {
        "recording": {
            "topics": {"command": "/cmd_vel", "sightings": "/landmarks", "truth": "/truth"},
            "base_frame": "base_link",
            "stamp_offset_s": {"sightings": -c.latency_s},
            "sightings_pose": [c.camera_x, 0.0, 0.0, 0.0, 0.0, 0.0],
        },
        "wheels": {
            "source": "command",
            "scale_v": c.scale_v,
            "scale_omega": c.scale_omega,
            "yaw_per_m": c.yaw_per_m,
            "delay_s": c.delay_s,
            "hold_s": _LONGEST_COMMAND_GAP_S,
            "noise": noise,
        },
        "landmarks": {
            "range_along_axis": True,
            "range_scale": c.range_scale,
            "bearing_bias_rad": c.bearing_bias_rad,
            "range_sigma_m": c.range_sigma_m,
            "range_sigma_per_m": c.range_sigma_per_m,
            "range_scale_sigma": _SCALE_SPREAD,
            "bearing_bias_sigma_rad": _BIAS_SPREAD_RAD,
            "bearing_sigma_rad": round(_SHARED_IN_FRAME * c.bearing_sigma_rad, 5),
            "repeat_s": _CORRELATION_S,
        },
    }


def write(run: Run, robot: int, out: Path, storage: str) -> None:
    """Write what was read of a robot: ``bag/``, ``map.yaml``, ``robot.yaml``."""
    with new_bag(out, storage) as bag:
        groups = list(frames(run))
        total = len(run.commands_ns) + len(groups) + len(run.truth_ns)
        write_merged(_commands(bag, run), _sightings(bag, run, groups), _truth(bag, run), total=total)
    write_map(_map(run), out / "map.yaml")
    note = f"MRCLAM robot {robot}. Constants fitted on the other four robots of dataset 6 (fgloc_datasets.mrclam)."
    write_robot(out / "robot.yaml", robot_settings(calibration(robot)), note)


def _map(run: Run) -> LandmarkMap:
    points = {i: np.array([*run.landmarks[i], 0.0]) for i in _LANDMARKS if i in run.landmarks}
    return LandmarkMap({i: Landmark(i, point, np.eye(3), size_m=0.0) for i, point in points.items()})


def _commands(bag: BagWriter, run: Run) -> Iterator[Message]:
    for stamp, (v, omega) in zip(run.commands_ns.tolist(), run.commands.tolist(), strict=True):
        yield stamp, partial(bag.command, "/cmd_vel", stamp, v, omega, frame_id="base_link")


def _sightings(bag: BagWriter, run: Run, groups: list[slice]) -> Iterator[Message]:
    for group in groups:
        stamp = int(run.sightings_ns[group.start])
        seen = [(int(i), r, b) for i, (r, b) in zip(run.subjects[group], run.sightings[group].tolist(), strict=True)]
        yield stamp, partial(bag.range_bearing, "/landmarks", stamp, seen)


def _truth(bag: BagWriter, run: Run) -> Iterator[Message]:
    for stamp, (x, y, yaw) in zip(run.truth_ns.tolist(), run.truth.tolist(), strict=True):
        yield stamp, partial(bag.truth, "/truth", stamp, (x, y, 0.0), yaw_quaternion(yaw).tolist())


def _rows_in_time(path: Path, columns: int) -> FloatArray:
    """Rows of a file by time. A few stamps of the odometry files come twice; both rows stay."""
    table = read_table(path, columns)
    if not np.isfinite(table[:, 0]).all():
        raise RecordingError(f"{path}: a stamp is not a number; download the set again")
    return np.asarray(table[np.argsort(table[:, 0], kind="stable")])


def download(folder: Path, dataset: int) -> Path:
    """Fetch and unpack one of the nine datasets; the folder that holds its files."""
    archive = fetch(Remote(_URL.format(dataset)), folder)
    unpacked = unpack(archive, folder / f"MRCLAM{dataset}")
    found = sorted(unpacked.rglob("Barcodes.dat"))
    if not found:
        raise RecordingError(f"{archive}: holds no Barcodes.dat; it is not an MRCLAM dataset")
    return found[0].parent
