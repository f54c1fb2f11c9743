"""Base of the failures of sensors: when they are active, what they know of the run, and how they pass events on."""

from __future__ import annotations

import heapq
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from fgloc.config import Config, Section
from fgloc.types import Event, LandmarkMap


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Facts of the run that a failure corrupts.

    Attributes:
        start_ns: receive time of the recording's first message.
        duration_s: length of the recording [s].
        config: of the run; slip needs the wheels' geometry.
        landmark_ids: ids of the map, ascending.
        rng: the failure's own generator.
        affected: events that each failure changed, dropped or added, by its kind.
    """

    start_ns: int
    duration_s: float
    config: Config
    landmark_ids: tuple[int, ...]
    rng: np.random.Generator
    affected: Counter[str] = field(default_factory=Counter)

    def seconds(self, event: Event) -> float:
        """Receive time of an event [s from the recording's first message]."""
        return (event.received_ns - self.start_ns) * 1e-9


_LARGEST = 1e6  # of any number of a failure: seconds, metres, pixels, parts per million


def _numbers(value: object) -> Iterator[float]:
    """All numbers in nested values."""
    if isinstance(value, Mapping):
        value = tuple(value.values())
    if isinstance(value, list | tuple | set | frozenset):
        for part in value:
            yield from _numbers(part)
    elif isinstance(value, int | float):
        yield value


class When(Section):
    """When a failure is active, in seconds of receive time from the recording's first message.

    Without intervals and bursts it is active throughout. Bursts are placed at random: for one seed their centers stay
    where they are when their length is varied.
    """

    intervals: tuple[tuple[float, float], ...] = Field((), description="from and until [s]")
    bursts: int = Field(0, ge=0, le=10_000, description="further intervals, placed at random")
    burst_s: float = Field(5.0, gt=0, description="length of each [s]")
    after_s: float = Field(0.0, ge=0, description="no burst begins before this [s]")
    share: float = Field(1.0, ge=0, le=1, description="of the messages inside, chosen at random one by one")

    @model_validator(mode="after")
    def _ordered(self) -> When:
        for start, end in self.intervals:
            if not start < end:
                raise ValueError(f"interval {start:g} to {end:g} s is empty; expected its start before its end")
        return self

    def schedule(self, scene: Scene) -> Schedule:
        """Draw the times of one run."""
        intervals = list(self.intervals)
        if self.bursts:
            half = 0.5 * self.burst_s
            free_s = max(0.0, scene.duration_s - self.after_s - self.burst_s)
            centers = self.after_s + half + free_s * scene.rng.uniform(size=self.bursts)
            intervals += [(float(c) - half, float(c) + half) for c in centers]
        elif not intervals:
            intervals = [(-np.inf, np.inf)]
        return Schedule(tuple(intervals), self.share, scene)


class Schedule:
    """The times at which a failure is active in one run."""

    def __init__(self, intervals: tuple[tuple[float, float], ...], share: float, scene: Scene) -> None:
        self.intervals = intervals
        self._share = share
        self._scene = scene

    def inside(self, event: Event) -> tuple[float, float] | None:
        """The interval that contains the event, whether or not chance picks it."""
        seconds = self._scene.seconds(event)
        return next(((a, b) for a, b in self.intervals if a <= seconds < b), None)

    def hits(self, event: Event) -> bool:
        """Whether the failure takes this event. Draws once for every event inside an interval: ask once."""
        return self.inside(event) is not None and (self._share >= 1.0 or self._scene.rng.uniform() < self._share)


Change = Callable[[Event], Event | None]


class Failure(Section):
    """One way in which sensors fail: a filter of events, drawn anew for each run from the scene's generator.

    Failures of stage "sightings" act once markers are found: after detection, or on recorded sightings. No failure
    touches the truth or the transforms, save that the recording ends early (truncated) or lacks a piece
    (kidnap) for all.
    """

    stage: ClassVar[Literal["recorded", "sightings"]] = "recorded"
    timed: ClassVar[bool] = True  # False: lasts the whole run, `when` is refused
    pixels: ClassVar[bool] = False  # True: changes what an image shows
    sizes: ClassVar[tuple[str, ...]] = ()  # numbers that, if all are 0, make it change nothing
    kind: str
    when: When = When()

    @model_validator(mode="after")
    def _lasting(self) -> Failure:
        if not self.timed and self.when != When():
            raise ValueError(f"{self.kind} lasts the whole run; leave out its 'when'")
        return self

    @model_validator(mode="after")
    def _plausible(self) -> Failure:
        for value in _numbers(self.model_dump()):
            if abs(value) > _LARGEST:
                raise ValueError(f"{self.kind} has the number {value:g}, expected none beyond {_LARGEST:g}")
        return self

    @abstractmethod
    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The corrupted events, in order of receive time."""

    def corrupt_map(self, landmark_map: LandmarkMap, scene: Scene) -> LandmarkMap:
        """The map that the run is given; few failures change it."""
        return landmark_map

    def touch(self, scene: Scene) -> None:
        """Note that one more event was affected."""
        scene.affected[self.kind] += 1


class EventFailure(Failure):
    """A failure that changes or drops events one by one and leaves their order alone.

    A subclass gives `change` or, if it has a state of one run, `begin`; and `changes`, or `targets` by its settings.
    """

    changes: ClassVar[tuple[type[Event], ...]] = ()  # classes of events

    def targets(self) -> tuple[type[Event], ...]:
        """Classes of the events that the failure changes."""
        return self.changes

    def begin(self, scene: Scene) -> Change:
        """Return the function that changes one event (None: drops it), with the state of one run."""
        return lambda event: self.change(event, scene)

    def change(self, event: Any, scene: Scene) -> Event | None:
        """The event, changed; None: it is dropped."""
        raise NotImplementedError

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The corrupted events, in order of receive time."""
        schedule, change, targets = self.when.schedule(scene), self.begin(scene), self.targets()
        for event in events:
            if not isinstance(event, targets) or not schedule.hits(event):
                yield event
                continue
            changed = change(event)
            if changed is not event:
                self.touch(scene)
            if changed is not None:
                yield changed


def by_receipt(events: Iterator[tuple[int, Event]]) -> Iterator[Event]:
    """Sort events, each given with the time before which nothing more will arrive."""
    waiting: list[tuple[int, int, Event]] = []
    order = count()
    for now_ns, event in events:
        heapq.heappush(waiting, (event.received_ns, next(order), event))
        while waiting and waiting[0][0] < now_ns:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]


@dataclass(frozen=True, slots=True, eq=False)
class Carriage:
    """Intervals and manner in which a robot is carried; each sensor defines what it then measures (`BuiltIn.carried`).

    Attributes:
        intervals: from when until when it is in the air [s].
        spin_m_s: speed of the wheels' rims in the air.
        height_m: to which it is lifted.
        rise_s: that lifting and setting down take.
        scene: of the run.
    """

    intervals: tuple[tuple[float, float], ...]
    spin_m_s: float
    height_m: float
    rise_s: float
    scene: Scene

    def interval(self, event: Event) -> tuple[float, float] | None:
        """The interval in which an event was measured; None: on the floor."""
        t = self.seconds(event)
        return next(((a, b) for a, b in self.intervals if a <= t < b), None)

    def seconds(self, event: Event) -> float:
        """Stamp of an event [s from the recording's first message]."""
        return (event.stamp_ns - self.scene.start_ns) * 1e-9
