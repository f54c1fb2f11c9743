"""Conventions of a recording: axes, signs, units, mirrors, scales, lags and frames, by pairs of signals.

Nothing here needs a pose, and only the last comparison needs a map. What is found is discrete or far beyond what an
installer may be off by; smaller deviations are constants, which the graph estimates. `init` writes the lines that undo
what is found, every other command names them first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fgloc import se2
from fgloc.config import Config, Role, WheelsConfig, one_line, setting, with_value
from fgloc.diagnosis.handling import Handling, Span, cut, handling, outside
from fgloc.diagnosis.pairs import (
    AXES,
    FOLLOWS,
    TURN,
    BodyFit,
    Figure,
    Mounting,
    Noise,
    RateFit,
    compared,
    fit_body,
    fit_map,
    fit_on_map,
    fit_rate,
    fit_sightings,
    fit_way,
    irls,
    jackknife,
    planar,
    track_noise,
    weighted,
)
from fgloc.diagnosis.signals import Path, Sightings, Signals, in_order, turn_by
from fgloc.frames import rotation_of, sensor_pose
from fgloc.sensors.wheels.naming import goes_sideways
from fgloc.sensors.wheels.sensor import settings_of
from fgloc.types import ControlEvent, Finding, FloatArray, LandmarkMap, Severity

_LATE_S = 0.03  # less is within what drivers mean by a stamp
_RESPONSE_S = 0.1  # a robot follows its commands with a lag of its own, which is no clock's
_LATE_SIGMAS = 4.0  # of a lag that is corrected: its sigma is the larger of two jackknives
_BOTH_SIGMAS = 2.5  # of each of two lags that are alike: one clock is late, and they are corrected by their mean
_SCALE = 0.03  # of a distance: less is a constant, which the graph estimates
_SURVEYED = 0.15  # of a distance on a map: likewise for what is paced off, or mapped by worn wheels
_UNSURE = 0.1  # share of a scale by which it is not known
_VARIED = 0.05  # rad/s, m/s: standard deviation of a motion that tells one time from another
_WHEELS_OFF = 0.2  # log scale of a truth: wheels may be off by less, and a truth that is no unit is seldom off by more
_PRIOR_SIGMAS = 4.0  # of the wheels, by which a truth may find them off: what is further off no run estimates
_KNOWN_YAW = 0.01  # rad: sigma of the yaw of a tracked body that hardly turned
_ASIDE = 0.1  # share of the way that is sideways: the lateral part of a turn about a sensor is less
_GYRO_SCALE = 0.02  # by which an uncalibrated gyro may be off
_RATE_SCALE = 0.1  # of a turn: no gyro and no careful track is off by more
_TURNED_RAD = 0.05  # of a sensor: likewise
_PLACED_M = 0.08
_BIAS_M = 0.03  # of a range
_ASKEW_RAD = 0.08  # standard deviation of bearings from which on depths differ from ranges, by 1 % at two of them
_LEAST_COS = math.cos(math.radians(80.0))  # as the measurement has it
_GAIN, _GAIN_SIGMAS = 0.05, 3.0  # of the log-likelihood of a sighting, by which another reading is named
_BIASED = 3.0  # times the configured bias that ranges usually are: shorter ones are in another unit than it
_TELLS = 0.7  # share of a turn that another explains: two that tell the same
_WORSE = 1.6  # times the misfit of the best axes from which on others are refuted
_MIRRORED = 1.35  # likewise of a mirror image, where nothing else is compared
_FROZEN_S, _MOVES_MPS, _FROZEN_SHARE = 0.1, 0.05, 0.02  # of a truth; fewer repetitions are a slower source's
_TWIST_LATE_S, _SILENT_S = 0.1, 0.6  # of a twist against its pose; without a message motion is not known
_SAME_YAW = 1e-3  # share of a turn by which a truth's yaw differs from the odometry's that it is
_WIDE_M, _IN_PLANE, _LEVEL_DEG = 0.3, 0.5, 1.0  # of a truth's places: spread, share off their plane, tilt of it
_PLANES = 8  # blocks of time of a plane's jackknife
_SKID = 0.7  # logarithm of a turn over another: a driver may give both of them, by different tracks
_ALIKE = 1.25  # times the best misfit within which the more usual axes are taken
_FITS = 0.3  # misfit over the median distance of landmarks above which nothing fits
_FIRST_S = 8.0  # of sightings that tell where a run began: wheels err by centimetres over it
_NO_MAP = 0.5  # residual over the spread of the landmarks: they stand elsewhere
_GRAVITY = 5.0  # m/s²: less is no accelerometer
_TILTED_RAD = 0.5  # of gravity from the IMU's upward axis: no careful mounting, and no slope
_GRAVITY_SIZE = 9.81  # m/s²; 9.78 to 9.83 on Earth
_GRAVITY_OFF, _OTHER_UNIT = 0.02, 0.15  # share beyond which an accelerometer is off, and beyond which its unit is
_APART_RAD, _WINDOWS, _SAMPLES = 0.05, 6, 4  # rad in half a second, for so many of them with so many messages
_SAME_TURN = 0.3  # share of the difference of wheels and gyro beyond which an odometry's yaw is not the gyro's
_WHEELS: dict[str, Role] = {"ticks": "joints", "odometry": "odometry"}  # role by source of the motion
_DRIFTED_S, _LAG_SIGMAS = 0.06, 3.5  # of the lag's change from half to half; a drift widens the sigmas of both

_UNITS = {0.3048: "feet", 0.0254: "inches", 0.01: "centimetres", 0.001: "millimetres", 1 / 3.6: "km/h"}
_UNIT = 0.04  # share by which a scale may miss a unit's
_ROUGHLY = 0.35  # logarithm of a scale: nothing else is so near to degrees for radians
_SHARED = 0.9  # share of a turn that another explains: one measurement
_OBEYED = 0.2  # logarithm of the share of its commands by which a robot moves more or less


@dataclass
class Conventions:
    """Findings on the conventions of a recording, the configuration with their lines set, and the evidence.

    Attributes:
        findings: with the lines that undo them.
        config: with those lines.
        compared: sentences on the pairs that were compared and agree, for `init`'s comments.
        noise: of the sensor of landmarks, where its axes are right; no finding, but a better start than the defaults.
        handling: when a person had the robot in hand; nothing is compared there.
        opposite: whether wheels and gyro turn in opposite directions, and gravity does not tell which is wrong.
        commanded: whether commands stand in for wheels.
        wheels: with which the wheels' path was read; what is found since then is not in it.
    """

    config: Config
    findings: list[Finding] = field(default_factory=list)
    compared: list[str] = field(default_factory=list)
    noise: Noise | None = None
    handling: Handling = field(default_factory=Handling)
    opposite: bool = False
    commanded: bool = False
    wheels: WheelsConfig = field(default_factory=WheelsConfig)

    def add(self, code: str, text: str, lines: Mapping[str, Any], figure: Figure | None, severity: Severity) -> None:
        """Note a finding, and set its lines."""
        shown = {setting(key): one_line(value) for key, value in lines.items()}
        value, sigma = (None, None) if figure is None else (figure.value, figure.sigma)
        remedy = "; ".join(f"set {key}: {value}" for key, value in shown.items())
        self.findings.append(Finding(code, f"{text}{': ' + remedy if remedy else ''}.", severity, shown, value, sigma))
        for key, given in lines.items():
            with suppress(ValueError):  # beyond what a setting may be: it is said, and left as it is
                self.config = with_value(self.config, key, given)


def conventions(
    signals: Signals,
    config: Config,
    T_base_sensor: FloatArray | None = None,
    imu_up: FloatArray | None = None,
    landmark_map: LandmarkMap | None = None,
) -> Conventions:
    """Compare all pairs of signals of a recording.

    Args:
        signals: of the recording, read as configured.
        config: as configured.
        T_base_sensor: ``(4, 4)`` place of the sensor that reports ranges or marker poses; None: the base.
        imu_up: ``(3,)`` the base's z axis in the IMU's frame, as configured; None: z.
        landmark_map: None: nothing is compared with a map.
    """
    found = Conventions(config)
    _odometry(found, signals)
    _yaw_of_gyro(found, signals, imu_up)
    path = signals.path(found.config)
    found.wheels = found.config.wheels
    found.commanded = signals.source == "command"
    if path is None or path.length_m < 0.05:
        if (rates := signals.rates()) is not None:
            _gravity(found, rates[2], _unit(imu_up))
        return found
    _sideways(found, signals)
    path = _angles(found, signals, path, imu_up)
    _commands(found, signals, path)
    by_odometry = _gyro_by_odometry(found, signals, path, imu_up)
    signals, path = _by_hand(found, signals, path, imu_up)
    driver = _driver_late(found, signals, path)
    gyro = _gyro(found, signals, path, imu_up)
    if by_odometry is not None and driver is not None and (gyro is None or gyro.share < _TELLS):
        late_s = Figure(by_odometry.late_s.value + driver.value, math.hypot(by_odometry.late_s.sigma, driver.sigma))
        gyro = replace(by_odometry, late_s=late_s)
    seen = signals.sightings()
    undecided = found.opposite and not _opposite(found, signals, path, seen, T_base_sensor)
    if found.opposite and not undecided:
        path, found.wheels = signals.path(found.config) or path, found.config.wheels
    by_gyro, turn_sigma = _turn_of(path, gyro)
    sensor = None if seen is None else _sensor(found, by_gyro, seen, T_base_sensor, landmark_map, turn_sigma)
    drifting = _drifts(found, signals, path, imu_up, T_base_sensor)
    undecided &= not any(finding.code == "imu.sign" for finding in found.findings)
    truth = None if undecided else _true_body(found, signals, path)  # wheels that may turn the wrong way judge no truth
    gyro, sensor = None if "imu" in drifting else gyro, None if "sightings" in drifting else sensor
    later_s = _clocks(found, signals, path, gyro, driver, sensor, truth)
    _first_pose(found, path, seen, T_base_sensor, landmark_map)
    if truth is not None:
        late_s = replace(truth.late_s, value=truth.late_s.value - later_s)
        truth = replace(truth, late_s=late_s if _varied(path) else Figure(0.0, math.inf))
        for code, text, lines, figure in _truth_lines(found, truth):
            severity = Severity.WARNING
            if code == "wheels.scale" and figure is not None:
                severity = _refuted(figure, found.config.wheels.scale_sigma)
            found.add(code, text, lines, figure, severity)
    return found


def _sideways(found: Conventions, signals: Signals) -> None:
    """Motion to the side by odometry or commands, of a drive that cannot make it."""
    drive = found.config.wheels.drive
    if signals.source not in ("ticks", "command") or (drive is not None and drive.slides):
        return
    told: dict[str, list[tuple[float, ...]]] = {
        "odometry": [row[4:6] for row in signals.odometry],
        "commands": [(e.v, e.vy) for e in signals.motion if isinstance(e, ControlEvent)],
    }
    for name, rows in told.items():
        share = goes_sideways(rows)
        if share is not None:
            kind = "two wheels" if drive is None else f"a drive of kind {drive.kind}"
            text = (
                f"By its {name} the robot goes sideways in {share:.0%} of its motion, which {kind} cannot: the wheels' "
                "motion lacks it. Set wheels.drive to a kind that can (mecanum, omni, swerve; docs/drives.md)"
            )
            found.add("wheels.sideways", text, {}, Figure(share, 0.0), Severity.ERROR)
            return


def unit_of(scale: float) -> tuple[float, str] | None:
    """Factor and name of the unit of length that a scale (true over reported) is near; None: no usual one."""
    for factor, name in _UNITS.items():
        for known, text in ((factor, name), (1.0 / factor, f"metres for {name}")):
            if abs(math.log(abs(scale) / known)) < _UNIT:
                return known, text
    return None


# --- the odometry's pose and its twist --------------------------------------------------------------------------------


def _odometry(found: Conventions, signals: Signals) -> None:
    pose = signals.odometry_path()
    if pose is None:
        return
    rows, times, yaw = in_order(signals.odometry), pose.times, pose.poses[:, 2]
    late_s = _twist_late(found, pose, rows[:, 6])
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
    if source == "auto" and signals.path(found.config) is not None and signals.by_twist:
        source = "twist"
    grave = Severity.ERROR if source == "twist" else Severity.WARNING if source == "auto" else Severity.NOTE
    _twist_speed(found, (moved / dt)[whole], middle[whole], (twists[0] + 1j * twists[1])[whole], grave)
    _twist_rate(found, (turned / dt)[whole], twists[2][whole], moved[whole], middle[whole], grave)
    body = (moved * np.exp(-1j * middle) / dt)[whole]
    aside, most = float(np.abs(body.imag).sum()), float(np.abs(body).sum())
    if aside > _ASIDE * most and np.ptp(twists[1]) > 0.0 and np.corrcoef(body.imag, twists[1][whole])[0, 1] > _TELLS:
        text = f"The robot moves sideways too ({100.0 * aside / most:.0f} % of its way): mecanum or omni wheels"
        found.add("odometry.sideways", text, {}, None, Severity.NOTE)


def _twist_speed(
    found: Conventions, moved: np.ndarray[Any, Any], yaw: FloatArray, twist: np.ndarray[Any, Any], grave: Severity
) -> None:
    """Unit, sign and frame of the reported speed, by the change of the pose."""
    if float(np.quantile(np.abs(moved), 0.9)) < 0.03 or not np.abs(twist).max() > 0.0:
        return
    body = moved * np.exp(-1j * yaw)
    fits = {}
    for frame, reference in (("body", body), ("world", moved)):
        slope = complex(irls(reference[:, None], twist, 0.05 * float(np.quantile(np.abs(twist), 0.9)) + 1e-9)[0][0])
        fits[frame] = (
            slope,
            float(np.mean(np.minimum(np.abs(twist - slope * reference) / abs(slope or 1.0), 1.0) ** 2)),
        )
    spread = float(np.abs(np.mean(np.exp(1j * yaw))))  # 1: it drove in one direction
    (c, misfit), (_, in_world) = fits["body"], fits["world"]
    if in_world < 0.3 * misfit and spread < 0.97 and misfit > 0.05 * float(np.mean(np.abs(moved) ** 2)):
        found.add(
            "odometry.twist_frame",
            "The odometry's twist is in the world's axes: there it follows the change of the pose, not in the robot's",
            {"wheels.source": "pose"},
            None,
            grave,
        )
        return
    if misfit > 0.5 * float(np.mean(np.abs(moved) ** 2)) or abs(c) < 1e-9:
        return
    ratio = 1.0 / abs(c)  # true over reported
    turned = abs(math.remainder(float(np.angle(c)), math.tau))
    if abs(math.log(ratio)) < 0.25 and turned < 0.5:
        return
    unit = unit_of(ratio)
    lines: dict[str, Any]
    if turned > 2.6 and abs(math.log(ratio)) < 0.25:
        text, lines = "The odometry's twist has the opposite direction of its pose's motion", {"wheels.source": "pose"}
    elif turned > 0.5:
        text, lines = "The odometry's twist is turned against its pose's motion", {"wheels.source": "pose"}
    elif unit is not None:
        text = f"The odometry's speeds are in {unit[1]}: they are {abs(c):.4g} times the change of its pose"
        lines = _of_twist(found, {"wheels.scale_v": round(unit[0] * found.config.wheels.scale_v, 7)})
    else:
        text = f"The odometry's speeds are {abs(c):.3g} times the change of its pose"
        lines = {"wheels.source": "pose"}
    found.add("odometry.twist_unit", text, lines, Figure(ratio, 0.0), grave)


def _twist_rate(
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
    if c < 0.0 and abs(math.log(-c)) < _SKID:
        ahead = [abs(np.mean(np.exp(1j * (np.angle(moved) - s * yaw))[np.abs(moved) > 0.01])) for s in (1.0, -1.0)]
        text = "The odometry's yaw rate has the opposite sign of its pose's yaw"
        if ahead[0] >= ahead[1]:
            found.add("odometry.yaw_sign", text, {"wheels.source": "pose"}, Figure(c, 0.0), grave)
        else:
            found.add("odometry.yaw_sign", f"{text}, whose own path contradicts that yaw", {}, Figure(c, 0.0), grave)
    elif abs(math.log(abs(c) * math.pi / 180.0)) < _ROUGHLY:
        lines = _of_twist(found, {"wheels.scale_omega": round(math.pi / 180.0 * found.config.wheels.scale_omega, 7)})
        text = f"The odometry's yaw rate is in degrees: it is {c:.3g} times the change of its pose's yaw"
        found.add("odometry.yaw_unit", text, lines, Figure(1.0 / c, 0.0), grave)


def _twist_late(found: Conventions, pose: Path, rates: FloatArray) -> float:
    """Name a twist that follows its own pose late: it is smoothed, or computed from older poses; its lag [s]."""
    times, yaw = pose.times, pose.poses[:, 2]
    known = (np.diff(times) > 0.0) & (np.diff(times) < _SILENT_S)
    turns = np.diff(yaw)[known] / np.diff(times)[known]
    if not len(turns) or min(np.std(turns), np.std(rates)) < _VARIED:
        return 0.0  # a constant turn has no lag, and a pose that does not move has none either
    fit = fit_rate(pose, times, turn_by(times, rates))
    interval_s = float(np.median(np.diff(times)))  # a mean twist of the last interval is half of it late
    if fit is None or fit.share < _TELLS or not fit.late_s.off(0.0, _TWIST_LATE_S + 0.5 * interval_s):
        return 0.0
    late, used = fit.late_s, found.config.wheels.source == "twist"
    text = (
        f"The odometry's twist is {abs(late.value):.2f} ± {late.sigma:.2f} s {'late' if late.value > 0 else 'early'} "
        "against its own pose: it is smoothed or delayed"
    )
    lines = {"wheels.source": "pose"} if used else {}
    severity = Severity.WARNING if used else Severity.NOTE
    found.add("odometry.twist_late", text if used else f"{text}; the pose is used", lines, late, severity)
    return late.value


def _of_twist(found: Conventions, lines: dict[str, Any]) -> dict[str, Any]:
    """Lines that undo an error of the twist alone: those given if the twist has to be used, else the source "pose"."""
    return lines if found.config.wheels.source == "twist" else {"wheels.source": "pose"}


# --- the wheels' angles against the driver's odometry, and commands ---------------------------------------------------


def _angles(found: Conventions, signals: Signals, path: Path, imu_up: FloatArray | None) -> Path:
    """Compare signs and unit of the wheels' angles with the driver's odometry; the path with what is wrong undone."""
    driver = signals.odometry_path()
    if signals.source != "ticks" or driver is None:
        return path
    way, turn = fit_way(path, driver.times, driver.way), fit_rate(path, driver.times, driver.poses[:, 2])
    factor = 0.0 if way is None or way.share < _TELLS else way.scale.value  # by the angles, over the odometry's
    turns = 0.0 if turn is None or turn.share < _TELLS else turn.scale.value
    wheels, rates = found.config.wheels, signals.rates()
    if turns < 0.0 and rates is not None:
        gyro = fit_rate(path, rates[0], turn_by(rates[0], rates[1] @ _unit(imu_up)) * found.config.gyro.scale)
        if gyro is not None and gyro.share > _TELLS and gyro.scale.value > 0.0:
            return path  # the odometry is wrong, and not used
    fitted, radius = settings_of(signals.motion), wheels.left_radius
    unit = 1.0 if fitted is None or radius is None else fitted["left_radius"] / radius
    if fitted is not None and abs(math.log(unit * 180.0 / math.pi)) < _ROUGHLY:
        text = (
            f"The wheels' angles are in degrees: by them the robot goes {1.0 / unit:.4g} times as far as its odometry"
        )
        given = {"left_radius": wheels.left_radius, "right_radius": wheels.right_radius}
        lines = {f"wheels.{key}": round(value * math.pi / 180.0, 8) for key, value in given.items() if value}
        found.add("wheels.unit", text, lines, Figure(1.0 / unit, 0.0), Severity.ERROR)
    elif factor < 0.0:
        text = "The wheels' angles count backward when the robot goes forward, by the driver's odometry"
        found.add("wheels.reversed", text, {"wheels.source": "pose"}, None, Severity.ERROR)
    elif turns < 0.0:
        text = "The wheels' angles turn the other way than the driver's odometry: left and right are exchanged"
        swapped = {"wheels.left_joint": wheels.right_joint, "wheels.right_joint": wheels.left_joint}
        found.add("wheels.sign", text, swapped if all(swapped.values()) else {}, None, Severity.ERROR)
    else:
        return path
    return signals.path(found.config) or path


def _gyro_by_odometry(found: Conventions, signals: Signals, path: Path, imu_up: FloatArray | None) -> RateFit | None:
    """Compare the gyro with an odometry whose yaw is the gyro's, where the wheels' angles do not tell its turns."""
    driver, rates = signals.odometry_path(), signals.rates()
    if signals.source != "ticks" or driver is None or rates is None:
        return None
    turned = np.column_stack([turn_by(rates[0], rate) for rate in rates[1].T])
    by_angles = [fit_rate(path, rates[0], column) for column in turned.T]
    if any(fit is not None and fit.share > _TELLS for fit in by_angles):
        return None
    trial = Conventions(found.config)
    fit = _gyro(trial, signals, driver, imu_up)
    if fit is None or fit.share < _SHARED:
        return None
    found.findings += trial.findings
    found.config = trial.config
    return fit


def _driver_late(found: Conventions, signals: Signals, path: Path) -> Figure | None:
    """Lag of the driver's odometry against the wheels' angles; None: the odometry is the path, or nothing tells."""
    driver = signals.odometry_path()
    if signals.source != "ticks" or driver is None:
        return None
    fits = [fit_way(path, driver.times, driver.way)]
    if not any(f.code == "odometry.yaw_is_gyro" for f in found.findings):
        fits.append(fit_rate(path, driver.times, driver.poses[:, 2]))
    lags = [fit.late_s for fit in fits if fit is not None and fit.share > _TELLS]
    return weighted(lags) if lags else None


def _commands(found: Conventions, signals: Signals, path: Path) -> None:
    """Name commands in another unit than the motion that follows them; where they are the motion, others tell."""
    commanded = signals.commanded(found.config.wheels.hold_s)
    if signals.source not in _WHEELS or commanded is None:
        return
    times, integrals = commanded
    fit = fit_way(path, times, integrals[:, 0])
    if fit is None or fit.share < FOLLOWS or fit.scale.value <= 0.0:
        return
    units = {**_UNITS, **{1.0 / factor: f"metres for {name}" for factor, name in _UNITS.items()}}
    factor = min(units, key=lambda unit: abs(math.log(fit.scale.value / unit)))
    if abs(math.log(fit.scale.value / factor)) > _OBEYED:
        return
    text = (
        f"The commanded speeds are in {units[factor]}: the robot moves {fit.scale.value:.4g} ± {fit.scale.sigma:.2g} "
        "times as fast. A learned motion reads them; correct whoever publishes them"
    )
    found.add("commands.unit", text, {}, fit.scale, Severity.WARNING)


# --- one measurement twice, and hands ---------------------------------------------------------------------------------


def _yaw_of_gyro(found: Conventions, signals: Signals, imu_up: FloatArray | None) -> None:
    """Report an odometry whose yaw is the gyro's: it follows the gyro where the wheels' angles give another turn."""
    rates, rows = signals.rates(), in_order(signals.odometry)
    if rates is None or len(rows) < 50:
        return
    times, omega, _ = rates
    turned = turn_by(times, omega @ _unit(imu_up))
    at = np.arange(max(times[0], rows[0, 0]), min(times[-1], rows[-1, 0]) - 0.5, 0.5)
    if len(at) < 20:
        return
    by_gyro = np.diff(np.interp(at, times, turned))
    yaw = np.diff(np.interp(at, rows[:, 0], np.unwrap(rows[:, 3])))
    given = settings_of(signals.motion)
    if given is None:  # without the wheels' own turn, a yaw that is the gyro's and a good odometry look alike
        return
    lines = {f"wheels.{key}": value for key, value in given.items()}
    with_angles = found.config
    try:
        for key, value in lines.items():
            with_angles = with_value(with_angles, key, value)
    except ValueError:  # no wheels are like this: the angles have another unit
        return
    angles = signals.path(with_angles)
    if angles is None:
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
    found.add("odometry.yaw_is_gyro", text, lines, None, Severity.NOTE)


def _by_hand(found: Conventions, signals: Signals, path: Path, imu_up: FloatArray | None) -> tuple[Signals, Path]:
    """Report when the robot was held, lifted or turned by hand; return the signals without that time."""
    trial = Conventions(found.config)
    _gyro(trial, signals, path, imu_up)
    if any(f.code in ("imu.axes", "imu.gravity") for f in trial.findings):
        return signals, path  # what turns is not what tilts
    up = _unit(imu_up) * abs(trial.config.gyro.scale)
    by_hand = handling(signals, trial.config, path, up)
    if sum(b - a for a, b in by_hand.spans) > 0.5 * (path.times[-1] - path.times[0]):
        return signals, path  # no robot is in hands for most of a drive: the gyro's unit or axes are wrong
    found.handling = by_hand
    for code, what, spans in (
        (
            "motion.held",
            "The robot was held, or its wheels spun: they turn more than the gyro from ",
            by_hand.held,
        ),
        ("motion.lifted", "The robot was lifted or turned by hand, by gyro and accelerometer, from ", by_hand.lifted),
    ):
        if spans:
            start = Figure(spans[0][0], 1.0)
            found.add(code, f"{what}{_spans(spans)}", {}, start, Severity.WARNING)
    size = by_hand.gravity
    if size is not None and _GRAVITY_OFF < abs(size / _GRAVITY_SIZE - 1.0) < _OTHER_UNIT:
        text = (
            f"The specific force at rest is {size:.2f} m/s², {abs(100.0 * (size / _GRAVITY_SIZE - 1.0)):.1f} % "
            f"{'more' if size > _GRAVITY_SIZE else 'less'} than gravity: scale or bias of the accelerometer is off, "
            "and tilts by it are as much in doubt"
        )
        found.add("imu.gravity_scale", text, {}, Figure(size, 0.05), Severity.NOTE)
    if not by_hand.spans:
        return signals, path
    return outside(signals, by_hand), cut(path, by_hand)


def _spans(spans: Sequence[Span]) -> str:
    return ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in spans)


# --- the gyro and the wheels ------------------------------------------------------------------------------------------


def _unit(up: FloatArray | None) -> FloatArray:
    axis = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, dtype=float)
    return np.asarray(axis / max(float(np.linalg.norm(axis)), 1e-12))


def _gyro(found: Conventions, signals: Signals, path: Path, imu_up: FloatArray | None) -> RateFit | None:
    """Compare axis, sign, unit and lag of the gyro; the fit of the axis that measures the turn, None: none does."""
    rates = signals.rates()
    if rates is None:
        return None
    times, omega, force = rates
    turned = np.column_stack([turn_by(times, rate) for rate in omega.T])
    given = found.config.gyro.scale
    sign = math.copysign(1.0, given)
    up = _unit(imu_up) * (sign if imu_up is None else 1.0)  # a mounting has the sign of the scale in it
    configured = fit_rate(path, times, turned @ up * abs(given))
    gravity = _gravity_axis(force)
    if configured is not None and configured.share > _TELLS and configured.scale.value > 0.0:
        _gravity(found, force, up * sign)
        return _gyro_scale(found, configured, given)
    if configured is not None and configured.share > _TELLS and gravity is not None and gravity @ up * sign > 0.5:
        found.opposite = True  # the IMU stands upright: wheels or gyro count the other way
        return replace(configured, scale=replace(configured.scale, value=-configured.scale.value))
    fits = {k: fit for k in range(3) if (fit := fit_rate(path, times, turned[:, k])) is not None and fit.share > _TELLS}
    if not fits:
        _gravity(found, force, up * sign)
        return None
    k = max(fits, key=lambda i: fits[i].share + (0.1 if gravity is not None and abs(gravity[i]) > 0.85 else 0.0))
    fit = fits[k]
    axis = np.zeros(3)
    axis[k] = math.copysign(1.0, fit.scale.value)
    _turned_imu(found, axis, gravity, fit)
    again = fit_rate(path, times, turned @ axis * abs(found.config.gyro.scale))
    return None if again is None else _gyro_scale(found, again, abs(given))


def _turned_imu(found: Conventions, axis: FloatArray, gravity: FloatArray | None, fit: RateFit) -> None:
    """Name the axis of the IMU that points up, and set it."""
    named = f"{'-' if axis.sum() < 0 else ''}{'xyz'[int(np.argmax(np.abs(axis)))]}"
    scale = found.config.gyro.scale
    by_gravity = "" if gravity is None else f", and gravity lies along {_axis_text(gravity)}"
    text = (
        f"The turn of the wheels is the gyro's {named} axis, not the one that its mounting says (it explains "
        f"{100.0 * fit.share:.0f} % of the wheels' turn{by_gravity})"
    )
    lines: dict[str, Any] = {"recording.imu_pose": [0.0, 0.0, 0.0, *_rpy_for(axis)]}
    if gravity is not None and gravity @ axis < -0.5:  # a mirror: no turn of the IMU does both
        lines = {"recording.imu_pose": [0.0, 0.0, 0.0, *_rpy_for(-axis)], "gyro.scale": -abs(scale)}
        text += "; gravity has the opposite sign, as of left-handed axes"
    elif scale < 0.0:
        lines["gyro.scale"] = -scale
    found.add("imu.axes", text, lines, None, Severity.ERROR)


def _rpy_for(up: FloatArray) -> list[float]:
    """Roll, pitch and yaw [rad] of an IMU whose axis ``up (3,)`` points upwards, by the least turn."""
    z = np.array([0.0, 0.0, 1.0])
    across = np.cross(up, z)
    size = float(np.linalg.norm(across))
    angle = math.atan2(size, float(up @ z))
    R = rotation_of(angle * (across / size if size > 1e-9 else np.array([1.0, 0.0, 0.0])))
    T = np.eye(4)
    T[:3, :3] = R
    return [round(v, 4) + 0.0 for v in sensor_pose(T, optical=False)[3:]]


def _gravity_axis(force: FloatArray) -> FloatArray | None:
    mean = np.median(force, axis=0)
    size = float(np.linalg.norm(mean))
    return None if not size > _GRAVITY else np.asarray(mean / size)


def _opposite(
    found: Conventions, signals: Signals, path: Path, seen: Sightings | None, T_base_sensor: FloatArray | None
) -> bool:
    """Name which of wheels and gyro turns the wrong way, by the landmarks; whether it is the wheels."""
    if seen is None:
        if not signals.images:  # what images show is compared elsewhere
            text = "Wheels and gyro turn in opposite directions: left and right are exchanged, or the gyro's sign"
            found.add("yaw.sign", text, {}, None, Severity.ERROR)
        return False
    mirrored = Path(path.times, path.poses * [1.0, -1.0, -1.0], path.gaps)
    R = np.eye(3) if T_base_sensor is None else T_base_sensor[:3, :3]
    turned = Sightings(seen.times, seen.ids, seen.points @ R.T, seen.spatial)
    fits = [fit_sightings(one, turned).get("body") for one in (path, mirrored)]
    misfits = [math.inf if fit is None else fit.misfit for fit in fits]
    wheels = found.config.wheels
    if misfits[1] * _WORSE < misfits[0]:
        lines: dict[str, Any] = {"wheels.scale_omega": -wheels.scale_omega}
        if wheels.track is not None and wheels.left_joint is not None:
            lines = {"wheels.left_joint": wheels.right_joint, "wheels.right_joint": wheels.left_joint}
        text = "The wheels turn in the opposite direction of gyro and landmarks, which agree"
        found.add("wheels.sign", text, lines, None, Severity.ERROR)
        return True
    if misfits[0] * _WORSE < misfits[1]:
        text = "The gyro turns in the opposite direction of wheels and landmarks, which agree"
        found.add("imu.sign", text, {"gyro.scale": -found.config.gyro.scale}, None, Severity.ERROR)
    return False


def _gravity(found: Conventions, force: FloatArray, up: FloatArray) -> None:
    """Report an IMU that is not upright by its accelerometer, although its gyro agrees or measures no turn."""
    axis = _gravity_axis(force)
    if axis is None or math.acos(float(np.clip(axis @ up, -1.0, 1.0))) < _TILTED_RAD:
        return
    snapped = np.zeros(3)
    snapped[int(np.argmax(np.abs(axis)))] = math.copysign(1.0, axis[int(np.argmax(np.abs(axis)))])
    if float(axis @ snapped) < math.cos(_TILTED_RAD):
        snapped = axis
    found.add(
        "imu.gravity",
        f"The IMU's accelerometer has gravity along {_axis_text(axis)}, not along the axis that its mounting says",
        {"recording.imu_pose": [0.0, 0.0, 0.0, *_rpy_for(snapped)]},
        None,
        Severity.ERROR,
    )


def _axis_text(axis: FloatArray) -> str:
    k = int(np.argmax(np.abs(axis)))
    return (
        f"{'-' if axis[k] < 0 else ''}{'xyz'[k]}" if abs(axis[k]) > 0.9 else f"({', '.join(f'{v:.2f}' for v in axis)})"
    )


def _gyro_scale(found: Conventions, fit: RateFit, given: float) -> RateFit:
    """Unit of the gyro, or a track that the turn refutes."""
    factor = fit.scale.value  # wheels' turn over the gyro's as configured
    if abs(math.log(max(factor, 1e-9) * 180.0 / math.pi)) < _ROUGHLY:
        sign = math.copysign(1.0, found.config.gyro.scale)
        found.add(
            "imu.unit",
            f"The gyro's rates are in degrees: they are {1.0 / factor:.1f} times those of the wheels",
            {"gyro.scale": round(sign * abs(given) * math.pi / 180.0, 7)},
            fit.scale,
            Severity.ERROR,
        )
    elif abs(math.log(max(factor, 1e-9) * math.pi / 180.0)) < _ROUGHLY:
        found.add(
            "odometry.yaw_unit",
            f"The wheels' yaw rate is {factor:.1f} times the gyro's: it is in degrees",
            {"wheels.scale_omega": round(found.config.wheels.scale_omega * math.pi / 180.0, 7)},
            fit.scale,
            Severity.ERROR,
        )
    elif fit.scale.off(1.0, _RATE_SCALE):
        found.add(
            "wheels.turn",
            f"The wheels turn {factor:.3f} ± {fit.scale.sigma:.3f} times as much as the gyro (a track as the turn sees "
            "it, or skidding wheels; a gyro is seldom off by so much)",
            {"wheels.scale_omega": round(found.config.wheels.scale_omega / factor, 4)},
            Figure(1.0 / factor, fit.scale.sigma / factor**2),
            Severity.ERROR,
        )
    else:
        found.compared.append(f"gyro and wheels turn alike ({factor:.3f} ± {fit.scale.sigma:.3f})")
    return fit


# --- landmarks and the wheels -----------------------------------------------------------------------------------------


def _turn_of(path: Path, gyro: RateFit | None) -> tuple[Path, float]:
    """The path with the gyro's turn, where there is one, and by what share of itself its turn may be off."""
    if gyro is None or gyro.share < _TELLS or abs(math.log(max(gyro.scale.value, 1e-9))) > _SKID:
        return path, TURN
    turns = 1.0 / gyro.scale.value
    return path.turned(turns), min(math.hypot(_GYRO_SCALE, turns * gyro.scale.sigma), TURN)


def _sensor(
    found: Conventions,
    path: Path,
    seen: Sightings,
    T_base_sensor: FloatArray | None,
    landmark_map: LandmarkMap | None,
    turn_sigma: float,
) -> Mounting | None:
    """Mounting of the sensor of landmarks with axes, mirror and scale; None: the wheels do not determine it."""
    T = np.eye(4) if T_base_sensor is None else T_base_sensor
    as_given, ranged = _as_configured(found.config, seen, T_base_sensor)
    fits = fit_sightings(path, as_given, turn_sigma=turn_sigma)
    if not fits:
        return None
    best = _best(fits)
    reach = float(np.median(np.abs(planar(as_given.points, best.axes))))
    if best.misfit > _FITS * reach or best.scale.sigma > 0.3 * best.scale.value:
        return None  # nothing fits: the landmarks move, the wheels slip throughout, or the robot hardly moved
    if _along_axis(found, path, seen, best, T_base_sensor, landmark_map):
        as_given, ranged = _as_configured(found.config, seen, T_base_sensor)
        fits = fit_sightings(path, as_given, turn_sigma=turn_sigma) or fits
        best = _best(fits)
    sound, turned_over = fits.get("body"), fits.get("body, upside down")
    by_map = _mirrored(path, as_given, sound, turned_over, landmark_map)
    usual = best.axes == "body" or (
        sound is not None and sound.misfit < (_WORSE if seen.spatial else _MIRRORED) * best.misfit
    )
    if by_map and turned_over is not None:
        best = turned_over
    elif usual:
        assert sound is not None
        return _constants(found, path, as_given, sound, T, landmark_map)
    raw = Sightings(seen.times, seen.ids, ranged, seen.spatial)
    chosen = best
    if T_base_sensor is not None:
        fits = fit_sightings(path, raw, turn_sigma=turn_sigma) or {best.axes: best}
        chosen = min(fits.values(), key=lambda m: m.misfit) if by_map else _best(fits)
    pose = _pose_of(chosen, T)
    lines: dict[str, Any] = {}
    off_mm = 1e3 * chosen.scale.value * chosen.misfit
    if chosen.axes == "optical":
        text = (
            "Positions of landmarks are in an optical frame (z ahead, x to the right): so they stay in place while the "
            f"wheels move, to {off_mm:.0f} mm; in the axes as configured they wander"
        )
        code, lines["recording.sightings_axes"] = "sightings.axes", "optical"
    elif not seen.spatial:
        text = (
            "Bearings count to the right (or the sensor is upside down): mirrored, landmarks stay in place to "
            f"{off_mm:.0f} mm while the wheels move, as reported they wander"
        )
        code = "sightings.mirrored"
    else:
        text = (
            f"Landmarks stay in place, to {off_mm:.0f} mm, if the sensor's axes are taken as "
            f"{chosen.axes}; in the axes as configured they wander"
        )
        code, lines["recording.sightings_axes"] = "sightings.axes", "body"
    lines["recording.sightings_pose"] = pose
    found.add(code, text, lines, None, Severity.ERROR)
    if chosen.scale.off(1.0, _SCALE) or landmark_map is not None:
        _scale(found, path, raw, chosen, landmark_map)
    found.noise = track_noise(path, raw, chosen)
    return chosen


def _mirrored(
    path: Path, seen: Sightings, sound: Mounting | None, turned_over: Mounting | None, landmark_map: LandmarkMap | None
) -> bool:
    """Whether bearings are a mirror image by the wheels and by the map alike, where the wheels alone are not sure."""
    if seen.spatial or landmark_map is None or sound is None or turned_over is None:
        return False
    if turned_over.misfit >= sound.misfit:
        return False
    fit = fit_map(path, seen, sound, {i: lm.position[:2] for i, lm in landmark_map.landmarks.items()})
    return fit is not None and fit.mirrored and fit.misfit < _NO_MAP


def _as_configured(config: Config, seen: Sightings, T_base_sensor: FloatArray | None) -> tuple[Sightings, FloatArray]:
    """Sightings in the base's axes about the sensor, with what is configured of it; the points in its own axes."""
    section = config.landmarks
    distance = np.maximum(np.linalg.norm(seen.points, axis=1, keepdims=True), 1e-9)
    bias_m = section.range_bias_m if float(np.median(distance)) > _BIASED * abs(section.range_bias_m) else 0.0
    ranged = section.range_scale * np.maximum(1.0 - bias_m / distance, 1e-3) * seen.points
    if section.range_along_axis and not seen.spatial:
        bearing = np.arctan2(seen.points[:, 1], seen.points[:, 0]) - section.bearing_bias_rad
        ranged = ranged / np.maximum(np.cos(bearing), _LEAST_COS)[:, None]
    turned = ranged if T_base_sensor is None else ranged @ T_base_sensor[:3, :3].T
    c, s = math.cos(section.bearing_bias_rad), math.sin(section.bearing_bias_rad)
    level = np.column_stack([turned[:, :2] @ np.array([[c, -s], [s, c]]), turned[:, 2:]])
    return Sightings(seen.times, seen.ids, level, seen.spatial), ranged


def _along_axis(
    found: Conventions,
    path: Path,
    seen: Sightings,
    m: Mounting,
    T_base_sensor: FloatArray | None,
    landmark_map: LandmarkMap | None,
) -> bool:
    """Name ranges that are distances along the sensor's axis (depths, as of cameras), or the other way round."""
    bearing = np.arctan2(seen.points[:, 1], seen.points[:, 0])
    if seen.spatial or float(np.std(bearing)) < _ASKEW_RAD:  # ahead the two are alike
        return False
    other = with_value(found.config, "landmarks.range_along_axis", along := not found.config.landmarks.range_along_axis)
    places = {} if landmark_map is None else {i: lm.position[:2] for i, lm in landmark_map.landmarks.items()}
    first, second = (_as_configured(config, seen, T_base_sensor)[0] for config in (found.config, other))
    gains = {"the wheels' motion": compared(path, first, second, m, {})}
    if len(places) > 2:
        gains["the map"] = compared(path, first, second, m, places)
    by, gain = max(gains.items(), key=lambda item: item[1].value / item[1].sigma)
    if min(g.value for g in gains.values()) < 0.0 or not gain.value > max(_GAIN, _GAIN_SIGMAS * gain.sigma):
        return False
    text = (
        "Ranges are distances along the sensor's axis (depths)"
        if along
        else "Ranges are distances to the landmarks, not along the sensor's axis"
    )
    text += f": so they fit {by} better (gain of log-likelihood a sighting {gain.value:.2f} ± {gain.sigma:.2f})"
    found.add("sightings.depth", text, {"landmarks.range_along_axis": along}, gain, Severity.ERROR)
    return True


def _best(fits: Mapping[str, Mounting]) -> Mounting:
    """Fit with the least misfit; among nearly equal ones, that with the most usual axes."""
    least = min(m.misfit for m in fits.values())
    return next(fits[name] for name in AXES if name in fits and fits[name].misfit <= _ALIKE * least)


def _pose_of(m: Mounting, T_given: FloatArray) -> list[float]:
    """x, y, z, roll, pitch, yaw of a mounting as ``recording.sightings_pose`` has it; the place if it is known."""
    (i, a), (j, b) = AXES[m.axes]
    forward, left = np.zeros(3), np.zeros(3)
    forward[i], left[j] = a, b
    R = np.array([forward, left, np.cross(forward, left)])
    c, s = math.cos(m.yaw.value), math.sin(m.yaw.value)
    T = np.eye(4)
    T[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R
    T[2, 3] = T_given[2, 3]
    for k, figure in ((0, m.x), (1, m.y)):
        T[k, 3] = figure.value if figure.sigma < 0.5 * _PLACED_M else T_given[k, 3]
    return [round(v, 4) + 0.0 for v in sensor_pose(T, optical=m.axes == "optical")]


def _constants(
    found: Conventions,
    path: Path,
    seen: Sightings,
    m: Mounting,
    T: FloatArray,
    landmark_map: LandmarkMap | None,
) -> Mounting:
    """Scale and mounting of a sensor whose axes are right."""
    scaled = m.scale.off(1.0, _SCALE)
    before = len(found.findings)
    if scaled or landmark_map is not None:
        _scale(found, path, seen, m, landmark_map)
    if len(found.findings) == before:
        m, scaled = _by_map(found, path, seen, m, T, landmark_map), False
    # the graph finds what is within the place's prior
    least = max(_PLACED_M, 3.0 * found.config.landmarks.position_sigma_m)
    place = [(k, f) for k, f in ((0, m.x), (1, m.y)) if f.off(T[k, 3], least) and f.sigma < 0.5 * _PLACED_M]
    turned = m.yaw.off(0.0, _TURNED_RAD)
    if (place or turned) and _varied(path):
        moved = T.copy()
        c, s = math.cos(m.yaw.value), math.sin(m.yaw.value)
        if turned:
            moved[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ T[:3, :3]
        for k, figure in place:
            moved[k, 3] = figure.value
        optical = found.config.recording.sightings_axes == "optical"
        what = []
        if turned:
            what.append(f"looks {math.degrees(m.yaw.value):+.1f} ± {math.degrees(m.yaw.sigma):.1f}° further left")
        what += [
            f"sits {figure.value - T[k, 3]:+.2f} ± {figure.sigma:.2f} m further {'ahead' if k == 0 else 'left'}"
            for k, figure in place
        ]
        found.add(
            "sightings.mounting",
            f"The sensor of the landmarks {' and '.join(what)} than configured, by the wheels' motion",
            {"recording.sightings_pose": [round(v, 4) + 0.0 for v in sensor_pose(moved, optical)]},
            m.yaw if turned else place[0][1],
            # by a path that is not the configured one, a small turn may be that path's own
            Severity.WARNING if "wheels.source" in _lines_of(found) else Severity.ERROR,
        )
    if not (scaled or place or turned):
        found.compared.append(
            f"landmarks and wheels agree: scale {m.scale.value:.3f} ± {m.scale.sigma:.3f}, the sensor looks "
            f"{math.degrees(m.yaw.value):+.1f} ± {math.degrees(m.yaw.sigma):.1f}° to the left"
        )
    return m


def _lines_of(found: Conventions) -> set[str]:
    """Keys of robot.yaml that the findings set."""
    return {key for finding in found.findings for key in finding.lines}


def _by_map(
    found: Conventions, path: Path, seen: Sightings, m: Mounting, T: FloatArray, landmark_map: LandmarkMap | None
) -> Mounting:
    """Name ranges that the map refutes, and note the noise; the mounting as wheels and map determine it best."""
    section = found.config.landmarks
    known = {} if landmark_map is None else {i: lm.position[:2] for i, lm in landmark_map.landmarks.items()}
    fitted = fit_on_map(path, seen, m, known) if len(known) > 2 else None
    if fitted is None:
        found.noise = track_noise(path, seen, m)
        return m
    by_map, found.noise = fitted
    long = by_map.too_long_m
    if long.off(0.0, _BIAS_M, 3.0):
        found.add(
            "sightings.range",
            f"Ranges are {long.value:+.3f} ± {long.sigma:.3f} m too long at {by_map.distance_m:.1f} m, by the map",
            {
                "landmarks.range_bias_m": round(section.range_bias_m + by_map.bias_m.value / section.range_scale, 4),
                "landmarks.range_scale": round(section.range_scale * by_map.scale.value, 4),
            },
            long,
            Severity.ERROR,
        )
    better = {}
    for name, configured in (("yaw", 0.0), ("x", float(T[0, 3])), ("y", float(T[1, 3])), ("late_s", 0.0)):
        wheels, on_map = getattr(m, name), getattr(by_map, name)
        refuted = abs(on_map.value - configured) + on_map.sigma < abs(on_map.value - wheels.value)
        better[name] = on_map if refuted or on_map.sigma < wheels.sigma else wheels
    return replace(m, **better)


def _scale(found: Conventions, path: Path, seen: Sightings, m: Mounting, landmark_map: LandmarkMap | None) -> None:
    """Which of wheels, ranges and map has the wrong scale; two against one decide, of two either may be wrong."""
    by_wheels, section = m.scale, found.config.landmarks  # true over reported range, in the wheels' metres
    if landmark_map is not None and len(landmark_map) > 2:
        places = {i: lm.position[:2] for i, lm in landmark_map.landmarks.items()}
        fit = fit_map(path, seen, m, places)
        if fit is not None and fit.misfit >= _NO_MAP:
            text = (
                "The map contradicts wheels and sightings, which agree, and neither a mirror image nor a scale of it "
                "fits: check that it is the map of this place, and its ids and positions"
            )
            found.add("map.contradiction", text, {}, None, Severity.ERROR)
            return
        if fit is not None:
            if fit.shift:
                text = f"The map's ids are {fit.shift:+d} against those seen"
                found.add("map.ids", text, {}, Figure(fit.shift, 0.0), Severity.ERROR)
            if fit.mirrored:
                text = "The map is a mirror image of what is seen: change the sign of all its y"
                found.add("map.mirrored", text, {}, None, Severity.ERROR)
            # distances on the map over reported ranges, which one view tells; over the wheels', by way of the ranges
            ranges = Figure(by_wheels.value * fit.scale.value, by_wheels.value * fit.scale.sigma)
            relative = math.hypot(fit.scale.sigma / fit.scale.value, by_wheels.sigma / by_wheels.value)
            on_map = Figure(fit.scale.value, fit.scale.value * relative)
            if by_wheels.sigma > _UNSURE * by_wheels.value:
                return  # the wheels do not tell distances, as on one circle
            if on_map.off(1.0, _SCALE):
                _three(found, by_wheels, on_map, ranges)
                return
            if not by_wheels.off(1.0, _SCALE):
                return
    if not by_wheels.off(1.0, _SCALE):
        return
    value = by_wheels.value * section.range_scale
    unit = unit_of(by_wheels.value)
    named = f" (they are in {unit[1]})" if unit is not None else ""
    rival = (
        "" if abs(math.log(by_wheels.value)) > 0.15 else f"; or the wheels' are {by_wheels.value:.3f} times too long"
    )
    found.add(
        "sightings.scale",
        f"Distances of landmarks are {1.0 / by_wheels.value:.4g} ± {by_wheels.sigma / by_wheels.value**2:.2g} times "
        f"those of the wheels' motion{named}{rival}",
        {"landmarks.range_scale": round(value if unit is None else unit[0] * section.range_scale, 5)},
        by_wheels,
        Severity.ERROR,
    )


def _three(found: Conventions, by_wheels: Figure, on_map: Figure, ranges: Figure) -> None:
    """Name the one of map, ranges and wheels that the other two contradict."""
    unit = unit_of(1.0 / on_map.value)
    if not by_wheels.off(1.0, _SCALE):
        if unit is None and abs(math.log(on_map.value)) < _SURVEYED:
            return
        factor = 1.0 / on_map.value if unit is None else unit[0]
        named = f" (it is in {unit[1]})" if unit is not None else ""
        found.add(
            "map.unit",
            f"Distances on the map are {on_map.value:.4g} ± {on_map.sigma:.2g} times those that wheels and sightings "
            f"agree on{named}",
            {"map.scale": round(found.config.map.scale * factor, 6)},
            Figure(1.0 / on_map.value, on_map.sigma / on_map.value**2),
            Severity.ERROR,
        )
    elif not ranges.off(1.0, _SCALE):
        found.add(
            "wheels.scale",
            f"Distances by the wheels are {1.0 / on_map.value:.4g} times those that map and sightings agree on",
            {"wheels.scale_v": round(found.config.wheels.scale_v * on_map.value, 5)},
            on_map,
            Severity.ERROR,
        )
    else:
        found.add(
            "scales",
            f"Map, sightings and wheels have three scales: sightings {1.0 / by_wheels.value:.3f} and map "
            f"{on_map.value:.3f} times the wheels'",
            {},
            on_map,
            Severity.ERROR,
        )


# --- clocks -----------------------------------------------------------------------------------------------------------


def _drifts(
    found: Conventions, signals: Signals, path: Path, imu_up: FloatArray | None, T_base_sensor: FloatArray | None
) -> list[str]:
    """Name the roles whose lag is another one in the second half of the time than in the first."""
    fits: dict[str, list[Figure]] = {}
    if signals.source not in _WHEELS or not _varied(path):
        return []
    rates, seen, middle = signals.rates(), signals.sightings(), len(path.times) // 2
    if seen is not None:
        seen, _ = _as_configured(found.config, seen, T_base_sensor)
    for part in (slice(None, middle), slice(middle, None)):
        half = Path(path.times[part], path.poses[part], path.gaps[part])
        if rates is not None and (fit := fit_rate(half, rates[0], turn_by(rates[0], rates[1] @ _unit(imu_up)))):
            fits.setdefault("imu", []).extend([fit.late_s] if fit.share > _TELLS else [])
        if seen is not None and (fitted := fit_sightings(half, seen, ["body"])):
            fits.setdefault("sightings", []).append(fitted["body"].late_s)
    seconds = 0.5 * float(path.times[-1] - path.times[0])
    drifting = []
    for role, lags in fits.items():
        if len(lags) < 2 or max(lag.sigma for lag in lags) > _LATE_S:
            continue
        drift = Figure((lags[1].value - lags[0].value) / seconds, math.hypot(lags[0].sigma, lags[1].sigma) / seconds)
        if drift.off(0.0, _DRIFTED_S / seconds, _LAG_SIGMAS):
            drifting.append(role)
            text = (
                f"The clock of {role} drifts against the wheels' by {1e3 * drift.value:+.2f} ± {1e3 * drift.sigma:.2f} "
                f"ms/s: synchronize the clocks, or list {role} in recording.received_stamps"
            )
            found.add("clock.drift", text, {}, drift, Severity.WARNING)
    return drifting


def _clocks(
    found: Conventions,
    signals: Signals,
    path: Path,
    gyro: RateFit | None,
    driver: Figure | None,
    sensor: Mounting | None,
    truth: BodyFit | None,
) -> float:
    """Name whose stamps are late, by the lags of gyro, odometry, landmarks and truth against the wheels.

    Two that are late alike say that it is the wheels' clock. Commands have a lag of another kind: the robot follows
    them late.

    Returns:
        How much later the wheels' motion is now taken to be [s].
    """
    late: dict[str, Figure] = {}
    if gyro is not None and gyro.share > _TELLS:
        late["imu"] = gyro.late_s
    if driver is not None and _varied(path):
        late["odometry"] = driver
    if sensor is not None and _varied(path):
        lag, true = sensor.late_s, None if truth is None or truth.share < _TELLS else truth.late_s.value
        refuting = true is not None and lag.off(true, _LATE_S, _LATE_SIGMAS)  # a truth that is late all by itself
        if lag.sigma < _LATE_S or refuting or _surely_late(lag):
            late["sightings"] = lag
    if (
        truth is not None
        and truth.share > _TELLS
        and _varied(path)
        and (truth.late_s.sigma < _LATE_S or _surely_late(truth.late_s))
    ):
        late["truth"] = truth.late_s
    off = {role: lag for role, lag in late.items() if _surely_late(lag)}
    perhaps = {role: lag for role, lag in late.items() if role in off or lag.off(0.0, _LATE_S, _BOTH_SIGMAS)}
    mean = weighted(list(perhaps.values())) if perhaps else Figure(0.0, math.inf)
    if _surely_late(mean) and all(_alike(lag, mean) for lag in perhaps.values()):
        off = perhaps  # two that are late alike are surer than each
    sensors = [role for role in late if role != "truth"]
    if not off.keys() & set(sensors):
        found.compared += [f"{r}: {late[r].value:+.3f} ± {late[r].sigma:.3f} s late" for r in sensors]
    if not off:
        return 0.0
    of_all = weighted(list(off.values()))
    same = len(off) > 1 and all(_alike(lag, of_all) for lag in off.values())
    if signals.source not in _WHEELS and (same or len(late) == 1):
        if of_all.value < 0.0:
            return 0.0
        delay_s = round(found.config.wheels.delay_s + of_all.value, 3)
        text = (
            f"The robot follows its commands late, after {of_all.value:.3f} s (± {of_all.sigma:.3f}), by "
            f"{' and '.join(off)}"
        )
        found.add("commands.delay", text, {"wheels.delay_s": delay_s}, of_all, Severity.WARNING)
        return of_all.value
    wheels = _WHEELS.get(signals.source, "command")
    if same or (len(late) == 1 and "imu" in off and _unpunctual(signals, wheels, "imu")):
        lag = of_all if same else off["imu"]
        _late(found, wheels, Figure(-lag.value, lag.sigma), " and ".join(off), len(late) == 1)
        return lag.value
    for role, lag in off.items():
        if role != "truth":
            others = [wheels, *(other for other in sensors if other not in off)]
            _late(found, role, lag, " and ".join(others), len(others) == 1)
    return 0.0


def _alike(lag: Figure, other: Figure) -> bool:
    return abs(lag.value - other.value) < 0.5 * _LATE_S + 3.0 * lag.sigma


def _surely_late(lag: Figure) -> bool:
    return lag.off(0.0, _LATE_S, _LATE_SIGMAS)


def _varied(path: Path) -> bool:
    """Whether speed or yaw rate vary: otherwise a lag and a turn of the sensor are the same."""
    at = np.arange(path.times[0] + 0.5, path.times[-1] - 0.5, 0.5)
    at = at[path.known(at - 0.5, at + 0.5)]
    if len(at) < 2:
        return False
    speed = np.hypot(*(path.at(at + 0.5) - path.at(at - 0.5))[:, :2].T)
    return max(float(np.std(path.yaw_rate(at, 0.5))), float(np.nanstd(speed))) > _VARIED


def _unpunctual(signals: Signals, role: Role, other: Role) -> bool:
    """Whether the first of two roles has the odder delay between stamp and receipt."""
    late_s = signals.late_s()
    return abs(late_s.get(role, 0.0)) > abs(late_s.get(other, 0.0)) + _LATE_S


def _late(found: Conventions, role: str, lag: Figure, against: str, either: bool) -> None:
    given = {str(r): offset for r, offset in found.config.recording.stamp_offset_s.items()}.get(role, 0.0)
    doubt = " (either clock may be wrong: only the difference matters)" if either else ""
    found.add(
        f"clock.{role}",
        f"The stamps of {role} are {abs(lag.value):.3f} ± {lag.sigma:.3f} s {'late' if lag.value > 0 else 'early'} "
        f"against {against}{doubt}",
        {"recording.stamp_offset_s": {role: round(given - lag.value, 3)}},
        lag,
        Severity.ERROR,
    )


# --- the first pose ---------------------------------------------------------------------------------------------------


def _first_pose(
    found: Conventions,
    path: Path,
    seen: Sightings | None,
    T_base_sensor: FloatArray | None,
    landmark_map: LandmarkMap | None,
) -> None:
    """Name a first pose that was given and is not where the first sightings put it: one of two frames is shifted."""
    given = found.config.estimator.initial_pose
    if given is None or seen is None or landmark_map is None or any(f.severity for f in found.findings):
        return
    as_given, _ = _as_configured(found.config, seen, T_base_sensor)
    use = np.array([int(i) in landmark_map.landmarks for i in seen.ids]) & (seen.times < seen.times[0] + _FIRST_S)
    use &= path.known(np.full(len(seen.times), path.times[0]), seen.times)
    place = np.zeros(2) if T_base_sensor is None else T_base_sensor[:2, 3]
    at = path.at(seen.times[use])
    points = se2.placed(at, as_given.points[use, :2] + place)
    places = np.array([landmark_map.landmarks[int(i)].position[:2] for i in seen.ids[use]]).reshape(-1, 2)
    started = se2.rigid_if_spread(points, places) if len(points) > 3 else None
    sentence = None if started is None else first_pose_sentence(found.config, started)
    if sentence is not None:
        found.findings.append(Finding("frame.first_pose", sentence, Severity.ERROR))
        found.config = with_value(found.config, "estimator.initial_pose", None)


# --- the truth --------------------------------------------------------------------------------------------------------


def _true_body(found: Conventions, signals: Signals, path: Path) -> BodyFit | None:
    """Truth against the wheels; None: there is none, or it is of something else. Only evaluation reads a truth."""
    poses = signals.true_poses()
    if poses is None or path.length_m < 0.3:
        return None
    _frozen(found, signals, path)
    _tilted(found, signals)
    section = found.config.truth
    own = poses.copy()
    own[:, 1:3] *= section.scale
    if section.axes == "ned":
        own[:, 1:] = np.column_stack([own[:, 2], own[:, 1], 0.5 * math.pi - own[:, 3]])
    x, y, turned = se2.inverse((*section.offset_m, section.yaw_offset_rad)).tolist()
    c, s = np.cos(own[:, 3]), np.sin(own[:, 3])
    own[:, 1:] += np.column_stack([c * x - s * y, s * x + c * y, np.full(len(own), turned)])
    if float(np.ptp(own[:, 3])) < 1e-3 < 0.1 < float(np.ptp(path.poses[:, 2])):
        found.add("truth.no_yaw", "The truth has no yaw: only positions are compared", {}, None, Severity.NOTE)
        return None
    _shared_yaw(found, signals, own)
    fit = fit_body(path, own)
    if fit is not None and fit.share > FOLLOWS and fit.turns.value > 0.0 and fit.turns.off(1.0, _RATE_SCALE):
        turns = fit.turns
        if not any(f.code == "wheels.turn" for f in found.findings):
            scale_omega = round(found.wheels.scale_omega * turns.value, 4)
            text = (
                f"By the truth the robot turns {turns.value:.3f} ± {turns.sigma:.2g} times as much as its wheels say "
                f"(a track or a geometry that is not the robot's); if so, set wheels.scale_omega: {scale_omega:g}"
            )
            sigma = math.hypot(found.config.wheels.turn_scale_sigma, found.config.wheels.scale_sigma)
            found.add("wheels.turn", text, {}, turns, _refuted(turns, sigma))
        fit = fit_body(path.turned(turns.value), own)
    return None if fit is None or fit.misfit > 0.25 else fit


def _refuted(by_truth: Figure, prior_sigma: float) -> Severity:
    """Severity of a scale of the wheels by the truth, which is never written: only evaluation reads a truth."""
    return Severity.ERROR if abs(math.log(by_truth.value)) > _PRIOR_SIGMAS * prior_sigma else Severity.WARNING


def _shared_yaw(found: Conventions, signals: Signals, truth: FloatArray) -> None:
    """Name a truth whose yaw is the odometry's: two measurements never agree so well."""
    rows = in_order(signals.odometry)
    if len(rows) < 50:
        return
    at = np.arange(max(truth[0, 0], rows[0, 0]), min(truth[-1, 0], rows[-1, 0]), 1.0)
    if len(at) < 2:
        return
    theirs = np.diff(np.interp(at, truth[:, 0], truth[:, 3]))
    ours = np.diff(np.interp(at, rows[:, 0], np.unwrap(rows[:, 3])))
    turning = np.abs(ours) > _APART_RAD
    if turning.sum() < _WINDOWS or np.median(np.abs(theirs - ours)[turning] / np.abs(ours)[turning]) > _SAME_YAW:
        return
    text = "The truth's yaw is the odometry's: the two are one measurement, and it judges no yaw"
    found.add("truth.yaw_is_odometry", text, {}, None, Severity.NOTE)


def _tilted(found: Conventions, signals: Signals) -> None:
    """Name a truth whose positions lie in a plane that is not level."""
    places = np.array(signals.truth)[:, 1:4]
    places = places[np.append(True, np.abs(np.diff(places, axis=0)).max(axis=1) > 0.0)]
    if len(places) < 30 or found.config.estimator.ground != "flat":
        return
    normals = [_normal(np.delete(places, part, axis=0)) for part in np.array_split(np.arange(len(places)), _PLANES)]
    normal, spread, off = _normal(places)
    tilt = math.acos(min(abs(float(normal[2])), 1.0))
    sigma = float(np.linalg.norm(jackknife(np.array([n for n, _, _ in normals]))))
    figure = Figure(math.degrees(tilt), math.degrees(sigma))
    if spread < _WIDE_M or off > _IN_PLANE * spread * math.sin(tilt) or not figure.off(0.0, _LEVEL_DEG):
        return
    text = (
        f"The truth's plane is tilted by {figure.value:.1f}° (± {figure.sigma:.1f}) against its z axis, or the floor "
        f"slopes: distances along the slope are {100.0 * (1.0 - math.cos(tilt)):.2g} % short"
    )
    found.add("truth.tilt", text, {}, figure, Severity.NOTE)


def _normal(places: FloatArray) -> tuple[FloatArray, float, float]:
    """Upward normal ``(3,)`` of places ``(n, 3)``, their spread in the narrower direction and off the plane [m]."""
    use = np.ones(len(places), dtype=bool)
    for _ in range(3):  # without glitches
        middle = np.median(places[use], axis=0)
        _, sizes, axes = np.linalg.svd(places[use] - middle, full_matrices=False)
        off = np.abs((places - middle) @ axes[2])
        use = off <= 4.0 * float(np.median(off)) + 1e-9
    size = sizes / math.sqrt(float(use.sum()))
    return axes[2] * math.copysign(1.0, axes[2, 2]), float(size[1]), float(size[2])


def _frozen(found: Conventions, signals: Signals, path: Path) -> None:
    """Name a truth that repeats its pose while the wheels move."""
    rows = in_order(signals.truth)
    repeated = np.append(False, np.abs(np.diff(rows[:, 1:], axis=0)).max(axis=1) == 0.0)
    place = path.at(np.column_stack([rows[:, 0] - _FROZEN_S, rows[:, 0]]).ravel())[:, :2].reshape(-1, 2, 2)
    moving = np.linalg.norm(place[:, 1] - place[:, 0], axis=1) > _FROZEN_S * _MOVES_MPS
    share = float(repeated[moving].mean()) if moving.any() else 0.0
    if share > _FROZEN_SHARE:
        text = f"The truth is frozen in {100.0 * share:.0f} % of its messages while the robot moves: poses are repeated"
        found.add("truth.frozen", text, {}, Figure(share, 0.0), Severity.NOTE)


def _truth_lines(found: Conventions, fit: BodyFit) -> Iterator[tuple[str, str, dict[str, Any], Figure | None]]:
    section = found.config.truth
    if fit.mirrored:
        other = "enu" if section.axes == "ned" else "ned"
        text = "The truth is a mirror image of the wheels' path: its axes are north, east, down"
        yield "truth.axes", text, {"truth.axes": other}, None
    elif fit.share > 0.5 and fit.turns.value < -0.5:
        yield "truth.yaw_sign", "The truth's yaw counts clockwise although its positions do not", {}, fit.turns
        return
    unit = unit_of(1.0 / fit.scale.value)
    if unit is None and abs(math.log(fit.scale.value)) < _WHEELS_OFF:
        if fit.scale.off(1.0, _SCALE):
            scale_v = round(found.wheels.scale_v * fit.scale.value, 4)
            text = (
                f"By the truth the robot moves {fit.scale.value:.3f} ± {fit.scale.sigma:.2g} times as far as its "
                f"wheels say; if the truth's metres are right, set wheels.scale_v: {scale_v:g}"
            )
            yield "wheels.scale", text, {}, fit.scale
    elif fit.scale.off(1.0, 0.08):
        factor = 1.0 / fit.scale.value if unit is None else unit[0]
        named = f" (it is in {unit[1]})" if unit is not None else ""
        yield (
            "truth.scale",
            f"Distances of the truth are {fit.scale.value:.4g} ± {fit.scale.sigma:.2g} times the wheels'{named}",
            {"truth.scale": round(section.scale * factor, 6)},
            fit.scale,
        )
    if fit.late_s.off(0.0, _RESPONSE_S if found.commanded else _LATE_S, _LAG_SIGMAS) and fit.share > FOLLOWS:
        given = {str(r): o for r, o in found.config.recording.stamp_offset_s.items()}.get("truth", 0.0)
        side = "late" if fit.late_s.value > 0 else "early"
        yield (
            "clock.truth",
            f"The truth's stamps are {abs(fit.late_s.value):.3f} s {side} (± {fit.late_s.sigma:.3f}) "
            "against the wheels'",
            {"recording.stamp_offset_s": {"truth": round(given - fit.late_s.value, 3)}},
            fit.late_s,
        )
    if fit.share < 0.3 and fit.yaw.sigma > _KNOWN_YAW:
        return
    place = [fit.x.value, fit.y.value]
    off_place = [f.off(0.0, 0.03) and f.sigma < 0.05 and fit.share >= 0.3 for f in (fit.x, fit.y)]
    turned = fit.yaw.off(0.0, 0.04)
    if not turned and not any(off_place):
        return
    kept = [v if off else 0.0 for v, off in zip(place, off_place, strict=True)]
    T_base_body = se2.compose((*kept, fit.yaw.value if turned else 0.0), (*section.offset_m, section.yaw_offset_rad))
    lines: dict[str, Any] = {}
    what = []
    if turned:
        lines["truth.yaw_offset_rad"] = round(float(T_base_body[2]), 4)
        what.append(f"is turned by {math.degrees(fit.yaw.value):+.1f} ± {math.degrees(fit.yaw.sigma):.1f}°")
    if any(off_place):
        what.append(f"sits at {place[0]:+.2f}, {place[1]:+.2f} m")
    if any(off_place) or section.offset_m != (0.0, 0.0):
        lines["truth.offset_m"] = [round(v, 3) + 0.0 for v in T_base_body[:2].tolist()]
    text = f"The body that the truth tracks {' and '.join(what)} in the robot's axes"
    yield "truth.mounting", text, lines, fit.yaw


# --- Frames of a first pose and of a truth, against the map's ---------------------------------------------------------

_SURE = 6.0  # sigmas of the given pose
_SLACK = (0.1, 0.1, 0.1)  # m, m, rad beside them
_FRAME_M = 0.3  # mean distance to the truth above which its frame is asked about: no run as installed errs by so much
_ALIGNED = 0.2  # share of that distance which may remain when the frames are brought together


def first_pose_sentence(config: Config, started: FloatArray) -> str | None:
    """The sentence on a first pose that was given and is not where the sightings put it; None if it is.

    Args:
        config: as the run uses it.
        started: ``(3,)`` where the sightings put the run's first pose.
    """
    given = config.estimator.initial_pose
    if given is None:
        return None
    apart = se2.log(se2.between(given, started))
    allowed = _SURE * np.array(config.estimator.initial_sigmas) + _SLACK
    if (np.abs(apart) <= allowed).all():
        return None
    x, y, yaw = started
    return (
        f"By the map and the sightings the run began at x {x:.2f} m, y {y:.2f} m, yaw {yaw:.2f} rad, but "
        f"estimator.initial_pose says {given[0]:.2f}, {given[1]:.2f}, {given[2]:.2f}: the map is shifted by "
        f"{math.hypot(*apart[:2]):.2f} m and {math.degrees(abs(apart[2])):.0f}°, or the pose is wrong; shift the map "
        f"or set estimator.initial_pose: [{x:.3f}, {y:.3f}, {yaw:.4f}]."
    )


def truth_sentence(config: Config, truth: FloatArray | None, times: FloatArray, poses: FloatArray) -> str | None:
    """The sentence on a truth in another frame than the map's; None if it is in the map's, or fits neither way.

    Args:
        config: as the run uses it.
        truth: rows of time, x, y and yaw, in order; None: there is none.
        times: ``(n,)`` of the poses, of the same clock.
        poses: ``(n, 3)`` by map and sightings.
    """
    if config.truth.align != "none" or truth is None:
        return None
    there = (times > truth[0, 0]) & (times < truth[-1, 0])
    if there.sum() < 4:
        return None
    path = np.column_stack([np.interp(times[there], truth[:, 0], truth[:, k]) for k in (1, 2)])
    here = poses[there, :2]
    apart = float(np.hypot(*(path - here).T).mean())
    T = se2.rigid_if_spread(path, here)
    if apart < _FRAME_M or T is None:
        return None
    left = float(np.hypot(*(se2.placed(T, path) - here).T).mean())
    if left > _ALIGNED * apart:
        return None
    return (
        f"The truth is in another frame than the map, {apart:.2f} m away on average and {left:.3f} m once moved by x "
        f"{T[0]:.2f} m, y {T[1]:.2f} m, yaw {T[2]:.3f} rad: set truth.align: se2."
    )
