"""What time it is on the wire: simulation time where there is a /clock, else the machine's."""

from __future__ import annotations

import threading
import time

from fgloc.live.wire.participant import Participant, Sample

TOPIC = "/clock"
TYPE = "rosgraph_msgs/msg/Clock"
_ALIKE_NS = 1_000_000_000  # clocks closer than this are one clock: ROS counts on it between machines


class WireClock:
    """Follows /clock from its first message on."""

    def __init__(self, participant: Participant) -> None:
        """Subscribe."""
        self._messages = participant.messages
        self._lock = threading.Lock()
        self._simulated_ns: int | None = None
        participant.read(TOPIC, TYPE, self._on_clock)

    @property
    def simulated(self) -> bool:
        """Whether there is a /clock."""
        return self._simulated_ns is not None

    def now_ns(self) -> int:
        """The time. Simulation time stands still between messages, as in ROS."""
        with self._lock:
            return time.time_ns() if self._simulated_ns is None else self._simulated_ns

    def received_ns(self, sample: Sample) -> int:
        """When a message came.

        That is when it was written, which neither the network nor a busy processor delays, if its writer has our clock:
        simulation time (as `fgloc play` has it; other players and simulators write by the machine's clock), or the
        machine's.
        """
        now = self.now_ns()
        apart = abs(sample.source_ns - now)
        ours = apart <= abs(sample.source_ns - time.time_ns()) if self.simulated else apart < _ALIKE_NS
        return sample.source_ns if ours else now

    def _on_clock(self, sample: Sample) -> None:
        stamp = self._messages.decode(TYPE, sample.cdr).clock
        with self._lock:
            self._simulated_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
