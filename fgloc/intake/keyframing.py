"""Cuts the stream of events into steps between keyframes, online and deterministically."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from fgloc.config import GateConfig, KeyframesConfig, camera_role
from fgloc.intake.clocks import ClockGuard, ClockNotes, ClockVerdict
from fgloc.sensors import registry
from fgloc.sensors.base import Stream
from fgloc.types import ControlEvent, Event, MotionEvent, SensorEvent, SightingsEvent, Step

# --- Events in order of stamp -----------------------------------------------------------------------------------------

E = TypeVar("E", bound=Event)


class EventBuffer(Generic[E]):
    """Events of one kind in order of stamp; ``stamps`` are theirs [ns]."""

    def __init__(self) -> None:
        """Start empty."""
        self.stamps: list[int] = []
        self._events: list[E] = []

    def insert(self, event: E) -> bool:
        """Put in order of stamp; False if the topic has a message of this stamp already."""
        stamp = event.stamp_ns
        if not self.stamps or stamp > self.stamps[-1]:
            self.stamps.append(stamp)
            self._events.append(event)
            return True
        at = bisect_right(self.stamps, stamp)
        k = at
        while k > 0 and self.stamps[k - 1] == stamp:
            k -= 1
            if self._events[k].topic == event.topic:
                return False
        self.stamps.insert(at, stamp)
        self._events.insert(at, event)
        return True

    def window(self, start_ns: int, end_ns: int, beyond: bool = True) -> tuple[E, ...]:
        """Events inside, the last one at or before the start and, if ``beyond``, the first one at or after the end."""
        first = max(bisect_right(self.stamps, start_ns) - 1, 0)
        last = bisect_left(self.stamps, end_ns) + 1 if beyond else bisect_right(self.stamps, end_ns)
        return tuple(self._events[first:last])

    def after(self, stamp_ns: int) -> int | None:
        """The first stamp later than this."""
        at = bisect_right(self.stamps, stamp_ns)
        return self.stamps[at] if at < len(self.stamps) else None

    def trim(self, start_ns: int) -> None:
        """Forget what no window from this start on needs."""
        first = bisect_right(self.stamps, start_ns) - 1
        if first > 0:
            del self.stamps[:first]
            del self._events[:first]

    def clear(self) -> None:
        """Forget all."""
        self.stamps.clear()
        self._events.clear()


# --- How late topics are ----------------------------------------------------------------------------------------------

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
        """Add a value at a time [ns]."""
        if now_ns - self.since_ns > _REMEMBERED_NS:
            twice = now_ns - self.since_ns > 2 * _REMEMBERED_NS
            self.before_ns, self.value_ns, self.since_ns = 0 if twice else self.value_ns, 0, now_ns
        self.value_ns = max(self.value_ns, value_ns)

    @property
    def ns(self) -> int:
        """Largest value remembered [ns]."""
        return max(self.value_ns, self.before_ns)


@dataclass(slots=True)
class Punctuality:
    """One topic's punctuality, as it is measured."""

    newest_ns: int
    heard_ns: int  # at its last message: how long events came in
    least_ns: int  # of `patience_ns`
    held: bool = False  # a message's value holds until the next
    late_ns: Peak = field(default_factory=Peak)  # by the newest stamp of all, of messages that came too late
    disorder_ns: Peak = field(default_factory=Peak)  # how far it has stepped back behind its own newest stamp
    lag_ns: Peak = field(default_factory=Peak)  # how far its messages were behind the newest stamp of all

    @property
    def patience_ns(self) -> int:
        """Time for which the topic is waited for, by the newest stamp of all [ns]."""
        return max(self.least_ns, min(5 * self.late_ns.ns // 4, MAX_PATIENCE_NS))

    @property
    def settled_ns(self) -> int:
        """After so long, by the newest stamp of all, nothing older of this topic is expected."""
        return max(_LEAST_SETTLED_NS, min(5 * self.lag_ns.ns // 4, MAX_PATIENCE_NS))


# --- Keyframes --------------------------------------------------------------------------------------------------------

_MAX_STEP_NS = 1_000_000_000  # motion models are made for steps up to this
_MOST_REACHED = 4096  # newest stamps that are remembered: 4 s of a busy robot
_ALIVE_NS = 2_000_000_000  # a source without messages for longer is not waited for ...
_SILENCE_NS = 500_000_000  # ... of which a silence of all sources counts no more than this
_WHOLE_NS = 10_000_000_000  # ... in a whole recording; there no keyframe waits for longer
_USED_LATE = (SightingsEvent, SensorEvent)


class KeyframeBuilder:
    """Turns gated events, in order of receipt, into contiguous steps.

    A keyframe is made at the stamp of each sightings event with a sighting, else every ``max_interval_s`` while a
    motion source sends (up to ``min_interval_s`` later, if a sighting is due then). Sightings closer than
    ``min_interval_s`` to the last keyframe, and late ones inside the lag, go with the next step at their own stamps.
    Where nothing was received, the step reaches to the next event, in pieces of at most 1 s.

    A keyframe is closed when every active source has sent at or beyond it, or ``reorder_s`` later by the newest
    stamp. A command holds until the next: of its topic nothing beyond the keyframe is needed, and it is waited for no
    longer than its messages have lately been behind those of other topics. Measured motion older than the last
    keyframe is lost ("late"), commands and sightings are not; their source is waited for longer in the next minute, up
    to 1 s. In a whole recording (not ``causal``) one that goes on within 10 s is waited for: wheel angles up to 5 s
    apart tell the motion between them. Clock jumps (see ``ClockGuard``) end the segment.

    The first step of a segment has ``start_ns == stamp_ns``. Depends on the events alone, never on the wall clock.
    ``rejections`` counts by "sensor.reason" with the reasons late, duplicate and future.
    """

    def __init__(
        self,
        config: KeyframesConfig,
        gate: GateConfig,
        lag_s: float,
        streams: Iterable[Stream] = (),
        named: Mapping[str, str] | None = None,
        causal: bool = True,
    ) -> None:
        """Start without events.

        Args:
            config: when keyframes are made.
            gate: what counts as a jump of the clock.
            lag_s: how late sightings may be and still be fused.
            streams: of registered sensors; their events go with the steps as sightings do.
            named: name of the camera of a topic, where there are several.
            causal: False: the recording is whole, and nobody waits for its steps.
        """
        self.rejections: Counter[str] = Counter()
        self._causal = causal
        self._min_ns = max(int(config.min_interval_s * 1e9), 1)
        self._max_ns = max(int(config.max_interval_s * 1e9), self._min_ns)
        self._reorder_ns = int(config.reorder_s * 1e9)
        self._history_ns = int(config.history_s * 1e9)
        self._lag_ns = int(lag_s * 1e9)
        self._clock = ClockGuard(gate)
        self._streams = {stream.event: stream for stream in streams}
        self._clock_notes = ClockNotes()
        self._named = named or {}
        self._index = 0
        self._segment = 0
        self._motion: dict[tuple[type[MotionEvent], str], EventBuffer[MotionEvent]] = {}  # by class of event and topic
        self._roles = {stream.event: stream.role for stream in (*registry.streams(), *self._streams.values())}
        self._reset()

    def _reset(self) -> None:
        """Begin a segment with nothing received."""
        for buffer in self._motion.values():
            buffer.clear()
        self._last_ns: int | None = None  # the last keyframe
        self._first_ns = 0  # the segment's first keyframe
        self._newest_ns = 0  # newest stamp
        self._received_ns = 0  # when the last event was received
        self._heard_ns = 0  # how long events came in, without the silences of all sources
        self._reached: deque[tuple[int, int]] = deque(maxlen=_MOST_REACHED)  # newest stamps of late, and when they came
        self._sources: dict[str, Punctuality] = {}
        self._pending: list[SightingsEvent | SensorEvent] = []  # that get a keyframe, by stamp
        self._carried: list[SensorEvent] = []  # that get none, by stamp
        self._seen: set[tuple[int, str]] = set()  # sightings of the lag
        self._seen_order: deque[tuple[int, str]] = deque()

    @property
    def newest_ns(self) -> int:
        """Newest stamp of the segment."""
        return self._newest_ns

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user so far, one sentence each."""
        notes = [*self._clock_notes.sentences]
        for topic, source in self._sources.items():
            if source.patience_ns > self._reorder_ns:
                notes.append(
                    f"{topic}: comes later than expert.keyframes.reorder_s after other sensors; waited for up to "
                    f"{source.patience_ns * 1e-9:.2f} s"
                )
        return tuple(notes)

    def push(self, event: Event) -> list[Step]:
        """Add the next event, in order of receipt, and return the steps that it completes (mostly none)."""
        if not isinstance(event, MotionEvent | SightingsEvent) and type(event) not in self._streams:
            return []
        return self._take(self._clock.judge(event))

    def flush(self) -> list[Step]:
        """The last steps of a recording: nothing more will come."""
        return self._take(self._clock.flush()) + self._finish()

    def _take(self, verdicts: list[tuple[ClockVerdict, Event]]) -> list[Step]:
        steps: list[Step] = []
        for verdict, event in verdicts:
            if verdict is ClockVerdict.OUTLIER:
                self._stray(event)
                continue
            if verdict is ClockVerdict.STARTS:
                steps += self._jump(event)
            self._insert(event)
            while (stamp_ns := self._candidate()) is not None and self._closed(stamp_ns):
                steps.append(self._step(stamp_ns))
        return steps

    # --- events in ---

    def _insert(self, event: Event) -> None:
        stamp = event.stamp_ns
        if stamp > self._newest_ns:
            self._newest_ns = stamp
            self._reached.append((stamp, event.received_ns))
        if self._received_ns:
            self._heard_ns += min(max(event.received_ns - self._received_ns, 0), _SILENCE_NS)
        self._received_ns = event.received_ns
        source = self._sources.get(event.topic)
        if source is None:
            held = isinstance(event, ControlEvent)
            source = self._sources[event.topic] = Punctuality(stamp, self._heard_ns, self._reorder_ns, held)
        elif stamp > source.newest_ns:
            source.newest_ns = stamp
        source.heard_ns = self._heard_ns
        source.disorder_ns.add(min(source.newest_ns - stamp, self._reorder_ns), self._newest_ns)
        late = self._last_ns is not None and stamp < self._last_ns
        late_ns = self._newest_ns - stamp if late else 0
        hopeless = late_ns > MAX_PATIENCE_NS and isinstance(event, _USED_LATE)  # they are used at whatever time
        source.late_ns.add(0 if hopeless else late_ns, self._newest_ns)
        source.lag_ns.add(self._newest_ns - stamp, self._newest_ns)
        if isinstance(event, _USED_LATE):
            self._insert_late(event)
            return
        assert isinstance(event, MotionEvent)
        if late and not (isinstance(event, ControlEvent) and late_ns < self._history_ns):
            self.rejections[f"{self._name(event)}.late"] += 1
        elif not self._motion.setdefault((type(event), event.topic), EventBuffer()).insert(event):
            self.rejections[f"{self._name(event)}.duplicate"] += 1

    def _insert_late(self, event: SightingsEvent | SensorEvent) -> None:
        """Keep what may be used after its keyframe."""
        if not isinstance(event, SensorEvent) and not event.sightings:
            return
        stamp, key = event.stamp_ns, (event.stamp_ns, event.topic)
        oldest = self._newest_ns - self._lag_ns
        while self._seen_order and self._seen_order[0][0] < oldest:
            self._seen.discard(self._seen_order.popleft())
        if stamp < oldest or (self._last_ns is not None and stamp < self._first_ns):
            self.rejections[f"{self._name(event)}.late"] += 1
        elif key in self._seen:
            self.rejections[f"{self._name(event)}.duplicate"] += 1
        else:
            self._seen.add(key)
            self._seen_order.append(key)
            if isinstance(event, SensorEvent) and not self._streams[type(event)].keyframe:
                insort(self._carried, event, key=lambda e: e.stamp_ns)
            else:
                insort(self._pending, event, key=lambda e: e.stamp_ns)

    def _name(self, event: Event) -> str:
        """Name of an event's role, for the rejections."""
        return camera_role(self._named.get(event.topic, ""), self._roles[type(event)])

    def _stray(self, event: Event) -> None:
        """An event far off the clock: a sighting may just be very late, the rest is lost."""
        ahead = event.stamp_ns - self._newest_ns
        if ahead > 0:
            self.rejections[f"{self._name(event)}.future"] += 1
            self._clock_notes.dropped(event.topic, ahead)
        elif isinstance(event, _USED_LATE):
            self._insert_late(event)
        else:
            self.rejections[f"{self._name(event)}.late"] += 1

    def _jump(self, event: Event) -> list[Step]:
        """End the segment; one that has not begun (its first stamps were wrong) is forgotten."""
        steps: list[Step] = []
        if self._last_ns is None:
            lost = sum(len(buffer.stamps) for buffer in self._motion.values()) + len(self._pending) + len(self._carried)
            self._clock_notes.jumped(
                f"{lost} message(s) before the first keyframe had stamps that nothing confirmed: dropped"
            )
        else:
            jump_s = (event.stamp_ns - self._newest_ns) * 1e-9
            steps = self._finish()
            self._segment += 1
            self._clock_notes.jumped(
                f"the clock jumped {'ahead' if jump_s > 0 else 'back'} by {abs(jump_s):.1f} s at "
                f"{event.stamp_ns * 1e-9:.3f} s: segment {self._segment} begins"
            )
        self._reset()
        return steps

    # --- steps out ---

    def _candidate(self) -> int | None:
        """Stamp at which the next keyframe is due [ns]; None if nothing calls for one."""
        last = self._last_ns
        if last is None:
            stamps = [buffer.stamps[0] for buffer in self._motion.values() if buffer.stamps]
            sightings = [event.stamp_ns for event in self._pending[:1]]
            first = min(stamps + sightings, default=None)
            return sightings[0] if first is not None and sightings and sightings[0] < first + self._min_ns else first
        if self._newest_ns < last + self._min_ns:
            return None
        at = bisect_left(self._pending, last + self._min_ns, key=lambda e: e.stamp_ns)
        sighting = self._pending[at].stamp_ns if at < len(self._pending) else None
        stamps = [stamp for buffer in self._motion.values() if (stamp := buffer.after(last)) is not None]
        due = max(min(stamps), last + self._max_ns) if stamps else None
        if sighting is not None and (due is None or sighting < due + self._min_ns):
            due = sighting
        if due is None:
            return None
        pieces = -((last - due) // _MAX_STEP_NS)
        return last + (due - last) // pieces

    def _closed(self, stamp_ns: int) -> bool:
        """Whether nothing before this time is still expected."""
        newest, waited_ns = self._newest_ns, self._waited(stamp_ns)
        if newest < stamp_ns + (self._reorder_ns if self._last_ns is None else 0):
            return False
        if not self._causal and newest >= stamp_ns + _WHOLE_NS:
            return True
        return all(
            source.newest_ns >= stamp_ns + source.disorder_ns.ns
            or (self._causal and newest >= stamp_ns + source.patience_ns and waited_ns >= source.patience_ns // 2)
            or (source.held and min(newest - stamp_ns, waited_ns) >= source.settled_ns)
            or self._ended(source)
            for source in self._sources.values()
        )

    def _ended(self, source: Punctuality) -> bool:
        """Whether a source has been silent for so long that it is not waited for."""
        alive_ns = _ALIVE_NS if self._causal else _WHOLE_NS
        return self._newest_ns > source.newest_ns + alive_ns and self._heard_ns - source.heard_ns >= _ALIVE_NS // 2

    def _waited(self, stamp_ns: int) -> int:
        """Time since this stamp was reached [ns], by receive times: after a stall, topics come one after another."""
        while len(self._reached) > 1 and self._reached[0][0] < stamp_ns:
            self._reached.popleft()
        return self._received_ns - self._reached[0][1] if self._reached else 0

    def _step(self, stamp_ns: int) -> Step:
        """Close the keyframe at this time."""
        start = stamp_ns if self._last_ns is None else self._last_ns
        handed = bisect_right(self._pending, stamp_ns, key=lambda e: e.stamp_ns)
        carried = bisect_right(self._carried, stamp_ns, key=lambda e: e.stamp_ns)
        step = Step(
            index=self._index,
            segment=self._segment,
            start_ns=start,
            stamp_ns=stamp_ns,
            motion=self._motion_of(start, stamp_ns),
            sightings=tuple(e for e in self._pending[:handed] if not isinstance(e, SensorEvent)),
            sensed=(
                *(e for e in self._pending[:handed] if isinstance(e, SensorEvent)),
                *self._carried[:carried],
            ),
        )
        del self._pending[:handed], self._carried[:carried]
        if self._last_ns is None:
            self._first_ns = stamp_ns
        self._last_ns = stamp_ns
        self._index += 1
        for (kind, _), buffer in self._motion.items():
            buffer.trim(stamp_ns - self._back_ns(kind))
        return step

    def _motion_of(self, start_ns: int, end_ns: int) -> dict[type[MotionEvent], tuple[MotionEvent, ...]]:
        """Events of a step by class, in order of stamp; of each topic those that it takes to integrate over it."""
        found: dict[type[MotionEvent], tuple[MotionEvent, ...]] = {}
        for (kind, _), buffer in self._motion.items():
            beyond = not issubclass(kind, ControlEvent)
            events = buffer.window(start_ns - self._back_ns(kind), end_ns, beyond)
            both = (*found[kind], *events) if kind in found else events
            found[kind] = both if both is events else tuple(sorted(both, key=lambda e: e.stamp_ns))
        return found

    def _back_ns(self, kind: type[MotionEvent]) -> int:
        """Span before a step for which events are kept [ns]."""
        return self._history_ns if issubclass(kind, ControlEvent) else 0

    def _finish(self) -> list[Step]:
        """Steps up to the newest event, without waiting for anything."""
        steps: list[Step] = []
        while (stamp_ns := self._candidate()) is not None:
            stamp_ns = min(stamp_ns, self._newest_kept())
            if self._last_ns is not None and stamp_ns < self._last_ns + self._min_ns:
                break
            steps.append(self._step(stamp_ns))
        if self._pending and self._last_ns is not None:  # too near to the last keyframe for one of their own
            steps.append(self._step(self._last_ns + self._min_ns))
        return steps

    def _newest_kept(self) -> int:
        stamps = [buffer.stamps[-1] for buffer in self._motion.values() if buffer.stamps]
        return max(stamps + [event.stamp_ns for event in self._pending[-1:]])
