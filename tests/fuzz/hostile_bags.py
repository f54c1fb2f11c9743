"""Recordings of less than a megabyte that stand for gigabytes or hours, unless their reader is careful."""

from __future__ import annotations

import bz2
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import cv2
import lz4.frame
import numpy as np
import zstandard
from mcap.writer import CompressionType, Writer

from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000


def _zeros(compress: Callable[[], object], size: int) -> bytes:
    """Compressed zeros, made piece by piece."""
    compressor = compress()
    block = bytes(1 << 20)
    parts = [compressor.begin()] if hasattr(compressor, "begin") else []
    parts += [compressor.compress(block) for _ in range(size >> 20)]
    return b"".join([*parts, compressor.flush()])


_COMPRESSORS = {
    "zstd": lambda: zstandard.ZstdCompressor(level=3).compressobj(),
    "lz4": lambda: lz4.frame.LZ4FrameCompressor(),
    "bz2": lambda: bz2.BZ2Compressor(),
}


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


def mcap_bomb(path: Path, kind: str, size: int, declared: int | None = None, chunks: int = 1) -> None:
    """Chunks of zeros without an index; each says it holds ``declared`` bytes."""
    data = _zeros(_COMPRESSORS[kind], size)
    head = struct.pack("<QQQI", START_NS, START_NS, size if declared is None else declared, 0)
    chunk = _record(6, head + _text(kind.encode()) + struct.pack("<Q", len(data)) + data)
    magic = b"\x89MCAP0\r\n"
    path.write_bytes(
        magic
        + _record(1, _text(b"ros2") + _text(b"x"))
        + chunk * chunks
        + _record(2, struct.pack("<QQI", 0, 0, 0))
        + magic
    )


def mcap_indexed_bomb(path: Path, chunks: int, each: int) -> None:
    """Many sound chunks of one large message each, all of the same time, so that a merge opens all at once."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, chunk_size=1)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/text", "cdr", schema)
        data = b"\0\1\0\0" + struct.pack("<I", each) + bytes(each)
        for _ in range(chunks):
            writer.add_message(channel, START_NS, data, START_NS)
        writer.finish()


def ros1_bomb(path: Path, kind: str, size: int) -> None:
    """A ROS 1 bag with one chunk of zeros, and an index that leads there."""
    data = _zeros(_COMPRESSORS[kind], size)

    def record(fields: dict[bytes, bytes], content: bytes) -> bytes:
        head = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in fields.items())
        return struct.pack("<I", len(head)) + head + struct.pack("<I", len(content)) + content

    magic = b"#ROSBAG V2.0\n"
    chunk = record(
        {b"op": b"\5", b"compression": kind.encode(), b"size": struct.pack("<I", min(size, 2**32 - 1))}, data
    )
    stamp = struct.pack("<II", START_NS // 10**9, 0)
    index = record(
        {b"op": b"\4", b"ver": struct.pack("<I", 1), b"conn": bytes(4), b"count": struct.pack("<I", 1)},
        stamp + struct.pack("<I", 0),
    )
    connection = record(
        {b"op": b"\7", b"conn": bytes(4), b"topic": b"/text"},
        b"".join(
            struct.pack("<I", len(f)) + f
            for f in (
                b"topic=/text",
                b"type=std_msgs/String",
                b"md5sum=" + b"0" * 32,
                b"message_definition=string data\n",
            )
        ),
    )

    def head(at: int) -> bytes:
        fields = {
            b"op": b"\3",
            b"index_pos": struct.pack("<Q", at),
            b"conn_count": struct.pack("<I", 1),
            b"chunk_count": struct.pack("<I", 1),
        }
        bare = record(fields, b"")
        return record(fields, b" " * (4096 - len(bare)))

    at = len(magic) + len(head(0))
    where = struct.pack("<Q", at)
    infos = record(
        {
            b"op": b"\6",
            b"ver": struct.pack("<I", 1),
            b"chunk_pos": where,
            b"start_time": stamp,
            b"end_time": stamp,
            b"count": struct.pack("<I", 1),
        },
        struct.pack("<II", 0, 1),
    )
    path.write_bytes(magic + head(at + len(chunk) + len(index)) + chunk + index + connection + infos)


def definition_bomb(path: Path, message_type: str, definition: str, encoding: str = "ros2msg") -> None:
    """An MCAP with one message of a type whose definition is hostile."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        schema = writer.register_schema(message_type, encoding, definition.encode())
        channel = writer.register_channel("/odom", "cdr", schema)
        for k in range(20):
            writer.add_message(channel, START_NS + k, b"\0\1\0\0" + bytes(2000), START_NS + k)
        writer.finish()


def qos_bomb(path: Path) -> None:
    """A channel whose quality-of-service profile is YAML with nested merges."""
    merges = "- &a0 {k: 1}\n" + "".join(f"- &a{i} {{<<: [{','.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 14))
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/text", "cdr", schema, {"offered_qos_profiles": merges})
        writer.add_message(channel, START_NS, b"\0\1\0\0\2\0\0\0a\0", START_NS)
        writer.finish()


def image_bomb(folder: Path, suffix: str, side: int) -> Path:
    """A bag with compressed images of ``side`` by ``side`` pixels."""
    image = cv2.imencode(suffix, np.zeros((side, side), np.uint8))[1].tobytes()
    return _with_images(folder, image, side)


def _with_images(folder: Path, image: bytes, side: int) -> Path:
    K = [[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]
    with BagWriter(folder) as bag:
        bag.static_transform(START_NS, "base_link", "camera", (0.1, 0.0, 0.3), (-0.5, 0.5, -0.5, 0.5))
        bag.camera_info("/camera/camera_info", START_NS, (side, side), K, [0.0] * 5, frame_id="camera")
        for k in range(40):
            stamp = START_NS + k * 50_000_000
            bag.odometry("/odom", stamp, (0.02 * k, 0.0, 0.0), (0.4, 0.0))
            if k == 20:
                bag.compressed_image("/camera/image/compressed", stamp, image, frame_id="camera")
    (folder / "robot.yaml").write_text(
        "markers: {dictionary: DICT_4X4_50, default_size_m: 0.1}\nexpert: {camera: {rescale: true}}\n"
    )
    return folder


def scans_bomb(folder: Path) -> Path:
    """A progressive JPEG of very many scans, each of which goes over the whole image."""
    jpeg = cv2.imencode(".jpg", np.zeros((2000, 2000), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    first = jpeg.index(b"\xff\xda")
    second = jpeg.index(b"\xff\xda", first + 2)
    scan = jpeg[second : jpeg.index(b"\xff", second + 20)] if second > 0 else b""
    end = jpeg.rindex(b"\xff\xd9")
    return _with_images(folder, jpeg[:end] + scan * 2000 + jpeg[end:], 2000)


def raw_image_bomb(path: Path) -> None:
    """A sound chunk that holds one raw image of 150 million pixels."""
    from fgloc.recording.messages import default_typestore

    store = default_typestore()
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](sec=START_NS // 10**9, nanosec=0)
    header = t["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")
    image = t["sensor_msgs/msg/Image"](header, 12000, 12500, "mono8", 0, 12500, np.zeros(12000 * 12500, np.uint8))
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")
        text = store.generate_msgdef("sensor_msgs/msg/Image", ros_version=2)[0]
        schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", text.encode())
        channel = writer.register_channel("/camera/image_raw", "cdr", schema)
        writer.add_message(channel, START_NS, bytes(store.serialize_cdr(image, "sensor_msgs/msg/Image")), START_NS)
        writer.finish()


def sqlite_query(path: Path, query: str) -> None:
    """A database whose messages are a query: without end, or of great blobs."""
    rows = {
        "endless": "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i, 1, i, x'00' FROM n",
        "blobs": "SELECT 1, 1, 1, zeroblob(900000000) UNION ALL SELECT 2, 1, 2, zeroblob(900000000)",
    }
    with closing(sqlite3.connect(path)) as database:
        database.executescript(
            "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT);"
            "INSERT INTO schema VALUES(3, 'humble');"
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
            " offered_qos_profiles TEXT);"
            "INSERT INTO topics VALUES(1, '/odom', 'nav_msgs/msg/Odometry', 'cdr', '');"
        )
        if query == "generated":
            database.execute(
                "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
                " data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL)"
            )
            database.execute("INSERT INTO messages(topic_id, timestamp) VALUES(1, 1)")
        else:
            database.execute(f"CREATE VIEW messages(id, topic_id, timestamp, data) AS {rows[query]}")
        database.commit()


def file_compression_bomb(folder: Path, size: int) -> Path:
    """A rosbag2 folder whose only file rosbag2 is said to have compressed."""
    folder.mkdir()
    (folder / "run_0.db3.zstd").write_bytes(_zeros(_COMPRESSORS["zstd"], size))
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n  duration: {nanoseconds: 1}\n"
        "  starting_time: {nanoseconds_since_epoch: 1}\n  message_count: 1\n  topics_with_message_count: []\n"
        "  compression_format: zstd\n  compression_mode: FILE\n  relative_file_paths: [run_0.db3.zstd]\n"
    )
    return folder


_HEADER = "std_msgs/Header header\nstring child_frame_id\n"
_SEPARATOR = "=" * 80 + "\n"
DEFINITIONS = {
    "strings": "string[100000000] x\n",
    "numbers": "float64[2000000000] x\n",
    "messages": f"a/B[30000000] x\n{_SEPARATOR}MSG: a/B\nuint8 x\n",
    "nested": "a/B0[900] x\n"
    + "".join(f"{_SEPARATOR}MSG: a/B{i}\na/B{i + 1}[900] x\n" for i in range(9))
    + f"{_SEPARATOR}MSG: a/B9\nuint8 x\n",
    "itself": "nav_msgs/Odometry[2] x\n",
    "empty": f"a/B[] x\n{_SEPARATOR}MSG: a/B\n",
    "comments": "# x\n" * 80_000,
    "fields": "".join(f"float64 x{i}\n" for i in range(20_000)),
}


def make_all(folder: Path, great: int = 3 << 30) -> dict[str, Path]:
    """All of them, by name; the great ones expand to this many bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    made: dict[str, Path] = {}

    def at(name: str, suffix: str = ".mcap") -> Path:
        made[name] = folder / f"{name}{suffix}"
        return made[name]

    for kind in ("zstd", "lz4"):
        size = great if kind == "zstd" else 200 << 20
        mcap_bomb(at(f"mcap_{kind}"), kind, size)
    mcap_bomb(at("mcap_undeclared"), "zstd", great, declared=1 << 20)
    mcap_bomb(at("mcap_many_chunks"), "zstd", 25 << 20, chunks=100)
    mcap_indexed_bomb(at("mcap_merged"), chunks=40, each=60 << 20)
    mcap_indexed_bomb(at("mcap_merged_within"), chunks=3, each=10 << 20)
    ros1_bomb(at("ros1_bz2", ".bag"), "bz2", great // 3)
    ros1_bomb(at("ros1_lz4", ".bag"), "lz4", 200 << 20)
    for name, text in DEFINITIONS.items():
        definition_bomb(at(f"definition_{name}"), "nav_msgs/msg/Odometry", text)
    idl = "module nav_msgs { module msg { const long X = ((((1)))); struct Odometry { long x; }; }; };"
    definition_bomb(at("definition_idl"), "nav_msgs/msg/Odometry", idl, "ros2idl")
    qos_bomb(at("qos"))
    made["png"] = image_bomb(folder / "png", ".png", 30000)
    made["webp"] = image_bomb(folder / "webp", ".webp", 16000)
    made["jpeg"] = image_bomb(folder / "jpeg", ".jpg", 9000)
    made["jpeg_scans"] = scans_bomb(folder / "scans")
    made["png_allowed"] = image_bomb(folder / "allowed", ".png", 4096)
    raw_image_bomb(at("raw_image"))
    for query in ("endless", "blobs", "generated"):
        sqlite_query(at(f"sqlite_{query}", ".db3"), query)
    made["file_compression"] = file_compression_bomb(folder / "compressed", great)
    return made


def megabytes(path: Path) -> float:
    """Size of a recording."""
    files = [path] if path.is_file() else [f for f in path.rglob("*") if f.is_file()]
    return sum(f.stat().st_size for f in files) / 1e6
