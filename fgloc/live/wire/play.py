"""A recording put on the wire with its recorded timing."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

from fgloc.errors import FglocError, WireError
from fgloc.live.wire.participant import CLOCK, CLOCK_TYPE, Participant, Writer
from fgloc.recording.messages import Messages, ros2_type
from fgloc.recording.storage import Channel, Storage

_TICK_S = 0.01  # time between two messages of /clock
_QUIET_S = 1.5  # readers that came one after the other have all come when no more came for this long
_FLUSH_S = 1.0  # for reliable readers to acknowledge the last messages


class Player:
    """Publishes a recording. Close it, or use it in a ``with``.

    Attributes:
        published: messages sent.
        damaged: messages that could not be converted.
        notes: what is not published, and why; what is wrong with the recording.
    """

    def __init__(self, path: Path, participant: Participant) -> None:
        """Open a recording and announce its topics.

        Raises:
            RecordingError: the recording cannot be read.
            WireError: none of its topics can be published.
        """
        self.path = path
        self._participant = participant
        self._storage = Storage(path)
        self._notes: list[str] = []
        self._writers: dict[tuple[str, str], tuple[Writer, Messages]] = {}
        self.published = 0
        self.damaged = 0
        for channel in self._storage.channels:
            if channel.count:
                self._announce(channel)
        if not self._writers:
            self.close()
            raise WireError(f"{path}: nothing to publish. {' '.join(self.notes)}")
        self._clock = None
        if not any(topic == CLOCK for topic, _ in self._writers):
            self._clock = participant.writer(CLOCK, CLOCK_TYPE)
        self._next_tick_s = 0.0

    def __enter__(self) -> Player:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the recording."""
        self._storage.close()

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user, one sentence each."""
        return (*self._storage.notes, *self._notes)

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last [s]."""
        start, end = self._storage.span_ns
        return (end - start) * 1e-9

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that are published, sorted."""
        return tuple(sorted(topic for topic, _ in self._writers))

    def wait_for_readers(self, timeout_s: float, stop: threading.Event | None = None) -> bool:
        """Wait until readers have come and no more come, and return whether they did; meanwhile /clock stands still."""
        stop = stop or threading.Event()
        began = changed = time.monotonic()
        known = 0
        while not stop.is_set() and (time.monotonic() - began < timeout_s or known):
            self._tick(self._storage.span_ns[0])
            readers = sum(writer.readers for writer, _ in self._writers.values())
            if readers != known:
                known, changed = readers, time.monotonic()
            if known and time.monotonic() - changed >= _QUIET_S:
                return True
            time.sleep(_TICK_S)
        return False

    def play(
        self,
        rate: float = 1.0,
        stop: threading.Event | None = None,
        progress: Callable[[float, float], None] | None = None,
    ) -> None:
        """Publish everything once.

        Args:
            rate: multiple of the recorded speed.
            stop: ends it early.
            progress: called with seconds done, and the recording's length.
        """
        stop = stop or threading.Event()
        start_ns = self._storage.span_ns[0]
        began = time.monotonic()
        for topic, message_type, received_ns, raw in self._storage.messages({topic for topic, _ in self._writers}):
            due = began + (received_ns - start_ns) * 1e-9 / rate
            while (ahead := due - time.monotonic()) > 0.0 and not stop.is_set():
                self._tick(start_ns + round((time.monotonic() - began) * rate * 1e9))
                time.sleep(min(ahead, max(0.0, self._next_tick_s - time.monotonic())))
            if stop.is_set():
                return
            self._tick(received_ns)
            self._publish(topic, message_type, received_ns, raw)
            if progress is not None:
                progress((received_ns - start_ns) * 1e-9, self.duration_s)

    def finish(self) -> None:
        """Wait until the readers have everything."""
        for writer, _ in self._writers.values():
            writer.flush(_FLUSH_S)

    def _announce(self, channel: Channel) -> None:
        try:
            messages = Messages.of_channel(channel, self._storage.kind == "ros1")
            latched = channel.topic == "/tf_static"
            writer = self._participant.writer(channel.topic, ros2_type(channel.message_type), latched, messages)
        except FglocError as error:
            self._notes.append(f"Not published: {channel.topic}: {error}.")
            return
        self._writers[channel.topic, channel.message_type] = writer, messages

    def _publish(self, topic: str, message_type: str, received_ns: int, raw: bytes) -> None:
        writer, messages = self._writers[topic, message_type]
        try:
            cdr = messages.to_cdr(message_type, raw)
        except Exception:  # rosbags leaks struct, decoding, key and assertion errors on damaged bytes
            self.damaged += 1
            return
        writer.write(cdr, received_ns)
        self.published += 1

    def _tick(self, now_ns: int) -> None:
        """Publish /clock if it is time to."""
        if time.monotonic() < self._next_tick_s:
            return
        self._next_tick_s = time.monotonic() + _TICK_S
        if self._clock is not None:
            stamp = {"sec": now_ns // 1_000_000_000, "nanosec": now_ns % 1_000_000_000}
            self._clock.write(self._participant.messages.encode(CLOCK_TYPE, {"clock": stamp}), now_ns)
