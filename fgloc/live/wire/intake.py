"""Topics of the wire as events: found by type, selected by role, decoded as those of a recording."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping

from fgloc.config import RecordingConfig, Role
from fgloc.errors import WireError
from fgloc.live.wire.clock import WireClock
from fgloc.live.wire.names import OWN
from fgloc.live.wire.participant import Participant, Publication, Sample
from fgloc.recording.reader import TF_TYPES, TopicInfo, events_of, select_roles
from fgloc.types import Event

SETTLED_S = 1.0  # no new topic for this long: all of a robot's have been found
MOTION: tuple[Role, ...] = ("odometry", "joints", "command", "imu")
LOOK: tuple[Role, ...] = ("image", "sightings")
_TF_TOPICS = ("/tf", "/tf_static")
_LATCHED = frozenset({"/tf_static"})


class Intake:
    """Selects topics as `Recording` does and pushes their events, each with the name of its publisher.

    Attributes:
        roles: topic of each role; empty until those are there that a run needs.
        undecodable: messages that could not be decoded, by topic.
        received: messages by topic.
        truth: whether a truth is read; only those who look on need it.
    """

    def __init__(
        self, participant: Participant, clock: WireClock, config: RecordingConfig, push: Callable[[Event, str], None]
    ) -> None:
        """Watch the wire; `find` looks for topics, `subscribe` reads them."""
        self._participant = participant
        self._clock = clock
        self._config = config
        self._push = push
        self._role_of: dict[str, Role | None] = {}
        self._also: set[str] = set()  # latched topics that are read from publishers that do not latch, too
        self._found: tuple[Publication, ...] = ()
        self._changed_s = time.monotonic()
        self.roles: dict[Role, str] = {}
        self.undecodable: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.truth = True
        self._counting = threading.Lock()

    def find(self) -> str:
        """Look for the topics that a run needs; call it a few times a second. What is found is in `roles`.

        Returns:
            What is missing, as one sentence; empty if nothing is.

        Raises:
            WireError: several topics could play one role, or a configured one has another type.
        """
        found = tuple(p for p in self._participant.publications() if not p.topic.startswith(OWN))
        if found != self._found:
            self._found, self._changed_s = found, time.monotonic()
        if time.monotonic() - self._changed_s < SETTLED_S:
            return ""
        selection = select_roles([TopicInfo(p.topic, p.message_type, 1) for p in found], self._config.topics)
        missing = "" if self.roles else self._missing(selection.roles)
        wrong = [problem for problem in selection.problems if "is not in the recording" not in problem]
        if wrong and not self.roles:  # a configured topic that is not there may come
            raise WireError("\n".join(wrong))
        if not missing:
            self.roles = {**selection.roles, **self.roles}
        return missing

    def subscribe(self) -> list[tuple[Role, str]]:
        """Read what was found and is not read yet; the roles and topics that are new."""
        types = {p.topic: p.message_type for p in self._found}
        for topic in _TF_TOPICS:
            if self.roles and types.get(topic) in TF_TYPES and topic not in self._role_of:
                self._role_of[topic] = None
                self._participant.read(topic, types[topic], self._on_sample, latched=topic in _LATCHED)
            if topic in self._role_of and topic in _LATCHED - self._also and self._participant.has_volatile(topic):
                self._also.add(topic)
                self._participant.read(topic, types[topic], self._on_sample)
        new = [(role, topic) for role, topic in self.roles.items() if topic not in self._role_of and topic in types]
        new = [(role, topic) for role, topic in new if self.truth or role != "truth"]
        for role, topic in new:
            self._role_of[topic] = role
            self._participant.read(topic, types[topic], self._on_sample)
        return new

    def _missing(self, roles: Mapping[Role, str]) -> str:
        lacking = []
        if not set(MOTION) & roles.keys():
            lacking.append("odometry, joint states, commands or an IMU")
        wanted = [role for role in LOOK if getattr(self._config.topics, role) != "none"]
        if wanted and not set(wanted) & roles.keys():
            lacking.append("images or marker sightings")
        names = {p.topic for p in self._found}
        for role in (*MOTION, *LOOK, "camera_info"):
            given = getattr(self._config.topics, role)
            if given not in (None, "none") and given not in names:
                lacking.append(f"{given} (recording.topics.{role})")
        there = ", ".join(f"{p.topic} ({p.message_type})" for p in self._found) or "none"
        return f"Waiting for {' and '.join(lacking)}; topics there: {there}." if lacking else ""

    def _on_sample(self, sample: Sample) -> None:
        with self._counting:
            self.received[sample.topic] += 1
        try:
            content = self._participant.messages.decode(sample.message_type, sample.cdr)
            role, received_ns = self._role_of[sample.topic], self._clock.received_ns(sample)
            events = events_of(content, sample.message_type, role, received_ns, sample.topic, self._config)
        except Exception:  # rosbags leaks struct, decoding, key and assertion errors on damaged bytes
            with self._counting:
                self.undecodable[sample.topic] += 1
            return
        for event in events:
            self._push(event, sample.publisher)
