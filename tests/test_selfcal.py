"""Calibration of ranges and bearings during the run: found, with an honest sigma, and worth having."""

from __future__ import annotations

import numpy as np
import pytest
from robot_world import CAMERA, Chain, World, beacons, config, nees
from scipy.stats import chi2

from fgloc.graph.batch import BatchSmoother
from fgloc.sensors.sighting_calibration import Calibration, calibration_gradient, shifted
from fgloc.smoothing import refine
from fgloc.types import CornerMeasurement, RangeBearingMeasurement

SCALE, BIAS = 1.03, 0.02  # reported over true range; added to the bearing
TRUTH = np.array([-np.log(SCALE), BIAS])  # log of true over reported; taken off the bearing
ON = config(landmarks={"range_scale_sigma": 0.05, "bearing_bias_sigma_rad": 0.05})
OFF = config()
SEEDS = range(6)


@pytest.fixture(scope="module")
def drives():
    """Per seed: world, chain with calibration, its estimates, and those without calibration."""
    made = []
    for seed in SEEDS:
        world = World(beacons(), seed=seed, range_scale=SCALE, bearing_bias=BIAS)
        chain, plain = Chain(ON, world.map, keep_all=True), Chain(OFF, world.map)
        made.append((world, chain, chain.run(world.events()), plain.run(world.events())))
    return made


def consistency(values_and_covs) -> tuple[float, float, float]:
    """Sum of NEES of the calibration, and its χ² bounds."""
    sizes = [(v - TRUTH) @ np.linalg.solve(P, v - TRUTH) for v, P in values_and_covs]
    return (sum(sizes), *chi2.ppf([0.001, 0.999], 2 * len(sizes)))


def test_scale_and_offset_are_found_online_with_an_honest_sigma(drives):
    found = [chain.localizer.calibrator.calibration for _, chain, _, _ in drives]
    assert np.allclose(np.mean([c.value for c in found], axis=0), TRUTH, atol=(0.004, 0.003))
    for c in found:
        assert np.allclose(c.value, TRUTH, atol=(0.012, 0.008))
        assert (np.sqrt(np.diag(c.cov)) < (0.005, 0.004)).all()  # from 0.05
    total, low, high = consistency((c.value, c.cov) for c in found)
    assert low < total < high


def test_the_batch_refines_it(drives):
    refined = []
    for _, chain, _, _ in drives:
        localizer = chain.localizer
        solver = BatchSmoother(localizer.estimator.log, localizer.factors, ON.batch, ON.estimator.gate_probability)
        refined.append(refine(solver, beacons(), ON.landmarks, localizer.calibrator.calibration))
    batch = np.array([r.value - TRUTH for r in refined])
    online = np.array([c.localizer.calibrator.calibration.value - TRUTH for _, c, _, _ in drives])
    assert (np.abs(batch).mean(axis=0) <= 1.1 * np.abs(online).mean(axis=0)).all()
    assert (np.abs(batch) < (0.012, 0.008)).all()
    total, low, high = consistency((r.value, r.cov) for r in refined)
    assert low < total < high
    for r in refined:
        assert (np.linalg.eigvalsh(r.pose_covs) > -1e-12).all()
        assert np.trace(r.pose_covs, axis1=1, axis2=2).max() > 0.0


def test_poses_are_consistent_with_calibration_and_over_confident_without(drives):
    with_it, without = [], []
    for world, _, estimates, plain in drives:
        for sizes, run in ((with_it, estimates), (without, plain)):
            sizes.append(np.mean([nees(e, world.truth(e.stamp_ns)) for e in run[50:]]) / 3)
    assert 0.5 < np.mean(with_it) < 1.6
    assert np.mean(without) > 2.0 * np.mean(with_it)


def test_corners_are_left_as_they_are():
    corners = CornerMeasurement(0, 1, np.zeros((4, 2)), 0.5, CAMERA)
    assert Calibration(np.array([0.1, 0.1]), np.eye(2)).apply(corners) is corners


def test_a_correction_adds_its_own_uncertainty():
    m = RangeBearingMeasurement(0, 1, 2.0, 3.1, np.diag([1e-4, 4e-4]))
    calibration = Calibration(np.array([np.log(1.1), -0.1]), np.array([[1e-4, 0.0], [0.0, 4e-4]]))
    made = calibration.apply(m)
    assert made.range_m == pytest.approx(2.2)
    assert made.bearing_rad == pytest.approx(3.2 - 2 * np.pi)
    assert np.allclose(made.cov, np.diag([1e-4 + 4e-4, 4e-4 + 2.2**2 * 1e-4]))


def test_a_segment_keeps_the_calibration(drives):
    calibrator = drives[0][1].localizer.calibrator
    before = calibrator.calibration
    calibrator.start(np.array([1.0, 2.0, 3.0]), np.eye(3))
    after = calibrator.calibration
    assert np.array_equal(before.value, after.value)
    assert np.array_equal(before.cov, after.cov)


def test_the_gradient_is_that_of_the_robust_cost():
    rng = np.random.default_rng(0)
    world, k = beacons(), 3.0
    poses = [np.array([*rng.uniform(-1, 1, 2), rng.uniform(-3, 3)]) for _ in range(12)]
    seen = [
        RangeBearingMeasurement(0, int(i), rng.uniform(1, 5), rng.uniform(-3, 3), np.diag([0.2, 0.5]) ** 2)
        for i in rng.integers(0, len(world), 12)
    ]

    def cost(log_scale: float, offset: float) -> float:
        total = 0.0
        for pose, m in zip(poses, seen, strict=True):
            m = shifted(m, log_scale, offset)
            x, y = world.landmarks[m.landmark_id].position[:2] - pose[:2]
            bearing = np.arctan2(y, x) - pose[2]
            e = np.array([np.angle(np.exp(1j * (m.bearing_rad - bearing))), m.range_m - np.hypot(x, y)])
            total += 0.5 * k * k * np.log1p(e @ np.linalg.solve(m.cov, e) / k**2)
        return total

    gradient = calibration_gradient(poses, seen, world, k)
    h = 1e-6
    numeric = [(cost(h, 0) - cost(-h, 0)) / (2 * h), (cost(0, h) - cost(0, -h)) / (2 * h)]
    assert np.allclose(gradient, numeric, rtol=1e-4)
