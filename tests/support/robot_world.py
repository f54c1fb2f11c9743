"""A robot that circles in a room of markers or beacons: its events with known noise, and the chain of a run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.estimation.localizer import Localizer
from fgloc.frames import rotation_of, yaw_quaternion
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.intake.validation import EventValidator
from fgloc.sensors.equipment import LandmarkSensor, MotionSensors, PoseSensors
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Camera, ControlEvent, Estimate, Event, Landmark, LandmarkMap

START_NS = 1_700_000_000_000_000_000
T_BASE_CAM = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.2], [0.0, 0.0, 0.0, 1.0]])
CAMERA = Camera(
    640, 480, "plumb_bob", np.array([[400.0, 0, 320], [0, 400.0, 240], [0, 0, 1]]), np.zeros(4), T_BASE_CAM, "cam"
)
SPEED, TURN = 0.4, 0.33  # a circle of 1.2 m
SIGMA_PX, SIGMA_RANGE, SIGMA_BEARING = 0.5, 0.06, 0.015
NOISE = dict(x_per_sqrt_m=0.03, y_per_sqrt_m=0.003, yaw_per_sqrt_m=0.04, xy_per_sqrt_rad=0.0, yaw_per_sqrt_rad=0.0)
SETTINGS = {
    "wheels": {"source": "twist", "noise": NOISE | {"xy_per_sqrt_s": 0.001, "yaw_per_sqrt_s": 0.001}},
    "markers": {"sigma_px": SIGMA_PX},
    "landmarks": {"range_sigma_m": SIGMA_RANGE, "bearing_sigma_rad": SIGMA_BEARING},
}


def config(**sections) -> Config:
    """The settings that fit the world's noise, with changes by section."""
    return Config.model_validate({k: SETTINGS.get(k, {}) | sections.get(k, {}) for k in {*SETTINGS, *sections}})


def standing(landmark_id: int, x: float, y: float, facing: float, size: float = 0.25) -> Landmark:
    """A marker on a wall whose face looks in the direction ``facing`` [rad]."""
    c, s = math.cos(facing), math.sin(facing)
    rotation = np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])
    return Landmark(landmark_id, np.array([x, y, 0.3]), rotation, size)


def room() -> LandmarkMap:
    """20 markers, five unevenly spread on each wall of 6 m."""
    landmarks = []
    for wall in range(4):
        for i, along in enumerate((-2.3, -1.4, -0.2, 1.1, 2.2)):
            x, y, _ = se2.compose((0.0, 0.0, wall * math.pi / 2), (3.0, along + 0.11 * wall, 0.0))
            landmarks.append(standing(5 * wall + i, x, y, wall * math.pi / 2 + math.pi))
    return LandmarkMap({m.landmark_id: m for m in landmarks}, "DICT_4X4_50")


def beacons(n: int = 7, seed: int = 3) -> LandmarkMap:
    """Points for ranges and bearings, 2.5 to 4.5 m from the middle."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, 2 * math.pi, n, endpoint=False) + rng.uniform(0.0, 0.5, n)
    places = rng.uniform(2.5, 4.5, n)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return points(places)


def points(places) -> LandmarkMap:
    """Points at ``(x, y)`` or ``(x, y, z)``, by id or in the order of their ids."""
    named = places if isinstance(places, Mapping) else dict(enumerate(places))
    return LandmarkMap({i: Landmark(i, np.array([*p, 0.0])[:3], np.eye(3), 0.0) for i, p in named.items()})


def truth_at(t: float, turned: float = 0.0) -> np.ndarray:
    """Pose ``(3,)`` at time t [s]; ``turned`` [rad] further along the circle."""
    angle = TURN * t + turned
    r = SPEED / TURN
    return np.array([r * math.sin(angle), -r * math.cos(angle), se2.wrap(angle)])


def project(pose, landmark: Landmark, tilt=(0.0, 0.0)) -> np.ndarray | None:
    """Corners ``(4, 2)`` of a marker that a camera tilted by roll and pitch sees from the front and whole, or None."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    tilted = np.eye(4)
    tilted[:3, :3] = rotation_of((*tilt, 0.0))
    T = np.array([[c, -s, 0, pose[0]], [s, c, 0, pose[1]], [0, 0, 1, 0], [0, 0, 0, 1.0]]) @ tilted @ T_BASE_CAM
    points = (landmark.corners() - T[:3, 3]) @ T[:3, :3]
    ray = landmark.position - T[:3, 3]
    if points[:, 2].min() < 0.2 or -ray @ landmark.rotation[:, 2] < 0.3 * np.linalg.norm(ray):
        return None
    pixels = points @ CAMERA.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    inside = (pixels > 0).all() and (pixels[:, 0] < 640).all() and (pixels[:, 1] < 480).all()
    return pixels if inside else None


def polar(pose, landmark: Landmark) -> tuple[float, float]:
    """Range and bearing of a landmark."""
    x, y, _ = se2.between(pose, (*landmark.position[:2], 0.0))
    return math.hypot(x, y), math.atan2(y, x)


@dataclass
class World:
    """Events of one drive: odometry at 20 Hz, commands at 10 Hz, sightings at ``rate`` Hz.

    ``blind`` are intervals [s] without sightings, ``dumb`` without motion, ``slips`` in which wheels turn five times
    as fast as the robot drives; ``kidnap_s`` is when the robot is carried to the other side of the circle; ``late_s``
    is how long sightings are on their way; ``sway_rad`` the sigma of roll and pitch in each image.
    """

    map: LandmarkMap
    seed: int = 0
    seconds: float = 20.0
    rate: int = 10
    blind: tuple[tuple[float, float], ...] = ()
    dumb: tuple[tuple[float, float], ...] = ()
    slips: tuple[tuple[float, float], ...] = ()
    sway_rad: float = 0.0
    kidnap_s: float = math.inf
    late_s: float = 0.0
    range_scale: float = 1.0  # reported over true
    bearing_bias: float = 0.0
    shown: LandmarkMap | None = None  # where the landmarks really are, if not where the map says
    start_ns: int = START_NS
    start_s: float = 0.0
    _rng: np.random.Generator = field(init=False, repr=False)

    def truth(self, stamp_ns: int) -> np.ndarray:
        """Pose at a stamp."""
        t = (stamp_ns - self.start_ns) * 1e-9 + self.start_s
        return truth_at(t, math.pi if t >= self.kidnap_s else 0.0)

    @property
    def sees_corners(self) -> bool:
        """Whether the landmarks are markers."""
        return next(iter((self.shown or self.map).landmarks.values())).size_m > 0.0

    def events(self) -> list[Event]:
        """In order of receipt."""
        self._rng = np.random.default_rng(self.seed)
        made: list[Event] = []
        for tick in range(round(self.seconds * 100)):
            t = tick * 0.01 + self.start_s
            stamp = self.start_ns + tick * 10_000_000
            if tick % 5 == 0 and not _within(t, self.dumb):
                made.append(self._odometry(stamp))
                if tick % 10 == 0:
                    made.append(ControlEvent(stamp, stamp, "/cmd_vel", SPEED, TURN))
            if tick % (100 // self.rate) == 0 and not _within(t, self.blind):
                made.append(self._sightings(stamp))
        return sorted(made, key=lambda e: e.received_ns)

    def _odometry(self, stamp: int) -> OdometryEvent:
        spread = math.sqrt(SPEED / 0.05)  # white noise of the twist that adds up to the density of the configuration
        slip = 5.0 if _within((stamp - self.start_ns) * 1e-9 + self.start_s, self.slips) else 1.0
        v = slip * SPEED + self._rng.normal(0.0, NOISE["x_per_sqrt_m"] * spread)
        omega = TURN + self._rng.normal(0.0, NOISE["yaw_per_sqrt_m"] * spread)
        x, y, yaw = self.truth(stamp)
        twist = np.array([v, 0.0, 0.0]), np.array([0.0, 0.0, omega])
        place = np.array([x, y, 0.0]), yaw_quaternion(yaw), np.zeros((6, 6))
        return OdometryEvent(stamp, stamp, "/odom", "odom", "base_link", *place, *twist, np.zeros((6, 6)))

    def _sightings(self, stamp: int) -> CornersEvent | RangeBearingEvent:
        (pose, tilt), received = self._view(stamp), stamp + round(self.late_s * 1e9)
        landmarks = (self.shown or self.map).landmarks.values()
        if self.sees_corners:
            seen = [(m.landmark_id, c) for m in landmarks if (c := project(pose, m, tilt)) is not None]
            noisy = [MarkerCorners(i, c + self._rng.normal(0.0, SIGMA_PX, (4, 2))) for i, c in seen]
            return CornersEvent(stamp, received, "/tags", "cam", tuple(noisy))
        made = []
        for i in self._rng.choice(len(landmarks), 2, replace=False):
            r, bearing = polar(pose, list(landmarks)[i])
            r = self.range_scale * r + self._rng.normal(0.0, SIGMA_RANGE)
            made.append(RangeBearing(int(i), r, bearing + self.bearing_bias + self._rng.normal(0.0, SIGMA_BEARING)))
        return RangeBearingEvent(stamp, received, "/landmarks", "base_link", tuple(made))

    def _view(self, stamp: int):
        """Pose from which the sensor looks, and roll and pitch of its camera."""
        return self.truth(stamp), self._rng.normal(0.0, self.sway_rad, 2) if self.sway_rad else (0.0, 0.0)


def _within(t: float, spans: Iterable[tuple[float, float]]) -> bool:
    return any(start <= t < end for start, end in spans)


class Chain:
    """Gate, stepper and localizer, joined as the runner joins them."""

    def __init__(self, settings: Config, landmark_map: LandmarkMap | None, keep_all=False, **motion) -> None:
        """``motion``: what `MotionSensors` has beside the wheels."""
        self.gate = EventValidator(settings.gate, None if landmark_map is None else set(landmark_map.landmarks))
        self.stepper = KeyframeBuilder(settings.keyframes, settings.gate, settings.estimator.lag_s)
        self.wheels = WheelMotion(settings.wheels)
        markers = landmark_map is not None and any(m.size_m for m in landmark_map.landmarks.values())
        sensor = LandmarkSensor(settings, landmark_map, CAMERA if markers else None, None)
        self.localizer = Localizer(
            settings, landmark_map, MotionSensors(self.wheels, **motion), PoseSensors(sensor), keep_all
        )
        self.estimates: list[Estimate] = []
        self.steps = 0

    def run(self, events: Iterable[Event]) -> list[Estimate]:
        """Take in all events; the estimates so far."""
        for event in events:
            passed = self.gate.check(event)
            if passed is not None:
                self._update(self.stepper.push(passed))
        self._update(self.stepper.flush())
        return self.estimates

    def _update(self, steps) -> None:
        for step in steps:
            self.steps += 1
            estimate = self.localizer.update(step)
            if estimate is not None:
                self.estimates.append(estimate)


def position_error(estimate: Estimate, truth) -> float:
    """Distance [m]."""
    return float(np.hypot(*(estimate.pose - truth)[:2]))


def nees(estimate: Estimate, truth) -> float:
    """Of pose and covariance in the map frame."""
    cov = se2.rotate_cov(estimate.cov, -float(estimate.pose[2]))
    error = se2.log(se2.between(estimate.pose, truth))
    return float(error @ np.linalg.solve(cov, error))
