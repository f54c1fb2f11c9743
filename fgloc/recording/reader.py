"""Recordings as events: ``open_recording`` for all kinds of bag."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import TracebackType

from fgloc.config import RecordingConfig, Role, role_names
from fgloc.errors import RecordingError
from fgloc.recording.decode import TF_TYPES, converters_of, events_of
from fgloc.recording.definitions import Decoder
from fgloc.recording.roles import TopicInfo, select_roles
from fgloc.recording.storage import RawMessage, Storage
from fgloc.recording.transforms import FrameTree
from fgloc.types import Event, TransformEvent


def open_recording(path: Path, config: RecordingConfig) -> Recording:
    """Open a ROS 1 ``.bag``, a rosbag2 folder, an ``.mcap`` or a ``.db3``.

    Args:
        path: file or folder.
        config: topics, clocks.

    Raises:
        RecordingError: the recording cannot be read, several topics could play one role, or a configured topic does
            not fit.

    Example:
        >>> with open_recording(Path("run.bag"), RecordingConfig()) as recording:  # doctest: +SKIP
        ...     for event in recording.events(): ...
    """
    recording = Recording(path, config)
    if recording.problems:
        recording.close()
        raise RecordingError(f"{path}: " + "\n".join(recording.problems))
    return recording


class Recording:
    """An opened recording. Close it, or use it in a ``with``.

    Attributes:
        path: as given.
        kind: "ros1", "sqlite3" or "mcap".
        topics: all topics, with the role that each plays.
        roles: selected topic of each role.
        problems: why no topic could be selected for a role; `open_recording` raises them.
        undecodable: messages that the latest pass of `events` could not decode, by topic.
    """

    def __init__(self, path: Path, config: RecordingConfig) -> None:
        """Open; see `open_recording`, which also refuses ambiguous roles."""
        self.path = path
        self.config = config
        self._storage = Storage(path)
        self.kind = self._storage.kind
        channels = self._storage.channels
        found: dict[str, TopicInfo] = {}
        for channel in sorted(channels, key=lambda c: (c.topic, -c.count)):
            known = found.setdefault(channel.topic, TopicInfo(channel.topic, channel.message_type, 0))
            found[channel.topic] = replace(known, count=known.count + channel.count)
        selection = select_roles(tuple(found.values()), config.topics)
        self.roles: Mapping[Role, str] = selection.roles
        self.problems = selection.problems
        role_of: dict[str, Role] = {topic: role for role, topic in selection.roles.items()}
        self.topics = tuple(replace(topic, role=role_of.get(topic.name)) for topic in found.values())
        known_types = TF_TYPES.union(*map(converters_of, role_names()))
        self._decoder = Decoder(
            self.kind == "ros1",
            [(c.message_type, c.definition) for c in channels if c.message_type in known_types and c.count],
        )
        self._notes = (*selection.notes, *self._decoder.notes)
        self.undecodable: dict[str, int] = {}

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._storage.close()

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know, one sentence each. Damage is noted when reading meets it."""
        return (*self._storage.notes, *self._notes)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Receive time of the first and of the last message."""
        return self._storage.span_ns

    @property
    def duration_s(self) -> float:
        """Time from the first message received to the last [s]."""
        start, end = self.span_ns
        return max(0, end - start) * 1e-9

    @cached_property
    def frames(self) -> FrameTree:
        """All transforms of ``/tf_static`` and ``/tf``; the first use reads these topics through."""
        topics = {topic.name for topic in self.topics if topic.message_type in TF_TYPES and topic.count}
        messages = self._storage.messages(topics) if topics else iter(())
        events = (event for message in messages for event in self.decode(message, None))
        return FrameTree(event for event in events if isinstance(event, TransformEvent))

    def events(self) -> Iterator[Event]:
        """Events of the selected topics and of tf, in order of receive time. May be called again.

        Raises:
            RecordingError: the storage is damaged and nothing could be read before.
        """
        self.undecodable = {}
        role_of = {topic.name: topic.role for topic in self.topics if topic.role or topic.message_type in TF_TYPES}
        for message in self._storage.messages(role_of.keys()):
            yield from self.decode(message, role_of[message[0]])

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages of these topics (None: of all), serialized, in order of receive time."""
        return self._storage.messages(topics)

    def decode(self, message: RawMessage, role: Role | None) -> list[Event]:
        """Events of one message in a role (None: tf); empty, and counted, if it cannot be decoded."""
        topic, message_type, received_ns, raw = message
        try:
            content = self._decoder.deserialize(message_type, raw)
            return events_of(content, message_type, role, received_ns, topic, self.config)
        except Exception:  # rosbags leaks struct, decoding, key and assertion errors on damaged bytes
            self.undecodable[topic] = self.undecodable.get(topic, 0) + 1
            return []

    @property
    def size_bytes(self) -> int:
        """Size of the storage files."""
        return self._storage.size_bytes

    def content_hash(self) -> str:
        """Hex SHA-256 of the storage file, or of several one after the other."""
        return self._storage.content_hash()
