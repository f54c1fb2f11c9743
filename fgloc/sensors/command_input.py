"""Control inputs from plain numbers."""

from __future__ import annotations

from fgloc.sensors.event_input import EventInput
from fgloc.types import ControlEvent


class CommandInput(EventInput):
    """What the robot is commanded."""

    def command(self, stamp_ns: int, v: float, omega: float) -> None:
        """Forward speed [m/s] and yaw rate [rad/s] that the robot was commanded."""
        self._deliver(ControlEvent(*self._when("command", stamp_ns), float(v), float(omega)))
