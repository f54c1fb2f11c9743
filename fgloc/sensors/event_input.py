"""Events from plain numbers, for those who feed a live run from their own loop: each sensor brings its own methods."""

from __future__ import annotations

from fgloc.sensors.base import When
from fgloc.types import Event

BASE, SENSOR = "base_link", "sensor"
"""Frames of what is given without a frame: the robot's base, and the sensor of landmarks."""


class EventInput:
    """Base of the classes whose methods make a sensor's events; `Live` is all of them together."""

    def _deliver(self, event: Event) -> None:
        """Take an event that was made."""
        raise NotImplementedError

    def _when(self, role: str, stamp_ns: int) -> When:
        """Stamp as the configuration corrects it, receive time and topic of a role."""
        raise NotImplementedError
