"""Conventions of a recording: axes, signs, units, mirrors, scales, lags and frames, by pairs of signals.

Nothing here needs a pose, and only the last comparison needs a map. What is found is discrete or far beyond what an
installer may be off by; smaller deviations are constants, which the graph estimates. `init` writes the lines that undo
what is found, every other command names them first. The comparisons are in `odometry`, `gyro`, `landmarks` and `truth`;
here are their order, and what their lags together say of the clocks.
"""

from __future__ import annotations

import math
from dataclasses import replace

from fgloc.config import Config, Role
from fgloc.diagnosis import gyro, landmarks, odometry, truth
from fgloc.diagnosis.comparison import WHEELS, Conventions
from fgloc.diagnosis.joints import check_joints
from fgloc.diagnosis.landmark_fits import Mounting, fit_sightings
from fgloc.diagnosis.pairs import LAG_SIGMAS, LATE_S, TELLS, Figure, RateFit, fit_rate, varied, weighted
from fgloc.diagnosis.positions import check_positions
from fgloc.diagnosis.ranges import check_radio, check_ranges
from fgloc.diagnosis.signals import Path, Signals, turn_by
from fgloc.diagnosis.steering import check_steering
from fgloc.diagnosis.truth import BodyFit
from fgloc.types import FloatArray, LandmarkMap, Severity

_LEAST_PATH_M = 0.05  # a robot that moved less tells nothing
_LATE_SIGMAS = 4.0  # of a lag that is corrected: its sigma is the larger of two jackknives
_BOTH_SIGMAS = 2.5  # of each of two lags that are alike: one clock is late, and they are corrected by their mean
_DRIFTED_S = 0.06  # of the lag's change from half to half; a drift widens the sigmas of both


def conventions(
    signals: Signals,
    config: Config,
    T_base_sensor: FloatArray | None = None,
    imu_up: FloatArray | None = None,
    landmark_map: LandmarkMap | None = None,
) -> Conventions:
    """Compare all pairs of signals of a recording, read as configured; the arguments are those of `Conventions`."""
    found = Conventions(config, signals, T_base_sensor, imu_up, landmark_map)
    check_radio(found)
    path = odometry.check_odometry(found)
    found.wheels = found.config.wheels
    if path is None or path.length_m < _LEAST_PATH_M:
        if (rates := signals.rates()) is not None:
            gyro.check_gravity(found, rates[2], found.up)
        return found
    path = check_joints(found, check_steering(found, path))
    if path is None:
        return found
    found.commanded = path.source == "command"
    gyro.check_dead(found, path)
    odometry.check_sideways(found, path)
    path = odometry.check_angles(found, path)
    path = gyro.check_wheels(found, path)
    odometry.check_commands(found, path)
    by_odometry = gyro.by_odometry(found, path)
    path = gyro.by_hand(found, path)
    driver = odometry.driver_late(found, path)
    turn = gyro.check_gyro(found, path)
    check_positions(found, path)
    by_ranges = check_ranges(found, path)
    if by_ranges is not path:
        path, turn = by_ranges, gyro.check_gyro(found, by_ranges) if found.opposite else turn
    if by_odometry is not None and driver is not None and (turn is None or turn.share < TELLS):
        late_s = Figure(by_odometry.late_s.value + driver.value, math.hypot(by_odometry.late_s.sigma, driver.sigma))
        turn = replace(by_odometry, late_s=late_s)
    seen = found.signals.sightings()
    undecided = found.opposite and not landmarks.which_is_opposite(found, path, seen)
    if found.opposite and not undecided:
        path, found.wheels = found.read_again(path), found.config.wheels
    by_gyro, turn_sigma = landmarks.turn_of(path, turn)
    sensor = None if seen is None else landmarks.check_sensor(found, by_gyro, seen, turn_sigma)
    if found.config.wheels != found.wheels:
        path, found.wheels = found.read_again(path), found.config.wheels
    landmarks.check_map(found, path, seen)
    drifting = _drifts(found, path)
    undecided &= "imu.sign" not in found.codes
    body = None if undecided else truth.true_body(found, path)  # wheels that may turn the wrong way judge no truth
    turn, sensor = None if "imu" in drifting else turn, None if "sightings" in drifting else sensor
    later_s = _clocks(found, path, turn, driver, sensor, body)
    landmarks.check_first_pose(found, path, seen)
    if body is not None:
        late_s = replace(body.late_s, value=body.late_s.value - later_s)
        truth.check_body(found, replace(body, late_s=late_s if varied(path) else Figure(0.0, math.inf)))
    return found


def _drifts(found: Conventions, path: Path) -> list[str]:
    """Name the roles whose lag is another one in the second half of the time than in the first."""
    fits: dict[str, list[Figure]] = {}
    if path.source not in WHEELS or not varied(path):
        return []
    rates, seen, middle = found.signals.rates(), found.signals.sightings(), len(path.times) // 2
    if seen is not None:
        seen, _ = landmarks.as_configured(found, seen)
    for part in (slice(None, middle), slice(middle, None)):
        half = Path(path.times[part], path.poses[part], path.gaps[part])
        if rates is not None and (fit := fit_rate(half, rates[0], turn_by(rates[0], rates[1] @ found.up))):
            fits.setdefault("imu", []).extend([fit.late_s] if fit.share > TELLS else [])
        if seen is not None and (fitted := fit_sightings(half, seen, ["body"])):
            fits.setdefault("sightings", []).append(fitted["body"].late_s)
    seconds = 0.5 * float(path.times[-1] - path.times[0])
    drifting = []
    for role, lags in fits.items():
        if len(lags) < 2 or max(lag.sigma for lag in lags) > LATE_S:
            continue
        drift = Figure((lags[1].value - lags[0].value) / seconds, math.hypot(lags[0].sigma, lags[1].sigma) / seconds)
        if drift.off(0.0, _DRIFTED_S / seconds, LAG_SIGMAS):
            drifting.append(role)
            text = (
                f"The clock of {role} drifts against the wheels' by {1e3 * drift.value:+.2f} ± {1e3 * drift.sigma:.2f} "
                f"ms/s: synchronize the clocks, or list {role} in recording.received_stamps"
            )
            found.add("clock.drift", text, None, drift, Severity.WARNING)
    return drifting


def _clocks(
    found: Conventions,
    path: Path,
    turn: RateFit | None,
    driver: Figure | None,
    sensor: Mounting | None,
    body: BodyFit | None,
) -> float:
    """Name whose stamps are late, by the lags of gyro, odometry, landmarks and truth against the wheels.

    Two that are late alike say that it is the wheels' clock. Commands have a lag of another kind: the robot follows
    them late.

    Returns:
        How much later the wheels' motion is now taken to be [s].
    """
    late: dict[str, Figure] = {}
    if turn is not None and turn.share > TELLS:
        late["imu"] = turn.late_s
    if varied(path):
        true = None if body is None or body.share <= TELLS else body.late_s
        if driver is not None:
            late["odometry"] = driver
        if sensor is not None:
            lag = sensor.late_s
            refuting = true is not None and lag.off(true.value, LATE_S, _LATE_SIGMAS)  # the truth is late by itself
            if lag.sigma < LATE_S or refuting or _surely_late(lag):
                late["sightings"] = lag
        if true is not None and (true.sigma < LATE_S or _surely_late(true)):
            late["truth"] = true
    off = {role: lag for role, lag in late.items() if _surely_late(lag)}
    perhaps = {role: lag for role, lag in late.items() if role in off or lag.off(0.0, LATE_S, _BOTH_SIGMAS)}
    mean = weighted(list(perhaps.values())) if perhaps else Figure(0.0, math.inf)
    if _surely_late(mean) and all(_alike(lag, mean) for lag in perhaps.values()):
        off = perhaps  # two that are late alike are surer than each
    sensors = [role for role in late if role != "truth"]
    if not off:
        return 0.0
    of_all = weighted(list(off.values()))
    same = len(off) > 1 and all(_alike(lag, of_all) for lag in off.values())
    if path.source not in WHEELS and (same or len(late) == 1):
        if of_all.value < 0.0:
            return 0.0
        delay_s = round(found.config.wheels.delay_s + of_all.value, 3)
        text = (
            f"The robot follows its commands late, after {of_all.value:.3f} s (± {of_all.sigma:.3f}), by "
            f"{' and '.join(off)}"
        )
        found.add("commands.delay", text, {"wheels.delay_s": delay_s}, of_all, Severity.WARNING)
        return of_all.value
    wheels: Role = WHEELS.get(path.source, "command")
    received = {role: abs(late_s) for role, late_s in found.signals.late_s().items()}  # after the stamp
    odder = received.get(wheels, 0.0) > received.get("imu", 0.0) + LATE_S
    if same or (len(late) == 1 and "imu" in off and odder):
        lag = of_all if same else off["imu"]
        _late(found, wheels, Figure(-lag.value, lag.sigma), " and ".join(off), len(late) == 1)
        return lag.value
    for role, lag in off.items():
        if role != "truth":
            others = [wheels, *(other for other in sensors if other not in off)]
            _late(found, role, lag, " and ".join(others), len(others) == 1)
    return 0.0


def _alike(lag: Figure, other: Figure) -> bool:
    return abs(lag.value - other.value) < 0.5 * LATE_S + 3.0 * lag.sigma


def _surely_late(lag: Figure) -> bool:
    return lag.off(0.0, LATE_S, _LATE_SIGMAS)


def _late(found: Conventions, role: str, lag: Figure, against: str, either: bool) -> None:
    doubt = " (either clock may be wrong: only the difference matters)" if either else ""
    text = (
        f"The stamps of {role} are {abs(lag.value):.3f} ± {lag.sigma:.3f} s {'late' if lag.value > 0 else 'early'} "
        f"against {against}{doubt}"
    )
    found.add(f"clock.{role}", text, found.earlier(role, lag.value), lag)
