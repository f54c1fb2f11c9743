"""``metadata.yaml`` of a rosbag2 folder: which storage files belong to it. Hostile contents are refused."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import yaml

from fgloc.errors import RecordingError
from fgloc.files.documents import HostileError, parse, plain

_MAX_BYTES = 16 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class BagMetadata:
    """What of ``metadata.yaml`` is needed to find and to judge the storage files."""

    files: tuple[Path, ...]
    compressed: str  # by rosbag2 itself: "file", "message", or "" (also where the storage format compresses)
    message_count: int | None


def read_metadata(folder: Path) -> BagMetadata | None:
    """Read ``folder/metadata.yaml``; None if it is absent or is too damaged to be understood.

    Raises:
        RecordingError: the file is absurdly large or deep, has aliases that expand without bound, or names a path
            outside the folder.
    """
    path = folder / "metadata.yaml"
    try:
        if not path.is_file():
            return None
        if path.stat().st_size > _MAX_BYTES:
            raise RecordingError(f"{path}: {path.stat().st_size} bytes, expected less than {_MAX_BYTES}; {_REMEDY}")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None
    try:
        root = parse(text, str(path))
        content = {} if root is None else plain(root)
        information = content["rosbag2_bagfile_information"]
        names = [_inside(path, name) for name in information["relative_file_paths"]]
        count = information.get("message_count")
        mode = str(information.get("compression_mode")).lower()
        return BagMetadata(
            files=tuple(folder / name for name in dict.fromkeys(names)),
            compressed=mode if mode in ("file", "message") else "",
            message_count=count if isinstance(count, int) and count >= 0 else None,
        )
    except HostileError as error:
        raise RecordingError(f"{path}: {error}; {_REMEDY}") from error
    except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError):
        return None


_REMEDY = "do not trust this recording, or delete its metadata.yaml to have the storage files opened directly"


def _inside(path: Path, name: Any) -> str:
    """File name of a relative path; ros2 foxy put the bag's folder in front of it."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise ValueError(name)
    parts = PureWindowsPath(name).parts  # splits at / and at \
    if PurePosixPath(name).is_absolute() or PureWindowsPath(name).anchor or ".." in parts:
        raise RecordingError(f"{path}: relative_file_paths names {name!r}, expected a file in {path.parent}; {_REMEDY}")
    return parts[-1]
