"""Factors of a whole recording, made over and over about new poses: what does not change is prepared once, in numpy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from fgloc import se2
from fgloc.errors import CovarianceError, EstimatorError
from fgloc.graph.factors import (
    INSTALLATION,
    LandmarkFactors,
    ground_key,
    installed_motion_factor,
    motion_factor,
    pose_key,
    sighting_factors,
)
from fgloc.graph.ground import gravity, gravity_factor, ground_prior, step_factors, step_of
from fgloc.graph.installation import GROUND, Installation
from fgloc.graph.measurement_log import Keyframe, LoggedSighting
from fgloc.graph.noise import whitening_of
from fgloc.graph.observation import Lines, Observations, Stacked
from fgloc.types import FloatArray, IntArray

_WHEELS_CAUCHY_K = 3.0  # sigmas, as of sightings in fits of a pose
_AT_ONCE = 300  # keyframes whose sightings are linearized at the same time; each may have 100 kB of Jacobians


class BatchMotions:
    """Between-factors of all keyframes, as `fgloc.graph.factors.installed_motion_factor` makes them."""

    def __init__(self, frames: Sequence[Keyframe], installation: Installation) -> None:
        """Prepare the motions that end at these keyframes."""
        self._n = installation.constants
        held = [(i, frame.k, m) for i, frame in enumerate(frames) for m in frame.motions]
        self._at = np.array([i for i, _, _ in held], dtype=np.int64)  # rows of the keyframes that they end at
        self._k = [k for _, k, _ in held]
        self._all = [m for _, _, m in held]
        self._motions = np.array([m.motion for m in self._all]).reshape(-1, 3)
        self._of_wheels = np.array([m.source == "wheels" for m in self._all], dtype=bool)
        self._W = whitenings([m.cov for m in self._all]) if held else np.zeros((0, 3, 3))
        back = np.array([se2.adjoint(se2.inverse(m)) for m in self._motions]).reshape(-1, 3, 3)
        self._by_first = -self._W @ back  # by the pose before
        self._H, self._r = np.zeros((len(held), 3, self._n)), np.zeros((len(held), 3))
        self._installed = [any(name in installation.index for name in m.depends_on) for m in self._all]
        for i, m in enumerate(self._all):
            for name, (derivative, assumed) in m.depends_on.items():
                if name in installation.index:
                    column = -self._W[i] @ derivative
                    self._H[i, :, installation.index[name]] = column
                    self._r[i] -= column * assumed
        self._scales = np.ones(len(held))  # on their covariances

    def weigh(self, poses: FloatArray, theta: FloatArray) -> float:
        """Scale the covariances of the wheels by how far each of their motions is from a solution.

        That is Cauchy's kernel, by weights that are computed anew about each solution: of wheels that slip for a moment
        the fixes around it say so.

        Source: Holland, Welsch 1977, "Robust regression using iteratively reweighted least-squares".

        Args:
            poses: ``(n, 3)`` of the keyframes.
            theta: ``(p,)`` installation.

        Returns:
            The largest change of a scale, as a factor.
        """
        if not self._of_wheels.any():
            return 1.0
        apart = np.array([se2.log(d) for d in se2.between_array(self._led_to(poses), poses[self._at])])
        white = np.einsum("nij,nj->ni", self._W, apart) + self._H @ theta + self._r
        squares = np.einsum("ni,ni->n", white, white) * (2.0 / se2.DOF)  # as if of two dimensions
        before = self._scales
        self._scales = np.where(self._of_wheels, 1.0 + squares / _WHEELS_CAUCHY_K**2, 1.0)
        return float(np.exp(np.abs(np.log(self._scales / before)).max()))

    def _led_to(self, poses: FloatArray) -> FloatArray:
        return se2.compose_array(poses[self._at - 1], self._motions)

    def factors(self, poses: FloatArray) -> Iterator[gtsam.NonlinearFactor]:
        """All; those with the installation linear about poses ``(n, 3)`` and what the motions lead to from there."""
        constants = gtsam.Values()
        constants.insert(INSTALLATION, np.zeros(self._n))
        before, after, scales = poses[self._at - 1], self._led_to(poses), self._scales.tolist()
        for i, (k, m, installed) in enumerate(zip(self._k, self._all, self._installed, strict=True)):
            if not installed:
                yield motion_factor(k, m if scales[i] == 1.0 else replace(m, cov=m.cov * scales[i]))
                continue
            first, second = pose_key(k - 1), pose_key(k)
            values = gtsam.Values(constants)
            values.insert(first, gtsam.Pose2(*before[i]))
            values.insert(second, gtsam.Pose2(*after[i]))
            noise = gtsam.noiseModel.Isotropic.Sigma(3, math.sqrt(scales[i]))
            blocks = first, self._by_first[i], second, self._W[i], INSTALLATION, self._H[i]
            linear = gtsam.JacobianFactor(*blocks, -self._r[i], noise)
            yield gtsam.LinearContainerFactor(linear, values)


class BatchSightings:
    """Sightings of a known map from all keyframes, and the prior of the installation.

    Of each image only what concerns its pose becomes a factor: an orthogonal transform of its rows leaves three in
    which the pose is, and the others, which hold the installation alone, are summed up over the whole recording. The
    solution is that of `sighting_factors`, in a tenth of the memory.
    """

    def __init__(
        self, frames: Sequence[Keyframe], accepted: Sequence[Sequence[LoggedSighting]], factors: LandmarkFactors
    ) -> None:
        """Prepare what was accepted at each keyframe."""
        self._installation = factors.installation
        self._chunks: list[_Images] = []
        for first in range(0, len(frames), _AT_ONCE):
            chosen = range(first, min(first + _AT_ONCE, len(frames)))
            held = [(i, frames[i].k, s) for i in chosen for s in accepted[i]]
            if held:
                self._chunks.append(_Images(held, factors))

    def factors(self, poses: FloatArray, theta: FloatArray, values: gtsam.Values) -> Iterator[gtsam.NonlinearFactor]:
        """All factors, linear about poses ``(n, 3)`` of the keyframes and an installation ``(p,)``.

        On uneven ground poses are ``(n, 6)``, with height, roll and pitch. The values are the same, for GTSAM.
        """
        rest = np.zeros((len(theta) + 1, len(theta) + 1))  # information of the installation, and its last column
        for chunk in self._chunks:
            yield from chunk.factors(poses, theta, values, rest)
        if len(theta):
            yield self._of_installation(theta, values, rest)

    def squares(self, poses: FloatArray, theta: FloatArray) -> tuple[FloatArray, IntArray]:
        """Squared residual ``(m,)`` of each sighting by its own noise, and its rows, see `Observations.squares`."""
        found = [chunk.squares(poses, theta) for chunk in self._chunks]
        return (
            np.concatenate([np.zeros(0), *(squares for squares, _ in found)]),
            np.concatenate([np.zeros(0, dtype=np.int64), *(rows for _, rows in found)]),
        )

    def _of_installation(self, theta: FloatArray, values: gtsam.Values, rest: FloatArray) -> gtsam.NonlinearFactor:
        """Factor of the installation's prior and of all terms of sightings in the installation alone."""
        prior, n = self._installation.prior(), len(theta)
        W = whitening_of(prior.cov[:n, :n])
        both = np.column_stack([W, W @ (theta - prior.mean[:n])])
        total = both.T @ both + rest
        root = _root(total[:n, :n])
        residual = np.linalg.solve(root.T, total[:n, n])
        A = np.vstack([root, np.zeros(n)])  # the last row is what no installation can explain
        b = np.append(residual, np.sqrt(max(0.0, total[n, n] - float(residual @ residual))))
        linear = gtsam.JacobianFactor(INSTALLATION, A, -b, gtsam.noiseModel.Unit.Create(n + 1))
        return gtsam.LinearContainerFactor(linear, values)


class _Images:
    """Sightings of some keyframes, grouped by image."""

    def __init__(self, held: Sequence[tuple[int, int, LoggedSighting]], factors: LandmarkFactors) -> None:
        """Prepare the sightings, each given with the row and the number of its keyframe."""
        self._row = np.array([i for i, _, _ in held], dtype=np.int64)
        self._k = np.array([k for _, k, _ in held], dtype=np.int64)
        self._sightings = [s for _, _, s in held]
        self._landmarks, self._installation = factors.landmarks, factors.installation
        self._observed = Observations([s.measurement for s in self._sightings], factors.landmarks, factors.installation)
        stamps = np.array([s.measurement.stamp_ns for s in self._sightings], dtype=np.int64)
        order = np.lexsort((stamps, self._row))
        new = np.flatnonzero(np.diff(stamps[order]) | np.diff(self._row[order])) + 1
        self._images = np.split(order, new)

    def factors(
        self, poses: FloatArray, theta: FloatArray, values: gtsam.Values, rest: FloatArray
    ) -> Iterator[gtsam.NonlinearFactor]:
        """Factors of these images, linear about poses and installation; terms of the latter alone go to ``rest``."""
        own = poses[self._row]
        (_, batch), *others = self._observed.batches
        if others or not batch.alike:
            yield from self._one_by_one(own, theta)
            return
        stack = batch.evaluate(own, theta)
        shared = batch.shared(stack)
        if not np.isfinite(shared).all():
            raise CovarianceError("the covariance of a sighting is not finite")
        ahead = [image[~stack.behind[image]] for image in self._images]
        for size in sorted({len(image) for image in ahead} - {0}):
            same = np.array([image for image in ahead if len(image) == size])
            rows = _rows(same, stack, len(theta))
            white = whitened(rows, shared[same].reshape(*rows.shape[:2], shared.shape[2]))
            yield from self._of_poses(same[:, 0], white, own.shape[1], values, rest)

    def squares(self, poses: FloatArray, theta: FloatArray) -> tuple[FloatArray, IntArray]:
        """Squared residual of each sighting by its own noise, and its rows, see `BatchSightings.squares`."""
        return self._observed.squares(poses[self._row], theta)

    def _of_poses(
        self, first: IntArray, white: FloatArray, d: int, values: gtsam.Values, rest: FloatArray
    ) -> Iterator[gtsam.NonlinearFactor]:
        """Factors of images, of which these are the first sightings, from white rows ``(g, m, d + n + 1)``."""
        Q, R = np.linalg.qr(white[:, :, :d])
        others = white[:, :, d:]
        top = np.swapaxes(Q, 1, 2) @ others
        flat, flat_top = others.reshape(-1, others.shape[2]), top.reshape(-1, others.shape[2])
        rest += flat.T @ flat - flat_top.T @ flat_top
        noise = gtsam.noiseModel.Unit.Create(R.shape[1])
        for k, by_pose, by_rest in zip(self._k[first].tolist(), R, top, strict=True):
            blocks: list[Any] = [pose_key(k), by_pose[:, :3]]
            if d > 3:
                blocks += [ground_key(k), by_pose[:, 3:]]
            if self._installation.constants:
                blocks += [INSTALLATION, by_rest[:, :-1]]
            linear = gtsam.JacobianFactor(*blocks, -by_rest[:, -1], noise)  # type: ignore[call-overload]
            yield gtsam.LinearContainerFactor(linear, values)

    def _one_by_one(self, own: FloatArray, theta: FloatArray) -> Iterator[gtsam.NonlinearFactor]:
        """Factors of recordings with sightings of several kinds, made keyframe by keyframe."""
        ground, own, constants = own[:, 3:], own[:, :3], len(theta)
        bounds = [0, *(np.flatnonzero(np.diff(self._row)) + 1).tolist(), len(self._row)]
        lines = [] if ground.shape[1] else self._observed.linearize(own, theta)
        for start, end in pairwise(bounds):
            sightings, there, some = self._sightings[start:end], theta, lines[start:end]
            if ground.shape[1]:
                there, measurements = np.concatenate([theta, ground[start]]), [s.measurement for s in sightings]
                some = Observations(measurements, self._landmarks, self._installation).linearize(own[start], there)
            ahead = [i for i, one in enumerate(some) if not one.behind]
            if ahead:
                kept = [sightings[i] for i in ahead], Lines.of([some[i] for i in ahead], len(there))
                yield from sighting_factors(int(self._k[start]), *kept, own[start], there, constants)


def _rows(chosen: IntArray, stack: Stacked, n: int) -> FloatArray:
    """Rows ``(g, m d, p + n + 1)``, p of the pose, of images ``(g, m)`` with as many sightings: Jacobians, residual."""
    g, m = chosen.shape
    d = stack.residual.shape[1]
    p = stack.J.shape[2]
    A = np.zeros((g, m, d, p + n + 2))  # with a place for what is no state
    A[..., :p] = stack.J[chosen]
    columns = np.where(stack.columns[chosen] >= 0, p + stack.columns[chosen], p + n + 1)
    np.put_along_axis(A, columns[:, :, None].repeat(d, axis=2), stack.H[chosen], axis=3)
    A[..., p + n] = stack.residual[chosen]
    return A[..., :-1].reshape(g, m * d, p + n + 1)


def _root(information: FloatArray) -> FloatArray:
    """R with ``Rᵀ R`` an information matrix, which may be positive to rounding only: far from the optimum.

    Raises:
        EstimatorError: it is not finite.
    """
    if not np.isfinite(information).all():
        raise EstimatorError("the batch diverged: it is not finite; look at steps.csv for what broke it")
    try:
        return np.asarray(np.linalg.cholesky(information).T)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(information)
        least = np.finfo(np.float64).eps * max(float(values[-1]), 1.0)
        return np.asarray(np.sqrt(np.maximum(values, least))[:, None] * vectors.T)


def whitenings(covs: Sequence[FloatArray]) -> FloatArray:
    """Whitening matrices of several covariances ``(d, d)``, as `whitening_of` makes one."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(np.array(covs))))
    except np.linalg.LinAlgError:
        return np.array([whitening_of(cov) for cov in covs])


def whitened(A: FloatArray, shared: FloatArray) -> FloatArray:
    """Rows ``(g, d, c)`` times the symmetric inverse root of ``I + S Sᵀ``, with S ``(g, d, s)`` of few columns.

    With ``SᵀS = V λ Vᵀ`` the root is ``I + S V diag(((1 + λ)^-½ - 1) / λ) Vᵀ Sᵀ``.
    """
    if not shared.shape[2]:
        return A
    values, vectors = np.linalg.eigh(np.swapaxes(shared, 1, 2) @ shared)
    values = np.maximum(values, 0.0)
    root = np.sqrt(1.0 + values)
    scaled = -vectors / (root * (1.0 + root))[:, None, :]  # (1/root - 1) / λ = -1 / (root (1 + root))
    return np.asarray(A + shared @ (scaled @ np.swapaxes(vectors, 1, 2) @ (np.swapaxes(shared, 1, 2) @ A)))


class GroundMotions:
    """Factors of motion of all keyframes, made anew about each solution."""

    def __init__(self, frames: Sequence[Keyframe], installation: Installation) -> None:
        """Prepare the keyframes, given in order."""
        self._frames, self._installation = frames, installation
        first = installation.prior()
        self._prior = first.cov[installation.constants :, installation.constants :]

    def factors(self, poses: FloatArray, ground: FloatArray, theta: FloatArray) -> Iterator[gtsam.NonlinearFactor]:
        """Factors of motion and ground of all keyframes, linear about a solution.

        Args:
            poses: ``(n, 3)`` of the keyframes.
            ground: ``(n, 3)`` their height, roll and pitch.
            theta: ``(constants,)`` installation.
        """
        installation = self._installation
        for i, frame in enumerate(self._frames):
            if not frame.motions:
                yield ground_prior(frame.k, np.zeros(len(GROUND)), self._prior)
                continue
            before = np.concatenate([theta, ground[i - 1]])
            step = step_of(frame.motions, before, installation)
            for motion in step.motions:
                yield installed_motion_factor(frame.k, motion, poses[i - 1], installation)
            yield from step_factors(frame.k, step, before, installation)
            seen = gravity(frame.motions, ground[i], before, installation)
            if seen is not None:
                yield gravity_factor(frame.k, seen, ground[i], before, installation)
