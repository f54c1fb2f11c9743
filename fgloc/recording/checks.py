"""What looks wrong in a recording: one collector for each role, each finding one sentence with its remedy.

The gate rejects bad items one by one while a run goes on; here the same faults are looked for in the whole recording
beforehand, so that the user hears of a wrong clock or of a spiking twist before trusting a result.
"""

from __future__ import annotations

from fgloc.config import Config, Role
from fgloc.recording.checks_base import Collector
from fgloc.recording.checks_camera import CameraInfoChecks, ImageChecks, SightingsChecks
from fgloc.recording.checks_motion import CommandChecks, ImuChecks, OdometryChecks, TruthChecks
from fgloc.types import Event, FloatArray


class OtherChecks:
    """Nothing but the timing is checked."""

    def add(self, event: Event) -> None:
        """Take in one event."""

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Nothing."""
        return []


CHECKS: dict[Role, type[Collector]] = {
    "odometry": OdometryChecks,
    "command": CommandChecks,
    "joints": OtherChecks,
    "imu": ImuChecks,
    "image": ImageChecks,
    "camera_info": CameraInfoChecks,
    "sightings": SightingsChecks,
    "truth": TruthChecks,
}
