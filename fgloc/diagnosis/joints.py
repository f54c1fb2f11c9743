"""Wheels of a drive against each other and the gyro: counts backwards, order of the joints, wheels that stand still."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from fgloc.config import with_value
from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.landmark_fits import fit_sightings
from fgloc.diagnosis.landmarks import WORSE, as_configured
from fgloc.diagnosis.pairs import TELLS, VARIED, explained
from fgloc.diagnosis.signals import Path, in_order, turn_by
from fgloc.drives.base import Drive, Steered
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import FloatArray, IntArray, Severity

_WINDOW_S = 0.2  # over which rates are means: a steering may turn meanwhile
_MOST, _FEWEST = 400, 50  # windows
_MOVES = 0.1  # times the usual rate of the fastest wheel: in windows of less it stands
_CONTRADICTS = 0.05  # share of the squares of the wheels' speeds that no motion of the robot explains
_GROSSLY = 0.2  # such a share, of which slips are not the cause
_EXPLAINS = 0.2  # share of that which a mistake that is the cause leaves
_STILL, _STANDS = 10, 0.02  # windows in which a wheel does not turn at all, and the share of those, likewise


class _Turned(NamedTuple):
    """Windows in which wheels turn: their ends [s], and rates of the driven and angles of the steered, by joint."""

    first: FloatArray
    last: FloatArray
    joints: dict[str, FloatArray]

    def of(self, names: Sequence[str]) -> list[list[float]]:
        """A row for each window of some joints' values."""
        return np.array([self.joints[name] for name in names]).reshape(len(names), len(self.first)).T.tolist()


class _Fit(NamedTuple):
    """Squares of the wheels' speeds and of what no motion explains of them, by window; share of the turn explained."""

    squares: FloatArray
    left: FloatArray
    turn: float

    def share(self, at: IntArray | slice = slice(None)) -> float:
        """Share of the squares in some windows that no motion explains."""
        return float(self.left[at].sum() / max(self.squares[at].sum(), 1e-12))


class _Mistake(NamedTuple):
    """Code, clause of a sentence, and the lines that undo it."""

    code: str
    text: str
    lines: dict[str, Any]


def check_joints(found: Conventions, path: Path) -> Path | None:
    """Name wheels that contradict each other or the gyro's turn, by the mistake that explains it; the path without.

    None: nothing undoes it, and so much contradicts itself that the wheels tell of nothing else.
    """
    drive = found.config.wheels.drive
    turned = None if path.source != "ticks" or drive is None else _turned(found, drive, path)
    if drive is None or turned is None:
        return path
    turn = _turn(found, turned)
    given = _fit(drive, turned, turn)
    apart = given.share()
    fits: list[_Mistake] = []
    if apart > _CONTRADICTS or (turn is not None and abs(given.turn) < TELLS):
        for tier in _mistakes(drive):
            tried = [(mistake, _fit(_with(found, mistake), turned, turn)) for mistake in tier]
            least = _EXPLAINS * max(apart, _CONTRADICTS)
            fits += [one for one, fit in tried if fit.share() < least and (turn is None or fit.turn > TELLS)]
            if fits:
                break
    by = "By what the wheels say of each other" + (" and the gyro" if turn is not None else "")
    if len(fits) > 1:
        by, fits = f"{by}, and the landmarks,", _by_landmarks(found, fits) or fits
    if len(fits) == 1:
        found.add(fits[0].code, f"{by} {fits[0].text}", fits[0].lines)
        return found.read_again(path)
    still = {name: np.flatnonzero(np.array(turned.joints[name]) == 0.0) for name in drive.driven}
    still = {name: at for name, at in still.items() if len(at) >= _STILL and given.share(at) > _STANDS}
    share = f"{math.sqrt(apart):.0%} of the wheels' motion contradicts itself"
    if fits:
        found.add(fits[0].code, f"{share}: {', or '.join(one.text for one in fits)}")
    elif len(still) == 1:
        ((name, at),) = still.items()
        span = f"from {turned.first[at[0]]:.1f} to {turned.last[at[-1]]:.1f} s"
        text = f"{name} does not turn ({span}) while the other wheels show that it should"
        found.add("wheels.still", text, severity=Severity.WARNING)
    elif apart > _CONTRADICTS:
        text = f"{share}: names, places or kind of wheels.drive are wrong, or a wheel is"
        found.add("wheels.contradict", text, severity=Severity.WARNING)
    return None if apart > _GROSSLY else path


def _by_landmarks(found: Conventions, fits: Sequence[_Mistake]) -> list[_Mistake]:
    """The mistake without which landmarks stay in place by far the best; none: they do not tell."""
    seen, misfits = found.signals.sightings(), []
    for one in fits:
        path = found.path_with(one.lines)
        fit = None if path is None or seen is None else fit_sightings(path, as_configured(found, seen)[0]).get("body")
        misfits.append(math.inf if fit is None else fit.misfit)
    best, other = np.argsort(misfits)[:2].tolist()
    return [fits[best]] if misfits[best] * WORSE < misfits[other] else []


def _mistakes(drive: Drive) -> Iterator[list[_Mistake]]:
    """Mistakes that may explain what wheels say: those of a tier are as likely, the next tier less."""
    yield [_reversed(drive, name) for name in drive.driven]
    swapped = []
    for key in ("wheels", "steering_joints"):
        names: Sequence[str] = getattr(drive, key, ())
        for a, b in combinations(names, 2):
            lines = {f"wheels.drive.{key}": [{a: b, b: a}.get(name, name) for name in names]}
            swapped.append(_Mistake("wheels.order", f"{a} and {b} are exchanged", lines))
    yield swapped
    yield [_reversed(drive, *pair) for pair in combinations(drive.driven, 2)]
    if isinstance(drive, Steered) and drive.steering_ticks is None:
        ratio = float(f"{drive.steering_ratio * math.pi / 180.0:.6g}")
        yield [_Mistake("wheels.steering", "the steering is in degrees", {"wheels.drive.steering_ratio": ratio})]


def _reversed(drive: Drive, *names: str) -> _Mistake:
    text = f"{' and '.join(names)} count{'s' * (len(names) == 1)} backwards"
    return _Mistake("wheels.reversed", text, {"wheels.drive.reversed": sorted({*drive.reversed} ^ {*names})})


def _with(found: Conventions, mistake: _Mistake) -> Drive:
    config = found.config
    for key, value in mistake.lines.items():
        config = with_value(config, key, value)
    assert config.wheels.drive is not None
    return config.wheels.drive


def _fit(drive: Drive, turned: _Turned, turn: FloatArray | None) -> _Fit:
    rates = turned.of(drive.driven)
    made = [drive.moves(row, steered) for row, steered in zip(rates, turned.of(drive.steered), strict=True)]
    left = np.array([rest @ rest for _, _, rest in made])
    squares = np.sum((drive.radius * np.array(rates)) ** 2, axis=1)
    if turn is None:
        return _Fit(squares, left, 0.0)
    slope, share = explained(turn, np.array([[twist[2] for twist, _, _ in made]]))
    return _Fit(squares, left, math.copysign(float(share[0]), float(slope[0])))


def _turn(found: Conventions, turned: _Turned) -> FloatArray | None:
    """Yaw rate by the gyro in each window; None: there is none, or it hardly turns."""
    rates = found.signals.rates()
    if rates is None:
        return None
    yaw = turn_by(rates[0], rates[1] @ (found.up * found.config.gyro.scale))
    turn = (np.interp(turned.last, rates[0], yaw) - np.interp(turned.first, rates[0], yaw)) / (
        turned.last - turned.first
    )
    return turn if float(np.std(turn)) > VARIED else None


def _turned(found: Conventions, drive: Drive, path: Path) -> _Turned | None:
    """Motion of the joints while they move; None: too few messages of it."""
    names = (*drive.driven, *drive.steered)
    events = [e for e in found.signals.motion if isinstance(e, JointsEvent) and {*names} <= {*e.names}]
    rows = in_order([(e.stamp_ns, *e.of(names, "position"), *e.of(names, "velocity")) for e in events])
    if len(rows) < _FEWEST:
        return None
    times, n, k = (rows[:, 0] - found.signals.origin_ns) * 1e-9, len(drive.driven), len(names)
    angles, rates = rows[:, 1 : 1 + n], rows[:, 1 + k : 1 + k + n]
    if np.isfinite(angles).all(axis=1).mean() > 0.5:
        steps, roll = np.diff(angles, axis=0), drive.rolls_over
        if roll is not None:
            steps = np.remainder(steps + 0.5 * roll, roll) - 0.5 * roll
        steps *= 1.0 if found.config.wheels.in_radians else math.tau / (drive.ticks_per_turn or 1.0)
    else:
        steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(times)[:, None]
    gone = np.concatenate([np.zeros((1, n)), np.cumsum(np.nan_to_num(steps), axis=0)])
    first = np.arange(times[0], times[-1] - _WINDOW_S, _WINDOW_S)
    first = first[path.known(first, first + _WINDOW_S)]
    last = first + _WINDOW_S
    means = np.column_stack([np.interp(last, times, g) - np.interp(first, times, g) for g in gone.T]) / _WINDOW_S
    fastest = np.abs(means).max(axis=1, initial=0.0)
    usual = float(np.quantile(fastest, 0.9)) if len(first) else 0.0
    moving = np.flatnonzero((fastest > _MOVES * usual) & (fastest < usual / _MOVES))  # faster is a counter that jumped
    if len(moving) < _FEWEST:
        return None
    moving = moving[:: math.ceil(len(moving) / _MOST)]
    first, means = first[moving], means[moving]
    steered = rows[np.searchsorted(times, first + 0.5 * _WINDOW_S), 1 + n : 1 + k]
    if not np.isfinite(steered).all():
        return None
    told = np.array([[drive.steering(value) for value in row] for row in steered.tolist()]).reshape(len(first), k - n)
    by_name = dict(zip(names, np.column_stack([means, told]).T, strict=True))
    return _Turned(first, first + _WINDOW_S, by_name)
