"""What the converters share: a bag that appears whole, robot.yaml, reading of tables."""

from __future__ import annotations

import heapq
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike

from fgloc.config import load_config
from fgloc.errors import RecordingError
from fgloc.files.outputs import write_text
from fgloc.instrumentation import counted
from fgloc.types import FloatArray, IntArray
from fgloc_datasets.bag import BagWriter

Message = tuple[int, Callable[[], None]]  # when it was received [ns], and what writes it


@contextmanager
def new_bag(out: Path, storage: str) -> Iterator[BagWriter]:
    """Write ``out/bag``: it appears when it is complete, and replaces an earlier one only then.

    Raises:
        RecordingError: ``out/bag`` exists and is no bag, or the storage is unknown.
    """
    if storage not in ("mcap", "sqlite3"):
        raise RecordingError(f"storage {storage!r}: expected 'mcap' or 'sqlite3'")
    target = out / "bag"
    if target.exists() and not (target / "metadata.yaml").is_file():
        raise RecordingError(f"{target} exists and is not a bag (no metadata.yaml); give another --out or remove it")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out, prefix=".converting-") as scratch:
        made = Path(scratch) / "bag"
        with BagWriter(made, storage) as bag:
            yield bag
        if target.exists():
            target.rename(Path(scratch) / "replaced")
        made.rename(target)


def write_merged(*streams: Iterable[Message], total: int | None = None) -> None:
    """Write messages in the order in which they were received; each stream is already in order."""
    merged = heapq.merge(*streams, key=itemgetter(0))
    for _, write in counted(merged, "converting", total, "messages"):
        write()


def write_robot(path: Path, settings: Mapping[str, Any], note: str) -> Path:
    """Write a ``robot.yaml`` headed by a comment, and load it back to prove it valid.

    Raises:
        ConfigError: the settings are not a configuration.
    """
    header = "".join(f"# {line}\n" for line in note.splitlines())
    write_text(path, header + yaml.safe_dump(dict(settings), sort_keys=False, default_flow_style=None, width=110))
    load_config(path)
    return path


def read_table(path: Path, columns: int, *, delimiter: str | None = None, header_rows: int = 0) -> FloatArray:
    """Numbers of a text table, ``(n, columns)``; text after ``#`` is a comment.

    Raises:
        RecordingError: the file is missing, empty, no table of numbers, or has another number of columns.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy's word on an empty file; said below with its name
            table = np.loadtxt(path, delimiter=delimiter, skiprows=header_rows, ndmin=2, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error}); give the folder of the unpacked set") from error
    except (ValueError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: expected {columns} columns of numbers: {error}") from error
    if table.size == 0:
        raise RecordingError(f"{path}: holds no rows; expected {columns} columns of numbers")
    if table.shape[1] != columns:
        raise RecordingError(f"{path}: {table.shape[1]} columns, expected {columns}")
    return np.asarray(table, dtype=float)


def nanoseconds(seconds: ArrayLike) -> IntArray:
    """Integer nanoseconds of float seconds since 1970, which are good to a microsecond."""
    return np.asarray(np.round(np.asarray(seconds, dtype=float) * 1e6), dtype=np.int64) * 1000
