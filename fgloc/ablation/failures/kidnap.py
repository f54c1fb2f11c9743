"""The robot is carried away: a piece of the recording is cut out, and only the sightings show it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

from pydantic import model_validator

from fgloc.sensors import registry
from fgloc.sensors.base import Joined
from fgloc.sensors.failures import Failure, Scene, When, by_receipt
from fgloc.types import Event


class Kidnap(Failure):
    """What was measured inside each interval is cut out, for all sensors and the truth, and the gap is closed.

    The robot goes on from where it was at the interval's end, although its odometry and wheel angles, moved to join on
    to their values before, measure no motion. The recording gets shorter by the length of the intervals. Unlike the
    other failures it goes by stamps, counted from the first message received, so that a late image stays with its time.
    Without ``when`` one piece of 5 s is cut out at random.
    """

    kind: Literal["kidnap"] = "kidnap"
    when: When = When(bursts=1)

    @model_validator(mode="after")
    def _bounded(self) -> Kidnap:
        if self.when.share != 1.0 or not (self.when.intervals or self.when.bursts):
            raise ValueError("kidnap cuts whole pieces out: give 'when' intervals or bursts, and no share")
        return self

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The events that are left, in order of receipt."""
        cuts = _merged([(_ns(a), _ns(b)) for a, b in self.when.schedule(scene).intervals])
        joined: dict[str, Joined] = {}

        def kept() -> Iterator[tuple[int, Event]]:
            for event in events:
                received_ns = event.received_ns - scene.start_ns
                shift = _removed(cuts, event.stamp_ns - scene.start_ns)
                if shift is None:
                    self.touch(scene)
                    continue
                if (joiner := registry.joiner_of(event)) is not None:
                    event = joined.setdefault(event.topic, joiner()).join(event, shift)
                now_ns = event.received_ns - _removed_until(cuts, received_ns)
                if shift:
                    event = replace(event, stamp_ns=event.stamp_ns - shift, received_ns=event.received_ns - shift)
                yield now_ns, event

        return by_receipt(kept())


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def _merged(intervals: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The intervals in order, those that overlap as one."""
    out: list[tuple[int, int]] = []
    for start, end in sorted(intervals):
        if out and start <= out[-1][1]:
            out[-1] = (out[-1][0], max(end, out[-1][1]))
        else:
            out.append((start, end))
    return out


def _removed_until(cuts: list[tuple[int, int]], at: int) -> int:
    """How much of the time before ``at`` is cut out."""
    return sum(min(end, at) - start for start, end in cuts if start < at)


def _removed(cuts: list[tuple[int, int]], at: int) -> int | None:
    """The same; None if ``at`` is cut out itself."""
    return None if any(start <= at < end for start, end in cuts) else _removed_until(cuts, at)
