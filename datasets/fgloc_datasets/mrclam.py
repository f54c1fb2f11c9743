"""UTIAS MRCLAM: five iRobot Creates, commanded velocities, range and bearing to 15 surveyed barcodes, Vicon truth.

    fgloc convert mrclam SRC --robot 3 --out DIR

writes ``bag/`` (``/cmd_vel``, ``/landmarks``, ``/truth``), ``map.yaml`` and ``robot.yaml``. Nothing is corrected in
the bag: what the files say is what it says. Sightings of the other robots (subjects 1 to 5) and of barcodes that no
subject carries are left out, and counted.

What ``robot.yaml`` corrects for was measured against the truth:

- There is no encoder: the integrated command stands in for it, with a delay and gains.
- The reported "range" is the distance along the camera's axis: the cosine of the bearing is missing.
- Sightings are stamped about 0.04 s late.

**Leave one out.** The row of robot k in the table of constants was fitted on the *other four* robots of dataset 6
only, noise included; robot k's own truth never reaches its configuration. ``--fit`` refits the table from the files:
the response to commands and the sightings' constants are fitted for each robot against its truth, on the error of 2
s of driving and on the error of each sighting, with a Cauchy loss. Robot k's row holds the *median* over the other
four. Noise is what remains in the other four when each of them is predicted from the three left: so it holds the
spread between robots too.

Source: Leung, Halpern, Barfoot, Liu, "The UTIAS multi-robot cooperative localization and mapping dataset", IJRR
30(8), 2011. The set carries no licence; cite the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize, nnls

from fgloc import se2
from fgloc.config import NoiseDensity
from fgloc.errors import RecordingError
from fgloc.sensors.maps import write_map
from fgloc.types import FloatArray, IntArray, Landmark, LandmarkMap
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import (
    Message,
    Remote,
    fetch,
    nanoseconds,
    new_bag,
    read_table,
    unpack,
    write_merged,
    write_robot,
)

# --- One robot's run --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Calibration:
    """Constants of ``robot.yaml``, named as in `fgloc.config`."""

    scale_v: float
    scale_omega: float
    delay_s: float
    yaw_per_m: float  # rad/m
    x_per_sqrt_m: float
    y_per_sqrt_m: float
    yaw_per_sqrt_m: float
    xy_per_sqrt_rad: float
    yaw_per_sqrt_rad: float
    xy_per_sqrt_s: float
    yaw_per_sqrt_s: float
    range_scale: float
    camera_x: float  # m, in the base frame
    bearing_bias_rad: float
    latency_s: float
    range_sigma_m: float
    range_sigma_per_m: float
    bearing_sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One robot's files. Stamps are integer nanoseconds, in order."""

    commands_ns: IntArray  # (n,)
    commands: FloatArray  # (n, 2) v [m/s], omega [rad/s]
    sightings_ns: IntArray  # (m,)
    subjects: IntArray  # (m,) landmark ids, 6 to 20
    sightings: FloatArray  # (m, 2) reported range [m], bearing [rad]
    truth_ns: IntArray  # (k,)
    truth: FloatArray  # (k, 3) x, y [m], yaw [rad]
    landmarks: dict[int, tuple[float, float]]  # subject -> x, y [m]
    robots_left_out: int  # sightings of other robots
    unknown_left_out: int  # sightings of barcodes that no subject carries


# --- Conversion -------------------------------------------------------------------------------------------------------

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
    """Content of ``robot.yaml``."""
    noise = {name: getattr(c, name) for name in _DENSITIES}
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
    for stamp, pose in zip(run.truth_ns.tolist(), run.truth.tolist(), strict=True):
        yield stamp, partial(bag.planar_truth, "/truth", stamp, pose)


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


# --- Fit of the constants ---------------------------------------------------------------------------------------------

_STEP_S = 0.02
_HOLD_S = 1.1
_TRUTH_GAP_S = 0.2
_FIT_WINDOW_S, _FIT_STRIDE_S = 2.0, 0.5
_NOISE_WINDOW_S, _NOISE_STRIDE_S = 5.0, 2.5  # about the time between two fixes
_GROSS_RANGE_M, _GROSS_BEARING_RAD = 1.0, 0.15
_DENSITIES = tuple(NoiseDensity.model_fields)
_LEAST_DENSITY = np.array([0, 0, 0, 0, 0, 0.001, 0.002])  # at rest: the logs hardly show any, a bump would
_RESPONSE = ("scale_v", "scale_omega", "delay_s", "yaw_per_m")
_SENSOR = ("range_scale", "camera_x", "bearing_bias_rad", "latency_s")


def left_out(runs: Mapping[int, Run]) -> dict[int, Calibration]:
    """For each robot the constants that the other robots suggest; at least three robots."""
    drives = {k: _Drive(run) for k, run in runs.items()}
    response = {k: drive.fit() for k, drive in drives.items()}
    sensor = {k: fit_sensor(run) for k, run in runs.items()}
    return {k: _row(k, runs, drives, response, sensor) for k in runs}


def fit_sensor(run: Run) -> FloatArray:
    """Range scale, camera x [m], bearing bias [rad] and latency [s] of one robot's sightings ``(4,)``."""
    start = np.array([1.0, 0.0, 0.0, 0.04])
    used = _usable(run, start)

    def residuals(q: FloatArray) -> FloatArray:
        e = _all_errors(run, q)[used]
        return np.asarray((e[:, :2] / np.column_stack([0.008 * e[:, 2], np.full(len(e), 0.006)])).ravel())

    fit = least_squares(residuals, start, loss="cauchy", diff_step=1e-3, x_scale=[0.01, 0.05, 0.01, 0.05])
    return np.asarray(fit.x)


def sighting_errors(run: Run, sensor: FloatArray) -> FloatArray:
    """Range error [m], bearing error [rad] and true range [m] of the sightings that have a truth, without gross errors.

    Args:
        run: a robot's run.
        sensor: range scale, camera x, bearing bias, latency.
    """
    return np.asarray(_all_errors(run, sensor)[_usable(run, sensor)])


def _all_errors(run: Run, sensor: FloatArray) -> FloatArray:
    """Errors of range and bearing as `sighting_errors` has them, of every sighting, across gaps of the truth too."""
    scale, camera_x, bias, latency = sensor
    at = run.sightings_ns - int(latency * 1e9)
    pose = se2.interpolate(run.truth_ns, run.truth, at)
    landmark = np.array([run.landmarks[int(i)] for i in run.subjects])
    x, y = se2.turned(landmark - pose[:, :2], -pose[:, 2]).T
    x = x - camera_x
    bearing = run.sightings[:, 1] - bias
    range_error = run.sightings[:, 0] * scale / np.cos(bearing) - np.hypot(x, y)
    return np.column_stack([range_error, se2.wrap_array(bearing - np.arctan2(y, x)), np.hypot(x, y)])


def _usable(run: Run, sensor: FloatArray) -> NDArray[np.bool_]:
    errors = _all_errors(run, sensor)
    small = (abs(errors[:, 0]) < _GROSS_RANGE_M) & (abs(errors[:, 1]) < _GROSS_BEARING_RAD)
    return np.asarray(small & _has_truth(run.truth_ns, run.sightings_ns - int(sensor[3] * 1e9)))


def _row(
    k: int,
    runs: Mapping[int, Run],
    drives: Mapping[int, _Drive],
    response: Mapping[int, FloatArray],
    sensor: Mapping[int, FloatArray],
) -> Calibration:
    others = [j for j in runs if j != k]

    def without(table: Mapping[int, FloatArray], j: int) -> FloatArray:
        return np.median([table[i] for i in others if i != j], axis=0)

    drift = [drives[j].noise_samples(without(response, j)) for j in others]
    density = _densities(np.concatenate([e for e, _ in drift]), np.concatenate([m for _, m in drift], axis=1))
    density = np.maximum(density, _LEAST_DENSITY)
    seen = np.concatenate([sighting_errors(runs[j], without(sensor, j)) for j in others])
    growth, _ = nnls(np.column_stack([np.ones(len(seen)), seen[:, 2]]), 1.2533 * abs(seen[:, 0]))  # E|e| to sigma
    constants = {
        **dict(zip(_RESPONSE, without(response, k), strict=True)),
        **dict(zip(_DENSITIES, density, strict=True)),
        **dict(zip(_SENSOR, without(sensor, k), strict=True)),
        "range_sigma_m": max(growth[0], 0.02),
        "range_sigma_per_m": growth[1],
        "bearing_sigma_rad": _clipped_rms(seen[:, 1]),
    }
    return Calibration(**{name: float(f"{value:.4g}") for name, value in constants.items()})


class _Drive:
    """One robot's commands and truth on a common grid of time."""

    def __init__(self, run: Run) -> None:
        first = max(int(run.truth_ns[0]), int(run.commands_ns[0])) + 3_000_000_000
        last = min(int(run.truth_ns[-1]), int(run.commands_ns[-1])) - 1_000_000_000
        self._grid = np.arange(first, last, int(_STEP_S * 1e9), dtype=np.int64)
        self._truth = se2.interpolate(run.truth_ns, run.truth, self._grid)
        self._truth[:, 2] = np.unwrap(self._truth[:, 2])
        unknown = ~_has_truth(run.truth_ns, self._grid)
        self._unknown_before = np.concatenate([[0], np.cumsum(unknown)])
        self._driven = _held_integral(run.commands_ns, run.commands)

    def fit(self) -> FloatArray:
        """Gains of v and omega, delay [s] and yaw per metre [rad/m] ``(4,)``."""
        fit = least_squares(
            lambda q: (self.errors(q, _FIT_WINDOW_S, _FIT_STRIDE_S)[0] / [0.02, 0.02, 0.04]).ravel(),
            [0.95, 0.95, 0.2, 0.0],
            loss="cauchy",
            diff_step=1e-3,
            x_scale=[0.05, 0.05, 0.05, 0.02],
        )
        return np.asarray(fit.x)

    def errors(self, response: FloatArray, window_s: float, stride_s: float) -> tuple[FloatArray, IntArray, IntArray]:
        """Errors ``(n, 3)`` of the motion over windows, in the frame of their ends; where the windows begin and end."""
        poses = self._integrate(response)[0]
        begin, end = self._windows(window_s, stride_s)
        predicted, true = _relative(poses, begin, end), _relative(self._truth, begin, end)
        return se2.between_array(predicted, true), begin, end

    def noise_samples(self, response: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors ``(n, 3)`` and, for each density, the covariance that its unit gives each window ``(7, n, 3, 3)``."""
        error, begin, end = self.errors(response, _NOISE_WINDOW_S, _NOISE_STRIDE_S)
        poses, v, omega = self._integrate(response)
        travelled = np.concatenate([[0.0], np.cumsum(abs(v) * _STEP_S)])
        turned = np.concatenate([[0.0], np.cumsum(abs(omega) * _STEP_S)])
        basis = np.zeros((len(_DENSITIES), len(begin), 3, 3))
        stride = 5
        for offset in range(0, int(end[0] - begin[0]), stride):
            a, b = begin + offset, np.minimum(begin + offset + stride, end)
            x, y, yaw = _relative(poses, a + stride // 2, end).T
            c, s = np.cos(yaw), np.sin(yaw)
            # Columns of Ad of the inverse motion to the window's end: what an error made here becomes there
            along = np.column_stack([c, -s, np.zeros_like(c)])
            across = np.column_stack([s, c, np.zeros_like(c)])
            turn = np.column_stack([s * x - c * y, c * x + s * y, np.ones_like(c)])
            xx, yy, tt = (e[:, :, None] * e[:, None, :] for e in (along, across, turn))
            metres, radians = travelled[b] - travelled[a], turned[b] - turned[a]
            seconds = (b - a) * _STEP_S
            parts = ((xx, metres), (yy, metres), (tt, metres), (xx + yy, radians), (tt, radians))
            for i, (shape, amount) in enumerate((*parts, (xx + yy, seconds), (tt, seconds))):
                basis[i] += shape * amount[:, None, None]
        return error, basis

    def _integrate(self, response: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        scale_v, scale_omega, delay, yaw_per_m = response
        ends = np.append(self._grid, self._grid[-1] + int(_STEP_S * 1e9)) - int(delay * 1e9)
        driven = np.diff(self._driven(ends), axis=0) / _STEP_S
        v = scale_v * driven[:, 0]
        omega = scale_omega * driven[:, 1] + yaw_per_m * v
        yaw = np.concatenate([[0.0], np.cumsum(omega * _STEP_S)])
        middle = 0.5 * (yaw[:-1] + yaw[1:])
        step = np.column_stack([v * np.cos(middle), v * np.sin(middle)]) * _STEP_S
        position = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
        return np.column_stack([position, yaw])[:-1], v, omega

    def _windows(self, window_s: float, stride_s: float) -> tuple[IntArray, IntArray]:
        n = round(window_s / _STEP_S)
        begin = np.arange(0, len(self._grid) - n, round(stride_s / _STEP_S), dtype=np.int64)
        begin = begin[self._unknown_before[begin + n] == self._unknown_before[begin]]
        return begin, begin + n


def _held_integral(stamps_ns: IntArray, values: FloatArray) -> Callable[[IntArray], FloatArray]:
    """Integral over time of values that hold until the next one, at most for a while; a function of the time."""
    dt = np.minimum(np.diff(stamps_ns) * 1e-9, _HOLD_S)
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values[:-1] * dt[:, None], axis=0)])
    origin = stamps_ns[0]
    start = (stamps_ns - origin) * 1e-9
    knots = np.column_stack([start[:-1], start[:-1] + dt]).ravel()
    at_knots = np.stack([total[:-1], total[1:]], axis=1).reshape(-1, values.shape[1])

    def integral(at_ns: IntArray) -> FloatArray:
        at = (at_ns - origin) * 1e-9
        return np.column_stack([np.interp(at, knots, column) for column in at_knots.T])

    return integral


def _has_truth(truth_ns: IntArray, at_ns: IntArray) -> NDArray[np.bool_]:
    after = np.clip(np.searchsorted(truth_ns, at_ns), 1, len(truth_ns) - 1)
    gap = (truth_ns[after] - truth_ns[after - 1]) * 1e-9
    return np.asarray((at_ns >= truth_ns[0]) & (at_ns <= truth_ns[-1]) & (gap < _TRUTH_GAP_S))


def _relative(poses: FloatArray, begin: IntArray, end: IntArray) -> FloatArray:
    """Motions ``(n, 3)`` between poses whose yaw is not wrapped."""
    d = poses[end] - poses[begin]
    return np.column_stack([se2.turned(d[:, :2], -poses[begin, 2]), d[:, 2]])


def _densities(errors: FloatArray, basis: FloatArray) -> FloatArray:
    """Densities ``(7,)`` under which Gaussian errors are likeliest, weakly drawn to 0.02 where the errors show none."""

    def cost(log_density: FloatArray) -> float:
        cov = np.tensordot(np.exp(2.0 * log_density), basis, 1) + 1e-10 * np.eye(3)
        nis = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(cov), errors)
        return float(0.5 * (np.linalg.slogdet(cov)[1] + nis).mean() + 1e-4 * ((log_density + 4.0) ** 2).sum())

    start = np.log([0.05, 0.01, 0.05, 0.01, 0.1, 0.002, 0.005])
    return np.asarray(np.exp(minimize(cost, start, method="L-BFGS-B", bounds=[(-9.0, 1.0)] * 7).x))


def _clipped_rms(errors: FloatArray) -> float:
    """RMS of errors, those beyond three robust sigmas counted as three: a robust kernel takes care of the rest."""
    limit = 3.0 * 1.4826 * np.median(abs(errors - np.median(errors))) + abs(np.median(errors))
    return float(np.sqrt((np.clip(errors, -limit, limit) ** 2).mean()))
