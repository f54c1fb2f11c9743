"""Salvage of damaged storage files: whatever can still be read is copied into a sound file, to be opened as usual.

A recorder that was killed leaves a file without its index; a full disk or an aborted copy cuts one short; a bad disk
flips bits. The index is not needed to walk the records, and a damaged chunk is skipped if its frame is sound.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fgloc.recording.recover_mcap import recover_mcap
from fgloc.recording.recover_ros1 import recover_ros1
from fgloc.recording.recover_sqlite import recover_sqlite

_RECOVER = {"ros1": recover_ros1, "mcap": recover_mcap, "sqlite3": recover_sqlite}


@dataclass(frozen=True, slots=True)
class Recovered:
    """A sound file that holds what could be read of a damaged one."""

    path: Path
    messages: int
    lost: float  # share of the damaged file's bytes that could not be read, or are known to be missing


def recover(path: Path, kind: str, folder: Path) -> Recovered:
    """Copy what can be read of ``path`` into a new file in ``folder``.

    Args:
        path: the damaged file; it is not changed.
        kind: "ros1", "mcap" or "sqlite3".
        folder: where to put the copy: a bag for ROS 1, else an MCAP.

    Raises:
        OSError: the file cannot be read, or the copy cannot be written.
    """
    target = folder / f"{path.stem}.recovered{'.bag' if kind == 'ros1' else '.mcap'}"
    target.unlink(missing_ok=True)
    if path.stat().st_size == 0:
        return Recovered(target, 0, 1.0)
    messages, lost = _RECOVER[kind](path, target)
    return Recovered(target, messages, lost)
