"""Which files a recording consists of."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from fgloc.errors import RecordingError
from fgloc.recording.metadata import BagMetadata, read_metadata

_KINDS = {".bag": "ros1", ".active": "ros1", ".mcap": "mcap", ".db3": "sqlite3"}
_MOST_NAMED = 5
EXPECTED = "expected a ROS 1 .bag, a rosbag2 folder, an .mcap or a .db3"


def find_beside(bag: Path, name: str) -> Path | None:
    """A file of this name beside the bag: in its folder, or in the folder that holds it."""
    folders = (bag, bag.parent) if bag.is_dir() else (bag.parent, bag.parent.parent)
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def find_files(path: Path, notes: list[str]) -> tuple[BagMetadata | None, tuple[Path, ...]]:
    """Storage files of a recording, in order, and its metadata where used.

    Raises:
        RecordingError: there are none, or it is not clear which.
    """
    if not path.exists():
        raise RecordingError(f"{path}: does not exist; {EXPECTED}")
    if not path.is_dir():
        kind_of(path)
        if not path.is_file():
            raise RecordingError(f"{path}: not a regular file; {EXPECTED}")
        return None, (path,)
    metadata = read_metadata(path)
    if metadata is not None:
        present = tuple(file for file in metadata.files if file.is_file())
        if present:
            missing = [file.name for file in metadata.files if file not in present]
            if missing:
                notes.append(f"Named by metadata.yaml but missing: {', '.join(missing)}.")
            return metadata, present
    groups: dict[str, list[Path]] = defaultdict(list)
    for file in sorted(path.iterdir(), key=_natural):
        if file.is_file() and file.suffix in (".mcap", ".db3"):
            groups[file.suffix].append(file)
    if not groups:
        inside = _recordings_in(path)
        hint = f"give one of the recordings in it: {', '.join(inside)}" if inside else EXPECTED
        raise RecordingError(f"{path}: a folder without .mcap or .db3; {hint}")
    if len(groups) > 1:
        names = ", ".join(file.name for files in groups.values() for file in files)
        raise RecordingError(f"{path}: no usable metadata.yaml and several storage kinds ({names}); give one file")
    files = next(iter(groups.values()))
    state = "damaged" if (path / "metadata.yaml").exists() else "missing"
    notes.append(f"metadata.yaml is {state}: {', '.join(file.name for file in files)} opened directly.")
    return None, tuple(files)


def _recordings_in(folder: Path) -> list[str]:
    """Names of ROS 1 bags and rosbag2 folders in a folder, the first ones."""
    found = [*folder.glob("*.bag"), *(file.parent for file in folder.glob("*/metadata.yaml"))]
    return sorted({str(path) for path in found})[:_MOST_NAMED]


def kind_of(path: Path) -> str:
    """Kind ("ros1", "mcap" or "sqlite3"), by the suffix.

    Raises:
        RecordingError: it is none of theirs.
    """
    suffix = path.suffix if path.suffix != ".zstd" else path.with_suffix("").suffix
    if suffix not in _KINDS:
        raise RecordingError(f"{path}: unknown kind {suffix!r}; {EXPECTED}")
    return _KINDS[suffix]


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key: run_2 before run_10."""
    parts = "".join(c if c.isdigit() else f" {c} " for c in path.name).split()
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
