"""The files of a recording: found, opened with rosbags behind one interface for all kinds, salvaged where damaged."""

from __future__ import annotations

import filecmp
import heapq
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path, PurePosixPath, PureWindowsPath
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from rosbags.interfaces import MessageDefinition
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader

from fgloc.errors import RecordingError
from fgloc.files.documents import HostileError, parse, plain
from fgloc.files.outputs import is_result
from fgloc.recording.limits import (
    REWINDS,
    Budget,
    TooLargeError,
    bound_reader,
    check_sqlite,
    decompress_file,
    decompressed,
    opening,
)
from fgloc.recording.recover import Recovered, recover, sqlite_journals
from fgloc.types import Grave, LostData

# --- metadata.yaml of a rosbag2 folder; hostile contents are refused --------------------------------------------------

_MAX_BYTES = 16 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class BagMetadata:
    """Content of ``metadata.yaml`` that finds and judges the storage files."""

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


# --- Which files belong to a recording --------------------------------------------------------------------------------

_KINDS = {".bag": "ros1", ".active": "ros1", ".mcap": "mcap", ".db3": "sqlite3"}
_MAGIC = {
    b"#ROSBAG V2.0": (".bag", "a ROS 1 bag"),
    b"\x89MCAP0\r\n": (".mcap", "an MCAP"),
    b"SQLite format 3\0": (".db3", "an SQLite database"),
}
_NAMES = {_KINDS[suffix]: name for suffix, name in _MAGIC.values()}
_MOST_NAMED = 5
_LITTLE = 0.01  # share of a recording whose loss is worth no warning
EXPECTED = "expected a ROS 1 .bag, a rosbag2 folder, an .mcap or a .db3"


def lost(text: str, share: float) -> str:
    """The note that a share of a recording cannot be read, grave if it is more than a little."""
    return LostData(text, min(share, 1.0)) if share > _LITTLE else text


def find_beside(bag: Path, name: str) -> Path | None:
    """A file of this name beside the bag: in its folder, or in the folder that holds it.

    A file that a run wrote there with its result is passed over: what a run finds is the input of another one only
    where a user says so, by giving it or by copying it out of the result.
    """
    return next((file for file in _beside(bag, name) if not is_result(file)), None)


def passed_over(bag: Path, name: str) -> Path | None:
    """The file that `find_beside` would return if no run had written it."""
    first = next(_beside(bag, name), None)
    return first if first is not None and is_result(first) else None


def _beside(bag: Path, name: str) -> Iterator[Path]:
    folders = (bag, bag.parent) if bag.is_dir() else (bag.parent, bag.parent.parent)
    return (folder / name for folder in folders if (folder / name).is_file())


def beside(bag: Path, name: str) -> Path:
    """Place of such a file where there is none: in the folder that holds the bag, or the storage file."""
    return (bag if bag.name not in ("", "..") else bag.resolve()).parent / name


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
        return _metadata_of(path), (path,)
    metadata = read_metadata(path)
    if metadata is not None:
        present = tuple(file for file in metadata.files if file.is_file())
        if present:
            missing = [file.name for file in metadata.files if file not in present]
            if missing:
                notes.append(Grave(f"Named by metadata.yaml but missing: {', '.join(missing)}."))
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
    opened = f"{', '.join(file.name for file in files)} opened directly."
    damaged = (path / "metadata.yaml").exists()
    notes.append(Grave(f"metadata.yaml is damaged: {opened}") if damaged else f"metadata.yaml is missing: {opened}")
    return None, tuple(files)


def refuse_repeats(bags: Sequence[Path], names: Sequence[str] = ()) -> None:
    """Refuse recordings of which two are the same, by another path or as a copy.

    What is no recording is passed over: reading it says why.

    Args:
        bags: recordings.
        names: what the user calls each; empty: by its path.

    Raises:
        RecordingError: the storage files of two are the same, or hold the same bytes.
    """
    labels = [f"{name} ({bag})" for name, bag in zip(names, bags, strict=True)] if names else [str(bag) for bag in bags]
    found: list[tuple[str, tuple[Path, ...]]] = []
    for label, bag in zip(labels, bags, strict=True):
        with suppress(RecordingError):
            found.append((label, find_files(bag, [])[1]))
    for (first, its), (second, others) in combinations(found, 2):
        if len(its) == len(others) and all(map(_same, its, others)):
            raise RecordingError(f"{first} and {second} are the same recording; give each recording once")


def _same(file: Path, other: Path) -> bool:
    """Whether two files are one, or have the same content; that of files of different sizes is not read."""
    return file.samefile(other) or filecmp.cmp(file, other, shallow=False)


def _metadata_of(file: Path) -> BagMetadata | None:
    """Content of the ``metadata.yaml`` beside a storage file, if it is of this file alone."""
    try:
        metadata = read_metadata(file.parent)
    except RecordingError:  # the file is sound whatever lies beside it
        return None
    return metadata if metadata is not None and [f.name for f in metadata.files] == [file.name] else None


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
        raise RecordingError(f"{path}: unknown kind {suffix!r}; {_other_name(path) or _CONVERTED}")
    return _KINDS[suffix]


_CONVERTED = f"{EXPECTED} (fgloc convert reads some public data sets)"


def _other_name(path: Path) -> str:
    """Advice where the content is of another kind than the name says; "" where it is of none that is known."""
    if not path.is_file():  # to open a pipe waits for its other end
        return ""
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError:
        return ""
    for magic, (suffix, what) in _MAGIC.items():
        if head.startswith(magic) and _KINDS.get(path.suffix) != _KINDS[suffix]:
            return f"its content is {what}: rename it to {path.with_suffix(suffix).name}"
    return "" if head else "it is empty: the recorder wrote nothing, or its copy failed"


def _has_magic(path: Path, kind: str) -> bool:
    """Whether a file begins as those of its kind do; one that cannot be opened may."""
    magic = next(magic for magic, (suffix, _) in _MAGIC.items() if _KINDS[suffix] == kind)
    try:
        with path.open("rb") as file:
            return file.read(len(magic)) == magic
    except OSError:
        return True


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key: run_2 before run_10."""
    parts = "".join(c if c.isdigit() else f" {c} " for c in path.name).split()
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


# --- Reading ----------------------------------------------------------------------------------------------------------

RawMessage = tuple[str, str, int, bytes]  # topic, message type (pkg/msg/Name), received_ns, serialized message


@dataclass(frozen=True, slots=True)
class Channel:
    """Messages of one type on one topic."""

    topic: str
    message_type: str
    count: int
    definition: MessageDefinition


class Storage:
    """Opened storage files of one recording.

    Attributes:
        kind: "ros1", "sqlite3" or "mcap".
        files: the storage files.
        notes: what went wrong and was got round; grows while messages are read.
    """

    def __init__(self, path: Path) -> None:
        """Open.

        Raises:
            RecordingError: nothing can be read, or the recording is hostile; names the file and the reason.
        """
        self.notes: list[str] = []
        self._scratch: TemporaryDirectory[str] | None = None
        metadata, self.files = find_files(path, self.notes)
        self.kind = kind_of(self.files[0])
        self._files: list[_File] = []
        try:
            self._open_files(metadata is not None and metadata.compressed == "message")
            if metadata is not None and metadata.message_count is not None:
                self._compare_count(metadata.message_count)
        except BaseException:
            self.close()
            raise

    def _open_files(self, compressed_messages: bool) -> None:
        failures = []
        for file in self.files:
            try:
                plain = self._decompressed(file) if file.suffix == ".zstd" else file
                self._files.append(_File(plain, self._folder, self.notes, compressed_messages))
            except TooLargeError:
                raise
            except RecordingError as error:
                failures.append(str(error))
        if not self._files:
            raise RecordingError("\n".join(failures))
        self.notes.extend(map(Grave, failures))

    def _decompressed(self, file: Path) -> Path:
        """A copy of a file that the recorder compressed as a whole; of a damaged one, as far as it goes."""
        target = self._folder() / file.stem
        try:
            decompress_file(file, target)
        except (OSError, EOFError) as error:
            self.notes.append(Grave(f"{file.name} is damaged ({_reason(error)}): what comes before is used."))
        return target

    def _compare_count(self, expected: int) -> None:
        found = sum(channel.count for channel in self.channels)
        if found < expected:
            share = 1.0 - found / expected
            text = f"metadata.yaml counts {expected} messages, the files hold {found}: {share:.1%} lost."
            self.notes.append(lost(text, share))

    def close(self) -> None:
        """Close all files and delete scratch copies."""
        for file in self._files:
            file.close()
        if self._scratch is not None:
            self._scratch.cleanup()
            self._scratch = None

    def _folder(self) -> Path:
        if self._scratch is None:
            self._scratch = TemporaryDirectory(prefix="fgloc-")
        return Path(self._scratch.name)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Topics and types; one entry for each pair."""
        merged: dict[tuple[str, str], Channel] = {}
        for file in self._files:
            for c in file.reader.connections:
                known = merged.get((c.topic, c.msgtype))
                count = c.msgcount + (known.count if known else 0)
                definition = known.definition if known and known.definition.data else c.msgdef
                merged[c.topic, c.msgtype] = Channel(c.topic, c.msgtype, count, definition)
        return tuple(merged.values())

    @property
    def span_ns(self) -> tuple[int, int]:
        """Receive time of the first and of the last message; (0, 0) if there is none."""
        spans = [(f.reader.start_time, f.reader.end_time - 1) for f in self._files if f.reader.message_count]
        return (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else (0, 0)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages of the given topics (None: of all) in order of receive time.

        Raises:
            RecordingError: the storage is damaged and nothing could be read before.
        """
        streams = [file.messages(topics) for file in self._files]
        return streams[0] if len(streams) == 1 else heapq.merge(*streams, key=lambda message: message[2])

    @property
    def size_bytes(self) -> int:
        """Size of the storage files."""
        return sum(file.stat().st_size for file in self.files)


class _File:
    """One storage file, replaced by a salvaged copy once it proves damaged."""

    def __init__(self, path: Path, folder: Callable[[], Path], notes: list[str], compressed_messages: bool) -> None:
        self._path, self._kind, self._folder, self._notes = path, kind_of(path), folder, notes
        self._compressed_messages = compressed_messages
        self._recovered = False
        self._budget = Budget(path)
        self.reader: Any = None
        try:
            if self._kind == "sqlite3" and (journals := sqlite_journals(path)):
                raise RecordingError(f"the recorder was killed, {journals[0].name} is left")
            self.reader = _open(path, self._kind, self._budget)
        except Exception as error:  # rosbags leaks apsw, struct, decoding and assertion errors
            self._recover(error)

    def close(self) -> None:
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.close()

    def messages(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        last_ns = -1
        at_last: list[tuple[str, bytes]] = []  # what was delivered last, to go on from there in a salvaged copy
        resume = (last_ns, at_last)
        self._budget.start_pass(REWINDS)
        while True:
            reader = self.reader
            wanted = [c for c in reader.connections if topics is None or c.topic in topics]
            if not wanted:
                return
            try:
                for connection, received_ns, raw in reader.messages(wanted):
                    if not 0 <= received_ns < 2**63:
                        raise RecordingError(f"receive time {received_ns} ns of a message on {connection.topic}")
                    if received_ns < resume[0] or (received_ns == resume[0] and (connection.topic, raw) in resume[1]):
                        continue
                    if received_ns != last_ns:
                        last_ns, at_last = received_ns, []
                    at_last.append((connection.topic, raw))
                    self._budget.spend(len(raw))
                    yield connection.topic, connection.msgtype, received_ns, self._plain(raw)
                return
            except Exception as error:
                if self.reader is reader:  # else another iterator has already replaced it
                    try:
                        self._recover(error)
                    except RecordingError as final:
                        if last_ns < 0:
                            raise
                        self._note(f"{final} What was read before is kept.")
                        return
                resume = (last_ns, at_last)

    def _plain(self, raw: bytes) -> bytes:
        """A message as it was before the recorder compressed it; one that is damaged stays, and is not decodable."""
        if not self._compressed_messages:
            return raw
        try:
            plain = decompressed("zstd", raw, self._budget.limit)
        except OverflowError:
            self._budget.check(self._budget.limit + 1)
            raise
        except Exception:  # damaged bytes
            return raw
        self._budget.spend(len(plain))
        return plain

    def _recover(self, error: Exception) -> None:
        if isinstance(error, TooLargeError):
            raise error
        reason = _reason(error) if _has_magic(self._path, self._kind) else f"it is not {_NAMES[self._kind]}"
        if not self._recovered and (other := _other_name(self._path)):
            raise RecordingError(f"{self._path}: cannot be read; {other}.") from error
        if self._recovered or isinstance(error, (PermissionError, FileNotFoundError)):
            raise RecordingError(f"{self._path}: cannot be read: {reason}.") from error
        try:
            recovered = recover(self._path, self._kind, self._folder())
            again = Budget(recovered.path) if recovered.messages else None
            reader = _open(recovered.path, kind_of(recovered.path), again) if again is not None else None
        except TooLargeError:
            raise
        except Exception as second:  # damaged bytes make the parser raise anything
            raise RecordingError(f"{self._path}: cannot be read: {reason}; nor salvaged: {_reason(second)}.") from error
        if reader is None:
            raise RecordingError(
                f"{self._path}: cannot be read: {reason}; {EXPECTED}, and no message could be salvaged."
            ) from error
        stated = 0 if self.reader is None else self.reader.message_count
        self._recovered = True
        self.close()
        self.reader = reader
        self._note(_salvaged(f"{self._path.name} is damaged ({reason})", recovered, stated))

    def _note(self, text: str) -> None:
        if text not in self._notes:
            self._notes.append(text)


def _salvaged(damage: str, recovered: Recovered, stated: int) -> Grave:
    """Note on a salvaged file: the share that is lost, by the ``stated`` messages of its index, else by its bytes."""
    share, told = recovered.lost, f"salvaged {recovered.messages} messages"
    if stated > recovered.messages:
        share = 1.0 - recovered.messages / stated
        told = f"salvaged {recovered.messages} of {stated} messages, {share:.1%} are lost"
    elif share >= 0.0005:
        told += f", {share:.1%} of its bytes are lost"
    if recovered.cut:
        told += "; it ends before its index: if it was cut off, what came after is missing too"
    return LostData(f"{damage}: {told}.", share) if share > _LITTLE else Grave(f"{damage}: {told}.")


def _open(path: Path, kind: str, budget: Budget) -> Any:
    if kind == "sqlite3":
        check_sqlite(path)
    reader = Ros1Reader(path) if kind == "ros1" else Ros2Reader(path)
    budget.start_pass()
    with opening(budget):
        reader.open()
        return _checked(reader, kind, budget)


def _checked(reader: Any, kind: str, budget: Budget) -> Any:
    try:
        bound_reader(reader, budget)
        if kind == "mcap" and not reader.storage.chunks:
            budget.start_pass()
            for _ in reader.messages():  # without an index rosbags finds disorder only when it meets it
                pass
        if not all(isinstance(c.topic, str) and isinstance(c.msgtype, str) for c in reader.connections):
            raise RecordingError("topic names are damaged")
    except BaseException:
        reader.close()
        raise
    return reader


def _reason(error: Exception) -> str:
    if isinstance(error, UnicodeDecodeError):
        return "its texts are damaged"
    return str(error).strip().rstrip(".") or type(error).__name__
