"""Body twist as a function of time: from odometry, wheel angles or commands."""

from __future__ import annotations

import cmath
import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from fgloc import se2
from fgloc.config import NoiseDensity, WheelsConfig
from fgloc.errors import ConfigError
from fgloc.frames import quaternion_yaw
from fgloc.se2 import wrap
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import ControlEvent, FloatArray, MotionEvent, Step

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


def _shape_density(twist: Twist | None, usual: tuple[float, float], seconds: float) -> float:
    """Variance [m²/s] of the place after a silence over which wheels tell way and turn, but not where they turned.

    The heading between is off by a Brownian bridge, of a turn rate as usual that changes within `_SILENT_TAU_S`; its
    integral has a twelfth of the variance of the end of the free process, times the square of the time. The place is
    off by no more than the way.
    """
    if twist is None:
        return 0.0
    speed, turn = max(math.hypot(*twist[:2]), usual[0]), max(abs(twist[2]), usual[1])
    share = seconds / (seconds + _SILENT_TAU_S)  # over less time the turn rate hardly changes
    return speed**2 * min(2.0 * _SILENT_TAU_S * (turn * seconds) ** 2 * share / 12.0, 0.25 * seconds)


class TwistTimeline:
    """Piecewise constant body twist, contiguous from its first stamp on; pieces may be unknown.

    After the last piece its ``tail`` holds for a while; then nothing is known. A piece may have derivatives ``(3, p)``
    of its twist by parameters of the drive.
    """

    def __init__(self, slides: bool = False) -> None:
        """Start empty; ``slides``: the robot goes sideways too, and noise along and across is that of the motion."""
        self._slides = slides
        self._by: dict[int, FloatArray] = {}  # derivatives, by start
        self._tail_by: FloatArray | None = None
        self._starts: list[int] = []
        self._pieces: list[Twist | None] = []  # None: unknown
        # by start, where only the ends are known: mean speed and turn rate before, and variance of the place a second
        self._bridged: dict[int, tuple[float, float, float]] = {}
        self._silence = (0, 0)  # start and end of the newest of them whose ends do not tell the way between
        self._seen_ns = 0  # until when it was seen
        self._known_s = self._way = self._turned = 0.0  # over all pieces: time [s], path [m], turn [rad]
        self._end = 0
        self._tail: Twist = (0.0, 0.0, 0.0)
        self._tail_end = 0
        self._fastest = _UNMEASURED_SPEED
        self._fastest_turn = _UNMEASURED_SPEED

    @property
    def start_ns(self) -> int | None:
        """Stamp at which the timeline begins [ns]; None if it holds nothing."""
        return self._starts[0] if self._starts else None

    @property
    def end_ns(self) -> int:
        """Stamp at which its last piece ends [ns]."""
        return self._end

    def begin(self, stamp_ns: int) -> None:
        """Forget all and start here."""
        self._starts.clear()
        self._pieces.clear()
        self._bridged.clear()
        self._by.clear()
        self._starts.append(stamp_ns)
        self._pieces.append(None)
        self._end = self._tail_end = stamp_ns

    def extend(
        self,
        end_ns: int,
        twist: Twist | None,
        bridged: bool = False,
        by: FloatArray | None = None,
        place_told: bool = True,
    ) -> None:
        """Add a piece from the last one's end to ``end_ns``.

        Args:
            end_ns: its end.
            twist: constant over it; None: not known.
            bridged: only its ends were measured: the way between is as noisy as that of a robot that went on as usual.
            by: derivatives ``(3, p)`` of the twist by the drive's parameters.
            place_told: whether the ends of a bridged piece tell the place of its end, as those of a pose do; wheels
                tell the whole way and turn, and not where on the way the robot turned.
        """
        if end_ns <= self._end:
            return
        seconds = (end_ns - self._end) * 1e-9
        if bridged and self._known_s > 0.0:
            usual = self._way / self._known_s, self._turned / self._known_s
            self._bridged[self._end] = *usual, 0.0 if place_told else _shape_density(twist, usual, seconds)
            if twist is not None and seconds > _SILENT_TAU_S:
                told = math.hypot(twist[0], twist[1]) * seconds < _BRIDGED_M and abs(twist[2]) * seconds < _BRIDGED_RAD
                self._silence, self._seen_ns = (0, 0) if told else (self._end, end_ns), self._end
        elif twist is not None:
            self._known_s += seconds
            self._way += math.hypot(twist[0], twist[1]) * seconds
            self._turned += abs(twist[2]) * seconds
        if by is not None:
            self._by[self._end] = by
        if twist != self._pieces[-1] or by is not None:
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
                self._bridged = {start: means for start, means in self._bridged.items() if start >= self._starts[0]}
                self._by = {start: by for start, by in self._by.items() if start >= self._starts[0]}

    def hold(self, twist: Twist, end_ns: int, by: FloatArray | None = None) -> None:
        """Set the twist that is assumed beyond the last piece, until ``end_ns``, with its derivatives."""
        self._tail, self._tail_by = twist, by
        self._tail_end = max(end_ns, self._end)

    def integrate(
        self, start_ns: int, end_ns: int, noise: NoiseDensity, turn_known: bool = False
    ) -> tuple[FloatArray, FloatArray, float]:
        """Motion between two times, ``start_ns <= end_ns``.

        The covariance is that of a Wiener process along the exact path (xx along the body's x axis, yy across), so
        that it does not depend on how the time is cut. Where the twist is unknown the robot is taken to stand, with the
        spread of a velocity as large as the largest yet seen that changes within 2 s. With ``turn_known`` something
        else measures the turn, also where wheels tell only the whole of it.

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
            speed, turn, shape = math.hypot(vx, vy), abs(w), 0.0
            if origin_ns in self._bridged:
                usual_speed, usual_turn, density = self._bridged[origin_ns]
                speed, turn, shape = max(speed, usual_speed), max(turn, usual_turn), 0.0 if turn_known else density
            ahead, aside = (abs(vx), abs(vy)) if self._slides else (speed, 0.0)
            qx = x2m * ahead + y2m * aside + xy2r * turn + xy2s + shape
            qy = y2m * ahead + x2m * aside + xy2r * turn + xy2s + shape
            qt = t2m * speed + t2r * turn + t2s
            cuts = int(abs(w) * seconds / _MAX_TURN) + 1
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

    def variance_within(self, start_ns: int, end_ns: int, seen: bool) -> FloatArray | None:
        """Variances ``(3,)`` of the pose at a step's end by the unknown way through a silence; None: in no silence.

        The ends of the silence tell its whole way. A pose within is off by a random velocity that is bound to both, or
        to where more than motion was ``seen`` last; the steps have none of it, for the whole would be lost. Steps come
        in order.
        """
        first, last = self._silence
        if start_ns >= last or first >= end_ns:
            return None
        if seen:
            self._seen_ns = min(end_ns, last)
        if seen or end_ns >= last:
            return None
        at, seen_at, whole = ((ns - first) * 1e-9 for ns in (end_ns, self._seen_ns, last))
        here, rest, total = map(_silent_spread, (at - seen_at, whole - at, whole - seen_at))
        spread = here - (0.5 * (total + here - rest)) ** 2 / total
        return spread * np.array([self._fastest, self._fastest, self._fastest_turn]) ** 2

    def sensitivity(self, start_ns: int, end_ns: int, width: int) -> FloatArray:
        """Derivatives ``(3, width)`` of the motion between two times (right perturbation) by the drive's parameters.

        Source: Solà et al. 2018, equations 67 and 163 (right Jacobian and adjoint of SE(2)).
        """
        total = np.zeros((3, width))
        for from_ns, to_ns, twist, origin_ns in self._between(start_ns, end_ns):
            if twist is None:
                continue
            seconds = (to_ns - from_ns) * 1e-9
            way = np.array(twist) * seconds
            total = se2.adjoint(se2.inverse(se2.exp(way))) @ total
            by = self._by.get(origin_ns) if from_ns < self._end else self._tail_by
            if by is not None:
                total += se2.right_jacobian(way) @ by * seconds
        return total

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


MAX_SPEED, MAX_TURN = 10.0, 20.0  # m/s, rad/s: a difference of two readings beyond them is a reset
_FIRST_USUAL_S = 0.05  # between readings, before any came
_MOST_USUAL = 20  # newest of which it is the mean
MAX_GAP_S = 5.0  # over a longer gap no difference is used: the robot may have been restarted
AGAIN_NS = 10_000_000_000  # steps that ended in a silence are measured again after it, if it was no longer


class Track:
    """One source of wheel motion: events in, a timeline out.

    Attributes:
        kind: name of the source.
        timeline: the body's twist, without the delay.
        rejections: readings that could not be used, by reason.
        notes: what the user should know, by what it is about.
    """

    kind = ""
    events: type[MotionEvent] = MotionEvent  # that it reads
    place_told = False  # whether two readings tell the motion between them, however long it was and where it turned

    def __init__(self, config: WheelsConfig) -> None:
        """Start with nothing received."""
        self._config = config
        self.timeline = self._empty()
        self.rejections: Counter[str] = Counter()
        self.notes: dict[str, str] = {}
        self._hold_ns = int(config.hold_s * 1e9)
        self._last_ns: int | None = None  # the newest stamp taken in
        self._given_ns = 0  # motion before this time was given to earlier steps
        self._usual_s, self._usual_of = _FIRST_USUAL_S, 1  # mean time between readings, and of how many
        self._forget()

    def ingest(self, step: Step) -> None:
        """Add the step's events that are newer than all before to the timeline."""
        self._given_ns = step.start_ns
        found: Sequence[Any] = step.of(self.events)
        first = 0 if self._last_ns is None else bisect_right(found, self._last_ns, key=lambda e: e.stamp_ns)
        for event in found[first:]:
            if self._last_ns is None or event.stamp_ns > self._last_ns:
                self._take(event)

    def reset(self) -> None:
        """Begin a new segment, which is not connected with what came before."""
        self.timeline = self._empty()
        self._last_ns = None
        self._forget()

    def _empty(self) -> TwistTimeline:
        drive = self._config.drive
        return TwistTimeline(drive is not None and drive.slides)

    def _take(self, event: Any) -> None:
        raise NotImplementedError

    def _forget(self) -> None:
        raise NotImplementedError

    def _possible(self, twist: Twist, seconds: float, fastest: float = MAX_SPEED) -> bool:
        """Whether a robot can have moved so from one reading to the next; stamps of receipt come in bursts."""
        share = min(seconds / self._usual_s, 1.0)
        return math.hypot(*twist[:2]) * share < fastest and abs(twist[2]) * share < MAX_TURN

    def _true(self, twist: Twist) -> Twist:
        """Twist of the robot for a reported one: small speeds set to zero, configured gains and slowdown applied."""
        vx, vy, w = twist
        config = self._config
        if math.hypot(vx, vy) < config.zero_speed:
            vx = vy = 0.0
        if abs(w) < config.zero_yaw_rate:
            w = 0.0
        scale = config.scale_v * max(0.0, 1.0 - config.slowdown * abs(w))
        vx, vy = scale * vx, scale * vy
        return vx, vy, config.scale_omega * w + config.yaw_per_m * vx

    def _true_by(self, twist: Twist, by: FloatArray) -> FloatArray:
        """Derivatives ``(3, p)`` of the twist of `_true` for those of the reported one."""
        vx, vy, w = twist
        config = self._config
        share = max(0.0, 1.0 - config.slowdown * abs(w))
        gain = config.scale_v * share * (math.hypot(vx, vy) >= config.zero_speed)
        turning = config.scale_omega * (abs(w) >= config.zero_yaw_rate)
        slower = -config.scale_v * config.slowdown * math.copysign(1.0, w) * (share > 0.0)
        whole = np.array([[gain, 0.0, slower * vx], [0.0, gain, slower * vy], [0.0, 0.0, turning]])
        whole[2] += config.yaw_per_m * whole[0]
        return np.asarray(whole @ by)

    def _extend(self, stamp_ns: int, twist: Twist | None, held: Twist | None, by: FloatArray | None = None) -> None:
        """Continue the timeline with ``twist`` or, if that is None, with ``held`` as long as it holds."""
        if self._last_ns is None:
            self.timeline.begin(stamp_ns)
        elif twist is not None:
            by = None if by is None else self._true_by(twist, by)
            bridged = stamp_ns - self._last_ns > self._hold_ns
            self.timeline.extend(stamp_ns, self._true(twist), bridged, by, self.place_told)
        else:
            if held is not None:
                self.timeline.extend(min(stamp_ns, self._last_ns + self._hold_ns), self._true(held))
            self.timeline.extend(stamp_ns, None)

    def _reach(self, stamp_ns: int, held: Twist | None, by: FloatArray | None = None) -> None:
        """Set the stamp of the newest reading; ``held`` is assumed beyond it."""
        if self._last_ns is not None:
            seconds = min((stamp_ns - self._last_ns) * 1e-9, self._config.hold_s)
            self._usual_of = min(self._usual_of + 1, _MOST_USUAL)
            self._usual_s += (seconds - self._usual_s) / self._usual_of
        self._last_ns = stamp_ns
        if held is not None:
            by = None if by is None else self._true_by(held, by)
            self.timeline.hold(self._true(held), stamp_ns + self._hold_ns, by)


class CommandTrack(Track):
    """Commands stand in for wheels: each holds until the next, for ``hold_s`` at most."""

    kind = "command"
    events = ControlEvent

    def _forget(self) -> None:
        self._command: Twist | None = None

    def _take(self, event: ControlEvent) -> None:
        twist = self._twist(event)
        if twist is None:
            return
        self._extend(event.stamp_ns, None, self._command)
        self._command = twist
        self._reach(event.stamp_ns, self._command)

    def _twist(self, event: ControlEvent) -> Twist | None:
        """Commanded twist; None: the drive cannot be commanded like this.

        Raises:
            ConfigError: it is commanded by a steering angle, no drive is given, and nothing else measures the motion.
        """
        drive = self._config.drive
        if event.steering is not None:
            twist = None if drive is None else drive.commanded(event.v, event.steering)
            if twist is not None:
                return twist
            text = "commands give a steering angle (ackermann_msgs): set wheels.drive to a kind that has one, ackermann"
            if self._config.source == "command":
                raise ConfigError(text)
            self.rejections["wheels.command_steering"] += 1
            self.notes["steering"] = text
            return None
        if drive is None or not drive.slides:
            return event.v, 0.0, event.omega
        if not math.isfinite(event.vy):
            self.rejections["wheels.command_non_finite"] += 1
            return None
        return event.v, event.vy, event.omega


def mean_twist(a: Twist | None, b: Twist | None) -> Twist | None:
    """Mean of two twists, or the one that is known."""
    if a is None or b is None:
        return a or b
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])


Pose = tuple[float, float, float]  # x, y [m], yaw [rad]

_CHECK_TURN, _CHECK_PATH = 0.5, 5.0  # rad or m of motion after which twist and pose are compared
_CHECK_HEADING = 0.5  # m of motion after which the pose's heading is held against the direction of its motion
_HEADING_RAD = 0.03  # of a pose's heading off its motion's direction: no offset of two clocks or axles makes more
_STILL = 0.01  # a path shorter than this share of the other did not move (degrees for radians: 0.017)
_BRIDGED_M, _BRIDGED_RAD = 0.5, 0.5  # over a long gap a motion of less is told by its ends
_BEGINS_M = 0.5  # from its origin: there an odometry is that was started just now
_SLACK_M, _SLACK_RAD = 0.03, 0.1
_DEGREES = (40.0, 80.0)  # a reported rotation this many times the pose's was given in degrees


class OdometryTrack(Track):
    """Between two messages, the mean of their twists or the exact motion between their poses.

    Either stands in where the other cannot be used (the gate marks that with NaN). With source "auto" pose differences
    are used, which the driver has summed up from every reading of its encoders, whatever the rate and the stamps of its
    messages; twists instead if the pose does not move, or if its heading is not that of its motion by the twists (a
    heading from elsewhere, or set by hand). A pose that jumps (odometry set to zero) is re-based: only differences
    count.
    """

    kind = "odometry"
    events = OdometryEvent
    place_told = True

    def __init__(self, config: WheelsConfig) -> None:
        """Start with nothing received."""
        super().__init__(config)
        self._mode: str = config.source if config.source in ("twist", "pose") else "auto"
        self._compared = self._mode == "pose"
        self._paths = [0.0, 0.0, 0.0, 0.0]  # pose: m, rad; twist: m, rad
        self._along = 0j  # sum of the pose's motions times the conjugate of the twist's [m²]
        self._across = np.zeros(3)  # sums over these products of |.|², |.|² angle, |.|² angle² [m⁴]
        self._heading_off = 0.0  # angle [rad] from the motion to the pose's heading, where the twist is used for that

    @property
    def by_twist(self) -> bool:
        """Whether the motion is the twist's, as configured or because the poses are not its integral."""
        return self._mode == "twist"

    def _forget(self) -> None:
        self._pose: Pose | None = None
        self._twist: Twist | None = None
        self._moving: Twist | None = None  # the last piece of the timeline

    def _take(self, event: OdometryEvent) -> None:
        vx, vy, _ = event.linear.tolist()
        w = float(event.angular[2])
        x, y, _ = event.position.tolist()
        twist = None if math.isnan(vx + vy + w) else (vx, vy, w)
        pose = None if math.isnan(x + y) else (x, y, quaternion_yaw(event.orientation))
        if twist is None and pose is None:
            return
        piece = None
        if self._last_ns is not None:
            piece = self._connect((event.stamp_ns - self._last_ns) * 1e-9, pose, twist)
        self._extend(event.stamp_ns, piece, self._twist or self._moving)
        self._pose, self._twist, self._moving = pose, twist, piece or self._moving
        self._reach(event.stamp_ns, (self._mode == "twist" and twist) or self._moving or twist)

    def _connect(self, seconds: float, pose: Pose | None, twist: Twist | None) -> Twist | None:
        """Twist between the last message and this one; None if neither twists nor poses give it."""
        both = self._twist is not None and twist is not None
        mean = mean_twist(self._twist, twist) if seconds <= self._config.hold_s else None
        moved = self._between_poses(pose, mean, seconds)
        if both and mean is not None and moved is not None and not self._compared:
            self._compare(moved, mean, seconds)
        if moved is not None and self._heading_off:
            c, s = math.cos(self._heading_off), math.sin(self._heading_off)
            moved = c * moved[0] + s * moved[1], c * moved[1] - s * moved[0], moved[2]
        if moved is None or mean is None:
            return moved or mean
        if self._mode == "pose":
            return moved
        if self._mode == "twist":
            return mean if both else moved
        return moved if any(moved) else mean

    def _bridges(self, pose: Pose) -> bool:
        """Whether the pose's difference is the motion over a long gap: it is used, and was not begun anew.

        Steps that ended within the gap had no motion. Those of some seconds are measured again; after a longer gap only
        a small difference is used: its last piece would be given its share of a way that the steps before do not have.
        """
        assert self._last_ns is not None
        before = self._pose or pose
        insists = self._config.source == "twist"  # else a twist is used as the pose stands, or its heading is off
        stands = pose == before and self._twist is not None and any(self._twist)
        restarted = math.hypot(*pose[:2]) < _BEGINS_M < math.hypot(*before[:2])
        dx, dy, dyaw = _difference(before, pose)
        little = math.hypot(dx, dy) < _BRIDGED_M and abs(dyaw) < _BRIDGED_RAD
        whole = self._given_ns <= self._last_ns + max(self._hold_ns, AGAIN_NS)
        return not insists and (little or whole) and not stands and not restarted

    def _between_poses(self, pose: Pose | None, mean: Twist | None, seconds: float) -> Twist | None:
        """The constant twist from the last pose to this one; None if that cannot be known."""
        if pose is None or self._pose is None:
            return None
        if seconds > MAX_GAP_S and not self._bridges(pose):
            return None
        dx, dy, dyaw = _difference(self._pose, pose)
        # Less than the slack is no jump, however short the time: stamps of receipt come in bursts.
        speed = max(math.hypot(dx, dy) - _SLACK_M, 0.0) / seconds
        turn = max(abs(dyaw) - _SLACK_RAD, 0.0) / seconds
        # Judged by the twist or, without one, by the motion just before.
        slack = 1.0
        reference = mean if mean is not None and any(mean) else None
        if reference is None:
            reference, slack = self._moving or (MAX_SPEED, 0.0, MAX_TURN), 1.0 + 10.0 * seconds
        may = min(slack + 1.5 * math.hypot(reference[0], reference[1]), MAX_SPEED)
        may_turn = min(3.0 * slack + 1.5 * abs(reference[2]), MAX_TURN)
        if speed > may or turn > may_turn:
            self.rejections["wheels.pose_reset"] += 1
            self.notes["reset"] = (
                f"the odometry's pose jumped {self.rejections['wheels.pose_reset']} time(s), the last by "
                f"{math.hypot(dx, dy):.3g} m and {dyaw:.3g} rad: taken as a reset, motion goes on from the new value"
            )
            return None
        return dx / seconds, dy / seconds, dyaw / seconds

    def _compare(self, moved: Twist, mean: Twist, seconds: float) -> None:
        """Cross-check twist and pose once enough was driven, and settle which is used.

        Raises:
            ConfigError: the configuration insists on a twist that is in degrees per second.
        """
        for k, value in enumerate((math.hypot(*moved[:2]), moved[2], math.hypot(*mean[:2]), mean[2])):
            self._paths[k] += abs(value) * seconds
        product = complex(*moved[:2]) * complex(*mean[:2]).conjugate() * seconds**2
        self._along += product
        self._across += abs(product) ** 2 * np.power(cmath.phase(product), [0, 1, 2])
        pose_path, pose_turn, twist_path, twist_turn = self._paths
        pose_still = pose_path <= _STILL * twist_path and pose_turn <= _STILL * twist_turn
        twist_still = twist_path <= _STILL * pose_path and twist_turn <= _STILL * pose_turn
        moved_enough = pose_turn > _CHECK_TURN or pose_path > _CHECK_PATH
        if not moved_enough and not (pose_still and (twist_turn > _CHECK_TURN or twist_path > _CHECK_PATH)):
            return
        heading, spread = self._heading()
        sure = pose_path > _CHECK_HEADING and spread < _HEADING_RAD
        self._compared = pose_still or sure or pose_path > _CHECK_PATH
        insists = self._config.source == "twist"
        ratio = twist_turn / max(pose_turn, 1e-9)
        mode, self._heading_off = "pose", 0.0
        if pose_still:
            mode, text = "twist", "the odometry's pose does not move: its twist is used"
        elif twist_still:
            text = "the odometry's twist is zero while its pose moves: "
            text += "set wheels.source to pose" if insists else "pose differences are used"
        elif pose_turn > _CHECK_TURN and _DEGREES[0] < ratio < _DEGREES[1]:
            text = f"the odometry's yaw rate is {ratio:.1f} times the rotation of its pose: degrees, not radians"
            if insists:
                raise ConfigError(f"{text}; set wheels.source to pose, or wheels.scale_omega to {math.pi / 180:.6f}")
            text += ": pose differences are used"
        elif abs(heading) > _HEADING_RAD + spread:
            mode, self._heading_off = "twist", heading
            text = (
                f"the odometry's twist is used: the heading of its pose is {math.degrees(-heading):+.1f}° off the "
                "direction in which the pose moves"
            )
        else:
            used = "the odometry's twist is used" if insists else "differences of the odometry's pose are used"
            other = "pose" if insists else "twist"
            text = f"{used}; its {other} agrees"
            if _differ(twist_path, pose_path) or _differ(twist_turn, pose_turn):
                text = (
                    f"{used}; its {other} disagrees: by the twist {twist_path:.2f} m and {twist_turn:.2f} rad, by the "
                    f"pose {pose_path:.2f} m and {pose_turn:.2f} rad"
                )
                text += "; see wheels.source" if self._config.source == "auto" else ""
        self._mode = "twist" if insists else mode
        self.notes["source"] = text

    def _heading(self) -> tuple[float, float]:
        """Angle from the twists to the pose's motions, and three standard errors of it [rad]."""
        angle, (n, na, naa) = cmath.phase(self._along), self._across
        variance = max(naa - 2.0 * angle * na + angle**2 * n, 0.0) / max(abs(self._along), 1e-12) ** 2
        return angle, 3.0 * math.sqrt(variance)


def _difference(a: Pose, b: Pose) -> Twist:
    """``log(a⁻¹ b)``, as `fgloc.se2` has it, without arrays: it runs for every message."""
    c, s = math.cos(a[2]), math.sin(a[2])
    x, y, turn = c * (b[0] - a[0]) + s * (b[1] - a[1]), c * (b[1] - a[1]) - s * (b[0] - a[0]), se2.wrap(b[2] - a[2])
    half = 0.5 * turn
    k = 1.0 - half * half / 3.0 if abs(turn) < 1e-5 else half / math.tan(half)
    return k * x + half * y, k * y - half * x, turn


def _differ(a: float, b: float) -> bool:
    """Whether two lengths that should be equal differ by more than a third."""
    return max(a, b) > _CHECK_TURN and not 0.75 * b < a < 1.34 * b
