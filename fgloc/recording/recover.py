"""Salvage of damaged storage files: whatever can still be read is copied into a sound file, to be opened as usual.

A recorder that was killed leaves a file without its index; a full disk or an aborted copy cuts one short; a bad disk
flips bits. The index is not needed to walk the records, and a damaged chunk is skipped if its frame is sound.
"""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer

from fgloc.recording.limits import Budget, check_tables, decompressed

# --- Extent of a damaged file ---------------------------------------------------------------------------------------

_MOST_CUT = 200  # a file of which less than this part is left says nothing of what it was


@dataclass(frozen=True, slots=True)
class Recovered:
    """A sound file that holds what could be read of a damaged one."""

    path: Path
    messages: int
    lost: float  # share of the damaged file that could not be read, or is known to be missing
    cut: bool = False  # it ends before its index: how much is missing beyond what `lost` knows is unknown


@dataclass(slots=True)
class _Walk:
    """Extent of a damaged file, as a pass over its records finds it.

    Attributes:
        path: the file.
        sound: bytes that could be read.
        extent: bytes that it has, or says it had.
        cut: whether it ends before its index.
    """

    path: Path
    sound: int = 0
    extent: int = 0
    cut: bool = True

    @property
    def size(self) -> int:
        """Bytes of the file as it is."""
        return self.path.stat().st_size

    @property
    def lost(self) -> float:
        """Share of the extent that could not be read."""
        return max(0.0, 1.0 - self.sound / max(self.size, self.extent))

    def extends_to(self, end: int) -> None:
        """Take what the file says of its length, unless that is absurd: the number itself is damaged."""
        if end <= _MOST_CUT * self.size:
            self.extent = max(self.extent, end)


# --- MCAP -------------------------------------------------------------------------------------------------------------

_MAX_NS = 2**63 - 1


class McapSink:
    """A new MCAP file that takes messages of any channel."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._writer = McapWriter(self._file, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library="fgloc")
        self.messages = 0

    def channel(self, topic: str, message_type: str, encoding: str, definition: bytes, serialization: str) -> int:
        """Add a channel; returns its id."""
        text = definition.decode(errors="replace").encode()  # damaged text must not stop the reader
        schema_id = self._writer.register_schema(message_type, encoding, text)
        return int(self._writer.register_channel(topic, serialization, schema_id))

    def write(self, channel_id: int, received_ns: int, data: bytes) -> None:
        """Add a message, unless its time is impossible."""
        if 0 <= received_ns <= _MAX_NS:
            self._writer.add_message(channel_id, received_ns, data, received_ns)
            self.messages += 1

    def close(self) -> None:
        """Write the index."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()


def recover_mcap(path: Path, target: Path) -> Recovered:
    """Copy what can be read of an MCAP.

    Raises:
        TooLargeError: its chunks expand to more than its size allows.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in _mcap_records(
        path, _Walk(path)
    ):  # first for the channels: those of a damaged chunk are repeated at the end
        if isinstance(record, Schema):
            schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            channels.setdefault(record.id, record)
    walked = _Walk(path)
    with closing(McapSink(target)) as sink:
        ids: dict[int, int] = {}
        for record in _mcap_records(path, walked):
            if not isinstance(record, Message) or record.channel_id not in channels:
                continue
            if record.channel_id not in ids:
                channel = channels[record.channel_id]
                schema = schemas.get(channel.schema_id) or Schema(data=b"", encoding="", id=0, name="")
                ids[record.channel_id] = sink.channel(
                    channel.topic, schema.name, schema.encoding, schema.data, channel.message_encoding
                )
            sink.write(ids[record.channel_id], record.log_time, record.data)
    return Recovered(target, sink.messages, walked.lost, walked.cut)


def _mcap_records(path: Path, walk: _Walk) -> Iterator[McapRecord | None]:
    """Readable records; ``walk`` learns the file's extent."""
    size, budget = path.stat().st_size, Budget(path)
    budget.start_pass()
    with path.open("rb") as file:
        walk.sound = len(file.read(8))  # magic
        while len(frame := file.read(9)) == 9:
            opcode, length = struct.unpack("<BQ", frame)
            payload = file.read(min(length, size - file.tell()))
            complete = len(payload) == length
            if opcode == Opcode.CHUNK:
                records, sound = _chunk_records(payload, complete, budget)
            elif complete:
                records = [_mcap_record(opcode, payload)]
                sound = True
            else:
                records, sound = [], False
            walk.cut = walk.cut and not (complete and opcode == Opcode.DATA_END)
            walk.sound += 9 + len(payload) if sound else 0
            yield from records
            if not complete:
                walk.extends_to(file.tell() - len(payload) + length)
                break
        else:
            walk.sound += len(frame) if len(frame) == 8 else 0  # the magic at the end


def _chunk_records(payload: bytes, complete: bool, budget: Budget) -> tuple[list[McapRecord | None], bool]:
    """Records of a chunk, and whether it was sound; the leading ones of a chunk that was cut short."""
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(payload)))
    except Exception:  # damaged bytes make the parser raise anything
        return [], False
    if chunk.compression:
        budget.check(chunk.uncompressed_size)
        budget.spend(chunk.uncompressed_size)
    try:
        data = decompressed(chunk.compression, chunk.data, chunk.uncompressed_size, cut=not complete)
        if complete:
            plain = replace(chunk, compression="", data=data)
            return list(breakup_chunk(plain, validate_crc=True)), True
    except Exception:  # damaged bytes make the parser raise anything
        return [], False
    records: list[McapRecord | None] = []
    stream = BytesIO(data)
    while len(frame := stream.read(9)) == 9:
        opcode, length = struct.unpack("<BQ", frame)
        inner = stream.read(min(length, len(data)))
        if len(inner) < length:
            break
        records.append(_mcap_record(opcode, inner))
    return records, True


def _mcap_record(opcode: int, payload: bytes) -> McapRecord | None:
    """A schema, channel or message; None for anything else, or if it is damaged."""
    stream = ReadDataStream(BytesIO(payload))
    record: McapRecord | None = None
    try:
        if opcode == Opcode.SCHEMA:
            record = Schema.read(stream)
        elif opcode == Opcode.CHANNEL:
            record = Channel.read(stream)
        elif opcode == Opcode.MESSAGE:
            record = Message.read(stream, len(payload))
    except Exception:  # damaged bytes make the parser raise anything
        return None
    return record


# --- rosbag2's SQLite -------------------------------------------------------------------------------------------------


def sqlite_journals(path: Path) -> list[Path]:
    """Journals that a killed recorder left beside a database: they hold, or undo, its last messages."""
    candidates = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
    return [file for file in candidates if file.is_file() and file.stat().st_size > 0]


def recover_sqlite(path: Path, target: Path) -> Recovered:
    """Copy the readable rows into an MCAP.

    Raises:
        TooLargeError: a table is a query.
    """
    walk = _Walk(path)
    walk.sound, walk.cut = walk.size, False  # the pages that are there may be damaged: rows tell
    with path.open("rb") as file:
        header = file.read(100)
    if len(header) == 100:
        page, pages = struct.unpack(">H", header[16:18])[0], struct.unpack(">I", header[28:32])[0]
        walk.extends_to((65536 if page == 1 else page) * pages)
    source, options = path, "mode=ro&immutable=1"
    if journals := sqlite_journals(path):
        source, options = target.parent / path.name, "mode=rw"
        for original in (path, *journals):
            shutil.copyfile(original, target.parent / original.name)
    skipped = 0
    with closing(McapSink(target)) as sink:
        try:
            with closing(sqlite3.connect(f"file:{quote(str(source.absolute()))}?{options}", uri=True)) as database:
                check_tables(database, path)
                skipped = _copy_rows(database, sink, Budget(path))
        except sqlite3.Error:
            pass  # damaged beyond the rows already copied
    of_rows = skipped / max(skipped + sink.messages, 1)
    return Recovered(target, sink.messages, max(walk.lost, of_rows), walk.cut)


def _copy_rows(database: sqlite3.Connection, sink: McapSink, budget: Budget) -> int:
    """Copy the rows that can be read; returns how many between them cannot."""
    budget.start_pass()
    database.execute("PRAGMA writable_schema=ON")  # or SQLite refuses a file that is shorter than its header says
    database.text_factory = lambda raw: raw.decode(errors="replace")
    definitions: dict[str, tuple[str, str]] = {}
    try:
        rows = database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT 10000"
        )
        definitions = {str(name): (str(encoding), str(text)) for name, encoding, text in rows}
    except sqlite3.Error:
        pass  # older bags have none
    ids: dict[int, int] = {}
    for topic_id, name, kind, serialization in database.execute(
        "SELECT id, name, type, serialization_format FROM topics LIMIT 10000"
    ):
        encoding, text = definitions.get(str(kind), ("", ""))
        ids[topic_id] = sink.channel(str(name), str(kind), encoding, text.encode(), str(serialization))
    last, step, skipped = 0, 1, 0
    while step < 2**40:  # past a damaged page the next sound row is looked for further and further away
        try:
            rows = database.execute(
                "SELECT id, topic_id, timestamp, data FROM messages WHERE id >= ? ORDER BY id", (last + step,)
            )
            for row_id, topic_id, received_ns, data in rows:
                if row_id <= last:
                    return skipped  # a damaged tree that leads in circles
                skipped += row_id - last - 1 if step > 1 else 0
                last, step = row_id, 1
                if topic_id in ids and isinstance(received_ns, int) and isinstance(data, bytes):
                    budget.spend(len(data))
                    sink.write(ids[topic_id], received_ns, data)
            return skipped
        except sqlite3.DatabaseError:
            step *= 2
    return skipped


# --- ROS 1 bags -------------------------------------------------------------------------------------------------------


def recover_ros1(path: Path, target: Path) -> Recovered:
    """Copy what can be read of a ROS 1 bag.

    Raises:
        TooLargeError: its chunks expand to more than its size allows.
    """
    budget = Budget(path)
    budget.start_pass()
    walk = _Walk(path)
    messages = 0
    connections: dict[int, Connection] = {}
    known: dict[tuple[str, str], Connection] = {}
    with Writer(target) as writer, path.open("rb") as file:
        walk.sound += len(file.readline(64))  # magic
        for header, data, sound in _ros1_records(file, walk.size):
            if header.get("op") == b"\x03" and len(header.get("index_pos", b"")) == 8:
                index_at = struct.unpack("<Q", header["index_pos"])[0]
                walk.extends_to(index_at)
                walk.cut = not 0 < index_at <= walk.size
            if header.get("op") == b"\x05":
                inner, sound = _ros1_chunk(header, data, sound, budget)
            else:
                inner = [(header, data)] if sound else []
            walk.sound += 8 + sum(5 + len(k) + len(v) for k, v in header.items()) + len(data) if sound else 0
            for record, content in inner:
                try:
                    if record["op"] == b"\x07":
                        number = struct.unpack("<L", record["conn"])[0]
                        if number not in connections:
                            connections[number] = _ros1_connection(writer, record, content, known)
                    elif record["op"] == b"\x02":
                        number = struct.unpack("<L", record["conn"])[0]
                        sec, nsec = struct.unpack("<LL", record["time"])
                        writer.write(connections[number], sec * 10**9 + nsec, content)
                        messages += 1
                except (KeyError, struct.error, UnicodeDecodeError):
                    continue  # a damaged record, or one of a connection that was lost
    return Recovered(target, messages, walk.lost, walk.cut)


def _ros1_connection(
    writer: Writer, record: dict[str, bytes], content: bytes, known: dict[tuple[str, str], Connection]
) -> Connection:
    topic, fields = record["topic"].decode(), _ros1_fields(content)
    kind = fields["type"].decode().replace("/", "/msg/", 1)
    if (topic, kind) not in known:
        known[topic, kind] = writer.add_connection(
            topic, kind, msgdef=fields["message_definition"].decode(), md5sum=fields["md5sum"].decode()
        )
    return known[topic, kind]


def _ros1_records(file: BinaryIO, size: int) -> Iterator[tuple[dict[str, bytes], bytes, bool]]:
    """Header fields, data, and whether the data is complete."""
    while len(raw := file.read(4)) == 4:
        length = struct.unpack("<L", raw)[0]
        header = file.read(min(length, size))
        raw = file.read(4)
        if len(header) < length or len(raw) < 4:
            return
        length = struct.unpack("<L", raw)[0]
        data = file.read(min(length, size))
        try:
            fields = _ros1_fields(header)
        except (ValueError, struct.error):
            fields = {}
        yield fields, data, len(data) == length and bool(fields)


def _ros1_fields(header: bytes) -> dict[str, bytes]:
    fields, position = {}, 0
    while position < len(header):
        length = struct.unpack_from("<L", header, position)[0]
        name, _, value = header[position + 4 : position + 4 + length].partition(b"=")
        fields[name.decode()] = value
        position += 4 + length
    return fields


def _ros1_chunk(
    header: dict[str, bytes], data: bytes, complete: bool, budget: Budget
) -> tuple[list[tuple[dict[str, bytes], bytes]], bool]:
    compression = header.get("compression", b"").decode(errors="replace")
    if compression != "none":
        if not complete or compression not in ("bz2", "lz4"):
            return [], False
        try:
            data = decompressed(compression, data, budget.limit)
        except Exception:  # damaged bytes
            return [], False
        budget.spend(len(data))
    records = [(fields, content) for fields, content, sound in _ros1_records(BytesIO(data), len(data)) if sound]
    return records, complete or bool(records)


# --- All kinds --------------------------------------------------------------------------------------------------------

_RECOVER = {"ros1": recover_ros1, "mcap": recover_mcap, "sqlite3": recover_sqlite}


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
    return _RECOVER[kind](path, target)
