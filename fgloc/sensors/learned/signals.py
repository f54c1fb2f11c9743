"""Measured signals around a step: what a model may read beside commands."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from fgloc.sensors import registry
from fgloc.sensors.base import MotionRole
from fgloc.sensors.channels import Mounting
from fgloc.sensors.learned.card import ModelCard
from fgloc.sensors.signals import Signal
from fgloc.types import MotionEvent, Step

EventsOf = Callable[[type[MotionEvent]], Sequence[MotionEvent]]
"""Events of a class, in order of stamp."""


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """What was measured around a step. Times are seconds since ``origin_ns``.

    Attributes:
        origin_ns: time zero.
        by_name: signal of each channel that was wanted and is known.
    """

    origin_ns: int
    by_name: Mapping[str, Signal] = field(default_factory=dict)

    def named(self, name: str) -> Signal | None:
        """By the name that a card's inputs use."""
        return self.by_name.get(name)

    def of_role(self, role: MotionRole) -> Signal | None:
        """The motion by a motion source; None if it is not known."""
        return next((self.by_name[name] for name in self.by_name if registry.channels()[name].role == role), None)


class SignalReader:
    """Keeps of the steps' events what a model reads, for as long as it looks back, and makes signals of it.

    Steps that do not continue the last one, by stamp or segment, begin anew: before the first event of a signal its
    first value is taken to have held.
    """

    def __init__(self, card: ModelCard, imu_up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        """Read what the card's model needs; ``imu_up`` is the base's z axis in the IMU's frame."""
        self._mounting = Mounting(card.joints, imu_up=np.asarray(imu_up, dtype=float))
        self._wanted = card.measured
        self._back_ns = round((card.signal_edges_s[-1] + card.wheel_kinematics.delay_s) * 1e9)
        self._reached: tuple[int, int] | None = None
        self._events: dict[type[MotionEvent], list[MotionEvent]] = {
            registry.channels()[name].event: [] for name in self._wanted
        }

    @property
    def back_ns(self) -> int:
        """How far before a step the events reach that are read; 0: none are read."""
        return self._back_ns if self._wanted else 0

    def fork(self, events: Mapping[type[MotionEvent], Sequence[MotionEvent]]) -> SignalReader:
        """A copy that may read on without changing this one, with these events in place of its own."""
        forked = copy.copy(self)
        forked._events = {kind: list(events.get(kind, ())) for kind in self._events}
        return forked

    def read(self, step: Step, gyro_bias: float = 0.0) -> Signals | str:
        """Signals over the step and what the model wants before it; else the name of the first one with a hole."""
        if not self._wanted:
            return Signals(step.start_ns)
        continued = self._reached == (step.segment, step.start_ns)
        self._reached = (step.segment, step.stamp_ns)
        oldest = step.start_ns - self._back_ns
        for kind, events in self._events.items():
            if not continued:
                events.clear()
            _follow(events, step.of(kind), oldest)
        mounting = replace(self._mounting, gyro_bias=gyro_bias)
        found = signals_of(self._wanted, self._events.__getitem__, step.start_ns, mounting)
        for name in self._wanted:
            signal = found.named(name)
            if signal is None or not signal.covers(0.0, step.dt):
                return name
        return found


def signals_of(wanted: Sequence[str], events_of: EventsOf, origin_ns: int, mounting: Mounting) -> Signals:
    """The wanted signals, as far as the events hold them.

    Args:
        wanted: names of channels.
        events_of: the events by class.
        origin_ns: time zero of the signals.
        mounting: what the channels need to know of the robot.
    """
    channels = [registry.channels()[name] for name in wanted]
    made = {channel.name: channel.signal(events_of(channel.event), origin_ns, mounting) for channel in channels}
    return Signals(origin_ns, {name: signal for name, signal in made.items() if signal is not None})


def _follow(events: list[MotionEvent], new: Sequence[MotionEvent], oldest_ns: int) -> None:
    """Add what is new and drop what is older than the last one at or before a time."""
    last_ns = events[-1].stamp_ns if events else -1
    events.extend(e for e in new if e.stamp_ns > last_ns)
    first = 0
    while first + 1 < len(events) and events[first + 1].stamp_ns <= oldest_ns:
        first += 1
    del events[:first]
