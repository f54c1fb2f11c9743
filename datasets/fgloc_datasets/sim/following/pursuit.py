"""Paths of waypoints, and a follower: a pose goes in, forward speed and yaw rate come out.

Source: Macenski, Singh, Martin, Ginés 2023, "Regulated pure pursuit for robot path tracking", Autonomous Robots 47:
the look-ahead grows with the speed, the speed falls with the curvature and towards the goal, and the robot turns on
the spot where the path leads behind it. Two things differ: the curvature is that of the path between the robot and
the look-ahead point, which is known before the robot is there; and instead of obstacles it is the pose's uncertainty
that slows the robot down. Two things are added: a robot that does not know its place well turns round once before it
drives, so that the camera sees markers on all sides; and the yaw rate is regulated, because tyres stick: without
that a robot that is told to turn slowly turns a second late, and swings about the path by a centimetre.

The curve through the waypoints is Akima's (1970, "A new method of interpolation and smooth curve fitting based on
local procedures"); with the modified weights, a straight row of waypoints gives a straight line.
"""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import Akima1DInterpolator

from fgloc.errors import ConfigError
from fgloc.files.settings import Settings
from fgloc.types import FloatArray
from fgloc_datasets.sim.control import Wanted
from fgloc_datasets.sim.scenario import Positive, Section, Vector2

# --- Paths ------------------------------------------------------------------------------------------------------------

BUNDLED = Path(__file__).parent.parent / "paths"
_STEP_M = 0.01  # between the points of the curve
_FEWEST_FOR_A_CURVE = 3


class WaypointPath(Section):
    """Waypoints to be passed in order, from the first, where the robot starts, to the last, where it stops."""

    name: str = Field(pattern=r"^[a-z0-9_]+$")
    description: str = ""
    speed_m_s: Positive = 0.3  # where the path is straight
    waypoints: tuple[Vector2, ...] = Field(min_length=2)  # m in the map

    @model_validator(mode="after")
    def _points_differ(self) -> WaypointPath:
        for i, (a, b) in enumerate(zip(self.waypoints[:-1], self.waypoints[1:], strict=True)):
            if math.dist(a, b) < _STEP_M:
                raise ValueError(
                    f"waypoints {i} and {i + 1} are both at {a}; expected {_STEP_M} m between them at least"
                )
        return self

    @property
    def start(self) -> tuple[float, float, float]:
        """Pose x, y [m], yaw [rad] at the first waypoint, along the curve."""
        curve = Curve(self)
        (x, y), (dx, dy) = curve.points[0], curve.points[1] - curve.points[0]
        return float(x), float(y), math.atan2(dy, dx)


class Curve:
    """The curve through the waypoints, in steps of a centimetre.

    Attributes:
        points: ``(n, 2)`` [m].
        along_m: ``(n,)`` distance from the start along the curve.
        at_waypoints: ``(m,)`` row of each waypoint.
    """

    def __init__(self, path: WaypointPath) -> None:
        """Interpolate between the waypoints by the distance between them."""
        given = np.array(path.waypoints)
        knots = np.concatenate([[0.0], np.hypot(*np.diff(given, axis=0).T).cumsum()])
        counts = [int(gap / _STEP_M) + 1 for gap in np.diff(knots)]
        pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots, knots[1:], counts, strict=False)]
        at = np.concatenate([*pieces, knots[-1:]])
        if len(given) < _FEWEST_FOR_A_CURVE:
            self.points = np.column_stack([np.interp(at, knots, given[:, k]) for k in range(2)])
        else:
            self.points = np.asarray(Akima1DInterpolator(knots, given, method="makima")(at))
        self.at_waypoints = np.cumsum([0, *counts])
        self.along_m = np.concatenate([[0.0], np.hypot(*np.diff(self.points, axis=0).T).cumsum()])

    @property
    def length_m(self) -> float:
        """Length of the curve [m]."""
        return float(self.along_m[-1])

    def distances(self, places: FloatArray) -> FloatArray:
        """Distance ``(n,)`` [m] of places ``(n, 2)`` from the curve."""
        a, b = self.points[:-1], self.points[1:]
        edge = b - a
        share = np.einsum("nmi,mi->nm", places[:, None] - a, edge) / (edge**2).sum(axis=1)
        nearest = a + np.clip(share, 0.0, 1.0)[..., None] * edge
        return np.asarray(np.linalg.norm(places[:, None] - nearest, axis=2).min(axis=1))


def load_path(what: str) -> WaypointPath:
    """A bundled path by name, or a YAML file with the keys of `WaypointPath`.

    Raises:
        ConfigError: there is no such path or file, or a value is wrong; all are named.
    """
    path = Path(what)
    if path.suffix not in (".yaml", ".yml"):
        path = BUNDLED / f"{what}.yaml"
        if not path.is_file():
            names = ", ".join(sorted(p.stem for p in BUNDLED.glob("*.yaml")))
            raise ConfigError(f"path '{what}' is not known; there are {names}; or give a YAML file")
    return Settings(path, "give a path by name, or a YAML file with waypoints").validated(WaypointPath)


# --- Pursuit ----------------------------------------------------------------------------------------------------------


class State(StrEnum):
    """State of the follower."""

    FOLLOWING = "following"
    SLOWED = "slowed"  # the pose is uncertain
    STOPPED = "stopped"  # no pose, or one that is too uncertain to drive by
    LOOKING = "looking"  # turns round once before it drives
    SEARCHING = "searching"  # turns on the spot: the camera may see a marker
    ARRIVED = "arrived"


class PursuitSettings(Section):
    """How the path is followed."""

    lookahead_s: Positive = 0.6  # the look-ahead point is so far ahead at the present speed ...
    lookahead_m: tuple[Positive, Positive] = (0.10, 0.35)  # ... within these bounds
    curvature_radius_m: Positive = 0.25  # the speed falls in proportion where the path turns more sharply
    approach_m: Positive = 0.30  # the speed falls in proportion towards the end
    least_speed_m_s: Positive = 0.08
    turn_on_spot_rad: Positive = 1.2  # the look-ahead point is so far off the robot's heading
    max_omega: Positive = 1.5  # rad/s
    rate_gain: float = Field(0.5, ge=0, lt=1)  # of the yaw rate that is lacking: tyres stick; 1: a quick robot swings
    arrived_m: Positive = 0.02
    slow_sigma_m: Positive = 0.15  # standard deviation of the position from which on the robot drives more slowly
    stop_sigma_m: Positive = 0.40  # and from which on it stands: a path of waypoints 0.3 m apart is lost
    search_after_s: float = Field(3.0, ge=0)  # so long stopped, the robot turns to look for markers ...
    search_omega: float = Field(0.4, ge=0)  # rad/s, ... so slowly that images are sharp
    look_sigma_m: float = Field(0.01, ge=0)  # a robot that knows its place less well turns round once before it drives
    look_omega: Positive = 0.8  # rad/s


class Pursuit:
    """Follows one path, once.

    Attributes:
        state: what it does.
        progress: row of the curve that the robot is nearest to.
    """

    def __init__(self, curve: Curve, speed_m_s: float, settings: PursuitSettings | None = None) -> None:
        """Begin at the path's start."""
        self.state = State.STOPPED
        self.progress = 0
        self._curve, self._speed = curve, speed_m_s
        self._settings = settings or PursuitSettings()
        self._v = 0.0
        self._stopped_since_s: float | None = None
        self._looked_rad: float | None = None  # how far it has turned round; None: before the first pose
        self._last: tuple[float, float] | None = None  # time and yaw of the last command
        self._curvature = _curvature(curve)

    def command(self, t: float, pose: FloatArray | None, position_sigma_m: float = 0.0) -> Wanted:
        """Forward speed [m/s] and yaw rate [rad/s].

        Args:
            t: time [s], ascending.
            pose: ``(3,)`` x, y [m], yaw [rad] in the map; None: it is not known.
            position_sigma_m: its standard deviation, in the worst direction.
        """
        if self.state is State.ARRIVED:
            return 0.0, 0.0
        s = self._settings
        trust = min(max((s.stop_sigma_m - position_sigma_m) / (s.stop_sigma_m - s.slow_sigma_m), 0.0), 1.0)
        if pose is None or trust == 0.0:
            return self._stand(t)
        self._stopped_since_s = None
        seconds, turned = self._since_last(t, float(pose[2]))
        left_rad = self._left_to_look(turned, position_sigma_m)
        if left_rad > _LOOKED_RAD:
            self.state = State.LOOKING
            return 0.0, min(s.look_omega, _APPROACH_PER_S * left_rad)
        self.state = State.FOLLOWING if trust == 1.0 else State.SLOWED
        self.progress = self._nearest(pose)
        left_m = self._curve.length_m - float(self._curve.along_m[self.progress])
        if left_m < s.arrived_m:
            self.state, self._v = State.ARRIVED, 0.0
            return 0.0, 0.0
        v, omega = self._pursue(pose, left_m, trust)
        if v > 0.0:
            omega += s.rate_gain * (omega - turned / seconds)
        return v, math.copysign(min(abs(omega), s.max_omega), omega)

    def _since_last(self, t: float, yaw: float) -> tuple[float, float]:
        """Time [s] since the last command, and the turn of the robot in it [rad]."""
        before, self._last = self._last or (t, yaw), (t, yaw)
        return max(t - before[0], 1e-3), math.remainder(yaw - before[1], math.tau)

    def _left_to_look(self, turned: float, position_sigma_m: float) -> float:
        """Turn [rad] that is left of the one look round at the start, which only a robot unsure of its place makes."""
        if self._looked_rad is None:
            self._looked_rad = 0.0 if position_sigma_m > self._settings.look_sigma_m else math.tau
        elif self._looked_rad < math.tau - _LOOKED_RAD:
            self._looked_rad += turned
        return math.tau - self._looked_rad

    def _pursue(self, pose: FloatArray, left_m: float, trust: float) -> Wanted:
        s = self._settings
        reach = min(max(s.lookahead_s * self._v, s.lookahead_m[0]), s.lookahead_m[1])
        ahead = self._ahead(pose, reach)
        dx, dy = self._curve.points[ahead] - pose[:2]
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        forward, left = cos * dx + sin * dy, -sin * dx + cos * dy
        off = math.atan2(left, forward)
        if abs(off) > s.turn_on_spot_rad:
            self._v = 0.0
            return 0.0, math.copysign(min(s.max_omega, _APPROACH_PER_S * abs(off)), off)
        curvature = 2.0 * left / max(forward**2 + left**2, s.lookahead_m[0] ** 2)
        sharpest = float(self._curvature[self.progress : ahead + 1].max())
        speed = self._speed * min(1.0, 1.0 / (sharpest * s.curvature_radius_m), left_m / s.approach_m) * trust
        self._v = min(max(speed, min(s.least_speed_m_s, self._speed)), s.max_omega / max(abs(curvature), 1e-9))
        return self._v, self._v * curvature

    def _stand(self, t: float) -> Wanted:
        self._v = 0.0
        self._stopped_since_s = t if self._stopped_since_s is None else self._stopped_since_s
        if t - self._stopped_since_s < self._settings.search_after_s:
            self.state = State.STOPPED
            return 0.0, 0.0
        self.state = State.SEARCHING
        return 0.0, self._settings.search_omega

    def _nearest(self, pose: FloatArray) -> int:
        """Index of the nearest point of the curve, not before the last one and within the next 0.3 m.

        So the robot stays on its branch where the path crosses itself.
        """
        along = self._curve.along_m
        last = int(np.searchsorted(along, along[self.progress] + _SEARCHED_M))
        part = self._curve.points[self.progress : last + 1]
        return self.progress + int(np.argmin(np.hypot(*(part - pose[:2]).T)))

    def _ahead(self, pose: FloatArray, reach: float) -> int:
        """Index of the first point of the curve from here on that is at least so far from the robot [m]."""
        far = np.hypot(*(self._curve.points[self.progress :] - pose[:2]).T) >= reach
        return self.progress + int(np.argmax(far)) if far.any() else len(self._curve.points) - 1


_SEARCHED_M = 0.3
_APPROACH_PER_S = 2.0  # yaw rate on the spot over what is left to be turned
_LOOKED_RAD = 0.03  # short of a whole turn: it is over
_SMOOTHED_M = 0.05  # to each side: curvature of the curve, not of its corners


def _curvature(curve: Curve) -> FloatArray:
    """Curvature ``(n,)`` [1/m] by the turn of the chords to both sides, at least a little so that 1 / it is finite."""
    n = len(curve.points)
    k = max(1, round(_SMOOTHED_M / (curve.length_m / n)))
    i = np.arange(n)
    before, after = curve.points[np.maximum(i - k, 0)], curve.points[np.minimum(i + k, n - 1)]
    a, b = curve.points - before, after - curve.points
    turn = np.abs(np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1)))
    length = 0.5 * (np.hypot(*a.T) + np.hypot(*b.T))
    turn[[0, -1]] = 0.0
    return np.asarray(np.maximum(turn / np.maximum(length, 1e-6), 1e-6))
