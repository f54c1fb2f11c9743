"""Parts that all converters share: download, a bag that appears whole, robot.yaml, reading of tables."""

from __future__ import annotations

import hashlib
import heapq
import os
import shutil
import tempfile
import urllib.error
import urllib.request
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO
from urllib.parse import urlsplit

import numpy as np
import yaml
from numpy.typing import ArrayLike

from fgloc.config import file_content, load_config
from fgloc.errors import RecordingError
from fgloc.files.outputs import write_text
from fgloc.instrumentation import counted
from fgloc.types import FloatArray, IntArray
from fgloc_datasets.bag import BagWriter

# --- Download ---------------------------------------------------------------------------------------------------------

_TIMEOUT_S = 60.0
_BLOCK = 1 << 20
_LIMIT = 4 << 30  # no set here is near 4 GiB: more is a mistake or an attack
_LOOPBACK = ("127.0.0.1", "::1", "localhost")


@dataclass(frozen=True, slots=True)
class Remote:
    """A file at its owner's. ``size`` [bytes] and ``sha256`` (hex) are checked where they are known."""

    url: str
    size: int | None = None
    sha256: str | None = None

    @property
    def name(self) -> str:
        """Last part of the address, the file's name."""
        return PurePosixPath(urlsplit(self.url).path).name


def fetch(remote: Remote, folder: Path) -> Path:
    """Download a file into a folder, unless a file of the right name and size is there already.

    The file appears under its name only when it is complete and checked.

    Raises:
        RecordingError: the address is not https (or ftp, or http on this machine), the server does not answer, or what
            came is not of the size or checksum that was expected.
    """
    _check_address(remote)
    target = folder / remote.name
    if target.is_file() and remote.size is not None and target.stat().st_size == remote.size:
        return target
    folder.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=folder, prefix=f".{remote.name}.", suffix=".part")
    part = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            _receive(remote, file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(target)
    except (urllib.error.URLError, OSError, EOFError) as error:
        reason = getattr(error, "reason", error)
        raise RecordingError(f"{remote.url}: {reason}; download it by hand into {folder} or try again") from error
    finally:
        part.unlink(missing_ok=True)
    return target


def unpack(archive: Path, folder: Path) -> Path:
    """Unpack a zip file into a folder, which appears whole.

    Raises:
        RecordingError: the archive is damaged, or a name in it leads out of the folder.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.exists():
        return folder
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".unpacking-") as scratch:
        made = Path(scratch) / "files"
        try:
            with zipfile.ZipFile(archive) as file:
                if sum(item.file_size for item in file.infolist()) > _LIMIT:
                    raise RecordingError(f"{archive}: unpacks to more than {_LIMIT} bytes; refused")
                for item in file.infolist():
                    _check_member(archive, item)
                file.extractall(made)
        except (zipfile.BadZipFile, EOFError) as error:
            raise RecordingError(f"{archive}: not a whole zip file ({error}); delete it and download again") from error
        made.mkdir(exist_ok=True)
        shutil.move(made, folder)
    return folder


def _check_address(remote: Remote) -> None:
    parts = urlsplit(remote.url)
    local = parts.scheme == "http" and parts.hostname in _LOOPBACK
    if not (parts.scheme in ("https", "ftp") or local) or not remote.name:
        raise RecordingError(f"{remote.url!r}: expected an https address (or ftp) that ends in a file name")


def _receive(remote: Remote, file: BinaryIO) -> None:
    digest = hashlib.sha256()
    received = 0
    with urllib.request.urlopen(remote.url, timeout=_TIMEOUT_S) as answer:
        length = answer.headers.get("Content-Length")
        promised = int(length) if length is not None and length.isdigit() else remote.size
        for block in counted(
            iter(lambda: answer.read(_BLOCK), b""), remote.name, promised and promised / _BLOCK, "MiB"
        ):
            received += len(block)
            if received > (remote.size or _LIMIT):
                raise RecordingError(f"{remote.url}: more than the expected {remote.size or _LIMIT} bytes; refused")
            digest.update(block)
            file.write(block)
    expected = remote.size if remote.size is not None else promised
    if expected is not None and received != expected:
        raise RecordingError(f"{remote.url}: {received} bytes came, expected {expected}; try again, or give --url")
    if remote.sha256 is not None and digest.hexdigest() != remote.sha256:
        raise RecordingError(f"{remote.url}: sha256 {digest.hexdigest()}, expected {remote.sha256}; not used")


def _check_member(archive: Path, item: zipfile.ZipInfo) -> None:
    path = PurePosixPath(item.filename.replace("\\", "/"))
    link = (item.external_attr >> 16) & 0o170000 == 0o120000
    if path.is_absolute() or ".." in path.parts or ":" in item.filename or link:
        raise RecordingError(f"{archive}: member {item.filename!r} leads out of the folder; refused")


# --- Conversion -------------------------------------------------------------------------------------------------------

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

    Args:
        path: of the file.
        settings: values in their sections, those of experts too.
        note: the comment.

    Raises:
        ConfigError: the settings are not a configuration.
    """
    header = "".join(f"# {line}\n" for line in note.splitlines())
    write_text(
        path, header + yaml.safe_dump(file_content(settings), sort_keys=False, default_flow_style=None, width=110)
    )
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
