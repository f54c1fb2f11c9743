"""Odometry, wheels' angles and commands against each other: unit, sign, frame and lag of what drivers report."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fgloc.diagnosis.comparison import WHEELS, Conventions, unit_of
from fgloc.diagnosis.pairs import FOLLOWS, ROUGHLY, SKID, TELLS, VARIED, Figure, fit_rate, fit_way, irls, weighted
from fgloc.diagnosis.signals import SILENT_S, Path, in_order, turn_by
from fgloc.sensors.wheels.naming import goes_sideways
from fgloc.sensors.wheels.sensor import WRONG_SIDES, settings_of
from fgloc.types import ControlEvent, FloatArray, Severity

_ASIDE = 0.1  # share of the way that is sideways: the lateral part of a turn about a sensor is less
_TWIST_LATE_S = 0.1  # of a twist against its pose
_APART_RAD, _WINDOWS, _SAMPLES = 0.05, 6, 4  # rad in half a second, for so many of them with so many messages
_SAME_TURN = 0.3  # share of the difference of wheels and gyro beyond which an odometry's yaw is not the gyro's
_OBEYED = 0.2  # logarithm of the share of its commands by which a robot moves more or less
_SAME_SCALE = 0.25  # logarithm of a speed over another that is no unit


def check_odometry(found: Conventions) -> Path | None:
    """Compare the odometry's pose, twist and gyro; motion by the wheels with what is found, None: too few messages."""
    given = found.config.wheels
    path = found.signals.path(found.config)
    _check_twist(found, path)
    _check_yaw_of_gyro(found)
    return path if found.config.wheels == given else found.signals.path(found.config)


def _check_twist(found: Conventions, path: Path | None) -> None:
    pose = found.signals.odometry_path()
    if pose is None:
        return
    rows, times, yaw = in_order(found.signals.odometry), pose.times, pose.poses[:, 2]
    late_s = _check_twist_clock(found, pose, rows[:, 6])
    if late_s:
        rows[:, 4:] = np.column_stack([np.interp(times + late_s, times, column) for column in rows[:, 4:].T])
    place = rows[:, 1] + 1j * rows[:, 2]
    span = max(1, round(0.4 / max(float(np.median(np.diff(times))), 1e-3)))
    dt = times[span:] - times[:-span]
    moved, turned = place[span:] - place[:-span], yaw[span:] - yaw[:-span]
    whole = (dt < 1.5) & (dt > 0.05) & (np.abs(moved) < 5.0 * dt + 0.5)
    if whole.sum() < 30:
        return
    middle = 0.5 * (yaw[span:] + yaw[:-span])
    # medians: drivers that differentiate a pose report spikes where its yaw wraps or its stamps jitter
    twists = np.median(np.lib.stride_tricks.sliding_window_view(rows[:-1, 4:7], span, axis=0), axis=2).T
    source = found.config.wheels.source
    if source == "auto" and path is not None and path.by_twist:
        source = "twist"
    grave = Severity.ERROR if source == "twist" else Severity.WARNING if source == "auto" else Severity.NOTE
    _check_speed(found, (moved / dt)[whole], middle[whole], (twists[0] + 1j * twists[1])[whole], grave)
    _check_rate(found, (turned / dt)[whole], twists[2][whole], moved[whole], middle[whole], grave)
    body = (moved * np.exp(-1j * middle) / dt)[whole]
    aside, most = float(np.abs(body.imag).sum()), float(np.abs(body).sum())
    if aside > _ASIDE * most and np.ptp(twists[1]) > 0.0 and np.corrcoef(body.imag, twists[1][whole])[0, 1] > TELLS:
        text = f"The robot moves sideways too ({100.0 * aside / most:.0f} % of its way): mecanum or omni wheels"
        found.add("odometry.sideways", text, severity=Severity.NOTE)


def _check_speed(
    found: Conventions, moved: np.ndarray[Any, Any], yaw: FloatArray, twist: np.ndarray[Any, Any], grave: Severity
) -> None:
    """Unit, sign and frame of the reported speed, by the change of the pose."""
    if float(np.quantile(np.abs(moved), 0.9)) < 0.03 or not np.abs(twist).max() > 0.0:
        return
    fits = []
    for reference in (moved * np.exp(-1j * yaw), moved):  # in the robot's axes, and in the world's
        slope = complex(irls(reference[:, None], twist, 0.05 * float(np.quantile(np.abs(twist), 0.9)) + 1e-9)[0][0])
        off = np.minimum(np.abs(twist - slope * reference) / abs(slope or 1.0), 1.0)
        fits.append((slope, float(np.mean(off**2))))
    spread = float(np.abs(np.mean(np.exp(1j * yaw))))  # 1: it drove in one direction
    (c, misfit), (_, in_world) = fits
    pose = {"wheels.source": "pose"}
    if in_world < 0.3 * misfit and spread < 0.97 and misfit > 0.05 * float(np.mean(np.abs(moved) ** 2)):
        text = (
            "The odometry's twist is in the world's axes: there it follows the change of the pose, not in the robot's"
        )
        found.add("odometry.twist_frame", text, pose, None, grave)
        return
    if misfit > 0.5 * float(np.mean(np.abs(moved) ** 2)) or abs(c) < 1e-9:
        return
    ratio = 1.0 / abs(c)  # true over reported
    turned = abs(math.remainder(float(np.angle(c)), math.tau))
    same, unit = abs(math.log(ratio)) < _SAME_SCALE, unit_of(ratio)
    lines: dict[str, Any] = pose
    if same and turned < 0.5:
        return
    if turned > 2.6 and same:
        text = "The odometry's twist has the opposite direction of its pose's motion"
    elif turned > 0.5:
        text = "The odometry's twist is turned against its pose's motion"
    elif unit is not None:
        text = f"The odometry's speeds are in {unit[1]}: they are {abs(c):.4g} times the change of its pose"
        lines = _of_twist(found, {"wheels.scale_v": round(unit[0] * found.config.wheels.scale_v, 7)})
    else:
        text = f"The odometry's speeds are {abs(c):.3g} times the change of its pose"
    found.add("odometry.twist_unit", text, lines, Figure(ratio, 0.0), grave)


def _check_rate(
    found: Conventions,
    rate: FloatArray,
    twist: FloatArray,
    moved: np.ndarray[Any, Any],
    yaw: FloatArray,
    grave: Severity,
) -> None:
    """Unit and sign of the reported yaw rate, by the change of the pose's yaw."""
    if float(np.quantile(np.abs(rate), 0.9)) < 0.03 or not np.abs(twist).max() > 0.0:
        return
    clipped = np.clip(twist, *np.quantile(twist, [0.01, 0.99]))
    c = float(rate @ clipped / (rate @ rate))
    if float(np.mean((clipped - c * rate) ** 2)) > 0.5 * float(np.mean(clipped**2)) or abs(c) < 1e-9:
        return
    if c < 0.0 and abs(math.log(-c)) < SKID:
        ahead = [abs(np.mean(np.exp(1j * (np.angle(moved) - s * yaw))[np.abs(moved) > 0.01])) for s in (1.0, -1.0)]
        text, lines = "The odometry's yaw rate has the opposite sign of its pose's yaw", {"wheels.source": "pose"}
        if ahead[0] < ahead[1]:
            text, lines = f"{text}, whose own path contradicts that yaw", {}
        found.add("odometry.yaw_sign", text, lines, Figure(c, 0.0), grave)
    elif abs(math.log(abs(c) * math.pi / 180.0)) < ROUGHLY:
        lines = _of_twist(found, {"wheels.scale_omega": round(math.pi / 180.0 * found.config.wheels.scale_omega, 7)})
        text = f"The odometry's yaw rate is in degrees: it is {c:.3g} times the change of its pose's yaw"
        found.add("odometry.yaw_unit", text, lines, Figure(1.0 / c, 0.0), grave)


def _check_twist_clock(found: Conventions, pose: Path, rates: FloatArray) -> float:
    """Name a twist that follows its own pose late: it is smoothed, or computed from older poses; its lag [s]."""
    times, yaw = pose.times, pose.poses[:, 2]
    known = (np.diff(times) > 0.0) & (np.diff(times) < SILENT_S)
    turns = np.diff(yaw)[known] / np.diff(times)[known]
    if not len(turns) or min(np.std(turns), np.std(rates)) < VARIED:
        return 0.0  # a constant turn has no lag, and a pose that does not move has none either
    fit = fit_rate(pose, times, turn_by(times, rates))
    interval_s = float(np.median(np.diff(times)))  # a mean twist of the last interval is half of it late
    if fit is None or fit.share < TELLS or not fit.late_s.off(0.0, _TWIST_LATE_S + 0.5 * interval_s):
        return 0.0
    late, used = fit.late_s, found.config.wheels.source == "twist"
    text = (
        f"The odometry's twist is {abs(late.value):.2f} ± {late.sigma:.2f} s {'late' if late.value > 0 else 'early'} "
        "against its own pose: it is smoothed or delayed"
    )
    if used:
        found.add("odometry.twist_late", text, {"wheels.source": "pose"}, late, Severity.WARNING)
    else:
        found.add("odometry.twist_late", f"{text}; the pose is used", None, late, Severity.NOTE)
    return late.value


def _of_twist(found: Conventions, lines: dict[str, Any]) -> dict[str, Any]:
    """Lines that undo an error of the twist alone: those given if the twist has to be used, else the source "pose"."""
    return lines if found.config.wheels.source == "twist" else {"wheels.source": "pose"}


def _check_yaw_of_gyro(found: Conventions) -> None:
    """Report an odometry whose yaw is the gyro's: it follows the gyro where the wheels' angles give another turn."""
    rates, rows, given = found.signals.rates(), in_order(found.signals.odometry), settings_of(found.signals.motion)
    if rates is None or len(rows) < 50 or given is None:
        return  # without the wheels' own turn, a yaw that is the gyro's and a good odometry look alike
    times, omega, _ = rates
    at = np.arange(max(times[0], rows[0, 0]), min(times[-1], rows[-1, 0]) - 0.5, 0.5)
    if len(at) < 20:
        return
    by_gyro = np.diff(np.interp(at, times, turn_by(times, omega @ found.up)))
    yaw = np.diff(np.interp(at, rows[:, 0], np.unwrap(rows[:, 3])))
    lines = {f"wheels.{key}": value for key, value in given.items()}
    angles = found.path_with(lines)
    if angles is None:  # no wheels are like this: the angles have another unit
        return
    by_wheels = np.diff(np.interp(at, angles.times, angles.poses[:, 2]))
    known = angles.known(at[:-1], at[1:]) & (np.diff(np.interp(at, times, np.arange(len(times)))) > _SAMPLES)
    apart = known & (np.abs(by_gyro - by_wheels) > _APART_RAD)
    if apart.sum() < _WINDOWS:
        return
    share = float(np.median(np.abs(yaw - by_gyro)[apart] / np.abs(by_wheels - by_gyro)[apart]))
    if share > _SAME_TURN:
        return
    text = (
        "The odometry's yaw is the gyro's, not the wheels': the two are one measurement (where the wheels turn "
        f"otherwise they differ by {100.0 * share:.0f} % of that)"
    )
    if found.config.wheels.source in ("auto", "ticks") and found.config.wheels.track is not None:
        lines = {}
    else:
        text += ". Yaw of the wheels is in their joints' angles"
    found.add("odometry.yaw_is_gyro", text, lines, severity=Severity.NOTE)


# --- the wheels' angles against the driver's odometry, and commands ---------------------------------------------------


def check_sideways(found: Conventions, path: Path) -> None:
    """Name motion to the side by odometry or commands, of a drive that cannot make it."""
    drive = found.config.wheels.drive
    if path.source not in ("ticks", "command") or (drive is not None and drive.slides):
        return
    told: dict[str, list[tuple[float, ...]]] = {
        "odometry": [row[4:6] for row in found.signals.odometry],
        "commands": [(e.v, e.vy) for e in found.signals.motion if isinstance(e, ControlEvent)],
    }
    for name, rows in told.items():
        share = goes_sideways(rows)
        if share is not None:
            kind = "two wheels" if drive is None else f"a drive of kind {drive.kind}"
            text = (
                f"By its {name} the robot goes sideways in {share:.0%} of its motion, which {kind} cannot: the wheels' "
                "motion lacks it. Set wheels.drive to a kind that can (mecanum, omni, swerve; docs/drives.md)"
            )
            found.add("wheels.sideways", text, None, Figure(share, 0.0))
            return


_BACKWARDS = {(True, True): "reversed", (True, False): "left_reversed", (False, True): "right_reversed"}


def check_angles(found: Conventions, path: Path) -> Path:
    """Compare signs and unit of the wheels' angles with the driver's odometry; the path with what is wrong undone."""
    driver = found.signals.odometry_path()
    if path.source != "ticks" or driver is None:
        return path
    way, turn = fit_way(path, driver.times, driver.way), fit_rate(path, driver.times, driver.poses[:, 2])
    factor = 0.0 if way is None or way.share < TELLS else way.scale.value  # by the angles, over the odometry's
    turns = 0.0 if turn is None or turn.share < TELLS else turn.scale.value
    wheels = found.config.wheels
    if turns < 0.0:
        gyro = found.turn_about(path, found.up * found.config.gyro.scale)
        if gyro is not None and gyro.share > TELLS and gyro.scale.value > 0.0:
            return path  # the odometry is wrong, and not used
    fitted, (left, right) = settings_of(found.signals.motion), (wheels.left_radius, wheels.right_radius)
    ratios = (1.0, 1.0)
    if fitted is not None and left and right and wheels.left_joint in (None, fitted["left_joint"]):
        ratios = fitted["left_radius"] / left, fitted["right_radius"] / right
    backwards = _BACKWARDS.get((ratios[0] < 0.0, ratios[1] < 0.0), "reversed" if factor < 0.0 else "")
    ratio = abs(ratios[0])
    unit = found.in_wheel_unit(path, ratio, ROUGHLY)
    if unit is not None:
        text = (
            f"The wheels' angles or rates are in {unit[1]}: by them the robot goes {1.0 / ratio:.4g} times as far as "
            "its odometry"
        )
        found.add("wheels.unit", text, found.wheel_lines(unit[0]), Figure(1.0 / ratio, 0.0))
    elif backwards:
        text = f"By the driver's odometry the wheels {WRONG_SIDES[backwards]}"
        found.add("wheels.reversed", text, found.right_sides(backwards) or {"wheels.source": "pose"})
    elif turns < 0.0:
        text = "The wheels' angles turn the other way than the driver's odometry: left and right are exchanged"
        found.add("wheels.sign", text, found.right_sides())
    else:
        return path
    return found.read_again(path)


def driver_late(found: Conventions, path: Path) -> Figure | None:
    """Lag of the driver's odometry against the wheels' angles; None: the odometry is the path, or nothing tells."""
    driver = found.signals.odometry_path()
    if path.source != "ticks" or driver is None:
        return None
    fits = [fit_way(path, driver.times, driver.way)]
    if "odometry.yaw_is_gyro" not in found.codes:
        fits.append(fit_rate(path, driver.times, driver.poses[:, 2]))
    lags = [fit.late_s for fit in fits if fit is not None and fit.share > TELLS]
    return weighted(lags) if lags else None


def check_commands(found: Conventions, path: Path) -> None:
    """Name commands in another unit than the motion that follows them; where they are the motion, others tell."""
    commanded = found.signals.commanded(found.config.wheels.hold_s)
    if path.source not in WHEELS or commanded is None:
        return
    times, integrals = commanded
    fit = fit_way(path, times, integrals[:, 0])
    unit = None if fit is None or fit.share < FOLLOWS or fit.scale.value <= 0.0 else unit_of(fit.scale.value, _OBEYED)
    if fit is None or unit is None:
        return
    text = (
        f"The commanded speeds are in {unit[1]}: the robot moves {fit.scale.value:.4g} ± {fit.scale.sigma:.2g} "
        "times as fast. A learned motion reads them; correct whoever publishes them"
    )
    found.add("commands.unit", text, None, fit.scale, Severity.WARNING)
