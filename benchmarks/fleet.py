"""Robots in a hall, as events: hours of driving with failures in minutes, for `benchmarks.integrity`.

Motion is kinematic and corners are projected: no physics, no pictures. A robot drives rounds of 10 m by 6 m among 40
markers on the walls, seen twice a second; odometry at 10 Hz, gyro at 20 Hz,
and a keyframe for each image, so that an hour takes a minute. What is installed, surveyed and set
is off by draws from the prior sigmas of the configuration, times `Drive.factor`. Nothing is read from a file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.live import START_NS, run_of
from fgloc import se2
from fgloc.config import Config, config_of
from fgloc.frames import yaw_quaternion
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Camera, Estimate, Event, FloatArray, Landmark, LandmarkMap

CASES = ("none", "slip", "dark30", "ids30", "moved", "frozen", "onewheel", "blurred", "late", "mixed", "knocked")
_TICK_S = 0.01
_ODOMETRY, _IMU, _IMAGE = 10, 5, 50  # ticks
_HALL = (8.0, 5.0)  # m: half of its length and width
_SIZE_M, _HEIGHT_M = 0.3, 0.6
_LAP_S = 70.0
_WHEEL_NOISE, _GYRO_NOISE, _CORNER_PX = 0.02, 0.005, 0.3
_TRACK_M = 0.4
_KNOCK_M, _KNOCK_RAD = 0.03, 0.05  # sigmas of what a hard knock does to a camera, on each axis
_FAR_M, _GRAZING, _LEAST_PX = 10.0, 0.3, 10.0  # a marker is not found farther off, flatter or smaller than this
_LOOKS = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # R_base_cam of a camera that looks ahead
_EPISODES: dict[str, tuple[float, float, float]] = {  # s: from one beginning to the next, shortest, longest
    "slip": (20.0, 0.3, 1.5),
    "dark30": (120.0, 30.0, 30.0),
    "frozen": (90.0, 5.0, 15.0),
    "onewheel": (90.0, 5.0, 15.0),
    "blurred": (60.0, 10.0, 20.0),
}
_MIXED = ("slip", "dark30", "frozen", "onewheel", "blurred")


@dataclass(frozen=True)
class Drive:
    """One robot's drive.

    Attributes:
        case: of `CASES`.
        seed: of all that is random.
        factor: on the prior sigmas from which the installation is drawn.
        seconds: length.
    """

    case: str
    seed: int
    factor: float
    seconds: float

    @property
    def config(self) -> Config:
        """Settings: defaults but for the noise of these wheels."""
        return config_of(
            {
                "wheels": {"source": "twist"},
                "keyframes": {"max_interval_s": 0.5},
                "integrity": {"alert_m": 0.1, "alert_yaw_rad": math.radians(2.0)},
            }
        )

    @cached_property
    def truth(self) -> FloatArray:
        """True x, y, yaw, speed and yaw rate ``(n, 5)`` at each tick."""
        rng = np.random.default_rng([self.seed, 1])
        t = np.arange(round(self.seconds / _TICK_S) + 1) * _TICK_S
        w, p = math.tau / _LAP_S, rng.uniform(0.0, math.tau, 4)
        x = 4.2 * np.cos(w * t) + 0.7 * np.cos(3.0 * w * t + p[0]) + 0.6 * np.cos(0.37 * w * t + p[1])
        y = 2.4 * np.sin(w * t) + 0.5 * np.sin(2.0 * w * t + p[2]) + 0.4 * np.cos(0.29 * w * t + p[3])
        if rng.random() < 0.5:
            y = -y
        dx, dy = np.gradient(x, t), np.gradient(y, t)
        yaw = np.unwrap(np.arctan2(dy, dx))
        return np.column_stack([x, y, yaw, np.hypot(dx, dy), np.gradient(yaw, t)])

    @cached_property
    def landmarks(self) -> LandmarkMap:
        """The map as it was surveyed."""
        length, width = _HALL
        around = np.linspace(0.0, 4.0 * (length + width), 40, endpoint=False)
        return LandmarkMap({i: _on_wall(i, float(at)) for i, at in enumerate(around)})

    @cached_property
    def true_landmarks(self) -> dict[int, Landmark]:
        """Where the markers are in truth."""
        rng, config = np.random.default_rng([self.seed, 2]), self.config
        place, turn = self.factor * config.map.position_sigma_m, self.factor * config.map.rotation_sigma_rad
        true = {}
        for i, one in self.landmarks.landmarks.items():
            R = one.rotation @ Rotation.from_rotvec(rng.normal(0.0, turn, 3)).as_matrix()
            true[i] = replace(one, position=one.position + rng.normal(0.0, place, 3), rotation=R)
        if self.case in ("moved", "mixed"):
            for i in rng.choice(len(true), 2, replace=False).tolist():
                along = rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 1.0)  # along its wall
                moved = true[i].position + along * true[i].rotation[:, 0]
                true[i] = replace(true[i], position=moved)
        return true

    @property
    def camera(self) -> Camera:
        """The camera as it is configured."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = _LOOKS, (0.1, 0.0, 0.3)
        K = np.array([[420.0, 0.0, 320.0], [0.0, 420.0, 240.0], [0.0, 0.0, 1.0]])
        return Camera(640, 480, "plumb_bob", K, np.zeros(4), T)

    def _spans(self, case: str, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Ticks ``(n,)`` at which a failure of a kind lasts."""
        every, least, most = _EPISODES[case]
        lasts = np.zeros(len(self.truth), dtype=np.bool_)
        at = rng.uniform(20.0, 20.0 + every)
        while at < self.seconds:
            end = at + rng.uniform(least, most)
            lasts[round(at / _TICK_S) : round(end / _TICK_S)] = True
            at = end + rng.exponential(every)
        return lasts

    def events(self) -> Iterator[Event]:
        """All events in their order."""
        rng = np.random.default_rng([self.seed, 3])
        told = {"mixed": _MIXED, "knocked": ("dark30",)}.get(self.case, (self.case,) if self.case in _EPISODES else ())
        fails = {case: self._spans(case, rng) for case in told}
        nowhere = np.zeros(len(self.truth), dtype=np.bool_)
        dark, blurred = fails.get("dark30", nowhere), fails.get("blurred", nowhere)
        bias = rng.normal(0.0, self.factor * self.config.gyro.bias_sigma)
        gain = 1.0 + rng.normal(0.0, self.factor * self.config.gyro.scale_sigma)
        seen = _Eye(self, rng)
        wheels = self._wheels(fails, rng)
        odometry = np.zeros(3)
        for tick in range(len(self.truth)):
            stamp = START_NS + round(tick * _TICK_S * 1e9)
            if tick % _IMU == 0:
                rate = gain * self.truth[tick, 4] + bias + rng.normal(0.0, _GYRO_NOISE)
                force = np.array([0.0, 0.0, 9.81])
                yield ImuEvent(stamp, stamp, "/imu", "base_link", np.array([0.0, 0.0, rate]), force, np.zeros((3, 3)))
            if tick % _ODOMETRY == 0:
                v, omega = wheels[tick // _ODOMETRY].tolist()
                odometry = se2.compose(odometry, se2.exp(_ODOMETRY * _TICK_S * np.array([v, 0.0, omega])))
                yield _odometry(stamp, odometry, v, omega)
            if tick % _IMAGE == 0 and not dark[tick]:
                yield seen.image(tick, stamp, 4.0 if blurred[tick] else 1.0)

    def _wheels(self, fails: dict[str, NDArray[np.bool_]], rng: np.random.Generator) -> FloatArray:
        """Speed and yaw rate ``(m, 2)`` that the odometry tells."""
        config, ticks = self.config.wheels, np.arange(0, len(self.truth), _ODOMETRY)
        late = round(rng.normal(0.0, self.factor * config.time_offset_sigma_s) / _TICK_S)
        true = self.truth[np.clip(ticks - late, 0, len(self.truth) - 1)]
        v, omega = true[:, 3], true[:, 4]
        noise = _WHEEL_NOISE * np.sqrt(np.abs(v) / (_ODOMETRY * _TICK_S))
        v_told = v * (1.0 + rng.normal(0.0, self.factor * config.scale_sigma)) + noise * rng.normal(size=len(v))
        turn = 1.0 + rng.normal(0.0, self.factor * config.turn_scale_sigma)
        drift = v * rng.normal(0.0, self.factor * config.yaw_per_m_sigma)
        omega_told = omega * turn + drift + noise * rng.normal(size=len(v))
        told = np.column_stack([v_told, omega_told])
        for case, lasts in fails.items():
            own = lasts[ticks]
            starts = np.flatnonzero(own & ~np.roll(own, 1))
            for start in starts.tolist():
                end = start + int(np.argmin(np.append(own[start:], False)))
                part = told[start:end]
                if case == "slip":
                    part += [rng.uniform(-0.5, 1.0) * v[start], rng.uniform(-0.4, 0.4)]
                elif case == "frozen":
                    part[:] = told[start - 1]
                elif case == "onewheel":  # the right one reports nothing
                    left = part[:, 0] - 0.5 * _TRACK_M * part[:, 1]
                    part[:, 0], part[:, 1] = 0.5 * left, -left / _TRACK_M
        return told

    def true_pose(self, stamp_ns: int) -> FloatArray:
        """True pose ``(3,)`` at a stamp within the drive."""
        at = (stamp_ns - START_NS) * 1e-9 / _TICK_S
        i = min(int(at), len(self.truth) - 2)
        x, y, yaw = self.truth[i, :3] + (at - i) * (self.truth[i + 1, :3] - self.truth[i, :3])
        return np.array([x, y, se2.wrap(yaw)])

    def run(self) -> Iterator[tuple[Estimate, FloatArray]]:
        """Each estimate of a live run, and its error ``(3,)`` in the base's axes: along, across [m], yaw [rad]."""
        for _, estimate, _ in run_of(self.config, self.landmarks, self.events(), self.camera):
            if estimate is not None:
                yield estimate, se2.between(self.true_pose(estimate.stamp_ns), estimate.pose)


class _Eye:
    """The camera as it is in truth."""

    def __init__(self, drive: Drive, rng: np.random.Generator) -> None:
        config, nominal, f = drive.config.camera, drive.camera, drive.factor
        self._drive, self._rng = drive, rng
        self._R = (
            nominal.T_base_cam[:3, :3]
            @ Rotation.from_rotvec(rng.normal(0.0, f * config.rotation_sigma_rad, 3)).as_matrix()
        )
        self._t = nominal.T_base_cam[:3, 3] + rng.normal(0.0, f * config.position_sigma_m, 3)
        self._focal = nominal.K[0, 0] * (1.0 + rng.normal(0.0, f * config.focal_sigma))
        self._middle = nominal.K[:2, 2] + rng.normal(0.0, f * config.principal_sigma_px, 2)
        self._k = rng.normal(0.0, f * config.distortion_sigma, 2)
        late = drive.config.camera.time_offset_sigma_s
        self._late_s = float(rng.normal(0.0, f * late)) + (0.06 if drive.case == "late" else 0.0)
        self._knocked = math.inf  # tick from which on the camera looks elsewhere
        if drive.case == "knocked":
            self._knocked = float(rng.uniform(0.1, 0.9)) * len(drive.truth)
            level = rng.random() < 0.5  # then no image contradicts it
            size = rng.uniform(0.2, 1.0)
            turn, push = rng.normal(0.0, size * _KNOCK_RAD, 3), rng.normal(0.0, size * _KNOCK_M, 3)
            if level:
                turn[:2], push[2] = 0.0, 0.0
            self._turn, self._push = Rotation.from_rotvec(turn).as_matrix(), push
        held = list(drive.true_landmarks.values())
        self._ids = np.array([one.landmark_id for one in held])
        self._corners = np.array([one.corners() for one in held])  # (n, 4, 3)
        self._normals = np.array([one.rotation[:, 2] for one in held])

    def image(self, tick: int, stamp: int, noise: float) -> CornersEvent:
        """Markers found in the image of a tick; its stamp is off by as much as the clock of the camera."""
        if tick >= self._knocked:
            self._R, self._t, self._knocked = self._turn @ self._R, self._t + self._push, math.inf
        at = min(max(tick - self._late_s / _TICK_S, 0.0), len(self._drive.truth) - 1.0)
        x, y, yaw = self._drive.true_pose(START_NS + round(at * _TICK_S * 1e9))
        c, s = math.cos(yaw), math.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        eye = np.array([x, y, 0.0]) + R @ self._t
        X = (self._corners - eye) @ (R @ self._R)  # (n, 4, 3)
        depth = X[:, :, 2].min(axis=1)
        toward = eye - self._corners.mean(axis=1)
        away = np.linalg.norm(toward, axis=1)
        found = (depth > 0.2) & (away < _FAR_M) & ((toward * self._normals).sum(axis=1) > _GRAZING * away)
        rays = X[found, :, :2] / X[found, :, 2:]
        r2 = (rays**2).sum(axis=2, keepdims=True)
        pixels = self._focal * rays * (1.0 + self._k[0] * r2 + self._k[1] * r2 * r2) + self._middle
        pixels = pixels + self._rng.normal(0.0, noise * _CORNER_PX, pixels.shape)
        inside = ((pixels > 2.0) & (pixels < [638.0, 478.0])).all(axis=(1, 2))
        side = np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=2).min(axis=1)
        kept, seen = inside & (side > _LEAST_PX), []
        for i, corners in zip(self._ids[found][kept].tolist(), pixels[kept], strict=True):
            if self._drive.case in ("ids30", "mixed") and self._rng.random() < 0.3:
                i = int(self._rng.choice(self._ids[self._ids != i]))
            seen.append(MarkerCorners(i, corners))
        return CornersEvent(stamp, stamp, "/detections", "camera", tuple(seen))


def _on_wall(i: int, at: float) -> Landmark:
    """Marker on the hall's walls, so far around it [m], upright, facing inwards."""
    length, width = _HALL
    sides = ((2 * length, (-length, -width), 0.0), (2 * width, (length, -width), 0.5 * math.pi))
    sides += ((2 * length, (length, width), math.pi), (2 * width, (-length, width), -0.5 * math.pi))
    for extent, (x, y), yaw in sides:
        if at < extent:
            place = np.array([x + at * math.cos(yaw), y + at * math.sin(yaw), _HEIGHT_M + 0.25 * (i % 3 - 1)])
            inwards = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
            up = np.array([0.0, 0.0, 1.0])
            return Landmark(i, place, np.column_stack([np.cross(up, inwards), up, inwards]), _SIZE_M)
        at -= extent
    raise ValueError(f"{at} m beyond the hall's walls")


def _odometry(stamp: int, pose: FloatArray, v: float, omega: float) -> OdometryEvent:
    zeros = np.zeros((6, 6))
    place, turned = np.array([pose[0], pose[1], 0.0]), yaw_quaternion(float(pose[2]))
    linear, angular = np.array([v, 0.0, 0.0]), np.array([0.0, 0.0, omega])
    return OdometryEvent(stamp, stamp, "/odom", "odom", "base_link", place, turned, zeros, linear, angular, zeros)
