"""Failures of images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fgloc.sensors.failures import Change, EventFailure, Scene, events_of
from fgloc.sensors.markers.events import ImageEvent
from fgloc.sensors.markers.images import ImageError, decode
from fgloc.types import Event


class Darkness(EventFailure):
    """Images get darker by the factor ``gain`` and noisy by ``noise`` gray levels (standard deviation, of 255)."""

    pixels: ClassVar[bool] = True
    kind: Literal["darkness"] = "darkness"
    gain: float = Field(0.1, ge=0, le=1, description="brightness that is left, as a share")
    noise: float = Field(2.0, ge=0, description="read noise [gray levels of 255]")

    def targets(self) -> tuple[type[Event], ...]:
        """Images."""
        return (ImageEvent,)

    def begin(self, scene: Scene) -> Change:
        """Darken, add noise, round."""

        def darken(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
            noise = scene.rng.standard_normal(image.shape, dtype=np.float32) * np.float32(self.noise)
            return np.clip(np.rint(image * np.float32(self.gain) + noise), 0, 255).astype(np.uint8)

        return _on_pixels(darken)


class MirroredImage(EventFailure):
    """Images are flipped left to right, as by a wrong setting of the driver."""

    pixels: ClassVar[bool] = True
    kind: Literal["mirrored_image"] = "mirrored_image"

    def targets(self) -> tuple[type[Event], ...]:
        """Images."""
        return (ImageEvent,)

    def begin(self, scene: Scene) -> Change:
        """Flip."""
        return _on_pixels(lambda image: image[:, ::-1])


class FrameRate(EventFailure):
    """The camera gives at most ``max_hz`` messages a second; the others are dropped."""

    kind: Literal["frame_rate"] = "frame_rate"
    max_hz: float = Field(1.0, gt=0, description="Hz")

    def targets(self) -> tuple[type[Event], ...]:
        """Everything that a camera reports."""
        return events_of("camera")

    def begin(self, scene: Scene) -> Change:
        """Drop what follows the last one too soon (5 % of jitter is let through)."""
        last_ns: dict[str, int] = {}
        period_ns = 0.95e9 / self.max_hz

        def change(event: Event) -> Event | None:
            if event.received_ns - last_ns.get(event.topic, -(10**19)) < period_ns:
                return None
            last_ns[event.topic] = event.received_ns
            return event

        return change


def _on_pixels(work: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Change:
    """Decode, change, and pass on uncompressed; what cannot be decoded stays as it is."""

    def change(event: Event) -> Event | None:
        assert isinstance(event, ImageEvent)
        try:
            gray = work(decode(event))
        except ImageError:
            return event
        height, width = gray.shape
        pixels = np.ascontiguousarray(gray).reshape(-1)
        return replace(event, encoding="mono8", compressed=False, width=width, height=height, step=width, data=pixels)

    return change
