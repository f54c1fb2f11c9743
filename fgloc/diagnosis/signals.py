"""Signals of a recording that measure the same quantities, collected once for the comparisons.

A prefix of the recording is read: all but the images, in bounded memory.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fgloc import se2
from fgloc.config import Config, Role, base_role, base_roles
from fgloc.frames import quaternion_yaw
from fgloc.intake.validation import EventValidator, reported_bounds
from fgloc.recording.reader import Recording
from fgloc.sensors.equipment import LandmarkSensor
from fgloc.sensors.gnss import GnssEvent
from fgloc.sensors.uwb import UwbEvent
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import (
    Camera,
    ControlEvent,
    Event,
    FloatArray,
    InertialEvent,
    IntArray,
    LandmarkMap,
    MotionEvent,
    SightingsEvent,
    Step,
    TruthEvent,
    by_class,
)

LONGEST_S = 600.0  # of a recording is looked at: enough for any convention, and bounded
_MOST_VALUES = 1_000_000  # messages, joints and sightings in all; 600 s of a busy robot are half of it
IMAGES: tuple[Role, ...] = ("image", "camera_info")
GRID_S = 0.05  # of the wheels' path
_FARTHEST = 1e9  # of a distance in any unit: more is no measurement
_SPIKE = 20.0  # times the rate that one of a hundred exceeds: more is no turn
SILENT_S = 0.6  # without a message of the wheels their motion is not known


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Landmarks in the sensor's axes: ``times (n,)`` [s], ``ids (n,)``, ``points (n, 3)`` [m].

    ``spatial``: whether a point has three measured coordinates; otherwise it lies in the sensor's plane.
    """

    times: FloatArray
    ids: IntArray
    points: FloatArray
    spatial: bool


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Motion of the base by its odometry: ``times (n,)`` [s], ``poses (n, 3)`` with a continuous yaw.

    ``gaps`` ``(n,)`` counts the silences before each time: motion between times with different counts is not known.
    ``source`` is that of the motion, as the odometer has it: "ticks", "odometry", "command"; ``by_twist``: whether it
    is an odometry's twist.
    """

    times: FloatArray
    poses: FloatArray
    gaps: IntArray
    source: str = ""
    by_twist: bool = False

    def at(self, times: FloatArray) -> FloatArray:
        """Poses ``(m, 3)`` at some times; NaN outside the path."""
        out = np.column_stack([np.interp(times, self.times, column) for column in self.poses.T])
        out[(times < self.times[0]) | (times > self.times[-1])] = np.nan
        return out

    def known(self, first: FloatArray, last: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Whether the motion between two times is known."""
        inside = (np.minimum(first, last) >= self.times[0]) & (np.maximum(first, last) <= self.times[-1])
        a = self.gaps[np.clip(np.searchsorted(self.times, first), 0, len(self.times) - 1)]
        b = self.gaps[np.clip(np.searchsorted(self.times, last), 0, len(self.times) - 1)]
        return np.asarray(inside & (a == b))

    def yaw_rate(self, times: FloatArray, half_s: float) -> FloatArray:
        """Mean yaw rate [rad/s] over ``half_s`` before and after each time."""
        yaw = np.interp(times + half_s, self.times, self.poses[:, 2])
        return np.asarray((yaw - np.interp(times - half_s, self.times, self.poses[:, 2])) / (2.0 * half_s))

    def turned(self, factor: float) -> Path:
        """The path of a robot that turns ``factor`` times as much while it travels as far."""
        yaw, before = self.poses[:, 2], np.append(self.poses[:1, 2], self.poses[:-1, 2])
        steps = np.diff(self.poses[:, 0] + 1j * self.poses[:, 1], prepend=complex(*self.poses[0, :2]))
        place = np.cumsum(steps * np.exp(1j * (factor - 1.0) * 0.5 * (yaw + before)))
        return replace(self, poses=np.column_stack([place.real, place.imag, factor * yaw]))

    @property
    def way(self) -> FloatArray:
        """Way ahead ``(n,)`` until each time [m]; what is driven backward counts negative."""
        yaw = 0.5 * (self.poses[1:, 2] + self.poses[:-1, 2])
        steps = np.diff(self.poses[:, 0] + 1j * self.poses[:, 1]) * np.exp(-1j * yaw)
        return np.append(0.0, np.cumsum(steps.real))

    @property
    def length_m(self) -> float:
        """Distance travelled."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())


def in_order(rows: Sequence[Sequence[float]]) -> FloatArray:
    """Rows ``(n, c)`` in order of their first column, the time, each time once."""
    table = np.array(rows, dtype=float)
    return table if not len(table) else np.asarray(table[np.unique(table[:, 0], return_index=True)[1]])


def turn_by(times: FloatArray, rate: FloatArray) -> FloatArray:
    """Integral ``(n,)`` of a rate over times."""
    return np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(times)))


@dataclass(eq=False)
class Signals:
    """Signals collected from a recording. Times are seconds from ``origin_ns``.

    Attributes:
        motion: events of the wheels and commands that passed the gate, in order of receipt.
        imu: rows of time, rates ``(3,)`` and specific forces ``(3,)`` as the driver reports them, whatever their unit.
        truth: rows of time, position ``(3,)`` and quaternion ``(4,)``.
        seen: rows of time, landmark and point ``(3,)``.
        ranges: rows of time, anchor and range [m] by radio.
        positions: rows of time, east and north of the origin [m], and reported sigma [m], of GNSS; 0: none is reported.
        spatial: whether the points of ``seen`` have three measured coordinates.
        images: whether the recording has images, which are not read here.
        odometry: rows of time, x, y, yaw, and the twist's vx, vy, ω as the driver reports them, whatever their unit.
        delays: received minus stamped [s], by role; infinite where a stamp is 0.
    """

    origin_ns: int = 0
    motion: list[MotionEvent] = field(default_factory=list)
    imu: list[tuple[float, ...]] = field(default_factory=list)
    truth: list[tuple[float, ...]] = field(default_factory=list)
    true_yaw: bool = True  # whether the truth has one
    seen: list[tuple[float, ...]] = field(default_factory=list)
    ranges: list[tuple[float, int, float]] = field(default_factory=list)
    positions: list[tuple[float, ...]] = field(default_factory=list)
    odometry: list[tuple[float, ...]] = field(default_factory=list)
    spatial: bool = False
    images: bool = False
    delays: dict[Role, list[float]] = field(default_factory=lambda: defaultdict(list))

    def late_s(self) -> dict[Role, float]:
        """Median of received minus stamped [s] of each role with enough messages."""
        return {role: float(np.median(values)) for role, values in self.delays.items() if len(values) >= _FEWEST}

    def sightings(self) -> Sightings | None:
        """Sightings in order of time; None: there are none."""
        if not self.seen:
            return None
        rows = np.array(sorted(self.seen), dtype=float)
        return Sightings(rows[:, 0], rows[:, 1].astype(np.int64), rows[:, 2:5], self.spatial)

    def path(self, config: Config) -> Path | None:
        """Motion by the wheels as configured; None: they have too few messages."""
        wheels = WheelMotion(config.wheels)
        events = sorted(self.motion, key=lambda e: e.stamp_ns)
        moving = [e for e in events if not isinstance(e, InertialEvent)]
        if len(moving) < 10:
            return None
        stamps = np.array([e.stamp_ns for e in moving], dtype=np.int64)
        grid = np.arange(stamps[0], stamps[-1] + 1, round(GRID_S * 1e9))
        ends = np.searchsorted(stamps, grid, side="right")
        silence = np.diff(stamps, append=stamps[-1]) * 1e-9
        poses, gaps, gap = [np.zeros(3)], [0], 0
        yaw = 0.0
        for k in range(1, len(grid)):
            step = Step(k, 0, int(grid[k - 1]), int(grid[k]), by_class(moving[max(ends[k - 1] - 1, 0) : ends[k] + 1]))
            measured = wheels.measure(step)
            motion = np.zeros(3) if measured is None else measured.motion
            last = max(int(ends[k]) - 1, 0)
            if measured is None or silence[last] > SILENT_S:
                gap += 1
            pose = se2.compose(poses[-1], motion)
            yaw += float(motion[2])
            poses.append(np.array([pose[0], pose[1], yaw]))
            gaps.append(gap)
        if not wheels.source:
            return None
        times, counts = (grid - self.origin_ns) * 1e-9, np.array(gaps, dtype=np.int64)
        return Path(times, np.array(poses), counts, wheels.source, wheels.by_twist)

    def odometry_path(self) -> Path | None:
        """Motion by the odometry's poses; None: too few."""
        rows = in_order(self.odometry)
        if len(rows) < 50:
            return None
        gaps = np.cumsum(np.diff(rows[:, 0], prepend=rows[0, 0]) > SILENT_S, dtype=np.int64)
        return Path(rows[:, 0], np.column_stack([rows[:, 1:3], np.unwrap(rows[:, 3])]), gaps)

    def commanded(self, hold_s: float) -> tuple[FloatArray, FloatArray] | None:
        """Times ``(n,)`` of the commands and their integrals ``(n, 2)`` [m, rad], each held so long; None: too few."""
        rows = in_order([(e.stamp_ns, e.v, e.omega) for e in self.motion if isinstance(e, ControlEvent)])
        if len(rows) < 20:
            return None
        times = (rows[:, 0] - self.origin_ns) * 1e-9
        steps = rows[:-1, 1:] * np.minimum(np.diff(times), hold_s)[:, None]
        return times, np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    def rates(self) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Times ``(n,)``, rates and forces ``(n, 3)`` of the IMU in order of time; None: too few."""
        if len(self.imu) < 50:
            return None
        rows = in_order(self.imu)
        size = np.abs(rows[:, 1:4]).max(axis=1)
        rows = rows[size <= _SPIKE * max(float(np.quantile(size, 0.99)), 0.1)]
        return rows[:, 0], rows[:, 1:4], rows[:, 4:7]

    def true_poses(self) -> FloatArray | None:
        """Rows of time, x, y, continuous yaw of the truth, frozen repetitions left out; None: too few."""
        if len(self.truth) < 30:
            return None
        rows = in_order(self.truth)
        rows = rows[np.append(True, np.abs(np.diff(rows[:, 1:], axis=0)).max(axis=1) > 0.0)]
        if len(rows) < 30:
            return None
        yaw = np.unwrap([quaternion_yaw(q) for q in rows[:, 4:8]])
        return np.column_stack([rows[:, 0], rows[:, 1:3], yaw])


class SignalCollector:
    """Takes signals from the events of a recording, one by one."""

    def __init__(self, config: Config, roles: Mapping[Role, str] | None = None) -> None:
        """Set up the bounds of plausible signals.

        Args:
            config: with the bounds of what is plausible; distances may be in any unit.
            roles: topics, to note what passes between stamp and receipt; None: that is not noted.
        """
        self.found = Signals(images="image" in base_roles(roles or ()))
        self._origin = getattr(getattr(config, "gnss", None), "origin", None)
        self._role_of = {topic: role for role, topic in (roles or {}).items()}
        any_unit = dict.fromkeys(("max_range", "max_position"), _FARTHEST)
        self._gate = EventValidator(reported_bounds(config).model_copy(update=any_unit))
        any_speed = any_unit | dict.fromkeys(("max_speed", "max_yaw_rate", "max_wheel_rate"), _FARTHEST)
        self._fast = EventValidator(reported_bounds(config).model_copy(update=any_speed))
        self._first_ns: int | None = None
        self._values = 0
        self._delays: dict[str, int] = {}  # of the first message, by topic [ns]

    def add(self, event: Event) -> bool:
        """Store the signals of an event; False: it came after the end of the time to be read, or as too many."""
        if self._first_ns is None:
            self._first_ns = self.found.origin_ns = event.received_ns
        if event.received_ns - self._first_ns > LONGEST_S * 1e9 or self._values >= _MOST_VALUES:
            return False
        delay = event.received_ns - event.stamp_ns
        if abs(delay - self._delays.setdefault(event.topic, delay)) > LONGEST_S * 1e9:
            return True  # its clock jumped, or it never was of this time: what is compared has one grid of times
        self._values += 1
        if isinstance(event, JointsEvent):
            self._values += len(event.names)
        elif isinstance(event, SightingsEvent):
            self._values += len(event.sightings)
        role = self._role_of.get(event.topic)
        if role is not None:
            late_s = (event.received_ns - event.stamp_ns) * 1e-9 if event.stamp_ns > 0 else math.inf
            self.found.delays[role].append(late_s)
        if isinstance(event, MotionEvent) and event.odometer is not None:
            row = ((event.stamp_ns - self.found.origin_ns) * 1e-9, *event.odometer.pose, *event.odometer.twist)
            if all(abs(value) <= _FARTHEST for value in row):  # nor with a NaN in it
                self.found.odometry.append(row)
        elif isinstance(event, InertialEvent):
            row = ((event.stamp_ns - self.found.origin_ns) * 1e-9, *event.angular_velocity.tolist())
            felt: list[float] = event.linear_acceleration.tolist()
            if (
                event.stamp_ns > 0
                and all(abs(v) <= _FARTHEST for v in row)
                and not any(abs(v) > _FARTHEST for v in felt)
            ):
                self.found.imu.append((*row, *felt))
            return True
        # a driver's twist has spikes; commands and angles have none, and may be in another unit
        gate = self._fast if isinstance(event, (ControlEvent, JointsEvent)) else self._gate
        passed = gate.check(event)
        if passed is None:
            return True
        at_s = (passed.stamp_ns - self.found.origin_ns) * 1e-9
        if isinstance(passed, MotionEvent):
            self.found.motion.append(passed)
        elif isinstance(passed, TruthEvent):
            self.found.true_yaw &= passed.has_yaw
            self.found.truth.append((at_s, *passed.position.tolist(), *passed.orientation.tolist()))
        elif isinstance(passed, UwbEvent):
            self.found.ranges.append((at_s, passed.anchor, passed.range_m))
        elif isinstance(passed, GnssEvent):
            if self._origin is not None and (place := passed.near(self._origin)) is not None:
                self.found.positions.append((at_s, *place.tolist(), math.sqrt(max(0.5 * np.trace(passed.cov), 0.0))))
        elif isinstance(passed, SightingsEvent) and not passed.in_pixels:
            self.found.seen.extend(self._points(passed, at_s))
        return True

    def _points(self, event: SightingsEvent, at_s: float) -> Iterator[tuple[float, ...]]:
        for sighting in event.sightings:
            place = sighting.place()
            if place is not None:
                self.found.spatial = True
                yield (at_s, float(sighting.landmark_id), *place.tolist())
                continue
            distance, bearing = sighting.distance(), getattr(sighting, "bearing_rad", None)
            if distance is not None and bearing is not None:
                x, y = distance * math.cos(bearing), distance * math.sin(bearing)
                yield (at_s, float(sighting.landmark_id), x, y, 0.0)


def read_signals(recording: Recording, config: Config) -> Signals:
    """Signals of a recording's beginning, without its images."""
    collector = SignalCollector(config, recording.roles)
    take(recording, [role for role in recording.roles if base_role(role) not in IMAGES], collector.add)
    return collector.found


def take(recording: Recording, roles: Collection[Role], add: Callable[[Event], bool]) -> None:
    """Pass the events of some roles to a collector, until it wants no more of them."""
    role_of = {topic: role for topic, role in recording.role_of.items() if role in roles}
    for message in recording.messages(role_of.keys()):
        if not all(map(add, recording.decode(message, role_of[message[0]]))):
            return


# --- Stamps of another clock ------------------------------------------------------------------------------------------

_OTHER_CLOCK_S = 5.0  # no driver takes so long: stamps that differ more from the receive times are of another clock
_FEWEST = 5  # messages of a role


def other_clocks(delays: Mapping[Role, float]) -> tuple[Role, ...]:
    """Roles whose stamps are of another clock than most, or not set.

    Args:
        delays: received minus stamped [s], by role, infinite where stamps are 0; of two roles either may be of another
            clock, and none is named.
    """
    usual = _usual(delays) if len(delays) > 2 else math.nan
    return tuple(sorted(role for role, d in delays.items() if math.isinf(d) or abs(d - usual) > _OTHER_CLOCK_S))


def _usual(delays: Mapping[Role, float]) -> float:
    """Median of those delays that are finite; NaN: none is."""
    return float(np.median([d for d in delays.values() if math.isfinite(d)] or [math.nan]))


def clock_sentence(roles: Sequence[Role], delays: Mapping[Role, float], given: Sequence[Role]) -> str:
    """Sentence on roles whose stamps are of another clock; ``given``: those that the configuration lists already."""
    usual = _usual({role: delay for role, delay in delays.items() if role not in roles})
    sentence = " and ".join(
        f"those of {role} are not set"
        if math.isinf(late)
        else f"those of {role} are {abs(late - usual):.4g} s {'behind' if late > usual else 'ahead'}"
        for role, late in ((role, delays[role]) for role in roles)
    )
    line = f"recording.received_stamps: [{', '.join([*given, *roles])}]"
    return f"Some stamps are of another clock ({sentence}): set {line}."


# --- Sightings of any kind as points ----------------------------------------------------------------------------------

_FLOOR_RAD, _FLOOR_M, _FLOOR_SHARE = 0.01, 0.02, 0.01  # what wheels err over a window, whatever the sensor's noise


@dataclass(frozen=True, slots=True, eq=False)
class RelativeSighting:
    """One sighting: landmark, place in the sensor's axes ``(3,)``, noise of bearing [rad] and range [m]."""

    landmark_id: int
    point: FloatArray
    sigma_rad: float
    sigma_m: float


class SightingCollector:
    """Turns sightings events into places in the sensor's own axes."""

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | None,
        cameras: Sequence[Camera],
        T_base_sensor: FloatArray | None,
        place: FloatArray,
    ) -> None:
        """Set up for the sightings that a `LandmarkSensor` measures; ``place (4, 4)`` has the axes asked for."""
        self._config, self._map, self._place = config, landmark_map, place
        self._sensor = LandmarkSensor(config, landmark_map, cameras, T_base_sensor)  # what it rejects does not count

    def sightings(self, event: SightingsEvent) -> Iterator[RelativeSighting]:
        """Place and noise of each landmark of a sightings event, in the sensor's axes."""
        if event.in_pixels and self._map is None and self._config.markers.default_size_m is None:
            return
        for m in self._sensor.measure(event):
            landmark = None if self._map is None else self._map.landmarks[m.landmark_id]
            found = m.relative(landmark, self._place)
            if found is None:
                continue
            point, sigma_rad, sigma_m = found
            distance = float(np.linalg.norm(point))
            floor_m = _FLOOR_M + _FLOOR_SHARE * distance
            sigmas = math.hypot(sigma_rad, _FLOOR_RAD), math.hypot(sigma_m, floor_m)
            yield RelativeSighting(m.landmark_id, point, *sigmas)
