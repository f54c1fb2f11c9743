"""One publisher was restarted and its clock with it: its stamps are put back on the clock of the others."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

from fgloc.types import Event, MotionEvent, RawEvent, SightingsEvent

_RESET_NS = 5_000_000_000  # a topic's delay that changes by more is not the network's
_COUNT = 3  # messages that agree on the new delay, before ...
_SPAN_NS = 200_000_000  # ... this long after the first of them another topic comes as usual: not just its last ones
_AGREE_NS = 500_000_000  # how much their delays may differ
_ALIVE_NS = 2_000_000_000  # a topic without messages for longer is no reference
_PATIENCE_NS = 3_000_000_000  # for how long messages are held back
_SHARE = 0.1  # of a new delay in the mean
_STAMPED = (MotionEvent, RawEvent, SightingsEvent)


Source = tuple[str, tuple[str, ...]]


def source_of(event: Event) -> Source:
    """The publisher of an event: of those that share a topic, which one."""
    return event.topic, event.publisher if isinstance(event, MotionEvent) else ()


@dataclass(slots=True)
class _Clock:
    """What is known of one source's stamps."""

    delay_ns: float  # usual receive time less stamp
    received_ns: int  # of the newest message
    offset_ns: int = 0  # added to its stamps
    held: list[Event] = field(default_factory=list)  # with another delay than usual

    def change_ns(self, event: Event) -> int:
        """How much later than usual a message seems."""
        return _delay(event) - self.offset_ns - round(self.delay_ns)

    def begin_anew(self, event: Event) -> None:
        """Take its delay for the usual one."""
        self.delay_ns, self.offset_ns = _delay(event), 0


class TopicClocks:
    """Tells the reset of one topic's clock from a jump of the clock that all share.

    A message whose delay (receive time less stamp) is far from its topic's usual one is held back until the next
    messages tell: the topic is alone with it (its stamps are corrected from then on), other topics have jumped too
    (`ClockGuard` begins a new segment), or it was a single wrong stamp. What comes with the usual delay passes
    unchanged. Depends on the events alone.
    """

    def __init__(self) -> None:
        """Nothing has come in."""
        self._clocks: dict[Source, _Clock] = {}
        self._jump_ns: int | None = None  # how much later than before the last common jump made messages seem
        self._resets: dict[str, tuple[int, int]] = {}  # by topic: how often, offset of the last [ns]

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know so far, one sentence each."""
        return tuple(
            f"{topic}: its clock alone was reset {count} time(s), as when its publisher is restarted; its stamps are "
            f"corrected by {offset_ns * 1e-9:+.3f} s, to its usual delay"
            for topic, (count, offset_ns) in self._resets.items()
        )

    def correct(self, event: Event) -> list[Event]:
        """Events that may pass, in order of receipt: mostly this one."""
        if not isinstance(event, _STAMPED):
            return [event]
        source = source_of(event)
        clock = self._clocks.get(source)
        delay = event.received_ns - event.stamp_ns
        if clock is None:
            self._clocks[source] = _Clock(delay, event.received_ns)
            return [event]
        clock.received_ns = event.received_ns
        delay -= clock.offset_ns
        if abs(delay - clock.delay_ns) <= _RESET_NS:
            clock.delay_ns += _SHARE * (delay - clock.delay_ns)
            released, clock.held = clock.held, []  # single wrong stamps
            released += self._witnessed(event.received_ns)
            return [*released, _shifted(event, clock.offset_ns)]
        return list(self._suspect(clock, event))

    def corrected(self, events: Iterable[Event]) -> Iterator[Event]:
        """All events of a recording."""
        for event in events:
            yield from self.correct(event)
        yield from self.flush()

    def flush(self) -> list[Event]:
        """What is still held back: nothing more will come."""
        held = [e for clock in self._clocks.values() for e in clock.held]
        return sorted(held, key=lambda e: e.received_ns)

    def _suspect(self, clock: _Clock, event: Event) -> Iterator[Event]:
        held = clock.held
        if held and abs(_delay(event) - _delay(held[-1])) > _AGREE_NS:
            yield from held
            held.clear()
        held.append(event)
        if self._jump_ns is not None and abs(clock.change_ns(event) - self._jump_ns) <= _AGREE_NS:
            clock.begin_anew(event)
            yield from held
            held.clear()
        elif self._all_jumped(event.received_ns):
            yield from self._jump()
        elif event.received_ns - held[0].received_ns > _PATIENCE_NS:
            yield from held
            held.clear()

    def _witnessed(self, now_ns: int) -> list[Event]:
        """A topic came with its usual delay: one that has been held for a while is alone with its own."""
        released: list[Event] = []
        for clock in self._clocks.values():
            if len(clock.held) >= _COUNT and now_ns - clock.held[0].received_ns >= _SPAN_NS:
                released += self._rebase(clock)
        return released

    def _rebase(self, clock: _Clock) -> list[Event]:
        """Correct a topic's stamps so that its delay is the usual one again."""
        mean = sum(_delay(e) for e in clock.held) // len(clock.held)
        clock.offset_ns = mean - round(clock.delay_ns)
        topic = clock.held[0].topic
        self._resets[topic] = (self._resets.get(topic, (0, 0))[0] + 1, clock.offset_ns)
        released, clock.held = [_shifted(e, clock.offset_ns) for e in clock.held], []
        return released

    def _all_jumped(self, now_ns: int) -> bool:
        """Whether every topic that has messages is held back."""
        return all(c.held for c in self._clocks.values() if now_ns - c.received_ns < _ALIVE_NS)

    def _jump(self) -> Iterator[Event]:
        """The clock that topics share has jumped: what is held is the new usual."""
        held = self.flush()
        for clock in self._clocks.values():
            if clock.held:
                self._jump_ns = clock.change_ns(clock.held[-1])
                clock.begin_anew(clock.held[-1])
                clock.held = []
        yield from held


def _delay(event: Event) -> int:
    return event.received_ns - event.stamp_ns


def _shifted(event: Event, offset_ns: int) -> Event:
    return replace(event, stamp_ns=event.stamp_ns + offset_ns) if offset_ns else event
