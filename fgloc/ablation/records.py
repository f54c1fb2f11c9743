"""What is kept of a job: a record, written whole or not at all, and a line for every attempt."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from fgloc.recording.outputs import write_json


class Track(BaseModel):
    """Estimate and truth at common times, for a picture [m]."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    estimate: list[tuple[float, float]]
    truth: list[tuple[float, float]]


class Cost(BaseModel):
    """What a run took; never the same twice."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seconds: float
    cpu_s: float
    peak_mb: float


class Record(BaseModel):
    """What is known of a job after its run. All but ``cost`` depends on the inputs alone."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str
    outcome: Literal["done", "refused", "crashed"]
    error: str = ""  # of a refused run the message, of a crashed one the traceback
    figures: dict[str, Any] = {}  # of Metrics, without times
    modes: dict[str, float] = {}  # mode -> share of the poses
    mistakes: tuple[str, ...] = ()  # of the set-up
    affected: dict[str, int] = {}  # events that the failures changed, by kind
    track: Track | None = None
    cost: Cost


def record_path(out: Path, key: str) -> Path:
    """Where a job's record is."""
    return out / "jobs" / f"{key}.json"


def owner_path(out: Path, folder: str) -> Path:
    """Where the key of the job is that wrote the files of a folder last."""
    return out / "jobs" / f"{folder}.owner"


def read_record(out: Path, key: str) -> Record | None:
    """A job's record; None if it has none."""
    path = record_path(out, key)
    return Record.model_validate_json(path.read_bytes()) if path.exists() else None


def write_record(out: Path, record: Record) -> None:
    """Write a job's record, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    write_json(record_path(out, record.key), record.model_dump(mode="json"))


def attempts(out: Path) -> list[tuple[str, float]]:
    """Key and time [s since 1970] of every run that was begun, in order."""
    path = out / "jobs" / "attempts.log"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [(key, float(stamp)) for key, stamp in (line.split() for line in lines)]


def log_attempt(out: Path, key: str) -> None:
    """Note that a run begins."""
    folder = out / "jobs"
    folder.mkdir(parents=True, exist_ok=True)
    file = os.open(folder / "attempts.log", os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(file, f"{key} {time.time():.6f}\n".encode())  # one short write: lines of several workers do not mix
    finally:
        os.close(file)
