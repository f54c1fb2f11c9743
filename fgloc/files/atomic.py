"""Files and folders that appear whole or not at all, also if the process is killed between any two system calls.

A file is written under a temporary name beside the old one, flushed and renamed over it. So is a folder of results: one
rename exchanges the two. Where that is not possible (``out`` is a mount point or the working folder, holds folders of
others, or the file system cannot exchange), the old files move out before the new ones move in, and the next write
completes or takes back what was interrupted: files of two results never lie side by side.

Temporary names are random, made with ``O_EXCL`` or ``mkdir`` (no symbolic link is followed), and locked while their
process lives: what is found unlocked was left by a killed one, and is removed.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import glob
import os
import secrets
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import IO, Any

from fgloc.errors import OutputError

_PARTIAL = ".partial-"
_OLD, _MOVED = ".old", ".moved"  # in a temporary folder: the old files; the same once all of them are in it
_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
_CANNOT_EXCHANGE = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EXDEV, errno.EBUSY, errno.EPERM, errno.EACCES}


@contextmanager
def atomic_file(path: Path, binary: bool = False) -> Iterator[IO[Any]]:
    """Open a file that replaces `path` when the block ends without an error, and leaves it alone otherwise.

    Raises:
        OutputError: the folder or the file cannot be written, or the disk is full.
    """
    with _named(path, "file"):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_left_files(path)
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.partial")
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_FOLLOW, 0o666)
        try:
            _lock(handle)
            # names of files that are no UTF-8 become escapes
            text: dict[str, Any] = {"encoding": "utf-8", "errors": "backslashreplace", "newline": ""}
            with os.fdopen(handle, "wb") if binary else os.fdopen(handle, "w", **text) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
                temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        _flush_folder(path.parent)


@contextmanager
def atomic_folder(out: Path, own: Sequence[str] = (), kept: Sequence[str] = ()) -> Iterator[Path]:
    """A temporary folder whose content becomes that of `out` when the block ends without an error.

    Args:
        out: the folder of a result; made if missing.
        own: patterns of all names that a result of this kind may have: an old file of such a name goes, also if the new
            result has none. Other files in `out` stay.
        kept: names of folders in `out` that stay.

    Raises:
        OutputError: it cannot be written; what was there before is as it was.
    """
    with _named(out, "result"):
        out = out.resolve()
        out.parent.mkdir(parents=True, exist_ok=True)
        _settle_left_folders(out)
        beside = _replaceable(out, own, kept)
        stage, handle = _new_folder(out.parent / f".{out.name}{_PARTIAL}" if beside else out / _PARTIAL)
        try:
            yield stage
            _flush_folder(stage)
            with _one_at_a_time(out.parent):
                own = (*own, *map(glob.escape, _names(stage)))
                if not (beside and _replaceable(out, own, kept) and _exchanged(stage, out, own)):
                    _move_in(stage, out, own)
                _flush_folder(out.parent)
        finally:
            shutil.rmtree(stage, ignore_errors=True)
            os.close(handle)


def check_out(out: Path, folder: bool = True) -> None:
    """Find out before a run whether its result can be written.

    Args:
        out: as given with ``--out``.
        folder: it is a folder; else a file.

    Raises:
        OutputError: it names something else, or the folder that is to hold it cannot be written.
    """
    with _named(out, "result" if folder else "file"):
        with suppress(FileNotFoundError, NotADirectoryError):
            out.lstat()  # refuses a NUL
        if out.exists() and out.is_dir() is not folder:
            raise OutputError(f"{out}: is {'a file' if folder else 'a folder'}; give another --out")
        place = out if folder else out.parent
        while not place.exists():
            place = place.parent
        if not place.is_dir():
            raise OutputError(f"{out}: {place} is a file, expected a folder; give another --out")
        probe, handle = _new_folder(place / _PARTIAL)
        os.close(handle)
        probe.rmdir()


@contextmanager
def _named(path: Path, what: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        kept = f"; the old {what} is kept" if os.path.lexists(path) else ""
        remedy = "make room on the disk" if error.errno == errno.ENOSPC else "give another place"
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}){kept}; {remedy}") from error
    except ValueError as error:
        if "\0" not in str(path):
            raise
        raise OutputError(f"{str(path)!r}: not a file name (it holds a NUL); give another") from error


def _lock(handle: int) -> bool:
    """Mark as in use until the handle is closed; False: another process uses it, or the file system has no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _new_folder(prefix: Path) -> tuple[Path, int]:
    """A new folder, with the rights of the user's umask, and the handle that locks it."""
    while True:
        path = prefix.with_name(prefix.name + secrets.token_hex(8))
        path.parent.mkdir(exist_ok=True)
        path.mkdir()
        with suppress(FileNotFoundError):  # another process may find and remove it before it is locked
            handle = os.open(path, os.O_RDONLY | _NO_FOLLOW)
            _lock(handle)
            if path.exists():
                return path, handle
            os.close(handle)


@contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Let other writers of results in this folder wait, where the file system has locks."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _remove_left_files(path: Path) -> None:
    for name in os.listdir(path.parent):
        if name.startswith(f".{path.name}.") and name.endswith(".partial"):
            left = path.with_name(name)
            with suppress(OSError), _left_by_killed(left) as dead:
                if dead:
                    left.unlink()


def _settle_left_folders(out: Path) -> None:
    """Remove what killed processes left in and beside `out`; complete or take back moves that they began."""
    left = [out.parent / n for n in os.listdir(out.parent) if n.startswith(f".{out.name}{_PARTIAL}")]
    left += [out / n for n in os.listdir(out) if n.startswith(_PARTIAL)] if out.is_dir() else []
    for stage in left:
        with suppress(OSError), _left_by_killed(stage) as dead:
            if dead:
                if (stage / _MOVED).is_dir():
                    _move(stage, out, _names(stage))
                elif (stage / _OLD).is_dir():
                    _move(stage / _OLD, out, _names(stage / _OLD))
                shutil.rmtree(stage)


@contextmanager
def _left_by_killed(path: Path) -> Iterator[bool]:
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | _NO_FOLLOW)
    try:
        yield _lock(handle)
    finally:
        os.close(handle)


def _replaceable(out: Path, own: Sequence[str], kept: Sequence[str]) -> bool:
    """Whether `out` as a whole may be exchanged for another folder."""
    if not os.access(out.parent, os.W_OK) or out == Path.cwd() or os.path.ismount(out):
        return False
    if not out.is_dir():
        return not out.exists()
    with os.scandir(out) as entries:
        return all(
            entry.is_file(follow_symlinks=False) or entry.is_symlink() or entry.name in kept or _fits(entry.name, own)
            for entry in entries
        )


def _exchanged(stage: Path, out: Path, own: Sequence[str]) -> bool:
    """Put `stage` in the place of `out` by one rename, with all that stays; False: this file system cannot."""
    try:
        if not out.exists() or not os.listdir(out):
            stage.rename(out)
            return True
        shutil.copymode(out, stage)
        for name in _names(out):
            if not _fits(name, own):
                _link(out / name, stage / name)
        sys.audit("fgloc.exchange", str(stage), str(out))
        return _exchange(stage, out)
    except OSError as error:
        if error.errno not in _CANNOT_EXCHANGE:
            raise
    return False


def _link(source: Path, target: Path) -> None:
    """Link a file, or a folder of the same files, under another name."""
    if source.is_symlink() or not source.is_dir():
        os.link(source, target, follow_symlinks=False)
        return
    target.mkdir()
    for name in _names(source):
        _link(source / name, target / name)


def _move_in(stage: Path, out: Path, own: Sequence[str]) -> None:
    """Move the old files out of `out`, then the new ones in; an error takes all back."""
    out.mkdir(exist_ok=True)
    old = [name for name in _names(out) if _fits(name, own)]
    new = [name for name in _names(stage) if _fits(name, own)]  # what stays may have been linked there too
    (stage / _OLD).mkdir()
    moved: list[str] = []
    try:
        _move(out, stage / _OLD, old)
        (stage / _OLD).rename(stage / _MOVED)
        for name in new:
            (stage / name).replace(out / name)
            moved.append(name)
    except OSError:
        _move(out, stage, moved)
        for place in (stage / _OLD, stage / _MOVED):
            _move(place, out, _names(place))
        raise


def _move(source: Path, target: Path, names: Sequence[str]) -> None:
    for name in names:
        (source / name).replace(target / name)


def _names(folder: Path) -> list[str]:
    """Names in a folder, without temporary folders; none if there is no folder."""
    try:
        return sorted(n for n in os.listdir(folder) if n not in (_OLD, _MOVED) and not n.startswith(_PARTIAL))
    except (FileNotFoundError, NotADirectoryError):
        return []


def _fits(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(name, pattern) for pattern in patterns)


# --- System calls that Python has no function for ---------------------------------------------------------------------


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two names by one system call: renameat2 with RENAME_EXCHANGE, on macOS renamex_np with RENAME_SWAP."""
    libc = ctypes.CDLL(None, use_errno=True)
    ends = os.fsencode(a), os.fsencode(b)
    if hasattr(libc, "renameat2"):
        here = ctypes.c_int(-100)  # AT_FDCWD
        failed = libc.renameat2(here, ctypes.c_char_p(ends[0]), here, ctypes.c_char_p(ends[1]), ctypes.c_uint(2))
    elif hasattr(libc, "renamex_np"):
        failed = libc.renamex_np(ctypes.c_char_p(ends[0]), ctypes.c_char_p(ends[1]), ctypes.c_uint(2))
    else:
        return False
    if failed:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return True


def _flush_folder(folder: Path) -> None:
    """Have the names in a folder on the disk, where the file system allows it."""
    if not folder.is_dir():
        return
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
