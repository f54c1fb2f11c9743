"""What looks wrong with a topic of a recording, for ``fgloc info``: what the sensors' checks share."""

from __future__ import annotations

from array import array
from collections import Counter
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from fgloc.types import Event, FloatArray, RawEvent, SightingsEvent

if TYPE_CHECKING:
    from fgloc.config import Config

_UNIT_TOLERANCE = 0.05


class Collector(Protocol):
    """Takes in the events of one topic and tells what is wrong with them."""

    def add(self, event: Event) -> None:
        """Take in one event."""

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong; ``seconds`` ``(n,)`` are the receive times from the recording's start."""


class TimingOnly:
    """Nothing but the timing is checked."""

    def add(self, event: Event) -> None:
        """Take in one event."""

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Nothing."""
        return []


class Table:
    """Rows of floats, compact."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._values = array("d")

    def add(self, *values: float) -> None:
        """Add a row."""
        self._values.extend(values)

    def array(self) -> FloatArray:
        """All rows ``(n, width)``."""
        return np.array(self._values, dtype=float).reshape(-1, self._width)


def finite_rows(rows: FloatArray) -> NDArray[np.bool_]:
    """Which rows hold neither NaN nor infinity."""
    return np.asarray(np.isfinite(rows).all(axis=1))


def count(mask: NDArray[np.bool_]) -> str:
    """How many of how many."""
    return f"{int(mask.sum())} of {mask.size}"


def times(n: int) -> str:
    """Once, or n times."""
    return "once" if n == 1 else f"{n} times"


def spikes(topic: str, name: str, unit: str, values: FloatArray, bound: float, seconds: FloatArray) -> list[str]:
    """Values beyond a bound, with the largest."""
    beyond = values > bound
    if not beyond.any():
        return []
    at = int(np.argmax(np.where(beyond, values, 0.0)))
    return [
        f"{topic}: {count(beyond)} have a {name} beyond {bound:g} {unit} (up to {values[at]:.4g}, at "
        f"{seconds[at]:.1f} s) and will be rejected."
    ]


def unit_length(topic: str, quaternions: FloatArray) -> list[str]:
    """Quaternions ``(n, 4)`` that are not of unit length."""
    off = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) > _UNIT_TOLERANCE
    return [f"{topic}: {count(off)} have a quaternion that is not of unit length."] if off.any() else []


class RawChecks:
    """Images without data; remembers sizes and frame."""

    def __init__(self) -> None:
        self._empty = 0
        self._count = 0
        self.frame_id = ""
        self.sizes: Counter[tuple[int, int]] = Counter()

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, RawEvent)
        self._count += 1
        self.frame_id = self.frame_id or event.frame_id
        self._empty += event.empty
        if event.size is not None:
            self.sizes[event.size] += 1

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        found = []
        if self._empty:
            found.append(f"{topic}: {self._empty} of {self._count} images are empty and will be skipped.")
        if len(self.sizes) > 1:
            sizes = ", ".join(f"{w}x{h}" for w, h in self.sizes)
            found.append(f"{topic}: the image size changes ({sizes}).")
        return found


class SightingsChecks:
    """Which markers were seen, and where."""

    def __init__(self) -> None:
        self.ids: Counter[int] = Counter()
        self.frame_id = ""
        self.in_pixels = False
        self._filled = array("b")  # whether each message holds a sighting
        self._ranges = Table(1)

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, SightingsEvent)
        self._filled.append(bool(event.sightings))
        self.frame_id = self.frame_id or event.frame_id
        self.in_pixels = event.in_pixels
        self.ids.update(s.landmark_id for s in event.sightings)
        for sighting in event.sightings:
            if (distance := sighting.distance()) is not None:
                self._ranges.add(distance)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        found = []
        if not self.ids:
            return [f"{topic}: none of its {len(self._filled)} messages holds a sighting."]
        seen = seconds[np.array(self._filled, dtype=bool)]
        gaps = np.diff(seen, prepend=0.0, append=seconds[-1])
        if (blackouts := gaps > config.estimator.dead_reckoning_after_s).any():
            at = int(np.argmax(gaps))
            found.append(
                f"{topic}: no sighting for more than {config.estimator.dead_reckoning_after_s:g} s "
                f"{times(int(blackouts.sum()))}, the longest {gaps[at]:.1f} s from "
                f"{seen[at - 1] if at else 0.0:.1f} s on."
            )
        rare = [str(i) for i, n in sorted(self.ids.items()) if n < config.landmarks.min_sightings]
        if rare:
            found.append(f"{topic}: seen fewer than {config.landmarks.min_sightings} times: id {', '.join(rare)}.")
        ranges = self._ranges.array()
        bad = ~((ranges > config.gate.min_range) & (ranges <= config.gate.max_range))
        if bad.any():
            found.append(
                f"{topic}: {count(bad)} sightings are not between {config.gate.min_range:g} and "
                f"{config.gate.max_range:g} m off and will be rejected."
            )
        return found
