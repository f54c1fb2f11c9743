"""Interface between a live run and its network, with two implementations: a DDS participant, and a node of ROS."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Protocol, TypeVar

_READ_DEPTH = 2000  # messages of a topic that wait to be read: 10 s of it, on a busy machine
_LARGE_DEPTH = 20  # of large ones: 4 s of images at 5 Hz
_LARGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_BATCH = 200  # messages taken from a queue at once
_MOST_PASSES = 20  # over the queues before what they held is handed on
_ALIKE_NS = 1_000_000_000  # clocks closer than this are one clock: ROS counts on it between machines


@dataclass(frozen=True, slots=True)
class Publication:
    """Topic that somebody else publishes."""

    topic: str
    message_type: str  # "pkg/msg/Name"


class Received(Protocol):
    """One message as it was received; `Transport.decode` reads it."""

    @property
    def topic(self) -> str:
        """Full name."""

    @property
    def message_type(self) -> str:
        """Type as "pkg/msg/Name"."""

    @property
    def source_ns(self) -> int:
        """Time of writing, by its writer's clock."""

    @property
    def publisher(self) -> str:
        """Name that tells writers of one topic apart; empty if the network does not say."""


class Clock(Protocol):
    """Time of the robot: simulated, or the machine's."""

    def now_ns(self) -> int:
        """Time now [ns]; simulation time stands still between messages, as in ROS."""

    def received_ns(self, message: Received) -> int:
        """Receive time of a message [ns], see `received_ns`."""


class Publisher(Protocol):
    """Writer of one topic."""

    @property
    def readers(self) -> int:
        """Number of matched readers."""

    def publish(self, values: Mapping[str, Any]) -> None:
        """Send a message, given as nested mappings; fields that are not given are zero or empty."""


class Transport(Protocol):
    """Network of a live run."""

    def full_name(self, name: str) -> str:
        """Full name of a topic: "~/x" is one of fgloc's own, "x" one of its robot's, "/x" one that robots share."""

    def clock(self) -> Clock:
        """Clock of this network."""

    def publications(self) -> tuple[Publication, ...]:
        """Topics that others publish now, sorted by name."""

    def has_volatile(self, topic: str) -> bool:
        """Whether one of the topic's publishers keeps nothing for late readers: a latched reader does not match it."""

    def lost(self) -> Mapping[str, int]:
        """Messages that were lost on their way here, by topic, as far as the network tells."""

    def read(self, topic: str, message_type: str, on_message: Callable[[Any], None], latched: bool = False) -> None:
        """Deliver a topic's messages, as `Received`, from now on and one after the other."""

    def decode(self, message: Any) -> Any:
        """Content of a received message: an object with the fields of its type. Raises whatever damage leads to."""

    def writer(self, topic: str, message_type: str, latched: bool = False) -> Publisher:
        """A reliable writer; a latched one gives late readers what was written before (transient local)."""


def received_ns(source_ns: int, now_ns: int, simulated: bool) -> int:
    """Receive time of a message [ns]: that of writing if its writer has our clock, else now.

    Neither the network nor a busy processor delays the time of writing. A writer has our clock if that is simulation
    time (as `fgloc play` has it; other players and simulators write by the machine's clock), or the machine's.
    """
    apart = abs(source_ns - now_ns)
    ours = apart <= abs(source_ns - time.time_ns()) if simulated else apart < _ALIKE_NS
    return source_ns if ours else now_ns


def read_depth(message_type: str) -> int:
    """Number of a topic's messages that may wait to be read."""
    return _LARGE_DEPTH if message_type in _LARGE else _READ_DEPTH


T = TypeVar("T")
Take = Callable[[int], Iterable[tuple[int, T]]]
"""Takes at most so many messages from a queue, the oldest first, each with its time of writing."""


def in_order(queues: Sequence[tuple[int, Take[T]]], first: Iterable[tuple[int, T]] = ()) -> list[T]:
    """Merge the messages that wait in several queues, in the order of writing; those without a time (0) come first.

    They are looked at again until nothing more has come: a queue's newest message would else overtake older ones of
    queues that were looked at before it.

    Args:
        queues: each with the number of messages that may wait in it; no more are taken.
        first: messages that were taken before.
    """
    found = [*first]
    rooms = [depth for depth, _ in queues]
    for _ in range(_MOST_PASSES):
        before = len(found)
        for k, (_, take) in enumerate(queues):
            taken = [*take(min(_BATCH, rooms[k]))] if rooms[k] else []
            rooms[k] -= len(taken)
            found += taken
        if len(found) == before:
            break
    return [message for _, message in sorted(found, key=itemgetter(0))]
