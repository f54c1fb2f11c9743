"""Paths: waypoints in YAML, and the smooth curve through them.

Source: Akima 1970, "A new method of interpolation and smooth curve fitting based on local procedures"; with the
modified weights, a straight row of waypoints gives a straight line.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import Akima1DInterpolator

from fgloc.errors import ConfigError
from fgloc.files.settings import Settings
from fgloc.types import FloatArray
from fgloc_datasets.sim.section import Positive, Section, Vector2

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
        """Of the whole curve."""
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
