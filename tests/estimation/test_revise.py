"""Motion factors changed after the fact: the belief is that of an estimator that was told right at first."""

from __future__ import annotations

import numpy as np
import pytest

from fgloc import se2
from fgloc.config import EstimatorConfig
from fgloc.graph.estimators import Estimator, ExtendedKalmanFilter, IncrementalEstimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.sensors.measurements import PointMeasurement
from fgloc.types import Landmark, LandmarkMap, MotionMeasurement

KINDS = ("fixed_lag", "isam2", "ekf")
Q, R = np.diag([0.01, 0.005, 0.01]) ** 2, np.diag([0.02, 0.08]) ** 2
MAP = LandmarkMap({i: Landmark(i, np.array([4.0 * np.cos(i), 4.0 * np.sin(i), 0.0]), np.eye(3), 0.0) for i in range(6)})
STEP = np.array([0.08, 0.0, 0.03])


def motion(k: int, source: str, offset, scale: float = 1.0) -> MotionMeasurement:
    return MotionMeasurement(source, k - 1, k, se2.compose(STEP, se2.exp(np.asarray(offset, dtype=float))), scale * Q)


class Drive:
    """A drive whose wheels slip; what the motion was told at first, and what is known of it later."""

    def __init__(self, n: int, blind=range(0), seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.n, self.first, self.later, self.seen = n, {}, {}, {}
        truth = np.zeros(3)
        for k in range(1, n):
            truth = se2.compose(truth, STEP)
            noise = rng.multivariate_normal(np.zeros(3), Q, 2)
            self.first[k] = [motion(k, "wheels", noise[0] + [0.02, 0.0, 0.0]), motion(k, "learned", noise[1])]
            self.later[k] = [motion(k, "learned", noise[1], 2.0)]
            ids = rng.choice(6, 2, replace=False) if k % 4 == 0 and k not in blind else ()
            self.seen[k] = [self._sighting(k, truth, int(i), rng) for i in ids]

    def _sighting(self, k, truth, i, rng):
        x, y, _ = se2.between(truth, (*MAP.landmarks[i].position[:2], 0.0))
        bearing, distance = rng.multivariate_normal((np.arctan2(y, x), np.hypot(x, y)), R)
        return PointMeasurement(k, i, distance, bearing, R)


def estimator(kind: str, lag_s: float = 3.0, keep_all: bool = False, threshold: float = 1e-4) -> Estimator:
    config = EstimatorConfig(kind=kind, lag_s=lag_s, relinearize_threshold=threshold)
    made = ExtendedKalmanFilter if kind == "ekf" else IncrementalEstimator
    started = made(config, LandmarkFactors(MAP), keep_all)
    started.start(0, PoseWithCovariance(np.zeros(3), 1e-4 * np.eye(3)))
    return started


def follow(run: Estimator, drive: Drive, ks, motions) -> PoseWithCovariance:
    factors = LandmarkFactors(MAP)
    for k in ks:
        held = [factors.sighting(k, m, None) for m in drive.seen[k]]
        belief = run.update(k * 10**8, 0.1, motions[k], held)
    return belief


def assert_same(a: PoseWithCovariance, b: PoseWithCovariance, atol: float = 1e-3, rtol: float = 5e-3) -> None:
    """Factors are linear about what was predicted when they were made: 1 mm where the revisions here move 40 to 91."""
    assert np.abs(se2.log(se2.between(a.pose, b.pose))).max() < atol
    assert np.abs(a.cov - b.cov).max() < rtol * np.abs(b.cov).max()


def follow_all(drive: Drive, n: int) -> Estimator:
    run = estimator("fixed_lag", lag_s=1.0)
    follow(run, drive, range(1, n), drive.first)
    return run


def settled(run: Estimator) -> PoseWithCovariance:
    """Iterated to the end: a factor swapped for itself is one more iteration."""
    newest = run.log.keyframes[run.k]
    for _ in range(4):
        run.revise({newest.k: newest.motions})
    return run.belief


@pytest.mark.parametrize("kind", KINDS)
def test_revised_motions_are_as_if_they_had_been_given_at_first(kind):
    drive = Drive(30)
    revised, told = estimator(kind), estimator(kind)
    follow(revised, drive, range(1, 20), drive.first)
    revised.revise({k: drive.later[k] for k in range(12, 20)})
    expected = follow(told, drive, range(1, 20), drive.first | {k: drive.later[k] for k in range(12, 20)})
    assert np.abs(se2.between(revised.belief.pose, expected.pose)).max() < 2e-3  # one iteration each
    assert_same(settled(revised), settled(told))
    assert revised.log.keyframes[19].belief is revised.belief
    assert revised.rebuilt == 0
    unchanged = follow(estimator(kind), drive, range(1, 20), drive.first)
    assert np.abs(se2.between(unchanged.pose, expected.pose)).max() > 1e-3  # it does make a difference
    after = [follow(run, drive, range(20, 26), drive.first) for run in (revised, told)]
    assert_same(*after)


@pytest.mark.parametrize("kind", KINDS)
def test_a_pose_that_was_set_does_not_follow_motions_revised_before_it(kind):
    drive, given = Drive(10), PoseWithCovariance(np.array([3.0, 1.0, 0.5]), 1e-4 * np.eye(3))
    run = estimator(kind)
    follow(run, drive, range(1, 6), drive.first)
    run.start(6 * 10**8, given)
    run.revise({k: drive.later[k] for k in range(3, 6)})
    assert_same(run.belief, given)


@pytest.mark.parametrize("kind", KINDS)
def test_many_revisions_as_poses_leave_the_window(kind):
    """Slots are used again and poses are marginalized between them; in the end nothing has been swapped for another."""
    drive = Drive(160)
    revised, told = estimator(kind, lag_s=2.0), estimator(kind, lag_s=2.0)
    believed = {}
    for k in range(1, 150):
        follow(revised, drive, [k], drive.first)
        believed[k] = drive.first[k]
        if k % 10 == 0:
            back = {i: drive.later[i] for i in range(k - 5, k + 1)}
            revised.revise(back)
            believed |= back
        if k % 30 == 0:  # and some of it is taken back
            again = {i: drive.first[i] for i in range(k - 2, k + 1)}
            revised.revise(again)
            believed |= again
    follow(told, drive, range(1, 150), believed)
    assert_same(settled(revised), settled(told))
    assert revised.rebuilt == told.rebuilt == 0
    assert_same(
        follow(revised, drive, range(150, 155), drive.first),
        follow(told, drive, range(150, 155), drive.first),
    )


def test_a_revision_that_reaches_behind_the_window_changes_what_is_in_it():
    drive = Drive(70)
    revised, told = estimator("fixed_lag", lag_s=1.0, keep_all=True), estimator("fixed_lag", lag_s=1.0)
    follow(revised, drive, range(1, 60), drive.first)
    revised.revise({k: drive.later[k] for k in range(20, 60)})
    assert all(revised.log.keyframes[k].motions == tuple(drive.later[k]) for k in range(20, 60))  # the batch's
    inside = {k: drive.later[k] for k in range(50, 60)}  # as near as the window's end may be said
    follow(told, drive, range(1, 60), drive.first | inside)
    before = settled(follow_all(drive, 60)).pose
    apart = np.abs(se2.between(settled(revised).pose, settled(told).pose))
    assert (apart < 0.2 * np.abs(se2.between(before, told.belief.pose)).max()).all()
    assert revised.rebuilt == 0


def test_what_is_held_stays_bounded():
    drive = Drive(400)
    run = estimator("fixed_lag", lag_s=2.0)
    held = []
    for k in range(1, 400):
        follow(run, drive, [k], drive.first)
        if k > 10 and k % 3 == 0:
            run.revise({i: drive.later[i] for i in range(k - 5, k + 1)})
        held.append((len(run._slots), run._backend._smoother.getFactors().size(), len(run.log)))
    early, late = np.max(held[30:60], axis=0), np.max(held[-100:], axis=0)
    assert (late <= early + 2).all()
    assert late[0] < 25
    assert late[1] < 120


def test_an_exception_while_revising_leaves_the_newest_belief(monkeypatch):
    """Whatever GTSAM does not like of the window: the run goes on."""
    drive = Drive(40)
    run = estimator("fixed_lag")
    follow(run, drive, range(1, 20), drive.first)
    before, calls = run.belief, []
    swap, update = type(run._backend).swap, type(run._backend).update

    def fails(self, *args):
        raise RuntimeError("indeterminate linear system")

    def fails_once(self, *args):
        calls.append(0)
        return fails(self) if len(calls) == 3 else update(self, *args)

    monkeypatch.setattr(type(run._backend), "swap", fails)
    monkeypatch.setattr(type(run._backend), "update", fails_once)
    run.revise({k: drive.later[k] for k in range(12, 20)})
    monkeypatch.setattr(type(run._backend), "swap", swap)
    assert run.rebuilt == 1
    assert np.abs(se2.between(before.pose, run.belief.pose)).max() < 0.05
    after = follow(run, drive, range(20, 30), drive.first)
    assert np.isfinite(after.cov).all()
