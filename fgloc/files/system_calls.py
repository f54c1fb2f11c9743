"""What Python has no function for: two names exchanged at once, and a folder's names flushed to the disk."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress
from pathlib import Path


def exchange(a: Path, b: Path) -> bool:
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


def flush_folder(folder: Path) -> None:
    """Have the names in a folder on the disk, where the file system allows it."""
    if not folder.is_dir():
        return
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
