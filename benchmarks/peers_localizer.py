"""What a user of robot_localization would build around it for a robot with markers, for `benchmarks.peers`.

Wheel twist, the gyro's yaw rate (less its bias while the robot stands), and poses from the images: of each marker alone
(``marker_poses``: IPPE, the lower reprojection error), or of all markers of an image at once (``pnp``: RANSAC, then
least squares on the inliers). Settings are the best, axis by axis, of small grids on validation recordings as installed
(`python -m benchmarks.peers --tune`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from benchmarks.peers_filter import V_YAW, VX, YAW, Measurements, X, Y, run_filter
from fgloc.sensors.cameras import pinhole, undistort_points
from fgloc.sensors.gyro.events import ImuEvent
from fgloc.sensors.markers.events import CornersEvent, MarkerCorners
from fgloc.sensors.pnp import marker_pose_candidates
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Camera, Estimate, FloatArray, LandmarkMap, Step

Kind = Literal["marker_poses", "pnp"]
KINDS: tuple[Kind, ...] = ("marker_poses", "pnp")
_STANDS_M_S, _STANDS_RAD_S = 1e-3, 1e-3
_RANSAC_PX, _RANSAC_ITERATIONS = 4.0, 100
_FEWEST_CORNERS = 4
_NS = 1e-9
_NEAR_M = 0.3  # sigmas of poses from nearer markers shrink no more
_NOT_USED = 1e-6  # process noise of what is zero in the plane


@dataclass(frozen=True, slots=True)
class Settings:
    """Sigmas and thresholds.

    Attributes:
        noise_xy, noise_yaw, noise_v, noise_omega: process noise per root second [m, rad, m/s, rad/s].
        pose_m, pose_rad: sigma of a pose from an image at 1 m ...
        growth: ... which grows with this power of the distance of the markers.
        reject: Mahalanobis distance above which a pose is rejected; 0: none is.
        reject_twist: the same of the wheels.
        wheel_v: sigma of the wheels' speed [m/s].
        wheel_omega: sigma of the wheels' turn rate [rad/s]; 0: not used.
        gyro: sigma of the gyro's [rad/s]; 0: not used.
    """

    noise_xy: float = 0.01
    noise_yaw: float = 0.01
    noise_v: float = 0.3
    noise_omega: float = 0.5
    pose_m: float = 0.02
    pose_rad: float = 0.02
    growth: float = 1.0
    reject: float = 5.0
    reject_twist: float = 0.0
    wheel_v: float = 0.02
    wheel_omega: float = 0.0
    gyro: float = 0.01


GRID: dict[str, tuple[float, ...]] = {
    "pose_m": (0.005, 0.01, 0.02, 0.05, 0.1),
    "pose_rad": (0.005, 0.01, 0.02, 0.05, 0.1),
    "growth": (0.0, 1.0, 2.0),
    "reject": (0.0, 3.0, 5.0, 10.0),
    "wheel_v": (0.005, 0.02, 0.05, 0.1),
    "wheel_omega": (0.0, 0.05, 0.2),
    "reject_twist": (0.0, 3.0, 5.0),
    "gyro": (0.003, 0.01, 0.03, 0.0),
    "noise_v": (0.1, 0.3, 1.0),
    "noise_omega": (0.2, 0.5, 2.0),
    "noise_xy": (0.003, 0.01, 0.03),
    "noise_yaw": (0.003, 0.01, 0.03),
}
"""What is tried of each setting, in this order, twice over."""


_WHEELS, _GYRO, _POSE = range(3)  # kinds of messages


class Localizer:
    """robot_localization with poses from images, over the steps of a run. What it is fed with is made once."""

    def __init__(
        self, library: Path, kind: Kind, landmarks: LandmarkMap, camera: Camera, steps: Sequence[Step]
    ) -> None:
        """Take what the installer believes, and the run."""
        self._library, self._kind = library, kind
        self._landmarks, self._camera, self._pinhole = landmarks.landmarks, camera, pinhole(camera)
        self._bias, self._stands = 0.0, True
        rows: list[tuple[float, int, FloatArray, float]] = []  # time, kind, x y yaw or v omega, distance
        after = []
        for step in steps:
            rows += sorted(self._messages(step), key=lambda row: row[0])
            after.append(len(rows))
        first = next((i for i, row in enumerate(rows) if row[1] == _POSE), len(rows))
        rows = rows[first:]  # there is no pose before
        self._stamps = [s.stamp_ns for s, n in zip(steps, after, strict=True) if n > first]
        self._after = np.array([n - first for n in after if n > first])
        self._times, self._kinds = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
        self._values = np.array([row[2] for row in rows]).reshape(-1, 3)
        self._distances = np.array([row[3] for row in rows])

    def run(self, settings: Settings) -> list[Estimate]:
        """The pose at the end of each step, from the first image with markers on."""
        if not self._stamps:
            return []
        s, n = settings, len(self._times)
        values, variances = np.zeros((n, 15)), np.ones((n, 15))
        measured, thresholds = np.zeros((n, 15), dtype=np.int64), np.zeros(n)
        wheels, gyro, poses = (self._kinds == kind for kind in (_WHEELS, _GYRO, _POSE))
        values[np.ix_(poses, [X, Y, YAW])] = self._values[poses]
        grown = np.maximum(self._distances[poses], _NEAR_M) ** s.growth
        variances[np.ix_(poses, [X, Y, YAW])] = (np.outer(grown, [s.pose_m, s.pose_m, s.pose_rad])) ** 2
        measured[np.ix_(poses, [X, Y, YAW])], thresholds[poses] = 1, s.reject
        values[np.ix_(wheels, [VX, V_YAW])] = self._values[wheels][:, :2]
        variances[np.ix_(wheels, [VX, V_YAW])] = s.wheel_v**2, s.wheel_omega**2
        measured[wheels, VX], measured[wheels, V_YAW] = 1, s.wheel_omega > 0.0
        thresholds[wheels] = s.reject_twist
        values[gyro, V_YAW], variances[gyro, V_YAW] = self._values[gyro][:, 0], s.gyro**2
        measured[gyro, V_YAW] = s.gyro > 0.0
        thresholds[0] = 0.0
        noise = np.full(15, _NOT_USED)
        noise[[X, Y, YAW, VX, V_YAW]] = np.square([s.noise_xy, s.noise_xy, s.noise_yaw, s.noise_v, s.noise_omega])
        given = Measurements(self._times, values, variances, measured, thresholds)
        asked = np.array(self._stamps) * _NS
        found, covs = run_filter(self._library, noise, given, self._after, asked)
        return [
            Estimate(stamp, pose, 0.5 * (cov + cov.T))
            for stamp, pose, cov in zip(self._stamps, found, covs, strict=True)
        ]

    def _messages(self, step: Step) -> Iterable[tuple[float, int, FloatArray, float]]:
        """Time, kind, values and distance of everything that came in a step."""
        for e in step.of(OdometryEvent):
            self._stands = abs(e.linear[0]) < _STANDS_M_S and abs(e.angular[2]) < _STANDS_RAD_S
            yield e.stamp_ns * _NS, _WHEELS, np.array([e.linear[0], e.angular[2], 0.0]), 0.0
        for imu in step.inertial:
            yield imu.stamp_ns * _NS, _GYRO, np.array([self._rate(imu), 0.0, 0.0]), 0.0
        for event in step.sightings:
            if isinstance(event, CornersEvent):
                for pose, distance in self._poses(event):
                    yield event.stamp_ns * _NS, _POSE, pose, distance

    def _rate(self, imu: ImuEvent) -> float:
        rate = float(imu.angular_velocity[2])
        if self._stands and abs(rate) < 0.05:
            self._bias += 0.02 * (rate - self._bias)
        return rate - self._bias

    def _poses(self, event: CornersEvent) -> list[tuple[FloatArray, float]]:
        """Poses of the base that an image tells, each with the distance of the nearest marker [m]."""
        seen = [s for s in event.sightings if s.landmark_id in self._landmarks]
        if self._kind == "marker_poses":
            return [found for s in seen if (found := self._of_marker(s)) is not None]
        found = self._of_all(seen)
        return [] if found is None else [found]

    def _of_marker(self, seen: MarkerCorners) -> tuple[FloatArray, float] | None:
        landmark = self._landmarks[seen.landmark_id]
        corners = undistort_points(self._camera, seen.corners_px)
        candidates = marker_pose_candidates(self._pinhole, corners, landmark.size_m)
        if not candidates:
            return None
        T_map_marker = np.eye(4)
        T_map_marker[:3, :3], T_map_marker[:3, 3] = landmark.rotation, landmark.position
        T_cam_marker = candidates[0][0]
        T = T_map_marker @ np.linalg.inv(self._camera.T_base_cam @ T_cam_marker)
        return _planar(T), float(np.linalg.norm(T_cam_marker[:3, 3]))

    def _of_all(self, seen: Sequence[MarkerCorners]) -> tuple[FloatArray, float] | None:
        if not seen:
            return None
        points = np.concatenate([self._landmarks[s.landmark_id].corners() for s in seen])
        pixels = np.concatenate([undistort_points(self._camera, s.corners_px) for s in seen])
        cv2.setRNGSeed(0)
        good, rvec, tvec, inliers = cv2.solvePnPRansac(
            points, pixels, self._pinhole.K, self._pinhole.D, None, None, False,
            _RANSAC_ITERATIONS, _RANSAC_PX, 0.99, None, cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
        if not good or inliers is None or len(inliers) < _FEWEST_CORNERS:
            return None
        chosen = inliers[:, 0]
        rvec, tvec = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], self._pinhole.K, self._pinhole.D, rvec, tvec)
        T_cam_map = np.eye(4)
        T_cam_map[:3, :3], T_cam_map[:3, 3] = cv2.Rodrigues(rvec)[0], tvec[:, 0]
        T = np.linalg.inv(self._camera.T_base_cam @ T_cam_map)
        depths = points[chosen] @ T_cam_map[:3, :3].T + T_cam_map[:3, 3]
        return _planar(T), float(np.linalg.norm(depths, axis=1).min())


def _planar(T: FloatArray) -> FloatArray:
    return np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])
