"""Metrics agree with evo's, and with the figures' definitions."""

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PoseTrajectory3D
from scipy.stats import chi2

from fgloc import se2
from fgloc.config import Config
from fgloc.errors import CovarianceError, TrajectoryError
from fgloc.evaluation import metrics
from fgloc.evaluation import metrics as consistency
from fgloc.evaluation.metrics import Matched, in_own_gauge, match, relative_error
from fgloc.frames import yaw_quaternion
from fgloc.stats import rounded
from fgloc.types import Trajectory

START_NS = 1_700_000_000_123_456_789


def random_walk(rng, n=200, period_ns=100_000_000):
    """A robot's path: smooth yaw that wraps, several metres long."""
    yaw = np.cumsum(rng.normal(0.02, 0.15, n))
    steps = rng.uniform(0.0, 0.12, n)
    poses = np.column_stack([np.cumsum(steps * np.cos(yaw)), np.cumsum(steps * np.sin(yaw)), se2.wrap_array(yaw)])
    return Trajectory(START_NS + period_ns * np.arange(n), poses)


def disturbed(rng, truth, T=(0.0, 0.0, 0.0)):
    """The truth seen from another frame, with noise."""
    noise = rng.normal(0.0, [0.05, 0.05, 0.04], (len(truth), 3))
    poses = se2.compose_array(np.asarray(T), truth.poses) + noise
    poses[:, 2] = se2.wrap_array(poses[:, 2])
    return Trajectory(truth.stamps_ns, poses)


def to_evo(stamps_ns, poses):
    quaternions = np.array([np.roll(yaw_quaternion(yaw), 1) for yaw in poses[:, 2]])
    return PoseTrajectory3D(
        positions_xyz=np.column_stack([poses[:, :2], np.zeros(len(poses))]),
        orientations_quat_wxyz=quaternions,
        timestamps=(stamps_ns - stamps_ns[0]) * 1e-9,
    )


def evo_pair(estimate, truth, align):
    reference, other = to_evo(truth.stamps_ns, truth.poses), to_evo(estimate.stamps_ns, estimate.poses)
    if align:
        other.align(reference, correct_scale=False)
    return reference, other


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("align", ["none", "se2"])
def test_ate_equals_evo(seed, align):
    rng = np.random.default_rng(seed)
    truth = random_walk(rng)
    estimate = disturbed(rng, truth, T=(3.0, -2.0, 2.2) if align == "se2" else (0.0, 0.0, 0.0))
    ours = match(estimate, truth, align)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data(evo_pair(estimate, truth, align == "se2"))
    assert metrics.ate_rmse_m(ours) == pytest.approx(ape.get_statistic(evo_metrics.StatisticsType.rmse), abs=1e-9)
    assert metrics.ate_mean_m(ours) == pytest.approx(ape.get_statistic(evo_metrics.StatisticsType.mean), abs=1e-9)
    assert 0.03 < metrics.ate_rmse_m(ours) < 0.15  # of the noise, not of the frames


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("align", ["none", "se2"])
def test_yaw_error_equals_evo(seed, align):
    rng = np.random.default_rng(seed)
    truth = random_walk(rng)
    estimate = disturbed(rng, truth, T=(3.0, -2.0, 2.2) if align == "se2" else (0.0, 0.0, 0.0))
    ape = evo_metrics.APE(evo_metrics.PoseRelation.rotation_angle_deg)
    ape.process_data(evo_pair(estimate, truth, align == "se2"))
    assert metrics.yaw_mae_deg(match(estimate, truth, align)) == pytest.approx(
        ape.get_statistic(evo_metrics.StatisticsType.mean), abs=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("apart_m", [1.0, 2.5])
def test_relative_error_equals_evo(seed, apart_m):
    rng = np.random.default_rng(seed)
    truth = random_walk(rng)
    estimate = disturbed(rng, truth)
    ours = relative_error(match(estimate, truth), apart_m)
    for relation, value in (
        (evo_metrics.PoseRelation.translation_part, ours.translation_m),
        (evo_metrics.PoseRelation.rotation_angle_deg, ours.rotation_deg),
    ):
        rpe = evo_metrics.RPE(relation, delta=apart_m, delta_unit=evo_metrics.Unit.meters)
        rpe.process_data(evo_pair(estimate, truth, False))
        assert value == pytest.approx(rpe.get_statistic(evo_metrics.StatisticsType.rmse), abs=1e-6)


def test_relative_error_of_a_short_path_is_unknown(rng):
    truth = random_walk(rng, n=5)
    assert relative_error(match(truth, truth), 100.0) is None


def test_rigid_motion_is_found_exactly(rng):
    points = rng.normal(size=(50, 3))
    for yaw in (-3.1, -1.0, 0.0, 0.4, 3.0):
        T = np.array([1.5, -7.0, yaw])
        np.testing.assert_allclose(se2.rigid(points[:, :2], se2.placed(T, points[:, :2])), T, atol=1e-12)


def test_truth_is_interpolated_at_the_estimates_stamps():
    truth = Trajectory(START_NS + 100_000_000 * np.arange(3), np.array([[0, 0, 3.0], [1, 2, -3.0], [2, 4, -2.8]]))
    estimate = Trajectory(np.array([START_NS + 50_000_000]), np.array([[0.5, 1.0, np.pi]]))
    two = Trajectory(np.append(estimate.stamps_ns, truth.stamps_ns[2]), np.vstack([estimate.poses, truth.poses[2]]))
    matched = match(two, truth)
    np.testing.assert_allclose(matched.truth[0, :2], [0.5, 1.0])
    assert abs(matched.errors[0, 2]) < 1e-9  # the shorter way round
    assert matched.distances[1] == 0.0


def test_truth_is_not_interpolated_across_its_gaps():
    truth = Trajectory(START_NS + np.array([0, 100, 200, 1200, 1300]) * 1_000_000, np.zeros((5, 3)))
    estimate = Trajectory(START_NS + np.array([-50, 0, 150, 200, 700, 1200, 1250, 1301]) * 1_000_000, np.zeros((8, 3)))
    matched = match(estimate, truth, max_gap_s=0.2)
    assert ((matched.stamps_ns - START_NS) // 1_000_000).tolist() == [0, 150, 200, 1200, 1250]


def test_trajectories_of_different_times_are_refused(rng):
    truth = random_walk(rng)
    later = Trajectory(truth.stamps_ns + 3_600_000_000_000, truth.poses)
    with pytest.raises(TrajectoryError, match=r"\b0 of 200\b"):
        match(later, truth)


def test_yaw_errors_are_wrapped():
    stamps = START_NS + np.arange(2)
    matched = Matched(
        stamps, np.array([[0, 0, 3.1], [0, 0, -3.1]]), np.array([[0, 0, -3.1], [0, 0, 3.1]]), None, np.zeros(3)
    )
    assert metrics.yaw_mae_deg(matched) == pytest.approx(np.degrees(2 * np.pi - 6.2))


def test_drift_is_end_error_over_distance():
    truth = Trajectory(
        START_NS + 100_000_000 * np.arange(101), np.column_stack([np.linspace(0, 10, 101), np.zeros((101, 2))])
    )
    estimate = Trajectory(truth.stamps_ns, truth.poses + np.array([0.0, 0.5, 0.0]))
    matched = match(estimate, truth)
    assert metrics.end_error_m(matched) == pytest.approx(0.5)
    assert metrics.drift_percent(matched) == pytest.approx(5.0)


def test_noise_of_a_resting_truth_is_no_distance(rng):
    assert metrics.path_length_m(rng.normal(0.0, 0.002, (5000, 2))) == 0.0
    stamps = START_NS + 100_000_000 * np.arange(50)
    resting = match(Trajectory(stamps, np.zeros((50, 3))), Trajectory(stamps, np.zeros((50, 3))))
    assert metrics.drift_percent(resting) is None


def random_covs(rng, n):
    roots = rng.normal(size=(n, 3, 3)) * [0.1, 0.2, 0.05]
    return roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(3)


def test_honest_covariance_is_called_honest(rng):
    covs = random_covs(rng, 4000)
    errors = np.einsum("nij,nj->ni", np.linalg.cholesky(covs), rng.normal(size=(4000, 3)))
    low, high = chi2.ppf([0.00005, 0.99995], 3 * 4000) / 4000
    assert low < consistency.nees(errors, covs).mean() < high
    for k, share in ((1, 0.683), (2, 0.954), (3, 0.997)):
        assert consistency.coverage(errors, covs, k) == pytest.approx(share, abs=0.015)


def test_overconfident_covariance_is_called_so(rng):
    covs = random_covs(rng, 500)
    errors = 2.0 * np.einsum("nij,nj->ni", np.linalg.cholesky(covs), rng.normal(size=(500, 3)))
    assert consistency.nees(errors, covs).mean() > chi2.ppf(0.99995, 3 * 500) / 500


def test_nees_does_not_depend_on_the_frame(rng):
    covs, errors = random_covs(rng, 20), rng.normal(size=(20, 3))
    R = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    turned = consistency.nees(errors @ R.T, R @ covs @ R.T)
    np.testing.assert_allclose(turned, consistency.nees(errors, covs))


def test_singular_covariance_is_refused():
    with pytest.raises(CovarianceError, match=r"\b1\b.*\[\[1\.0, 0\.0, 0\.0\], .*\[0\.0, 0\.0, 0\.0\]\]"):
        consistency.nees(np.ones((2, 3)), np.array([np.eye(3), np.diag([1.0, 1.0, 0.0])]))


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.mark.parametrize(
    ("value", "sigma", "shown"),
    [
        (0.00516, 0.00592, "0.0052 ± 0.0059"),
        (-0.00004, 0.0031, "0.0000 ± 0.0031"),
        (-0.0000123, 0.00000456, "-0.0000123 ± 0.0000046"),
        (1.0, 0.0996, "1.00 ± 0.10"),
        (150.4, 70.7, "150 ± 71"),
        (1234.5, 567.8, "1234 ± 568"),
        (0.99, 0.0, "0.99 ± 0"),
        (5.0, float("inf"), "5 ± inf"),
    ],
)
def test_a_figure_has_the_decimals_of_its_sigma(value, sigma, shown):
    assert " ± ".join(rounded(value, sigma)) == shown
    assert rounded(abs(value), sigma, "+")[0].startswith("+")


def test_honest_dead_reckoning_is_called_honest_where_the_truths_frame_is_fitted(rng):
    """Drift from a first pose that is known exactly; the truth lives in another frame, and has its own noise."""
    values = []
    for _ in range(20):
        steps = np.tile([0.05, 0.0, 0.01], (300, 1))
        sigma = np.array([0.004, 0.002, 0.004])
        true, guess, cov = [np.zeros(3)], [np.zeros(3)], [1e-8 * np.eye(3)]
        for step in steps:
            true.append(se2.compose(true[-1], step))
            guess.append(se2.compose(guess[-1], step + rng.normal(0.0, sigma)))
            c, s = np.cos(guess[-2][2]), np.sin(guess[-2][2])
            F, R = np.eye(3), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            F[:2, 2] = [-s * step[0], c * step[0]]
            cov.append(F @ cov[-1] @ F.T + R @ np.diag(sigma**2) @ R.T)
        stamps = np.arange(len(true)) * 100_000_000
        moved = se2.compose_array(np.array([2.0, -1.0, 0.7]), np.array(true)) + rng.normal(
            0.0, [0.003, 0.003, 0.005], (301, 3)
        )
        matched = match(Trajectory(stamps, np.array(guess), np.array(cov)), Trajectory(stamps, moved), "se2")
        values.append(np.mean(consistency.nees(*in_own_gauge(matched))) / 3.0)
    assert 0.5 < np.mean(values) < 1.5
    plain = np.mean(consistency.nees(matched.errors, matched.covs)) / 3.0
    assert plain > 10.0 * values[-1]


@pytest.mark.parametrize(("truth", "named"), [("of its own", False), ("turned", True), ("none", False)])
def test_a_truth_without_a_yaw_is_no_body_that_is_turned(truth: str, named: bool) -> None:
    """A robot that drives in waves along one direction: of a truth whose yaw is 0 all along it is off by one angle."""
    t = np.linspace(0.0, 30.0, 301)
    yaw = 1.2 + 0.1 * np.sin(t)
    path = np.cumsum(0.1 * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)
    true = {"of its own": yaw, "turned": yaw - 0.5, "none": np.zeros(len(t))}[truth]
    stamps = np.round(1e9 * t).astype(np.int64)
    estimate = Trajectory(stamps, np.column_stack([path, yaw]))
    matched = match(estimate, Trajectory(stamps, np.column_stack([path + 0.01, true]), has_yaw=bool(true.any())))
    finding = metrics._turned(Config(), matched)
    assert (finding is not None) is named
    if finding is not None:
        assert float(finding.lines["truth.yaw_offset_rad"]) == pytest.approx(-0.5, abs=0.01)
