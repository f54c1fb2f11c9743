"""The diagnosis of a run: its signals, compared while it goes on by the engine that compares a recording before it."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, replace

import numpy as np

from fgloc.config import Config
from fgloc.diagnosis.collect import SightingCollector
from fgloc.diagnosis.conventions import conventions
from fgloc.diagnosis.floor import FloorWatch
from fgloc.diagnosis.signals import SignalCollector, Signals
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.roles import with_values
from fgloc.types import Camera, Event, Finding, FloatArray, LandmarkMap, Severity, SightingsEvent, Step, ordered

_FIRST_S, _GROWTH = 20.0, 2.0  # signals of a first comparison, and how many times as much the next one needs
_FIRST_MOVING_S, _GROWTH_MOVING = 5.0, 1.4  # likewise, of motion: until `_FIRST_S` of it, four more comparisons
_MOVES_M_S, _MOVES_RAD_S = 0.01, 0.02  # by the wheels: below, the robot stands
_SCALES = ("sightings.scale", "wheels.scale", "map.unit", "scales", "sightings.range")
_TURNED_RAD = 0.3  # of a camera: more than the turn by which wheels are off
_SPARSE_S = 0.09  # images closer than this to the one before add little information


class Diagnosis:
    """Collects the signals of a run, in bounded memory, whatever the estimator makes of them.

    Corners of markers are compared as points in the camera's axes.

    Attributes:
        found: by the last comparison; of little motion, by the last two alike.
    """

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | None,
        camera: Camera | None,
        T_base_sensor: FloatArray | None,
        imu_up: FloatArray | None,
        floor: FloorWatch | None = None,
    ) -> None:
        """Set up for the sensors of a run.

        Args:
            config: as the run uses it.
            landmark_map: the known map; None if landmarks are estimated.
            camera: of corners; None if there is none.
            T_base_sensor: ``(4, 4)`` of a sensor that reports ranges or marker poses, as `LandmarkSensor` takes it.
            imu_up: ``(3,)`` the base's z axis in the IMU's frame; None: there is no gyro.
            floor: watches whether it is flat; None: it may be as it is.
        """
        self._floor, self._camera, self._map, self._up = floor, camera, landmark_map, imu_up
        self._config, self._place = config, T_base_sensor
        if camera is not None:
            self._config = with_values(config, "recording", {"sightings_axes": "optical"})
            self._place = camera.T_base_cam
        sensor = LandmarkSensor(config, landmark_map, camera, T_base_sensor)  # what it refuses does not count
        place = np.eye(4) if self._place is None else self._place
        self._corners = SightingCollector(config, landmark_map, sensor, place)
        self._signals = SignalCollector(config)
        self._began_ns: int | None = None
        self._span_s, self._looked_s, self._compared_s = 0.0, -math.inf, 0.0
        self._moving_s, self._compared_moving_s = 0.0, 0.0
        self._codes: set[str] = set()  # found by the last comparison
        self.found: tuple[Finding, ...] = ()

    def add(self, event: Event) -> None:
        """Take the signals of an event, as it came: what the gate refuses may have another unit."""
        self._began_ns = event.received_ns if self._began_ns is None else self._began_ns
        if not self._signals.add(event):
            return
        self._span_s = (event.received_ns - self._began_ns) * 1e-9
        if not isinstance(event, SightingsEvent) or not event.in_pixels:
            return
        signals = self._signals.found
        at_s = (event.stamp_ns - signals.origin_ns) * 1e-9
        if abs(at_s - self._looked_s) >= _SPARSE_S:
            self._looked_s, signals.spatial = at_s, True
            signals.seen += [(at_s, s.landmark_id, *s.point.tolist()) for s in self._corners.sightings(event, at_s)]

    def observe(self, step: Step, by_hand: bool = False, motion: FloatArray | None = None) -> None:
        """Watch the floor over a step.

        Args:
            step: as the localizer got it.
            by_hand: a person has the robot in hand.
            motion: ``(3,)`` by the wheels, which tells how much of the signals is of a robot in motion.
        """
        if self._floor is not None:
            self._floor.observe(step, by_hand)
        if motion is not None and (
            math.hypot(motion[0], motion[1]) > _MOVES_M_S * step.dt or abs(motion[2]) > _MOVES_RAD_S * step.dt
        ):
            self._moving_s += step.dt

    @property
    def mistakes(self) -> tuple[str, ...]:
        """What is surely wrong with the configuration, and makes the poses wrong: a sentence each."""
        sentence = None if self._floor is None else self._floor.sentence
        return () if sentence is None else (sentence,)

    def findings(self, ended: bool = True) -> tuple[Finding, ...]:
        """Findings: signals of the sensors that do not fit together, each with its remedy.

        Args:
            ended: compare all signals; otherwise only once they are many more than those compared before.
        """
        comparison = self.comparison(ended)
        if comparison is not None:
            comparison()
        return self.found

    def comparison(self, ended: bool = False) -> Callable[[], None] | None:
        """A comparison to be made by any thread, of the signals so far; it sets `found`.

        Args:
            ended: as `findings` has it. None is given where no comparison is due.
        """
        growth = _GROWTH_MOVING if self._compared_moving_s < _FIRST_S else _GROWTH
        enough = self._span_s >= max(_FIRST_S, _GROWTH * self._compared_s)
        enough |= self._moving_s >= max(_FIRST_MOVING_S, growth * self._compared_moving_s)
        if self._span_s <= self._compared_s or not (ended or enough):
            return None
        self._compared_s, self._compared_moving_s = self._span_s, self._moving_s
        now = self._signals.found
        signals = replace(now, **{f.name: copy.copy(getattr(now, f.name)) for f in fields(now)})
        little = not ended and 0.0 < self._moving_s < _FIRST_S
        return lambda: self._compare(signals, little)

    def _compare(self, signals: Signals, little: bool) -> None:
        found = conventions(signals, self._config, self._place, self._up, self._map)
        named = ordered(found.findings if self._camera is None else self._of_camera(found.findings))
        self.found = tuple(f for f in named if not little or f.code in self._codes)
        self._codes = {f.code for f in named}

    @staticmethod
    def _of_camera(findings: Iterable[Finding]) -> Iterator[Finding]:
        """Findings about points that corners of markers tell: sizes and focal length are in every distance.

        Small turns of the camera are left to the graph, and to the fit of corners before a run: at a marker's distance
        the wheels' own turn does the same.
        """
        for finding in findings:
            severity = min(finding.severity, Severity.WARNING)
            if finding.code == "sightings.mounting" and abs(finding.value or 0.0) < _TURNED_RAD:
                continue
            if finding.code not in _SCALES:
                yield replace(finding, severity=severity)
                continue
            said = finding.text.partition(": set ")[0].removesuffix(".")
            text = f"{said}; a wrong size of the markers or focal length does the same: measure them."
            yield replace(finding, text=text, lines={}, severity=severity)
