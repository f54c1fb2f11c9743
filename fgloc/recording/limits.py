"""Bounds on what a recording may expand to: work and memory stay in proportion to the size of its files.

A few kilobytes of zstd, LZ4 or bzip2 can stand for gigabytes of zeros, an index may name one message a million times,
and a table of a database may be a query that never ends. Sensor data compresses by 2 to 10, uncompressed images of a
simulator without noise by up to 100: a pass over a recording may deliver 128 times its size, and 32 MiB in any case.
"""

from __future__ import annotations

import bz2
import sqlite3
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote

import lz4.frame  # type: ignore[import-untyped]
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import decompressors as ros1_decompressors
from rosbags.rosbag2 import storage_mcap, storage_sqlite3

from fgloc.errors import RecordingError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

_RATIO = 128
_FREE_BYTES = 32 << 20
_BLOCK = 1 << 20
_FRAMES = 1000  # of one chunk; recorders write one
REWINDS = 4  # a ROS 1 reader decompresses a chunk again when messages of two chunks alternate


class TooLargeError(RecordingError):
    """A recording expands to more than its size allows; it is not salvaged."""


class _Decompressor(Protocol):
    @property
    def eof(self) -> bool: ...
    @property
    def unused_data(self) -> bytes: ...
    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "zstd": zstd.ZstdDecompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


def allowed_bytes(path: Path) -> int:
    """Number of bytes that a pass over a file, or over a folder's files, may deliver."""
    files = [path] if path.is_file() else [file for file in path.iterdir() if file.is_file()]
    return _FREE_BYTES + _RATIO * sum(file.stat().st_size for file in files)


class Budget:
    """Counts what passes over one file deliver.

    Attributes:
        limit: bytes that one pass may deliver.
    """

    def __init__(self, path: Path) -> None:
        """A budget by the file's size."""
        self._path = path
        self.limit = allowed_bytes(path)
        self._left = 0

    def start_pass(self, rewinds: int = 1) -> None:
        """Let one more pass begin, which may decompress everything this many times."""
        self._left = rewinds * self.limit

    def check(self, size: int) -> None:
        """Refuse what would be larger than a pass may be.

        Raises:
            TooLargeError: it would be.
        """
        if size > self.limit:
            raise TooLargeError(
                f"{self._path}: expands to {size / 1e6:.0f} MB or more, expected at most {self.limit / 1e6:.0f} MB "
                f"({_RATIO} times its size and {_FREE_BYTES >> 20} MiB); if you trust it, decompress it first"
            )

    def spend(self, size: int) -> None:
        """Count bytes that were decompressed for the current pass.

        Raises:
            TooLargeError: the pass delivers too much.
        """
        self._left -= size
        if self._left < 0:
            self.check(self.limit + 1)


def decompressed(kind: str, data: bytes, limit: int, cut: bool = False) -> bytes:
    """Decompress all frames of some data.

    Args:
        kind: "zstd", "lz4", "bz2", or "" or "none" for data that is not compressed.
        data: compressed.
        limit: bytes that may come out.
        cut: the data may end too early; what comes before is returned.

    Raises:
        OverflowError: more would come out.
        ValueError: the kind is unknown, the data ends too early, or has too many frames.
        Exception: what the decompressors raise on damaged data.
    """
    if kind in ("", "none"):
        return data
    if kind not in _DECOMPRESSORS:
        raise ValueError(f"unknown compression {kind!r}")
    parts: list[bytes] = []
    size = 0
    for _ in range(_FRAMES):
        if not data:
            return b"".join(parts)
        decompressor: _Decompressor = _DECOMPRESSORS[kind]()
        while not decompressor.eof:
            part = decompressor.decompress(data, min(_BLOCK, limit + 1 - size))
            data = b""
            size += len(part)
            parts.append(part)
            if size > limit:
                raise OverflowError(f"a chunk expands to more than {limit} bytes")
            if not part and not decompressor.eof:
                if cut:
                    return b"".join(parts)
                raise ValueError(f"{kind} data ends too early")
        data = decompressor.unused_data or b""
    raise ValueError(f"more than {_FRAMES} frames in one chunk")


def decompress_file(source: Path, target: Path) -> None:
    """Decompress a ``.zstd`` file.

    Raises:
        TooLargeError: it expands beyond its allowance.
        EOFError: it is damaged, or ends too early; what came before is in the target.
        OSError: the target cannot be written.
    """
    budget, size = Budget(source), 0
    with zstd.open(source, "rb") as content, target.open("wb") as file:
        while True:
            try:
                block = content.read(_BLOCK)
            except zstd.ZstdError as error:
                raise EOFError(str(error)) from error
            if not block:
                return
            size += len(block)
            budget.check(size)
            file.write(block)


_opening: ContextVar[Budget | None] = ContextVar("opening", default=None)


@contextmanager
def opening(budget: Budget) -> Iterator[None]:
    """Count what an MCAP reader decompresses meanwhile, for it reads a file without an index through."""
    token = _opening.set(budget)
    try:
        yield
    finally:
        _opening.reset(token)


def _chunk(kind: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk that claims to hold ``size`` bytes, in place of rosbags' own function."""
    if (budget := _opening.get()) is not None:
        budget.check(size)
        budget.spend(size)
    return decompressed(kind, data, size)


# rosbags decompresses without bounds, and loads quality-of-service profiles, which nobody here reads, as YAML, where a
# few nested merges take hours.
storage_mcap.DECOMPRESSORS.update({kind: partial(_chunk, kind) for kind in ("lz4", "zstd")})
storage_mcap.get_qos = lambda metadata: []
storage_sqlite3.parse_qos = lambda dcts: []  # type: ignore[attr-defined]


def bound_reader(reader: Any, budget: Budget) -> None:
    """Bound what an opened reader of rosbags expands chunks to.

    Raises:
        TooLargeError: the index of an MCAP tells of more than the file may hold.
    """
    if isinstance(reader, Ros1Reader):
        for position, chunk in reader.chunks.items():
            reader.chunks[position] = chunk._replace(decompressor=partial(_ros1_chunk, budget, chunk.decompressor))
    elif isinstance(reader.storage, storage_mcap.McapReader):
        budget.check(sum(chunk.uncompressed_size for chunk in reader.storage.chunks))


def _ros1_chunk(budget: Budget, original: Callable[[bytes], bytes], data: bytes) -> bytes:
    kind = next((name for name, function in ros1_decompressors.items() if function is original), "none")
    try:
        content = decompressed(kind, data, budget.limit)
    except OverflowError:
        budget.check(budget.limit + 1)
        raise
    budget.spend(len(content))
    return content


def check_sqlite(path: Path) -> None:
    """Refuse a database in which what rosbag2 has as tables is a query: it may never end.

    Raises:
        TooLargeError: it is.
    """
    with closing(sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)) as database:
        check_tables(database, path)


def check_tables(database: sqlite3.Connection, path: Path) -> None:
    """Check an opened database like `check_sqlite`."""
    database.text_factory = lambda raw: raw.decode(errors="replace")
    try:
        rows = database.execute("SELECT type, name, sql FROM sqlite_master LIMIT 1000").fetchall()
    except sqlite3.Error:
        return  # damaged: that is found when it is read
    for kind, name, sql in rows:
        text = " ".join(str(sql).upper().split())
        computed = kind == "table" and (" VIRTUAL " in text or "AS (" in text or "AS(" in text)
        if computed or kind in ("view", "trigger"):
            raise TooLargeError(f"{path}: its {kind} {name!r} is computed, as no recorder writes it; do not trust it")
