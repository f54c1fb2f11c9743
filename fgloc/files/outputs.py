"""Writing and reading results: TUM trajectories, covariances, decisions, JSON; a file appears whole or not at all."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from fgloc.errors import OutputError, TrajectoryError
from fgloc.files.atomic import atomic_file
from fgloc.files.documents import read_text
from fgloc.frames import quaternion_matrix, quaternion_yaw, roll_pitch, rpy_matrix, rpy_quaternion
from fgloc.types import Decision, IntArray, Protection, Trajectory

_NS = 1_000_000_000
_TUM_HEADER = "# stamp[s] x[m] y[m] z[m] qx qy qz qw\n"
_COV_COLUMNS: tuple[str, ...] = ("xx", "xy", "xθ", "yy", "yθ", "θθ")
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_SPATIAL_COV_COLUMNS: tuple[str, ...] = tuple(f"{a} {b}" for i, a in enumerate(_AXES) for b in _AXES[i:])
_STEP_COLUMNS = (
    "step",
    "stamp",
    "kind",
    "landmark_id",
    "residual",
    "nis",
    "dof",
    "weight",
    "reason",
    "threshold",
    "shift_m",
    "judgement",
)


RESULT_FORMAT = 1
"""Version of result folders, in ``config.json``; 0: none is written there, before 1.0."""

RESULT_MARK = "# As a run of fgloc found it. Beside the run's result, other runs read it only if they are given it."
"""First line of a file that a run writes under a name which the next one looks for beside its recording."""


def is_result(file: Path) -> bool:
    """Whether a run wrote this file with its result, which still lies beside it."""
    if not (file.parent / "trajectory.tum").is_file():
        return False
    mark = RESULT_MARK.encode()
    try:
        with file.open("rb") as opened:
            return opened.read(len(mark)) == mark
    except OSError:
        return False


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as TUM: ``t x y z qx qy qz qw``, t in seconds with all nine decimals.

    On a flat floor z, roll and pitch are 0.

    Raises:
        TrajectoryError: a pose is not finite.
        OutputError: the file cannot be written.
    """
    _check_finite(path, trajectory)
    with atomic_file(path) as file:
        file.write(_TUM_HEADER)
        for i, (stamp, (x, y, yaw)) in enumerate(
            zip(trajectory.stamps_ns.tolist(), trajectory.poses.tolist(), strict=True)
        ):
            qz, qw = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
            numbers = (x, y, 0.0, 0.0, 0.0, qz, qw)
            if trajectory.ground is not None:
                z, roll, pitch = trajectory.ground[i].tolist()
                numbers = (x, y, z, *rpy_quaternion(roll, pitch, yaw))
            file.write(f"{_seconds(stamp)} " + " ".join(f"{number:.9f}" for number in numbers) + "\n")


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as KITTI's odometry benchmark has it: the 12 numbers of ``[R | t]``, row by row.

    The axes are ours (x forward, z up); KITTI's own files have a camera's. There are no stamps: one line a pose.

    Raises:
        TrajectoryError: a pose is not finite.
        OutputError: the file cannot be written.
    """
    _check_finite(path, trajectory)
    with atomic_file(path) as file:
        for i, (x, y, yaw) in enumerate(trajectory.poses.tolist()):
            c, s = math.cos(yaw), math.sin(yaw)
            numbers: tuple[float, ...] = (c, -s, 0.0, x, s, c, 0.0, y, 0.0, 0.0, 1.0, 0.0)
            if trajectory.ground is not None:
                z, roll, pitch = trajectory.ground[i].tolist()
                numbers = tuple(np.column_stack([rpy_matrix(roll, pitch, yaw), (x, y, z)]).ravel().tolist())
            file.write(" ".join(f"{number:.9e}" for number in numbers) + "\n")


def read_tum(path: Path, ground: bool = False) -> Trajectory:
    """Read a TUM trajectory, flattened to the plane. Stamps are exact to the nanosecond.

    Args:
        path: the file.
        ground: keep height, roll and pitch too.

    Raises:
        TrajectoryError: the file is missing or empty, or a line has not eight finite numbers, a zero quaternion, or a
            stamp that does not come after the one before. The message names file, line and value.
    """
    lines = read_text(path, TrajectoryError, "give a TUM text file", max_bytes=1 << 30).splitlines()
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    heights: list[tuple[float, float, float]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        stamp, pose, height = _parse_tum_line(line, where=f"{path}, line {number}")
        if stamps and stamp <= stamps[-1]:
            raise TrajectoryError(
                f"{path}, line {number}: stamp {line.split()[0]} does not come after {_seconds(stamps[-1])}; "
                "sort the file and drop duplicate stamps"
            )
        stamps.append(stamp)
        poses.append(pose)
        heights.append(height)
    if not stamps:
        raise TrajectoryError(f"{path}: no pose in it; expected lines of t x y z qx qy qz qw")
    above = np.array(heights, dtype=float) if ground else None
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses, dtype=float), ground=above)


def write_covariance_csv(path: Path, trajectory: Trajectory) -> None:
    """Write the upper triangle of each pose's covariance in the map frame: stamp, xx xy xθ yy yθ θθ [m, rad].

    On uneven ground it is that of x, y, z, roll, pitch and yaw.

    Raises:
        TrajectoryError: the trajectory has no covariances.
        OutputError: the file cannot be written.
    """
    if trajectory.covs is None:
        raise TrajectoryError(f"{path}: the trajectory has no covariances to write")
    covs, columns = trajectory.covs, _COV_COLUMNS
    if trajectory.ground_covs is not None:
        covs, columns = trajectory.ground_covs, _SPATIAL_COV_COLUMNS
    upper = np.triu_indices(covs.shape[-1])
    rows = (
        (_seconds(stamp), *(f"{value:.9e}" for value in cov[upper]))
        for stamp, cov in zip(trajectory.stamps_ns.tolist(), covs, strict=True)
    )
    _write_table(path, ("stamp", *columns), rows)


def write_protection_csv(path: Path, stamps_ns: IntArray, protections: Sequence[Protection]) -> None:
    """Write the bound on each pose's error: along, across [m], yaw [rad] and position [m], its cause, and the alert.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = (
        (_seconds(stamp), *(f"{value:.6g}" for value in (*p.bound, p.position_m)), p.cause, int(p.alert))
        for stamp, p in zip(stamps_ns.tolist(), protections, strict=True)
    )
    _write_table(path, ("stamp", "along_m", "across_m", "yaw_rad", "position_m", "cause", "alert"), rows)


def write_steps_csv(path: Path, decisions: Iterable[Decision], judged: Mapping[Decision, int] | None = None) -> None:
    """Write one row per decision: what was measured, how well it fitted, its weight, and why.

    Args:
        path: the file.
        decisions: the rows.
        judged: the number of the judgement that a row belongs to, where it belongs to one.

    Raises:
        OutputError: the file cannot be written.
    """
    numbers = judged or {}

    def row(d: Decision) -> tuple[object, ...]:
        fit = (f"{d.residual:.6g}", f"{d.nis:.6g}", d.dof, f"{d.weight:.6g}")
        shown = ("" if math.isnan(value) else f"{value:.6g}" for value in (d.threshold, d.shift_m))
        return d.step, _seconds(d.stamp_ns), d.kind, d.landmark_id, *fit, d.reason, *shown, numbers.get(d, "")

    _write_table(path, _STEP_COLUMNS, map(row, decisions))


def _write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with atomic_file(path) as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(columns)
        table.writerows(rows)


def _check_finite(path: Path, trajectory: Trajectory) -> None:
    finite = np.isfinite(trajectory.poses).all(axis=1)
    if trajectory.ground is not None:
        finite &= np.isfinite(trajectory.ground).all(axis=1)
    bad = np.flatnonzero(~finite)
    if bad.size:
        pose = trajectory.poses[bad[0]].tolist()
        raise TrajectoryError(f"{path}: pose {bad[0]} is {pose}, expected finite x, y, yaw; nothing was written")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write indented JSON. A number that is not finite is refused: JSON has none, and null says "unknown".

    Raises:
        OutputError: the file cannot be written, or the content holds what JSON cannot.
    """
    try:
        text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise OutputError(f"{path}: not representable as JSON ({error}); the old file is kept") from error
    with atomic_file(path) as file:
        file.write(text + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_file(path) as file:
        file.write(text)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a binary file.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_file(path, binary=True) as file:
        file.write(data)


def sha256_of(path: Path) -> str:
    """Hex SHA-256 of a file, or of a folder's file names and contents.

    Raises:
        OSError: it cannot be read.
    """
    if path.is_file():
        return _digest(path)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    listing = "".join(f"{_digest(file)}  {file.relative_to(path).as_posix()}\n" for file in files)
    return hashlib.sha256(os.fsencode(listing)).hexdigest()


def _digest(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def _seconds(stamp_ns: int) -> str:
    """Seconds with nine decimals, exact."""
    sign = "-" if stamp_ns < 0 else ""
    whole, rest = divmod(abs(stamp_ns), _NS)
    return f"{sign}{whole}.{rest:09d}"


def _parse_tum_line(line: str, where: str) -> tuple[int, tuple[float, float, float], tuple[float, float, float]]:
    """Stamp [ns]; x, y [m] and yaw [rad]; z [m], roll and pitch [rad]."""
    words = line.split()
    if len(words) != 8:
        raise TrajectoryError(
            f"{where}: {len(words)} values between blanks, expected the 8 of t x y z qx qy qz qw: {line.strip()!r}; "
            "evo writes EuRoC's files so: evo_traj euroc FILE --save_as_tum"
        )
    for word in words:
        try:
            finite = Decimal(word).is_finite()
        except InvalidOperation:
            finite = False
        if not finite:
            raise TrajectoryError(f"{where}: {word!r} is not a finite number; remove the line or mend it")
    stamp = int((Decimal(words[0]) * _NS).to_integral_value())
    if abs(stamp) >= 2**63:
        raise TrajectoryError(f"{where}: stamp {words[0]} is out of range; expected seconds")
    x, y, z = (float(word) for word in words[1:4])
    quaternion = np.array([float(word) for word in words[4:]])
    norm = float(np.linalg.norm(quaternion))
    if not 0.5 < norm < 2.0:
        raise TrajectoryError(f"{where}: quaternion {' '.join(words[4:])} has length {norm:.3g}, expected 1 (x y z w)")
    quaternion /= norm
    return stamp, (x, y, quaternion_yaw(quaternion)), (z, *roll_pitch(quaternion_matrix(quaternion)))
