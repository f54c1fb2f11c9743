"""A few short stretches of a recording, read before the run: images with their markers, wheel motion, gyro, truth."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from fgloc import se2
from fgloc.config import Config, Role
from fgloc.intake.validation import EventValidator, reported_bounds
from fgloc.recording.reader import Recording
from fgloc.sensors import registry
from fgloc.sensors.detection import DetectionError, Detector
from fgloc.types import (
    Event,
    FloatArray,
    InertialEvent,
    IntArray,
    LandmarkMap,
    MotionEvent,
    RawEvent,
    SightingsEvent,
    Step,
    TruthEvent,
    by_class,
)

STRETCHES = 5
STRETCH_S = 4.0  # within it wheels err by centimetres only
PERIOD_S = 12.0  # from one stretch to the next
MARGIN_S = 1.2  # wheels and gyro before and after the images, for clocks that differ
GRID_S = 0.02
_SPACING_S = 0.19  # images nearer to the one before are passed over
_PATIENCE_S = 120.0  # so long an image is waited for
_FEWEST = 8  # sightings of a stretch
_SPREAD_M = 0.4  # of the markers that they are of


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """The markers of the map in one image."""

    stamp_ns: int
    seen: tuple[Any, ...]  # sightings in pixels


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Some images, and what wheels and gyro measured meanwhile on an even grid of times.

    Attributes:
        times: ``(n,)`` of the images [s], from the first grid point.
        pictures: the images.
        wheels: ``(g, 3)`` twist times time of each grid interval, as configured.
        gyro: ``(g,)`` rotation [rad] of each grid interval; None: there is no gyro.
        start_ns: stamp of the first grid point.
    """

    times: FloatArray
    pictures: tuple[Picture, ...]
    wheels: FloatArray
    gyro: FloatArray | None
    start_ns: int


@dataclass
class Excerpt:
    """What was read.

    Attributes:
        pictures: by stretch.
        motion: odometry, joints and commands in order of receipt.
        imu, truth: likewise.
        delays: received minus stamped [s] by role.
        wheel_source: as the odometer has it, once stretches were made.
    """

    pictures: list[list[Picture]] = field(default_factory=lambda: [[] for _ in range(STRETCHES)])
    motion: list[MotionEvent] = field(default_factory=list)
    imu: list[InertialEvent] = field(default_factory=list)
    truth: list[TruthEvent] = field(default_factory=list)
    delays: dict[Role, list[float]] = field(default_factory=lambda: defaultdict(list))
    wheel_source: str = ""

    def stretches(self, config: Config, imu_up: FloatArray | None) -> list[Stretch]:
        """The stretches with motion by this configuration.

        Args:
            config: of the wheels.
            imu_up: ``(3,)`` the base's z axis in the IMU's frame; None: the gyro is not used.
        """
        made = [_stretch(self, pictures, config, imu_up) for pictures in self.pictures if len(pictures) > 3]
        return [s for s in made if s is not None]


def read_excerpt(recording: Recording, config: Config, detector: Detector | None) -> Excerpt:
    """Read the beginning of a recording: bounded work, however long it is.

    Args:
        recording: to be read from its start.
        config: bounds of what is taken.
        detector: of markers; None: the recording holds corners.
    """
    collector = ExcerptCollector(recording, config, detector)
    for event in recording.events():
        if not collector.add(event):
            break
    return collector.found


class ExcerptCollector:
    """Takes an excerpt from the events of a recording, as `read_excerpt` does.

    Attributes:
        found: the excerpt, so far.
    """

    def __init__(self, recording: Recording, config: Config, detector: Detector | None) -> None:
        """As `read_excerpt`, but nothing is read."""
        self.found = Excerpt()
        self._gate = EventValidator(reported_bounds(config))
        self._detector = detector
        self._role_of = {topic: role for role, topic in recording.roles.items()}
        self._first_image: int | None = None
        self._last_image = 0
        self._end_ns: int | None = None

    def add(self, event: Event) -> bool:
        """Take what is wanted of an event; False: it came after the excerpt's end."""
        if self._end_ns is None:
            self._end_ns = event.received_ns + round(_PATIENCE_S * 1e9)
        if event.received_ns > self._end_ns:
            return False
        role = self._role_of.get(event.topic)
        if role is not None:
            self.found.delays[role].append((event.received_ns - event.stamp_ns) * 1e-9)
        if isinstance(event, RawEvent) or (isinstance(event, SightingsEvent) and event.in_pixels):
            self._take_image(event)
        else:
            _take_motion(self.found, self._gate, event)
        return True

    def _take_image(self, event: RawEvent | SightingsEvent) -> None:
        if self._first_image is None:
            self._first_image = event.stamp_ns
            self._end_ns = event.received_ns + round(((STRETCHES - 1) * PERIOD_S + STRETCH_S + MARGIN_S + 1.0) * 1e9)
        which, within = divmod((event.stamp_ns - self._first_image) * 1e-9, PERIOD_S)
        near = event.stamp_ns - self._last_image < _SPACING_S * 1e9
        if near or not (0 <= which < STRETCHES and within < STRETCH_S):
            return
        self._last_image = event.stamp_ns
        corners = _corners(event, self._detector)
        passed = None if corners is None else self._gate.check(corners)
        if isinstance(passed, SightingsEvent):
            self.found.pictures[int(which)].append(Picture(event.stamp_ns, passed.sightings))
        elif corners is not None:
            self.found.pictures[int(which)].append(Picture(event.stamp_ns, ()))


def _take_motion(found: Excerpt, gate: EventValidator, event: Event) -> None:
    passed = gate.check(event)
    if isinstance(passed, InertialEvent):
        found.imu.append(passed)
    elif isinstance(passed, MotionEvent):
        found.motion.append(passed)
    elif isinstance(passed, TruthEvent):
        found.truth.append(passed)


def _corners(event: RawEvent | SightingsEvent, detector: Detector | None) -> SightingsEvent | None:
    if isinstance(event, SightingsEvent):
        return event
    if detector is None:
        return None
    try:
        found: SightingsEvent = detector.detect(event)
        return found
    except DetectionError:
        return None


def _stretch(excerpt: Excerpt, pictures: list[Picture], config: Config, imu_up: FloatArray | None) -> Stretch | None:
    """One stretch; None where the motion is not known throughout."""
    start_ns = pictures[0].stamp_ns - round(MARGIN_S * 1e9)
    count = int((pictures[-1].stamp_ns - start_ns) * 1e-9 / GRID_S + MARGIN_S / GRID_S) + 1
    grid = start_ns + np.arange(count + 1) * round(GRID_S * 1e9)
    wheels = wheel_increments(excerpt, config, grid)
    if wheels is None:
        return None
    gyro = None if imu_up is None else _gyro_increments(excerpt.imu, imu_up, grid)
    times = np.array([(p.stamp_ns - start_ns) * 1e-9 for p in pictures])
    return Stretch(times, tuple(pictures), wheels, gyro, start_ns)


def wheel_increments(excerpt: Excerpt, config: Config, grid: IntArray) -> FloatArray | None:
    """Twist times time ``(g, 3)`` between the stamps ``(g + 1,)``; None where too few messages were received."""
    reach = 1_000_000_000
    events = [e for e in excerpt.motion if grid[0] - reach <= e.stamp_ns <= grid[-1] + reach]
    events.sort(key=lambda e: e.stamp_ns)
    step = Step(0, 0, int(grid[0]), int(grid[-1]), by_class(events))
    wheels = registry.odometer().build(config)
    wheels.measure(step)
    if not wheels.source:
        return None
    excerpt.wheel_source = wheels.source
    motions = [wheels.motion_between(step, a, b)[0] for a, b in pairwise(grid.tolist())]
    return np.array([se2.log(m) for m in motions])


def _gyro_increments(imu: list[InertialEvent], up: FloatArray, grid: IntArray) -> FloatArray | None:
    """Rotation ``(g,)`` between the stamps; None where they are not covered."""
    stamps = np.array([e.stamp_ns for e in imu], dtype=np.int64)
    inside = (stamps >= grid[0] - 500_000_000) & (stamps <= grid[-1] + 500_000_000)
    if inside.sum() < 0.2 * len(grid):
        return None
    at = (stamps[inside] - grid[0]) * 1e-9
    rates = np.array([e.angular_velocity for e, used in zip(imu, inside, strict=True) if used]) @ up
    order = np.argsort(at, kind="stable")
    middle = (np.arange(len(grid) - 1) + 0.5) * GRID_S
    return np.asarray(np.interp(middle, at[order], rates[order]) * GRID_S)


def usable(picture: Picture, landmark_map: LandmarkMap) -> list[Any]:
    """Markers of the map that have a size and are seen once in an image: sightings in pixels."""
    times = Counter(m.landmark_id for m in picture.seen)
    known = landmark_map.landmarks
    return [
        m for m in picture.seen if times[m.landmark_id] == 1 and m.landmark_id in known and known[m.landmark_id].size_m
    ]


def tells_place(stretch: Stretch, landmark_map: LandmarkMap) -> bool:
    """Whether the markers seen in a stretch are enough, and far enough apart, to determine where the robot was."""
    ids = [m.landmark_id for p in stretch.pictures for m in usable(p, landmark_map)]
    places = np.array([landmark_map.landmarks[i].position[:2] for i in ids]).reshape(-1, 2)
    return len(ids) >= _FEWEST and float(places.var(axis=0).sum()) > _SPREAD_M**2
