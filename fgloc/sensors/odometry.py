"""Odometries beside the wheels: visual, LiDAR, second wheels, poses or twists (``recording.odometries``).

Each is a motion source of its own, named ``odometry.NAME``. Its motion over a step is that of its poses, where it gives
them, else of its twists; what it tracks is mounted at ``pose`` in the base frame. Mounting, scale and clock are
constants of the installation. Its covariance is that of its messages, else of usual noise densities; by how much the
true one is larger is learned from its differences to the other sources (`CovarianceScale`), which also find it frozen,
jumped or restarted (`fgloc.estimation.beside`).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from fgloc import se2
from fgloc.config import ODOMETRIES, Config, GateConfig, NoiseDensity, OdometryTopic
from fgloc.sensors.base import BASE, BuiltIn, EventInput, FoundRow, MotionInstallation, Parameter, Rank, Stream
from fgloc.sensors.failures import Change, EventFailure, Failure, Scene
from fgloc.sensors.wheels.events import (
    OdometryChecks,
    PoseAndTwistEvent,
    odometry_converters,
    odometry_validator,
    planar,
)
from fgloc.sensors.wheels.failures import JoinedWheels
from fgloc.types import Event, FloatArray, IntArray, MotionMeasurement, Step

# --- Events -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class BesideEvent(PoseAndTwistEvent):
    """``nav_msgs/Odometry`` of a source beside the wheels; its topic tells which one."""


class OdometriesInput(EventInput):
    """Method that makes the events of odometries beside the wheels."""

    def odometry_beside(
        self,
        name: str,
        stamp_ns: int,
        pose: tuple[float, float, float] | None = None,
        twist: tuple[float, float, float] | None = None,
        twist_cov: FloatArray | None = None,
    ) -> None:
        """Odometry of a source of ``recording.odometries``.

        Args:
            name: of the source.
            stamp_ns: when it was measured.
            pose: x, y [m], yaw [rad] in a frame of its own; None: it has none.
            twist: forward, left [m/s], yaw rate [rad/s]; None: it has none.
            twist_cov: ``(3, 3)`` of the twist; None: not known.
        """
        known = planar(pose, twist)
        if twist_cov is not None and twist is not None:
            known[-1][np.ix_(_ROS, _ROS)] = twist_cov
        self._deliver(BesideEvent(*self._when(f"odometry.{name}", stamp_ns), name, BASE, *known))


# --- Constants of the installation ------------------------------------------------------------------------------------

_PLACE_M, _YAW_RAD = 0.02, 0.03  # how far a given mounting is off
_UNKNOWN_M, _UNKNOWN_RAD = 0.2, 0.1  # and one that is taken to be the base's
_SCALE = 0.02  # of its distances: of a stereo camera's calibration, or of tyres
_CLOCK_S = 0.02
PLACE = ("x_m", "y_m", "yaw_rad")


def _parameters(config: Config, sources: Collection[str]) -> Iterator[Parameter]:
    for one in config.recording.odometries:
        place, yaw = (_PLACE_M, _YAW_RAD) if one.pose is not None else (_UNKNOWN_M, _UNKNOWN_RAD)
        for name, sigma in zip(PLACE, (place, place, yaw), strict=True):
            yield Parameter(f"{one.role}.{name}", sigma)
        yield Parameter(f"{one.role}.scale", _SCALE)
        yield Parameter(f"{one.role}.time_offset_s", _CLOCK_S, Rank.CLOCK)


def _found(config: Config) -> tuple[FoundRow, ...]:
    rows = []
    for one in config.recording.odometries:
        given = dict(zip(PLACE, one.pose or (0.0, 0.0, 0.0), strict=True)) | {"scale": 1.0, "time_offset_s": 0.0}
        rows += [FoundRow(f"{one.role}.{name}", f"{one.role}.{name}", at, 1.0) for name, at in given.items()]
    return tuple(rows)


INSTALLATION = MotionInstallation(
    lambda config, sources: tuple(_parameters(config, sources)), _found, lambda state, config: iter(()), {}
)


# --- By how much a covariance is too small ----------------------------------------------------------------------------

_SCALES = np.geomspace(0.1, 1e4, 61)
_PRIOR_DECADES = 0.7  # sigma of the scale's decadic logarithm: a covariance is off by a factor of five
_MEMORY_S = 120.0
_WRONG, _WIDE = 0.02, 100.0  # share of differences that no covariance explains, and the factor on theirs
_WINDOW_S = 1.0  # errors that last show in sums over such a time


class CovarianceScale:
    """Factor on a source's covariance, by its differences to a reference: its likelihood at `_SCALES`.

    Steps and sums over a second have a likelihood each; the larger factor counts, as errors that last, like a drifting
    heading, show in sums only.
    """

    def __init__(self) -> None:
        logs = np.log10(_SCALES)
        self._prior = -0.5 * (logs / _PRIOR_DECADES) ** 2
        self._steps, self._sums = np.zeros(len(_SCALES)), np.zeros(len(_SCALES))
        self._sum: tuple[float, FloatArray, FloatArray, FloatArray] | None = None

    @property
    def factor(self) -> float:
        """Mean of the factor, of single steps or of sums; never below 1: errors that two sources share do not show."""
        return max(self._mean(self._steps), self._mean(self._sums), 1.0)

    def _mean(self, likelihood: FloatArray) -> float:
        weights = np.exp(self._prior + likelihood - (self._prior + likelihood).max())
        return float(np.exp(weights @ np.log(_SCALES) / weights.sum()))

    def add(self, seconds: float, difference: FloatArray, own: FloatArray, other: FloatArray) -> None:
        """Add a step.

        Args:
            seconds: its length.
            difference: ``(3,)`` of the two motions.
            own: ``(3, 3)`` covariance of the source, times 1.
            other: ``(3, 3)`` of the reference, with what the installation adds to the difference.
        """
        kept = math.exp(-seconds / _MEMORY_S)
        self._steps = kept * self._steps + _log_likelihood(difference, own, other)
        before = self._sum or (0.0, np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))
        total = before[0] + seconds, before[1] + difference, before[2] + own, before[3] + other
        if total[0] < _WINDOW_S:
            self._sum = total
            return
        self._sum = None
        self._sums = math.exp(-total[0] / _MEMORY_S) * self._sums + _log_likelihood(*total[1:])

    def interrupt(self) -> None:
        """Forget the running sum, as the source was wrong."""
        self._sum = None


def _log_likelihood(difference: FloatArray, own: FloatArray, other: FloatArray) -> FloatArray:
    """Log likelihood of a difference for each of `_SCALES`; a small share of differences has a wide distribution."""
    S = _SCALES[:, None, None] * own + other
    nis = np.einsum("i,nij,j->n", difference, np.linalg.inv(S), difference)
    right = -0.5 * (nis + np.log(np.linalg.det(S)))
    wrong = -0.5 * (nis / _WIDE + np.log(np.linalg.det(S)) + 3.0 * math.log(_WIDE))
    return np.asarray(np.logaddexp(math.log(1.0 - _WRONG) + right, math.log(_WRONG) + wrong))


# --- Motion over a step -----------------------------------------------------------------------------------------------

_ROS = (0, 1, 5)
_HOLD_NS = 300_000_000  # a twist holds for so long beyond its message; after it the source is silent
_KEEP = 4096  # newest pieces: more than 10 s at 200 Hz
_JUMP_M, _JUMP_RAD = 0.1, 0.2  # of a pose, off what its twist makes of the interval
_BEGINS_M = 0.5  # from its origin: there an odometry is that was started just now
_DENSITY = NoiseDensity()  # usual


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """Interval between two messages: constant twist, covariance per second, whether the pose repeats, what is wrong."""

    start_ns: int
    end_ns: int
    twist: FloatArray  # (3,)
    density: FloatArray  # (3, 3) per second
    repeats: bool
    wrong: str


@dataclass(frozen=True, slots=True, eq=False)
class BesideReading:
    """One source over one step.

    Attributes:
        motion: as reported, of the base; covariance as the messages have it.
        wrong: why it cannot be used by its own messages: "jumped", "restarted"; "" otherwise.
        repeats: all its poses in the step are the one before.
    """

    motion: MotionMeasurement
    wrong: str
    repeats: bool


class BesideOdometry:
    """Messages of one source, and its motion over steps.

    Attributes:
        name: ``odometry.NAME``.
        scale: factor on its covariance.
    """

    def __init__(self, config: OdometryTopic, gate: GateConfig, frame: Callable[[str], FloatArray | None]) -> None:
        """Begin without messages; ``frame``: ``T_base_frame (4, 4)`` by tf, where the settings give no mounting."""
        self.name, self._topic, self._gate, self._frame = config.role, config.topic, gate, frame
        self._given = config.pose
        self._mounting = np.zeros(3) if config.pose is None else np.array(config.pose)
        self.scale = CovarianceScale()
        self.reset()

    def reset(self) -> None:
        """Begin a segment, which nothing connects with what was before."""
        self._pieces: list[_Piece] = []
        self._last: BesideEvent | None = None

    def read(self, step: Step) -> BesideReading | None:
        """Its motion over a step; None where it is silent."""
        for event in step.of(BesideEvent):
            if event.topic == self._topic and (self._last is None or event.stamp_ns > self._last.stamp_ns):
                if self._last is not None:
                    self._pieces.append(self._piece(self._last, event))
                elif self._given is None and (T := self._frame(event.child_frame_id)) is not None:
                    self._mounting = np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])
                self._last = event
        del self._pieces[:-_KEEP]
        if step.dt <= 0.0:
            return None
        motion, cov, at = np.zeros(3), np.zeros((3, 3)), step.start_ns
        wrong, repeats = "", True
        for piece in self._over(step):
            end = min(piece.end_ns, step.stamp_ns) if piece is not self._pieces[-1] else step.stamp_ns
            if piece.start_ns > at + _HOLD_NS or end > piece.end_ns + _HOLD_NS or piece.end_ns - piece.start_ns > 1e9:
                return None
            seconds, at = (end - at) * 1e-9, end
            part = se2.exp(piece.twist * seconds)
            motion, cov = se2.compose(motion, part), se2.compose_cov(cov, part, piece.density * seconds)
            wrong, repeats = wrong or piece.wrong, repeats and piece.repeats
        if at < step.stamp_ns:
            return None
        X = self._mounting
        ad = se2.adjoint(X)
        base = se2.compose(se2.compose(X, motion), se2.inverse(X))
        made = MotionMeasurement(self.name, step.start_ns, step.stamp_ns, base, ad @ cov @ ad.T)
        return BesideReading(made, wrong, repeats)

    def derivatives(self, step: Step, m: MotionMeasurement) -> dict[str, FloatArray]:
        """Derivatives ``(3,)`` of a step's motion (right perturbation) by the constants of the source."""
        X = self._mounting
        ad = se2.adjoint(X)
        own = se2.compose(se2.compose(se2.inverse(X), m.motion), X)
        by_mounting = ad @ (se2.adjoint(se2.inverse(own)) - np.eye(3))
        c, s = math.cos(own[2]), math.sin(own[2])
        by_scale = ad @ np.array([c * own[0] + s * own[1], -s * own[0] + c * own[1], 0.0])
        c, s = math.cos(X[2]), math.sin(X[2])
        in_base = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # mounting moved along the base's axes
        by = dict(zip((f"{self.name}.{name}" for name in PLACE), (by_mounting @ in_base).T, strict=True))
        start, end = self._twist(step.start_ns), self._twist(step.stamp_ns)
        change = end - se2.adjoint(se2.inverse(own)) @ start
        return by | {f"{self.name}.scale": by_scale, f"{self.name}.time_offset_s": ad @ change}

    def _twist(self, at_ns: int) -> FloatArray:
        """Reported twist ``(3,)`` at a time: the mean of the pieces before and after."""
        k = bisect_right(self._pieces, at_ns, key=lambda p: p.start_ns)
        begun_ns = self._pieces[k - 1].start_ns if k > 0 else 0
        near = self._pieces[max(k - 2, 0) : k + 1] if abs(at_ns - begun_ns) < _HOLD_NS else []
        return np.asarray(np.mean([p.twist for p in near], axis=0)) if near else np.zeros(3)

    def _over(self, step: Step) -> Iterator[_Piece]:
        """Pieces that reach into a step, in order; the last one may hold beyond its end."""
        first = max(bisect_right(self._pieces, step.start_ns, key=lambda p: p.end_ns) - 1, 0)
        for piece in self._pieces[first:]:
            if piece.start_ns >= step.stamp_ns:
                return
            if piece.end_ns > step.start_ns or piece is self._pieces[-1]:
                yield piece

    def _piece(self, before: BesideEvent, now: BesideEvent) -> _Piece:
        seconds = (now.stamp_ns - before.stamp_ns) * 1e-9
        first, second = _pose(before), _pose(now)
        known = [t for t in (_reported(before), _reported(now)) if t is not None]
        by_twist = np.mean(known, axis=0) if known else None
        wrong, repeats = "", False
        if first is not None and second is not None:
            moved = se2.log(se2.between(first, second))
            twist = moved / seconds
            repeats = not moved.any()
            if self._jumps(moved, by_twist, seconds):
                was, came = math.hypot(*first[:2]), math.hypot(*second[:2])
                wrong = "restarted" if came < _BEGINS_M < was else "jumped"
        else:
            twist = np.zeros(3) if by_twist is None else by_twist
        return _Piece(before.stamp_ns, now.stamp_ns, twist, _density(now, twist, seconds), repeats, wrong)

    def _jumps(self, moved: FloatArray, by_twist: FloatArray | None, seconds: float) -> bool:
        """Whether a pose moved further than a robot can, or far off what the twists say."""
        way, turn = float(np.hypot(*moved[:2])), abs(float(moved[2]))
        if way > self._gate.max_speed * seconds + _JUMP_M or turn > self._gate.max_yaw_rate * seconds + _JUMP_RAD:
            return True
        if by_twist is None:
            return False
        off = moved - by_twist * seconds
        told = float(np.hypot(*by_twist[:2])) * seconds, abs(float(by_twist[2])) * seconds
        return bool(np.hypot(*off[:2]) > _JUMP_M + told[0] or abs(off[2]) > _JUMP_RAD + told[1])


def _pose(event: BesideEvent) -> FloatArray | None:
    pose = event.pose
    return None if np.isnan(pose).any() else pose


def _reported(event: BesideEvent) -> FloatArray | None:
    twist = np.array([event.linear[0], event.linear[1], event.angular[2]])
    return None if np.isnan(twist).any() else twist


def _density(event: BesideEvent, twist: FloatArray, seconds: float) -> FloatArray:
    """Covariance ``(3, 3)`` of the motion per second: of the message's twist, else usual noise densities."""
    cov = event.twist_cov[np.ix_(_ROS, _ROS)]
    if (np.diag(cov) > 0.0).all():
        return np.asarray(cov * seconds)
    return np.diag(_DENSITY.per_second(float(np.hypot(*twist[:2])), float(twist[2])))


# --- Failures for `fgloc ablate` --------------------------------------------------------------------------------------


class BesideFrozen(EventFailure):
    """Odometries beside the wheels repeat their last pose, at rest, with new stamps."""

    changes: ClassVar[tuple[type[Event], ...]] = (BesideEvent,)
    kind: Literal["odometries_frozen"] = "odometries_frozen"

    def begin(self, scene: Scene) -> Change:
        """Return the function that repeats the first pose of each topic."""
        held: dict[tuple[str, int], BesideEvent] = {}
        schedule = self.when.schedule(scene)

        def freeze(event: Event) -> Event:
            assert isinstance(event, BesideEvent)
            inside = schedule.inside(event)
            first = held.setdefault((event.topic, 0 if inside is None else hash(inside)), event)
            rest = np.zeros(3)
            return replace(event, position=first.position, orientation=first.orientation, linear=rest, angular=rest)

        return freeze


class BesideJump(Failure):
    """Poses of odometries beside the wheels jump ahead at the start of each interval, and stay there."""

    kind: Literal["odometries_jump"] = "odometries_jump"
    distance_m: float = Field(0.5, gt=0, description="m, forward")
    yaw_rad: float = Field(0.3, description="rad")

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The changed events, in order of receive time."""
        schedule = self.when.schedule(scene)
        begun: IntArray | list[float] = sorted(start for start, _ in schedule.intervals)
        for event in events:
            jumps = bisect_right(begun, scene.seconds(event)) if isinstance(event, BesideEvent) else 0
            if not jumps or not isinstance(event, BesideEvent):
                yield event
                continue
            self.touch(scene)
            pose = event.pose
            for _ in range(jumps):
                pose = se2.compose((self.distance_m, 0.0, self.yaw_rad), pose)
            yield event.with_pose(pose)


# --- The sensor -------------------------------------------------------------------------------------------------------


ODOMETRY = BuiltIn(
    name=ODOMETRIES,
    title="odometries beside the wheels",
    installation=INSTALLATION,
    streams=(
        Stream(
            ODOMETRIES,
            BesideEvent,
            odometry_converters(BesideEvent),
            (),
            validator=odometry_validator,
            findings=OdometryChecks,
        ),
    ),
    failures=(BesideFrozen, BesideJump),
    joined=JoinedWheels,
)
