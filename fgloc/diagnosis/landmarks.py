"""A sensor of landmarks against the wheels and the map: axes, mirror, scale, mounting, ids, first pose."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fgloc import se2
from fgloc.config import Config, with_value
from fgloc.diagnosis.comparison import GEAR, WHEELS, Conventions, unit_of
from fgloc.diagnosis.landmark_fits import (
    AXES,
    LOOKS,
    CoarseFit,
    Mounting,
    coarse_fit,
    compared,
    fit_map,
    fit_on_map,
    fit_sightings,
    planar,
    rotation_to_base,
    track_noise,
)
from fgloc.diagnosis.pairs import SKID, TELLS, TURN, Figure, RateFit, varied
from fgloc.diagnosis.signals import Path, Sightings
from fgloc.frames import homogeneous, rpy_matrix, sensor_pose
from fgloc.sensors.wheels.sensor import WRONG_SIDES
from fgloc.types import Finding, FloatArray, Severity

_OTHERWISE = 0.25  # logarithm of a distance by which nothing is off but by its unit
_SCALE = 0.03  # of a distance: less is a constant, which the graph estimates
_WHEEL_UNIT = 0.1  # logarithm by which distances of landmarks may miss a unit of wheels that is named by them alone
_SURVEYED = 0.15  # of a distance on a map: likewise for what is paced off, or mapped by worn wheels
_MAPPED = 0.2  # logarithm by which distances on a map in another unit may be off besides
_UNSURE = 0.1  # share of a scale by which it is not known
_GYRO_SCALE = 0.02  # by which an uncalibrated gyro may be off
_TURNED_RAD = 0.05  # of a sensor: likewise
_PLACED_M = 0.08
_BIAS_M = 0.03  # of a range
_ASKEW_RAD = 0.08  # standard deviation of bearings from which on depths differ from ranges, by 1 % at two of them
_LEAST_COS = math.cos(math.radians(80.0))  # as the measurement has it
_GAIN, _GAIN_SIGMAS = 0.05, 3.0  # of the log-likelihood of a sighting, by which another reading is named
_BIASED = 3.0  # times the configured bias that ranges usually are: shorter ones are in another unit than it
_ALIKE_OFF = 0.15  # logarithm by which way and turn may differ that are off by one cause
_LOOKS_BACK_RAD = 2.0  # of a sensor: rather than two mistakes it is one, of wheels that count backwards
_OPTICAL = "Positions of landmarks are in an optical frame (z ahead, x to the right): so they stay in place"
WORSE = 1.6  # times the misfit of the best axes from which on others are refuted
_MIRRORED = 1.35  # likewise of a mirror image, where nothing else is compared
_ALIKE = 1.25  # times the best misfit within which the more usual axes are taken
_BY_FAR, _NEARLY = 5.0, 2.0  # times a misfit: of what is refuted by few landmarks, of what is as good with them
_FITS = 0.3  # misfit over the median distance of landmarks above which nothing fits
_NO_DRIFT = math.log(7.0)  # of a scale: less may be wheels that drift, and no map in feet is named so
_COARSELY = math.log(1.3)  # by which a scale by wheels alone may miss a unit
_ORIENTED = {"sightings.axes", "sightings.mounting", "sightings.mirrored", "wheels.sign", "wheels.reversed", "imu.sign"}
_MIRROR_IMAGE = "The map is a mirror image of what is seen: change the sign of all its y"
_SCALED = {"map.unit", "map.contradiction", "map.mirrored", "map.ids", "sightings.scale", "wheels.scale", "scales"}
_FIRST_S = 8.0  # of sightings that tell where a run began: wheels err by centimetres over it
_LATER_S, _FITS_M = (20.0, 40.0), 0.5  # likewise, where they show a robot that fits the map so well
_DRIFTED = (0.5, 0.5, 0.3)  # m, m, rad that wheels may err by over that time
_NO_MAP = 0.5  # residual over the spread of the landmarks: they stand elsewhere
_SURE = 6.0  # sigmas of the given pose
_SLACK = (0.1, 0.1, 0.1)  # m, m, rad beside them


def turn_of(path: Path, turn: RateFit | None) -> tuple[Path, float]:
    """The path with the gyro's turn, where there is one, and by what share of itself its turn may be off."""
    if turn is None or turn.share < TELLS or abs(math.log(max(turn.scale.value, 1e-9))) > SKID:
        return path, TURN
    turns = 1.0 / turn.scale.value
    return path.turned(turns), min(math.hypot(_GYRO_SCALE, turns * turn.scale.sigma), TURN)


def which_is_opposite(found: Conventions, path: Path, seen: Sightings | None) -> bool:
    """Name which of wheels and gyro turns the wrong way, by the landmarks; whether it is the wheels."""
    if seen is None:
        if not found.signals.images:  # what images show is compared elsewhere
            wrong = "the steering's sign is wrong" if found.steered else "left and right are exchanged"
            found.add("yaw.sign", f"Wheels and gyro turn in opposite directions: {wrong}, or the gyro's sign")
        return False
    mirrored = path.turned(-1.0)
    turned = Sightings(seen.times, seen.ids, seen.points @ _place(found)[:3, :3].T, seen.spatial)
    fits = [fit_sightings(one, turned).get("body") for one in (path, mirrored)]
    misfits = [math.inf if fit is None else fit.misfit for fit in fits]
    looks_back = fits[1] is not None and abs(se2.wrap(fits[1].yaw.value)) > _LOOKS_BACK_RAD
    if misfits[1] * WORSE < misfits[0]:
        backwards = found.right_sides("reversed") if path.source == "ticks" else {}
        if backwards and looks_back:
            text = f"By gyro and landmarks the wheels {WRONG_SIDES['reversed']}"
            found.add("wheels.reversed", text, backwards)
            return True
        text = "The wheels turn in the opposite direction of gyro and landmarks, which agree"
        found.add("wheels.sign", text, _lines_of_turn(found))
        return True
    if misfits[0] * WORSE < misfits[1]:
        text = "The gyro turns in the opposite direction of wheels and landmarks, which agree"
        found.add("imu.sign", text, {"gyro.scale": -found.config.gyro.scale})
    return False


def _lines_of_turn(found: Conventions) -> dict[str, Any]:
    """Lines for wheels that turn the wrong way."""
    wheels = found.config.wheels
    if (drive := found.steered) is not None:
        return {"wheels.drive.steering_ratio": -drive.steering_ratio}
    return (found.right_sides() if wheels.track is not None else None) or {"wheels.scale_omega": -wheels.scale_omega}


def check_sensor(found: Conventions, path: Path, seen: Sightings, turn_sigma: float) -> Mounting | None:
    """Mounting of the sensor of landmarks with axes, mirror and scale; None: the wheels do not determine it.

    Args:
        found: the comparison.
        path: motion of the wheels, with the gyro's turn where there is one.
        seen: sightings in the sensor's axes.
        turn_sigma: prior of the share by which the robot turns more or less than that.
    """
    as_given, ranged = as_configured(found, seen)
    fits = fit_sightings(path, as_given, turn_sigma=turn_sigma)
    if not fits:
        return None
    for look in (_backwards, _wheels_off):
        without = look(found, path, as_given, fits)
        if without is not None:
            path, fits = without
    best = _best(fits)
    reach = _reach(as_given, best)
    off = path.source == "ticks" and best.turns.off(1.0, 1.0 - math.exp(-GEAR))
    if off and best.misfit < _FITS * reach and "wheels.turn" not in found.codes:  # the gyro's is nearer
        scale_omega = round(found.config.wheels.scale_omega * best.turns.value, 4)
        text = (
            f"By the landmarks the robot turns {best.turns.value:.3g} ± {best.turns.sigma:.2g} times as much as its "
            "wheels say (a track that is not the robot's, or skidding wheels)"
        )
        found.add("wheels.turn", text, {"wheels.scale_omega": scale_omega}, best.turns)
    if best.misfit > _FITS * reach:
        return None  # nothing fits: the landmarks move, or the wheels slip throughout
    if best.scale.sigma > 0.3 * best.scale.value:  # too few landmarks, or the robot hardly moved
        _optical_by_few(found, seen, fits, best)
        return None
    if _along_axis(found, path, seen, best):
        as_given, ranged = as_configured(found, seen)
        fits = fit_sightings(path, as_given, turn_sigma=turn_sigma) or fits
        best = _best(fits)
    sound, turned_over = fits.get("body"), fits.get("body, upside down")
    by_map = _mirrored(found, path, as_given, sound, turned_over)
    usual = best.axes == "body" or (
        sound is not None and sound.misfit < (WORSE if seen.spatial else _MIRRORED) * best.misfit
    )
    if by_map and turned_over is not None:
        best = turned_over
    elif usual:
        assert sound is not None
        return _constants(found, path, as_given, sound)
    raw, chosen = Sightings(seen.times, seen.ids, ranged, seen.spatial), best
    if found.T_base_sensor is not None:
        fits = fit_sightings(path, raw, turn_sigma=turn_sigma) or {best.axes: best}
        chosen = min(fits.values(), key=lambda m: m.misfit) if by_map else _best(fits)
    off_mm = 1e3 * chosen.scale.value * chosen.misfit
    pose = {"recording.sightings_pose": _pose_of(chosen, _place(found))}
    if not seen.spatial:
        text = (
            "Bearings count to the right (or the sensor is upside down): mirrored, landmarks stay in place to "
            f"{off_mm:.0f} mm while the wheels move, as reported they wander"
        )
        found.add("sightings.mirrored", text, pose)
    elif chosen.axes == "optical":
        text = f"{_OPTICAL} while the wheels move, to {off_mm:.0f} mm; in the axes as configured they wander"
        found.add("sightings.axes", text, {"recording.sightings_axes": "optical"} | pose)
    else:
        text = (
            f"Landmarks stay in place, to {off_mm:.0f} mm, if the sensor's axes are taken as "
            f"{chosen.axes}; in the axes as configured they wander"
        )
        found.add("sightings.axes", text, {"recording.sightings_axes": "body"} | pose)
    if chosen.scale.off(1.0, _SCALE) or found.landmark_map is not None:
        _scale(found, path, raw, chosen)
    found.noise = track_noise(path, raw, chosen)
    return chosen


def _reach(seen: Sightings, m: Mounting) -> float:
    return float(np.median(np.abs(planar(seen.points, m.axes))))


def _unscaled(m: Mounting) -> bool:
    """Whether ranges and wheels agree on distances, but for what either may be off by."""
    return m.scale.sigma < 0.3 * m.scale.value and abs(math.log(m.scale.value)) < _OTHERWISE + 2.0 * m.scale.sigma


def distances_agree(found: Conventions, path: Path, seen: Sightings) -> bool | None:
    """Whether distances by sightings are those of a path; None: sightings do not determine them."""
    as_given, _ = as_configured(found, seen)
    best = _fitting(fit_sightings(path, as_given), as_given)
    return None if best is None or best.scale.sigma > 0.3 * best.scale.value else _unscaled(best)


def by_landmarks(found: Conventions, path: Path, seen: Sightings) -> Path:
    """Name wheels that way and turn by the landmarks show to be off alike; the path without that."""
    as_given, _ = as_configured(found, seen)
    fits = fit_sightings(path, as_given)
    without = _wheels_off(found, path, as_given, fits) if fits else None
    return path if without is None else without[0]


def _fitting(fits: Mapping[str, Mounting], seen: Sightings) -> Mounting | None:
    """Best of fits by which landmarks stay in place; None: none is like this."""
    best = _best(fits) if fits else None
    return None if best is None or best.misfit > _FITS * _reach(seen, best) else best


def _backwards(
    found: Conventions, path: Path, seen: Sightings, fits: Mapping[str, Mounting]
) -> tuple[Path, dict[str, Mounting]] | None:
    """Name wheels that count backwards, by the landmarks alone; path and fits without that."""
    best, sound = _fitting(fits, seen), fits.get("body")
    usual = sound is not None and best is not None and sound.misfit < WORSE * best.misfit
    if path.source != "ticks" or (usual and sound is not None and abs(sound.yaw.value) < _LOOKS_BACK_RAD):
        return None
    tried = []
    for kind in ("reversed", "left_reversed", "right_reversed"):
        lines = found.right_sides(kind)
        other = found.path_with(lines) if lines else None
        if other is not None and _spins(other, found.config):
            continue
        again = {} if other is None else fit_sightings(other, seen)
        m = again.get("body")
        if other is not None and m is not None and _fitting({"body": m}, seen) and (_unscaled(m) or _alike(m)):
            tried += [(m.misfit, kind, lines, other, again)] * (abs(m.yaw.value) < _LOOKS_BACK_RAD)
    if not tried:
        return None
    misfit, kind, lines, other, again = min(tried, key=lambda one: one[0])
    if best is not None and misfit > WORSE * best.misfit:
        return None
    found.add("wheels.reversed", f"By the landmarks the wheels {WRONG_SIDES[kind]}", lines)
    return other, again


def _spins(path: Path, config: Config) -> bool:
    """Whether a path turns on average faster than robots do: any landmarks fit it somehow."""
    turned = float(np.abs(np.diff(path.poses[:, 2])).sum())
    return turned > config.gate.max_yaw_rate * float(path.times[-1] - path.times[0])


def _wheels_off(
    found: Conventions, path: Path, seen: Sightings, fits: Mapping[str, Mounting]
) -> tuple[Path, dict[str, Mounting]] | None:
    """Name wheels in another unit, before a gear or of other radii, by way and turn alike; path and fits without it.

    No unit of the ranges does it: landmarks show how far the robot turns, whatever their distances are in.
    """
    best = _fitting(fits, seen)
    if path.source not in WHEELS or (best is not None and _unscaled(best)):
        return None
    tried: list[tuple[float, Path, dict[str, Mounting], Mounting]] = []
    alike = [] if best is None else [best.turns.value] * _alike(best)
    for factor in found.wheel_units if path.source == "ticks" and found.config.wheels.in_radians else ():
        fitted = _of_wheels(found, seen, factor)
        if fitted is None:
            continue
        m = fitted[-1]
        turns = max(_best(fits).turns.value, 1e-9)
        better = m.misfit * WORSE < _best(fits).misfit or abs(math.log(turns / factor)) < _OTHERWISE
        if _unscaled(m):
            tried += [(factor, *fitted)] * better
        elif _alike(m):
            alike.append(factor * m.turns.value)
    if not tried:
        others = (float(f"{scale:.4g}") for scale in alike if abs(math.log(scale)) > GEAR)
        tried = [(scale, *fitted) for scale in others if (fitted := _of_wheels(found, seen, scale)) is not None]
        tried = [one for one in tried if _unscaled(one[-1])]
    if not tried:
        return None
    factor, other, again, m = min(tried, key=lambda one: one[-1].misfit)
    off_by = found.wheels_off_by(path, factor)
    if off_by is None:
        return None
    scale = Figure(factor / m.scale.value, factor * m.scale.sigma / m.scale.value**2)
    text = (
        f"By the landmarks the robot moves and turns {scale.value:.3g} ± {scale.sigma:.2g} times as much as its wheels "
        f"say: {off_by[2]}"
    )
    found.add(off_by[1], text, found.wheel_lines(factor), scale)
    return other, again


def _alike(m: Mounting) -> bool:
    """Whether the wheels' way is off by what their turn is off by."""
    return m.turns.value > 0.0 and abs(math.log(m.scale.value * m.turns.value)) < _ALIKE_OFF


def _of_wheels(found: Conventions, seen: Sightings, factor: float) -> tuple[Path, dict[str, Mounting], Mounting] | None:
    """Path of wheels that turn so many times as much, and the fits of sightings to it; None: landmarks wander."""
    path = found.path_with(found.wheel_lines(factor))
    fits = None if path is None else fit_sightings(path, seen)
    best = _fitting(fits, seen) if fits else None
    return None if path is None or not fits or best is None else (path, fits, best)


def _optical_by_few(found: Conventions, seen: Sightings, fits: Mapping[str, Mounting], best: Mounting) -> None:
    """Name an optical frame where few landmarks are seen, which determine no constant: the other one fits by far worse.

    What a robot tells that drives straight on is alike about the camera's axis: then it is the usual frame.
    """
    body, optical = fits.get("body"), fits.get("optical")
    level = np.allclose(_place(found)[:3, :3], np.eye(3), atol=1e-3)  # what is turned already is in axes of its own
    if body is None or optical is None or not (seen.spatial and level):
        return
    if optical.misfit < _NEARLY * best.misfit and _BY_FAR * optical.misfit < body.misfit:
        off_mm, other_mm = (1e3 * m.misfit for m in (optical, body))
        text = (
            f"{_OPTICAL} to {off_mm:.0f} mm while the wheels move, in the configured axes to {other_mm:.0f} mm; of so "
            "few nothing else is told"
        )
        found.add("sightings.axes", text, {"recording.sightings_axes": "optical"})


def _mirrored(
    found: Conventions, path: Path, seen: Sightings, sound: Mounting | None, turned_over: Mounting | None
) -> bool:
    """Whether bearings are a mirror image by the wheels and by the map alike, where the wheels alone are not sure."""
    if seen.spatial or found.landmark_map is None or sound is None or turned_over is None:
        return False
    if turned_over.misfit >= sound.misfit:
        return False
    fit = fit_map(path, seen, sound, found.places)
    return fit is not None and fit.mirrored and fit.misfit < _NO_MAP


def _place(found: Conventions) -> FloatArray:
    return np.eye(4) if found.T_base_sensor is None else found.T_base_sensor


def as_configured(found: Conventions, seen: Sightings, config: Config | None = None) -> tuple[Sightings, FloatArray]:
    """Sightings in the base's axes about the sensor, with what is configured of it; the points in its own axes.

    Args:
        found: the comparison.
        seen: sightings in the sensor's axes.
        config: with which they are read; None: with what was found so far.
    """
    section, T_base_sensor = (config or found.config).landmarks, found.T_base_sensor
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


def _along_axis(found: Conventions, path: Path, seen: Sightings, m: Mounting) -> bool:
    """Name ranges that are distances along the sensor's axis (depths, as of cameras), or the other way round."""
    bearing = np.arctan2(seen.points[:, 1], seen.points[:, 0])
    if seen.spatial or float(np.std(bearing)) < _ASKEW_RAD:  # ahead the two are alike
        return False
    other = with_value(found.config, "landmarks.range_along_axis", along := not found.config.landmarks.range_along_axis)
    places = found.places
    first, second = (as_configured(found, seen, config)[0] for config in (found.config, other))
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
    found.add("sightings.depth", text, {"landmarks.range_along_axis": along}, gain)
    return True


def _best(fits: Mapping[str, Mounting]) -> Mounting:
    """Fit with the least misfit; among nearly equal ones, that with the most usual axes."""
    least = min(m.misfit for m in fits.values())
    return next(fits[name] for name in AXES if name in fits and fits[name].misfit <= _ALIKE * least)


def _pose_of(m: Mounting, T_given: FloatArray) -> list[float]:
    """x, y, z, roll, pitch, yaw of a mounting as ``recording.sightings_pose`` has it; the place if it is known."""
    T = homogeneous(rpy_matrix(0.0, 0.0, m.yaw.value) @ rotation_to_base(m.axes))
    T[2, 3] = T_given[2, 3]
    for k, figure in ((0, m.x), (1, m.y)):
        T[k, 3] = figure.value if figure.sigma < 0.5 * _PLACED_M else T_given[k, 3]
    return [round(v, 4) + 0.0 for v in sensor_pose(T, optical=m.axes == "optical")]


def _constants(found: Conventions, path: Path, seen: Sightings, m: Mounting) -> Mounting:
    """Scale and mounting of a sensor whose axes are right."""
    T, before = _place(found), len(found.findings)
    if m.scale.off(1.0, _SCALE) or found.landmark_map is not None:
        _scale(found, path, seen, m)
    if len(found.findings) == before:
        m = _by_map(found, path, seen, m, T)
    # the graph finds what is within the place's prior
    least = max(_PLACED_M, 3.0 * found.config.landmarks.position_sigma_m)
    place = [(k, f) for k, f in ((0, m.x), (1, m.y)) if f.off(T[k, 3], least) and f.sigma < 0.5 * _PLACED_M]
    turned = m.yaw.off(0.0, _TURNED_RAD)
    if (place or turned) and varied(path):
        moved, what = T.copy(), []
        if turned:
            moved[:3, :3] = rpy_matrix(0.0, 0.0, m.yaw.value) @ T[:3, :3]
            what.append(f"looks {math.degrees(m.yaw.value):+.1f} ± {math.degrees(m.yaw.sigma):.1f}° further left")
        for k, figure in place:
            moved[k, 3] = figure.value
            side = "ahead" if k == 0 else "left"
            what.append(f"sits {figure.value - T[k, 3]:+.2f} ± {figure.sigma:.2f} m further {side}")
        pose = sensor_pose(moved, found.config.recording.sightings_axes == "optical")
        # by a path that is not the configured one, a small turn may be that path's own
        by_other = any("wheels.source" in finding.lines for finding in found.findings)
        found.add(
            "sightings.mounting",
            f"The sensor of the landmarks {' and '.join(what)} than configured, by the wheels' motion",
            {"recording.sightings_pose": [round(v, 4) + 0.0 for v in pose]},
            m.yaw if turned else place[0][1],
            Severity.WARNING if by_other else Severity.ERROR,
        )
    return m


def _by_map(found: Conventions, path: Path, seen: Sightings, m: Mounting, T: FloatArray) -> Mounting:
    """Name ranges that the map refutes, and note the noise; the mounting as wheels and map determine it best."""
    section, known = found.config.landmarks, found.places
    fitted = fit_on_map(path, seen, m, known) if len(known) > 2 else None
    if fitted is None:
        found.noise = track_noise(path, seen, m)
        return m
    by_map, found.noise = fitted
    long = by_map.too_long_m
    if long.off(0.0, _BIAS_M, 3.0):
        text = f"Ranges are {long.value:+.3f} ± {long.sigma:.3f} m too long at {by_map.distance_m:.1f} m, by the map"
        lines = {
            "landmarks.range_bias_m": round(section.range_bias_m + by_map.bias_m.value / section.range_scale, 4),
            "landmarks.range_scale": round(section.range_scale * by_map.scale.value, 4),
        }
        found.add("sightings.range", text, lines, long)
    better = {}
    for name, configured in (("yaw", 0.0), ("x", float(T[0, 3])), ("y", float(T[1, 3])), ("late_s", 0.0)):
        wheels, on_map = getattr(m, name), getattr(by_map, name)
        refuted = abs(on_map.value - configured) + on_map.sigma < abs(on_map.value - wheels.value)
        better[name] = on_map if refuted or on_map.sigma < wheels.sigma else wheels
    return replace(m, **better)


def _scale(found: Conventions, path: Path, seen: Sightings, m: Mounting) -> None:
    """Which of wheels, ranges and map has the wrong scale; two against one decide, of two either may be wrong."""
    by_wheels, places = m.scale, found.places  # true over reported range, in the wheels' metres
    fit = fit_map(path, seen, m, places) if len(places) > 2 else None
    if fit is not None:
        if fit.misfit >= _NO_MAP and fit.in_part:
            text = (
                "The map fits some stretches of the way and not others: the robot was carried or slipped on it, or "
                "landmarks were moved or bear the same number"
            )
            found.add("map.contradiction", text, severity=Severity.WARNING)
            return
        if fit.misfit >= _NO_MAP:
            text = (
                "The map contradicts wheels and sightings, which agree, and neither a mirror image nor a scale of it "
                "fits: check that it is the map of this place, and its ids and positions"
            )
            found.add("map.contradiction", text)
            return
        if fit.shift:
            found.add("map.ids", f"The map's ids are {fit.shift:+d} against those seen", None, Figure(fit.shift, 0.0))
        if fit.mirrored:
            found.add("map.mirrored", _MIRROR_IMAGE)
        # distances on the map over reported ranges, which one view tells; over the wheels', by way of the ranges
        ranges = Figure(by_wheels.value * fit.scale.value, by_wheels.value * fit.scale.sigma)
        relative = math.hypot(fit.scale.sigma / fit.scale.value, by_wheels.sigma / by_wheels.value)
        on_map = Figure(fit.scale.value, fit.scale.value * relative)
        if by_wheels.sigma > _UNSURE * by_wheels.value or not varied(path):
            return  # the wheels do not tell distances, as on one circle
        if on_map.off(1.0, _SCALE):
            _three(found, path, by_wheels, on_map, ranges)
            return
    if not (by_wheels.off(1.0, _SCALE) and varied(path)):
        return
    inverse = Figure(1.0 / by_wheels.value, by_wheels.sigma / by_wheels.value**2)
    sure = max(_WHEEL_UNIT, 2.0 * by_wheels.sigma / by_wheels.value)
    in_unit, unit = found.in_wheel_unit(path, inverse.value, sure), unit_of(by_wheels.value)
    line = round(by_wheels.value * found.config.landmarks.range_scale, 5)
    if in_unit is not None:
        text = (
            f"Distances of landmarks are {inverse.value:.4g} ± {inverse.sigma:.2g} times those of the wheels' motion: "
            f"the wheels' angles or rates are probably in {in_unit[1]} ({in_unit[0]:.4g} rad); or it is the ranges, "
            f"and expert.landmarks.range_scale is {line:g}"
        )
        found.add("wheels.unit", text, found.wheel_lines(in_unit[0]), inverse)
        return
    named = f" (they are in {unit[1]})" if unit is not None else ""
    rival = "" if unit is not None else f"; or the wheels' are {by_wheels.value:.3f} times too long"
    text = (
        f"Distances of landmarks are {inverse.value:.4g} ± {inverse.sigma:.2g} times those of the wheels' motion"
        f"{named}{rival}"
    )
    factor = by_wheels.value if unit is None else unit[0]
    lines = {"landmarks.range_scale": round(factor * found.config.landmarks.range_scale, 5)}
    found.add("sightings.scale", text, lines, by_wheels)


def check_map(found: Conventions, path: Path, seen: Sightings | None) -> None:
    """Name what a map shows whose landmarks are hardly ever in one view: its unit, a mirror image, a sensor turned."""
    if seen is None or len(found.places) < 3 or path.source not in WHEELS or found.codes & _SCALED:
        return
    T = _place(found)
    as_given, _ = as_configured(found, seen)
    fitted = coarse_fit(path, as_given, (float(T[0, 3]), float(T[1, 3])), found.places)
    if fitted is None:
        return
    if fitted.kind:
        if not found.codes & _ORIENTED:
            _other_than_configured(found, fitted)
        return
    scale, count = fitted.scale, fitted.count
    unit = unit_of(1.0 / scale, _COARSELY, speeds=False)
    if unit is None and abs(math.log(scale / 10.0)) < _COARSELY:
        unit = 0.1, "decimetres"
    if unit is None or abs(math.log(scale)) < _NO_DRIFT:
        return
    text = (
        f"Distances on the map are about {scale:.3g} times those that the wheels travel between sightings of its "
        f"landmarks, by {count} of them (it is in {unit[1]})"
    )
    factor = round(found.config.map.scale * unit[0], 6)
    found.add("map.unit", text, {"map.scale": factor}, Figure(1.0 / scale, _COARSELY / scale))


def _other_than_configured(found: Conventions, fitted: CoarseFit) -> None:
    """Name the mirror image, or the turn of wheels or sensor, with which the landmarks stand as on the map."""
    count, kind, T = fitted.count, fitted.kind, _place(found)
    if kind == "map":
        found.add("map.mirrored", _MIRROR_IMAGE)
        return
    if kind == "mirror":
        text = f"Map or bearings are a mirror image, by {count} landmarks: change the sign of all its y, or of bearings"
        found.add("sightings.mirrored", text)
        return
    if kind == "turn":
        text = f"The wheels turn the other way than map and sightings, which agree, by {count} landmarks"
        found.add("wheels.sign", text, _lines_of_turn(found))
        return
    if kind == "bearings":
        code, R, what = "sightings.mirrored", rotation_to_base("body, upside down"), "bearings count to the right"
    else:
        yaw = cmath.phase(LOOKS[kind])
        side = "left" if yaw > 0.0 else "right"
        code, R = "sightings.mounting", rpy_matrix(0.0, 0.0, yaw)
        what = f"the sensor looks {math.degrees(abs(yaw)):.0f}° further to the {side} than configured"
    moved = homogeneous(R @ T[:3, :3])
    moved[:3, 3] = T[:3, 3]
    pose = sensor_pose(moved, found.config.recording.sightings_axes == "optical")
    text = f"The landmarks stand as on the map, by {count} of them, if {what}"
    found.add(code, text, {"recording.sightings_pose": [round(v, 4) + 0.0 for v in pose]})


def _three(found: Conventions, path: Path, by_wheels: Figure, on_map: Figure, ranges: Figure) -> None:
    """Name the one of map, ranges and wheels that the other two contradict."""
    inverse = Figure(1.0 / on_map.value, on_map.sigma / on_map.value**2)
    unit = unit_of(inverse.value, _MAPPED, speeds=False)  # what is left, ranges or wheels may be off by
    if not by_wheels.off(1.0, _SCALE):
        if unit is None and abs(math.log(on_map.value)) < _SURVEYED:
            return
        factor = inverse.value if unit is None else unit[0]
        named = f" (it is in {unit[1]})" if unit is not None else ""
        text = (
            f"Distances on the map are {on_map.value:.4g} ± {on_map.sigma:.2g} times those that wheels and sightings "
            f"agree on{named}"
        )
        found.add("map.unit", text, {"map.scale": round(found.config.map.scale * factor, 6)}, inverse)
    elif not ranges.off(1.0, _SCALE):
        text = f"Distances by the wheels are {inverse.value:.4g} times those that map and sightings agree on"
        in_unit = found.in_wheel_unit(path, on_map.value)
        if in_unit is not None:
            text += f": the wheels' angles or rates are in {in_unit[1]}"
            found.add("wheels.unit", text, found.wheel_lines(in_unit[0]), on_map)
            return
        scale_v = round(found.config.wheels.scale_v * on_map.value, 5)
        found.add("wheels.scale", text, {"wheels.scale_v": scale_v}, on_map)
    else:
        text = (
            f"Map, sightings and wheels have three scales: sightings {1.0 / by_wheels.value:.3f} and map "
            f"{on_map.value:.3f} times the wheels'"
        )
        found.add("scales", text, None, on_map)


# --- the first pose ---------------------------------------------------------------------------------------------------


def check_first_pose(found: Conventions, path: Path, seen: Sightings | None) -> None:
    """Name a first pose that was given and is not where the first sightings put it: one of two frames is shifted."""
    places = found.places
    if found.config.estimator.initial_pose is None or seen is None or found.landmark_map is None:
        return
    if any(f.severity and not f.code.startswith(("truth.", "clock.truth")) for f in found.findings):
        return
    as_given, _ = as_configured(found, seen)
    known = np.array([int(i) in places for i in seen.ids])
    known &= path.known(np.full(len(seen.times), path.times[0]), seen.times)
    sentence = None
    for seconds in (_FIRST_S, *_LATER_S):  # where one landmark is in view at a time, it takes longer to see two
        use = known & (seen.times < seen.times[0] + seconds)
        points = se2.placed(path.at(seen.times[use]), as_given.points[use, :2] + _place(found)[:2, 3])
        there = np.array([places[int(i)] for i in seen.ids[use]]).reshape(-1, 2)
        started = se2.rigid_if_spread(points, there) if len(points) > 3 else None
        if started is None:
            continue
        left = float(np.median(np.hypot(*(se2.placed(started, points) - there).T)))
        if seconds == _FIRST_S:
            sentence = first_pose_sentence(found.config, started)
        elif left < _FITS_M:
            sentence = first_pose_sentence(found.config, started, _DRIFTED)
        break
    if sentence is not None:
        found.findings.append(Finding("frame.first_pose", sentence, Severity.ERROR))
        found.config = with_value(found.config, "estimator.initial_pose", None)


def first_pose_sentence(config: Config, started: FloatArray, drifted: Sequence[float] = (0.0, 0.0, 0.0)) -> str | None:
    """The sentence on a first pose that was given and is not where the sightings put it; None if it is.

    Args:
        config: as the run uses it.
        started: ``(3,)`` where the sightings put the run's first pose.
        drifted: by how much more that may be off [m, m, rad].
    """
    given = config.estimator.initial_pose
    if given is None:
        return None
    apart = se2.log(se2.between(given, started))
    allowed = _SURE * np.array(config.estimator.initial_sigmas) + _SLACK + np.asarray(drifted)
    if (np.abs(apart) <= allowed).all():
        return None
    x, y, yaw = started
    return (
        f"By the map and the sightings the run began at x {x:.2f} m, y {y:.2f} m, yaw {yaw:.2f} rad, but "
        f"estimator.initial_pose says {given[0]:.2f}, {given[1]:.2f}, {given[2]:.2f}: the map is shifted by "
        f"{math.hypot(*apart[:2]):.2f} m and {math.degrees(abs(apart[2])):.0f}°, or the pose is wrong; shift the map "
        f"or set estimator.initial_pose: [{x:.3f}, {y:.3f}, {yaw:.4f}]."
    )
