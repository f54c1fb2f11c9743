"""Measurements to GTSAM factors: keys, linear factors, and the factors of motions and sightings.

A known landmark enters as a unary factor; an unknown one is a variable. Factors are Gaussian, but for sightings of
unknown landmarks, which have Cauchy's kernel.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from operator import is_not
from typing import Any

import gtsam
import numpy as np

from fgloc import se2
from fgloc.errors import CovarianceError, EstimatorError
from fgloc.frames import rotations
from fgloc.graph.installation import Installation, InstallationEstimate, camera_block
from fgloc.graph.measurement_log import LoggedSighting, PoseWithCovariance
from fgloc.graph.noise import covariance_problem, gaussian, robust, sighting_whitening, whitening_of
from fgloc.graph.observation import Lines, Observations
from fgloc.sensors.measurements import FrameMeasurement, LandmarkMeasurement, PointMeasurement
from fgloc.types import (
    FloatArray,
    IntArray,
    Landmark,
    LandmarkMap,
    MotionMeasurement,
)

# --- Linear factors, and the keys of the installation in them ---------------------------------------------------------

INSTALLATION = int(gtsam.symbol("i", 0))
"""Key of the installation state: one vector."""


def ground_key(k: int) -> int:
    """Key of height, roll and pitch of keyframe k: one vector."""
    return int(gtsam.symbol("g", k))


def insert_installation(k: int, theta: FloatArray, constants: int, values: gtsam.Values) -> None:
    """Insert keyframe k's point of linearization: the installation ``(n,)``, whose last rows may be its own ground."""
    if constants:
        values.insert(INSTALLATION, theta[:constants])
    if len(theta) > constants:
        values.insert(ground_key(k), theta[constants:])


def installation_blocks(k: int, H: FloatArray, constants: int) -> dict[int, FloatArray]:
    """Derivatives ``(d, n)`` by the installation, by key; the last of them may be keyframe k's own."""
    blocks = {INSTALLATION: H[:, :constants]} if constants else {}
    return blocks if H.shape[1] == constants else {**blocks, ground_key(k): H[:, constants:]}


def linear_factor(
    blocks: Mapping[int, FloatArray], residual: FloatArray, values: gtsam.Values
) -> gtsam.NonlinearFactor:
    """A factor of whitened residual ``(d,)``, linear about these values; up to three keys with their Jacobians."""
    pairs: list[Any] = [part for key, A in blocks.items() for part in (key, A)]
    noise = gtsam.noiseModel.Unit.Create(len(residual))
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(*pairs, -residual, noise), values)  # type: ignore[call-overload]


def factor_graph(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """Graph of these factors, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


# --- Motions, priors and sightings ------------------------------------------------------------------------------------

# Usual constants, of whitened residuals. Sources: Zhang 1997, "Parameter estimation techniques"; Agarwal et al. 2013,
# "Robust map optimization using dynamic covariance scaling".
_KERNELS = {
    "huber": gtsam.noiseModel.mEstimator.Huber.Create(1.345),
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy.Create(2.385),
    "dcs": gtsam.noiseModel.mEstimator.DCS.Create(1.0),
}
_MOST_LOOKALIKES = 10


def pose_key(k: int) -> int:
    """Key of the pose of keyframe k."""
    return int(gtsam.symbol("x", k))


def pose_vector(pose: gtsam.Pose2) -> FloatArray:
    """A pose as ``(3,)``."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def landmark_key(landmark_id: int) -> int:
    """Key of an estimated landmark."""
    return int(gtsam.symbol("l", landmark_id))


def installed_motion_factor(
    k: int, m: MotionMeasurement, before: FloatArray, installation: Installation
) -> gtsam.NonlinearFactor:
    """Between-factor from keyframe k - 1 to k and the parameters that the motion depends on.

    Linear about a pose ``before`` (3,) of keyframe k - 1 and the one that the motion leads to: good to half the squared
    angle, as a share of the motion, by which the poses are turned from there.
    """
    columns = {installation.index[name]: c for name, c in m.depends_on.items() if name in installation.index}
    if not columns:
        return motion_factor(k, m)
    W = whitening_of(m.cov)
    values = gtsam.Values()
    values.insert(pose_key(k - 1), gtsam.Pose2(*before))
    values.insert(pose_key(k), gtsam.Pose2(*se2.compose(before, m.motion)))
    blocks = {pose_key(k - 1): -W @ se2.adjoint(se2.inverse(m.motion)), pose_key(k): W}
    residual = np.zeros(3)
    values.insert(INSTALLATION, np.zeros(installation.constants))
    H = np.zeros((3, installation.constants))
    for i, (derivative, assumed) in columns.items():
        H[:, i] = -W @ derivative
        residual -= H[:, i] * assumed
    blocks[INSTALLATION] = H
    return linear_factor(blocks, residual, values)


def installed_prior_factor(
    k: int, prior: PoseWithCovariance, belief: InstallationEstimate, constants: int
) -> gtsam.NonlinearFactor:
    """Prior on keyframe k and the installation together; of a prior that knows nothing of it, on each alone.

    Of the installation the first ``constants`` are the same for all keyframes, the others are those of this one.
    """
    known = prior.installation or belief
    values = gtsam.Values()
    values.insert(pose_key(k), gtsam.Pose2(*prior.pose))
    insert_installation(k, known.mean, constants, values)
    W = whitening_of(prior.joint_cov(known))
    blocks = {pose_key(k): W[:, :3]} | installation_blocks(k, W[:, 3:], constants)
    return linear_factor(blocks, np.zeros(len(W)), values)


def sighting_factors(
    k: int,
    sightings: Sequence[LoggedSighting],
    lines: Lines,
    pose: FloatArray,
    theta: FloatArray,
    constants: int | None = None,
) -> list[gtsam.NonlinearFactor]:
    """One factor for all sightings of one image, linear about a pose and an installation.

    Args:
        k: keyframe.
        sightings: made there.
        lines: the same, linearized there.
        pose: ``(3,)``.
        theta: ``(n,)``.
        constants: how many of it are the same for all keyframes; None: all.
    """
    shared = len(theta) if constants is None else constants
    values = gtsam.Values()
    values.insert(pose_key(k), gtsam.Pose2(*pose))
    insert_installation(k, theta, shared, values)
    images: dict[int, list[int]] = {}
    for i, sighting in enumerate(sightings):
        images.setdefault(sighting.measurement.stamp_ns, []).append(i)
    made = []
    for members in images.values():
        image = lines.only(members)
        W = sighting_whitening(image.noise())
        A = W @ image.H
        blocks = {pose_key(k): A[:, :3]} | installation_blocks(k, A[:, 3:], shared)
        made.append(linear_factor(blocks, W @ image.residual, values))
    return made


def motion_factor(k: int, m: MotionMeasurement, kernel: str = "none") -> gtsam.NonlinearFactor:
    """Between-factor from keyframe k - 1 to k; a kernel other than "none" is put on the wheels' alone."""
    noise = gaussian(m.cov)
    if m.source == "wheels" and kernel != "none":
        noise = gtsam.noiseModel.Robust.Create(_KERNELS[kernel], noise)
    return gtsam.BetweenFactorPose2(pose_key(k - 1), pose_key(k), gtsam.Pose2(*m.motion), noise)


def prior_factor(k: int, pose: FloatArray, cov: FloatArray) -> gtsam.NonlinearFactor:
    """Prior on keyframe k; the covariance is a right perturbation's."""
    return gtsam.PriorFactorPose2(pose_key(k), gtsam.Pose2(*pose), gaussian(cov))


def variable_factor(k: int, m: LandmarkMeasurement, cauchy_k: float | None) -> gtsam.NonlinearFactor:
    """Sighting of a landmark that is a variable, a point or a pose.

    Raises:
        EstimatorError: it never is one.
    """
    if not isinstance(m, PointMeasurement | FrameMeasurement):
        raise EstimatorError("marker corners need a known map: give --map, or build one with `fgloc map`")
    keys, noise = (pose_key(k), landmark_key(m.landmark_id)), robust(gaussian(m.cov), cauchy_k)
    if isinstance(m, PointMeasurement):
        return gtsam.BearingRangeFactor2D(*keys, gtsam.Rot2(m.bearing_rad), m.range_m, noise)
    return gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(*m.pose), noise)


_NOTHING: tuple[FloatArray, dict[int, tuple[LandmarkMeasurement, int]], Lines] = np.zeros(3), {}, Lines.of((), 0)


class LandmarkFactors:
    """Residuals of sightings: of a known map as residuals by pose and installation, of an unknown one as factors.

    Attributes:
        installation: the parameters beside the pose.
    """

    def __init__(self, landmark_map: LandmarkMap | None, installation: Installation | None = None) -> None:
        self._known: Mapping[int, Landmark] | None = None if landmark_map is None else landmark_map.landmarks
        self.installation = Installation({}) if installation is None else installation
        self._estimated = self.installation.prior()
        self._prepared: tuple[tuple[LandmarkMeasurement, ...], Observations | None] = (), None
        self._sizes: dict[float, tuple[IntArray, FloatArray]] = {}
        self._remembered: tuple[FloatArray, dict[int, tuple[LandmarkMeasurement, int]], Lines] = _NOTHING

    def with_installation(self, installation: Installation) -> LandmarkFactors:
        """Copy with another installation; parameters with a smaller prior sigma than before start from its mean."""
        held = np.flatnonzero(installation.sigmas < self.installation.sigmas)
        mean = self._estimated.mean.copy()
        mean[held] = installation.prior().mean[held]
        return self._copied(installation, InstallationEstimate(mean, self._estimated.cov))

    def _copied(self, installation: Installation, estimated: InstallationEstimate) -> LandmarkFactors:
        other = copy.copy(self)
        other.installation, other.estimated, other._prepared = installation, estimated, ((), None)
        return other

    def with_states(self, ids: Iterable[int]) -> LandmarkFactors:
        """Copy in which these landmarks are states, from the map on; the other constants start as they are known."""
        installation = self.installation.with_states(ids)
        known = installation.prior()
        for i, name in enumerate(self.installation.names):
            if not name.startswith("map."):
                known.mean[installation.index[name]] = self._estimated.mean[i]
        return self._copied(installation, known)

    def with_mounting(self, kind: str, name: str, before: FloatArray) -> LandmarkFactors:
        """Copy for a camera that was knocked; see `Installation.with_mounting`.

        Args:
            kind: of its sightings.
            name: of the camera since then.
            before: mean ``(k,)`` of the constants of the mounting until then, which starts there.
        """
        installation = self.installation.with_mounting(kind, name)
        if installation is self.installation:
            return self
        rows, _ = self.installation.mounting(kind)
        known = installation.prior()
        for i, own in enumerate(self.installation.names):
            known.mean[installation.index[own]] = self._estimated.mean[i]
        first, count = installation.blocks[camera_block(name)]
        known.mean[first : first + count] = self._estimated.mean[rows[0] : rows[0] + count]
        known.mean[[installation.index[self.installation.names[i]] for i in rows]] = before
        return self._copied(installation, known)

    @property
    def estimated(self) -> InstallationEstimate:
        """Newest estimate of the installation, with its covariance."""
        return self._estimated

    @estimated.setter
    def estimated(self, belief: InstallationEstimate) -> None:
        self._estimated = belief
        self._remembered = _NOTHING

    def states_changed(self) -> None:
        """Forget what was prepared for other landmarks as states."""
        self._prepared, self._remembered = ((), None), _NOTHING

    def time_offset_s(self, camera: str = "") -> float:
        """How late stamps of sightings are, as far as is known; of several cameras those of one."""
        return self.installation.time_offset(self.estimated, camera)

    @property
    def known(self) -> bool:
        """Whether the map is given; otherwise landmarks are variables."""
        return self._known is not None

    @property
    def landmarks(self) -> Mapping[int, Landmark]:
        """Landmarks of the known map, by id; empty if the map is unknown."""
        return self._known or {}

    def installed(self, m: MotionMeasurement, *derivatives: Mapping[str, FloatArray]) -> MotionMeasurement:
        """The motion as reported with the installation as it is known now; its derivatives are those of the sensors."""
        index, mean = self.installation.index, self.estimated.mean
        by = {name: d for each in derivatives for name, d in each.items()}
        kept = {name: (d, float(mean[index[name]])) for name, d in by.items() if name in index}
        correction = np.sum([d * value for d, value in kept.values()], axis=0) if kept else np.zeros(3)
        return replace(m, motion=se2.compose(m.motion, se2.exp(correction)), depends_on=kept)

    def sighting(
        self, k: int, m: LandmarkMeasurement, cauchy_k: float | None, alone: LandmarkMeasurement | None = None
    ) -> LoggedSighting:
        """The measurement as the graph takes it at keyframe k.

        Raises:
            EstimatorError: the landmark is not in the known map, or corners were given for an unknown map.
            CovarianceError: the measurement's covariance is not one.
        """
        if self._known is None:
            return LoggedSighting(m, alone or m, cauchy_k, variable_factor(k, m, cauchy_k))
        if m.of_landmark and m.landmark_id not in self._known:
            raise EstimatorError(f"landmark {m.landmark_id} is not in the map ({len(self._known)} landmarks)")
        if m.cov is not None and (problem := covariance_problem(m.cov)):
            raise CovarianceError(
                f"{problem}: {m.cov.tolist()}; a measurement like this has to be rejected by the gate"
            )
        return LoggedSighting(m, alone or m, cauchy_k)

    def observe(self, measurements: Sequence[LandmarkMeasurement]) -> Observations:
        """Sightings of the known map, prepared for being linearized; of the same as the last time, once."""
        if self._known is None:
            raise EstimatorError("sightings are linearized against a known map only")
        held, observed = self._prepared
        if observed is None or len(held) != len(measurements) or any(map(is_not, held, measurements)):
            held, observed = tuple(measurements), Observations(measurements, self._known, self.installation)
            self._prepared = held, observed
        return observed

    def linearize(self, measurements: Sequence[LandmarkMeasurement], pose: FloatArray) -> Lines:
        """Sightings at a pose and the installation as it is known now.

        Asked again of some of the same sightings at the same pose, as a step does, the answer is remembered.
        """
        at, held, lines = self._remembered
        if at is not pose or any(id(m) not in held for m in measurements):
            lines = self.observe(measurements).together(pose, self.estimated.mean)
            held = {id(m): (m, i) for i, m in enumerate(measurements)}
            self._remembered = pose, held, lines
        return lines.only([held[id(m)][1] for m in measurements])

    def lookalikes(self, m: LandmarkMeasurement, pose: FloatArray) -> Sequence[LandmarkMeasurement]:
        """The sighting as one of another marker of the same size, seen from this pose about where this one was seen.

        None where they hang so densely that the place does not tell, and of what is not told apart by a code.
        """
        if self._known is None:
            raise EstimatorError("what else a marker may be needs a known map")
        if not m.in_pixels:
            return ()
        ids, positions = self._of_size(self._known[m.landmark_id].size_m)
        x, y, yaw = pose
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = positions[:, 0] - x, positions[:, 1] - y
        places = self._tilted(np.column_stack([c * dx + s * dy, -s * dx + c * dy, positions[:, 2]]))
        others = ids != m.landmark_id
        found = m.misread(ids[others], places[others])
        return found if len(found) <= _MOST_LOOKALIKES else ()

    def _of_size(self, size_m: float) -> tuple[IntArray, FloatArray]:
        """Ids ``(n,)`` and positions ``(n, 3)`` of the markers of a size."""
        if size_m not in self._sizes:
            held = [one for one in self.landmarks.values() if one.size_m == size_m]
            ids = np.array([one.landmark_id for one in held], dtype=np.int64)
            self._sizes[size_m] = ids, np.array([one.position for one in held])
        return self._sizes[size_m]

    def _tilted(self, level: FloatArray) -> FloatArray:
        """Points ``(m, 3)`` in the base's axes, from those of a level base on the floor."""
        if not self.installation.ground:
            return level
        z, *angles = self._estimated.mean[self.installation.constants :].tolist()
        return np.asarray((level - [0.0, 0.0, z]) @ rotations(np.array([angles]))[0])
