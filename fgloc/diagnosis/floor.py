"""Whether the floor is flat, where the configuration says so: by the direction of gravity, or by markers in images.

Both tell which way is up in the base's axes. On a flat floor that is always the same way, whatever the mountings are
off by: what counts is how far it moves from its median. What an accelerometer says has to be what the gyro says too: a
robot that tilts turns about x and y, and one that only seems to, as its speed, a scale or a clock is off, does not. Nor
does what was seen while it was in a person's hands tell of the floor.
"""

from __future__ import annotations

import math

import numpy as np

from fgloc.frames import rotation_of
from fgloc.sensors.equipment import AttitudeSensor, Odometer
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.pnp import up_in_base
from fgloc.types import FloatArray, LandmarkMap, PixelMeasurement, Step

_WINDOW_S = 1.0  # that the specific force is averaged over: what wheels do not tell of accelerations averages out
_EVERY_NS = 500_000_000  # between images that are looked at
_TILTED_RAD = math.radians(2.0)  # by the accelerometer; flat floors with stop and go and slip give 1.3 at most
_TILTED_IN_IMAGE_RAD = math.radians(4.0)  # two markers with a surveyed place tell it to a degree or two
_LEAST = 4  # windows, or images, that are tilted ...
_SHARE = 0.02  # ... and share of all
_CONFIRMED = 0.5  # share of the changes of gravity's direction that the gyro's turns explain
_EXTREME = 0.99  # quantile that is told: one wild reading is none
_MOST = 20_000  # readings that are kept


class FloorWatch:
    """Collects which way is up."""

    def __init__(
        self,
        attitude: AttitudeSensor | None,
        wheels: Odometer,
        landmarks: LandmarkSensor,
        landmark_map: LandmarkMap | None,
    ) -> None:
        """Take the sensors.

        Args:
            attitude: None: there is no accelerometer, so that images are looked at.
            wheels: tell the robot's own acceleration.
            landmarks: make measurements of sightings.
            landmark_map: None: images tell nothing.
        """
        self._attitude, self._wheels = attitude, wheels
        self._landmarks, self._map = landmarks, landmark_map
        self._ups: list[FloatArray] = []
        self._turned: list[FloatArray] = []  # (5,) by the gyro [rad], time [s] and stretch: means over windows
        self._force, self._sum, self._seconds = np.zeros(3), np.zeros(5), 0.0
        self._total = np.zeros(5)
        self._by_force = False
        self._looked_ns = 0

    def observe(self, step: Step, by_hand: bool = False) -> None:
        """Collect the tilt of a step.

        Args:
            step: with its inertial measurements.
            by_hand: a person holds the robot; the moment before that showed is discarded as well.
        """
        if by_hand:
            if self._seconds > 0.0 and self._ups and self._by_force:
                del self._ups[-1], self._turned[-1]
            self._force, self._sum, self._seconds = np.zeros(3), np.zeros(5), 0.0
            self._total[4] += 1.0
            return
        if len(self._ups) >= _MOST:
            return
        reading = None if self._attitude is None else self._attitude.measure(step, self._wheels.twist)
        if self._attitude is not None and reading is not None and reading.force is not None:
            self._by_force = True
            yaw = float(self._attitude.rates_at(step.inertial, step.stamp_ns)[2]) * step.dt
            turn = np.array([*reading.turn, yaw, step.dt, 0.0])
            self._force += reading.force * step.dt
            self._sum += (self._total + 0.5 * turn) * step.dt
            self._total += turn
            self._seconds += step.dt
            if self._seconds >= _WINDOW_S:
                self._ups.append(self._force / np.linalg.norm(self._force))
                self._turned.append(self._sum / self._seconds)
                self._force, self._sum, self._seconds = np.zeros(3), np.zeros(5), 0.0
        elif not self._by_force and self._map is not None:
            self._look(step, self._map)

    @property
    def _confirmed(self) -> bool:
        """Whether the gyro turns as gravity does in the base's axes, from window to window."""
        ups, turned = np.array(self._ups), np.diff(np.array(self._turned), axis=0)
        usual = np.median(ups, axis=0)
        true = ups - usual + [0.0, 0.0, 1.0]  # what is always there is the mounting's
        joined = turned[:, 4] == 0.0
        if joined.sum() < _LEAST:
            return False
        bias = np.median(turned[joined, :2] / turned[joined, 3:4], axis=0)
        turns = turned[:, :3] - np.outer(turned[:, 3], [*bias, 0.0])
        by_gyro = np.array([rotation_of(-turn) @ up for turn, up in zip(turns, true[:-1], strict=True)])[joined, :2]
        seen, expected = np.diff(true, axis=0)[joined, :2], by_gyro - true[:-1][joined, :2]
        return float(((seen - expected) ** 2).sum()) < (1.0 - _CONFIRMED) * float((seen**2).sum())

    def _look(self, step: Step, landmark_map: LandmarkMap) -> None:
        for event in step.sightings:
            if event.stamp_ns < self._looked_ns + _EVERY_NS or not event.in_pixels:
                continue
            seen = [m for m in self._landmarks.measure(event) if isinstance(m, PixelMeasurement)]
            known = [(m.corners_px, landmark_map.landmarks[m.landmark_id]) for m in seen]
            up = up_in_base(seen[0].camera, known) if len(known) > 1 else None
            if up is not None:
                self._looked_ns = event.stamp_ns
                self._ups.append(up)

    @property
    def sentence(self) -> str | None:
        """What is wrong; None: nothing."""
        if len(self._ups) < _LEAST:
            return None
        ups = np.array(self._ups)
        bound = _TILTED_RAD if self._by_force else _TILTED_IN_IMAGE_RAD
        usual = np.median(ups, axis=0)
        off = np.arccos(np.clip(ups @ (usual / np.linalg.norm(usual)), -1.0, 1.0))
        if (off > bound).sum() < max(_LEAST, _SHARE * len(ups)) or (self._by_force and not self._confirmed):
            return None
        roll, pitch = np.arctan2(ups[:, 1], ups[:, 2]), np.arctan2(-ups[:, 0], ups[:, 2])
        most = [math.degrees(np.quantile(np.abs(a - np.median(a)), _EXTREME)) for a in (pitch, roll)]
        by = "the accelerometer" if self._by_force else "the markers' corners"
        return (
            f"the floor is not flat: pitch up to {most[0]:.0f}°, roll up to {most[1]:.0f}°, by {by}; "
            "set estimator.ground: uneven"
        )
