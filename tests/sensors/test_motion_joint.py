"""Correlated wheels and learned motion: the two factors together say what the joint Gaussian says."""

from __future__ import annotations

import numpy as np
import pytest
from refusal import refusal

from fgloc import se2
from fgloc.errors import CovarianceError
from fgloc.sensors.learned.network import JointCalibration
from fgloc.types import FloatArray, MotionMeasurement


def joint_covariance(rng: np.random.Generator, scale: float = 1.0) -> FloatArray:
    """Of (e_w, e_n) ``(6, 6)``, with errors of centimeters and hundredths of a radian."""
    root = rng.normal(size=(6, 12))
    units = np.tile([0.02, 0.01, 0.03], 2) * scale
    return np.asarray(root @ root.T / 12 * np.outer(units, units))


def measurement(source: str, motion: FloatArray, cov: FloatArray) -> MotionMeasurement:
    return MotionMeasurement(source, 0, 200_000_000, motion, cov)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def test_two_factors_equal_the_joint_gaussian(rng: np.random.Generator) -> None:
    kept = 0
    for _ in range(60):
        P = joint_covariance(rng)
        W, N, C = P[:3, :3], P[3:, 3:], P[3:, :3]
        joint = JointCalibration(W, N, C)
        L_w, L_n = np.linalg.cholesky(W), np.linalg.cholesky(N)
        correlation = np.linalg.solve(L_n, C @ np.linalg.inv(L_w).T)
        if (
            max(np.linalg.norm(correlation, 2) - 0.04, np.linalg.norm(np.linalg.solve(L_w, L_n @ correlation), 2))
            > 0.95
        ):
            continue  # shrunk: no longer exact
        kept += 1
        errors = np.linalg.cholesky(P) @ rng.normal(size=6)
        true = np.array([0.1, 0.01, 0.2])
        z_w, z_n = se2.compose(true, se2.exp(errors[:3])), se2.compose(true, se2.exp(errors[3:]))
        star = joint.decorrelate(measurement("wheels", z_w, W), measurement("learned", z_n, N))
        # Exact joint estimate about z_w: observations 0 (wheels) and d (learned) of one tangent vector.
        d = se2.log(se2.between(z_w, z_n))
        H = np.vstack([np.eye(3), np.eye(3)])
        information = H.T @ np.linalg.solve(P, H)
        mean = np.linalg.solve(information, H.T @ np.linalg.solve(P, np.concatenate([np.zeros(3), d])))
        # Product of two independent factors.
        star_information = np.linalg.inv(star.cov)
        product = np.linalg.inv(W) + star_information
        product_mean = np.linalg.solve(product, star_information @ se2.log(se2.between(z_w, star.motion)))
        np.testing.assert_allclose(product, information, rtol=1e-6)
        np.testing.assert_allclose(product_mean, mean, atol=1e-9)
    assert kept >= 5


def test_one_calibration_serves_steps_of_any_length(rng: np.random.Generator) -> None:
    P = joint_covariance(rng)
    joint = JointCalibration(P[:3, :3], P[3:, 3:], P[3:, :3])
    K = joint.gain(P[:3, :3], P[3:, 3:])
    np.testing.assert_allclose(joint.gain(P[:3, :3] / 25, P[3:, 3:] / 25), K, rtol=1e-9)
    units = np.diag([100.0, 100.0, 57.3])  # centimeters and degrees
    scaled = JointCalibration(*(units @ M @ units for M in (P[:3, :3], P[3:, 3:], P[3:, :3])))
    np.testing.assert_allclose(scaled.correlation, joint.correlation, rtol=1e-9)


def test_uncorrelated_stays_as_it_is(rng: np.random.Generator) -> None:
    P = joint_covariance(rng)
    learned = measurement("learned", np.array([0.1, 0.0, 0.1]), P[3:, 3:])
    star = JointCalibration(P[:3, :3], P[3:, 3:], np.zeros((3, 3))).decorrelate(
        measurement("wheels", np.array([0.12, 0.01, 0.15]), P[:3, :3]), learned
    )
    np.testing.assert_allclose(star.motion, learned.motion, atol=1e-12)
    np.testing.assert_allclose(star.cov, learned.cov, rtol=1e-9)
    assert (star.source, star.start_ns, star.stamp_ns) == ("learned", 0, 200_000_000)


def test_gain_is_shrunk(rng: np.random.Generator) -> None:
    W = np.diag([1e-4, 1e-4, 1e-4])
    joint = JointCalibration(W, 9 * W, 0.9 * 3 * W)  # K would be 2.7
    K = joint.gain(W, 9 * W)
    assert np.linalg.norm(K, 2) == pytest.approx(0.95)
    star = joint.decorrelate(
        measurement("wheels", np.zeros(3), W), measurement("learned", np.array([0.01, 0.0, 0.0]), 9 * W)
    )
    assert np.linalg.eigvalsh(star.cov).min() > 0
    assert np.isfinite(star.motion).all()


def test_full_correlation_still_gives_a_covariance() -> None:
    W = np.diag([1e-4, 4e-4, 1e-4])
    star = JointCalibration(W, W / 4, W / 2).decorrelate(
        measurement("wheels", np.zeros(3), W), measurement("learned", np.zeros(3), W / 4)
    )
    np.linalg.cholesky(star.cov)


def test_impossible_covariances_are_refused() -> None:
    eye = np.eye(3)
    with pytest.raises(CovarianceError, match=r"norm 1\.5"):
        JointCalibration(eye, eye, 1.5 * eye)
    for W, N in ((-eye, eye), (eye, np.full((3, 3), np.nan)), (np.zeros((3, 3)), eye)):
        with refusal(CovarianceError, cause=np.linalg.LinAlgError):
            JointCalibration(W, N, np.zeros((3, 3)))
    with pytest.raises(ValueError, match="one step"):
        JointCalibration(eye, eye, 0 * eye).decorrelate(
            MotionMeasurement("wheels", 0, 1, np.zeros(3), eye), MotionMeasurement("learned", 0, 2, np.zeros(3), eye)
        )
