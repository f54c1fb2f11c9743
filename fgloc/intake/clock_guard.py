"""Which stamps are right: jumps of the clock against single wrong stamps."""

from __future__ import annotations

from collections import deque
from enum import Enum

from fgloc.config import GateConfig
from fgloc.types import Event, MotionEvent

_LEAP_NS = 500_000_000  # a stamp further ahead than this, and than four usual intervals, needs confirmation
_CONFIRM_COUNT = 3  # events that agree on a new time ...
_CONFIRM_NS = 250_000_000  # ... over this span confirm it ...
_CONFIRM_BACK_NS = 100_000_000  # ... and, of an earlier time, received over this: late messages come in a burst
_GIVE_UP_NS = 5_000_000_000  # after this span without motion messages, sightings alone confirm
_WINDOW_NS = 60_000_000_000  # events within it may agree with each other
_MAX_UNCONFIRMED = 1024


class ClockVerdict(Enum):
    """What an event is."""

    FITS = "belongs to the running clock"
    STARTS = "the first of a new segment: the clock has jumped"
    OUTLIER = "its stamp is wrong, or it is very late"


class ClockGuard:
    """Sorts events by whether their stamps fit the running clock.

    A stamp far ahead of the newest or far behind it is kept in a bounded queue until others agree with it (the clock
    has jumped, or all sensors had a gap) or until one arrives that fits the running clock (then it was an outlier).
    Depends on the order of events alone, so that a replay decides as the live run did.
    """

    def __init__(self, config: GateConfig) -> None:
        self._newest_ns = 0  # of the accepted stamps
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
        if not self._started or overtaken or -self._back_ns <= ahead <= max(_LEAP_NS, 4.0 * self._usual_ns):
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
        self._motion = self._motion or isinstance(event, MotionEvent)
