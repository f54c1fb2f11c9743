"""What arrives: rates and delays by topic, publishers, and clocks that were reset."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from fgloc.config import Config
from fgloc.intake.clocks import Source, TopicClocks, source_of
from fgloc.intake.validation import EventValidator, reported_bounds
from fgloc.live.facts import LiveFacts
from fgloc.live.facts import role_of as known_role
from fgloc.live.status import TopicMeter, TopicStatus
from fgloc.types import Event, MotionEvent, TransformEvent

_SILENT_NS = 2_000_000_000  # a topic that others outlive by this long is reported
_SUCCESSION_NS = (
    1_000_000_000  # a publisher that sends nothing for this long has ended; another one of the topic is used
)


@dataclass(slots=True)
class _Publisher:
    """Whose messages of a topic are used."""

    name: str
    received_ns: int

    def has_the_topic(self, name: str, received_ns: int) -> bool:
        """Whether a message is of that publisher, or of one that takes its place."""
        if name != self.name and received_ns - self.received_ns < _SUCCESSION_NS:
            return False
        self.name, self.received_ns = name, received_ns
        return True


class Reception:
    """Takes every event as it arrives; used under the lock of its owner.

    Attributes:
        dropped: events that are not used whatever is in them, by role.
    """

    def __init__(self, config: Config) -> None:
        """Nothing has arrived."""
        self._selection = LiveFacts(config, None, None)
        self._gate = EventValidator(reported_bounds(config))
        self.dropped: Counter[str] = Counter()
        self._publishers: dict[Source, _Publisher] = {}
        self._meters: dict[str, TopicMeter] = {}
        self._clocks = TopicClocks()
        self._notes: dict[str, None] = {}  # an ordered set

    def receive(self, event: Event, publisher: str) -> list[Event]:
        """The events that are to be used now: mostly this one; see `TopicClocks`."""
        role = role_of(event)
        if not isinstance(event, TransformEvent) and not self._is_of_its_publisher(event, publisher):
            self.dropped[role] += 1
            self.note(
                f"{event.topic}: two publishers; only the messages of the first are used: stop or rename one of them"
            )
            return []
        if event.topic not in self._meters:
            self._meters[event.topic] = TopicMeter(role)
        self._meters[event.topic].add(event.stamp_ns, event.received_ns)
        return self._clocks.correct(event)

    def _is_of_its_publisher(self, event: Event, publisher: str) -> bool:
        """Whether a message is of the one publisher that its topic should have; transforms have any number."""
        first = self._publishers.setdefault(source_of(event), _Publisher(publisher, event.received_ns))
        return first.has_the_topic(publisher, event.received_ns)

    def motion(self, event: Event) -> MotionEvent | None:
        """An event that was received, if it is of the motion source to be used, and as the gate lets it through."""
        if not isinstance(event, MotionEvent) or not self._selection.topic_is_used(event):
            return None
        passed = self._gate.check(event)
        return passed if isinstance(passed, MotionEvent) else None

    def note(self, text: str) -> None:
        """Remember a sentence for the user."""
        self._notes.setdefault(text)

    def topics(self) -> Mapping[str, TopicStatus]:
        """How each topic comes in."""
        return {topic: meter.status() for topic, meter in sorted(self._meters.items())}

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know so far, one sentence each."""
        newest = max((meter.last_ns for meter in self._meters.values()), default=0)
        gaps = [
            f"{topic}: no message for {(newest - meter.last_ns) * 1e-9:.0f} s"
            for topic, meter in sorted(self._meters.items())
            if meter.is_regular and newest - meter.last_ns > _SILENT_NS
        ]
        return (*self._notes, *self._clocks.notes, *gaps)


def role_of(event: Event) -> str:
    """Role of an event's topic."""
    return known_role(event) or "tf"
