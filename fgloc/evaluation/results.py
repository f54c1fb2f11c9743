"""Reading a result folder back: what ``fgloc smooth``, ``fgloc online`` and `fgloc.RunResult.write` wrote."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from fgloc.errors import TrajectoryError
from fgloc.files.documents import read_text
from fgloc.files.outputs import RESULT_FORMAT, read_tum
from fgloc.sensors.maps import load_map
from fgloc.types import Decision, FloatArray, LandmarkMap, Mode, Trajectory

_MOST_BYTES = 1 << 30  # of each file
_REMEDY = "give the folder of a finished run (--out of fgloc smooth or fgloc online)"
_MODES = {mode.value.lower(): mode for mode in Mode}
_PLANAR = (0, 1, 5)  # of x, y, z, roll, pitch, yaw


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """A run as its folder has it; its truth, in a frame of its own, is not read.

    Attributes:
        folder: where it was read from.
        trajectory: ``T_map_base`` with covariances in the map frame.
        modes: one per pose.
        decisions: the rows of ``steps.csv``.
        metrics: ``metrics.json``.
        provenance: ``config.json``: command, configuration, versions, hash of the recording.
        landmarks: ``map.yaml``: the map where the run found its landmarks; None: it has none.
        truth: None.
    """

    folder: Path
    trajectory: Trajectory
    modes: tuple[Mode, ...]
    decisions: tuple[Decision, ...]
    metrics: Mapping[str, Any]
    provenance: Mapping[str, Any]
    landmarks: LandmarkMap | None = None
    truth: Trajectory | None = None


def read_results(folder: Path | str) -> Results:
    """Read the folder of a run, also of an older version: what it did not write is missing.

    Raises:
        TrajectoryError: a file is missing, or a line of it is not what a run writes; the message names both.
        MapError: its map cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise TrajectoryError(f"{folder}: no such folder; {_REMEDY}")
    if not (folder / "trajectory.tum").is_file():
        raise TrajectoryError(f"{folder}: no trajectory.tum in it; {_REMEDY}")
    provenance = _read_json(folder / "config.json")
    written = provenance.get("format", 0)
    if not isinstance(written, int) or not 0 <= written <= RESULT_FORMAT:
        raise TrajectoryError(
            f"{folder}: written by a newer fgloc (format {written!r}; this one reads up to {RESULT_FORMAT}); update "
            "fgloc, or run the recording again"
        )
    trajectory = _read_trajectory(folder)
    decisions = _read_steps(folder / "steps.csv")
    named = _named(decisions)
    map_file = folder / "map.yaml"
    return Results(
        folder=folder,
        trajectory=trajectory,
        modes=tuple(named.get(stamp, Mode.OK) for stamp in trajectory.stamps_ns.tolist()),
        decisions=decisions,
        metrics=_read_json(folder / "metrics.json"),
        provenance=provenance,
        landmarks=load_map(map_file) if map_file.is_file() else None,
    )


def read_modes(steps: Path) -> dict[int, Mode]:
    """Modes of the poses that are not `Mode.OK`, by stamp [ns].

    Args:
        steps: the ``steps.csv`` of a run.

    Raises:
        TrajectoryError: it is missing, or a line of it is not what a run writes.
    """
    return _named(_read_steps(steps))


def _named(decisions: Iterable[Decision]) -> dict[int, Mode]:
    return {d.stamp_ns: _MODES[d.reason] for d in decisions if d.kind == "mode" and d.reason in _MODES}


def _read_trajectory(folder: Path) -> Trajectory:
    """Poses and covariances, on uneven ground those in space too."""
    poses = read_tum(folder / "trajectory.tum", ground=True)
    covs = _read_covariances(folder / "covariance.csv", poses)
    if covs.shape[1] == 3:
        return Trajectory(poses.stamps_ns, poses.poses, covs)
    planar = covs[:, _PLANAR][:, :, _PLANAR]
    return Trajectory(poses.stamps_ns, poses.poses, planar, poses.ground, covs)


def _read_covariances(path: Path, poses: Trajectory) -> FloatArray:
    """Covariances ``(n, 3, 3)``, on uneven ground ``(n, 6, 6)``, whose stamps must be those of the poses."""
    rows = _rows(path)
    if len(rows) != len(poses):
        raise TrajectoryError(f"{path}: {len(rows)} rows, expected {len(poses)}, as many as there are poses; {_REMEDY}")
    size = 6 if rows and "roll roll" in rows[0] else 3
    upper = np.triu_indices(size)
    covs = np.zeros((len(rows), size, size))
    for i, (row, stamp) in enumerate(zip(rows, poses.stamps_ns.tolist(), strict=True)):
        where = f"{path}, line {i + 2}"
        if _stamp(row.get("stamp"), where) != stamp:
            raise TrajectoryError(f"{where}: stamp {row.get('stamp')} is not that of the pose; {_REMEDY}")
        values = [_number(value, where) for key, value in row.items() if key != "stamp"]
        if len(values) != len(upper[0]) or not np.isfinite(values).all():
            raise TrajectoryError(f"{where}: expected {len(upper[0])} finite numbers after the stamp; {_REMEDY}")
        covs[i][upper] = values
        covs[i] += np.triu(covs[i], 1).T
    return covs


def _read_steps(path: Path) -> tuple[Decision, ...]:
    out = []
    for i, row in enumerate(_rows(path)):
        where = f"{path}, line {i + 2}"
        fit = [_number(row.get(key), where) for key in ("residual", "nis", "weight")]
        whole = [_number(row.get(key), where) for key in ("step", "landmark_id", "dof")]
        if not all(value.is_integer() for value in whole):
            raise TrajectoryError(f"{where}: step, landmark_id and dof are {whole}, expected whole numbers; {_REMEDY}")
        threshold, shift = (_number(row.get(key) or "nan", where) for key in ("threshold", "shift_m"))
        residual, nis, weight = fit
        step, landmark, dof = (int(value) for value in whole)
        stamp, kind, reason = _stamp(row.get("stamp"), where), row.get("kind") or "", row.get("reason") or ""
        out.append(Decision(step, stamp, kind, landmark, residual, nis, dof, weight, reason, threshold, shift))
    return tuple(out)


def _rows(path: Path) -> list[dict[str, str]]:
    text = read_text(path, TrajectoryError, _REMEDY, max_bytes=_MOST_BYTES)
    return list(csv.DictReader(text.splitlines()))


def _read_json(path: Path) -> Mapping[str, Any]:
    text = read_text(path, TrajectoryError, _REMEDY, max_bytes=_MOST_BYTES)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise TrajectoryError(f"{path}: not JSON ({error}); {_REMEDY}") from error
    if not isinstance(content, dict):
        raise TrajectoryError(f"{path}: a {type(content).__name__}, expected an object; {_REMEDY}")
    return content


def _number(text: str | None, where: str) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise TrajectoryError(f"{where}: {text!r} is not a number; {_REMEDY}") from None


def _stamp(text: str | None, where: str) -> int:
    try:
        seconds = Decimal(text or "")
    except InvalidOperation:
        raise TrajectoryError(f"{where}: stamp {text!r} is not a number; {_REMEDY}") from None
    if not seconds.is_finite() or math.isinf(float(seconds)) or abs(seconds) > 1 << 33:
        raise TrajectoryError(f"{where}: stamp {text} is out of range; expected seconds; {_REMEDY}")
    return int((seconds * 1_000_000_000).to_integral_value())
