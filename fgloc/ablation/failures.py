"""Failures of messages, clocks, landmarks and several sensors, as filters of events that know nothing of the estimator.

Those of one sensor are in its module: `fgloc.sensors.gyro.ImuBias`, for example.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fgloc.config import Config
from fgloc.frames import rpy_matrix
from fgloc.sensors import registry
from fgloc.sensors.base import Joiner
from fgloc.sensors.failures import Carriage, Change, EventFailure, Failure, Scene, When, by_receipt
from fgloc.sensors.registry import SensorName, events_of
from fgloc.types import Event, LandmarkMap, RawEvent, Sighting, SightingsEvent

# --- Transport and clocks: lost, late, repeated messages; clocks that disagree ----------------------------------------


class Dropout(EventFailure):
    """A sensor has no messages: they are lost."""

    kind: Literal["dropout"] = "dropout"
    sensor: SensorName

    def targets(self) -> tuple[type[Event], ...]:
        """Classes of the sensor's messages."""
        return events_of(self.sensor)

    def begin(self, scene: Scene) -> Change:
        """Return the function that drops each message."""
        return lambda event: None


class ClockOffset(EventFailure):
    """A sensor's clock is ahead by ``offset_s`` and gains ``drift_ppm``: its stamps are wrong, its arrival is not."""

    sizes: ClassVar[tuple[str, ...]] = ("offset_s", "drift_ppm")
    kind: Literal["clock_offset"] = "clock_offset"
    sensor: SensorName
    offset_s: float = Field(0.1, description="s; negative: behind")
    drift_ppm: float = Field(0.0, description="µs gained per second since the start")

    def targets(self) -> tuple[type[Event], ...]:
        """Classes of the sensor's messages."""
        return events_of(self.sensor)

    def begin(self, scene: Scene) -> Change:
        """Return the function that moves the stamp of each message."""

        def change(event: Event) -> Event:
            moved = self.offset_s + self.drift_ppm * 1e-6 * scene.seconds(event)
            return replace(event, stamp_ns=event.stamp_ns + round(moved * 1e9)) if moved else event

        return change


class Latency(Failure):
    """A sensor's messages arrive late by ``delay_s`` and a further random part of ``jitter_s`` (uniform).

    With jitter longer than their period they arrive out of order. Stamps keep the time of measurement, unless
    ``stamped_on_arrival``: then they are late as well, and the sensor seems to lag. Commands that arrive late so are
    commands that the recorder received late, not commands that the robot followed late.
    """

    sizes: ClassVar[tuple[str, ...]] = ("delay_s", "jitter_s")
    kind: Literal["latency"] = "latency"
    sensor: SensorName
    delay_s: float = Field(0.0, ge=0, description="s")
    jitter_s: float = Field(0.0, ge=0, description="s, at most")
    stamped_on_arrival: bool = False

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The events in their new order of receipt."""
        schedule = self.when.schedule(scene)

        def delayed() -> Iterator[tuple[int, Event]]:
            for event in events:
                now_ns = event.received_ns
                if isinstance(event, events_of(self.sensor)) and schedule.hits(event):
                    late_ns = round((self.delay_s + self.jitter_s * scene.rng.uniform()) * 1e9)
                    if late_ns:
                        self.touch(scene)
                        stamp_ns = event.stamp_ns + (late_ns if self.stamped_on_arrival else 0)
                        event = replace(event, received_ns=now_ns + late_ns, stamp_ns=stamp_ns)
                yield now_ns, event

        return by_receipt(delayed())


class DuplicatedMessages(Failure):
    """A sensor's messages arrive twice, the copy ``after_s`` later with the same stamp."""

    kind: Literal["duplicated_messages"] = "duplicated_messages"
    sensor: SensorName
    after_s: float = Field(0.0, ge=0, description="s")

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The events with their copies."""
        schedule = self.when.schedule(scene)

        def doubled() -> Iterator[tuple[int, Event]]:
            for event in events:
                yield event.received_ns, event
                if isinstance(event, events_of(self.sensor)) and schedule.hits(event):
                    self.touch(scene)
                    yield event.received_ns, replace(event, received_ns=event.received_ns + round(self.after_s * 1e9))

        return by_receipt(doubled())


class Truncated(Failure):
    """The recording ends early: ``keep`` of its length is left, for the truth as well."""

    timed: ClassVar[bool] = False
    kind: Literal["truncated"] = "truncated"
    keep: float = Field(0.5, gt=0, le=1, description="share of the recording")

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The events up to the end."""
        for event in events:
            if scene.seconds(event) <= self.keep * scene.duration_s:
                yield event
            else:
                self.touch(scene)


# --- What is seen: markers hidden, misread, doubled, moved, or measured badly -----------------------------------------


class SightingFailure(EventFailure):
    """A failure that changes or hides single sightings; a message left empty stays, as a camera would send it."""

    stage: ClassVar[Literal["recorded", "sightings"]] = "sightings"

    def targets(self) -> tuple[type[Event], ...]:
        """Class of the messages with sightings."""
        return (SightingsEvent,)

    def begin(self, scene: Scene) -> Change:
        """Return the function that applies `alter` to each sighting of a message."""
        alter = self.alter(scene)

        def change(event: Event) -> Event | None:
            assert isinstance(event, SightingsEvent)
            after = tuple(s for s in map(alter, event.sightings) if s is not None)
            same = len(after) == len(event.sightings) and all(
                a is b for a, b in zip(after, event.sightings, strict=True)
            )
            return event if same else replace(event, sightings=after)

        return change

    @abstractmethod
    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """Return the function that changes one sighting, or hides it (None), with the state of one run."""


class SightingNoise(SightingFailure):
    """White noise, of the standard deviations below, on each number that a sighting reports."""

    sizes: ClassVar[tuple[str, ...]] = ("corner_px", "range_m", "bearing_rad", "position_m")
    kind: Literal["sighting_noise"] = "sighting_noise"
    corner_px: float = Field(0.0, ge=0, description="px, on each coordinate of each corner")
    range_m: float = Field(0.0, ge=0, description="m")
    bearing_rad: float = Field(0.0, ge=0, description="rad")
    position_m: float = Field(0.0, ge=0, description="m, on each coordinate of a marker pose")

    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """Add the noise of the sighting's kind."""
        sigmas = {name: getattr(self, name) for name in ("corner_px", "range_m", "bearing_rad", "position_m")}
        return lambda s: s.noisy(sigmas, scene.rng)


class OccludedIds(SightingFailure):
    """Markers are hidden: those of ``ids``, and a random ``part`` of the map's others, the same throughout a run."""

    sizes: ClassVar[tuple[str, ...]] = ("ids", "part")
    kind: Literal["occluded_ids"] = "occluded_ids"
    ids: tuple[int, ...] = ()
    part: float = Field(0.0, ge=0, le=1, description="share of the map's markers; the number is rounded")

    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """Hide the chosen ids."""
        others = [i for i in scene.landmark_ids if i not in self.ids]
        order = scene.rng.permutation(len(others))  # drawn whole: a larger part holds the smaller one
        hidden = {*self.ids, *(others[k] for k in order[: round(self.part * len(others))])}
        return lambda s: None if s.landmark_id in hidden else s


class WrongIds(SightingFailure):
    """A sighting is read as another marker of the map with probability ``probability``."""

    sizes: ClassVar[tuple[str, ...]] = ("probability",)
    kind: Literal["wrong_ids"] = "wrong_ids"
    probability: float = Field(0.05, ge=0, le=1, description="of each sighting")

    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """Draw another id of the map."""

        def misread(s: Sighting) -> Sighting:
            others = [i for i in scene.landmark_ids if i != s.landmark_id]
            if not others or scene.rng.uniform() >= self.probability:
                return s
            return replace(s, landmark_id=others[int(scene.rng.integers(len(others)))])

        return misread


class DuplicatedId(SightingFailure):
    """Two markers carry one id: the map's marker ``other`` reports as ``marker_id``; random ones where not given."""

    kind: Literal["duplicated_id"] = "duplicated_id"
    marker_id: int | None = None
    other: int | None = None

    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """Rename one marker."""
        free = [i for i in scene.landmark_ids if i not in (self.marker_id, self.other)]
        drawn = [free[k] for k in scene.rng.permutation(len(free))]
        kept = self.marker_id if self.marker_id is not None else next(iter(drawn), None)
        renamed = self.other if self.other is not None else next((i for i in drawn if i != kept), None)
        if kept is None or renamed is None:
            return lambda s: s
        return lambda s: replace(s, landmark_id=kept) if s.landmark_id == renamed else s


class MovedMarker(Failure):
    """Markers are not where the map has them, throughout the run.

    Each of ``ids`` (or ``count`` random markers) stands ``distance_m`` away in a random horizontal direction and turned
    by ``yaw_rad`` about the vertical. That the map is moved instead of the marker is the same to the robot: all of
    them ``together`` are a map that is shifted as a whole (each turns about itself).
    """

    timed: ClassVar[bool] = False
    sizes: ClassVar[tuple[str, ...]] = ("distance_m", "yaw_rad")
    kind: Literal["moved_marker"] = "moved_marker"
    ids: tuple[int, ...] = ()
    count: int = Field(1, ge=1, description="markers to be moved if no ids are given")
    distance_m: float = Field(0.3, ge=0, description="m")
    yaw_rad: float = Field(0.0, description="rad, counter-clockwise from above")
    together: bool = Field(False, description="all in the same direction")

    def apply(self, events: Any, scene: Scene) -> Any:
        """All events as they were."""
        return events

    def corrupt_map(self, landmark_map: LandmarkMap, scene: Scene) -> LandmarkMap:
        """The map with some markers elsewhere."""
        order = [scene.landmark_ids[k] for k in scene.rng.permutation(len(scene.landmark_ids))]
        chosen = set(self.ids) or set(order[: self.count])
        turn = rpy_matrix(0.0, 0.0, -self.yaw_rad)
        moved = dict(landmark_map.landmarks)
        direction = scene.rng.uniform(-np.pi, np.pi)
        for n, i in enumerate(sorted(chosen & set(moved))):
            if n > 0 and not self.together:
                direction = scene.rng.uniform(-np.pi, np.pi)
            shift = self.distance_m * np.array([np.cos(direction), np.sin(direction), 0.0])
            landmark = moved[i]
            rotation = turn @ landmark.rotation if landmark.size_m > 0 else landmark.rotation
            moved[i] = replace(landmark, position=landmark.position - shift, rotation=rotation)
            self.touch(scene)
        return replace(landmark_map, landmarks=moved)


# --- The robot is carried away: a piece of the recording is cut out ---------------------------------------------------


class _Pieces(Failure):
    """A failure of whole pieces of a recording, each with a beginning and an end; one at random without ``when``."""

    why: ClassVar[str]  # it needs them
    when: When = When(bursts=1)

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if self.when.share != 1.0 or not (self.when.intervals or self.when.bursts):
            raise ValueError(f"{self.why}: give 'when' intervals or bursts, and no share")
        return self


class Kidnap(_Pieces):
    """What was measured inside each interval is cut out, for all sensors and the truth, and the gap is closed.

    The robot goes on from where it was at the interval's end, although its odometry and wheel angles, moved to join on
    to their values before, measure no motion. The recording gets shorter by the length of the intervals. Unlike the
    other failures it goes by stamps, counted from the first message received, so that a late image stays with its time.
    Without ``when`` one piece of 5 s is cut out at random.
    """

    kind: Literal["kidnap"] = "kidnap"
    why: ClassVar[str] = "kidnap cuts whole pieces out"

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The events that are left, in order of receipt."""
        cuts = _merged([(_ns(a), _ns(b)) for a, b in self.when.schedule(scene).intervals])
        joined: dict[str, Joiner] = {}

        def kept() -> Iterator[tuple[int, Event]]:
            for event in events:
                received_ns = event.received_ns - scene.start_ns
                shift = _removed(cuts, event.stamp_ns - scene.start_ns)
                if shift is None:
                    self.touch(scene)
                    continue
                if (joiner := registry.joiner_of(event)) is not None:
                    event = joined.setdefault(event.topic, joiner())(event, shift)
                now_ns = event.received_ns - _removed_until(cuts, received_ns)
                if shift:
                    event = replace(event, stamp_ns=event.stamp_ns - shift, received_ns=event.received_ns - shift)
                yield now_ns, event

        return by_receipt(kept())


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def _merged(intervals: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Intervals in order, overlapping ones merged."""
    out: list[tuple[int, int]] = []
    for start, end in sorted(intervals):
        if out and start <= out[-1][1]:
            out[-1] = (out[-1][0], max(end, out[-1][1]))
        else:
            out.append((start, end))
    return out


def _removed_until(cuts: list[tuple[int, int]], at: int) -> int:
    """Time [ns] before ``at`` that is cut out."""
    return sum(min(end, at) - start for start, end in cuts if start < at)


def _removed(cuts: list[tuple[int, int]], at: int) -> int | None:
    """Time [ns] before ``at`` that is cut out; None if ``at`` itself is cut out."""
    return None if any(start <= at < end for start, end in cuts) else _removed_until(cuts, at)


# --- The robot is carried while the recording goes on -----------------------------------------------------------------


class Lift(_Pieces):
    """Inside each interval the robot is lifted, carried along the way that the recording drives, and set down.

    No time is cut out (`Kidnap` does that), and the truth stays: it is carried where it went, turning as it did.
    Wheels stand, or spin in the air at ``spin_m_s`` of their rims without load; commands are zero, or ask for that
    spinning. The IMU keeps its turning and its horizontal accelerations; added are the rise and descent by ``height_m``
    (minimum jerk, ``rise_s`` each), the bounce of a walking person, a tilt and the hands' sway. The IMU is taken to be
    level. Markers are hidden unless ``markers`` is "shown". Times are stamps, from the first message received.
    """

    kind: Literal["lift"] = "lift"
    why: ClassVar[str] = "lift needs a beginning and an end"
    wheels: Literal["still", "spin"] = "still"
    spin_m_s: float = Field(0.3, description="m/s, of the rims")
    markers: Literal["hidden", "shown"] = "hidden"
    height_m: float = Field(0.5, gt=0, description="m")
    rise_s: float = Field(1.0, gt=0, description="s")

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The events, in order of receipt."""
        spin = self.spin_m_s if self.wheels == "spin" else 0.0
        intervals = self.when.schedule(scene).intervals
        carriage = Carriage(intervals, spin, self.height_m, self.rise_s, scene)
        carried = registry.carried(carriage)
        for event in events:
            held = carriage.interval(event) is not None
            if (tell := carried.get(type(event))) is not None:
                changed: Event | None = tell(event)
            else:
                hidden = self.markers == "hidden" and isinstance(event, RawEvent | SightingsEvent)
                changed = None if held and hidden else event
            if changed is not event:
                self.touch(scene)
            if changed is not None:
                yield changed


# --- Chains of failures -----------------------------------------------------------------------------------------------

_OF_ANY_SENSOR = (
    Dropout,
    SightingNoise,
    OccludedIds,
    WrongIds,
    DuplicatedId,
    MovedMarker,
    Latency,
    ClockOffset,
    DuplicatedMessages,
    Truncated,
    Kidnap,
    Lift,
)
if TYPE_CHECKING:
    AnyFailure = Failure
else:
    AnyFailure = Annotated[reduce(or_, (*_OF_ANY_SENSOR, *registry.failures())), Field(discriminator="kind")]
    """Any failure by its ``kind``: those of any sensor, and those that the installed sensors bring."""


def corrupt(
    failures: Sequence[Failure],
    stage: Literal["recorded", "sightings"],
    events: Iterator[Event],
    scenes: Sequence[Scene],
) -> Iterator[Event]:
    """Events after all failures of a stage, applied one after the other.

    Args:
        failures: in the order in which they act.
        stage: of the events.
        events: in order of receive time.
        scenes: one per failure.
    """
    for failure, scene in zip(failures, scenes, strict=True):
        if failure.stage == stage:
            events = failure.apply(events, scene)
    return events


def generators(count: int, seed: int) -> list[np.random.Generator]:
    """One generator per failure of a chain: what one draws does not depend on the others."""
    return [np.random.default_rng([seed, index]) for index in range(count)]


class Corruption:
    """Effects of a chain of failures on one run: on its map first, then on its events at either stage."""

    def __init__(
        self,
        failures: Sequence[Failure],
        span: tuple[int, float],
        config: Config,
        landmark_map: LandmarkMap | None = None,
        seed: int = 0,
    ) -> None:
        """Draw nothing yet.

        Args:
            failures: in the order in which they act.
            span: receive time of the recording's first message [ns], and its length [s].
            config: of the run.
            landmark_map: its map; None: there is none.
            seed: of what is random.
        """
        ids = () if landmark_map is None else tuple(sorted(landmark_map.landmarks))
        self._failures = failures
        self._scenes = [Scene(*span, config, ids, rng) for rng in generators(len(failures), seed)]

    def corrupt_map(self, landmark_map: LandmarkMap) -> LandmarkMap:
        """The map after all failures, itself where none changes it; to be called before the events are."""
        for failure, scene in zip(self._failures, self._scenes, strict=True):
            landmark_map = failure.corrupt_map(landmark_map, scene)
        return landmark_map

    def recorded(self, events: Iterator[Event]) -> Iterator[Event]:
        """Recorded events after the failures of that stage."""
        return corrupt(self._failures, "recorded", events, self._scenes)

    def sightings(self, events: Iterator[Event]) -> Iterator[Event]:
        """Events with markers found in images, after the failures of that stage."""
        return corrupt(self._failures, "sightings", events, self._scenes)

    @property
    def affected(self) -> Counter[str]:
        """Events that the failures changed, dropped or added, by kind."""
        return sum((scene.affected for scene in self._scenes), Counter())
