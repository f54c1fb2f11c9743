"""Ranges to known anchors against the wheels: which way and how much the robot turns, scale and offset of the ranges.

The path by the wheels is cut into stretches. Each is laid onto the anchors by its own rigid motion, and all share what
may be wrong: the share by which the robot turns and travels more than its wheels say, and scale and offset of the
ranges. Robust least squares from every sign and several sizes of the turn; their sigmas are of a jackknife over the
stretches. Ranges without bearing tell the sign of a turn as well as a gyro does, if the robot turns both ways or curves
about more than one anchor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.pairs import MAD, ComplexArray, Figure, jackknife
from fgloc.diagnosis.signals import GRID_S, Path, in_order
from fgloc.sensors.checks import listed
from fgloc.sensors.uwb import UNITS, usual_unit
from fgloc.types import FloatArray, Severity

_MOST_STRETCHES, _FEWEST_STRETCHES = 12, 4
_LONGEST_S, _SHORTEST_S = 40.0, 5.0  # of a stretch: wheels err little over it, and the robot turns
_FEWEST, _FEWEST_ANCHORS = 12, 3  # ranges of a stretch; anchors of all
_LEAST_M, _LEAST_RAD = 0.3, 0.3  # way and turn of a stretch: less tells nothing
_TURNS = (-1.0, 0.5, -0.5, 2.0, -2.0)  # of the robot over the wheels', tried as starts beside 1 ...
_SOUND = 1.15  # ... if that leaves errors of more than so many times the noise as configured
_AROUND = np.linspace(-math.pi, math.pi, 16, endpoint=False)  # rad: directions in which a stretch may begin
_MOST_RANGES = 120  # of a stretch, evenly chosen
_PRIOR = np.array([1.0, 0.1, 0.1, 0.3])  # sigmas of ln turn, ln way, ln range and offset [m]
_HELD_TURN, _HELD_SCALE = (np.where(np.arange(4) == k, 1e-6, _PRIOR) for k in (0, 2))
_DONE = 1e-6  # relative change of cost or unknowns at which a solution stands
_FLOOR_M = 0.03  # of a range's noise, with what wheels err by over a stretch
_WORSE = 1.4  # times the misfit of the best turn from which on the one as configured is refuted ...
_APART, _RIVAL = 0.3, 1.1  # ... and any other that is so far from the best
_TURN_OFF, _WAY_OFF, _RANGE_OFF, _BIAS_OFF_M = 0.15, 0.1, 0.03, 0.05  # less are constants, which the graph estimates
_SOUND_VALUES = np.array([1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0])  # turn, way, scale, offset; with the scale held
_LEAST = np.array([_TURN_OFF, _WAY_OFF, _RANGE_OFF, math.inf, math.inf, math.inf, math.inf, _BIAS_OFF_M])


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """A stretch of the path, and its ranges ``(n,)`` [m] with their times ``(n,)`` [s] and anchors ``(n, 3)``."""

    path: Path
    times: FloatArray
    ranges: FloatArray
    anchors: FloatArray


@dataclass(frozen=True, slots=True)
class RangeFit:
    """What ranges say of the wheels and of themselves.

    Attributes:
        turn: turn of the robot over that of its wheels; negative: they turn the other way.
        way: likewise of the way.
        scale: reported over true distance.
        bias_m: what reported ranges are too long by if their scale is right [m].
        misfit: robust standard deviation of a range [m] ...
        as_given: ... if the robot turns as its wheels say ...
        rival: ... and with the best of the turns that are far from ``turn``.
    """

    turn: Figure
    way: Figure
    scale: Figure
    bias_m: Figure
    misfit: float
    as_given: float
    rival: float


def fit_ranges(
    path: Path, rows: Sequence[tuple[float, ...]], anchors: Mapping[int, FloatArray], tag: FloatArray, noise_m: float
) -> RangeFit | None:
    """Fit of ranges to the path; None: too few ranges, or anchors, or the robot hardly moves.

    Args:
        path: motion of the wheels.
        rows: time [s], anchor and range [m].
        anchors: places ``(3,)`` in the map.
        tag: place ``(3,)`` in the base frame.
        noise_m: of a range, as configured: no other turn is tried if the one by the wheels leaves no more.
    """
    known = in_order([row for row in rows if int(row[1]) in anchors])
    if len(known) < _FEWEST or len(set(known[:, 1].tolist())) < _FEWEST_ANCHORS:
        return None
    stretches = _stretches(path, known, anchors)
    if len(stretches) < _FEWEST_STRETCHES:
        return None
    problem = _Problem(stretches, tag)
    held = problem.solve(problem.begin(1.0), _HELD_TURN)
    as_given = problem.misfit(held)
    tried = [problem.solve(held)]
    if as_given > _SOUND * noise_m:
        tried += [problem.solve(problem.begin(turn)) for turn in _TURNS]
    best = min(tried, key=problem.misfit)
    rivals = [problem.misfit(x) for x in tried if abs(x.turn - best.turn) > _APART]
    unscaled = problem.solve(best, _HELD_SCALE)
    found = np.array([*best.values, *unscaled.values])
    sigma = np.zeros(len(found))
    if (np.abs(found - _SOUND_VALUES) > _LEAST).any():  # else nothing can be named, however sure it is
        left_out = []
        for k in range(len(stretches)):
            some = _Problem([*stretches[:k], *stretches[k + 1 :]], tag)
            both = (some.solve(x.without(k), prior) for x, prior in ((best, _PRIOR), (unscaled, _HELD_SCALE)))
            left_out.append([value for x in both for value in x.values])
        sigma = jackknife(np.array(left_out))
    turn, way, scale, _, _, _, _, bias = (Figure(float(v), float(s)) for v, s in zip(found, sigma, strict=True))
    return RangeFit(turn, way, scale, bias, problem.misfit(best), as_given, min(rivals, default=math.inf))


def _stretches(path: Path, rows: FloatArray, anchors: Mapping[int, FloatArray]) -> list[_Stretch]:
    """Stretches of equal length in which the robot moves and turns by its wheels."""
    first, last = max(path.times[0], rows[0, 0]), min(path.times[-1], rows[-1, 0])
    length = min(_LONGEST_S, max((last - first) / (2 * _FEWEST_STRETCHES), _SHORTEST_S))
    made = []
    for began in np.arange(first, last - 0.5 * length, length):
        own = rows[(rows[:, 0] >= began) & (rows[:, 0] < began + length)]
        own = own[path.known(np.full(len(own), began), own[:, 0])][:: max(1, len(own) // _MOST_RANGES)]
        inside = slice(*np.searchsorted(path.times, [began - GRID_S, began + length + GRID_S]))
        part = Path(path.times[inside], path.poses[inside], path.gaps[inside])
        if len(own) < _FEWEST or part.length_m < _LEAST_M or float(np.ptp(part.poses[:, 2])) < _LEAST_RAD:
            continue
        made.append(_Stretch(part, own[:, 0], own[:, 2], np.array([anchors[int(i)] for i in own[:, 1]])))
    return made[:: -(-len(made) // _MOST_STRETCHES)] if made else []


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Turn to begin with, unknowns ``(4,)`` that all stretches share, and their first poses ``(s, 3)``.

    The four are logarithms of turn over that to begin with, of way and of range, and the offset [m].
    """

    began: float
    shared: FloatArray
    poses: FloatArray

    @property
    def turn(self) -> float:
        """Turn of the robot over that of its wheels."""
        return self.began * math.exp(self.shared[0])

    @property
    def values(self) -> tuple[float, float, float, float]:
        """Turn, way, reported over true range, and offset [m]."""
        _, way, long, bias = self.shared.tolist()
        return self.turn, math.exp(way), math.exp(long), bias

    def without(self, k: int) -> _Solution:
        """The solution without a stretch."""
        return replace(self, poses=np.delete(self.poses, k, axis=0))


class _Problem:
    """The stretches of a path with what they share."""

    def __init__(self, stretches: Sequence[_Stretch], tag: FloatArray) -> None:
        self._stretches, self._tag = stretches, tag

    def misfit(self, x: _Solution) -> float:
        """Robust standard deviation of a range [m] about its prediction."""
        return MAD * float(np.median(np.abs(self._errors(x))))

    def begin(self, turn: float) -> _Solution:
        """Each stretch by itself laid onto the anchors, if the robot turns so much more than its wheels."""
        poses = [_laid(self._tag_places(s, turn, 1.0), s) for s in self._stretches]
        return _Solution(turn, np.zeros(4), np.array(poses))

    def solve(self, x: _Solution, prior: FloatArray = _PRIOR) -> _Solution:
        """Least squares with Cauchy's loss at the noise that residuals show; ``prior (4,)``: sigmas of the shared."""
        for _ in range(2):
            sigma = max(self.misfit(x), _FLOOR_M)

            def residuals(u: FloatArray, x: _Solution = x, sigma: float = sigma) -> FloatArray:
                off = self._errors(_Solution(x.began, u[:4], u[4:].reshape(-1, 3))) / sigma
                return np.append(np.sign(off) * np.sqrt(2.0 * np.log1p(0.5 * off**2)), u[:4] / prior)

            u = least_squares(residuals, np.append(x.shared, x.poses.ravel()), method="lm", ftol=_DONE, xtol=_DONE).x
            x = _Solution(x.began, u[:4], u[4:].reshape(-1, 3))
        return x

    def _errors(self, x: _Solution) -> FloatArray:
        """Reported less predicted ranges [m]."""
        turn, way, scale, bias = x.values
        errors = []
        for s, (px, py, yaw) in zip(self._stretches, x.poses, strict=True):
            q = complex(px, py) + np.exp(1j * yaw) * self._tag_places(s, turn, way)
            away = q - (s.anchors[:, 0] + 1j * s.anchors[:, 1])
            distance = np.hypot(np.abs(away), s.anchors[:, 2] - self._tag[2])
            errors.append(s.ranges - distance * scale - bias)
        return np.concatenate(errors)

    def _tag_places(self, s: _Stretch, turn: float, way: float) -> ComplexArray:
        """Places ``(n,)`` of the tag at the ranges of a stretch, in the base frame of its first one."""
        poses = s.path.turned(turn).at(s.times)
        z, yaw = poses[:, 0] + 1j * poses[:, 1], poses[:, 2] - poses[0, 2]
        tag = complex(self._tag[0], self._tag[1])
        return np.asarray(way * (z - z[0]) * np.exp(-1j * poses[0, 2]) + np.exp(1j * yaw) * tag)


def _laid(z: ComplexArray, s: _Stretch) -> FloatArray:
    """Pose ``(3,)`` of a stretch's start by which the tag's places fit the ranges best, of all directions tried.

    For one direction squared ranges are linear in the start and in its squared distance from the origin.
    """
    a = s.anchors[:, 0] + 1j * s.anchors[:, 1]
    centre = a.mean()
    best, least = np.zeros(3), math.inf
    for yaw in _AROUND:
        b = a - centre - np.exp(1j * yaw) * z  # |start - b| is the range
        A = np.column_stack([-2.0 * b.real, -2.0 * b.imag, np.ones(len(b))])
        found = np.linalg.lstsq(A, s.ranges**2 - np.abs(b) ** 2, rcond=None)[0]
        start = complex(found[0], found[1])
        cost = float(np.median(np.abs(np.abs(start - b) - s.ranges)))
        if cost < least:
            least, best = cost, np.array([start.real + centre.real, start.imag + centre.imag, yaw])
    return best


# --- Findings ---------------------------------------------------------------------------------------------------------


_MARGIN = 1.2  # of the bound of ranges over the farthest
_MISSES = 0.7  # times what two ranges have to be together, at least, to reach from one anchor to the other
_OF_ANCHOR = 5  # ranges of an anchor whose median counts


def check_radio(found: Conventions) -> None:
    """Name ranges of another unit, and anchors none of which the settings have."""
    section: Any = getattr(found.config, "uwb", None)
    rows = found.signals.ranges
    if section is None or len(rows) < _FEWEST:
        return
    heard, bound = sorted({int(row[1]) for row in rows}), found.config.gate.max_range
    ranges = np.array([row[2] for row in rows])
    low, middle, high = np.percentile(ranges, [1.0, 50.0, 99.0])
    if middle > bound and (unit := _unit(section, rows, bound)) is not None:
        text = (
            f"Half of the ranges are beyond the {bound:g} m of expert.gate.max_range ({low:.4g} to {high:.4g} m): they "
            f"are in {UNITS[unit]}"
        )
        far = {"gate.max_range": float(math.ceil(_MARGIN * high * unit))} if high * unit > bound else {}
        found.add("uwb.unit", text, {"uwb.unit_m": float(f"{section.unit_m * unit:.6g}")} | far)
        found.signals = replace(found.signals, ranges=[(t, i, r * unit) for t, i, r in rows])
    if section.anchors and not section.anchors.keys() & set(heard):
        text = (
            f"None of the anchors that are heard ({listed(heard)}) is in uwb.anchors, which has "
            f"{listed(section.anchors)}: no range is used. Give places by the numbers that the messages have (the "
            "figures at the end of frame_id, else in the topic's name)"
        )
        found.add("uwb.other_ids", text)


def _unit(section: Any, rows: Sequence[tuple[float, ...]], bound: float) -> float | None:
    """Unit [m] that brings ranges within the bound and to anchors; None: no usual one, or it is not sure."""
    ranges = [row[2] for row in rows]
    fitting = [unit for unit in UNITS if float(np.median(ranges)) * unit <= bound]
    middles = {}
    for number, place in section.anchors.items():
        own = [row[2] for row in rows if int(row[1]) == number]
        if len(own) >= _OF_ANCHOR:
            middles[number] = (np.array(place), float(np.median(own)))
    pairs = [(a, b) for k, a in enumerate(middles.values()) for b in list(middles.values())[k + 1 :]]
    if pairs:  # two ranges together reach from one anchor to the other
        short = [min(u * (r + s) / max(float(math.dist(p, q)), 1e-9) for (p, r), (q, s) in pairs) for u in fitting]
        return next((u for u, share in zip(fitting, short, strict=True) if share > _MISSES), None)
    return usual_unit(ranges, bound)


def check_ranges(found: Conventions, path: Path) -> Path:
    """Name wheels that turn the other way or otherwise than ranges show, and ranges that are too long.

    Returns:
        The path by the wheels with what is found.
    """
    section = getattr(found.config, "uwb", None)
    if section is None or not section.anchors or not found.signals.ranges:
        return path
    anchors = {i: np.array(place, dtype=float) for i, place in section.anchors.items()}
    rows = [(t, i, (r - section.bias_m) / section.scale) for t, i, r in found.signals.ranges]
    fit = fit_ranges(path, rows, anchors, np.array(section.tag, dtype=float), section.sigma_m)
    if fit is None:
        return path
    given = found.config.wheels
    refuted = fit.misfit * _WORSE < fit.as_given and fit.misfit * _RIVAL < fit.rival
    gyro_agrees = found.signals.rates() is not None and not found.opposite  # with the wheels: no range refutes it
    turns = refuted and fit.turn.off(1.0, _TURN_OFF, 4.0)
    if turns and not gyro_agrees:
        _turn(found, fit.turn)
    elif turns and not fit.turn.off(-1.0, _TURN_OFF):
        text = (
            "The anchors are a mirror image of where they stand: wheels and gyro agree on left and right, ranges do "
            "not (or the odometry has its turns from a gyro that is mounted the wrong way up)"
        )
        mirrored = {number: (x, -y, z) for number, (x, y, z) in section.anchors.items()}
        found.add("uwb.mirrored", text, {"uwb.anchors": mirrored}, fit.turn)
    elif found.opposite and not refuted:
        text = "The gyro turns in the opposite direction of wheels and ranges, which agree"
        found.add("imu.sign", text, {"gyro.scale": -found.config.gyro.scale}, fit.turn)
    if fit.way.off(1.0, _WAY_OFF, 4.0) and not fit.scale.off(1.0, _RANGE_OFF, 4.0):
        text = f"The wheels' way is {1.0 / fit.way.value:.3f} ± {fit.way.sigma:.2g} times what ranges and anchors show"
        found.add("wheels.scale", text, {"wheels.scale_v": round(given.scale_v * fit.way.value, 5)}, fit.way)
    _long(found, fit)
    return path if found.config.wheels == given else found.read_again(path)


def _turn(found: Conventions, turn: Figure) -> None:
    wheels, size = found.config.wheels, abs(turn.value)
    lines: dict[str, Any] = {"wheels.scale_omega": round(wheels.scale_omega * turn.value, 4)}
    if wheels.track is not None and (turn.value > 0.0 or found.right_sides()):
        lines = {"wheels.track": round(wheels.track / size, 4)}
        lines |= found.right_sides() if turn.value < 0.0 else {}
    much = f"{size:.3f} ± {turn.sigma:.2g} times as much as by its wheels"
    if turn.value < 0.0:
        text = "By the ranges the robot turns the other way than by its wheels: left and right are exchanged"
        text += " (or, if they are not, the anchors are a mirror image)"
        if abs(math.log(size)) > _TURN_OFF:
            text += f", and {much}: their distance is wrong, too"
        found.add("wheels.sign", text, lines, turn)
    else:
        text = f"By the ranges the robot turns {much}: the distance of the wheels is wrong"
        found.add("wheels.turn", text, lines, turn)


def _long(found: Conventions, fit: RangeFit) -> None:
    """Name scale and offset of the ranges beyond what radios of one kind differ by."""
    section: Any = getattr(found.config, "uwb", None)
    if fit.scale.off(1.0, _RANGE_OFF, 4.0):
        long, sigma = 100.0 * fit.scale.value - 100.0, 100.0 * fit.scale.sigma
        text = f"Ranges are {long:+.1f} ± {sigma:.1f} % too long, by wheels and anchors"
        lines = {"uwb.scale": round(section.scale * fit.scale.value, 4)}
        found.add("uwb.scale", text, lines, fit.scale, Severity.WARNING)
    elif fit.bias_m.off(0.0, _BIAS_OFF_M, 4.0):
        text = f"Ranges are {fit.bias_m.value:+.3f} ± {fit.bias_m.sigma:.2g} m too long, by wheels and anchors"
        lines = {"uwb.bias_m": round(section.bias_m + section.scale * fit.bias_m.value, 3)}
        found.add("uwb.bias_m", text, lines, fit.bias_m, Severity.WARNING)
