"""Body twist as a function of time, integrated exactly with its noise."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator

import numpy as np

from fgloc.se2 import wrap
from fgloc.sensors.noise_density import NoiseDensity
from fgloc.types import FloatArray

Twist = tuple[float, float, float]  # vx, vy [m/s], yaw rate [rad/s] in the body frame

_KEEP_NS = 30_000_000_000  # late sightings reach back no further
_TRIM_EVERY = 256
_MAX_TURN = 1.0  # rad: longer arcs are cut, so that the quadrature of the noise stays exact to 1e-6
_SHORT_TURN = 0.1  # rad: below it two nodes do
_TWO_NODES = ((0.5 - 0.5 / math.sqrt(3.0), 0.5), (0.5 + 0.5 / math.sqrt(3.0), 0.5))  # Gauss-Legendre on [0, 1]
_THREE_NODES = tuple((0.5 + 0.5 * s * math.sqrt(0.6), w / 18.0) for s, w in ((-1.0, 5.0), (0.0, 8.0), (1.0, 5.0)))
_UNMEASURED_SPEED = 0.5  # m/s and rad/s that a robot without messages is taken to be capable of at least ...
_SILENT_TAU_S = 2.0  # ... changing its mind after this time
_STEADY_NS = 20_000_000  # a speed over less time may be a jitter of stamps
_FLOOR = 1e-12  # keeps a covariance without any noise positive definite


def _silent_spread(seconds: float) -> float:
    """Variance of the displacement after this long at a random velocity of unit variance: ``seconds²`` at first."""
    return 2.0 * _SILENT_TAU_S * (seconds + _SILENT_TAU_S * math.expm1(-seconds / _SILENT_TAU_S))


class TwistTimeline:
    """Piecewise constant body twist, contiguous from its first stamp on; pieces may be unknown.

    After the last piece its ``tail`` holds for a while; then nothing is known.
    """

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._pieces: list[Twist | None] = []  # None: unknown
        self._end = 0
        self._tail: Twist = (0.0, 0.0, 0.0)
        self._tail_end = 0
        self._fastest = _UNMEASURED_SPEED
        self._fastest_turn = _UNMEASURED_SPEED

    @property
    def start_ns(self) -> int | None:
        """When the timeline begins; None if it holds nothing."""
        return self._starts[0] if self._starts else None

    def begin(self, stamp_ns: int) -> None:
        """Forget all and start here."""
        self._starts.clear()
        self._pieces.clear()
        self._starts.append(stamp_ns)
        self._pieces.append(None)
        self._end = self._tail_end = stamp_ns

    def extend(self, end_ns: int, twist: Twist | None) -> None:
        """Add a piece from the last one's end to ``end_ns``; None: the twist is not known."""
        if end_ns <= self._end:
            return
        if twist != self._pieces[-1]:
            self._starts.append(self._end)
            self._pieces.append(twist)
        long = end_ns - self._end >= _STEADY_NS
        self._end = self._tail_end = end_ns
        if twist is not None and long:
            self._fastest = max(self._fastest, math.hypot(twist[0], twist[1]))
            self._fastest_turn = max(self._fastest_turn, abs(twist[2]))
        if len(self._starts) % _TRIM_EVERY == 0:
            old = bisect_right(self._starts, end_ns - _KEEP_NS) - 1
            if old > 0:
                del self._starts[:old]
                del self._pieces[:old]

    def hold(self, twist: Twist, end_ns: int) -> None:
        """What is taken to hold beyond the last piece, until ``end_ns``."""
        self._tail = twist
        self._tail_end = max(end_ns, self._end)

    def integrate(self, start_ns: int, end_ns: int, noise: NoiseDensity) -> tuple[FloatArray, FloatArray, float]:
        """Motion between two times, ``start_ns <= end_ns``.

        The covariance is that of a Wiener process along the exact path (xx along the body's x axis, yy across), so
        that it does not depend on how the time is cut. Where the twist is unknown the robot is taken to stand, with the
        spread of a velocity as large as the largest yet seen that changes within 2 s.

        Returns:
            ``T_start_end`` ``(3,)``, its right-perturbation covariance ``(3, 3)``, and the time without knowledge [s].
        """
        x = y = yaw = 0.0
        p = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        unknown = 0.0
        x2m, y2m, t2m = noise.x_per_sqrt_m**2, noise.y_per_sqrt_m**2, noise.yaw_per_sqrt_m**2
        xy2r, t2r = noise.xy_per_sqrt_rad**2, noise.yaw_per_sqrt_rad**2
        xy2s, t2s = noise.xy_per_sqrt_s**2, noise.yaw_per_sqrt_s**2
        for from_ns, to_ns, twist, origin_ns in self._between(start_ns, end_ns):
            seconds = (to_ns - from_ns) * 1e-9
            if twist is None:
                before, after = (from_ns - origin_ns) * 1e-9, (to_ns - origin_ns) * 1e-9
                spread = _silent_spread(after) - _silent_spread(before)
                xy = self._fastest**2 * spread + xy2s * seconds
                p = (p[0] + xy, p[1], p[2], p[3] + xy, p[4], p[5] + self._fastest_turn**2 * spread + t2s * seconds)
                unknown += seconds
                continue
            vx, vy, w = twist
            speed, turn = math.hypot(vx, vy), abs(w)
            qx = x2m * speed + xy2r * turn + xy2s
            qy = y2m * speed + xy2r * turn + xy2s
            qt = t2m * speed + t2r * turn + t2s
            cuts = int(turn * seconds / _MAX_TURN) + 1
            h = seconds / cuts
            for _ in range(cuts):
                along, left, p = _advance(p, twist, h, (qx, qy, qt))
                c, s = math.cos(yaw), math.sin(yaw)
                x += c * along - s * left
                y += s * along + c * left
                yaw += w * h
        cov = np.array(
            [[p[0] + _FLOOR, p[1], p[2]], [p[1], p[3] + _FLOOR, p[4]], [p[2], p[4], p[5] + _FLOOR]], dtype=float
        )
        return np.array([x, y, wrap(yaw)]), cov, unknown

    def _between(self, start_ns: int, end_ns: int) -> Iterator[tuple[int, int, Twist | None, int]]:
        """Start, end, twist and, of unknown pieces, where the silence began."""
        at = start_ns
        k = bisect_right(self._starts, at) - 1
        while at < end_ns:
            if k < 0:  # before the first message
                until = min(self._starts[0], end_ns) if self._starts else end_ns
                yield at, until, None, start_ns
            elif at < self._end:
                until = min(self._starts[k + 1] if k + 1 < len(self._starts) else self._end, end_ns)
                if until > at:
                    yield at, until, self._pieces[k], self._starts[k]
            elif at < self._tail_end:
                until = min(self._tail_end, end_ns)
                yield at, until, self._tail, 0
            else:
                until = end_ns
                yield at, until, None, self._tail_end
            at = until
            k += 1


def _advance(
    p: tuple[float, ...], twist: Twist, h: float, density: tuple[float, float, float]
) -> tuple[float, float, tuple[float, float, float, float, float, float]]:
    """One arc: its displacement along and left, and the covariance (xx, xy, xt, yy, yt, tt) at its end.

    Args:
        p: covariance at its start.
        twist: of the body.
        h: how long it takes [s].
        density: of the noise by x, y [m²/s] and yaw [rad²/s].

    Source: Solà et al. 2018, SE(2): the integral of ``Ad(exp(-u ξ)) Q Ad(exp(-u ξ))ᵀ`` over u, by quadrature, after
    ``Ad(exp(-h ξ)) P Ad(exp(-h ξ))ᵀ``.
    """
    vx, vy, w = twist
    qx, qy, qt = density
    p11, p12, p13, p22, p23, p33 = p
    angle = w * h
    c, s = math.cos(angle), math.sin(angle)
    sx, cx = (s / w, (1.0 - c) / w) if abs(angle) > 1e-6 else (h, 0.5 * angle * h)
    xi, yi = -sx * vx - cx * vy, cx * vx - sx * vy  # translation of the arc's inverse
    b11, b12, b13 = c * p11 + s * p12 + yi * p13, c * p12 + s * p22 + yi * p23, c * p13 + s * p23 + yi * p33
    b21, b22, b23 = c * p12 - s * p11 - xi * p13, c * p22 - s * p12 - xi * p23, c * p23 - s * p13 - xi * p33
    p11, p12, p22 = c * b11 + s * b12 + yi * b13, c * b12 - s * b11 - xi * b13, c * b22 - s * b21 - xi * b23
    p13, p23 = b13, b23
    along, left = sx * vx - cx * vy, cx * vx + sx * vy
    for node, weight in _TWO_NODES if abs(angle) < _SHORT_TURN else _THREE_NODES:
        k, u = weight * h, node * h
        angle = w * u
        c, s = math.cos(angle), math.sin(angle)
        sx, cx = (s / w, (1.0 - c) / w) if abs(angle) > 1e-6 else (u, 0.5 * angle * u)
        xi, yi = -sx * vx - cx * vy, cx * vx - sx * vy
        p11 += k * (c * c * qx + s * s * qy + yi * yi * qt)
        p12 += k * (c * s * (qy - qx) - xi * yi * qt)
        p22 += k * (s * s * qx + c * c * qy + xi * xi * qt)
        p13 += k * yi * qt
        p23 -= k * xi * qt
    return along, left, (p11, p12, p13, p22, p23, p33 + qt * h)
