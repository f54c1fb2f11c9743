"""Graduated non-convexity: finds the outliers of a whole run without a good guess."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from fgloc import se2
from fgloc.config import BatchConfig, EstimatorConfig
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.gnc import Candidate, graduate, surrogate_weights
from fgloc.graph.isam2 import IncrementalEstimator
from fgloc.graph.measurement_log import Belief
from fgloc.types import Landmark, LandmarkMap, MotionMeasurement, RangeBearingMeasurement

MAP = LandmarkMap({i: Landmark(i, np.array([2.0 * i, 2.0 * (i % 2), 0.0]), np.eye(3), 0.0) for i in range(6)})
COV = np.diag([0.01, 0.01, 0.005]) ** 2
STEP = np.array([0.1, 0.0, 0.0])


def line(z, sigma=1.0):
    return gtsam.PriorFactorPoint2(0, np.array([z, 0.0]), gtsam.noiseModel.Isotropic.Sigma(2, sigma))


def least_squares(graph, values):
    return gtsam.GaussNewtonOptimizer(graph, values).optimize()


def test_weights_are_those_of_the_paper():
    ratios = np.array([0.0, 0.4, 0.6, 1.0, 1.9, 2.1])
    weights = surrogate_weights(ratios, 1.0)  # 1 up to 1/2, 0 from 2 on
    assert weights[[0, 1]].tolist() == [1.0, 1.0]
    assert weights[5] == 0.0
    assert weights[2:5] == pytest.approx(np.sqrt(2.0 / ratios[2:5]) - 1.0)


def test_a_third_of_outliers_is_found_from_their_middle():
    rng = np.random.default_rng(0)
    good, bad = rng.normal(0.0, 1.0, 20), rng.normal(60.0, 1.0, 10)
    candidates = [Candidate((line(z),), 9.0) for z in (*good, *bad)]
    start = gtsam.Values()
    start.insert(0, np.array([float(np.mean([*good, *bad])), 0.0]))
    weights, values = graduate(gtsam.NonlinearFactorGraph(), candidates, start, least_squares)
    assert (weights[20:] < 1e-6).all()
    assert weights[:20].sum() > 17
    assert values.atPoint2(0)[0] == pytest.approx(good.mean(), abs=0.3)


def test_known_inliers_decide():
    inliers = gtsam.NonlinearFactorGraph()
    inliers.add(line(0.0, 0.1))
    start = gtsam.Values()
    start.insert(0, np.array([50.0, 0.0]))
    weights, _ = graduate(inliers, [Candidate((line(50.0),), 9.0), Candidate((line(1.0),), 9.0)], start, least_squares)
    assert weights.round(6).tolist() == [0.0, 1.0]


def drive(learned, sees=lambda k: True, slips=range(20, 30), n=60):
    """A straight drive; the wheels turn four times too far in the steps that slip."""
    estimator = IncrementalEstimator(EstimatorConfig(), LandmarkFactors(MAP), keep_all=True)
    estimator.start(0, Belief(np.zeros(3), COV))
    truth = [np.zeros(3)]
    for k in range(1, n):
        truth.append(se2.compose(truth[-1], STEP))
        motions = [MotionMeasurement("wheels", 0, k, STEP * (4.0 if k in slips else 1.0), COV)]
        if learned:
            motions.append(MotionMeasurement("learned", 0, k, STEP, 4.0 * COV))
        seen = []
        for landmark in MAP.landmarks.values():
            x, y, _ = se2.between(truth[-1], np.array([*landmark.position[:2], 0.0]))
            m = RangeBearingMeasurement(
                k, landmark.landmark_id, float(np.hypot(x, y)), float(np.arctan2(y, x)), np.diag([0.01, 0.05]) ** 2
            )
            seen.append(LandmarkFactors(MAP).sighting(k, m, 3.0))
        estimator.update(k, 0.2, motions, seen if sees(k) else [])
    return estimator.log, np.array(truth)


def worst(solver, truth):
    return np.hypot(*(solver.poses() - truth)[:, :2].T).max()


def test_slip_while_blind_is_left_to_the_learned_motion():
    log, truth = drive(learned=True, sees=lambda k: not 15 <= k < 35)
    errors = {}
    for robust in ("none", "gnc"):
        solver = BatchSmoother(log, LandmarkFactors(MAP), BatchConfig(robust=robust), 0.9999)
        errors[robust] = worst(solver, truth)
    assert set(solver.outliers) == set(range(20, 30))
    assert all(held == {"wheels"} for held in solver.outliers.values())
    assert errors["gnc"] < 0.02
    assert errors["none"] > 10 * errors["gnc"]


@pytest.mark.parametrize(("robust", "learned"), [("gnc", False), ("gnc_all", True)])
def test_where_nothing_may_be_believed_every_pose_is_still_determined(robust, learned):
    log, _ = drive(learned)
    solver = BatchSmoother(log, LandmarkFactors(MAP), BatchConfig(robust=robust), 0.9999)
    assert set(range(20, 30)) <= set(solver.outliers)
    assert np.isfinite(solver.result().covs).all()
