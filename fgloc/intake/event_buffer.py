"""Events in order of stamp."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import Generic, TypeVar

from fgloc.types import Event

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
