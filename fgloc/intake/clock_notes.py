"""What the user is told of clocks that jumped or differ."""

from __future__ import annotations

from collections.abc import Iterator

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
        """What the user should know so far."""
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
