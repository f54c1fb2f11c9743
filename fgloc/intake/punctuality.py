"""How late and how disordered a topic is, as it is measured: by this the reordering buffer waits."""

from __future__ import annotations

from dataclasses import dataclass, field

MAX_PATIENCE_NS = 1_000_000_000
_LEAST_SETTLED_NS = 10_000_000  # a message of any topic may be this late: threads and networks take turns
_REMEMBERED_NS = 60_000_000_000  # for so long it is remembered how late a topic was


@dataclass(slots=True)
class Peak:
    """Largest value of late: of the running minute and of the one before it."""

    value_ns: int = 0
    before_ns: int = 0
    since_ns: int = 0

    def add(self, value_ns: int, now_ns: int) -> None:
        """Take in a value at a time [ns]."""
        if now_ns - self.since_ns > _REMEMBERED_NS:
            twice = now_ns - self.since_ns > 2 * _REMEMBERED_NS
            self.before_ns, self.value_ns, self.since_ns = 0 if twice else self.value_ns, 0, now_ns
        self.value_ns = max(self.value_ns, value_ns)

    @property
    def ns(self) -> int:
        """That value [ns]."""
        return max(self.value_ns, self.before_ns)


@dataclass(slots=True)
class Punctuality:
    """One topic's punctuality, as it is measured."""

    newest_ns: int
    received_ns: int  # of its last message
    least_ns: int  # of `patience_ns`
    held: bool = False  # a message's value holds until the next
    late_ns: Peak = field(default_factory=Peak)  # by the newest stamp of all, of messages that came too late
    disorder_ns: Peak = field(default_factory=Peak)  # how far it has stepped back behind its own newest stamp
    lag_ns: Peak = field(default_factory=Peak)  # how far its messages were behind the newest stamp of all

    @property
    def patience_ns(self) -> int:
        """How long, by the newest stamp of all, its word is waited for."""
        return max(self.least_ns, min(5 * self.late_ns.ns // 4, MAX_PATIENCE_NS))

    @property
    def settled_ns(self) -> int:
        """After so long, by the newest stamp of all, nothing older of this topic is expected."""
        return max(_LEAST_SETTLED_NS, min(5 * self.lag_ns.ns // 4, MAX_PATIENCE_NS))
