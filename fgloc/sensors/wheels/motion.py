"""Wheel motion over a step, what the wheels are off by, and whether they stand."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Container, Iterator
from functools import partial
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from fgloc import se2
from fgloc.config import WheelsConfig
from fgloc.sensors.base import FoundRow, InstallationState, MotionInstallation, Parameter, Rank
from fgloc.sensors.wheels.driven import DriveTrack, TicksTrack
from fgloc.sensors.wheels.tracks import AGAIN_NS, CommandTrack, OdometryTrack, Track, TwistTimeline
from fgloc.types import FloatArray, MotionMeasurement, Setting, Step

if TYPE_CHECKING:
    from fgloc.config import Config


_COMMANDED_NS = 1_000_000_000  # how long before a step a command still moves the robot
_QUANTIZATION = 1e-3  # m, rad: of encoders, in a second; less is no motion
_WINDOW_S = 1.0  # in which encoders that jitter by a tick come back to where they were ...
_JITTER = 2e-3  # ... to within a tick of each wheel [rad]
_LEAST_S = 0.1  # a shorter step has as large a quantization


def is_standing(motion: FloatArray, seconds: float) -> bool:
    """Whether a motion ``(3,)`` that wheels measured over a step of this length [s] counts as standing still."""
    x, y, yaw = motion
    return bool(max(math.hypot(x, y), abs(yaw)) < _QUANTIZATION * max(seconds, _LEAST_S))


class Standing:
    """Detects wheels that stand, by single steps or, as encoders jitter between two ticks, over a second."""

    def __init__(self) -> None:
        self._steps: deque[tuple[float, FloatArray]] = deque()

    def fork(self) -> Standing:
        """A copy that may go on without changing this one."""
        forked = Standing()
        forked._steps.extend(self._steps)
        return forked

    def observe(self, motion: FloatArray | None, seconds: float) -> bool:
        """Whether the wheels stand still, after the next step.

        Args:
            motion: ``(3,)`` of the wheels over the step; None: unknown, or they are commanded to move.
            seconds: length of the step.
        """
        if motion is None:
            self._steps.clear()
            return False
        self._steps.append((seconds, motion))
        while sum(s for s, _ in self._steps) - self._steps[0][0] >= _WINDOW_S:
            self._steps.popleft()
        if is_standing(motion, seconds):
            return True
        x, y, yaw = np.sum([m for _, m in self._steps], axis=0)
        whole = sum(s for s, _ in self._steps) >= _WINDOW_S
        return bool(whole and math.hypot(x, y) < _QUANTIZATION and abs(yaw) < _JITTER)


def commanded_to_move(step: Step) -> bool | None:
    """Whether a command of the step, or of the second before it, is not zero; None if there is none."""
    since = step.start_ns - _COMMANDED_NS
    recent = [c.v != 0.0 or c.omega != 0.0 for c in step.controls if c.stamp_ns >= since]
    return any(recent) if recent else None


_SLOWEST = 0.1  # share of the reported speed that turning leaves, where it is divided by
OF_CLOCK = ("wheels.time_offset_s", "wheels.delay_s")


def _parameters(config: Config, sources: Collection[str]) -> tuple[Parameter, ...]:
    """Parameters of the wheels with their priors; without a gyro, other clocks are compared to that of the wheels."""
    wheels = config.wheels
    return (
        *_geometry(wheels),
        Parameter("wheels.slowdown", wheels.slowdown_sigma),
        Parameter("wheels.delay_s", wheels.delay_sigma_s),
        Parameter(
            "wheels.time_offset_s",
            wheels.time_offset_sigma_s if "gyro" in sources else 0.0,
            Rank.CLOCK,
            ("heading",),
        ),
    )


DRIVE = "wheels.drive."
"""Begins the name of a parameter of a drive."""


def _geometry(wheels: WheelsConfig) -> Iterator[Parameter]:
    """The drive's own parameters, or those of two wheels, which commands of any drive have too."""
    drive = None if wheels.source == "command" else wheels.drive
    if drive is None:
        yield Parameter("wheels.radius", wheels.scale_sigma, effects=("length", "turn"), lengthens=True)
        yield Parameter("wheels.track", wheels.turn_scale_sigma, effects=("turn",), lengthens=True)
    else:
        for name, sigma in drive.states.items():
            is_radius = name == "radius"
            yield Parameter(f"{DRIVE}{name}", sigma, effects=("length", "turn") if is_radius else ("turn",))
    if drive is None or drive.unequal:
        yield Parameter("wheels.yaw_per_m", wheels.yaw_per_m_sigma, effects=("turn",))


def _of_drive(wheels: WheelsConfig) -> Iterator[tuple[str, float]]:
    """Names of the drive's own parameters, and their values as configured."""
    if wheels.drive is not None:
        for name in wheels.drive.states:
            yield f"{DRIVE}{name}", wheels.drive.value(name)


def _found_rows(config: Config) -> tuple[FoundRow, ...]:
    """Rows of ``metrics.json`` on the wheels."""
    wheels = config.wheels
    unequal = (
        FoundRow("wheels.radius_ratio", "wheels.yaw_per_m", 1.0, -wheels.track)
        if wheels.track is not None
        else FoundRow("wheels.yaw_per_m", "wheels.yaw_per_m", wheels.yaw_per_m, 1.0)
    )
    return (
        *(FoundRow(name, name, value, 1.0) for name, value in _of_drive(wheels)),
        FoundRow("wheels.radius_scale", "wheels.radius", 1.0, 1.0),
        FoundRow("wheels.track_scale", "wheels.track", 1.0, 1.0),
        unequal,
        FoundRow("wheels.slowdown", "wheels.slowdown", wheels.slowdown, 1.0),
        FoundRow("wheels.delay_s", "wheels.delay_s", wheels.delay_s, 1.0),
        FoundRow("wheels.time_offset_s", "wheels.time_offset_s", 0.0, 1.0),
    )


def _settings(state: InstallationState, config: Config) -> Iterator[Setting]:
    """Settings of the wheels, as a run has estimated them."""
    wheels = config.wheels
    longer, turn = 1.0 + state.value("wheels.radius"), 1.0 - state.value("wheels.track")
    pull = (turn * longer * wheels.yaw_per_m + state.value("wheels.yaw_per_m")) / longer
    gain = {"wheels.radius": wheels.scale_v}
    yield from state.setting("wheels.scale_v", wheels.scale_v, wheels.scale_v * longer, gain)
    gain = {"wheels.track": wheels.scale_omega, "wheels.radius": wheels.scale_omega}
    gain["wheels.track"] *= -1.0
    yield from state.setting("wheels.scale_omega", wheels.scale_omega, wheels.scale_omega * longer * turn, gain)
    yield from state.setting("wheels.yaw_per_m", wheels.yaw_per_m, pull, {"wheels.yaw_per_m": 1.0})
    for key, given in _of_drive(wheels):
        yield from state.setting(key, given, given + state.value(key), {key: 1.0})
    for name in ("slowdown", "delay_s"):
        given = getattr(wheels, name)
        now = max(0.0, given + state.value(f"wheels.{name}"))
        yield from state.setting(f"wheels.{name}", given, now, {f"wheels.{name}": 1.0})


INSTALLATION = MotionInstallation(
    _parameters,
    _found_rows,
    _settings,
    {
        "wheels.scale_v": "wheels.scale_sigma",
        "wheels.scale_omega": "wheels.turn_scale_sigma",
        "wheels.yaw_per_m": "wheels.yaw_per_m_sigma",
        "wheels.slowdown": "wheels.slowdown_sigma",
        "wheels.delay_s": "wheels.delay_sigma_s",
    },
)


_TRACKS: dict[str, type[Track]] = {
    "twist": OdometryTrack,
    "pose": OdometryTrack,
    "ticks": TicksTrack,
    "command": CommandTrack,
}

_HALF_NS = 20_000_000
_SHORTEST_TOLD_S = 1e-3  # without a known motion, in all; less is counted, but no note


def mean_twist(between: Callable[[int, int], tuple[FloatArray, FloatArray]], at_ns: int) -> FloatArray:
    """Twist ``(3,)`` of the base [m/s, m/s, rad/s]: the mean over 40 ms around a time.

    Args:
        between: gives the motion ``(3,)`` from one time [ns] to another, with its covariance.
        at_ns: the time.
    """
    motion, _ = between(at_ns - _HALF_NS, at_ns + _HALF_NS)
    return np.asarray(se2.log(motion) / (2e-9 * _HALF_NS))


class WheelMotion:
    """Integrates the wheels' motion over a step, with covariance.

    Between two odometry messages the twist is the mean of theirs; a command holds until the next. A piece whose twist
    the gate refused is taken from pose differences, else the last twist is held, at most for ``hold_s``. The covariance
    is made of the configured noise densities alone: robots' own are rarely right. It does not depend on how time is cut
    into steps. Where no message came for longer than ``hold_s`` the robot is taken to stand still with the spread of
    its largest speed so far, so that every step has a measurement; such steps are counted as "wheels.silence". Of a way
    that only the ends of a silence tell see `TwistTimeline.variance_within`.

    Sources: with "auto" wheel angles if the geometry is given, else the odometry (see `OdometryTrack`), else commands:
    the best that has messages.

    Attributes:
        source: where the motion comes from: "ticks", "odometry" or "command"; empty before any message came.
        unknown_s: time [s] for which no motion of the wheels was known so far.
        measured_again: earlier steps, in a silence of the wheels, whose motion the reading after it has told; `measure`
            gives it.
        turn_known: whether a gyro tells the turn within a silence.

    ``rejections`` counts wheels.silence, wheels.pose_reset (an odometry that jumped) and wheels.encoder_reset.
    """

    def __init__(self, config: WheelsConfig) -> None:
        """Set up.

        Raises:
            ConfigError: wheel angles are asked for without the wheels' geometry.
        """
        self._config = config
        self.source = ""
        self.unknown_steps = 0
        self._delay_ns = int(config.delay_s * 1e9)
        self.unknown_s = 0.0
        self._segment: int | None = None
        if config.source == "auto" and config.drive is not None:
            kinds = ["ticks"]
        elif config.source == "auto":
            geometry = (config.left_radius, config.right_radius, config.track)
            kinds = ["ticks"] if None not in geometry else []
            kinds += ["twist", "command"]
        else:
            kinds = [] if config.source == "none" else [config.source]
        driven = config.drive is not None
        self._tracks = [
            (DriveTrack if driven and kind == "ticks" else _TRACKS[kind])(config) for kind in kinds
        ]  # best first
        self._all = tuple(self._tracks)
        self._taken: WeakKeyDictionary[Step, MotionMeasurement | None] = WeakKeyDictionary()
        self._beyond: deque[tuple[Step, float]] = deque()  # ended after the newest reading; time unknown in each
        self._read_ns = 0  # end of the timeline then
        self.measured_again: list[Step] = []  # by the newest call of `measure`
        self.turn_known = False

    @property
    def by_twist(self) -> bool:
        """Whether the motion is the twist of an odometry, not the change of its pose."""
        return any(isinstance(t, OdometryTrack) and t.by_twist and t.kind == self.source for t in self._all)

    @property
    def from_commands(self) -> bool:
        """Whether there is no wheel odometry, and commands replace it."""
        return self.source == "command"

    @property
    def rejections(self) -> Counter[str]:
        """Number of readings and steps that could not be used so far, by reason."""
        counts = Counter({"wheels.silence": self.unknown_steps} if self.unknown_steps else {})
        for track in self._all:
            counts.update(track.rejections)
        return counts

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user so far, one sentence each."""
        of_tracks = [note for track in self._all for note in track.notes.values()]
        explained = any(track.kind == self.source and "source" in track.notes for track in self._all)
        notes = [f"wheel motion comes from {_NAMES[self.source]}"] if self.source and not explained else []
        notes += of_tracks
        if self.unknown_s >= _SHORTEST_TOLD_S:
            short, s = self.unknown_s < 0.1, "" if self.unknown_steps == 1 else "s"
            lasted = f"{1e3 * self.unknown_s:.0f} ms" if short else f"{self.unknown_s:.1f} s"
            notes.append(f"no wheel motion was known for {lasted} in {self.unknown_steps} step{s}")
        return tuple(notes)

    @property
    def track_m(self) -> float | None:
        """Distance between the wheels [m], as configured; None: not known."""
        return self._config.track

    def measure(self, step: Step) -> MotionMeasurement | None:
        """Motion over the step. Measured again, the same step gives the same.

        Returns:
            None for a step of no length or if the configured source is "none".

        Raises:
            ConfigError: wheel joints are ambiguous or missing, or the twist chosen by configuration is in degrees.
        """
        if step in self._taken:
            return self._taken[step]
        self._ingest(step)
        self.measured_again = []
        measured = None
        if self._tracks and step.dt > 0.0:
            timeline = self._active(step)
            self._measure_again(timeline)
            measured, unknown_s = self._measured(timeline, step)
            self._count_unknown(unknown_s)
            if step.stamp_ns - self._delay_ns > timeline.end_ns:
                while self._beyond and step.stamp_ns - self._beyond[0][0].stamp_ns > AGAIN_NS:
                    self._beyond.popleft()
                self._beyond.append((step, unknown_s))
                self._read_ns = timeline.end_ns
        self._taken[step] = measured
        return measured

    def _measured(self, timeline: TwistTimeline, step: Step) -> tuple[MotionMeasurement, float]:
        """Motion of a step, and the time [s] of it without knowledge."""
        motion, cov, unknown_s = self._integrate(timeline, step.start_ns, step.stamp_ns)
        start_ns, end_ns = step.start_ns - self._delay_ns, step.stamp_ns - self._delay_ns
        within = timeline.variance_within(start_ns, end_ns, bool(step.sightings or step.sensed))
        return MotionMeasurement("wheels", step.start_ns, step.stamp_ns, motion, cov, end_variance=within), unknown_s

    def _count_unknown(self, seconds: float, sign: int = 1) -> None:
        if seconds > 0.0:
            self.unknown_steps += sign
            self.unknown_s += sign * seconds

    def _measure_again(self, timeline: TwistTimeline) -> None:
        """Measure the steps that ended in a silence again, once a reading has come that tells the motion in it."""
        if not self._beyond or timeline.end_ns <= self._read_ns:
            return
        beyond, self._beyond = self._beyond, deque()
        if not any(unknown_s for _, unknown_s in beyond):
            return
        again = [(step, *self._measured(timeline, step)) for step, _ in beyond]
        if sum(unknown_s for *_, unknown_s in again) >= sum(unknown_s for _, unknown_s in beyond):
            return
        for (step, measured, now_s), (_, before_s) in zip(again, beyond, strict=True):
            self._taken[step] = measured
            self._count_unknown(before_s, -1)
            self._count_unknown(now_s)
            self.measured_again.append(step)

    def motion_between(self, step: Step, from_ns: int, to_ns: int) -> tuple[FloatArray, FloatArray]:
        """Motion between two times near the step, forwards or backwards.

        Args:
            step: the newest step.
            from_ns: up to 30 s before the step's end; earlier, nothing is known.
            to_ns: likewise.

        Returns:
            ``T_from_to`` ``(3,)`` and its right-perturbation covariance ``(3, 3)``.
        """
        if step not in self._taken:
            self._ingest(step)
        timeline = self._active(step) if self._tracks else TwistTimeline()
        motion, cov, _ = self._integrate(timeline, min(from_ns, to_ns), max(from_ns, to_ns))
        if from_ns <= to_ns:
            return motion, cov
        ad = se2.adjoint(motion)
        return se2.inverse(motion), np.asarray(ad @ cov @ ad.T)

    def twist(self, step: Step, at_ns: int) -> FloatArray:
        """Twist ``(3,)`` of the base [m/s, m/s, rad/s] at a time near the step's end: the mean over 40 ms around it."""
        return mean_twist(partial(self.motion_between, step), at_ns)

    def derivatives(
        self,
        step: Step,
        m: MotionMeasurement,
        wanted: Container[str] = (),
        rates: tuple[float, FloatArray] | None = None,
    ) -> dict[str, FloatArray]:
        """Derivatives ``(3,)`` of a step's motion (right perturbation) by the parameters of the wheels.

        Args:
            step: its events.
            m: the motion, as the wheels report it or another source of less noise.
            wanted: those of the clock only where they are wanted.
            rates: weight of another source and its yaw rates ``(2,)`` [rad/s] at start and end of the step.
        """
        config = self._config
        rho_x, rho_y, phi = se2.log(m.motion)
        by_turn = np.array([-0.5 * rho_y, 0.5 * rho_x, 1.0])
        # Slowdown lowers the speed by the reported turning
        commanded = abs(phi) / max((m.stamp_ns - m.start_ns) * 1e-9, 1e-3) / config.scale_omega
        slower = -commanded * rho_x / max(1.0 - config.slowdown * commanded, _SLOWEST)
        by = {
            "wheels.radius": np.array([rho_x, rho_y, phi]),
            "wheels.track": -phi * by_turn,
            "wheels.yaw_per_m": rho_x * by_turn,
            "wheels.slowdown": np.array([slower, 0.0, 0.0]),
        }
        if any(name in wanted for name in OF_CLOCK):
            start, end = self.twist(step, step.start_ns), self.twist(step, step.stamp_ns)
            if rates is not None:
                weight, (first, last) = rates
                start[2] += weight * (first - start[2])
                end[2] += weight * (last - end[2])
            change = end - se2.adjoint(se2.inverse(m.motion)) @ start  # by it a wrong clock shows
            by |= {"wheels.time_offset_s": change, "wheels.delay_s": -change}
        drive = config.drive
        if drive is not None and self.source == "ticks":
            names = tuple(drive.states)
            start_ns, end_ns = step.start_ns - self._delay_ns, step.stamp_ns - self._delay_ns
            D = self._active(step).sensitivity(start_ns, end_ns, len(names))
            by |= {f"{DRIVE}{name}": D[:, i] for i, name in enumerate(names)}
        return by

    def _integrate(self, timeline: TwistTimeline, start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray, float]:
        span = start_ns - self._delay_ns, end_ns - self._delay_ns
        return timeline.integrate(*span, self._config.noise, self.turn_known)

    def _ingest(self, step: Step) -> None:
        if step.segment != self._segment:
            for track in self._tracks:
                track.reset()
            self._segment = step.segment
            self._beyond.clear()
        for track in self._tracks:
            track.ingest(step)

    def _active(self, step: Step) -> TwistTimeline:
        """The best source with messages before the step's end, else the best with any."""
        active = [track for track in self._tracks if track.timeline.start_ns is not None]
        for track in active:
            start = track.timeline.start_ns
            if start is not None and start < step.stamp_ns - self._delay_ns:
                if track is not self._tracks[-1]:  # worse ones are not needed any more
                    self._tracks = self._tracks[: self._tracks.index(track) + 1]
                self.source = track.kind
                return track.timeline
        return (active or self._tracks)[0].timeline


_NAMES = {
    "ticks": "wheel angles",
    "odometry": "the odometry",
    "command": "commands, which stand in for wheels",
}
