"""Steered drives against gyro and truth: unit and sign of the steering, unit of the speed, wheelbase."""

from __future__ import annotations

import math

import numpy as np

from fgloc.diagnosis.comparison import GEAR, Conventions, unit_of
from fgloc.diagnosis.pairs import RATE_SCALE, TELLS, Figure, fit_rate, fit_way
from fgloc.diagnosis.signals import Path
from fgloc.drives.steered import Ackermann, Tricycle
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import FloatArray

_SIDEWAYS_RAD = 0.5 * math.pi  # of a car's wheel: no further
_TWO_TURNS_RAD = 4.0 * math.pi  # further than this no wheel is steered, and hardly a steering wheel
_WHEELBASE = 2.5  # times: a wheelbase that somebody measured is not off by more
_OF_SPEED = 0.12  # logarithm by which turns of a speed in another unit may miss it: by the wheelbase


def check_steering(found: Conventions, path: Path) -> Path:
    """Name what is wrong with steering, speed and wheelbase of a steered drive; the path with that undone."""
    drive = found.steered
    if path.source != "ticks" or drive is None:
        return path
    path = _in_degrees(found, path, drive)
    gyro, true = found.turn_about(path, found.up * found.config.gyro.scale), _true_path(found)
    if gyro is None or gyro.share < TELLS:
        return path
    if gyro.scale.value > 0.0:
        return _by_size(found, path, gyro.scale, _way(path, true))
    turn = None if true is None else fit_rate(path, true.times, true.poses[:, 2])
    if turn is None or turn.share < TELLS or turn.scale.value > 0.0:
        return path  # either may be wrong
    text = "The steering counts to the other side than gyro and truth, which agree"
    found.add("wheels.sign", text, {"wheels.drive.steering_ratio": -drive.steering_ratio})
    return found.read_again(path)


def _by_size(found: Conventions, path: Path, turn: Figure, way: Figure | None) -> Path:
    """Name a speed in another unit, or a wrong wheelbase; the path with that undone.

    Args:
        found: the comparison.
        path: motion of the wheels.
        turn: that of the wheels over the true one.
        way: likewise; None: nothing tells.
    """
    drive = found.steered
    if drive is None or not turn.off(1.0, RATE_SCALE):
        return path
    speed = unit_of(1.0 / turn.value, _OF_SPEED)
    if way is not None and way.off(1.0, RATE_SCALE) and abs(math.log(way.value / turn.value)) < GEAR:
        speed = unit_of(1.0 / way.value) or (1.0 / way.value, "")
    elif way is not None:
        speed = None
    said = f"The wheels turn {turn.value:.3g} ± {turn.sigma:.2g} times as much as the gyro"
    if speed is not None:
        factor, name = speed
        known = "" if way is None else f" and go {way.value:.3g} times as far as the truth"
        why = f"their speed is in {name}" if name else "their speed is wrong by as much"
        other = "" if way is not None else " (else wheelbase or steering are wrong by as much)"
        lines = {"wheels.drive.radius": float(f"{drive.radius * factor:.6g}")}
        found.add("wheels.unit" if name else "wheels.gear", f"{said}{known}: {why}{other}", lines, turn)
    elif 1.0 / _WHEELBASE < turn.value < _WHEELBASE:
        lines = {"wheels.drive.wheelbase": float(f"{drive.wheelbase * turn.value:.4g}")}
        text = f"{said}: the wheelbase is wrong (else the steering's ratio is, by as much)"
        found.add("wheels.wheelbase", text, lines, turn)
    else:
        text = f"{said}: wheels.drive.steering_ratio or wheelbase is wrong by as much"
        found.add("wheels.wheelbase", text, None, turn)
    return found.read_again(path)


def _in_degrees(found: Conventions, path: Path, drive: Ackermann | Tricycle) -> Path:
    """Name a steering in degrees, by angles that no wheel has; the path with that undone."""
    largest = _largest(found, drive)
    least = _SIDEWAYS_RAD if isinstance(drive, Ackermann) else _TWO_TURNS_RAD
    if drive.steering_ticks is not None or not largest > least:
        return path
    lines = {"wheels.drive.steering_ratio": float(f"{drive.steering_ratio * math.pi / 180.0:.6g}")}
    other = found.path_with(lines)
    text = f"The steering reaches {largest:.3g} rad, more than a wheel can"
    if other is None or math.radians(largest) > _SIDEWAYS_RAD:
        found.add("wheels.steering", f"{text}: wheels.drive.steering_ratio is wrong")
        return path
    turn = found.turn_about(other, found.up * found.config.gyro.scale)
    if largest < _TWO_TURNS_RAD and (turn is None or turn.share < TELLS):
        found.add("wheels.steering", f"{text}: its angles are in degrees, or those of the steering wheel")
        return path
    found.add("wheels.steering", f"{text}: its angles are in degrees", lines, Figure(largest, 0.0))
    return other


def _largest(found: Conventions, drive: Ackermann | Tricycle) -> float:
    """Largest angle of the steering as configured [rad], but for one of a hundred; 0: none is told."""
    angles = [
        abs(drive.steering_ratio * float(event.position[k]) + drive.steering_zero)
        for event in found.signals.motion
        if isinstance(event, JointsEvent) and len(event.position) == len(event.names)
        for k, name in enumerate(event.names)
        if name in drive.steered and math.isfinite(event.position[k])
    ]
    return float(np.quantile(angles, 0.99)) if angles else 0.0


def _way(path: Path, true: Path | None) -> Figure | None:
    """Way of the wheels over that of the truth; None: there is no truth with a yaw, or it does not tell."""
    fit = None if true is None else fit_way(path, true.times, true.way)
    return fit.scale if fit is not None and fit.share > TELLS and fit.scale.value > 0.0 else None


def _true_path(found: Conventions) -> Path | None:
    """Path of the truth as configured; None: there is none, or it has no yaw."""
    rows: FloatArray | None = found.signals.true_poses() if found.signals.true_yaw else None
    if rows is None:
        return None
    scale = found.config.truth.scale
    return Path(rows[:, 0], rows[:, 1:] * [scale, scale, 1.0], np.zeros(len(rows), dtype=np.int64))
