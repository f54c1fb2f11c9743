"""Salvage of ROS 1 bags: walks the records without the index and skips damaged chunks."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer

from fgloc.recording.limits import Budget, decompressed


def recover_ros1(path: Path, target: Path) -> tuple[int, float]:
    """Copy what can be read of a ROS 1 bag; returns the number of messages and the share of the bytes that is lost.

    Raises:
        TooLargeError: its chunks expand to more than its size allows.
    """
    budget = Budget(path)
    budget.start_pass()
    size = path.stat().st_size
    read = messages = 0
    connections: dict[int, Connection] = {}
    known: dict[tuple[str, str], Connection] = {}
    with Writer(target) as writer, path.open("rb") as file:
        read += len(file.readline(64))  # magic
        for header, data, sound in _ros1_records(file, size):
            if header.get("op") == b"\x05":
                inner, sound = _ros1_chunk(header, data, sound, budget)
            else:
                inner = [(header, data)] if sound else []
            read += 8 + sum(5 + len(k) + len(v) for k, v in header.items()) + len(data) if sound else 0
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
    return messages, max(0.0, 1.0 - read / size)


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
