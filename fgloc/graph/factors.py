"""Measurements to GTSAM factors: the one place that knows both.

A known landmark enters as a unary factor; an unknown one is a variable. Motion factors are Gaussian, landmark factors
robust (Cauchy), as design.md §6 has it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from fgloc import se2
from fgloc.errors import CovarianceError, EstimatorError
from fgloc.graph.measurement_log import Sighting
from fgloc.types import (
    Camera,
    CornerMeasurement,
    FloatArray,
    Landmark,
    LandmarkMap,
    LandmarkMeasurement,
    MarkerPoseMeasurement,
    MotionMeasurement,
    RangeBearingMeasurement,
)

# Usual constants, of whitened residuals. Sources: Zhang 1997, "Parameter estimation techniques"; Agarwal et al. 2013,
# "Robust map optimization using dynamic covariance scaling".
_KERNELS = {
    "huber": gtsam.noiseModel.mEstimator.Huber.Create(1.345),
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy.Create(2.385),
    "dcs": gtsam.noiseModel.mEstimator.DCS.Create(1.0),
}
_MOST_LOOKALIKES = 10
_LOOKALIKE = 0.1  # tangent of the angle between two directions that may be of one marker, distortion left in
MIN_DEPTH_M = 0.05  # a corner nearer to the image plane than this is not projected


def pose_key(k: int) -> int:
    """Key of the pose of keyframe k."""
    return int(gtsam.symbol("x", k))


def landmark_key(landmark_id: int) -> int:
    """Key of an estimated landmark."""
    return int(gtsam.symbol("l", landmark_id))


def gaussian(cov: FloatArray) -> gtsam.noiseModel.Base:
    """Noise model of a covariance, which is checked because GTSAM does not.

    Raises:
        CovarianceError: not finite, not symmetric or not positive definite.
    """
    problem = _covariance_problem(cov)
    if problem:
        raise CovarianceError(f"{problem}: {cov.tolist()}; a measurement like this has to be rejected by the gate")
    return gtsam.noiseModel.Gaussian.Covariance(cov)


def robust(noise: gtsam.noiseModel.Base, cauchy_k: float | None) -> gtsam.noiseModel.Base:
    """Wrap a noise model in a Cauchy kernel (k in units of sigma); None leaves it Gaussian."""
    if cauchy_k is None:
        return noise
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(cauchy_k), noise)


def motion_factor(k: int, m: MotionMeasurement, kernel: str = "none") -> gtsam.NonlinearFactor:
    """Between-factor from keyframe k - 1 to k; a kernel other than "none" is put on the wheels' alone."""
    noise = gaussian(m.cov)
    if m.source == "wheels" and kernel != "none":
        noise = gtsam.noiseModel.Robust.Create(_KERNELS[kernel], noise)
    return gtsam.BetweenFactorPose2(pose_key(k - 1), pose_key(k), gtsam.Pose2(*m.motion), noise)


def prior_factor(k: int, pose: FloatArray, cov: FloatArray) -> gtsam.NonlinearFactor:
    """Prior on keyframe k; the covariance is a right perturbation's."""
    return gtsam.PriorFactorPose2(pose_key(k), gtsam.Pose2(*pose), gaussian(cov))


class LandmarkFactors:
    """Makes factors of landmark sightings, against a known map or against variables.

    Cameras and landmark corners are converted once and kept.
    """

    def __init__(self, landmark_map: LandmarkMap | None) -> None:
        self._known: Mapping[int, Landmark] | None = None if landmark_map is None else landmark_map.landmarks
        self._corners: dict[int, FloatArray] = {}
        self._cameras: dict[int, tuple[Camera, gtsam.Pose3, gtsam.Cal3DS2]] = {}
        self._corner_noises: dict[tuple[float, float | None], gtsam.noiseModel.Base] = {}

    @property
    def known(self) -> bool:
        """Whether the map is given; otherwise landmarks are variables."""
        return self._known is not None

    def map_cov(self, landmark_id: int) -> FloatArray | None:
        """Covariance ``(2, 2)`` of a known landmark's x, y; None if the map does not give it."""
        landmark = None if self._known is None else self._known.get(landmark_id)
        return None if landmark is None else landmark.cov

    def sighting(
        self,
        k: int,
        m: LandmarkMeasurement,
        cauchy_k: float | None,
        raw: LandmarkMeasurement | None = None,
        alone: LandmarkMeasurement | None = None,
    ) -> Sighting:
        """The measurement with its factors at keyframe k (and what it was before, see `Sighting`); raises as `make`."""
        return Sighting(m, raw or m, alone or raw or m, cauchy_k, tuple(self.make(k, m, cauchy_k)))

    def make(self, k: int, m: LandmarkMeasurement, cauchy_k: float | None) -> list[gtsam.NonlinearFactor]:
        """Factors of one sighting at keyframe k.

        Raises:
            EstimatorError: the landmark is not in the known map, or corners were given for an unknown map.
            CovarianceError: the measurement's covariance is not one.
        """
        if self._known is None:
            return [self._unknown(k, m, cauchy_k)]
        landmark = self._known.get(m.landmark_id)
        if landmark is None:
            raise EstimatorError(f"landmark {m.landmark_id} is not in the map ({len(self._known)} landmarks)")
        if isinstance(m, CornerMeasurement):
            return self._corner_factors(k, m, landmark, cauchy_k)
        if isinstance(m, RangeBearingMeasurement):
            point, cov = cartesian(m)
            noise = robust(gaussian(cov), cauchy_k)
            return [gtsam.KnownLandmarkFactorPose2(pose_key(k), landmark.position[:2], point, noise)]
        pose = se2.compose(landmark.planar, se2.inverse(m.pose))
        ad = se2.adjoint(m.pose)  # perturbation of T_base_marker, moved to the robot's side
        noise = robust(gaussian(_symmetric(ad @ m.cov @ ad.T)), cauchy_k)
        return [gtsam.PriorFactorPose2(pose_key(k), gtsam.Pose2(*pose), noise)]

    def near(self, landmark_id: int, displacement: FloatArray, within_m: float) -> list[int]:
        """Other known landmarks this near to where one would stand if it were displaced so ``(2,)`` in the map."""
        known = self._known or {}
        place = known[landmark_id].position[:2] + displacement
        near = (i for i, other in known.items() if math.hypot(*(other.position[:2] - place)) <= within_m)
        return [i for i in near if i != landmark_id]

    def distance(self, landmark_id: int, pose: FloatArray) -> float:
        """How far [m] a known landmark is from the base at this pose, in the plane."""
        if self._known is None:
            raise EstimatorError("the distance of a landmark needs a known map")
        x, y = self._known[landmark_id].position[:2] - pose[:2]
        return math.hypot(x, y)

    def depth(self, m: CornerMeasurement, pose: FloatArray) -> float:
        """Smallest depth [m] of the marker's corners in front of the camera, for the base at this pose."""
        if self._known is None:
            raise EstimatorError("the depth of a marker needs a known map")
        x, y, yaw = pose
        c, s = math.cos(yaw), math.sin(yaw)
        corners = self._landmark_corners(self._known[m.landmark_id])
        dx, dy = corners[:, 0] - x, corners[:, 1] - y
        base = np.column_stack([c * dx + s * dy, -s * dx + c * dy, corners[:, 2]])
        T = m.camera.T_base_cam
        return float(((base - T[:3, 3]) @ T[:3, 2]).min())

    def lookalikes(self, m: CornerMeasurement, pose: FloatArray) -> list[int]:
        """Other markers of the same size that the base at this pose sees about where this one was seen.

        None of them where they hang so densely that the place does not tell.
        """
        if self._known is None:
            raise EstimatorError("what else a marker may be needs a known map")
        size = self._known[m.landmark_id].size_m
        others = [x for i, x in self._known.items() if i != m.landmark_id and x.size_m == size]
        x, y, yaw = pose
        c, s = math.cos(yaw), math.sin(yaw)
        T, K = m.camera.T_base_cam, m.camera.K
        u, v = m.corners_px.mean(axis=0)
        found = []
        for other in others:
            dx, dy = other.position[0] - x, other.position[1] - y
            right, down, depth = T[:3, :3].T @ (
                np.array([c * dx + s * dy, -s * dx + c * dy, other.position[2]]) - T[:3, 3]
            )
            if depth < MIN_DEPTH_M:
                continue
            across = math.hypot(right / depth - (u - K[0, 2]) / K[0, 0], down / depth - (v - K[1, 2]) / K[1, 1])
            if across < _LOOKALIKE:
                found.append(other.landmark_id)
        return found if len(found) <= _MOST_LOOKALIKES else []

    def _unknown(self, k: int, m: LandmarkMeasurement, cauchy_k: float | None) -> gtsam.NonlinearFactor:
        if isinstance(m, RangeBearingMeasurement):
            noise = robust(gaussian(m.cov), cauchy_k)
            bearing = gtsam.Rot2(m.bearing_rad)
            return gtsam.BearingRangeFactor2D(pose_key(k), landmark_key(m.landmark_id), bearing, m.range_m, noise)
        if isinstance(m, MarkerPoseMeasurement):
            noise = robust(gaussian(m.cov), cauchy_k)
            measured = gtsam.Pose2(*m.pose)
            return gtsam.BetweenFactorPose2(pose_key(k), landmark_key(m.landmark_id), measured, noise)
        raise EstimatorError("marker corners need a known map: give --map, or build one with `fgloc map`")

    def _corner_factors(
        self, k: int, m: CornerMeasurement, landmark: Landmark, cauchy_k: float | None
    ) -> list[gtsam.NonlinearFactor]:
        corners = self._landmark_corners(landmark)
        bTc, calibration = self._camera(m.camera)
        noise_key = (m.sigma_px, cauchy_k)
        if noise_key not in self._corner_noises:
            self._corner_noises[noise_key] = robust(gtsam.noiseModel.Isotropic.Sigma(2, m.sigma_px), cauchy_k)
        noise, key = self._corner_noises[noise_key], pose_key(k)
        return [
            gtsam.PlanarProjectionFactor1(key, corners[i], m.corners_px[i], bTc, calibration, noise) for i in range(4)
        ]

    def _landmark_corners(self, landmark: Landmark) -> FloatArray:
        if landmark.landmark_id not in self._corners:
            self._corners[landmark.landmark_id] = landmark.corners()
        return self._corners[landmark.landmark_id]

    def _camera(self, camera: Camera) -> tuple[gtsam.Pose3, gtsam.Cal3DS2]:
        held = self._cameras.get(id(camera))
        if held is None or held[0] is not camera:
            if len(self._cameras) > 64:  # cameras moved to a keyframe (late images) come and go
                self._cameras.clear()
            K, D = camera.K, np.concatenate([camera.D, np.zeros(4)])[:4]
            calibration = gtsam.Cal3DS2(K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2], *D)
            held = (camera, gtsam.Pose3(camera.T_base_cam), calibration)
            self._cameras[id(camera)] = held
        return held[1], held[2]


def cartesian(m: RangeBearingMeasurement) -> tuple[FloatArray, FloatArray]:
    """The sighting as a point ``(2,)`` in the base frame with covariance ``(2, 2)``.

    The frame turned by the bearing has range along its first axis and range times bearing across; first order in the
    bearing's sigma, which is exact enough below 0.2 rad.
    """
    c, s = math.cos(m.bearing_rad), math.sin(m.bearing_rad)
    r = m.range_m
    J = np.array([[-r * s, c], [r * c, s]])  # columns: bearing, range
    return np.array([r * c, r * s]), _symmetric(J @ m.cov @ J.T)


def whitened(
    factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, cauchy_k: float | None
) -> tuple[FloatArray, FloatArray]:
    """Whitened residual ``(d,)`` and Jacobian ``(d, 3)`` of unary pose factors, without their robust weights.

    A robust factor linearises to its Gaussian one times √w, w = 1 / (1 + r²/k²), so that w = 1 - |√w r|²/k².
    """
    residuals, jacobians = [], []
    for factor in factors:
        A, b = factor.linearize(values).jacobian()
        scale = -1.0
        if cauchy_k is not None:
            scale /= math.sqrt(max(1.0 - float(b @ b) / cauchy_k**2, 1e-12))
        jacobians.append(A * -scale)
        residuals.append(b * scale)
    return np.concatenate(residuals), np.vstack(jacobians)


def _covariance_problem(cov: FloatArray) -> str:
    """What is wrong with a covariance; "" if nothing.

    Sylvester's criterion in plain floats, because this runs for every factor of every step.
    """
    if cov.shape == (3, 3):
        (a, b, c), (d, e, f), (g, h, i) = cov.tolist()
        minors: tuple[float, ...] = a, a * e - b * d, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        skew = abs(b - d) + abs(c - g) + abs(f - h)
        size = abs(a) + abs(e) + abs(i)
    elif cov.shape == (2, 2):
        (a, b), (d, e) = cov.tolist()
        minors = (a, a * e - b * d)
        skew, size = abs(b - d), abs(a) + abs(e)
    else:
        return f"covariance of shape {cov.shape}, expected (2, 2) or (3, 3)"
    if not math.isfinite(size + skew):
        return "covariance with NaN or Inf"
    if skew > 1e-9 * size:
        return "asymmetric covariance"
    return "" if min(minors) > 0.0 else "covariance is not positive definite"


def _symmetric(m: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (m + m.T))
