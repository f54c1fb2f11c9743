"""Rows 60 to 66 of the fault list: damaged, hostile and incomplete recordings."""

from __future__ import annotations

import re
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from recording_bags import START_NS, TICK_NS, storage_file, write_drive, write_ros1
from refusal import refusal
from rosbags.rosbag2 import Reader

import fgloc
from fgloc.config import RecordingConfig
from fgloc.errors import RecordingError
from fgloc.files.documents import HostileError
from fgloc.recording.reader import open_recording
from fgloc.recording.recover import recover_mcap
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Grave, LostData, Severity

DEFAULT = RecordingConfig()


def odometry_stamps(path: Path) -> tuple[list[int], tuple[str, ...]]:
    """Receive times of the odometry and the notes after reading."""
    with open_recording(path, DEFAULT) as recording:
        received = [e.received_ns for e in recording.events() if isinstance(e, OdometryEvent)]
        return received, recording.notes


def note_of(notes: tuple[str, ...], word: str) -> str:
    (note,) = [note for note in notes if word in note]
    return note


def lost_share(note: str) -> float:
    assert isinstance(note, Grave)
    return note.share if isinstance(note, LostData) else 0.0


def small_chunks(path: Path, chunk_bytes: int = 8192) -> Path:
    """Rewrite an MCAP with small zstd chunks, as recorders with little memory do."""
    from mcap.reader import make_reader

    target = path.with_name("chunked.mcap")
    with path.open("rb") as source, target.open("wb") as sink:
        writer = Writer(sink, chunk_size=chunk_bytes)
        writer.start(profile="ros2")
        ids = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.topic not in ids:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, "cdr", schema_id)
            writer.add_message(ids[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


def cut(path: Path, share: float) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path


# --- 60: bag truncated ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_fault_60_a_compressed_chunk_that_is_cut_short_gives_its_beginning(tmp_path, compression):
    path, rng = tmp_path / "one_chunk.mcap", np.random.default_rng(0)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8 << 20, compression=compression)
        writer.start(profile="ros2")
        channel = writer.register_channel("/a", "cdr", writer.register_schema("x/msg/Y", "ros2msg", b"int32 a"))
        for k in range(2000):
            writer.add_message(channel, k, rng.bytes(300), k)
        writer.finish()
    recovered = recover_mcap(cut(path, 0.5), tmp_path / "salvaged.mcap")
    assert 500 < recovered.messages < 1200
    assert recovered.lost == pytest.approx(0.5, abs=0.05)  # the chunk says how long it was
    assert recovered.cut


@pytest.mark.parametrize("chunk_bytes", [None, 8192])
def test_fault_60_truncated_mcap_is_salvaged(tmp_path, chunk_bytes):
    path = storage_file(write_drive(tmp_path / "run"))
    path = cut(path if chunk_bytes is None else small_chunks(path, chunk_bytes), 0.6)
    received, notes = odometry_stamps(path)
    assert received == [START_NS + k * TICK_NS + 2_000_000 for k in range(len(received))]
    assert 0.4 * 200 < len(received) < 0.8 * 200
    by_its_chunk = 0.4 if chunk_bytes is None else 0.0  # of small chunks those that are missing are not known
    assert lost_share(note_of(notes, "salvaged")) == pytest.approx(by_its_chunk, abs=0.1)


@pytest.mark.parametrize("opened", ["folder", "file"])
def test_fault_60_truncation_is_told_by_the_messages_that_metadata_counts(tmp_path, opened):
    folder = write_drive(tmp_path / "run")
    file = cut(storage_file(folder), 0.5)
    _, notes = odometry_stamps(folder if opened == "folder" else file)
    assert 0.3 < lost_share(note_of(notes, "metadata.yaml counts 842 messages")) < 0.7


def test_fault_60_a_missing_file_of_several_is_grave(tmp_path):
    folder = write_drive(tmp_path / "run")
    metadata, name = folder / "metadata.yaml", storage_file(folder).name
    metadata.write_text(metadata.read_text().replace(f"- {name}", f"- {name}\n  - second.mcap", 1))
    assert isinstance(note_of(odometry_stamps(folder)[1], "missing: second.mcap"), Grave)


@pytest.mark.parametrize(("share", "grave"), [(0.5, True), (0.005, False)])
def test_fault_60_messages_that_cannot_be_decoded_are_told_by_their_share(tmp_path, share, grave):
    """A run warns of a large loss, and counts a single bad message."""
    file = storage_file(write_drive(tmp_path / "run", "sqlite3"))
    with closing(sqlite3.connect(file)) as database:
        (topic,) = database.execute("SELECT id FROM topics WHERE name = '/odom'").fetchone()
        chosen = f"SELECT id FROM messages WHERE topic_id = {topic} ORDER BY id LIMIT {int(200 * share)}"
        database.execute(f"UPDATE messages SET data = x'00010000' WHERE id IN ({chosen})")
        database.commit()
    with open_recording(file, DEFAULT) as recording:
        sum(1 for _ in recording.events())
        (said,) = recording.unreadable
    assert isinstance(said, Grave) == grave
    assert not grave or lost_share(said) == share


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_fault_60_a_run_warns_of_half_a_recording_lost(tmp_path, kind):
    path = storage_file(write_drive(tmp_path / "run")) if kind == "mcap" else write_ros1(tmp_path / "run.bag")
    result = fgloc.run(cut(path, 0.5), None, fgloc.Config(), "online")
    lost = [finding for finding in result.findings if finding.code == "recording.lost"]
    assert lost
    assert all(finding.severity is Severity.WARNING for finding in lost)
    assert 0.3 < max(finding.value for finding in lost) < 0.7


def test_fault_60_truncated_ros1_bag_is_salvaged(tmp_path):
    received, notes = odometry_stamps(cut(write_ros1(tmp_path / "run.bag"), 0.5))
    assert received == [START_NS + k * TICK_NS for k in range(len(received))]
    assert 30 < len(received) < 70
    assert lost_share(note_of(notes, "salvaged")) == pytest.approx(0.5, abs=0.1)  # its head has the place of its index


def test_fault_60_truncated_sqlite_is_salvaged(tmp_path):
    received, notes = odometry_stamps(cut(storage_file(write_drive(tmp_path / "run", "sqlite3")), 0.7))
    assert set(received) < {START_NS + k * TICK_NS + 2_000_000 for k in range(200)}
    assert received == sorted(received)
    assert 50 < len(received) < 190
    assert lost_share(note_of(notes, "salvaged")) == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_fault_60_nothing_left_is_one_error(tmp_path, kind):
    path = write_ros1(tmp_path / "run.bag") if kind == "ros1" else storage_file(write_drive(tmp_path / "run", kind))
    for share in (0.0, 0.01):
        with pytest.raises(RecordingError, match=re.escape(path.name)):
            odometry_stamps(cut(path, share))


# --- 61: metadata.yaml missing ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("content", [None, "", "rosbag2_bagfile_information: [", "\x00\x01"])
def test_fault_61_metadata_missing(tmp_path, storage, content):
    folder = write_drive(tmp_path / "run", storage, n=20)
    (folder / "metadata.yaml").unlink()
    if content is not None:
        (folder / "metadata.yaml").write_text(content)
    received, notes = odometry_stamps(folder)
    assert len(received) == 20
    state = "missing" if content is None else "damaged"
    assert note_of(notes, "metadata.yaml").startswith(f"metadata.yaml is {state}: {storage_file(folder).name}")


# --- 62: recorder killed ----------------------------------------------------------------------------------------------


def test_fault_62_killed_mcap_recorder(tmp_path):
    """Neither DataEnd nor summary nor footer: the file ends after a complete record."""
    path = small_chunks(storage_file(write_drive(tmp_path / "run")))
    with Reader(path) as reader:
        end = reader.storage.chunks[-1].chunk_start_offset  # type: ignore[union-attr]
    path.write_bytes(path.read_bytes()[:end])
    received, notes = odometry_stamps(path)
    assert len(received) > 180
    assert lost_share(note_of(notes, "salvaged")) == 0.0


def test_fault_62_killed_sqlite_recorder_leaves_its_last_messages_in_the_journal(tmp_path):
    original = storage_file(write_drive(tmp_path / "run", "sqlite3"))
    killed = tmp_path / "killed.db3"
    with closing(sqlite3.connect(original)) as database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("DELETE FROM messages WHERE id > 400")
        database.commit()
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        database.execute("PRAGMA wal_autocheckpoint=0")
        rows = database.execute("SELECT topic_id, timestamp, data FROM messages").fetchall()
        later = [(topic, stamp + 3600 * 10**9, data) for topic, stamp, data in rows]
        database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", later)
        database.commit()
        for end in ("", "-wal"):  # what is on the disk while the recorder still has the file open
            (tmp_path / f"killed.db3{end}").write_bytes(original.with_name(original.name + end).read_bytes())
    before = {end: (tmp_path / f"killed.db3{end}").read_bytes() for end in ("", "-wal")}
    received, notes = odometry_stamps(killed)
    assert received[-1] - received[0] > 3600 * 10**9
    assert "killed.db3-wal is left" in note_of(notes, "salvaged 800 messages")
    assert before == {end: (tmp_path / f"killed.db3{end}").read_bytes() for end in ("", "-wal")}


def test_fault_62_killed_ros1_recorder(tmp_path):
    """The index is written last: without it index_pos is 0."""
    path = write_ros1(tmp_path / "run.bag")
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    (index_pos,) = struct.unpack_from("<Q", data, at)
    struct.pack_into("<Q", data, at, 0)
    active = tmp_path / "run.bag.active"
    active.write_bytes(data[:index_pos])
    received, notes = odometry_stamps(active)
    assert len(received) == 100
    assert lost_share(note_of(notes, "salvaged")) == 0.0


# --- 63: bit-flipped bag ----------------------------------------------------------------------------------------------


def make_bag(tmp_path: Path, kind: str) -> Path:
    if kind == "ros1":
        return write_ros1(tmp_path / "run.bag", n=30)
    path = storage_file(write_drive(tmp_path / "run", kind.removesuffix(" chunked"), n=30))
    return small_chunks(path, 2048) if kind == "mcap chunked" else path


def read_all(path: Path) -> int | None:
    """Number of events; None if refused. Anything but RecordingError escapes and fails the test."""
    try:
        with open_recording(path, DEFAULT) as recording:
            count = sum(1 for _ in recording.events())
            assert recording.frames.frames is not None
            assert recording.duration_s >= 0
    except RecordingError:
        return None
    return count


@pytest.mark.parametrize(
    "kind", ["ros1", "mcap", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("mcap chunked", "sqlite3"))]
)
def test_fault_63_bit_flips_give_one_error_type_or_events(tmp_path, kind):
    path = make_bag(tmp_path, kind)
    data = path.read_bytes()
    whole = read_all(path)
    rng = np.random.default_rng(63)
    counts = []
    for _ in range(60):
        damaged = bytearray(data)
        for bit in rng.integers(0, len(data) * 8, size=rng.choice([1, 4, 32])):
            damaged[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(damaged)
        counts.append(read_all(path))
    read = [count for count in counts if count is not None]
    assert len(read) > 0.7 * len(counts)
    assert np.median(read) > 0.5 * whole


@pytest.mark.parametrize("kind", ["ros1", "mcap", "mcap chunked", "sqlite3"])
def test_fault_63_truncation_anywhere_gives_one_error_type_or_events(tmp_path, kind):
    path = make_bag(tmp_path, kind)
    data = path.read_bytes()
    counts = []
    for length in np.linspace(0, len(data) - 1, 30).astype(int):
        path.write_bytes(data[:length])
        counts.append(read_all(path) or 0)
    assert counts[0] == 0
    assert max(counts) > 60


def test_fault_63_what_was_read_before_the_damage_is_kept(tmp_path):
    """A flip inside one chunk costs that chunk, not what comes before or after, and nothing is given twice."""
    path = small_chunks(storage_file(write_drive(tmp_path / "run")))
    with Reader(path) as reader:
        chunks = reader.storage.chunks  # type: ignore[union-attr]
        middle = chunks[len(chunks) // 2]
        at = middle.chunk_start_offset + middle.chunk_length // 2
        bounds = middle.message_start_time, middle.message_end_time
    data = bytearray(path.read_bytes())
    data[at] ^= 0x10
    path.write_bytes(data)
    received, notes = odometry_stamps(path)
    all_stamps = [START_NS + k * TICK_NS + 2_000_000 for k in range(200)]
    assert received == sorted(set(received))
    lost = set(all_stamps) - set(received)
    assert lost
    assert all(bounds[0] <= stamp <= bounds[1] for stamp in lost)
    assert 0 < lost_share(note_of(notes, "of 842 messages")) < 0.2  # its index counts them


def test_fault_63_damaged_text_in_definitions_falls_back(tmp_path):
    path = storage_file(write_drive(tmp_path / "run", n=20))
    data = path.read_bytes()
    path.write_bytes(data.replace(b"string child_frame_id", b"str\xfb!g chil%_frame_id"))
    received, notes = odometry_stamps(path)
    assert len(received) == 20
    assert "nav_msgs/msg/Odometry" in note_of(notes, "definitions")


# --- 64: no embedded definitions --------------------------------------------------------------------------------------


def test_fault_64_no_embedded_definitions(tmp_path):
    path = storage_file(write_drive(tmp_path / "run", "sqlite3", n=20))
    with closing(sqlite3.connect(path)) as database:
        database.execute("DELETE FROM message_definitions")
        database.commit()
    received, notes = odometry_stamps(path)
    assert len(received) == 20
    note = note_of(notes, "no definitions")
    assert note.count("landmark_msgs/msg/LandmarkArray") == note.count("nav_msgs/msg/Odometry") == 1
    assert "ROS 2 Humble" in note


# --- 65: path escape in metadata, YAML bomb ---------------------------------------------------------------------------


@pytest.mark.parametrize("escape", ["../other/x.mcap", "/etc/x.mcap", "sub/../../x.mcap", "C:\\x.mcap", "..\\x.mcap"])
def test_fault_65_path_escape_is_refused(tmp_path, escape):
    write_drive(tmp_path / "other", n=5)
    folder = write_drive(tmp_path / "run", n=5)
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(storage_file(folder).name, f"'{escape}'"))
    with pytest.raises(RecordingError, match="relative_file_paths names") as caught:
        open_recording(folder, DEFAULT)
    assert repr(escape) in str(caught.value)


def test_fault_65_yaml_bomb_is_refused(tmp_path):
    folder = write_drive(tmp_path / "run", n=5)
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
    metadata = folder / "metadata.yaml"
    metadata.write_text("\n".join(lines) + "\n" + metadata.read_text())
    with refusal(RecordingError, metadata, cause=HostileError):
        open_recording(folder, DEFAULT)


def test_fault_65_deep_nesting_is_refused(tmp_path):
    folder = write_drive(tmp_path / "run", n=5)
    (folder / "metadata.yaml").write_text("[" * 20_000)
    with refusal(RecordingError, folder / "metadata.yaml", cause=HostileError):
        open_recording(folder, DEFAULT)


def test_fault_65_the_recordings_own_folder_may_lead_a_path(tmp_path):
    folder = write_drive(tmp_path / "run", n=5)
    name = storage_file(folder).name
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(name, f"run/{name}"))
    assert len(odometry_stamps(folder)[0]) == 5


# --- 66: wrong frame_id, missing tf -----------------------------------------------------------------------------------


def test_fault_66_missing_frame_is_named_with_those_there(tmp_path):
    with open_recording(write_drive(tmp_path / "run", n=5), DEFAULT) as recording:
        with pytest.raises(RecordingError, match=r"'camera_link'.* base_link, camera_"):
            recording.frames.lookup("base_link", "camera_link")
        with pytest.raises(RecordingError, match=r"recording\.sightings_pose"):
            recording.frames.lookup("body", "camera_optical")


def test_fault_66_no_transforms_at_all(tmp_path):
    with (
        open_recording(write_ros1(tmp_path / "run.bag"), DEFAULT) as recording,
        refusal(RecordingError, "'base_link'", "'camera'", "/tf_static"),
    ):
        recording.frames.lookup("base_link", "camera")


@pytest.mark.parametrize(("name", "right"), [("run.mcap", "run.bag"), ("run", "run.bag"), ("run.db3", "run.bag")])
def test_a_file_whose_content_is_of_another_kind_than_its_name_says_which(tmp_path, name, right):
    path = write_ros1(tmp_path / "source.bag").rename(tmp_path / name)
    with pytest.raises(RecordingError, match=rf"{re.escape(name)}.*ROS 1.* {right}"):
        open_recording(path, DEFAULT)


def test_an_empty_file_is_said_to_be_empty(tmp_path):
    path = tmp_path / "run.mcap"
    path.touch()
    with pytest.raises(RecordingError, match=r"run\.mcap.*empty"):
        open_recording(path, DEFAULT)


@pytest.mark.parametrize("content", [np.random.default_rng(0).bytes(3000), b"hello\n" * 50, b"\xff\xfe" * 500])
@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_fault_63_a_file_of_another_kind_is_said_to_be_one(tmp_path, content, suffix):
    path = tmp_path / f"x{suffix}"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="it is not") as caught:
        open_recording(path, DEFAULT)
    assert str(path) in str(caught.value)
    assert "codec" not in str(caught.value)
