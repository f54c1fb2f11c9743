"""Salvage of MCAP files: walks the records without the index and skips damaged chunks."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from fgloc.recording.limits import Budget, decompressed

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


def recover_mcap(path: Path, target: Path) -> tuple[int, float]:
    """Copy what can be read of an MCAP; returns the number of messages and the share of the bytes that is lost.

    Raises:
        TooLargeError: its chunks expand to more than its size allows.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record, _ in _mcap_records(path):  # first for the channels: those of a damaged chunk are repeated at the end
        if isinstance(record, Schema):
            schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            channels.setdefault(record.id, record)
    lost = 0.0
    with closing(McapSink(target)) as sink:
        ids: dict[int, int] = {}
        for record, sound in _mcap_records(path):
            lost = 1.0 - sound / path.stat().st_size
            if not isinstance(record, Message) or record.channel_id not in channels:
                continue
            if record.channel_id not in ids:
                channel = channels[record.channel_id]
                schema = schemas.get(channel.schema_id) or Schema(data=b"", encoding="", id=0, name="")
                ids[record.channel_id] = sink.channel(
                    channel.topic, schema.name, schema.encoding, schema.data, channel.message_encoding
                )
            sink.write(ids[record.channel_id], record.log_time, record.data)
    return sink.messages, lost


def _mcap_records(path: Path) -> Iterator[tuple[McapRecord | None, int]]:
    """Readable records, each with the number of the file's bytes that were sound so far; ends with (None, bytes)."""
    size, budget = path.stat().st_size, Budget(path)
    budget.start_pass()
    with path.open("rb") as file:
        read = len(file.read(8))  # magic
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
            if sound:
                read += 9 + len(payload)
            for record in records:
                yield record, read
            if not complete:
                break
        else:
            read += len(frame) if len(frame) == 8 else 0  # the magic at the end
    yield None, read


def _chunk_records(payload: bytes, complete: bool, budget: Budget) -> tuple[list[McapRecord | None], bool]:
    """Records of a chunk, and whether it was sound. Of one that was cut short, the leading ones if not compressed."""
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(payload)))
    except Exception:  # damaged bytes make the parser raise anything
        return [], False
    if chunk.compression:
        budget.check(chunk.uncompressed_size)
        budget.spend(chunk.uncompressed_size)
    try:
        if complete:
            data = decompressed(chunk.compression, chunk.data, chunk.uncompressed_size)
            plain = replace(chunk, compression="", data=data)
            return list(breakup_chunk(plain, validate_crc=True)), True
        if chunk.compression:
            return [], False
    except Exception:  # damaged bytes make the parser raise anything
        return [], False
    records: list[McapRecord | None] = []
    stream = BytesIO(chunk.data)
    while len(frame := stream.read(9)) == 9:
        opcode, length = struct.unpack("<BQ", frame)
        inner = stream.read(min(length, len(chunk.data)))
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
