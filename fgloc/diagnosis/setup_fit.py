"""How well a set-up of camera, map and wheels explains an excerpt of a recording: a small batch problem.

The excerpt is a few short stretches: images with their markers, wheel motion, gyro. The cost is the negative
log-likelihood of corners, wheel motion and gyro with the priors of the configuration, so that two set-ups can be
compared by their costs. Poses of the images are free; wheels and gyro tie each to the next one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from fgloc import se2
from fgloc.config import Config, base_role
from fgloc.diagnosis.signals import IMAGES, SignalCollector, Signals, take
from fgloc.graph.installation import CAMERA, Installation, installation_of
from fgloc.graph.observation import CornerBatch
from fgloc.intake.validation import EventValidator, reported_bounds
from fgloc.recording.reader import Recording
from fgloc.sensors.cameras import marker_pose_candidates, pinhole, undistort_points
from fgloc.sensors.markers.detector import Detector
from fgloc.sensors.markers.images import ImageError
from fgloc.sensors.measurements import PixelMeasurement
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import (
    Camera,
    Event,
    FloatArray,
    IntArray,
    Landmark,
    LandmarkMap,
    RawEvent,
    SightingsEvent,
    Step,
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
    """

    times: FloatArray
    pictures: tuple[Picture, ...]
    wheels: FloatArray
    gyro: FloatArray | None


@dataclass
class Excerpt:
    """Signals and pictures read from the beginning of a recording.

    Attributes:
        signals: of wheels, gyro and truth.
        pictures: by stretch.
        wheel_source: as the odometer has it, once stretches were made.
    """

    signals: Signals
    pictures: list[list[Picture]] = field(default_factory=lambda: [[] for _ in range(STRETCHES)])
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
    take(recording, [role for role in recording.roles if base_role(role) not in IMAGES], collector.add)
    if "image" in recording.roles:
        take(recording, ["image"], lambda event: collector.add(event) and not collector.pictured)
    return collector.found


class ExcerptCollector:
    """Collector of an excerpt from the events of a recording, for `read_excerpt`.

    Attributes:
        found: the excerpt, so far.
        pictured: no later image is looked at.
    """

    def __init__(self, recording: Recording, config: Config, detector: Detector | None) -> None:
        """Prepare an empty excerpt; the arguments are those of `read_excerpt`."""
        self._signals = SignalCollector(config, recording.roles)
        self.found = Excerpt(self._signals.found)
        self.pictured = False
        self._gate = EventValidator(reported_bounds(config))
        self._detector = detector
        self._first_image: int | None = None
        self._last_image = 0
        self._end_ns = recording.span_ns[0] + round(_PATIENCE_S * 1e9)

    def add(self, event: Event) -> bool:
        """Store the signals and markers of an event; False: it came after the end of the time to be read."""
        if isinstance(event, RawEvent) or (isinstance(event, SightingsEvent) and event.in_pixels):
            self._take_image(event)
        return self._signals.add(event)

    def _take_image(self, event: RawEvent | SightingsEvent) -> None:
        self.pictured |= event.received_ns > self._end_ns
        if self.pictured:
            return
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


def _corners(event: RawEvent | SightingsEvent, detector: Detector | None) -> SightingsEvent | None:
    if isinstance(event, SightingsEvent):
        return event
    if detector is None:
        return None
    try:
        found: SightingsEvent = detector.detect(event)
        return found
    except ImageError:
        return None


def _stretch(excerpt: Excerpt, pictures: list[Picture], config: Config, imu_up: FloatArray | None) -> Stretch | None:
    """One stretch; None where the motion is not known throughout."""
    start_ns = pictures[0].stamp_ns - round(MARGIN_S * 1e9)
    count = int((pictures[-1].stamp_ns - start_ns) * 1e-9 / GRID_S + MARGIN_S / GRID_S) + 1
    grid = start_ns + np.arange(count + 1) * round(GRID_S * 1e9)
    wheels = wheel_increments(excerpt, config, grid)
    if wheels is None:
        return None
    gyro = None if imu_up is None else _gyro_increments(excerpt.signals, imu_up, grid)
    times = np.array([(p.stamp_ns - start_ns) * 1e-9 for p in pictures])
    return Stretch(times, tuple(pictures), wheels, gyro)


def wheel_increments(excerpt: Excerpt, config: Config, grid: IntArray) -> FloatArray | None:
    """Twist times time ``(g, 3)`` between the stamps ``(g + 1,)``; None where too few messages were received."""
    reach = 1_000_000_000
    events = [e for e in excerpt.signals.motion if grid[0] - reach <= e.stamp_ns <= grid[-1] + reach]
    events.sort(key=lambda e: e.stamp_ns)
    step = Step(0, 0, int(grid[0]), int(grid[-1]), by_class(events))
    wheels = WheelMotion(config.wheels)
    wheels.measure(step)
    if not wheels.source:
        return None
    excerpt.wheel_source = wheels.source
    motions = [wheels.motion_between(step, a, b)[0] for a, b in pairwise(grid.tolist())]
    return np.array([se2.log(m) for m in motions])


def _gyro_increments(signals: Signals, up: FloatArray, grid: IntArray) -> FloatArray | None:
    """Rotation ``(g,)`` between the stamps; None where they are not covered."""
    rates, edges = signals.rates(), (grid - signals.origin_ns) * 1e-9
    if rates is None:
        return None
    inside = (rates[0] >= edges[0] - 0.5) & (rates[0] <= edges[-1] + 0.5)
    if inside.sum() < 0.2 * len(grid):
        return None
    middle = edges[0] + (np.arange(len(grid) - 1) + 0.5) * GRID_S
    return np.asarray(np.interp(middle, rates[0][inside], (rates[1] @ up)[inside]) * GRID_S)


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


# --- Wheel motion and gyro between the images, as functions of what they may be off by --------------------------------

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
    """Residuals of wheels and gyro between the images of all stretches."""

    def __init__(self, stretches: Sequence[Stretch], turned: FloatArray, config: Config) -> None:
        """Precompute what all poses share.

        Args:
            stretches: of the excerpt.
            turned: ``(3, 3)`` applied to the wheels' twist.
            config: noise of wheels and gyro.
        """
        self._stretches, self._turned_by = stretches, turned
        self._noise = config.wheels.noise
        self._gyro_noise = config.gyro.yaw_per_sqrt_s
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
        moved = se2.between_array(poses[i], poses[i + 1])
        x, y, turn = moved.T
        rows: list[Rows] = []
        went, sigmas, seconds = self.between(extras)
        r = moved - went
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
        noise, late = self._noise, extras[_WHEELS][3]
        motions, sigmas, spans = [], [], []
        for s in self._stretches:
            forward, turns = self._steps(s, extras)
            at, dt = s.times - late, np.diff(s.times)
            path = _along(at, forward, turns)
            ends = np.diff(path, axis=0)
            motions.append(np.column_stack([se2.turned(ends[:, :2], -path[:-1, 2]), ends[:, 2]]))
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
        s = self._stretches[k]
        return _along(s.times - extras[_WHEELS][3], *self._steps(s, extras))

    def _steps(self, s: Stretch, extras: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Way ``(g, 2)`` [m] and turn ``(g,)`` [rad] of the wheels in each grid interval."""
        radius, track, pull, _ = extras[_WHEELS]
        steps = s.wheels @ self._turned_by.T
        forward = np.exp(radius) * steps[:, :2]
        return forward, np.exp(radius - track) * steps[:, 2] + pull * forward[:, 0]

    def _by_gyro(self, late: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotation by the gyro between images ``(k,)``, its derivative by the lateness, and where there is any."""
        turned, slope, has = [], [], []
        for s in self._stretches:
            gyro, at = np.zeros(len(s.wheels)) if s.gyro is None else s.gyro, s.times - late
            turned.append(np.diff(_at(at, _summed(gyro))))
            slope.append(-np.diff(_at(at, np.append(gyro, gyro[-1]) / GRID_S)))
            has.append(np.full(len(at) - 1, s.gyro is not None))
        return np.concatenate(turned), np.concatenate(slope), np.concatenate(has)


def extra_sigmas(config: Config, has_gyro: bool) -> dict[str, float]:
    """Prior sigmas of `EXTRAS` in an ordinary installation; what can be no unknown is held."""
    wheels, camera = config.wheels, config.camera
    gyro = config.gyro
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


def _along(times: FloatArray, forward: FloatArray, turns: FloatArray) -> FloatArray:
    """Poses ``(n, 3)`` with a continuous yaw at times [s], by steps ``(g, 2)`` [m] and ``(g,)`` [rad] on the grid."""
    yaw = _summed(turns)
    x, y = se2.turned(forward, yaw[:-1] + 0.5 * turns).T
    return np.column_stack([_at(times, values) for values in (_summed(x), _summed(y), yaw)])


def _at(times: FloatArray, values: FloatArray) -> FloatArray:
    """Values of the grid points at some times [s]."""
    return np.asarray(np.interp(times, np.arange(len(values)) * GRID_S, values))


# --- The batch problem ------------------------------------------------------------------------------------------------

_SIZE, _MAP = 0, 1
_SIGMA_PX = 0.2  # px: of corners in motion, on top of the configured noise
_EXACT = 1e-6  # sigma of what is no unknown here
_KERNEL = 9.0  # squared Cauchy constant, per degree of freedom
_ITERATIONS = 12
_LEAST_INFORMATION = 1e-9  # of a pose that nothing ties down
_DONE = 1e-3  # share of the cost by which an iteration has to improve it


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """The set-up of a run, and by how much the motion is changed against the excerpt's.

    Attributes:
        turned: signs or rotation of the wheels' twist ``(3, 3)``.
        extras: ``(9,)`` values of `EXTRAS` about which the fit starts.
    """

    config: Config
    landmark_map: LandmarkMap
    camera: Camera
    turned: FloatArray = field(default_factory=lambda: np.eye(3))
    extras: FloatArray = field(default_factory=lambda: np.zeros(len(EXTRAS)))

    @property
    def values(self) -> dict[str, float]:
        """Values of `EXTRAS` by name."""
        return dict(zip(EXTRAS, self.extras.tolist(), strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well a set-up explains an excerpt.

    Attributes:
        cost: negative log-likelihood.
        costs: its part in each stretch ``(s,)``, without priors.
        misfit: median squared whitened residual of the markers, per degree of freedom; 1 is expected.
        poses: ``(n, 3)`` of the images.
        values: found value and prior sigma by name.
        markers: mean squared whitened residual of each marker, by id.
        normal: normal matrix and gradient at the solution; the last columns are those of ``values``, in order.
    """

    cost: float
    costs: FloatArray
    misfit: float
    poses: FloatArray
    values: Mapping[str, tuple[float, float]]
    markers: Mapping[int, float]
    normal: tuple[FloatArray, FloatArray]

    def gain(self, free: Mapping[str, float]) -> float:
        """By how much the cost would fall, to second order, with other prior sigmas for some values."""
        A, b = self.normal[0].copy(), self.normal[1].copy()
        first = len(b) - len(self.values)
        for k, (name, (value, sigma)) in enumerate(self.values.items(), first):
            if name in free:
                less = sigma**-2.0 - free[name] ** -2.0
                A[k, k] -= less
                b[k] -= less * value
        prior = sum(0.5 * (v / s) ** 2 - 0.5 * (v / free[n]) ** 2 for n, (v, s) in self.values.items() if n in free)
        return float(prior + 0.5 * b @ np.linalg.solve(A, b))


class Problem:
    """The stretches under one set-up."""

    def __init__(self, stretches: Sequence[Stretch], setup: Setup, free: Mapping[str, float]) -> None:
        """Precompute what all iterations share.

        Args:
            stretches: of the excerpt.
            setup: to be judged.
            free: prior sigmas, by name, that replace those of an ordinary installation.
        """
        self._stretches, self._setup = stretches, setup
        ideal = pinhole(setup.camera)
        sigma = float(np.hypot(setup.config.markers.sigma_px, _SIGMA_PX))
        self._motion = Motion(stretches, setup.turned, setup.config)
        self._corners: list[FloatArray] = []
        self._measured: list[PixelMeasurement] = []
        frames = []
        for i, picture in enumerate(p for s in stretches for p in s.pictures):
            for m in usable(picture, setup.landmark_map):
                corners = undistort_points(setup.camera, m.corners_px)
                if np.isfinite(corners).all():
                    frames.append(i)
                    self._corners.append(m.corners_px)
                    self._measured.append(PixelMeasurement(0, m.landmark_id, corners, sigma, ideal))
        self._frame: IntArray = np.array(frames, dtype=np.int64)
        self._ids = [m.landmark_id for m in self._measured]
        self._held = LandmarkMap({i: setup.landmark_map.landmarks[i] for i in sorted(set(self._ids))})
        has_gyro = any(s.gyro is not None for s in stretches)
        self._installation = _installation(setup.config, self._held, has_gyro, free)
        self._sigmas = np.array([free.get(n, s) for n, s in extra_sigmas(setup.config, has_gyro).items()])

    @property
    def sightings(self) -> int:
        """How many sightings of known markers there are."""
        return len(self._ids)

    @property
    def pairs(self) -> int:
        """How many pairs of images are tied by the motion between them."""
        return len(self._motion.pairs)

    def solve(self, poses: FloatArray | None = None, iterations: int = _ITERATIONS) -> Fit | None:
        """Levenberg–Marquardt with Cauchy weights; None if the images do not determine where the robot was.

        Args:
            poses: ``(n, 3)`` to start from; None: wheel motion is laid onto the markers.
            iterations: at most so many.
        """
        poses = self._start() if poses is None else poses
        try:
            return None if poses is None else self._descended(poses, iterations)
        except np.linalg.LinAlgError:  # numbers beyond all bounds: such a set-up explains nothing
            return None

    def _descended(self, poses: FloatArray, iterations: int) -> Fit:
        theta, extras, damping = np.zeros(len(self._installation)), self._setup.extras.copy(), 1e-6
        state = self._linearized(poses, theta, extras)
        for _ in range(iterations):
            cost, A, b = state[:3]
            step = np.asarray(
                np.linalg.solve(A + np.diag(damping * np.diag(A) + _LEAST_INFORMATION), -b), dtype=np.float64
            )
            moved = self._moved(poses, theta, extras, step)
            trial = self._linearized(*moved)
            if trial[0] < cost:
                (poses, theta, extras), state, damping = moved, trial, max(0.1 * damping, 1e-9)
                if cost - trial[0] < _DONE * cost:
                    break
            else:
                damping = max(100.0 * damping, 1e-4)
        return self._fit(poses, theta, extras, state)

    # --- the parts ---

    def _linearized(
        self, poses: FloatArray, theta: FloatArray, extras: FloatArray
    ) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Cost, normal matrix and gradient; the cost by stretch; the squared residual of each sighting."""
        n, p = len(poses), len(theta)
        size = 3 * n + p + len(EXTRAS)
        A, b = np.zeros((size, size)), np.zeros(size)
        by_stretch, stretch_of = np.zeros(len(self._stretches)), self._motion.stretch_of
        # 1. Corners
        r, J, columns = self._corner_rows(poses, theta, extras)
        squares = _add(A, b, r, J, columns, by_stretch, stretch_of[self._frame])
        # 2. Wheels and gyro
        for r, J, columns in self._motion.rows(poses, extras, 3 * n + p):
            _add(A, b, r, J, columns, by_stretch, stretch_of[self._motion.pairs])
        # 3. Priors
        information = np.concatenate([self._installation.sigmas, self._sigmas]) ** -2.0
        x = np.concatenate([theta, extras])
        A[range(3 * n, size), range(3 * n, size)] += information
        b[3 * n :] += information * x
        return float(by_stretch.sum() + 0.5 * information @ x**2), A, b, by_stretch, squares

    def _corner_rows(
        self, poses: FloatArray, theta: FloatArray, extras: FloatArray
    ) -> tuple[FloatArray, FloatArray, IntArray]:
        n, p = len(poses), len(theta)
        at = poses[self._frame]
        batch = self._batch(extras[_SIZE], extras[_MAP])
        stack = batch.evaluate(at, theta)
        larger = self._batch(extras[_SIZE] + 1e-4, extras[_MAP]).evaluate(at, theta, by_installation=False)
        by_size = (larger.residual - stack.residual) / 1e-4
        places = np.array([self._held.landmarks[i].position for i in self._ids]) * np.exp(extras[_MAP])
        by_map = np.einsum("mdk,mk->md", stack.H[:, :, 12:15], places)
        J = np.concatenate([stack.J, stack.H, by_size[:, :, None], by_map[:, :, None]], axis=2)
        own = 3 * self._frame[:, None] + np.arange(3)
        extra = np.broadcast_to(3 * n + p + np.array([_SIZE, _MAP]), (len(at), 2))
        columns = np.concatenate([own, 3 * n + stack.columns, extra], axis=1)
        return np.clip(stack.residual, -1e4, 1e4), np.clip(J, -1e7, 1e7), columns

    def _start(self) -> FloatArray | None:
        """Poses ``(n, 3)``: each stretch of wheel motion laid rigidly onto the markers that it saw."""
        T, size = self._setup.camera.T_base_cam, np.exp(self._setup.extras[_SIZE])
        base = np.full((len(self._ids), 2), np.nan)
        for k, (i, corners) in enumerate(zip(self._ids, self._corners, strict=True)):
            found = marker_pose_candidates(self._setup.camera, corners, size * self._held.landmarks[i].size_m)
            if found:
                base[k] = (T[:3, :3] @ found[0][0][:3, 3] + T[:3, 3])[:2]
        places = np.array([self._held.landmarks[i].position[:2] for i in self._ids]).reshape(-1, 2)
        poses: list[FloatArray] = []
        for k in range(len(self._stretches)):
            path, first = self._motion.path(k, self._setup.extras), len(poses)
            own = np.isfinite(base[:, 0]) & (self._frame >= first) & (self._frame < first + len(path))
            place = laid(path[self._frame[own] - first], base[own], places[own])
            if place is None:
                return None
            poses += [se2.compose(place, p) for p in path]
        return np.array(poses)

    def _batch(self, size: float, scale: float) -> CornerBatch:
        factor, stretch = np.exp(size), np.exp(scale)
        landmarks = {
            i: Landmark(i, stretch * m.position, m.rotation, factor * m.size_m) for i, m in self._held.landmarks.items()
        }
        return CornerBatch(self._measured, landmarks, self._installation)

    def _moved(
        self, poses: FloatArray, theta: FloatArray, extras: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        n, p = len(poses), len(theta)
        by = step[: 3 * n].reshape(n, 3)
        moved = poses + np.column_stack([se2.turned(by[:, :2], poses[:, 2]), by[:, 2]])
        return moved, theta + step[3 * n : 3 * n + p], extras + step[3 * n + p :]

    def _fit(
        self,
        poses: FloatArray,
        theta: FloatArray,
        extras: FloatArray,
        state: tuple[float, FloatArray, FloatArray, FloatArray, FloatArray],
    ) -> Fit:
        names = (*self._installation.names, *EXTRAS)
        sigmas = np.concatenate([self._installation.sigmas, self._sigmas])
        found = zip(np.concatenate([theta, extras]).tolist(), sigmas.tolist(), strict=True)
        per = state[4] / 8.0
        ids = np.array(self._ids)
        markers = {int(i): float(per[ids == i].mean()) for i in np.unique(ids)}
        return Fit(
            state[0],
            state[3],
            float(np.median(per)),
            poses,
            dict(zip(names, found, strict=True)),
            markers,
            (state[1], state[2]),
        )


def _installation(config: Config, held: LandmarkMap, has_gyro: bool, free: Mapping[str, float]) -> Installation:
    """Camera and markers, without clocks and wheels, which `EXTRAS` holds."""
    plain = installation_of(config, held, corners=True, has_gyro=has_gyro, most=10_000, gains=())
    sigmas = dict(zip(plain.names, plain.sigmas.tolist(), strict=True))
    camera = {f"camera.{name}": sigmas.get(f"camera.{name}", _EXACT) for name in CAMERA}
    markers = {n: s for n, s in sigmas.items() if n.startswith("map.")}
    return Installation({n: free.get(n, s) for n, s in (camera | {"camera.time_offset_s": _EXACT} | markers).items()})


def _add(
    A: FloatArray,
    b: FloatArray,
    r: FloatArray,
    J: FloatArray,
    columns: IntArray,
    costs: FloatArray,
    stretch: IntArray,
) -> FloatArray:
    """Add blocks of residuals ``(m, d)`` with Jacobians ``(m, d, c)`` and Cauchy weights; their squares ``(m,)``."""
    squares = np.asarray((r**2).sum(axis=1))
    bound = _KERNEL * r.shape[1]
    weights = 1.0 / (1.0 + squares / bound)
    np.add.at(costs, stretch, 0.5 * bound * np.log1p(squares / bound))
    weighted = J * weights[:, None, None]
    H = np.einsum("mdi,mdj->mij", weighted, J)
    np.add.at(A, (columns[:, :, None], columns[:, None, :]), H)
    np.add.at(b, columns, np.einsum("mdi,md->mi", weighted, r))
    return squares
