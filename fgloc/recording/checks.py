"""What looks wrong in a recording: one collector for each role, each finding one sentence with its remedy.

The gate rejects bad items one by one while a run goes on; here the same faults are looked for in the whole recording
beforehand, so that a wrong clock or a spiking twist is known before a result is used. Those of sensors
come with them; here are those of the calibration and the truth.
"""

from __future__ import annotations

import numpy as np

from fgloc.config import Config, Role
from fgloc.sensors import registry
from fgloc.sensors.checks import Collector, Table, TimingOnly, count, finite_rows, unit_length
from fgloc.types import CameraInfoEvent, Event, FloatArray, TruthEvent


class TruthChecks:
    """Truth that is not always there."""

    def __init__(self) -> None:
        self._rows = Table(7)

    def add(self, event: Event) -> None:
        """Take in one event."""
        assert isinstance(event, TruthEvent)
        self._rows.add(*event.position, *event.orientation)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """What is wrong."""
        rows = self._rows.array()
        found = []
        finite = finite_rows(rows)
        if not finite.all():
            found.append(f"{topic}: {count(~finite)} hold NaN or infinity.")
        found += unit_length(topic, rows[finite, 3:7])
        if len(seconds) > 1:
            gaps = np.diff(seconds)
            covered = float(gaps[gaps <= config.truth.max_gap_s].sum() / max(seconds[-1] - seconds[0], 1e-9))
            if covered < 0.95:
                found.append(
                    f"{topic}: truth arrives in bursts: gaps of more than {config.truth.max_gap_s:g} s make up "
                    f"{1 - covered:.0%} of the time, where nothing can be compared."
                )
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


_CHECKS: dict[Role, type[Collector]] = {"camera_info": CameraInfoChecks, "truth": TruthChecks}


def collector(role: Role) -> Collector:
    """A new collector for the topic of a role."""
    if role in _CHECKS:
        return _CHECKS[role]()
    return next((stream.findings() for stream in registry.streams_of(role)), TimingOnly())
