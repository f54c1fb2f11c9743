"""Which joints are the wheels of a robot, and their geometry, from what its own driver made of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import FloatArray

_LEFT = re.compile(r"(?<![a-z])(left|l)(?![a-z])", re.IGNORECASE)
_RIGHT = re.compile(r"(?<![a-z])(right|r)(?![a-z])", re.IGNORECASE)
_FEWEST = 50  # messages of each, for a fit
_FITS = 0.98  # share of the odometry's variance that the wheels must explain
_LEAST_TURNING = 0.05  # rad/s: standard deviation of the yaw rate below which the track does not show


@dataclass(frozen=True, slots=True)
class WheelPair:
    """Two joints."""

    left: str
    right: str


@dataclass(frozen=True, slots=True)
class WheelGeometry:
    """Nominal values [m], as the odometry's driver has them."""

    radius_m: float
    track_m: float


def wheel_pair(names: Sequence[str]) -> WheelPair | None:
    """The joints that are the left and right wheel by their names; None if that is not clear."""
    words = {name: name.replace("_", " ").replace("-", " ") for name in names}
    wheels = [name for name in names if "wheel" in name.lower()] or list(names)
    left = [name for name in wheels if _LEFT.search(words[name]) and not _RIGHT.search(words[name])]
    right = [name for name in wheels if _RIGHT.search(words[name]) and not _LEFT.search(words[name])]
    return WheelPair(left[0], right[0]) if len(left) == len(right) == 1 else None


def fit_geometry(
    pair: WheelPair, joints: Sequence[JointsEvent], odometry: Sequence[OdometryEvent]
) -> WheelGeometry | None:
    """Radius and track with which the wheels' angles give the odometry's twist; None if they do not explain it.

    Args:
        pair: which joints.
        joints: in the order of their stamps.
        odometry: of the same drive, likewise.
    """
    angles = np.array([_angles(event, pair) for event in joints])
    stamps = np.array([event.stamp_ns for event in joints], dtype=np.int64)
    keep = np.flatnonzero(np.diff(stamps, prepend=-1) > 0)
    if len(keep) < _FEWEST or len(odometry) < _FEWEST or not np.isfinite(angles[keep]).all():
        return None
    seconds = (stamps[keep] - stamps[keep[0]]) * 1e-9
    rates = np.diff(angles[keep], axis=0) / np.diff(seconds)[:, None]
    middles = 0.5 * (seconds[1:] + seconds[:-1])
    at = np.array([(event.stamp_ns - stamps[keep[0]]) * 1e-9 for event in odometry])
    twists = np.array([[event.linear[0], event.angular[2]] for event in odometry])
    order = np.argsort(at, kind="stable")
    told = np.stack([np.interp(middles, at[order], twists[order, k]) for k in range(2)], axis=1)
    radius = _slope(rates.mean(axis=1), told[:, 0])
    per_difference = _slope(rates[:, 1] - rates[:, 0], told[:, 1])
    if radius is None or per_difference is None or told[:, 1].std() < _LEAST_TURNING:
        return None
    return WheelGeometry(radius, radius / per_difference)


def _angles(event: JointsEvent, pair: WheelPair) -> tuple[float, float]:
    def of(name: str) -> float:
        i = event.names.index(name) if name in event.names else -1
        return float(event.position[i]) if 0 <= i < len(event.position) else float("nan")

    return of(pair.left), of(pair.right)


def _slope(x: FloatArray, y: FloatArray) -> float | None:
    """Least squares without offset; None if it is not positive or leaves too much."""
    power = float(x @ x)
    if power <= 0.0 or float(y @ y) <= 0.0:
        return None
    slope = float(x @ y) / power
    left = float(((y - slope * x) ** 2).sum() / (y @ y))
    return slope if slope > 0.0 and left < 1.0 - _FITS else None
