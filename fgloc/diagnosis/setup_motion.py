"""Wheel motion and gyro between the images of an excerpt, as functions of what they may be off by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.diagnosis.excerpt import GRID_S, Stretch
from fgloc.sensors import registry
from fgloc.types import FloatArray, IntArray

EXTRAS = ("size", "map_scale", "radius", "track", "yaw_per_m", "late_s", "gyro_late_s", "gyro_scale", "gyro_bias")
"""Parameters beside camera and markers: logs of true over given size, map, radius and track; yaw gained per metre
[rad/m]; how late the images' stamps are against wheels and gyro [s]; the gyro's scale and bias [rad/s]."""
_WHEELS = slice(2, 6)  # what the wheels' motion depends on
_GYRO_LATE, _GYRO_SCALE, _GYRO_BIAS = 6, 7, 8
_SIZE_SIGMA = 0.005  # share: prints are exact to a millimetre in 0.2 m
_MAP_SIGMA = 1e-3  # share of all its distances
_HELD = 1e-4  # sigma of what is taken as exact
_WHEELS_FLOOR = np.array([0.001, 0.001, 0.001])  # m, m, rad: of the integration on a grid
_GYRO_FLOOR_RAD = 0.0005
_NO_GYRO_RAD = 1e9  # sigma where there is none
_NUDGE = 1e-6
_KEPT = 0.67  # share of the sightings that lay a path onto the map: the others may be of wrong markers
_FEWEST_POINTS = 4

Rows = tuple[FloatArray, FloatArray, IntArray]
"""Whitened residuals ``(m, d)``, their derivatives ``(m, d, c)`` and by which unknowns these are ``(m, c)``."""


class Motion:
    """Of all stretches."""

    def __init__(self, stretches: Sequence[Stretch], turned: FloatArray, config: Config) -> None:
        """Prepare.

        Args:
            stretches: of the excerpt.
            turned: ``(3, 3)`` applied to the wheels' twist.
            config: noise of wheels and gyro.
        """
        self._stretches, self._turned_by = stretches, turned
        self._noise = registry.odometer().errors(config).noise
        self._gyro_noise = registry.rate_sensor().errors(config).yaw_per_sqrt_s
        lengths = [len(s.times) for s in stretches]
        self.stretch_of = np.repeat(np.arange(len(stretches)), lengths)
        self.pairs: IntArray = np.flatnonzero(np.diff(self.stretch_of) == 0)

    def rows(self, poses: FloatArray, extras: FloatArray, first: int) -> list[Rows]:
        """Residuals of wheels and gyro between the poses ``(n, 3)`` of the images.

        Args:
            poses: right perturbations of them are unknowns 0 to 3 n.
            extras: ``(9,)`` values of `EXTRAS`.
            first: number of the first of these among the unknowns.
        """
        i = self.pairs
        a, c = poses[i], poses[i + 1]
        cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
        dx, dy = c[:, 0] - a[:, 0], c[:, 1] - a[:, 1]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        turn = se2.wrap_array(c[:, 2] - a[:, 2])
        rows: list[Rows] = []
        went, sigmas, seconds = self.between(extras)
        r = np.column_stack([x, y, turn]) - went
        r[:, 2] = se2.wrap_array(r[:, 2])
        J = np.zeros((len(i), 3, 10))
        J[:, 0, 0] = J[:, 1, 1] = J[:, 2, 2] = -1.0
        J[:, 0, 2], J[:, 1, 2] = y, -x
        ct, st = np.cos(turn), np.sin(turn)
        J[:, 0, 3], J[:, 0, 4], J[:, 1, 3], J[:, 1, 4], J[:, 2, 5] = ct, -st, st, ct, 1.0
        for k in range(4):
            nudged = extras.copy()
            nudged[_WHEELS.start + k] += _NUDGE
            J[:, :, 6 + k] = -(self.between(nudged)[0] - went) / _NUDGE
        ends = np.concatenate([3 * i[:, None] + np.arange(3), 3 * (i + 1)[:, None] + np.arange(3)], axis=1)
        wheels = np.broadcast_to(first + np.arange(_WHEELS.start, _WHEELS.stop), (len(i), 4))
        rows.append((r / sigmas, J / sigmas[:, :, None], np.concatenate([ends, wheels], axis=1)))
        turned, by_late, has = self._by_gyro(extras[_GYRO_LATE])
        sigma = np.hypot(self._gyro_noise * np.sqrt(seconds), _GYRO_FLOOR_RAD)
        sigma = np.where(has, sigma, _NO_GYRO_RAD)
        scale = 1.0 + extras[_GYRO_SCALE]
        r = se2.wrap_array(turn - scale * turned + extras[_GYRO_BIAS] * seconds)
        J = np.zeros((len(i), 1, 5))
        J[:, 0, 0], J[:, 0, 1], J[:, 0, 2], J[:, 0, 3], J[:, 0, 4] = -1.0, 1.0, -scale * by_late, -turned, seconds
        ends = np.column_stack([3 * i + 2, 3 * i + 5])
        gyro = np.broadcast_to(first + np.array([_GYRO_LATE, _GYRO_SCALE, _GYRO_BIAS]), (len(i), 3))
        rows.append(((r / sigma)[:, None], J / sigma[:, None, None], np.concatenate([ends, gyro], axis=1)))
        return rows

    def between(self, extras: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Wheel motion ``(k, 3)`` between images, its sigmas, and the time between them [s]."""
        radius, track, pull, late = extras[_WHEELS]
        noise = self._noise
        motions, sigmas, spans = [], [], []
        for s in self._stretches:
            steps = s.wheels @ self._turned_by.T
            forward = np.exp(radius) * steps[:, :2]
            turns = np.exp(radius - track) * steps[:, 2] + pull * forward[:, 0]
            at = s.times - late
            x, y, yaw = (_at(at, v) for v in _path(forward, turns))
            c, d = np.cos(yaw[:-1]), np.sin(yaw[:-1])
            ax, ay, turn = np.diff(x), np.diff(y), np.diff(yaw)
            motions.append(np.column_stack([c * ax + d * ay, c * ay - d * ax, turn]))
            dt = np.diff(s.times)
            way = np.diff(_at(at, _summed(np.hypot(forward[:, 0], forward[:, 1]))))
            bend = np.diff(_at(at, _summed(np.abs(turns))))
            q = np.column_stack(
                [
                    noise.x_per_sqrt_m**2 * way + noise.xy_per_sqrt_rad**2 * bend + noise.xy_per_sqrt_s**2 * dt,
                    noise.y_per_sqrt_m**2 * way + noise.xy_per_sqrt_rad**2 * bend + noise.xy_per_sqrt_s**2 * dt,
                    noise.yaw_per_sqrt_m**2 * way + noise.yaw_per_sqrt_rad**2 * bend + noise.yaw_per_sqrt_s**2 * dt,
                ]
            )
            sigmas.append(np.sqrt(q + _WHEELS_FLOOR**2))
            spans.append(dt)
        return np.concatenate(motions), np.concatenate(sigmas), np.concatenate(spans)

    def path(self, k: int, extras: FloatArray) -> FloatArray:
        """Poses ``(n, 3)`` of the images of a stretch by the wheels, from its first grid point."""
        radius, track, _, late = extras[_WHEELS]
        s = self._stretches[k]
        steps = s.wheels @ self._turned_by.T
        x, y, yaw = _path(np.exp(radius) * steps[:, :2], np.exp(radius - track) * steps[:, 2])
        return np.column_stack([_at(s.times - late, v) for v in (x, y, yaw)])

    def _by_gyro(self, late: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotation by the gyro between images ``(k,)``, its derivative by the lateness, and where there is any."""
        turned, slope, has = [], [], []
        for s in self._stretches:
            k = len(s.times) - 1
            if s.gyro is None:
                turned.append(np.zeros(k))
                slope.append(np.zeros(k))
            else:
                angles, at = _summed(s.gyro), s.times - late
                turned.append(np.diff(_at(at, angles)))
                slope.append(-np.diff(_at(at, np.append(s.gyro, s.gyro[-1]) / GRID_S)))
            has.append(np.full(k, s.gyro is not None))
        return np.concatenate(turned), np.concatenate(slope), np.concatenate(has)


def extra_sigmas(config: Config, has_gyro: bool) -> dict[str, float]:
    """Prior sigmas of `EXTRAS` in an ordinary installation; what can be no unknown is held."""
    wheels, camera = registry.odometer().errors(config), config.camera
    gyro = registry.rate_sensor().errors(config)
    late = float(np.hypot(camera.time_offset_sigma_s, wheels.time_offset_sigma_s))
    sigmas = (
        _SIZE_SIGMA,
        _MAP_SIGMA,
        max(wheels.scale_sigma, _HELD),
        max(wheels.turn_scale_sigma, _HELD),
        max(wheels.yaw_per_m_sigma, _HELD),
        late,
        camera.time_offset_sigma_s,
        gyro.scale_sigma if has_gyro else _HELD,
        gyro.bias_sigma if has_gyro else _HELD,
    )
    return dict(zip(EXTRAS, sigmas, strict=True))


def laid(path: FloatArray, seen: FloatArray, places: FloatArray) -> FloatArray | None:
    """Pose ``(3,)`` of a path's start that brings what was seen from it onto the map; without the worst third."""
    points = se2.placed(path, seen)
    weights = 1.0 / np.maximum((seen**2).sum(axis=1), 0.01)
    place: FloatArray | None = None
    for _ in range(3):
        if len(points) < _FEWEST_POINTS:
            return None
        place = se2.rigid_if_spread(points, places, weights)
        if place is None:
            return None
        off = se2.placed(place, points) - places
        distance = np.hypot(off[:, 0], off[:, 1])
        near = distance <= max(float(np.quantile(distance, _KEPT)), 0.05)
        points, places, weights = points[near], places[near], weights[near]
    return place


def _summed(steps: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(steps)])


def _path(forward: FloatArray, turns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses at the grid points from steps ``(g, 2)`` [m] and ``(g,)`` [rad]: x, y, yaw ``(g + 1,)``."""
    yaw = _summed(turns)
    middle = yaw[:-1] + 0.5 * turns
    c, s = np.cos(middle), np.sin(middle)
    x = _summed(c * forward[:, 0] - s * forward[:, 1])
    return x, _summed(s * forward[:, 0] + c * forward[:, 1]), yaw


def _at(times: FloatArray, values: FloatArray) -> FloatArray:
    """Values of the grid points at some times [s]."""
    return np.asarray(np.interp(times, np.arange(len(values)) * GRID_S, values))
