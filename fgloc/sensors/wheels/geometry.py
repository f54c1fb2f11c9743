"""Which joints are the wheels of a robot, and their geometry, from what its own driver made of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, Event, FloatArray

_LEFT = re.compile(r"(?<![a-z])(left|l)(?![a-z])", re.IGNORECASE)
_RIGHT = re.compile(r"(?<![a-z])(right|r)(?![a-z])", re.IGNORECASE)
_FEWEST = 50  # messages of each, for a fit
_FITS = 0.98  # share of the odometry's variance that the wheels must explain
_CAUCHY, _ITERATIONS = 3.5, 5  # median absolute deviations beyond which a residual counts less: 95 % efficiency
_LEAST_TURNING = 0.05  # rad/s: standard deviation of the yaw rate below which the track does not show
NAMED_BY = 100  # messages whose joints are looked at: arm and wheels may take turns on a topic
_WINDOW_S = 0.3  # over which rates are means: stamps of single messages jitter
_STEADY_S = 1.0  # after a command: by then the wheels turn as they are told
_ALIKE = 0.05  # relative spread of the track that commands give at different times


@dataclass(frozen=True, slots=True)
class WheelPair:
    """Two joints."""

    left: str
    right: str


@dataclass(frozen=True, slots=True)
class WheelGeometry:
    """Nominal values [m], as the robot's driver has them.

    Attributes:
        radius_m: of both wheels.
        track_m: between them.
        by_commands: the track is that of the commands: the odometry's turn is not the wheels'.
    """

    radius_m: float
    track_m: float
    by_commands: bool = False


def wheel_pair(names: Sequence[str]) -> WheelPair | None:
    """The joints that are the left and right wheel by their names; None if that is not clear."""
    words = {name: name.replace("_", " ").replace("-", " ") for name in names}
    wheels = [name for name in names if "wheel" in name.lower()] or list(names)
    left = [name for name in wheels if _LEFT.search(words[name]) and not _RIGHT.search(words[name])]
    right = [name for name in wheels if _RIGHT.search(words[name]) and not _LEFT.search(words[name])]
    return WheelPair(left[0], right[0]) if len(left) == len(right) == 1 else None


def fit_geometry(
    pair: WheelPair,
    joints: Sequence[JointsEvent],
    odometry: Sequence[OdometryEvent],
    commands: Sequence[ControlEvent] = (),
) -> WheelGeometry | None:
    """Radius and track with which the wheels' angles give the driver's speeds; None if they do not explain them.

    The odometry gives the radius, and the track unless its turn is another sensor's; then the commands give it.

    Args:
        pair: which joints.
        joints: in the order of their stamps.
        odometry: of the same drive, likewise.
        commands: likewise.
    """
    angles = np.array([_angles(event, pair) for event in joints])
    stamps = np.array([event.stamp_ns for event in joints], dtype=np.int64)
    keep = np.flatnonzero(np.diff(stamps, prepend=-1) > 0)
    if len(keep) < _FEWEST or len(odometry) < _FEWEST or not np.isfinite(angles[keep]).all():
        return None
    seconds, angles = (stamps[keep] - stamps[keep[0]]) * 1e-9, angles[keep]
    at = np.array([(event.stamp_ns - stamps[keep[0]]) * 1e-9 for event in odometry])
    twists = np.array([[event.linear[0], event.angular[2]] for event in odometry])
    at, twists = at[known := np.isfinite(twists).all(axis=1)], twists[known]  # the gate refuses some
    if len(at) < _FEWEST:
        return None
    order = np.argsort(at, kind="stable")
    told = np.stack([np.interp(seconds, at[order], twists[order, k]) for k in range(2)], axis=1)
    gone = np.cumsum(0.5 * (told[1:] + told[:-1]) * np.diff(seconds)[:, None], axis=0)
    gone = np.concatenate([np.zeros((1, 2)), gone])
    later = np.minimum(np.searchsorted(seconds, seconds + _WINDOW_S), len(seconds) - 1)
    lasted = seconds[later] - seconds
    heard = np.searchsorted(at[order], seconds[later], side="right") - np.searchsorted(at[order], seconds)
    whole = (lasted > 0.5 * _WINDOW_S) & (lasted < 2.0 * _WINDOW_S) & (heard > 1)  # no silence in it
    if whole.sum() < _FEWEST:
        return None
    rates, means = (((x[later] - x)[whole] / lasted[whole, None]) for x in (angles, gone))
    difference, seconds = rates[:, 1] - rates[:, 0], seconds[whole]
    radius = _slope(rates.mean(axis=1), means[:, 0])
    per_difference = _slope(difference, means[:, 1]) if told[:, 1].std() > _LEAST_TURNING else None
    by_commands = per_difference is None
    if per_difference is None:
        per_difference = _commanded(seconds + stamps[keep[0]] * 1e-9, difference, commands)
    if radius is None or per_difference is None:
        return None
    return WheelGeometry(radius, radius / per_difference, by_commands)


def _commanded(times: FloatArray, difference: FloatArray, commands: Sequence[ControlEvent]) -> float | None:
    """Commanded yaw rate over the difference of the wheels' rates while a command holds; None: it is not constant."""
    if len(commands) < 2:
        return None
    at = np.array([event.stamp_ns * 1e-9 for event in commands])
    omega = np.array([event.omega for event in commands])
    since = at[np.append(True, np.diff(omega) != 0.0)]
    last = np.searchsorted(at, times, side="right") - 1
    held = times - since[np.maximum(np.searchsorted(since, times, side="right") - 1, 0)]
    turning = (last >= 0) & (held > _STEADY_S) & (times < at[np.maximum(last, 0)] + _STEADY_S)
    turning &= (np.abs(omega[np.maximum(last, 0)]) > _LEAST_TURNING) & (difference != 0.0)
    if turning.sum() < _FEWEST:
        return None
    ratios = omega[last[turning]] / difference[turning]
    ratio = float(np.median(ratios))
    return ratio if ratio > 0.0 and np.median(np.abs(ratios - ratio)) < _ALIKE * ratio else None


def settings_of(events: Sequence[Event]) -> dict[str, Any] | None:
    """Keys of the section `wheels` with which the angles of the wheels are used; None: they are not determined."""
    joints = [event for event in events if isinstance(event, JointsEvent)]
    names = tuple(dict.fromkeys(name for event in joints[:NAMED_BY] for name in event.names))
    pair = wheel_pair(names)
    odometry = [event for event in events if isinstance(event, OdometryEvent)]
    found = (
        None
        if pair is None
        else fit_geometry(pair, joints, odometry, [e for e in events if isinstance(e, ControlEvent)])
    )
    if pair is None or found is None:
        return None
    radius = float(f"{found.radius_m:.4g}")
    return {
        "source": "ticks",
        "left_joint": pair.left,
        "right_joint": pair.right,
        "left_radius": radius,
        "right_radius": radius,
        "track": float(f"{found.track_m:.4g}"),
    }


def _angles(event: JointsEvent, pair: WheelPair) -> tuple[float, float]:
    def of(name: str) -> float:
        i = event.names.index(name) if name in event.names else -1
        return float(event.position[i]) if 0 <= i < len(event.position) else float("nan")

    return of(pair.left), of(pair.right)


def _slope(x: FloatArray, y: FloatArray) -> float | None:
    """Robust regression without offset; None if it is not positive or leaves too much of the squares.

    Messages that came late are outliers, and shorten the slope of least squares.
    """
    power = float(x @ x)
    if power <= 0.0 or float(y @ y) <= 0.0:
        return None
    slope = float(x @ y) / power
    left = float(((y - slope * x) ** 2).sum() / (y @ y))
    for _ in range(_ITERATIONS):
        residual = np.abs(y - slope * x)
        moving = np.abs(x) > 0.1 * np.abs(x).max()
        weights = 1.0 / (1.0 + (residual / (_CAUCHY * float(np.median(residual[moving])) + 1e-9)) ** 2)
        slope = float((weights * x) @ y) / float((weights * x) @ x)
    return slope if slope > 0.0 and left < 1.0 - _FITS else None
