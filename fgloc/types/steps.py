"""A step: all events between two keyframes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from fgloc.types.events import ControlEvent, InertialEvent, MotionEvent, SensorEvent, SightingsEvent

M = TypeVar("M", bound=MotionEvent)


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)  # sensors remember what they made of it
class Step:
    """All that was received between two keyframes, gated and in order of stamp.

    Each tuple of ``motion`` holds what is needed to integrate over ``[start_ns, stamp_ns]``: the events inside, the
    last one at or before the start, and the first one at or after the end where known. Control inputs reach back
    ``history_s`` further. ``sightings`` were made at ``stamp_ns`` (the keyframe) or, arriving late, at their own stamps
    in the lag.
    """

    index: int
    segment: int  # counts up where the clock jumped; a new segment shares no motion with the one before
    start_ns: int
    stamp_ns: int
    motion: Mapping[type[MotionEvent], tuple[MotionEvent, ...]] = field(default_factory=dict)  # by class of event
    sightings: tuple[SightingsEvent, ...] = ()
    sensed: tuple[SensorEvent, ...] = ()  # of registered sensors, at their own stamps like late sightings

    @property
    def dt(self) -> float:
        """Length [s]."""
        return (self.stamp_ns - self.start_ns) * 1e-9

    def of(self, kind: type[M]) -> tuple[M, ...]:
        """The motion events of a class, or of the one class derived from it that the robot has."""
        for made, events in self.motion.items():
            if issubclass(made, kind):
                return events  # type: ignore[return-value]
        return ()

    @property
    def controls(self) -> tuple[ControlEvent, ...]:
        """Control inputs."""
        return self.of(ControlEvent)

    @property
    def inertial(self) -> tuple[InertialEvent, ...]:
        """Of the inertial unit."""
        return self.of(InertialEvent)


def by_class(events: Iterable[MotionEvent]) -> dict[type[MotionEvent], tuple[MotionEvent, ...]]:
    """Motion events as a step holds them, in the order in which they are given."""
    made: dict[type[MotionEvent], list[MotionEvent]] = {}
    for event in events:
        made.setdefault(type(event), []).append(event)
    return {kind: tuple(same) for kind, same in made.items()}
