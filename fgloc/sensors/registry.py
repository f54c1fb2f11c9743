"""The sensors that are installed beside the built-in ones, by role and by event."""

from __future__ import annotations

from collections.abc import Mapping

from fgloc.extensions import outside_sensors
from fgloc.sensors.base import Context, Converter, Sensor, Stream
from fgloc.types import Event


def sensors() -> tuple[type[Sensor], ...]:
    """All registered sensors.

    Raises:
        ConfigError: an installed one cannot be used.
    """
    return outside_sensors()


def streams() -> Mapping[str, Stream]:
    """Their streams, by role."""
    return {stream.role: stream for sensor in sensors() for stream in sensor.streams}


def converters(role: str) -> Mapping[str, Converter]:
    """Converters of a registered role, by message type; empty if it is none."""
    stream = streams().get(role)
    return {} if stream is None else stream.converters


def role_of_event(event: Event) -> str | None:
    """Role of a registered sensor's event; None if it is of none."""
    return next((role for role, stream in streams().items() if isinstance(event, stream.event)), None)


def build(context_of: Mapping[str, Context]) -> tuple[Sensor, ...]:
    """The sensors of one run, of those that have a context."""
    built = (s.build(context_of[s.name]) for s in sensors() if s.name in context_of)
    return tuple(sensor for sensor in built if sensor is not None)
