"""Salvage of rosbag2's SQLite files: walks the rows past damaged pages, and takes in a killed recorder's journal."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from fgloc.recording.limits import Budget, check_tables
from fgloc.recording.recover_mcap import McapSink


def sqlite_journals(path: Path) -> list[Path]:
    """Journals that a killed recorder left beside a database: they hold, or undo, its last messages."""
    candidates = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
    return [file for file in candidates if file.is_file() and file.stat().st_size > 0]


def recover_sqlite(path: Path, target: Path) -> tuple[int, float]:
    """Copy the readable rows into an MCAP; returns their number and the share of the bytes that is lost.

    Raises:
        TooLargeError: a table is a query.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(100)
    intended = size
    if len(header) == 100:
        page, pages = struct.unpack(">H", header[16:18])[0], struct.unpack(">I", header[28:32])[0]
        intended = max(size, (65536 if page == 1 else page) * pages)
    source, options = path, "mode=ro&immutable=1"
    if journals := sqlite_journals(path):
        source, options = target.parent / path.name, "mode=rw"
        for original in (path, *journals):
            shutil.copyfile(original, target.parent / original.name)
    with closing(McapSink(target)) as sink:
        try:
            with closing(sqlite3.connect(f"file:{quote(str(source.absolute()))}?{options}", uri=True)) as database:
                check_tables(database, path)
                _copy_rows(database, sink, Budget(path))
        except sqlite3.Error:
            pass  # damaged beyond the rows already copied
    return sink.messages, 1.0 - size / intended


def _copy_rows(database: sqlite3.Connection, sink: McapSink, budget: Budget) -> None:
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
    last, step = 0, 1
    while step < 2**40:  # past a damaged page the next sound row is looked for further and further away
        try:
            rows = database.execute(
                "SELECT id, topic_id, timestamp, data FROM messages WHERE id >= ? ORDER BY id", (last + step,)
            )
            for row_id, topic_id, received_ns, data in rows:
                if row_id <= last:
                    return  # a damaged tree that leads in circles
                last, step = row_id, 1
                if topic_id in ids and isinstance(received_ns, int) and isinstance(data, bytes):
                    budget.spend(len(data))
                    sink.write(ids[topic_id], received_ns, data)
            return
        except sqlite3.DatabaseError:
            step *= 2
