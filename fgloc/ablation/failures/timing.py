"""Failures of transport and clocks: lost, late, repeated messages; clocks that disagree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar, Literal

from pydantic import Field

from fgloc.sensors.failures import Change, EventFailure, Failure, Scene, by_receipt
from fgloc.sensors.registry import SensorName, events_of
from fgloc.types import Event


class Dropout(EventFailure):
    """A sensor has no messages: they are lost."""

    kind: Literal["dropout"] = "dropout"
    sensor: SensorName

    def targets(self) -> tuple[type[Event], ...]:
        """Messages of the sensor."""
        return events_of(self.sensor)

    def begin(self, scene: Scene) -> Change:
        """Drop."""
        return lambda event: None


class ClockOffset(EventFailure):
    """A sensor's clock is ahead by ``offset_s`` and gains ``drift_ppm``: its stamps are wrong, its arrival is not."""

    kind: Literal["clock_offset"] = "clock_offset"
    sensor: SensorName
    offset_s: float = Field(0.1, description="s; negative: behind")
    drift_ppm: float = Field(0.0, description="µs gained per second since the start")

    def targets(self) -> tuple[type[Event], ...]:
        """Messages of the sensor."""
        return events_of(self.sensor)

    def begin(self, scene: Scene) -> Change:
        """Move the stamp."""

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
