"""The batch on uneven ground: motions projected by the roll and pitch of the last solution, and its ground factors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np

from fgloc.graph.batch_solve import Solved, forget_separators
from fgloc.graph.factors import installed_motion_factor, pose_key
from fgloc.graph.ground import gravity, ground_key
from fgloc.graph.installation import GROUND, Installation
from fgloc.graph.measurement_log import Keyframe
from fgloc.graph.uneven import gravity_factor, ground_prior, step_factors, step_of
from fgloc.types import FloatArray


def ground_of(values: gtsam.Values, frames: Sequence[Keyframe]) -> FloatArray:
    """Height, roll and pitch ``(n, 3)`` of keyframes."""
    return np.array([values.atVector(ground_key(frame.k)) for frame in frames]).reshape(-1, len(GROUND))


def ground_covs(marginals: Solved, frames: Sequence[Keyframe]) -> FloatArray:
    """Covariances ``(n, 6, 6)`` of x, y, yaw (right perturbation), height, roll and pitch."""
    found = []
    for row, frame in enumerate(frames):
        keys = [pose_key(frame.k), ground_key(frame.k)]
        joint = marginals.jointMarginalCovariance(keys)
        found.append(np.block([[np.asarray(joint.at(a, b)) for b in keys] for a in keys]))
        forget_separators(marginals, row)
    return np.array(found)


class GroundMotions:
    """Factors of motion of all keyframes, made anew about each solution."""

    def __init__(self, frames: Sequence[Keyframe], installation: Installation) -> None:
        """Take the keyframes in order."""
        self._frames, self._installation = frames, installation
        first = installation.prior()
        self._prior = first.cov[installation.constants :, installation.constants :]

    def factors(self, poses: FloatArray, ground: FloatArray, theta: FloatArray) -> Iterator[gtsam.NonlinearFactor]:
        """All factors.

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
