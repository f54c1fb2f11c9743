"""What the parts of a run are built from: the facts of a stream, be it a recording or live."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Protocol

from fgloc.config import Role
from fgloc.recording.reader import Recording
from fgloc.recording.transforms import FrameTree
from fgloc.types import Camera, Event, RawEvent

_SCAN_EVENTS = 20_000  # how far into a recording an image that can be decoded is looked for


class HasFrames(Protocol):
    """Anything with transforms."""

    @property
    def frames(self) -> FrameTree:
        """All transforms between frames."""
        ...


class StreamFacts(HasFrames, Protocol):
    """What is known of a stream before it is run."""

    @property
    def name(self) -> str:
        """For messages to the user."""
        ...

    @property
    def roles(self) -> Mapping[Role, str]:
        """Topic of each role that is there."""
        ...

    @property
    def topics(self) -> str:
        """All topics with their types, for messages to the user."""
        ...

    @property
    def first(self) -> Mapping[type[Event], Event]:
        """The first event of each kind."""
        ...

    @property
    def image_size(self) -> tuple[int, int] | None:
        """Width and height of the first image that can be decoded; None if there is none."""
        ...

    @property
    def camera(self) -> Camera | None:
        """The calibrated and mounted camera, if it is known without CameraInfo and transforms."""
        ...


class RecordingFacts:
    """The facts of a recording, read when they are asked for."""

    camera: Camera | None = None

    def __init__(self, recording: Recording) -> None:
        """Take an opened recording."""
        self._recording = recording
        self.name = str(recording.path)
        self.roles: Mapping[Role, str] = recording.roles

    @property
    def topics(self) -> str:
        """All topics with their types."""
        return ", ".join(f"{t.name} ({t.message_type})" for t in self._recording.topics) or "none"

    @property
    def frames(self) -> FrameTree:
        """All transforms."""
        return self._recording.frames

    @cached_property
    def first(self) -> Mapping[type[Event], Event]:
        """The first event of each kind."""
        return first_events(self._recording)

    @cached_property
    def image_size(self) -> tuple[int, int] | None:
        """Of the first image near the beginning that can be decoded."""
        some = (event for _, event in zip(range(_SCAN_EVENTS), self._recording.events(), strict=False))
        return first_size(some)


def first_events(recording: Recording) -> dict[type[Event], Event]:
    """The first event of each kind, from as far into the recording as it takes for every topic to have a message."""
    found: dict[type[Event], Event] = {}
    missing = set(recording.roles.values())
    for event in recording.events():
        found.setdefault(type(event), event)
        missing.discard(event.topic)
        if not missing:
            break
    return found


def first_size(events: Iterable[Event]) -> tuple[int, int] | None:
    """Width and height of the first image among events that can be decoded."""
    for event in events:
        if isinstance(event, RawEvent) and (size := event.decoded_size()) is not None:
            return size
    return None
