"""A truth against the wheels: its axes, mirror, unit, clock, frame and mounting.

Only evaluation reads a truth, so that it never decides anything of the sensors; wheels that it refutes are named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.config import Config
from fgloc.diagnosis.comparison import Conventions, unit_of
from fgloc.diagnosis.pairs import (
    BLOCKS,
    FOLLOWS,
    LAG_SIGMAS,
    LATE_S,
    MOST_LAG_S,
    RATE_SCALE,
    SITS,
    ComplexArray,
    Figure,
    best_lag,
    complex_poses,
    explained,
    fit_rate,
    irls,
    jackknife,
)
from fgloc.diagnosis.signals import Path, in_order
from fgloc.types import FloatArray, Severity

_WINDOW_S = 2.0  # over which displacements are compared
_SCALE = 0.03  # of a distance: less is a constant, which the graph estimates
_RESPONSE_S = 0.1  # a robot follows its commands with a lag of its own, which is no clock's
_WHEELS_OFF = 0.2  # logarithm of a way that a unit or a gear leaves
_PRIOR_SIGMAS = 4.0  # of the wheels, by which a truth may find them off: what is further off no run estimates
_GAP_S = 0.25  # between two poses of the truth, over which it is interpolated
_KNOWN_YAW = 0.01  # rad: sigma of the yaw of a tracked body that hardly turned
_FROZEN_S, _MOVES_MPS, _FROZEN_SHARE = 0.1, 0.05, 0.02  # of a truth; fewer repetitions are a slower source's
_FEWEST = 30  # messages of a truth
_JUMP_M, _JUMP_RAD = 0.3, 0.5  # within one message of a truth: noise and bursts of stamps make less
_TURNS_RAD, _WINDOWS = 0.05, 6  # rad in a second, for so many of them
_SAME_YAW = 1e-3  # share of a turn by which a truth's yaw differs from the odometry's that it is
_WIDE_M, _IN_PLANE, _LEVEL_DEG = 0.3, 0.5, 1.0  # of a truth's places: spread, share off their plane, tilt of it
_PLANES = 8  # blocks of time of a plane's jackknife
_FRAME_M = 0.3  # mean distance to the truth above which its frame is asked about: no run as installed errs by so much
_ALIGNED = 0.2  # share of that distance which may remain when the frames are brought together


@dataclass(frozen=True, slots=True)
class BodyFit:
    """A body whose poses are known from elsewhere, on a robot whose wheels are known.

    Attributes:
        mirrored: whether its positions are a mirror image (x and y exchanged, or one of them negated).
        turns: its turn over the robot's: 1, or -1 if its yaw counts the other way.
        scale: its distances over the robot's.
        yaw: of its axes in the base frame [rad].
        x: of its origin in the base frame [m].
        y: likewise.
        late_s: how much later its stamps are than the wheels'.
        misfit: robust standard deviation of a displacement [m].
        share: of the turn's variance that is explained.
    """

    mirrored: bool
    turns: Figure
    scale: Figure
    yaw: Figure
    x: Figure
    y: Figure
    late_s: Figure
    misfit: float
    share: float


def fit_body(path: Path, poses: FloatArray) -> BodyFit | None:
    """Mounting of a body with given poses, and their errors, from its displacements and the wheels'.

    Args:
        path: motion of the wheels.
        poses: rows of time, x, y and continuous yaw.

    Returns:
        None where the two share too little time, or the robot does not move.
    """
    times, yaw = poses[:, 0], poses[:, 3]
    rate = fit_rate(path, times, yaw)
    by_turn = None if rate is None or rate.share < FOLLOWS else rate.late_s
    late = 0.0 if by_turn is None else by_turn.value
    start = np.arange(path.times[0], path.times[-1] - _WINDOW_S, 0.2)
    start = start[path.known(start, start + _WINDOW_S)]
    start = start[_covered(times, start + late) & _covered(times, start + _WINDOW_S + late)]
    if len(start) < 40:
        return None
    if by_turn is None:
        late = _speed_lag(path, poses, start)
    fits = {m: _body(path, poses, start, late, m) for m in (False, True)}
    mirrored = fits[True][1] < 0.5 * fits[False][1]
    if fits[False][0][2] < 0.0 and fits[True][1] < 2.0 * fits[False][1]:  # it went so straight that both fit
        mirrored = _course_turns(path, poses, start, late) < 0.0
    (alpha, lever, turns), misfit, travelled = fits[mirrored]
    if travelled < 0.1:
        return None
    left_out = []
    for block in np.array_split(np.arange(len(start)), BLOCKS):
        x = _body(path, poses, np.delete(start, block), late, mirrored)[0]
        turned = math.remainder(np.angle(x[0]) - np.angle(alpha), math.tau)
        left_out.append((x[2], abs(x[0]), turned, x[1].real, x[1].imag))
    s = jackknife(np.array(left_out)).tolist()
    return BodyFit(
        mirrored,
        Figure(turns, s[0]),
        Figure(abs(alpha), s[1]),
        Figure(float(np.angle(alpha)), s[2]),
        Figure(lever.real, s[3]),
        Figure(lever.imag, s[4]),
        Figure(late, 0.05 if by_turn is None else by_turn.sigma),
        misfit,
        0.0 if rate is None else rate.share,
    )


def _course_turns(path: Path, poses: FloatArray, start: FloatArray, late: float) -> float:
    """Turn of a body's course from half a window to the next, times that of the wheels: negative for a mirror image."""
    places = [_at(poses, start + late + share * _WINDOW_S)[0] for share in (0.0, 0.5, 1.0)]
    bend = ((places[2] - places[1]) * (places[1] - places[0]).conj()).imag
    yaw = [np.interp(start + share * _WINDOW_S, path.times, path.poses[:, 2]) for share in (0.25, 0.75)]
    return float(bend @ (yaw[1] - yaw[0]))


def _covered(times: FloatArray, at: FloatArray) -> NDArray[np.bool_]:
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    return np.asarray((times[after] - times[after - 1] < _GAP_S) & (at >= times[0]) & (at <= times[-1]))


def _at(poses: FloatArray, at: FloatArray) -> tuple[ComplexArray, FloatArray]:
    x, y, yaw = (np.interp(at, poses[:, 0], poses[:, k]) for k in (1, 2, 3))
    return x + 1j * y, np.asarray(yaw)


def _speed_lag(path: Path, poses: FloatArray, start: FloatArray) -> float:
    """Lag [s] by the distances, for a body whose yaw is no measure of it."""
    way = np.abs(np.diff([np.interp(start + d, path.times, _length(path.poses[:, :2])) for d in (0.0, 0.4)], axis=0)[0])

    def shares(lags: FloatArray) -> FloatArray:
        at = start + lags[:, None]
        return explained(way, np.abs(_at(poses, at + 0.4)[0] - _at(poses, at)[0]))[1]

    return best_lag(shares, MOST_LAG_S)[0]


def _length(places: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])


def _body(
    path: Path, poses: FloatArray, start: FloatArray, late: float, mirrored: bool
) -> tuple[tuple[complex, complex, float], float, float]:
    """Least squares of displacements: of the body in its axes, by those of the base and by the lever arm.

    With the body at l in the base, turned by δ: ``e^{iδ} s d_body = d_base + (e^{iφ} - 1) l``.
    """
    p1, r1 = complex_poses(path, start)
    p2, r2 = complex_poses(path, start + _WINDOW_S)
    base, turn = (p2 - p1) / r1, r2 / r1
    q1, psi1 = _at(poses, start + late)
    q2, psi2 = _at(poses, start + _WINDOW_S + late)
    own = (q2 - q1) * np.exp(-1j * psi1)
    turned = np.asarray(psi2 - psi1)
    if mirrored:
        own, turned = own.conj(), -turned
    phi = np.interp(start + _WINDOW_S, path.times, path.poses[:, 2]) - np.interp(start, path.times, path.poses[:, 2])
    turns = 1.0
    if float(np.std(phi)) > 0.05:
        turns, share = (float(of[0]) for of in explained(turned, phi[None]))
        if 0.0 < turns < 1.0 and share > 0.0:  # the wheels' noise makes it smaller, by down to the share explained
            turns = min(1.0, turns / share)
    x, residual = irls(np.column_stack([own, -(turn - 1.0)]), base, 1e-6, SITS)
    size = abs(x[0])
    relative = complex(x[0]) / size**2 if size > 1e-9 else 1e9 + 0j  # e^{iδ} over s: its distances over the robot's
    return (complex(relative), complex(x[1]), turns), float(np.median(residual)), float(np.median(np.abs(base)))


def true_body(found: Conventions, path: Path) -> BodyFit | None:
    """Truth against the wheels; None: there is none, or it is of something else. Only evaluation reads a truth."""
    if len(found.signals.truth) < _FEWEST or path.length_m < 0.3:
        return None
    _frozen(found, path)
    _jumps(found, path)
    poses = found.signals.true_poses()
    if poses is None:
        return None
    _tilted(found)
    section = found.config.truth
    own = poses.copy()
    own[:, 1:3] *= section.scale
    if section.axes == "ned":
        own[:, 1:] = np.column_stack([own[:, 2], own[:, 1], 0.5 * math.pi - own[:, 3]])
    x, y, turned = se2.inverse((*section.offset_m, section.yaw_offset_rad)).tolist()
    own[:, 1:3] += se2.turned(np.array([x, y]), own[:, 3])
    own[:, 3] += turned
    if not found.signals.true_yaw or float(np.ptp(own[:, 3])) < 1e-3 < 0.1 < float(np.ptp(path.poses[:, 2])):
        found.add("truth.no_yaw", "The truth has no yaw: only positions are compared", severity=Severity.NOTE)
        return None
    _shared_yaw(found, own)
    fit = fit_body(path, own)
    if fit is not None and fit.share > FOLLOWS and fit.turns.value > 0.0:
        path, fit = _wheels_off(found, path, own, fit)
    if fit is not None and fit.share > FOLLOWS and fit.turns.value > 0.0 and fit.turns.off(1.0, RATE_SCALE):
        turns = fit.turns
        if "wheels.turn" not in found.codes:
            scale_omega = round(found.wheels.scale_omega * turns.value, 4)
            text = (
                f"By the truth the robot turns {turns.value:.3f} ± {turns.sigma:.2g} times as much as its wheels say "
                f"(a track or a geometry that is not the robot's); if so, set wheels.scale_omega: {scale_omega:g}"
            )
            sigma = math.hypot(found.config.wheels.turn_scale_sigma, found.config.wheels.scale_sigma)
            found.add("wheels.turn", text, None, turns, _refuted(turns, sigma))
        fit = fit_body(path.turned(turns.value), own)
    return None if fit is None or fit.misfit > 0.25 else fit


def _wheels_off(found: Conventions, path: Path, own: FloatArray, fit: BodyFit) -> tuple[Path, BodyFit]:
    """Name wheels in another unit, before a gear or of other radii, by way and turn alike; path and fit without it."""
    off_by = found.wheels_off_by(path, fit.turns.value)
    other = None if off_by is None else found.path_with(found.wheel_lines(off_by[0]))
    again = None if other is None else fit_body(other, own)
    if off_by is None or other is None or again is None or abs(math.log(again.scale.value)) > _WHEELS_OFF:
        return path, fit
    factor, code, clause = off_by
    lines = "; ".join(f"{key}: {value:g}" for key, value in found.wheel_lines(factor).items())
    text = (
        f"By the truth the robot moves and turns {factor * again.scale.value:.3g} times as much as its wheels say: "
        f"{clause}; if so, set {lines}"
    )
    found.add(code, text, None, fit.turns)
    return other, again


def _refuted(by_truth: Figure, prior_sigma: float) -> Severity:
    """Severity of a scale of the wheels by the truth, which is never written: only evaluation reads a truth."""
    return Severity.ERROR if abs(math.log(by_truth.value)) > _PRIOR_SIGMAS * prior_sigma else Severity.WARNING


def _shared_yaw(found: Conventions, truth: FloatArray) -> None:
    """Name a truth whose yaw is the odometry's: two measurements never agree so well."""
    rows = in_order(found.signals.odometry)
    if len(rows) < 50:
        return
    at = np.arange(max(truth[0, 0], rows[0, 0]), min(truth[-1, 0], rows[-1, 0]), 1.0)
    if len(at) < 2:
        return
    theirs = np.diff(np.interp(at, truth[:, 0], truth[:, 3]))
    ours = np.diff(np.interp(at, rows[:, 0], np.unwrap(rows[:, 3])))
    turning = np.abs(ours) > _TURNS_RAD
    if turning.sum() < _WINDOWS or np.median(np.abs(theirs - ours)[turning] / np.abs(ours)[turning]) > _SAME_YAW:
        return
    text = "The truth's yaw is the odometry's: the two are one measurement, and it judges no yaw"
    found.add("truth.yaw_is_odometry", text, severity=Severity.NOTE)


def _tilted(found: Conventions) -> None:
    """Name a truth whose positions lie in a plane that is not level."""
    places = np.array(found.signals.truth)[:, 1:4]
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
    if tilt > 0.25 * math.pi:
        text = "The truth's plane stands upright: another axis than z is up, y in some motion capture: turn it"
        found.add("truth.axes", text, None, figure, Severity.WARNING)
        return
    text = (
        f"The truth's plane is tilted by {figure.value:.1f}° (± {figure.sigma:.1f}) against its z axis, or the floor "
        f"slopes: distances along the slope are {100.0 * (1.0 - math.cos(tilt)):.2g} % short"
    )
    found.add("truth.tilt", text, None, figure, Severity.NOTE)


def _normal(places: FloatArray) -> tuple[FloatArray, float, float]:
    """Normal ``(3,)``, its largest part positive, of places ``(n, 3)``; their spread in its plane and off it [m].

    The spread is that in the narrower direction.
    """
    use = np.ones(len(places), dtype=bool)
    for _ in range(3):  # without glitches
        middle = np.median(places[use], axis=0)
        _, sizes, axes = np.linalg.svd(places[use] - middle, full_matrices=False)
        off = np.abs((places - middle) @ axes[2])
        use = off <= 4.0 * float(np.median(off)) + 1e-9
    size = sizes / math.sqrt(float(use.sum()))
    return axes[2] * math.copysign(1.0, axes[2, np.argmax(np.abs(axes[2]))]), float(size[1]), float(size[2])


def _frozen(found: Conventions, path: Path) -> None:
    """Name a truth that repeats its pose while the wheels move."""
    rows = in_order(found.signals.truth)
    repeated = np.append(False, np.abs(np.diff(rows[:, 1:], axis=0)).max(axis=1) == 0.0)
    place = path.at(np.column_stack([rows[:, 0] - _FROZEN_S, rows[:, 0]]).ravel())[:, :2].reshape(-1, 2, 2)
    moving = np.linalg.norm(place[:, 1] - place[:, 0], axis=1) > _FROZEN_S * _MOVES_MPS
    share = float(repeated[moving].mean()) if moving.any() else 0.0
    if share > _FROZEN_SHARE:
        text = f"The truth is frozen in {100.0 * share:.0f} % of its messages while the robot moves: poses are repeated"
        found.add("truth.frozen", text, None, Figure(share, 0.0), Severity.NOTE)


def _jumps(found: Conventions, path: Path) -> None:
    """Name a truth that jumps: by more, from one message to the next, than it otherwise moves or turns in that time."""
    rows = in_order(found.signals.truth)
    seconds = np.diff(rows[:, 0])
    turned = 2.0 * np.arccos(np.minimum(np.abs((rows[1:, 4:8] * rows[:-1, 4:8]).sum(axis=1)), 1.0))
    moved = np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1)
    extents = [
        np.linalg.norm(np.ptp(np.percentile(places, (5, 95), axis=0), axis=0))
        for places in (rows[:, 1:3], path.at(rows[:, 0])[:, :2])
    ]
    unit = max(float(extents[0]) / max(float(extents[1]), _WIDE_M), 1.0)  # of a truth in millimetres
    apart = (moved, _JUMP_M * unit), (turned, _JUMP_RAD)
    jumped = np.any([d > slack + 3.0 * np.percentile(d / seconds, 90) * seconds for d, slack in apart], axis=0)
    gap = seconds > found.config.truth.max_gap_s
    jumped &= ~(gap | np.append(False, gap[:-1]))  # what comes first after a gap may be older than its stamp of receipt
    if jumped.any():
        times = f"{jumped.sum()} time{'s' if jumped.sum() > 1 else ''}"
        text = f"The truth jumps {times}, by up to {moved[jumped].max():.3g} m and {turned[jumped].max():.3g} rad"
        found.add("truth.jumps", text, None, Figure(float(jumped.mean()), 0.0), Severity.WARNING)


def check_body(found: Conventions, fit: BodyFit) -> None:
    """Name what is wrong with axes, unit, clock and mounting of the truth, or with the scale of the wheels."""
    section, warn = found.config.truth, Severity.WARNING
    if fit.mirrored:
        other = "enu" if section.axes == "ned" else "ned"
        text = "The truth is a mirror image of the wheels' path: its axes are north, east, down"
        found.add("truth.axes", text, {"truth.axes": other}, severity=warn)
    elif fit.share > 0.5 and fit.turns.value < -0.5:
        text = "The truth's yaw counts clockwise although its positions do not"
        found.add("truth.yaw_sign", text, None, fit.turns, warn)
        return
    scale, unit = fit.scale, unit_of(1.0 / fit.scale.value)
    if unit is None and scale.off(1.0, _SCALE):
        scale_v = round(found.wheels.scale_v * scale.value, 4)
        text = (
            f"By the truth the robot moves {scale.value:.3f} ± {scale.sigma:.2g} times as far as its "
            f"wheels say; if the truth's metres are right, set wheels.scale_v: {scale_v:g}"
        )
        found.add("wheels.scale", text, None, scale, _refuted(scale, found.config.wheels.scale_sigma))
    elif unit is not None and scale.off(1.0, 0.08):
        text = (
            f"Distances of the truth are {scale.value:.4g} ± {scale.sigma:.2g} times the wheels' (it is in {unit[1]})"
        )
        found.add("truth.scale", text, {"truth.scale": round(section.scale * unit[0], 6)}, scale, warn)
    late_s = fit.late_s
    if late_s.off(0.0, _RESPONSE_S if found.commanded else LATE_S, LAG_SIGMAS) and fit.share > FOLLOWS:
        side = "late" if late_s.value > 0 else "early"
        text = f"The truth's stamps are {abs(late_s.value):.3f} s {side} (± {late_s.sigma:.3f}) against the wheels'"
        found.add("clock.truth", text, found.earlier("truth", late_s.value), late_s, warn)
    if fit.share < 0.3 and fit.yaw.sigma > _KNOWN_YAW:
        return
    off_place = [f.off(0.0, 0.03) and f.sigma < 0.05 and fit.share >= 0.3 for f in (fit.x, fit.y)]
    turned = fit.yaw.off(0.0, 0.04)
    if not turned and not any(off_place):
        return
    kept = [f.value if off else 0.0 for f, off in zip((fit.x, fit.y), off_place, strict=True)]
    T_base_body = se2.compose((*kept, fit.yaw.value if turned else 0.0), (*section.offset_m, section.yaw_offset_rad))
    lines: dict[str, Any] = {}
    what = []
    if turned:
        lines["truth.yaw_offset_rad"] = round(float(T_base_body[2]), 4)
        what.append(f"is turned by {math.degrees(fit.yaw.value):+.1f} ± {math.degrees(fit.yaw.sigma):.1f}°")
    if any(off_place):
        what.append(f"sits at {fit.x.value:+z.2f}, {fit.y.value:+z.2f} m")
    if any(off_place) or section.offset_m != (0.0, 0.0):
        lines["truth.offset_m"] = [round(v, 3) + 0.0 for v in T_base_body[:2].tolist()]
    text = f"The body that the truth tracks {' and '.join(what)} in the robot's axes"
    found.add("truth.mounting", text, lines, fit.yaw, warn)


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
