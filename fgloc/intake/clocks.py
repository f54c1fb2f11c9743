"""Clocks: jumps of the one that all topics share, resets of a single topic's, and single wrong stamps."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from enum import Enum

from fgloc.config import GateConfig
from fgloc.types import Event, MotionEvent, RawEvent, SightingsEvent

# --- The common clock -------------------------------------------------------------------------------------------------

_LEAP_NS = (
    500_000_000  # a stamp further ahead than this needs confirmation, unless it is by four usual intervals at most
)
# and not further ahead of its time of receipt, by as much, than any before
_CONFIRM_COUNT = 3  # events that agree on a new time ...
_CONFIRM_NS = 250_000_000  # ... over this span confirm it ...
_CONFIRM_BACK_NS = 100_000_000  # ... and, of an earlier time, received over this: late messages come in a burst
_GIVE_UP_NS = 5_000_000_000  # after this span without motion messages, sightings alone confirm
_WINDOW_NS = 60_000_000_000  # events within it may agree with each other
_MAX_UNCONFIRMED = 1024


class ClockVerdict(Enum):
    """Verdict on the stamp of an event."""

    FITS = "belongs to the running clock"
    STARTS = "the first of a new segment: the clock has jumped"
    OUTLIER = "its stamp is wrong, or it is very late"


class ClockGuard:
    """Sorts events by whether their stamps fit the running clock.

    A stamp far ahead of the newest or far behind it is kept in a bounded queue until others agree with it (the clock
    has jumped, or all sensors had a gap) or until one arrives that fits the running clock (then it was an outlier).
    Where messages are rare, a stamp may be further ahead, but not of its own time of receipt by more than those before.
    Depends on the events and their order alone, so that a replay decides as the live run did.
    """

    def __init__(self, config: GateConfig) -> None:
        self._newest_ns = 0  # of the accepted stamps
        self._lead_ns: int | None = None  # largest stamp less time of receipt, of those
        self._started = False
        self._back_ns = int(config.clock_back_s * 1e9)
        self._jump_ns = int(config.clock_jump_s * 1e9)
        self._usual_ns = 0.0  # running mean of the newest stamp's advances
        self._motion = False  # a motion message has arrived on the running clock
        self._unconfirmed: deque[Event] = deque()
        self._newest_of: dict[str, int] = {}  # by topic, on the running clock

    def judge(self, event: Event) -> list[tuple[ClockVerdict, Event]]:
        """Verdicts that this event allows: on itself, on earlier ones that waited, on none yet."""
        ahead = event.stamp_ns - self._newest_ns
        overtaken = ahead < 0 and event.stamp_ns > self._newest_of.get(event.topic, event.stamp_ns)
        early = self._lead_ns is not None and -_delay(event) - self._lead_ns > _LEAP_NS
        usual = -self._back_ns <= ahead <= max(_LEAP_NS, 0.0 if early else 4.0 * self._usual_ns)
        if not self._started or overtaken or usual:
            outliers = [(ClockVerdict.OUTLIER, other) for other in self._unconfirmed]
            self._unconfirmed.clear()
            if not overtaken:
                self._advance_to(event)
            self._newest_of[event.topic] = max(event.stamp_ns, self._newest_of.get(event.topic, 0))
            return [*outliers, (ClockVerdict.FITS, event)]
        self._unconfirmed.append(event)
        group = [e for e in self._unconfirmed if self._agree(e, event)]
        span = max(e.stamp_ns for e in group) - min(e.stamp_ns for e in group)
        moves = not self._motion or any(isinstance(e, MotionEvent) for e in group)
        enough = span >= (_CONFIRM_NS if moves else _GIVE_UP_NS) and (
            ahead > 0 or max(e.received_ns for e in group) - min(e.received_ns for e in group) >= _CONFIRM_BACK_NS
        )
        if len(group) >= _CONFIRM_COUNT and enough:
            return self._accept(group)
        if len(self._unconfirmed) > _MAX_UNCONFIRMED:
            return [(ClockVerdict.OUTLIER, self._unconfirmed.popleft())]
        return []

    def flush(self) -> list[tuple[ClockVerdict, Event]]:
        """Verdicts on all that still waits: two that agree are accepted, as nothing more will come."""
        verdicts: list[tuple[ClockVerdict, Event]] = []
        while self._unconfirmed:
            last = self._unconfirmed[-1]
            group = [e for e in self._unconfirmed if self._agree(e, last)]
            if len(group) > 1:
                verdicts += self._accept(group)
            else:
                verdicts.append((ClockVerdict.OUTLIER, self._unconfirmed.pop()))
        return verdicts

    def _agree(self, event: Event, latest: Event) -> bool:
        """Whether both lie on the same side of the running clock and near each other."""
        same_side = (event.stamp_ns > self._newest_ns) == (latest.stamp_ns > self._newest_ns)
        return same_side and -_WINDOW_NS <= event.stamp_ns - latest.stamp_ns <= self._back_ns

    def _accept(self, group: list[Event]) -> list[tuple[ClockVerdict, Event]]:
        """Move the clock to the first of the group, and judge again all that waited."""
        first = min(group, key=lambda e: e.stamp_ns)
        waiting = [e for e in self._unconfirmed if e is not first]
        self._unconfirmed.clear()
        jumped = not 0 <= first.stamp_ns - self._newest_ns <= self._jump_ns
        if jumped:
            self._motion = False
            self._lead_ns = None
            self._newest_of.clear()
        self._advance_to(first)
        self._newest_of[first.topic] = first.stamp_ns
        verdicts = [(ClockVerdict.STARTS if jumped else ClockVerdict.FITS, first)]
        for event in waiting:
            verdicts += self.judge(event)
        return verdicts

    def _advance_to(self, event: Event) -> None:
        advance = event.stamp_ns - self._newest_ns if self._started else 0
        if advance < -self._back_ns:
            self._newest_ns = event.stamp_ns
        elif advance > 0 or not self._started:
            self._usual_ns += 0.1 * (min(advance, 2_000_000_000) - self._usual_ns)
            self._newest_ns = event.stamp_ns
        self._started = True
        self._lead_ns = -_delay(event) if self._lead_ns is None else max(self._lead_ns, -_delay(event))
        self._motion = self._motion or isinstance(event, MotionEvent)


_NAMED_JUMPS = 10  # the rest is counted
_FEWEST = 10  # dropped messages of a topic that are worth a sentence


class ClockNotes:
    """Collects jumps of the clock, and messages whose stamps lie ahead of the other sensors'."""

    def __init__(self) -> None:
        self._jumps: list[str] = []  # the first few ...
        self._jump_count = 0  # ... of so many
        self._ahead: dict[str, tuple[int, int]] = {}  # by topic: how many messages, offset of the last

    def jumped(self, note: str) -> None:
        """The clock jumped; ``note`` says when, and what became of it."""
        self._jump_count += 1
        if self._jump_count <= _NAMED_JUMPS:
            self._jumps.append(note)

    def dropped(self, topic: str, ahead_ns: int) -> None:
        """A message was dropped whose stamp lies ahead of the newest one."""
        self._ahead[topic] = self._ahead.get(topic, (0, 0))[0] + 1, ahead_ns

    @property
    def sentences(self) -> Iterator[str]:
        """Notes for the user so far, one sentence each."""
        yield from self._jumps
        if self._jump_count > _NAMED_JUMPS:
            yield f"the clock jumped {self._jump_count} times in all"
        for topic, (count, ahead_ns) in self._ahead.items():
            if count >= _FEWEST:
                yield (
                    f"{topic}: {count} messages were dropped, their stamps lie ahead of the other sensors' "
                    f"(the last by {ahead_ns * 1e-9:.2f} s): correct them with recording.stamp_offset_s, "
                    "or take the receive times of whichever clock is wrong with recording.received_stamps"
                )


# --- Clocks of single topics ------------------------------------------------------------------------------------------

_RESET_NS = 5_000_000_000  # a topic's delay that changes by more is not the network's
_COUNT = 3  # messages that agree on the new delay, before ...
_SPAN_NS = 200_000_000  # ... this long after the first of them another topic comes as usual: not just its last ones
_AGREE_NS = 500_000_000  # how much their delays may differ
_ALIVE_NS = 2_000_000_000  # a topic without messages for longer is no reference
_PATIENCE_NS = 3_000_000_000  # for how long messages are held back
_SHARE = 0.1  # of a new delay in the mean
_MOST_HELD = 5000  # messages of a source: 3 s of a fast sensor
_MOST_NAMES = 1000  # characters of a publisher's names that are kept
_MOST_SOURCES = 1000  # whose clocks are followed: joints may come under ever new names
_STAMPED = (MotionEvent, RawEvent, SightingsEvent)


Source = tuple[str, tuple[str, ...]]


def source_of(event: Event) -> Source:
    """The publisher of an event: of those that share a topic, which one. Long lists of names are a digest."""
    publisher = event.publisher if isinstance(event, MotionEvent) else ()
    if sum(map(len, publisher)) > _MOST_NAMES:
        publisher = (hashlib.sha256("\0".join(publisher).encode(errors="surrogatepass")).hexdigest(),)
    return event.topic, publisher


@dataclass(slots=True)
class _Clock:
    """Delay and offset of one source's stamps."""

    delay_ns: float  # usual receive time less stamp
    received_ns: int  # of the newest message
    offset_ns: int = 0  # added to its stamps
    held: list[Event] = field(default_factory=list)  # with another delay than usual

    def change_ns(self, event: Event) -> int:
        """Delay of a message beyond the usual one [ns]."""
        return _delay(event) - self.offset_ns - round(self.delay_ns)

    def begin_anew(self, event: Event) -> None:
        """Make the delay of this event the usual one."""
        self.delay_ns, self.offset_ns = _delay(event), 0


class TopicClocks:
    """Distinguishes the reset of one topic's clock from a jump of the clock that all share.

    A message whose delay (receive time less stamp) is far from its topic's usual one is held back until the next
    messages tell: the topic is alone with it (its stamps are corrected from then on), other topics have jumped too
    (`ClockGuard` begins a new segment), or it was a single wrong stamp. What comes with the usual delay passes
    unchanged. Depends on the events alone.
    """

    def __init__(self) -> None:
        """Start without any source."""
        self._clocks: dict[Source, _Clock] = {}
        self._jump_ns: int | None = None  # how much later than before the last common jump made messages seem
        self._resets: dict[str, tuple[int, int]] = {}  # by topic: how often, offset of the last [ns]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user so far, one sentence each."""
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
            released = self._make_room()
            self._clocks[source] = _Clock(delay, event.received_ns)
            return [*released, event]
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
        """Events that are still held back, at the end of the stream."""
        held = [e for clock in self._clocks.values() for e in clock.held]
        return sorted(held, key=lambda e: e.received_ns)

    def _make_room(self) -> list[Event]:
        """Forget the source that has been silent for longest if there are too many; return what was held of it."""
        if len(self._clocks) < _MOST_SOURCES:
            return []
        return self._clocks.pop(min(self._clocks, key=lambda source: self._clocks[source].received_ns)).held

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
        elif event.received_ns - held[0].received_ns > _PATIENCE_NS or len(held) >= _MOST_HELD:
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
