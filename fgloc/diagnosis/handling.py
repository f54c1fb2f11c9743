"""Motion that is not a robot's on its flat floor: held, lifted or turned by hand; a floor that is not flat.

What wheels and IMU say in a person's hands is true, and not of a robot on its floor: nothing is compared there, and no
constant, clock or floor is blamed for it.

Whether the floor is flat, where the configuration says so, is told by the direction of gravity, or by markers in
images: both tell which way is up in the base's axes. On a flat floor that is always the same way, whatever the
mountings are off by: what counts is how far it moves from its median. What an accelerometer says has to be what the
gyro says too: a robot that tilts turns about x and y, and one that only seems to, as its speed, a scale or a clock is
off, does not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fgloc.config import Config
from fgloc.diagnosis.signals import Path, Signals, turn_by
from fgloc.estimation.faults import LiftMonitor
from fgloc.frames import rotation_of
from fgloc.sensors.cameras import up_in_base
from fgloc.sensors.equipment import LandmarkSensor
from fgloc.sensors.gyro import Attitude, Gyro
from fgloc.sensors.measurements import corners_of
from fgloc.sensors.wheels.motion import WheelMotion, commanded_to_move, is_standing
from fgloc.types import (
    FloatArray,
    InertialEvent,
    LandmarkMap,
    MotionMeasurement,
    MotionReadings,
    Step,
    by_class,
)

Span = tuple[float, float]  # seconds from the recording's start

_STEP_S = 0.1
_COMMANDS_S = 1.0  # before a step: those still move the robot
_APART_S = 5.0  # between two signs of one handling: nobody sets a robot down for less
_LASTS_S = 0.3  # a shorter one is a knock
_HELD_WINDOW_S, _HELD_EVERY_S = 1.5, 0.25
_HELD_TURN = 0.15  # rad by the wheels within a window
_HELD_WAY_M = 0.05  # they go no further within it: the robot turns on the spot
_HELD_SHARE = 0.65  # of what it usually is, the gyro's turn for the wheels'
_HELD_LASTS_S = 3.0  # less is slip
_USUAL = 0.9  # quantile of the gyro's turn for the wheels': a robot turns less than its wheels where they slip ...
_AGREE = 0.6  # ... and never as much on wheels that skid throughout: these tell nothing
_REST_S = 2.0  # of rest, for the size of gravity


@dataclass(frozen=True, slots=True, eq=False)
class Handling:
    """Stretches of time in which a person handled the robot, and the specific force at rest.

    Attributes:
        lifted: it was lifted, or turned by hand.
        held: its wheels turned and it did not, or much less.
        gravity: median size of the specific force of a robot at rest [m/s²]; None: it never rests, or nothing tells.
    """

    lifted: tuple[Span, ...] = ()
    held: tuple[Span, ...] = ()
    gravity: float | None = None

    @property
    def spans(self) -> tuple[Span, ...]:
        """All stretches, in order."""
        return tuple(sorted((*self.lifted, *self.held)))


def handling(signals: Signals, config: Config, path: Path, up: FloatArray) -> Handling:
    """Find the stretches in which the robot was lifted, turned by hand or held.

    Args:
        signals: of the recording.
        config: with which wheels and gyro are read.
        path: of the wheels, likewise.
        up: ``(3,)`` the base's z axis in the IMU's frame, times the scale of its rates.
    """
    rates = signals.rates()
    if rates is None:
        return Handling()
    monitor, signs, resting = LiftMonitor(math.inf, up), [], []
    for k, (step, readings) in enumerate(_steps(signals, config, up)):
        at = (step.stamp_ns - signals.origin_ns) * 1e-9
        told = [d.reason for d in monitor.observe(k, step, readings)]
        if readings.wheels is not None and is_standing(readings.wheels.motion, step.dt):
            resting.append(at)
        if any(reason != "carried" for reason in told):
            signs.append(at)
            monitor.carried = False  # a sign is one by itself
    lifted = tuple(_merged(signs, _APART_S, _LASTS_S))
    held = tuple(_held(path, *rates[:2], up, lifted))
    times, force = rates[0], np.linalg.norm(rates[2], axis=1)
    rest = np.array(resting)
    quiet = ~_inside(rest, lifted)
    nearest = np.abs(times - rest[np.clip(np.searchsorted(rest, times), 0, len(rest) - 1)]) if len(rest) else times
    still = (nearest < _STEP_S) & ~_inside(times, lifted) & np.append(True, np.diff(force) != 0.0)
    gravity = float(np.median(force[still])) if quiet.sum() * _STEP_S > _REST_S and still.sum() > 10 else None
    return Handling(lifted, held, gravity)


def outside(signals: Signals, found: Handling) -> Signals:
    """Signals without the IMU's measurements in the handled stretches."""
    times = np.array([row[0] for row in signals.imu])
    kept = ~_inside(times, found.spans)
    return replace(signals, imu=[row for row, keep in zip(signals.imu, kept, strict=True) if keep])


def cut(path: Path, found: Handling) -> Path:
    """Path of the wheels, its motion marked as unknown in the handled stretches."""
    handled = _inside(path.times, found.spans)
    return replace(path, gaps=path.gaps + np.cumsum(handled))


def _steps(signals: Signals, config: Config, up: FloatArray) -> Iterator[tuple[Step, MotionReadings]]:
    """Steps of the whole recording with what wheels and gyro measure."""
    wheels, gyro = WheelMotion(config.wheels), Gyro(config.gyro, up)
    events = sorted((e for e in signals.motion if not isinstance(e, InertialEvent)), key=lambda e: e.stamp_ns)
    stamps = np.array([e.stamp_ns for e in events], dtype=np.int64)
    imu = [_event(row, signals.origin_ns) for row in sorted(signals.imu)]
    sampled = np.array([e.stamp_ns for e in imu], dtype=np.int64)
    grid = np.arange(stamps[0], stamps[-1], round(_STEP_S * 1e9))
    for k in range(1, len(grid)):
        start, end = int(grid[k - 1]), int(grid[k])
        first = max(int(np.searchsorted(stamps, start - round(_COMMANDS_S * 1e9))) - 1, 0)
        own = events[first : int(np.searchsorted(stamps, end, side="right")) + 1]
        a, b = np.searchsorted(sampled, [start, end], side="right")
        step = Step(k, 0, start, end, by_class([*own, *imu[max(int(a) - 1, 0) : int(b) + 1]]))
        measured = wheels.measure(step)
        still = None if measured is None or commanded_to_move(step) else measured.motion
        turn = gyro.measure(step, still)
        yaw = None
        if turn is not None:
            yaw = MotionMeasurement("gyro", start, end, np.array([0.0, 0.0, turn.yaw]), np.eye(3) * turn.variance)
        yield step, MotionReadings(measured, None, yaw)


def _event(row: Sequence[float], origin_ns: int) -> InertialEvent:
    stamp = origin_ns + round(row[0] * 1e9)
    return InertialEvent(stamp, stamp, "", "", np.array(row[1:4]), np.array(row[4:7]))


def _merged(times: Sequence[float], apart_s: float, least_s: float, each_s: float = _STEP_S) -> Iterator[Span]:
    """Stretches of times that are not further apart than this."""
    at = np.array(times)
    for part in np.split(at, np.flatnonzero(np.diff(at) > apart_s) + 1):
        if len(part) and part[-1] - part[0] + each_s >= least_s:
            yield float(part[0] - each_s), float(part[-1])


def _held(path: Path, times: FloatArray, rates: FloatArray, up: FloatArray, lifted: Sequence[Span]) -> Iterator[Span]:
    """Stretches in which the wheels turn the robot on the spot, and the gyro much less than it usually does."""
    at = np.arange(max(path.times[0], times[0]), min(path.times[-1], times[-1]) - _HELD_WINDOW_S, _HELD_EVERY_S)
    if len(at) < 2:
        return
    end = at + _HELD_WINDOW_S
    turned = turn_by(times, rates @ up)
    gyro = np.interp(end, times, turned) - np.interp(at, times, turned)
    before, after = path.at(at), path.at(end)
    wheels, way = after[:, 2] - before[:, 2], np.hypot(*(after - before)[:, :2].T)
    spans = tuple((a - _HELD_WINDOW_S, b) for a, b in lifted)
    turning = (np.abs(wheels) > _HELD_TURN) & path.known(at, end) & ~_inside(at, spans)
    if not turning.any():
        return
    share = np.where(turning, gyro / np.where(turning, wheels, 1.0), np.inf)
    usual = float(np.quantile(share[turning], _USUAL))
    if usual < _AGREE:
        return
    held = turning & (way < _HELD_WAY_M) & (share < _HELD_SHARE * usual) & (share > -1.0)
    for first, last in _merged(at[held].tolist(), _APART_S, 0.0, 0.0):
        if last + _HELD_WINDOW_S - first > _HELD_LASTS_S:
            yield first, last + _HELD_WINDOW_S


def _inside(times: FloatArray, spans: Sequence[Span]) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Whether each time lies in one of the stretches."""
    inside = np.zeros(len(times), dtype=bool)
    for a, b in spans:
        inside |= (times >= a) & (times <= b)
    return inside


# --- The floor --------------------------------------------------------------------------------------------------------

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
    """Collector of the vertical direction in the base frame, to test whether the floor is flat."""

    def __init__(
        self,
        attitude: Attitude | None,
        wheels: WheelMotion,
        landmarks: LandmarkSensor,
        landmark_map: LandmarkMap | None,
    ) -> None:
        """Set up for the sensors of a run.

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
        self._total = np.zeros(5)
        self._begin()
        self._by_force = False
        self._looked_ns = 0

    def _begin(self) -> None:
        """Begin a window."""
        self._force, self._sum, self._seconds = np.zeros(3), np.zeros(5), 0.0

    def observe(self, step: Step, by_hand: bool = False) -> None:
        """Collect the tilt of a step.

        Args:
            step: with its inertial measurements.
            by_hand: a person holds the robot; the moment before that showed is discarded as well.
        """
        if by_hand:
            if self._seconds > 0.0 and self._ups and self._by_force:
                del self._ups[-1], self._turned[-1]
            self._begin()
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
                self._begin()
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
            seen = corners_of(self._landmarks.measure(event))  # of one image, so of one camera
            known = [(m.corners_px, landmark_map.landmarks[m.landmark_id]) for m in seen]
            up = up_in_base(seen[0].camera, known) if len(known) > 1 else None
            if up is not None:
                self._looked_ns = event.stamp_ns
                self._ups.append(up)

    @property
    def sentence(self) -> str | None:
        """Sentence that the floor is not flat, with the largest pitch and roll [°]; None: it seems flat."""
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
