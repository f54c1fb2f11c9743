"""Three plain pipelines, as a good engineer writes them in an afternoon: what `benchmarks.installed` compares with.

All of them keep ten seconds of poses in iSAM2 (``IncrementalFixedLagSmoother``), join them with the wheels' way and the
gyro's turn at constant noise, and take the map, the camera and ``robot.yaml`` as they are believed:

- ``marker_poses``: each marker's pose (IPPE, the lower reprojection error) says where the robot is;
- ``corners``: each marker's four corners are reprojected;
- ``corners_rules``: the same with three rules: a gate in pixels; wheels that the gyro contradicts are dropped for the
  step; a new start from the markers after a few images of which none was accepted.

The constants are the best of a small grid on validation recordings with perfect installation (seeds 41 and 42: without
failure, on patches, with 30 s of darkness, with 30 % of wrong ids, with a moved marker, with a dead encoder; the least
geometric mean of the ATE); no other recording was looked at. Robots stand at the start, which tells the gyro's bias.
Steps are those that fgloc cuts, so that all give their poses at the same times; the pipelines share its reading of the
wheel angles and its poses from single markers, and no other part.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import gtsam
import numpy as np

from fgloc import se2
from fgloc.config import WheelsConfig
from fgloc.sensors.cameras import marker_pose_candidates, pinhole, undistort_points
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Camera, Estimate, FloatArray, LandmarkMap, Step

Pipeline = Literal["marker_poses", "corners", "corners_rules"]
PIPELINES: tuple[Pipeline, ...] = ("marker_poses", "corners", "corners_rules")
_ERRORS = (RuntimeError, IndexError, ValueError)  # GTSAM's
_SAME_TIME_NS = 1_000_000
_MIN_DEPTH_M = 0.05
_STANDS_M, _STANDS_RAD = 1e-4, 1e-4  # of wheel motion in a step: the gyro then shows its bias
_CAP_PX = 50.0  # a marker that disagrees with a start by more counts as this much


@dataclass(frozen=True, slots=True)
class Constants:
    """Sigmas and rules. Those of the motion are of a step, a fifth of a second."""

    lag_s: float = 10.0
    motion_m: float = 0.003
    motion_rad: float = 0.003
    corner_px: float = 0.5
    pose_m: float = 0.02
    pose_rad: float = 0.02
    cauchy: float = 1.0  # in sigmas
    start_m: float = 0.3
    start_rad: float = 0.3
    gate_px: float = 20.0  # rule 1
    turn_rad: float = 0.03  # rule 2: wheels and gyro differ by more in a step
    unknown_m: float = 0.1  # motion of a step without wheels
    patience: int = 5  # rule 3: images without an accepted marker


TUNED: dict[Pipeline, Constants] = {
    "marker_poses": Constants(),
    "corners": Constants(motion_m=0.02, motion_rad=0.001, corner_px=0.2),  # so loose that wheels may slip
    "corners_rules": Constants(),
}


class Textbook:
    """One of the pipelines, fed with steps."""

    def __init__(
        self,
        pipeline: Pipeline,
        landmarks: LandmarkMap,
        camera: Camera,
        wheels: WheelsConfig,
        constants: Constants | None = None,
    ) -> None:
        """Take what the installer believes."""
        self._pipeline = pipeline
        self._constants = c = constants or TUNED[pipeline]
        self._landmarks = landmarks.landmarks
        self._camera, self._pinhole = camera, pinhole(camera)
        K, D = self._pinhole.K, np.concatenate([self._pinhole.D, np.zeros(4)])[:4]
        self._calibration = gtsam.Cal3DS2(K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2], *D)
        self._bTc = gtsam.Pose3(camera.T_base_cam)
        self._wheels = WheelMotion(wheels)
        kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(c.cauchy)
        self._corner_noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, c.corner_px))
        self._pose_noise = gtsam.noiseModel.Robust.Create(kernel, _diagonal(c.pose_m, c.pose_rad))
        self._wheel_noise = _diagonal(c.motion_m, c.motion_rad)
        self._weak_noise = _diagonal(c.unknown_m, c.motion_rad)
        self._start_noise = _diagonal(c.start_m, c.start_rad)
        self._bias = 0.0
        self._misses = 0
        self._k = 0
        self._pose: FloatArray | None = None
        self._segment = -1
        self._smoother = self._new_smoother()

    def update(self, step: Step) -> Estimate | None:
        """The pose after a step; None before the first image with markers."""
        motion, noise = self._motion(step)
        seen = self._seen(step)
        if step.segment != self._segment:
            self._segment, self._pose = step.segment, None
        if self._pose is None:
            return self._start(step, seen)
        predicted = se2.compose(self._pose, motion)
        used = [s for s in seen if self._accepted(s, predicted)]
        self._misses = 0 if used else self._misses + bool(seen)
        if self._pipeline == "corners_rules" and self._misses >= self._constants.patience:
            return self._start(step, seen)
        self._k += 1
        between = gtsam.BetweenFactorPose2(self._k - 1, self._k, gtsam.Pose2(*motion), noise)
        return self._solve(step, predicted, [between, *self._sighting_factors(used)])

    def run(self, steps: Iterable[Step]) -> list[Estimate]:
        """All poses of a recording."""
        return [estimate for step in steps if (estimate := self.update(step)) is not None]

    # --- motion ---

    def _motion(self, step: Step) -> tuple[FloatArray, gtsam.noiseModel.Base]:
        """The wheels' way and the gyro's turn. Rule 2: where the two disagree, the way counts for nothing."""
        measured = self._wheels.measure(step)
        motion = np.zeros(3) if measured is None else measured.motion
        turn = self._turn(step, motion)
        if turn is None:
            return motion, self._wheel_noise
        disagree = self._pipeline == "corners_rules" and abs(turn - motion[2]) > self._constants.turn_rad
        return np.array([motion[0], motion[1], turn]), self._weak_noise if disagree else self._wheel_noise

    def _turn(self, step: Step, wheels: FloatArray) -> float | None:
        """The gyro's turn; its bias is what it says while the wheels stand."""
        rates = [e.angular_velocity[2] for e in step.inertial if step.start_ns <= e.stamp_ns <= step.stamp_ns]
        if not rates:
            return None
        rate = float(np.mean(rates))
        if math.hypot(wheels[0], wheels[1]) < _STANDS_M and abs(wheels[2]) < _STANDS_RAD and abs(rate) < 0.05:
            self._bias += 0.2 * (rate - self._bias)
        return (rate - self._bias) * step.dt

    # --- sightings ---

    def _seen(self, step: Step) -> list[MarkerCorners]:
        """Markers of the map in the image at the step's end, their corners as the pinhole camera has them."""
        events = [e for e in step.sightings if isinstance(e, CornersEvent)]
        now = [e for e in events if abs(e.stamp_ns - step.stamp_ns) < _SAME_TIME_NS]
        return [
            replace(s, corners_px=undistort_points(self._camera, s.corners_px))
            for e in now
            for s in e.sightings
            if s.landmark_id in self._landmarks
        ]

    def _reprojection(self, seen: MarkerCorners, pose: FloatArray) -> float:
        """Mean distance [px] of the corners from where they are expected; infinite behind the camera."""
        x, y, yaw = pose
        T_map_base = np.eye(4)
        T_map_base[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        T_map_base[:2, 3] = x, y
        T = np.linalg.inv(T_map_base @ self._camera.T_base_cam)
        points = self._landmarks[seen.landmark_id].corners() @ T[:3, :3].T + T[:3, 3]
        if points[:, 2].min() < _MIN_DEPTH_M:
            return math.inf
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self._pinhole.K, self._pinhole.D)[0][:, 0]
        return float(np.hypot(*(pixels - seen.corners_px).T).mean())

    def _accepted(self, seen: MarkerCorners, predicted: FloatArray) -> bool:
        """Whether rule 1 accepts a marker; without the rule, whether the marker can be projected."""
        if self._pipeline == "marker_poses":
            return True
        error = self._reprojection(seen, predicted)
        return error < (self._constants.gate_px if self._pipeline == "corners_rules" else math.inf)

    def _sighting_factors(self, used: Sequence[MarkerCorners]) -> list[gtsam.NonlinearFactor]:
        if self._pipeline == "marker_poses":
            poses = [pose for s in used for pose in self._poses_from(s)[:1]]
            return [gtsam.PriorFactorPose2(self._k, gtsam.Pose2(*pose), self._pose_noise) for pose in poses]
        return [
            gtsam.PlanarProjectionFactor1(self._k, corner, pixel, self._bTc, self._calibration, self._corner_noise)
            for s in used
            for corner, pixel in zip(self._landmarks[s.landmark_id].corners(), s.corners_px, strict=True)
        ]

    def _poses_from(self, seen: MarkerCorners) -> list[FloatArray]:
        """Poses of the base by one marker, flattened; that of the lower reprojection error first."""
        landmark = self._landmarks[seen.landmark_id]
        T_map_marker = np.eye(4)
        T_map_marker[:3, :3], T_map_marker[:3, 3] = landmark.rotation, landmark.position
        found = []
        for T_cam_marker, _ in marker_pose_candidates(self._pinhole, seen.corners_px, landmark.size_m):
            T = T_map_marker @ np.linalg.inv(self._camera.T_base_cam @ T_cam_marker)
            found.append(np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])]))
        return found

    # --- the graph ---

    def _start(self, step: Step, seen: Sequence[MarkerCorners]) -> Estimate | None:
        """Begin at the pose by one marker that fits all markers of the image best."""
        candidates = [pose for s in seen for pose in self._poses_from(s)]
        if not candidates:
            return None
        costs = [sum(min(self._reprojection(s, pose), _CAP_PX) for s in seen) for pose in candidates]
        pose = candidates[int(np.argmin(costs))]
        self._smoother, self._k, self._misses = self._new_smoother(), self._k + 1, 0
        used = [s for s in seen if self._accepted(s, pose)]
        prior = gtsam.PriorFactorPose2(self._k, gtsam.Pose2(*pose), self._start_noise)
        return self._solve(step, pose, [prior, *self._sighting_factors(used)])

    def _solve(self, step: Step, initial: FloatArray, factors: Sequence[gtsam.NonlinearFactor]) -> Estimate | None:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for factor in factors:
            graph.add(factor)
        values.insert(self._k, gtsam.Pose2(*initial))
        try:
            self._smoother.update(graph, values, {self._k: step.stamp_ns * 1e-9})
            pose = self._smoother.calculateEstimatePose2(self._k)
            cov = np.asarray(self._smoother.marginalCovariance(self._k))
        except _ERRORS:  # the smoother is of no more use: begin again with the next markers
            self._pose = None
            return None
        self._pose = np.array([pose.x(), pose.y(), pose.theta()])
        return Estimate(step.stamp_ns, self._pose, se2.rotate_cov(cov, pose.theta()))

    def _new_smoother(self) -> gtsam.IncrementalFixedLagSmoother:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.setRelinearizeThreshold(0.001)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        return gtsam.IncrementalFixedLagSmoother(self._constants.lag_s, params)


def _diagonal(metres: float, radians: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([metres, metres, radians]))
