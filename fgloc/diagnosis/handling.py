"""Stretches of a recording in which a person had the robot in hand: held, lifted or turned, by wheels and IMU.

What wheels and IMU say there is true, and not of a robot on its floor: nothing is compared there, and no constant,
clock or floor is blamed for it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fgloc.config import Config
from fgloc.diagnosis.signals import Path, Signals
from fgloc.robust.lift import LiftMonitor
from fgloc.sensors import registry
from fgloc.sensors.rest import commanded_to_move, is_standing
from fgloc.types import FloatArray, InertialEvent, MotionMeasurement, MotionReadings, Step, by_class

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
    """Stretches of time and what the IMU shows beside them.

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
    """Find them.

    Args:
        signals: of the recording.
        config: with which wheels and gyro are read.
        path: of the wheels, likewise.
        up: ``(3,)`` the base's z axis in the IMU's frame, times the scale of its rates.
    """
    rates = signals.rates()
    if rates is None:
        return Handling()
    monitor, signs, sure, resting = LiftMonitor(math.inf, up), [], [], []
    for k, (step, readings) in enumerate(_steps(signals, config, up)):
        at = (step.stamp_ns - signals.origin_ns) * 1e-9
        told = [d.reason for d in monitor.observe(k, step, readings)]
        if readings.wheels is not None and is_standing(readings.wheels.motion, step.dt):
            resting.append(at)
        if any(reason != "carried" for reason in told):
            signs.append(at)
            monitor.carried = False  # a sign is one by itself
            # Rough ground throws a robot that drives as hands do
            if set(told) != {"vertical_velocity"} or (resting and resting[-1] == at):
                sure.append(at)
    lifted = tuple((a, b) for a, b in _merged(signs, _APART_S, _LASTS_S) if any(a <= at <= b for at in sure))
    held = tuple(_held(path, *rates[:2], up, lifted))
    times, force = rates[0], np.linalg.norm(rates[2], axis=1)
    rest = np.array(resting)
    quiet = ~_inside(rest, lifted)
    nearest = np.abs(times - rest[np.clip(np.searchsorted(rest, times), 0, len(rest) - 1)]) if len(rest) else times
    still = (nearest < _STEP_S) & ~_inside(times, lifted) & np.append(True, np.diff(force) != 0.0)
    gravity = float(np.median(force[still])) if quiet.sum() * _STEP_S > _REST_S and still.sum() > 10 else None
    return Handling(lifted, held, gravity)


def outside(signals: Signals, found: Handling) -> Signals:
    """The signals of the IMU without these stretches."""
    times = np.array([row[0] for row in signals.imu])
    kept = ~_inside(times, found.spans)
    return replace(signals, imu=[row for row, keep in zip(signals.imu, kept, strict=True) if keep])


def cut(path: Path, found: Handling) -> Path:
    """The wheels' path, whose motion is not known in these stretches."""
    handled = _inside(path.times, found.spans)
    return Path(path.times, path.poses, path.gaps + np.cumsum(handled))


def _steps(signals: Signals, config: Config, up: FloatArray) -> Iterator[tuple[Step, MotionReadings]]:
    """Steps of the whole recording with what wheels and gyro measure."""
    wheels, gyro = registry.odometer().build(config), registry.rate_sensor().build(config, up)
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
    turned = np.append(0.0, np.cumsum(0.5 * ((rates[1:] + rates[:-1]) @ up) * np.diff(times)))
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
