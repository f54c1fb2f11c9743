"""What is kept of a job: a record, written whole or not at all, and a line for every attempt."""

from __future__ import annotations

import fcntl
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from fgloc.errors import OutputError
from fgloc.files.outputs import write_json

_ATTEMPT = re.compile(r"(\w+) (\d+\.\d{6})")


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
    """A job's record; None if it has none, or if its file is damaged: then the job has to run again."""
    path = record_path(out, key)
    try:
        return Record.model_validate_json(path.read_bytes())
    except (FileNotFoundError, ValidationError):
        return None


def write_record(out: Path, record: Record) -> None:
    """Write a job's record, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    write_json(record_path(out, record.key), record.model_dump(mode="json"))


def attempts(out: Path) -> list[tuple[str, float]]:
    """Key and time [s since 1970] of every run that was begun, in order, without lines that a full disk cut short."""
    path = out / "jobs" / "attempts.log"
    lines = path.read_text(encoding="ascii", errors="replace").splitlines() if path.exists() else []
    return [(match[1], float(match[2])) for match in map(_ATTEMPT.fullmatch, lines) if match]


def log_attempt(out: Path, key: str) -> None:
    """Note that a run begins.

    Raises:
        OutputError: it cannot be noted.
    """
    path = out / "jobs" / "attempts.log"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab", buffering=0) as file:
            file.write(f"{key} {time.time():.6f}\n".encode())  # one short write: lines of several workers do not mix
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}); finished runs are kept") from error


@contextmanager
def only_sweep(out: Path) -> Iterator[None]:
    """Keep other sweeps out of a folder: two would run the same jobs, and each replace the other's report.

    Raises:
        OutputError: another one is at work in it, or it cannot be written.
    """
    path = out / "jobs" / ".lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error})") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(f"{out}: another sweep is at work in it; wait for it, or give another folder") from error
        except OSError:  # a file system without locks
            pass
        yield
