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
from fgloc.recording.decode import TF_TYPES, events_of
from fgloc.recording.roles import Selection, TopicInfo, select_roles
from fgloc.types import Event

SETTLED_S = 1.0  # no new topic for this long: all of a robot's have been found
MOTION: tuple[Role, ...] = ("odometry", "joints", "command", "imu")
LOOK: tuple[Role, ...] = ("image", "sightings")
_TF_TOPICS = ("/tf", "/tf_static")


class Intake:
    """Selects topics as `Recording` does and pushes their events.

    Attributes:
        roles: selected topic of each role that is subscribed.
        undecodable: messages that could not be decoded, by topic.
        received: messages by topic.
    """

    def __init__(
        self, participant: Participant, clock: WireClock, config: RecordingConfig, push: Callable[[Event], None]
    ) -> None:
        """Watch the wire; `poll` subscribes."""
        self._participant = participant
        self._clock = clock
        self._config = config
        self._push = push
        self._role_of: dict[str, Role | None] = {}
        self._known: tuple[Publication, ...] = ()
        self._changed_s = time.monotonic()
        self.roles: dict[Role, str] = {}
        self.undecodable: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self._counting = threading.Lock()

    def poll(self) -> str:
        """Look for topics, and subscribe once those that a run needs are there; call it a few times a second.

        Returns:
            What is still missing, as one sentence; empty if nothing is.

        Raises:
            WireError: several topics could play one role, or a configured one has another type.
        """
        found = tuple(p for p in self._participant.publications() if not p.topic.startswith(OWN))
        if found != self._known:
            self._known, self._changed_s = found, time.monotonic()
        self._subscribe_tf(found)
        selection = select_roles([TopicInfo(p.topic, p.message_type, 1) for p in found], self._config.topics)
        missing = self._missing(selection.roles)
        settled = time.monotonic() - self._changed_s >= SETTLED_S
        if self.roles:
            missing = ""
        elif missing or not settled:
            if settled and selection.problems and found:
                self._refuse(selection)
            return missing
        elif selection.problems:
            self._refuse(selection)
        if settled:
            self._subscribe(selection.roles, {p.topic: p.message_type for p in found})
        return missing

    def _missing(self, roles: Mapping[Role, str]) -> str:
        lacking = []
        if not set(MOTION) & roles.keys():
            lacking.append("odometry, joint states, commands or an IMU")
        wanted = [role for role in LOOK if getattr(self._config.topics, role) != "none"]
        if wanted and not set(wanted) & roles.keys():
            lacking.append("images or marker sightings")
        names = {p.topic for p in self._known}
        for role in (*MOTION, *LOOK, "camera_info"):
            given = getattr(self._config.topics, role)
            if given not in (None, "none") and given not in names:
                lacking.append(f"{given} (recording.topics.{role})")
        there = ", ".join(f"{p.topic} ({p.message_type})" for p in self._known) or "none"
        return f"Waiting for {' and '.join(lacking)}; topics there: {there}." if lacking else ""

    def _refuse(self, selection: Selection) -> None:
        """Ambiguous topics are an error, as in a recording; configured ones that are not there yet may come."""
        wrong = [p for p in selection.problems if "is not in the recording" not in p]
        if wrong:
            raise WireError("\n".join(wrong))

    def _subscribe(self, roles: Mapping[Role, str], types: Mapping[str, str]) -> None:
        """Read the topics of the roles that nothing plays yet."""
        for role, topic in roles.items():
            if role not in self.roles and topic not in self._role_of:
                self.roles[role] = topic
                self._role_of[topic] = role
                self._participant.read(topic, types[topic], self._on_sample)

    def _subscribe_tf(self, found: tuple[Publication, ...]) -> None:
        for publication in found:
            topic = publication.topic
            if publication.message_type in TF_TYPES and topic in _TF_TOPICS and topic not in self._role_of:
                self._role_of[topic] = None
                latched = topic == "/tf_static"
                self._participant.read(topic, publication.message_type, self._on_sample, latched)

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
            self._push(event)
