"""Checks of what was seen: images, calibration and marker sightings."""

from __future__ import annotations

from array import array
from collections import Counter

import numpy as np

from fgloc.config import Config
from fgloc.recording.checks_base import Table, count, times
from fgloc.types import (
    CameraInfoEvent,
    CornersEvent,
    Event,
    FloatArray,
    ImageEvent,
    MarkerPosesEvent,
    RangeBearingEvent,
)


class ImageChecks:
    """Empty images; remembers sizes and frame."""

    def __init__(self) -> None:
        self._empty = 0
        self._count = 0
        self.frame_id = ""
        self.sizes: Counter[tuple[int, int]] = Counter()

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, ImageEvent)
        self._count += 1
        self.frame_id = self.frame_id or event.frame_id
        self._empty += len(event.data) == 0
        if not event.compressed:
            self.sizes[event.width, event.height] += 1

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        found = []
        if self._empty:
            found.append(f"{topic}: {self._empty} of {self._count} images are empty and will be skipped.")
        if len(self.sizes) > 1:
            sizes = ", ".join(f"{w}x{h}" for w, h in self.sizes)
            found.append(f"{topic}: the image size changes ({sizes}).")
        return found


class CameraInfoChecks:
    """A calibration that is none, or that changes."""

    def __init__(self) -> None:
        self.size = (0, 0)
        self.frame_id = ""
        self._zero = 0
        self._no_distortion = 0
        self._count = 0
        self._calibrations: set[bytes] = set()

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, CameraInfoEvent)
        self._count += 1
        self.size = event.width, event.height
        self.frame_id = self.frame_id or event.frame_id
        self._zero += not event.K.any()
        self._no_distortion += len(event.D) == 0
        if len(self._calibrations) < 10:
            self._calibrations.add(event.K.tobytes() + event.D.tobytes())

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        found = []
        if self._zero:
            found.append(
                f"{topic}: K is all zero in {self._zero} of {self._count} messages: the camera is not calibrated; "
                "give a calibration (camera.file in the configuration)."
            )
        elif self._no_distortion:
            found.append(f"{topic}: no distortion coefficients; they are taken as zero.")
        if len(self._calibrations) > 1:
            found.append(f"{topic}: the calibration changes during the recording; the first one is used.")
        return found


class SightingsChecks:
    """Which markers were seen, and where."""

    def __init__(self) -> None:
        self.ids: Counter[int] = Counter()
        self.frame_id = ""
        self.corners = False
        self._filled = array("b")  # whether each message holds a sighting
        self._positions = Table(3)
        self._ranges = Table(1)

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, CornersEvent | MarkerPosesEvent | RangeBearingEvent)
        self._filled.append(bool(event.sightings))
        self.frame_id = self.frame_id or event.frame_id
        if isinstance(event, RangeBearingEvent):
            self.ids.update(s.landmark_id for s in event.sightings)
            for landmark in event.sightings:
                self._ranges.add(landmark.range_m)
        elif isinstance(event, MarkerPosesEvent):
            self.ids.update(s.marker_id for s in event.sightings)
            for marker in event.sightings:
                self._positions.add(*marker.position)
                self._ranges.add(float(np.linalg.norm(marker.position)))
        else:
            self.corners = True
            self.ids.update(s.marker_id for s in event.sightings)

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
        bad = ~((ranges >= config.gate.min_range) & (ranges <= config.gate.max_range))
        if bad.any():
            found.append(
                f"{topic}: {count(bad)} sightings are not within {config.gate.min_range:g} to "
                f"{config.gate.max_range:g} m and will be rejected."
            )
        return found + self._axes(topic, config)

    def _axes(self, topic: str, config: Config) -> list[str]:
        """A standing marker keeps its height while its distance changes: this tells which axis points forward."""
        positions = self._positions.array()
        if len(positions) < 20 or config.recording.sightings_axes is not None:
            return []
        spread = np.percentile(positions, 95, axis=0) - np.percentile(positions, 5, axis=0)
        optical = (positions[:, 2] > 0).mean() > 0.99 and spread[1] < 0.4 * min(spread[0], spread[2])
        if optical and "optical" not in self.frame_id:
            return [
                f"{topic}: the positions look as if z pointed forward (z {positions[:, 2].min():.1f} to "
                f"{positions[:, 2].max():.1f} m, y nearly constant) although frame_id is {self.frame_id!r}; "
                "if so, set recording.sightings_axes: optical."
            ]
        return []
