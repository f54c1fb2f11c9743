"""The IMU against the wheels: axis, sign, unit, gravity, and the times in which a person had the robot in hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.handling import Span, cut, handling, outside
from fgloc.diagnosis.landmarks import by_landmarks, distances_agree
from fgloc.diagnosis.pairs import RATE_SCALE, ROUGHLY, TELLS, Figure, RateFit
from fgloc.diagnosis.signals import Path
from fgloc.frames import homogeneous, rotation_of, sensor_pose
from fgloc.sensors.wheels.sensor import WRONG_SIDES
from fgloc.types import FloatArray, Severity

_TURNED_RAD = 0.5  # by the wheels: enough for any gyro to notice
_SHARED = 0.9  # share of a turn that another explains: one measurement
_GRAVITY = 5.0  # m/s²: less is no accelerometer
_TILTED_RAD = 0.5  # of gravity from the IMU's upward axis: no careful mounting, and no slope
_LEANS_RAD = 0.2  # the same where the gyro's scale is off too: a lean by an angle makes the rate its cosine
_COSINE = 0.02  # least such error of the scale: 1 - cos(0.2)
_GRAVITY_SIZE = 9.81  # m/s²; 9.78 to 9.83 on Earth
_GRAVITY_OFF, _OTHER_UNIT = 0.02, 0.15  # share beyond which an accelerometer is off, and beyond which its unit is


def check_dead(found: Conventions, path: Path) -> None:
    """Name a gyro that gives the same rates from the first message to the last, and leave the IMU out."""
    rates = found.signals.rates()
    if rates is None or np.ptp(rates[1], axis=0).any() or np.ptp(path.poses[:, 2]) < _TURNED_RAD:
        return
    text = (
        f"The gyro's rates never change (they are {', '.join(f'{w:g}' for w in rates[1][0])} rad/s), while the wheels "
        f"turn the robot by up to {math.degrees(np.ptp(path.poses[:, 2])):.0f}°: it does not measure"
    )
    found.add("imu.dead", text, {"recording.topics.imu": "none"})
    found.signals = replace(found.signals, imu=[])


def by_odometry(found: Conventions, path: Path) -> RateFit | None:
    """Compare the gyro with an odometry whose yaw is the gyro's, where the wheels' angles do not tell its turns."""
    driver = found.signals.odometry_path()
    if path.source != "ticks" or driver is None or found.signals.rates() is None:
        return None
    by_angles = (found.turn_about(path, axis) for axis in np.eye(3)[::-1])
    if any(fit is not None and fit.share > TELLS for fit in by_angles):
        return None
    trial = found.trial()
    fit = check_gyro(trial, driver)
    if fit is None or fit.share < _SHARED:
        return None
    found.findings += trial.findings
    found.config = trial.config
    return fit


def by_hand(found: Conventions, path: Path) -> Path:
    """Report when the robot was held, lifted or turned by hand, and cut that time from the signals and the path."""
    trial = found.trial()
    check_gyro(trial, path)
    if trial.codes & {"imu.axes", "imu.gravity"}:
        return path  # what turns is not what tilts
    in_hand = handling(found.signals, trial.config, path, found.up * abs(trial.config.gyro.scale))
    if sum(b - a for a, b in in_hand.spans) > 0.5 * (path.times[-1] - path.times[0]):
        return path  # no robot is in hands for most of a drive: the gyro's unit or axes are wrong
    for code, what, spans in (
        ("motion.held", "The robot was held, or its wheels spun: they turn more than the gyro from ", in_hand.held),
        ("motion.lifted", "The robot was lifted or turned by hand, by gyro and accelerometer, from ", in_hand.lifted),
    ):
        if spans:
            found.add(code, f"{what}{_text(spans)}", None, Figure(spans[0][0], 1.0), Severity.WARNING)
    size = in_hand.gravity
    if size is not None and _GRAVITY_OFF < abs(size / _GRAVITY_SIZE - 1.0) < _OTHER_UNIT:
        text = (
            f"The specific force at rest is {size:.2f} m/s², {abs(100.0 * (size / _GRAVITY_SIZE - 1.0)):.1f} % "
            f"{'more' if size > _GRAVITY_SIZE else 'less'} than gravity: scale or bias of the accelerometer is off, "
            "and tilts by it are as much in doubt"
        )
        found.add("imu.gravity_scale", text, None, Figure(size, 0.05), Severity.NOTE)
    if not in_hand.spans:
        return path
    found.signals = outside(found.signals, in_hand)
    return cut(path, in_hand)


def check_wheels(found: Conventions, path: Path) -> Path:
    """Name wheels that count backwards, in another unit, before a gear or of other radii; the path with that undone.

    The gyro's turn is what they are held against.
    A unit is one unless sightings refute it; anything else may be the track alone, unless sightings confirm it.
    """
    if found.signals.rates() is None:
        return path
    fit = found.turn_about(path, found.up * found.config.gyro.scale)
    if fit is None or fit.share < TELLS:
        return _one_backwards(found, path)
    if fit.scale.value <= 0.0:
        return path
    off_by = found.wheels_off_by(path, 1.0 / fit.scale.value)
    if off_by is None:
        return path
    factor, code, clause = off_by
    other, seen = found.path_with(found.wheel_lines(factor)), found.signals.sightings()
    agree = None if other is None or seen is None else distances_agree(found, other, seen)
    if other is None or agree is False or (agree is None and code != "wheels.unit"):
        # it is the track or the gyro, beside whatever the wheels are off by
        return path if seen is None else by_landmarks(found, path, seen)
    also = ", and by the landmarks they move as much too far" if agree else ""
    text = f"The wheels turn {fit.scale.value:.3g} ± {fit.scale.sigma:.2g} times as much as the gyro{also}: {clause}"
    share = Figure(1.0 / fit.scale.value, fit.scale.sigma / fit.scale.value**2)
    found.add(code, text, found.wheel_lines(factor), share)
    return other


def _one_backwards(found: Conventions, path: Path) -> Path:
    """Name one side of the wheels that counts backwards: the way that the wheels tell is the gyro's turn."""
    up, rates = found.up * found.config.gyro.scale, found.signals.rates()
    gravity = None if rates is None else _gravity_axis(rates[2])
    if gravity is not None and gravity @ up < -0.5 * abs(found.config.gyro.scale):
        up = -up  # an IMU that hangs upside down, which is named besides
    for kind in ("left_reversed", "right_reversed"):
        lines = found.right_sides(kind)
        other = found.path_with(lines) if lines and path.source == "ticks" else None
        fit = None if other is None else found.turn_about(other, up)
        if other is not None and fit is not None and fit.share > TELLS and fit.scale.value > 0.0:
            found.add("wheels.reversed", f"By the gyro the wheels {WRONG_SIDES[kind]}", lines)
            return check_wheels(found, other)
    return path


def _text(spans: Sequence[Span]) -> str:
    return ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in spans)


def check_gyro(found: Conventions, path: Path) -> RateFit | None:
    """Compare axis, sign, unit and lag of the gyro; the fit of the axis that measures the turn, None: none does."""
    rates = found.signals.rates()
    if rates is None:
        return None
    force = rates[2]
    given = found.config.gyro.scale
    sign = math.copysign(1.0, given)
    up = found.up * (sign if found.imu_up is None else 1.0)  # a mounting has the sign of the scale in it
    configured = found.turn_about(path, up * abs(given))
    gravity = _gravity_axis(force)
    if configured is not None and configured.share > TELLS and configured.scale.value > 0.0:
        return _check_scale(found, _by_gravity(found, path, force, up * sign, configured))
    if configured is not None and configured.share > TELLS and gravity is not None and gravity @ up * sign > 0.5:
        found.opposite = True  # the IMU stands upright: wheels or gyro count the other way
        return replace(configured, scale=replace(configured.scale, value=-configured.scale.value))
    about = {k: found.turn_about(path, axis) for k, axis in enumerate(np.eye(3))}
    fits = {k: fit for k, fit in about.items() if fit is not None and fit.share > TELLS}
    if not fits:
        check_gravity(found, force, up * sign)
        return None
    k = max(fits, key=lambda i: fits[i].share + (0.1 if gravity is not None and abs(gravity[i]) > 0.85 else 0.0))
    axis = np.zeros(3)
    axis[k] = math.copysign(1.0, fits[k].scale.value)
    _set_axis(found, axis, gravity, fits[k])
    again = found.turn_about(path, axis * abs(found.config.gyro.scale))
    return None if again is None else _check_scale(found, again)


def _set_axis(found: Conventions, axis: FloatArray, gravity: FloatArray | None, fit: RateFit) -> None:
    """Name the axis of the IMU that points up, and set it."""
    scale = found.config.gyro.scale
    by_gravity = "" if gravity is None else f", and gravity lies along {_named(gravity)}"
    text = (
        f"The turn of the wheels is the gyro's {_named(axis)} axis, not the one that its mounting says (it explains "
        f"{100.0 * fit.share:.0f} % of the wheels' turn{by_gravity})"
    )
    lines: dict[str, Any] = {"recording.imu_pose": _pose_for(axis)}
    if gravity is not None and gravity @ axis < -0.5:  # a mirror: no turn of the IMU does both
        lines = {"recording.imu_pose": _pose_for(-axis), "gyro.scale": -abs(scale)}
        text += "; gravity has the opposite sign, as of left-handed axes"
    elif scale < 0.0:
        lines["gyro.scale"] = -scale
    found.add("imu.axes", text, lines)


def _pose_for(up: FloatArray) -> list[float]:
    """``recording.imu_pose`` of an IMU whose axis ``up (3,)`` points upwards, by the least turn."""
    across = np.cross(up, [0.0, 0.0, 1.0])
    size = float(np.linalg.norm(across))
    T = homogeneous(rotation_of(math.atan2(size, float(up[2])) * (across / size if size > 1e-9 else np.eye(3)[0])))
    return [0.0, 0.0, 0.0, *(round(v, 4) + 0.0 for v in sensor_pose(T, optical=False)[3:])]


def _by_gravity(found: Conventions, path: Path, force: FloatArray, up: FloatArray, fit: RateFit) -> RateFit:
    """Name an IMU that is not upright by its accelerometer; the fit of the turn about the axis that is."""
    axis, given = _gravity_axis(force), abs(found.config.gyro.scale)
    about = None if axis is None else found.turn_about(path, axis * given)
    if about is None or about.share < TELLS or about.scale.value <= 0.0:
        check_gravity(found, force, up)
        return fit
    mistaken = fit.scale.off(1.0, _COSINE) and abs(about.scale.value - 1.0) < 0.5 * abs(fit.scale.value - 1.0)
    tilted = check_gravity(found, force, up, _LEANS_RAD if mistaken else _TILTED_RAD)
    return about if tilted else fit


def _gravity_axis(force: FloatArray) -> FloatArray | None:
    mean = np.median(force, axis=0)
    size = float(np.linalg.norm(mean))
    return None if not size > _GRAVITY else np.asarray(mean / size)


def check_gravity(found: Conventions, force: FloatArray, up: FloatArray, least_rad: float = _TILTED_RAD) -> bool:
    """Report an IMU that is not upright by its accelerometer, although its gyro agrees or measures no turn."""
    axis = _gravity_axis(force)
    if axis is None or math.acos(float(np.clip(axis @ up, -1.0, 1.0))) < least_rad:
        return False
    k, snapped = int(np.argmax(np.abs(axis))), np.zeros(3)
    snapped[k] = math.copysign(1.0, axis[k])
    if float(axis @ snapped) < math.cos(_TILTED_RAD) or float(up @ snapped) > math.cos(_TILTED_RAD):
        snapped = axis
    text = f"The IMU's accelerometer has gravity along {_named(axis)}, not along the axis that its mounting says"
    found.add("imu.gravity", text, {"recording.imu_pose": _pose_for(snapped)})
    return True


def _named(axis: FloatArray) -> str:
    k = int(np.argmax(np.abs(axis)))
    named = f"{'-' if axis[k] < 0 else ''}{'xyz'[k]}"
    return named if abs(axis[k]) > 0.9 else f"({', '.join(f'{v:.2f}' for v in axis)})"


def _check_scale(found: Conventions, fit: RateFit) -> RateFit:
    """Name a gyro in degrees, or a track that the turn refutes."""
    factor = fit.scale.value  # wheels' turn over the gyro's as configured
    log, degrees = math.log(max(factor, 1e-9)), math.pi / 180.0
    omega = found.config.wheels.scale_omega
    if abs(log - math.log(degrees)) < ROUGHLY:
        text = f"The gyro's rates are in degrees: they are {1.0 / factor:.1f} times those of the wheels"
        found.add("imu.unit", text, {"gyro.scale": round(found.config.gyro.scale * degrees, 7)}, fit.scale)
    elif abs(log + math.log(degrees)) < ROUGHLY:
        text = f"The wheels' yaw rate is {factor:.1f} times the gyro's: it is in degrees"
        found.add("odometry.yaw_unit", text, {"wheels.scale_omega": round(omega * degrees, 7)}, fit.scale)
    elif fit.scale.off(1.0, RATE_SCALE):
        text = (
            f"The wheels turn {factor:.3f} ± {fit.scale.sigma:.3f} times as much as the gyro (a track as the turn sees "
            "it, or skidding wheels; a gyro is seldom off by so much)"
        )
        share = Figure(1.0 / factor, fit.scale.sigma / factor**2)
        found.add("wheels.turn", text, {"wheels.scale_omega": round(omega / factor, 4)}, share)
    return fit
