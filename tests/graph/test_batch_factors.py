"""Factors of a whole recording made at once are those that are made one by one."""

import gtsam
import numpy as np
import pytest

from benchmarks.steps import Chain, World
from fgloc.graph.batch_factors import BatchMotions, BatchSightings, whitened
from fgloc.graph.factors import INSTALLATION, installed_motion_factor, pose_key, sighting_factors


@pytest.fixture(scope="module")
def run():
    """Keyframes of a short run, its factors, and poses and an installation that are not those of the run."""
    chain = Chain(World(), keep_all=True, with_model=False)
    for _ in chain.updates(World().events(4.0)):
        pass
    rng = np.random.default_rng(0)
    frames, factors = list(chain.localizer.estimator.log.keyframes.values()), chain.localizer.factors
    poses = np.array([f.belief.pose for f in frames]) + rng.normal(0.0, 0.01, (len(frames), 3))
    return frames, factors, poses, 0.3 * rng.normal(size=len(factors.installation)) * factors.installation.sigmas


def values_of(poses, theta, frames):
    values = gtsam.Values()
    for frame, pose in zip(frames, poses, strict=True):
        values.insert(pose_key(frame.k), gtsam.Pose2(*pose))
    values.insert(INSTALLATION, theta)
    return values


def system(made, poses, theta, frames):
    """Information matrix and vector of factors at these poses, and their error."""
    graph, values = gtsam.NonlinearFactorGraph(), values_of(poses, theta, frames)
    for factor in made:
        graph.add(factor)
    ordering = gtsam.Ordering()
    for key in sorted(graph.keyVector()):
        ordering.push_back(key)
    return (*graph.linearize(values).hessian(ordering), graph.error(values))


def test_motions(run):
    frames, factors, poses, theta = run
    one_by_one = [
        installed_motion_factor(frame.k, motion, poses[i - 1], factors.installation)
        for i, frame in enumerate(frames)
        for motion in frame.motions
    ]
    at_once = BatchMotions(frames, factors.installation).factors(poses)
    for a, b in zip(system(one_by_one, poses, theta, frames), system(at_once, poses, theta, frames), strict=True):
        assert np.allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(a).max())


def test_sightings_and_the_prior_of_the_installation(run):
    frames, factors, poses, theta = run
    row = np.eye(len(theta))[0]
    factors.installation.measured(row, 0.5 * factors.installation.sigmas[0], factors.installation.sigmas[0])
    prior = factors.installation.prior()
    one_by_one = [gtsam.PriorFactorVector(INSTALLATION, prior.mean, gtsam.noiseModel.Gaussian.Covariance(prior.cov))]
    for frame, pose in zip(frames, poses, strict=True):
        if frame.sightings:
            lines = factors.observe([s.measurement for s in frame.sightings]).together(pose, theta)
            one_by_one += sighting_factors(frame.k, frame.sightings, lines, pose, theta)
    assert len(one_by_one) > 50
    sightings = BatchSightings(frames, [frame.sightings for frame in frames], factors)
    at_once = sightings.factors(poses, theta, values_of(poses, theta, frames))
    for a, b in zip(system(one_by_one, poses, theta, frames), system(at_once, poses, theta, frames), strict=True):
        assert np.allclose(a, b, rtol=1e-8, atol=1e-9 * np.abs(a).max())


def test_whitened_rows_have_unit_covariance():
    rng = np.random.default_rng(1)
    S = rng.normal(size=(5, 12, 3)) * np.array([1e-3, 1.0, 1e4])
    W = whitened(np.broadcast_to(np.eye(12), (5, 12, 12)), S)
    noise = np.eye(12) + S @ np.swapaxes(S, 1, 2)
    assert np.allclose(W @ noise @ np.swapaxes(W, 1, 2), np.eye(12), atol=1e-6)
